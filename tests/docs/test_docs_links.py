"""Links of the pages and notebooks: files, pictures and headings are there, and the index has every page."""

from __future__ import annotations

import json
import re
from collections import Counter
from functools import lru_cache
from pathlib import Path
from typing import Dict, FrozenSet, Iterator, List, Tuple
from urllib.parse import unquote

import pytest

ROOT = Path(__file__).resolve().parents[2]
INDEX = ROOT / "docs" / "README.md"
TOP = [ROOT / name for name in ("README.md", "CONTRIBUTING.md", "CHANGELOG.md")]
PAGES = [*TOP, *sorted((ROOT / "docs").rglob("*.md"))]
NOTEBOOKS = sorted((ROOT / "notebooks").glob("*.ipynb"))
ELSEWHERE = ("http://", "https://", "mailto:")


def without_code(text: str) -> str:
    """Text without fenced blocks and code spans."""
    text = re.sub(r"^( *)(```+|~~~+).*?^\1\2 *$", "", text, flags=re.M | re.S)
    return re.sub(r"(`+)(?!`).*?(?<!`)\1(?!`)", "", text, flags=re.S)


def targets(text: str) -> Iterator[str]:
    """Where links and pictures of a Markdown text point."""
    text = without_code(text)
    for found in re.finditer(r"\]\(\s*<?([^)\s>]+)>?(?:\s+\"[^\"]*\")?\s*\)", text):
        yield found[1]
    for found in re.finditer(r"^\[[^\]]+\]:\s+(\S+)", text, re.M):
        yield found[1]
    for found in re.finditer(r"<(?:img|a|video|source)\b[^>]*?\b(?:src|href)=\"([^\"]+)\"", text):
        yield found[1]


def text_of(file: Path) -> str:
    """Markdown of a page, or of the cells of a notebook that hold text."""
    text = file.read_text(encoding="utf-8")
    if file.suffix != ".ipynb":
        return text
    cells = json.loads(text)["cells"]
    return "\n\n".join("".join(cell["source"]) for cell in cells if cell["cell_type"] == "markdown")


def slug(title: str) -> str:
    """Anchor that GitHub gives a heading, before doubles are told apart."""
    title = re.sub(r"!?\[([^\]]*)\]\([^)]*\)", r"\1", title).strip().lower()
    return re.sub(r"[^\w\- ]", "", title.replace("`", "")).replace(" ", "-")


@lru_cache(maxsize=None)
def anchors(file: Path) -> FrozenSet[str]:
    """Anchors of a page: its headings, doubles with -1, -2 ..., and names that are written in HTML."""
    text = re.sub(r"^( *)(```+).*?^\1\2 *$", "", text_of(file), flags=re.M | re.S)
    found, seen = set(re.findall(r"<a (?:id|name)=\"([^\"]+)\"", text)), Counter()
    for title in re.findall(r"^#{1,6} +(.+?) *#*$", text, re.M):
        name = slug(title)
        found.add(f"{name}-{seen[name]}" if seen[name] else name)
        seen[name] += 1
    return frozenset(found)


def broken(file: Path) -> List[str]:
    """Links of a file that lead nowhere in this repository."""
    wrong = []
    for target in targets(text_of(file)):
        if target.startswith(ELSEWHERE):
            continue
        path, _, anchor = unquote(target).partition("#")
        place = (file.parent / path).resolve() if path else file
        inside = place == ROOT or ROOT in place.parents
        if not inside or not place.exists() or (anchor and anchor not in anchors(place)):
            wrong.append(target)
    return wrong


@pytest.mark.parametrize("file", [*PAGES, *NOTEBOOKS], ids=lambda file: str(file.relative_to(ROOT)))
def test_links_and_pictures_lead_somewhere(file):
    assert not broken(file)


def test_the_index_has_every_page():
    linked = {(INDEX.parent / target.partition("#")[0]).resolve() for target in targets(text_of(INDEX))}
    wanted = {*(ROOT / "docs").rglob("*.md"), *NOTEBOOKS, *TOP} - {INDEX}
    assert not sorted(str(page.relative_to(ROOT)) for page in wanted - linked)


def test_the_readme_leads_to_the_index():
    assert INDEX in {(ROOT / target).resolve() for target in targets(text_of(ROOT / "README.md"))}


def test_every_picture_of_the_docs_is_shown_somewhere():
    shown = {(page.parent / target).resolve() for page in [*PAGES, *NOTEBOOKS] for target in targets(text_of(page))}
    pictures = {file for kind in ("png", "jpg", "gif", "svg") for file in (ROOT / "docs").rglob(f"*.{kind}")}
    assert not sorted(str(picture.relative_to(ROOT)) for picture in pictures - shown)


CASES: Dict[str, Tuple[str, List[str]]] = {
    "a file": ("[a](there.md) ![b](gone.png)", ["gone.png"]),
    "a heading": ("[a](there.md#two-words) [b](there.md#two)", ["there.md#two"]),
    "a heading here": ("# One, `two`!\n[a](#one-two) [b](#one)", ["#one"]),
    "a double heading": ("# A\n# A\n[a](#a-1) [b](#a-2)", ["#a-2"]),
    "code": ("`[a](gone.md)`\n```\n[a](gone.md)\n```\n", []),
    "elsewhere": ("[a](https://example.org/gone)", []),
    "outside": ("[a](../../../../../etc/hostname)", ["../../../../../etc/hostname"]),
    "html": ('<img src="gone.png" width="3">', ["gone.png"]),
}


@pytest.mark.parametrize("case", CASES)
def test_what_is_broken_is_found(case, tmp_path, monkeypatch):
    monkeypatch.setitem(globals(), "ROOT", tmp_path)
    (tmp_path / "there.md").write_text("## Two words\n", encoding="utf-8")
    page = tmp_path / "page.md"
    text, expected = CASES[case]
    page.write_text(text, encoding="utf-8")
    assert broken(page) == expected
