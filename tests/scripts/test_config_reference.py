"""docs/configuration.md is what the code and the YAML files say, and nothing in it lacks a meaning or a limit."""

from __future__ import annotations

import importlib
import re
import subprocess
import sys
from dataclasses import fields
from pathlib import Path
from typing import Any, Dict, Iterator, Tuple

import pytest
import yaml

from cflow_torch import CFlowError, Config

ROOT = Path(__file__).resolve().parents[2]
SCRIPT = ROOT / "scripts" / "config_reference.py"
NAMES = [field.name for field in fields(Config)]
CONFIGS = sorted(file for file in (ROOT / "configs").rglob("*.yaml") if file.parent.name != "model")


@pytest.fixture(scope="module")
def reference() -> Iterator[Any]:
    sys.path.insert(0, str(SCRIPT.parent))
    try:
        yield importlib.import_module("config_reference")
    finally:
        sys.path.remove(str(SCRIPT.parent))


def plain_keys(values: Dict[str, Any], before: str = "") -> Iterator[Tuple[str, Any]]:
    """Dotted names of the values of a file, as the keys of the page are named."""
    for name, value in values.items():
        if before == "" and name in ("defaults", "hydra"):
            continue
        is_group = isinstance(value, dict) and before != "rows."  # rows of an experiment are values
        yield from plain_keys(value, f"{before}{name}.") if is_group else [(f"{before}{name}", value)]


def test_the_page_is_what_the_script_makes(reference):
    assert reference.PAGE.read_text(encoding="utf-8") == reference.page(), "run python scripts/config_reference.py"


def test_check_says_when_the_page_is_stale(reference, tmp_path, monkeypatch, capsys):
    page = tmp_path / "configuration.md"
    monkeypatch.setattr(reference, "PAGE", page)
    monkeypatch.setattr(sys, "argv", ["config_reference.py", "--check"])
    assert reference.main() == 1 and not page.exists()
    monkeypatch.setattr(sys, "argv", ["config_reference.py"])
    assert reference.main() == 0
    monkeypatch.setattr(sys, "argv", ["config_reference.py", "--check"])
    assert reference.main() == 0
    page.write_text(page.read_text(encoding="utf-8").replace("| `8` |", "| `4` |"), encoding="utf-8")
    assert reference.main() == 1
    assert "run python scripts/config_reference.py" in capsys.readouterr().err


def test_the_script_runs_by_itself():
    assert subprocess.run([sys.executable, str(SCRIPT), "--check"]).returncode == 0


def test_every_field_is_described_and_stands_on_the_page_once(reference):
    described = reference.descriptions()
    assert list(described) == NAMES  # also in the same order
    assert all(len(text) > 20 and text.endswith((".", ")")) for text in described.values())
    named = [name for names in reference.GROUPS.values() for name in names]
    assert sorted(named) == sorted(NAMES)


@pytest.mark.parametrize("name", NAMES)
def test_limits_are_those_of_the_checks(reference, name):
    limits = reference.LIMITS[name]
    assert limits.good and limits.bad
    for value in limits.good:
        assert getattr(Config(**{name: value}), name) == value
    for value in limits.bad:
        with pytest.raises(CFlowError, match=name):
            Config(**{name: value})


@pytest.mark.parametrize("file", CONFIGS, ids=lambda file: "/".join(file.parts[-2:]))
def test_keys_are_those_that_yaml_reads(reference, file):
    found = {key.name: key.value for key in reference.keys(file)}
    expected = dict(plain_keys(yaml.safe_load(file.read_text(encoding="utf-8"))))
    assert list(found) == list(expected)
    for name, value in expected.items():
        assert yaml.safe_load(found[name]) == value, name


def test_every_row_of_the_page_has_a_meaning(reference):
    lines = reference.page().split("\n")
    rows = [line for line in lines if line.startswith("| `")]
    assert len(rows) > 100
    for row in rows:
        cells = re.split(r"(?<!\\)\|", row)[1:-1]
        assert len(cells) in (3, 4, 5), row
        meaning = cells[1] if len(cells) == 4 else cells[-1]  # of an experiment the second
        assert len(meaning.strip()) > 5, row
