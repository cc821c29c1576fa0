"""The commands and Python blocks of README, the quick start and the page on harnesses run.

Python that reads /data/my_drive or /data/drive.bag gets a simulated one. We skip commands that need data, the network
or another repository. Of `cflow` commands with data we compose the settings.
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
from bag_writer import BagWriter
from command_line import cflow

from cflow_torch.data.arrays import write_array_log
from cflow_torch.data.arrays.cloud_file import read_cloud
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
            exec(compile(part.replace('"/data/', '"data/'), "page", "exec"), names)
    elif kind == "module":
        sys.argv = part
        runpy.run_module(part[0], run_name="__main__")
    elif not DATA.search(" ".join(part)):
        assert cflow(*part) == 0, part


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return an empty working folder."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", list(sys.argv))
    return tmp_path


@pytest.fixture
def names(folder: Path) -> dict[str, Any]:
    """Return the arrays that README uses, and write the data that the quick start reads."""
    drive = make_drive(seed=1, num_sweeps=5, profile="demo")
    write_array_log(drive, "data").rename("data/my_drive")
    writer = BagWriter(folder / "data", "ros1")
    for sweep in drive:
        stamp, cloud = sweep.timestamp_ns, writer.cloud(sweep.timestamp_ns, sweep.points, None)
        writer.write("/tf", stamp, "tf2_msgs/msg/TFMessage", [writer.transform(stamp, "odom", "velodyne", sweep.pose)])
        writer.write("/points", stamp, "sensor_msgs/msg/PointCloud2", *cloud)
    writer.bag.close()
    motion = np.linalg.inv(drive.poses[1]) @ drive.poses[0]
    return {"pc0": drive.sweep(0).points, "pc1": drive.sweep(1).points, "T_ego1_ego0": motion}


@pytest.mark.parametrize("command", sorted(filter(DATA.search, COMMANDS)))
def test_commands_with_data_have_valid_settings(command: str, folder: Path) -> None:
    assert cflow(*command.replace(" -m ", " ").split(), "--cfg", "job") == 0


def test_python_of_the_readme_runs(names: dict[str, Any]) -> None:
    for part in (part for part in parts(PAGES[0]) if part[0] == "python"):
        run(*part, names)


def test_scripts_of_the_quick_start_run(names: dict[str, Any], capfd: pytest.CaptureFixture) -> None:
    arrays, tracks, bag, many = (part for part in parts(PAGES[1]) if part[0] == "python")
    run(*arrays, names)
    assert re.search(r"object \d+ at \[.*\] m: \d+\.\d m/s", capfd.readouterr().out) and Path("flow.png").is_file()
    run(*many, names)
    run(*tracks, {})
    assert re.search(r"object \d+: .* m/s", capfd.readouterr().out)
    run(*bag, {})
    assert 0 < len(read_cloud("clean_map.ply")) < len(read_cloud("map.ply"))


@pytest.mark.slow
@pytest.mark.parametrize("page", PAGES)
def test_commands_and_python_run_in_the_order_of_the_page(page: str, names: dict[str, Any]) -> None:
    for part in parts(page):
        run(*part, names)
