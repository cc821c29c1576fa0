"""What is handed out: the wheel is built from the source distribution, holds what it should, and runs on its own."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

pytest.importorskip("build.__main__", reason="the extra dev is not installed")
pytest.importorskip("setuptools", reason="builds the wheel")

ROOT = Path(__file__).resolve().parents[1]
MADE = ("__pycache__", "*.py[cod]", "*.egg-info", ".*", "outputs", "multirun", "build", "dist")


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Built from the source distribution. The checkout is not written to."""
    source, target = tmp_path_factory.mktemp("source") / "checkout", tmp_path_factory.mktemp("dist")
    shutil.copytree(ROOT, source, ignore=shutil.ignore_patterns(*MADE))
    command = [sys.executable, "-m", "build", "--no-isolation", "--outdir", str(target), str(source)]
    done = subprocess.run(command, capture_output=True, text=True, cwd=target)
    printed = done.stdout + done.stderr
    assert done.returncode == 0 and "deprecated" not in printed, printed
    (built,) = target.glob("*.whl")
    return built


def test_every_folder_with_code_is_a_package_of_the_wheel() -> None:
    named = re.findall(r'"(cflow_torch[.\w]*)",', (ROOT / "pyproject.toml").read_text().partition("\npackages")[2])
    folders = {file.parent.relative_to(ROOT) for file in ROOT.glob("cflow_torch/**/*.py")}
    folders |= {Path("cflow_torch") / file.parent.relative_to(ROOT) for file in ROOT.glob("configs/**/*.py")}
    assert named == sorted(".".join(folder.parts) for folder in folders)


@pytest.mark.slow
def test_the_wheel_holds_the_package_and_nothing_else(wheel: Path) -> None:
    """No oracle, no benchmark's targets, no test, no script."""
    patterns = ("cflow_torch/**/*.py", "configs/**/*.py", "configs/**/*.yaml")
    kept = [file for pattern in patterns for file in ROOT.glob(pattern)]
    expected = {re.sub("^configs/", "cflow_torch/configs/", file.relative_to(ROOT).as_posix()) for file in kept}
    files = ("py.typed", "verified/confidence.json", "viz/page.html")
    with zipfile.ZipFile(wheel) as archive:
        names = {name for name in archive.namelist() if ".dist-info/" not in name}
    assert names == expected | {f"cflow_torch/{file}" for file in files}
    assert wheel.name.endswith("-py3-none-any.whl")
    assert wheel.stat().st_size < 2**20, "under 1 MiB: no picture, no data"


@pytest.mark.slow
def test_the_wheel_runs_alone(wheel: Path, tmp_path: Path) -> None:
    """Outside the checkout: a flow. torch and the like come from the environment of the tests."""
    installed, home = tmp_path / "installed", tmp_path / "elsewhere"
    home.mkdir()
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(installed)
    code = "import cflow_torch, cflow_torch.configs as c, cflow_torch.cli.main as m; m.main(); "
    code += "print(cflow_torch.__file__, *c.__path__)"
    command = [sys.executable, "-c", code, "flow", "model=paper", "data.num_sweeps=2", "engine.workers=1"]
    environment = {**os.environ, "PYTHONPATH": str(installed)}
    done = subprocess.run(command, capture_output=True, text=True, cwd=home, env=environment)
    assert done.returncode == 0, done.stdout + done.stderr
    assert done.stdout.splitlines()[-1].count(str(installed)) == 2, "not the checkout"
    assert len(list(home.glob("outputs/flow/*/*.feather"))) == 1
