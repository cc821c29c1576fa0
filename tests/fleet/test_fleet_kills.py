"""A run that is killed again and again and resumed each time ends with the bytes of one that was left alone."""

from __future__ import annotations

import os
import random
import re
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Dict, List

import pytest

from cflow_torch.simulator import make_drive
from cflow_torch.simulator.writers.av2 import write_av2_log

pytestmark = [pytest.mark.slow, pytest.mark.skipif(not Path("/proc/self/task").is_dir(), reason="needs Linux's /proc")]

NUM_LOGS, PAIRS = 5, 40  # 200 windows
KILLS = 20
FRAMES_BETWEEN = (0, 4)  # a run is killed once so many more frames are there
HOW = ("parent SIGKILL", "all SIGKILL", "worker SIGKILL", "parent SIGTERM", "parent SIGINT")
AT_WORK = {-signal.SIGKILL, 128 + signal.SIGTERM, 128 + signal.SIGINT}
AT_START = {*AT_WORK, -signal.SIGTERM}  # before the command catches signals


@pytest.fixture(scope="module")
def fleet(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Five simulated logs with 40 pairs each."""
    root = tmp_path_factory.mktemp("fleet")
    for seed in range(NUM_LOGS):
        write_av2_log(make_drive(seed=seed, num_sweeps=PAIRS + 1, profile="demo"), root)
    return root


def start(root: Path, output: Path, *more: str) -> subprocess.Popen:
    """`cflow flow` in a process group of its own."""
    arguments = ["data=av2", f"data.root={root}", f"output={output}", "model=paper", "data.check=false", *more]
    command = [sys.executable, "-m", "cflow_torch.cli.main", "flow", *arguments]
    environ = {**os.environ, "OMP_NUM_THREADS": "1"}
    return subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, start_new_session=True, env=environ
    )


def finish(process: subprocess.Popen) -> str:
    """What it printed; it must have succeeded."""
    printed, _ = process.communicate(timeout=600)
    assert process.returncode == 0, printed
    return printed


def tree(folder: Path) -> Dict[str, bytes]:
    """Every file, hidden ones too, but the reports, which tell times."""
    files = [file for file in folder.rglob("*") if file.is_file() and "reports" not in file.parts]
    return {str(file.relative_to(folder)): file.read_bytes() for file in files}


def frames(folder: Path) -> int:
    return sum(1 for _ in folder.glob("*/*.feather"))


def workers(process: subprocess.Popen) -> List[int]:
    """Worker processes of a run."""
    children = Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split()
    return [int(child) for child in children if b"spawn_main" in Path(f"/proc/{child}/cmdline").read_bytes()]


@pytest.fixture(scope="module")
def single(fleet: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The flow of the fleet by one worker, one window at a time, never disturbed."""
    output = tmp_path_factory.mktemp("single")
    finish(start(fleet, output, "engine.workers=1", "engine.batch=1"))
    assert frames(output) == NUM_LOGS * PAIRS
    return output


def test_shards_together_are_the_single_run(fleet: Path, single: Path, tmp_path: Path) -> None:
    for process in [start(fleet, tmp_path, f"shard.index={index}", "shard.count=3") for index in range(3)]:
        finish(process)
    assert tree(tmp_path) == tree(single)


def test_workers_together_are_the_single_run(fleet: Path, single: Path, tmp_path: Path) -> None:
    finish(start(fleet, tmp_path, "engine.workers=2"))
    assert tree(tmp_path) == tree(single)


def test_ray_s_workers_together_are_the_single_run(fleet: Path, single: Path, tmp_path: Path) -> None:
    pytest.importorskip("ray", reason="needs the extra ray")
    finish(start(fleet, tmp_path, "engine=ray", "engine.workers=2"))
    assert tree(tmp_path) == tree(single)


def test_kills_lose_nothing_and_leave_nothing(fleet: Path, single: Path, tmp_path: Path) -> None:
    chance = random.Random(9)
    seen: List[str] = []
    for number in range(KILLS):
        how = HOW[number % len(HOW)]
        one = number % 4 == 0 and not how.startswith("worker")
        process = start(fleet, tmp_path, f"engine.workers={1 if one else 2}", "engine.batch=2")
        before, wanted = frames(tmp_path), chance.randint(*FRAMES_BETWEEN)
        wanted = max(wanted, how.endswith("SIGINT"))  # while Python imports, Ctrl-C is Python's business
        while frames(tmp_path) < before + wanted and process.poll() is None:
            time.sleep(0.002)
        time.sleep(chance.random() * 0.05)
        who, name = how.split()
        if who == "worker":
            while not workers(process) and process.poll() is None:
                time.sleep(0.01)
            os.kill(chance.choice(workers(process)), signal.Signals[name])
            time.sleep(chance.random() * 0.1)
            os.kill(process.pid, signal.SIGTERM)  # it goes on with another worker: end it as well
        else:
            (os.killpg if who == "all" else os.kill)(process.pid, signal.Signals[name])
        printed, _ = process.communicate(timeout=60)
        seen.append(f"{how} at {frames(tmp_path)} frames: status {process.returncode}")
        assert process.returncode in (AT_WORK if wanted else AT_START), f"{seen}\n{printed}"
        whole = {name: content for name, content in tree(tmp_path).items() if not Path(name).name.startswith(".")}
        assert whole == {name: content for name, content in tree(single).items() if name in whole}, seen
    time.sleep(1)  # workers whose parent was killed end at their next message
    left = NUM_LOGS * PAIRS - frames(tmp_path)
    assert left > 0, f"the kills came too late to be one of a run at work: {seen}"
    printed = finish(start(fleet, tmp_path))
    assert re.search(rf"computed +{left}\n", printed), printed
    assert tree(tmp_path) == tree(single), "nothing is lost, nothing is left behind"
    assert not list(tmp_path.rglob(".*"))
    print("\n".join(seen))
