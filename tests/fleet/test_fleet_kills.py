"""`cflow flow` in a process of its own, killed and resumed: it ends with the bytes of a run that was left alone."""

from __future__ import annotations

import os
import random
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Callable

import pytest
from small_fleet import COMMAND, command, frames, tree

pytestmark = pytest.mark.skipif(not Path("/proc/self/task").is_dir(), reason="needs Linux's /proc")

COPIES = 40  # of a log of five pairs: a run of some seconds
KILLS = 12
FRAMES_BETWEEN = (0, 5)  # a run is killed once so many more frames are there
HOW = ("parent SIGKILL", "all SIGKILL", "worker SIGKILL", "parent SIGTERM", "all SIGTERM", "all SIGINT")


@pytest.fixture(scope="module")
def many(fleet: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One log under many names."""
    root = tmp_path_factory.mktemp("many")
    for number in range(COPIES):
        shutil.copytree(sorted(fleet.iterdir())[1], root / f"log-{number:02}", copy_function=os.link)
    return root


@pytest.fixture(scope="module")
def expected(fleet: Path, single: dict[str, bytes]) -> dict[str, bytes]:
    """Flow files of a run on `many` that nothing disturbed."""
    of_log = {Path(name).name: c for name, c in single.items() if name.startswith(sorted(fleet.iterdir())[1].name)}
    names = [name for name in of_log if name.endswith(".feather")]
    return {f"log-{number:02}/{name}": of_log[name] for number in range(COPIES) for name in names}


def start(root: Path, output: Path, *more: str) -> subprocess.Popen:
    """`cflow flow` in a process group of its own."""
    arguments = [*COMMAND, f"data.root={root}", f"output={output}", "engine.batch=2", *more]
    return subprocess.Popen(
        [sys.executable, "-m", "cflow_torch.cli.main", *arguments],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        start_new_session=True,
        env={**os.environ, "OMP_NUM_THREADS": "1"},
    )


def wait_for(condition: Callable[[], bool], process: subprocess.Popen | None = None) -> None:
    """Wait until something is so, or the process has ended, or for two minutes."""
    deadline = time.monotonic() + 120
    while not condition() and (process is None or process.poll() is None) and time.monotonic() < deadline:
        time.sleep(0.01)


def workers(process: subprocess.Popen) -> list[int]:
    """Worker processes of a run."""
    children = Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split()
    return [int(child) for child in children if b"spawn_main" in Path(f"/proc/{child}/cmdline").read_bytes()]


def live(processes: list[int]) -> bool:
    """Whether any of them does."""
    return any(Path(f"/proc/{process}").exists() for process in processes)


def flow_of(output: Path) -> dict[str, bytes]:
    """All files but manifests and hidden ones."""
    return {n: content for n, content in tree(output).items() if not n.endswith("manifest.json") and "/." not in n}


def test_a_killed_run_is_resumed_and_its_workers_end(many: Path, expected: dict[str, bytes], tmp_path: Path) -> None:
    process = start(many, tmp_path, "engine.workers=2")
    wait_for(lambda: len(frames(tmp_path)) > 3, process)
    orphans = workers(process)
    process.kill()
    process.communicate(timeout=60)
    wait_for(lambda: not live(orphans))
    assert process.returncode == -signal.SIGKILL and len(orphans) == 2 and not live(orphans)
    assert 3 < len(frames(tmp_path)) < len(expected) and flow_of(tmp_path).items() <= expected.items()
    assert command(f"data.root={many}", f"output={tmp_path}") == 0
    assert flow_of(tmp_path) == expected, "nothing is lost"
    assert not list(tmp_path.rglob(".*")), "nothing is left behind"


@pytest.mark.slow
def test_kills_lose_nothing_and_leave_nothing(many: Path, expected: dict[str, bytes], tmp_path: Path) -> None:
    chance, seen = random.Random(9), []
    for number in range(KILLS):
        who, name = HOW[number % len(HOW)].split()
        process = start(many, tmp_path, f"engine.workers={1 if number % 4 == 0 and who != 'worker' else 2}")
        wanted = len(frames(tmp_path)) + max(chance.randint(*FRAMES_BETWEEN), name == "SIGINT")
        wait_for(lambda wanted=wanted: len(frames(tmp_path)) >= wanted, process)  # type: ignore[misc]
        time.sleep(chance.random() * 0.05)
        if who == "worker":
            wait_for(lambda process=process: bool(workers(process)), process)  # type: ignore[misc]
            os.kill(chance.choice(workers(process)), signal.SIGKILL)
            time.sleep(chance.random() * 0.1)
            process.terminate()  # it continues with another worker: end it as well
        elif process.poll() is None:
            (os.killpg if who == "all" else os.kill)(process.pid, signal.Signals[name])
        printed, _ = process.communicate(timeout=120)
        seen.append(f"{who} {name} at {len(frames(tmp_path))} frames: status {process.returncode}")
        at_start = {-signal.SIGTERM, -signal.SIGINT}  # before the command catches signals
        assert process.returncode in {0, -signal.SIGKILL, 143, 130, *at_start}, f"{seen}\n{printed}"
        assert flow_of(tmp_path).items() <= expected.items(), seen
    assert len(frames(tmp_path)) < len(expected), f"the kills came too late to be one of a run at work: {seen}"
    time.sleep(1)  # workers whose parent was killed end at their next message
    process = start(many, tmp_path)
    printed, _ = process.communicate(timeout=600)
    assert process.returncode == 0, printed
    assert flow_of(tmp_path) == expected and not list(tmp_path.rglob(".*"))
