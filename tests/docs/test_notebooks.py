"""The notebooks: committed bare, and every cell runs in a kernel of its own and leaves nothing behind."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest

nbformat = pytest.importorskip("nbformat", reason="notebooks need the extra test: nbclient, ipykernel")
nbclient = pytest.importorskip("nbclient")
pytest.importorskip("ipykernel")
pytest.importorskip("matplotlib")

FOLDER = Path(__file__).parents[2] / "notebooks"
NAMES = (
    "01_quick_start",
    "02_bev_and_clusters",
    "03_correlation",
    "04_key_points",
    "05_evaluation",
    "06_own_sensor",
    "07_opensceneflow",
)
SECONDS = 120  # a cell that takes longer hangs
LARGEST = 100_000  # bytes
MACHINE_PATHS = re.compile(r"/home/|/root/|/Users/|/work/|/tmp/|[A-Z]:\\\\")


def read(name: str) -> Any:
    return nbformat.read(FOLDER / f"{name}.ipynb", as_version=nbformat.NO_CONVERT)


def test_these_are_all() -> None:
    assert sorted(path.stem for path in FOLDER.glob("*.ipynb")) == sorted(NAMES)


@pytest.mark.parametrize("name", NAMES)
def test_is_committed_bare(name: str) -> None:
    """No output that could go stale, nothing of the machine it was written on."""
    notebook = read(name)
    nbformat.validate(notebook)
    assert notebook.nbformat == 4
    assert set(notebook.metadata) == {"kernelspec", "language_info"}
    assert notebook.metadata.kernelspec.name == "python3"
    for number, cell in enumerate(notebook.cells):
        if cell.cell_type == "code":
            assert (cell.outputs, cell.execution_count) == ([], None), f"cell {number}: clear all outputs"
        assert not cell.metadata, f"cell {number} has metadata {dict(cell.metadata)}"
        assert not MACHINE_PATHS.search(cell.source), f"cell {number} names a folder of one machine"
    assert (FOLDER / f"{name}.ipynb").stat().st_size < LARGEST


def test_the_page_lists_all() -> None:
    linked = re.findall(r"\]\((.+?)\.ipynb\)", (FOLDER / "README.md").read_text(encoding="utf-8"))
    assert linked == list(NAMES)


@pytest.mark.parametrize("name", NAMES)
def test_runs(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for variable in ("TMPDIR", "CFLOW_CACHE", "IPYTHONDIR", "JUPYTER_DATA_DIR", "JUPYTER_CONFIG_DIR"):
        (tmp_path / variable).mkdir()
        monkeypatch.setenv(variable, str(tmp_path / variable))
    monkeypatch.delenv("JUPYTER_PATH", raising=False)  # kernels of other environments
    here = tmp_path / "here"
    here.mkdir()
    notebook = read(name)
    client = nbclient.NotebookClient(
        notebook, timeout=SECONDS, kernel_name="python3", resources={"metadata": {"path": str(here)}}
    )
    try:
        client.execute()
    except nbclient.exceptions.CellExecutionError as error:  # its text is the cell and the traceback
        pytest.fail(f"{name}:\n" + re.sub(r"\x1b\[[0-9;]*m", "", str(error)), pytrace=False)
    assert [path.name for path in here.iterdir()] == [], "it writes beside the notebook"
    outputs = [output for cell in notebook.cells for output in cell.get("outputs", [])]
    said = "".join(output.text for output in outputs if output.output_type == "stream" and output.name == "stderr")
    assert said == "", "it warns"
    assert any("image/png" in output.get("data", {}) for output in outputs), "it shows no picture"
