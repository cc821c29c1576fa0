"""Say for each log what is right, and what is wrong and how to fix it: `cflow check`."""

from __future__ import annotations

import json
import sys
from typing import Any, TextIO

from cflow_torch.cli.commands import Check
from cflow_torch.cli.logs import complete_data, find_logs, paths_of
from cflow_torch.data.catalog import Logs, source_name
from cflow_torch.data.log_check import WRONG, Finding, examine
from cflow_torch.types import CFlowError


def task(cfg: Check) -> None:
    """Print the pages of each path, whatever its format is."""
    statuses = [0]
    for data in [{**cfg.data, "root": path} for path in paths_of(cfg.data)] or [cfg.data]:
        try:
            pages = _pages(data, sys.stderr if cfg.json else sys.stdout)
        except CFlowError as error:
            print(f"error: {error}", file=sys.stderr)
            statuses.append(2)
            continue
        print(json.dumps(pages, indent=2, ensure_ascii=False) if cfg.json else "\n\n".join(map(_text, pages)))
        statuses += [1 for page in pages for finding in page["findings"] if finding["status"] == WRONG]
    if max(statuses):
        raise SystemExit(max(statuses))


def _pages(data: dict[str, Any], out: TextIO) -> list[dict[str, Any]]:
    """Return the pages of the logs of one path."""
    data = complete_data(data, out)
    logs = find_logs({**data, "check": False})  # `examine` says more
    return [_page(logs, source, str(data["label"])) for source in logs.sources]


def _page(logs: Logs, source: Any, label: str) -> dict[str, Any]:
    """Return the page of a log; one that cannot be opened has a single line, its error."""
    try:
        with logs.open(source) as log:
            name, findings = log.log_id, examine(log)
    except (CFlowError, OSError) as error:
        name = source_name(source)
        findings = [Finding("log", WRONG, str(error))]
    rows = [{"topic": each.topic, "status": each.status, "text": each.text} for each in findings]
    return {"log": name, "data": label, "findings": rows}


def _text(page: dict[str, Any]) -> str:
    rows = page["findings"]
    num_wrong = sum(row["status"] == WRONG for row in rows)
    head = f"{page['log']} ({page['data']}): {f'{num_wrong} wrong' if num_wrong else 'nothing is wrong'}"
    return "\n".join([head, *(f"  {row['topic']:11}  {row['status']:14}  {row['text']}" for row in rows)])
