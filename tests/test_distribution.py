"""What is handed out: wheel and source distribution are built, hold what they should, and the wheel runs on its own."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import tarfile
import zipfile
from pathlib import Path
from typing import Set, Tuple

import pytest

pytest.importorskip("build.__main__", reason="the extra dev is not installed")
metadata = pytest.importorskip("packaging.metadata", reason="needs packaging 23.1")

ROOT = Path(__file__).resolve().parents[1]
TOP_LEVEL = ("CHANGELOG.md", "CITATION.cff", "CONTRIBUTING.md", "LICENSE", "MANIFEST.in", "README.md")
TOP_LEVEL = (*TOP_LEVEL, "SECURITY.md", "hubconf.py", "pyproject.toml")
FOLDERS = ("cflow_torch", "configs", "docs", "notebooks", "scripts", "tests")
MADE = ("__pycache__", "*.py[cod]", "*.egg-info", ".*", "outputs", "multirun")


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> Tuple[Path, Path]:
    """Wheel and source distribution; the wheel is built from the latter. The checkout is not written to."""
    source, target = tmp_path_factory.mktemp("source"), tmp_path_factory.mktemp("dist")
    for name in TOP_LEVEL:
        shutil.copy2(ROOT / name, source / name)
    for name in FOLDERS:
        if (ROOT / name).is_dir():
            shutil.copytree(ROOT / name, source / name, ignore=shutil.ignore_patterns(*MADE))
    command = [sys.executable, "-m", "build", "--no-isolation", "--outdir", str(target), str(source)]
    done = subprocess.run(command, capture_output=True, text=True, cwd=target)
    assert done.returncode == 0, done.stdout + done.stderr
    (wheel,), (sdist,) = target.glob("*.whl"), target.glob("*.tar.gz")
    return wheel, sdist


@pytest.fixture(scope="module")
def installed(built: Tuple[Path, Path], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the installed wheel and nothing else; torch and the like come from the environment of the tests."""
    folder = tmp_path_factory.mktemp("installed")
    pip = [sys.executable, "-m", "pip", "install", "--quiet", "--no-index", "--no-deps", "--no-compile"]
    subprocess.run([*pip, "--target", str(folder), str(built[0])], check=True, capture_output=True, cwd=folder)
    return folder


def names_in(wheel: Path) -> Set[str]:
    with zipfile.ZipFile(wheel) as archive:
        return {name for name in archive.namelist() if ".dist-info/" not in name}


def test_the_wheel_holds_the_package_and_nothing_else(built: Tuple[Path, Path]) -> None:
    wheel, _ = built
    expected = {str(file.relative_to(ROOT)) for file in (ROOT / "cflow_torch").rglob("*.py")}
    expected |= {f"cflow_torch/{file.relative_to(ROOT)}" for file in (ROOT / "configs").rglob("*.py")}
    expected |= {f"cflow_torch/{file.relative_to(ROOT)}" for file in (ROOT / "configs").rglob("*.yaml")}
    expected |= {"cflow_torch/py.typed", "cflow_torch/verified/confidence.json"}
    assert names_in(wheel) == expected
    assert wheel.name.endswith("-py3-none-any.whl")
    assert wheel.stat().st_size < 2**20, "under 1 MiB: no picture, no data"


def test_the_wheel_says_what_it_is(built: Tuple[Path, Path]) -> None:
    """What `twine check` looks at, and that the README is the description, as Markdown."""
    with zipfile.ZipFile(built[0]) as archive:
        names = {Path(name).name: name for name in archive.namelist() if ".dist-info/" in name}
        told = metadata.Metadata.from_email(archive.read(names["METADATA"]), validate=True)
        assert archive.read(names["LICENSE"]) == (ROOT / "LICENSE").read_bytes()
        assert b"cflow = cflow_torch.cli.main:main" in archive.read(names["entry_points.txt"])
    assert told.name == "cflow_torch" and str(told.requires_python) == ">=3.8"
    assert told.description_content_type == "text/markdown"
    assert told.description.strip() == (ROOT / "README.md").read_text(encoding="utf-8").strip()
    assert {"viz", "hdf5", "ray", "test", "dev"} <= set(told.provides_extra)
    core = {requirement.name for requirement in told.requires_dist if requirement.marker is None}
    assert core == {"torch", "numpy", "pyarrow", "kornia", "hydra-core", "tqdm"}


def test_the_source_distribution_is_all_that_a_packager_needs(built: Tuple[Path, Path]) -> None:
    with tarfile.open(built[1]) as archive:
        names = {name.partition("/")[2] for name in archive.getnames() if "/" in name}
    for folder in FOLDERS:
        for file in (ROOT / folder).rglob("*"):
            kept = file.suffix in (".py", ".yaml", ".md", ".sh", ".txt", ".png", ".ipynb")
            if file.is_file() and kept and not {"__pycache__", ".ipynb_checkpoints"} & set(file.parts):
                assert str(file.relative_to(ROOT)) in names, "left out by MANIFEST.in"
    assert set(TOP_LEVEL) <= names
    assert not [name for name in names if re.search(r"\.py[co]$|__pycache__|^outputs|^multirun|\.git", name)]
    links = re.findall(r"\]\((?!https?:|#)([^)#]+)", (ROOT / "README.md").read_text(encoding="utf-8"))
    assert links and set(links) <= {name.rstrip("/") for name in names}, "what README.md refers to is there"


def test_the_wheel_runs_alone(installed: Path, tmp_path: Path) -> None:
    """Outside the checkout: help, versions, and a picture of the demo."""
    home = tmp_path / "elsewhere"
    home.mkdir()

    def run(*arguments: str) -> str:
        environment = {**os.environ, "PYTHONPATH": str(installed), "OMP_NUM_THREADS": "1"}
        done = subprocess.run([sys.executable, *arguments], capture_output=True, text=True, cwd=home, env=environment)
        assert done.returncode == 0, done.stdout + done.stderr
        return done.stdout

    where = run("-c", "import cflow_torch, cflow_torch.configs as c; print(cflow_torch.__file__, *c.__path__)")
    assert all(Path(path).is_relative_to(installed) for path in where.split()), where
    command = str(installed / "bin" / "cflow")
    assert "usage: cflow" in run(command, "--help")
    assert "torch " in run(command, "info")
    run(command, "demo", "model=paper", "data.num_sweeps=2", "pair=0")
    assert (home / "outputs" / "demo" / "flow.png").read_bytes().startswith(b"\x89PNG")
