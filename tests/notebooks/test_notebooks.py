"""The notebooks: stored without outputs, and every cell runs and leaves nothing behind."""

from __future__ import annotations

import json
import re
import tempfile
from pathlib import Path
from typing import Any

import pytest

FOLDER = Path(__file__).parents[2] / "notebooks"
NAMES = sorted(file.stem for file in FOLDER.glob("*.ipynb"))
SLOW = ("05_evaluation", "06_own_sensor")  # call the command line, which starts anew each time
MACHINE_PATHS = re.compile(r"/home/|/root/|/Users/|/work/|/tmp/|[A-Z]:\\\\")


def cells(name: str) -> list[dict[str, Any]]:
    """Its cells, their source as one text."""
    notebook = json.loads((FOLDER / f"{name}.ipynb").read_text(encoding="utf-8"))
    return [{**cell, "source": "".join(cell["source"])} for cell in notebook["cells"]]


@pytest.mark.parametrize("name", NAMES)
def test_is_stored_bare(name: str) -> None:
    """No output that could go stale, nothing of the machine it was written on."""
    for number, cell in enumerate(cells(name)):
        assert not cell.get("outputs") and cell.get("execution_count") is None, f"cell {number}: clear all outputs"
        assert not cell["metadata"], f"cell {number} has metadata {cell['metadata']}"
        assert not MACHINE_PATHS.search(cell["source"]), f"cell {number} names a folder of one machine"


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=pytest.mark.slow) if name in SLOW else name for name in NAMES]
)
def test_runs(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture) -> None:
    plt = pytest.importorskip("matplotlib.pyplot")
    plt.switch_backend("agg")
    here = tmp_path / "here"
    here.mkdir()
    monkeypatch.chdir(here)
    monkeypatch.setenv("CFLOW_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    variables: dict[str, Any] = {"__name__": "__main__"}
    for number, cell in enumerate(cells(name)):
        if cell["cell_type"] == "code":
            source = cell["source"].replace("%matplotlib inline\n", "")
            exec(compile(source, f"{name}, cell {number}", "exec"), variables)
    plt.close("all")
    assert not list(here.iterdir()), "it writes beside the notebook"
    assert not capfd.readouterr().err, "it warns"
