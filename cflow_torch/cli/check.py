"""Say for each log what is right, and what is wrong and how to fix it: `cflow check`."""

from __future__ import annotations

import json
from typing import Any

from cflow_torch.cli.commands import Check
from cflow_torch.cli.logs import Sources, find_logs
from cflow_torch.data.log_check import WRONG, Finding, examine
from cflow_torch.types import CFlowError


def task(cfg: Check) -> None:
    sources = find_logs(cfg.data)
    sources.settings["check"] = False  # `examine` says more
    pages = [_page(sources, source, str(cfg.data["label"])) for source in sources.logs]
    if cfg.json:
        print(json.dumps(pages, indent=2, ensure_ascii=False))
    else:
        print("\n\n".join(map(_text, pages)))
    if any(finding["status"] == WRONG for page in pages for finding in page["findings"]):
        raise SystemExit(1)


def _page(sources: Sources, source: Any, label: str) -> dict[str, Any]:
    """Return the page of a log; one that cannot be opened has a single line, its error."""
    try:
        with sources.open(source) as log:
            name, findings = log.log_id, examine(log)
    except (CFlowError, OSError) as error:
        name = str(getattr(source, "name", source))
        findings = [Finding("log", WRONG, str(error))]
    rows = [{"topic": each.topic, "status": each.status, "text": each.text} for each in findings]
    return {"log": name, "data": label, "findings": rows}


def _text(page: dict[str, Any]) -> str:
    rows = page["findings"]
    num_wrong = sum(row["status"] == WRONG for row in rows)
    head = f"{page['log']} ({page['data']}): {f'{num_wrong} wrong' if num_wrong else 'nothing is wrong'}"
    return "\n".join([head, *(f"  {row['topic']:11}  {row['status']:14}  {row['text']}" for row in rows)])
