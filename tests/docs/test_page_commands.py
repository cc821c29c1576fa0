"""The commands and Python blocks of README, the quick start and the page on harnesses run.

We skip those that need data, the network or another repository. Of `cflow` commands with data we compose the settings.
"""

from __future__ import annotations

import re
import runpy
import shlex
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command_line import cflow

from cflow_torch.simulator import make_drive

ROOT = Path(__file__).resolve().parents[2]
PAGES = ("README.md", "docs/quick_start.md", "docs/harness.md")
BLOCK = re.compile(r"^```(bash|python)\n(.*?)^```", re.M | re.S)
DATA = re.compile(r"/data|/path|experiment=")
FOREIGN = re.compile(r"# \w+\.py\n|from bucketed_scene_flow_eval")  # Python for other repositories begins with this


def parts(page: str) -> list[tuple[str, Any]]:
    """Return the parts of a page in order: ("python", text), ("cflow", words), or ("module", words) of python -m."""
    found: list[tuple[str, Any]] = []
    for language, text in BLOCK.findall((ROOT / page).read_text(encoding="utf-8")):
        if language == "python":
            found.append((language, text))
            continue
        for line in text.replace("\\\n", " ").splitlines():
            words = shlex.split(line, comments=True)
            found += [("cflow", words[1:])] if words[:1] == ["cflow"] else []
            found += [("module", words[2:])] if words[:2] == ["python", "-m"] else []
    return found


COMMANDS = {" ".join(words) for page in PAGES for kind, words in parts(page) if kind == "cflow"}


def run(kind: str, part: Any, names: dict[str, Any]) -> None:
    """Run one part of a page in this process, unless it is skipped."""
    if kind == "python":
        if not FOREIGN.match(part):
            exec(compile(part, "page", "exec"), names)
    elif kind == "module":
        sys.argv = part
        runpy.run_module(part[0], run_name="__main__")
    elif not DATA.search(" ".join(part)):
        assert cflow(*part) == 0, part


@pytest.fixture
def names(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    """Return the arrays that README uses, in an empty working folder."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", list(sys.argv))
    drive = make_drive(seed=1, num_sweeps=2, profile="demo")
    motion = np.linalg.inv(drive.poses[1]) @ drive.poses[0]
    return {"pc0": drive.sweep(0).points, "pc1": drive.sweep(1).points, "T_ego1_ego0": motion}


@pytest.mark.parametrize("command", sorted(filter(DATA.search, COMMANDS)))
def test_commands_with_data_have_valid_settings(command: str, names: dict[str, Any]) -> None:
    assert cflow(*command.replace(" -m ", " ").split(), "--cfg", "job") == 0


@pytest.mark.parametrize("page", PAGES[:2])
def test_python_runs(page: str, names: dict[str, Any]) -> None:
    for part in (part for part in parts(page) if part[0] == "python"):
        run(*part, names)


@pytest.mark.slow
@pytest.mark.parametrize("page", PAGES)
def test_commands_and_python_run_in_the_order_of_the_page(page: str, names: dict[str, Any]) -> None:
    for part in parts(page):
        run(*part, names)
