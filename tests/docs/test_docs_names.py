"""What the pages name is there: files, what files define, settings; and docs/method.md has every label of the paper."""

from __future__ import annotations

import ast
import re
from dataclasses import fields
from functools import lru_cache
from pathlib import Path
from typing import FrozenSet, Iterator, List, Set, Tuple

import pytest

from cflow_torch import Config

ROOT = Path(__file__).resolve().parents[2]
PACKAGE = ROOT / "cflow_torch"
METHOD = ROOT / "docs" / "method.md"
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md"))]
# Files of other programs, or ones that a page tells the reader to write.
FOREIGN = {"eval.py", "save.py", "test_pl.py", "run_cflow.py", "tools/visualization.py"}
# Where a file may be that is named without its folder.
FOLDERS = (ROOT, PACKAGE, PACKAGE / "reference", ROOT / "scripts", ROOT / "tests")
LABEL = r"(?:Eq|Alg|Sec)\. |(?:Table|Figure) "


def text_of(page: Path) -> str:
    return page.read_text(encoding="utf-8")


def find(name: str) -> List[Path]:
    """Files of this name."""
    return [folder / name for folder in FOLDERS if (folder / name).is_file()]


@lru_cache(maxsize=None)
def defined(file: Path) -> FrozenSet[str]:
    """Functions, classes, their methods and fields (`Class.name`), and variables of a module."""
    found: Set[str] = set()
    for node in ast.parse(text_of(file)).body:
        found.update(_names(node))
        if isinstance(node, ast.ClassDef):
            found.update(f"{node.name}.{name}" for inner in node.body for name in _names(inner))
    return frozenset(found)


def _names(node: ast.stmt) -> Iterator[str]:
    if isinstance(node, (ast.FunctionDef, ast.ClassDef)):
        yield node.name
    elif isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name):
        yield node.target.id
    elif isinstance(node, ast.Assign):
        yield from (target.id for target in node.targets if isinstance(target, ast.Name))


def names_in_files(text: str) -> Iterator[Tuple[str, str]]:
    """(file, name) of everything that is written as `file.py`: `name`, `name`."""
    for found in re.finditer(r"`([\w/]+\.py)`:((?:,?\s+`[\w.]+`)+)", text):
        yield from ((found[1], name) for name in re.findall(r"`([\w.]+)`", found[2]))


def labels(docstring: str) -> Iterator[str]:
    """Labels of the paper in the `Source:` part of a docstring."""
    source = re.search(r"^\s*Source: (.*?)(?:\n\s*\n|\Z)", docstring, re.M | re.S)
    if source is None:
        return
    of_label = False
    for item in re.split(r"[;,]\s+", re.sub(r"\s+", " ", source[1]).rstrip(". ")):
        item = re.sub(r"^\w+: ", "", item)
        starts = re.match(LABEL, item) is not None
        if starts or (of_label and re.fullmatch(r"\w+", item)):
            yield re.split(r" with |: ", re.sub(LABEL, "", item))[0]
        of_label = starts or of_label


def all_labels() -> Set[Tuple[str, str]]:
    """(file, label) of the docstrings of the package."""
    found = set()
    for file in PACKAGE.rglob("*.py"):
        for node in ast.walk(ast.parse(text_of(file))):
            if isinstance(node, (ast.Module, ast.ClassDef, ast.FunctionDef)):
                for label in labels(ast.get_docstring(node) or ""):
                    found.add((file.name, label))
    return found


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_files_that_are_named_exist(page):
    text = text_of(page).replace("/path/to/cflow_torch/", "")
    named = set(re.findall(r"(?<![\w/.-])([\w/]+\.py)\b", text))
    assert not [name for name in sorted(named - FOREIGN) if not find(name)]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_what_files_are_said_to_hold_is_there(page):
    wrong = [
        (file, name) for file, name in names_in_files(text_of(page)) if not any(name in defined(f) for f in find(file))
    ]
    assert not wrong


def test_the_method_names_both_paths_for_every_stage():
    text = text_of(METHOD)
    stages = re.findall(r"^### .*?(?=^##)", text, re.M | re.S)
    assert len(stages) >= 16
    for stage in stages:
        title = stage.split("\n")[0]
        for path, folder in (("Fast path", PACKAGE), ("Reference", PACKAGE / "reference")):
            told = re.search(rf"^- {path}: (.*?)(?=^- |\Z)", stage, re.M | re.S)
            assert told, f"{title}: no {path}"
            files = {file for file, _ in names_in_files(told[1])}
            assert files, title
            assert all((ROOT / file).is_file() and folder in (ROOT / file).parents for file in files), title
    assert len(list(names_in_files(text))) > 60


def test_words_in_code_type_on_the_method_page_are_known():
    known = {field.name for field in fields(Config)}
    for file in PACKAGE.rglob("*.py"):
        for node in ast.walk(ast.parse(text_of(file))):
            if isinstance(node, ast.Constant) and isinstance(node.value, str):
                known.add(node.value)
            known.update(
                getattr(node, part) for part in ("id", "attr", "arg", "name") if isinstance(getattr(node, part, 0), str)
            )
    known.update({"pytest", "Config"})
    words = set(re.findall(r"`([A-Za-z_][\w.]*)`", text_of(METHOD)))
    words -= {word for word in words if word.endswith((".py", ".md"))}
    assert len(words) > 60
    assert not sorted(word for word in words if not set(word.split(".")) <= known)


def test_every_label_that_docstrings_carry_is_on_the_method_page():
    found = all_labels()
    assert len({label for _, label in found}) >= 10
    text = re.sub(r"\s+", " ", text_of(METHOD))
    assert not sorted((file, label) for file, label in found if label not in text)


def test_every_label_in_the_code_is_on_the_method_page():
    # Not only in `Source:`: equations, algorithms, tables and figures wherever the method has one.
    text = text_of(METHOD)
    method = [*PACKAGE.glob("*.py"), *PACKAGE.glob("ops/*.py"), *PACKAGE.glob("reference/*.py")]
    for file in method:
        code = re.sub(r"\s+", " ", text_of(file))
        for label in re.findall(rf"(?:{LABEL})(\w*_\w*\w)", code):
            assert label in text, f"{file.name}: {label}"
