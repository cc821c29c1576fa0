"""The notebooks are stored with outputs. Every cell runs, prints what is stored, and leaves nothing behind."""

from __future__ import annotations

import json
import re
import tempfile
from pathlib import Path
from typing import Any

import pytest

FOLDER = Path(__file__).parents[2] / "notebooks"
NAMES = sorted(file.stem for file in FOLDER.glob("*.ipynb"))
SLOW = ("01_quick_start", "03_own_sensor", "04_training_labels")
MACHINE_PATHS = re.compile(r"/home/|/root/|/Users/|/work/|/tmp/|[A-Z]:\\\\")
REFRESH = "run python scripts/refresh_notebooks.py"


def cells(name: str) -> list[dict[str, Any]]:
    """Its cells, their source as one text."""
    notebook = json.loads((FOLDER / f"{name}.ipynb").read_text(encoding="utf-8"))
    return [{**cell, "source": "".join(cell["source"])} for cell in notebook["cells"]]


def printed(cell: dict[str, Any]) -> str:
    return "".join("".join(output["text"]) for output in cell["outputs"] if output["output_type"] == "stream")


def words(text: str) -> set[str]:
    """The words without numbers, which another version may change, as well as the number of rows of a table."""
    return set(re.sub(r"[-+\d.,%\s\[\]]+", " ", text).split())


@pytest.mark.parametrize("name", NAMES)
def test_is_stored_with_outputs(name: str) -> None:
    """Some cells have outputs, none has an error, a warning or anything of the machine on which it ran."""
    assert any("image/png" in output.get("data", {}) for cell in cells(name) for output in cell.get("outputs", ()))
    for number, cell in enumerate(cells(name)):
        kinds = {output.get("name", output["output_type"]) for output in cell.get("outputs", ())}
        assert not kinds & {"error", "stderr"}, f"cell {number}: {kinds}"
        assert not cell["metadata"] and cell.get("execution_count") is None, f"cell {number}: {REFRESH}"
        text = cell["source"] + (printed(cell) if cell["cell_type"] == "code" else "")
        assert not MACHINE_PATHS.search(text), f"cell {number} names a folder of one machine"
    limit = 2_000_000 if name == "01_quick_start" else 500_000  # the 3-D view contains its library
    assert (FOLDER / f"{name}.ipynb").stat().st_size < limit


def test_the_extra_notebooks_contains_the_extras_that_they_name() -> None:
    project = (FOLDER.parent / "pyproject.toml").read_text(encoding="utf-8")
    listed = re.search(r'^notebooks = \["cflow_torch\[([\w,]+)\]"', project, re.MULTILINE)[1].split(",")
    named = {extra for name in NAMES for cell in cells(name) for extra in re.findall(r"extra `(\w+)`", cell["source"])}
    assert named and named <= set(listed)


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=pytest.mark.slow) if name in SLOW else name for name in NAMES]
)
def test_runs(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture) -> None:
    plt = pytest.importorskip("matplotlib.pyplot")
    plt.switch_backend("agg")
    if any("show(pairs" in cell["source"] for cell in cells(name)):
        pytest.importorskip("k3d", reason="needs the extra html (Python 3.9)")
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
            said = capfd.readouterr()
            assert words(said.out) == words(printed(cell)), f"cell {number}: {REFRESH}"
            assert not said.err, "it warns"
    plt.close("all")
    assert not list(here.iterdir()), "it writes beside the notebook"
