"""Links of the pages have targets, and the site has every public name and the notebooks."""

from __future__ import annotations

import importlib
import json
import re
from pathlib import Path
from urllib.parse import unquote

import pytest

import cflow_torch
from cflow_torch import evaluation, viz
from cflow_torch.data.catalog import DATA_SETS

ROOT = Path(__file__).resolve().parents[2]
PAGES = [*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md"), *(ROOT / "notebooks").glob("*.[im][pd]*")]
CODE = re.compile(r"^ *(```+|~~~+).*?^ *\1|(`+)(?!`).*?(?<!`)\2(?!`)", re.M | re.S)
LINK = re.compile(r"\]\(\s*<?([^)\s>]+)|<(?:img|a)\b[^>]*?\b(?:src|href)=\"([^\"]+)|^\[[^\]]+\]:\s+(\S+)", re.M)


def text_of(page: Path) -> str:
    """Return the Markdown of a page, or of the text cells of a notebook."""
    text = page.read_text(encoding="utf-8")
    if page.suffix == ".ipynb":
        cells = json.loads(text)["cells"]
        text = "\n\n".join("".join(cell["source"]) for cell in cells if cell["cell_type"] == "markdown")
    return text


def anchors(page: Path) -> set[str]:
    """Return the anchors that GitHub gives the headings of a page."""
    titles = re.findall(r"^#{1,6} +(.+?) *$", re.sub(r"^```.*?^```", "", text_of(page), flags=re.M | re.S), re.M)
    return {re.sub(r"[^\w\- ]", "", title.lower()).replace(" ", "-") for title in titles}


def broken_links(page: Path) -> list[str]:
    """Return the links of a page without a target in this repository."""
    wrong = []
    for parts in LINK.findall(CODE.sub("", text_of(page))):
        target = unquote("".join(parts))
        path, _, anchor = target.partition("#")
        file = (page.parent / path).resolve() if path else page
        if re.match(r"https?:|mailto:", target):
            continue
        if not file.exists() or ROOT not in (file, *file.parents) or (anchor and anchor not in anchors(file)):
            wrong.append(target)
    return wrong


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_links_have_targets(page: Path) -> None:
    assert not broken_links(page)


def test_the_reference_has_every_public_name() -> None:
    named = set(re.findall(r"- (cflow_torch\.[\w.]+)$", (ROOT / "mkdocs.yml").read_text(encoding="utf-8"), re.M))
    public = {f"cflow_torch.{name}" for name in cflow_torch.__all__ if name != "__version__"}
    readers = {f"cflow_torch.data.{name}.{one.log}" for name, one in DATA_SETS.items()}
    scores = {f"cflow_torch.evaluation.{name}" for name in evaluation.__all__ if name != "DEFINITIONS"}
    pictures = {
        f"cflow_torch.viz.{name}" for name in viz.__all__ if name.startswith(("plot", "save", "record", "show"))
    }
    assert not (public | readers | scores | pictures) - named


def test_a_notebook_becomes_a_page_with_its_outputs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(ROOT / "scripts")
    notebook_page = importlib.import_module("site_pages").notebook_page
    outputs = [
        {"output_type": "stream", "text": ["1 car\n"]},
        {"output_type": "display_data", "data": {"image/png": "iVBO\n", "text/plain": "<Figure>"}},
    ]
    cells = [
        {"cell_type": "markdown", "source": ["# A title"]},
        {"cell_type": "code", "source": ["print(cars)"], "outputs": outputs},
    ]
    file = tmp_path / "a.ipynb"
    file.write_text(json.dumps({"cells": cells}), encoding="utf-8")
    assert notebook_page(file) == (
        "# A title\n\n```python\nprint(cars)\n```\n\n```text\n1 car\n```\n\n![output](data:image/png;base64,iVBO)"
    )
