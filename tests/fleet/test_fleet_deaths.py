"""Worker processes that die or hang, and runs that are killed: no other frame is lost, and runs can be resumed."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any, Callable

import numpy as np
import pytest
from small_fleet import COMMAND, PAIRS, TWO, command, flow_files, frames, run, tree

from cflow_torch.data.av2 import AV2Log
from cflow_torch.fleet import parallel, work

pytestmark = pytest.mark.skipif(not Path("/proc/self/task").is_dir(), reason="needs Linux's /proc")
DEADLY = "CFLOW_TEST_DEADLY"  # folder of files <log>.<time stamp> with the name of a cause and how often it occurs
REAL_MAKE = parallel.make_worker
LIMIT = 12e9  # bytes, of a worker's address space

CAUSES: dict[str, Callable[[], Any]] = {
    "SIGKILL": lambda: os.kill(os.getpid(), signal.SIGKILL),
    "SIGSEGV": lambda: os.kill(os.getpid(), signal.SIGSEGV),
    "SystemExit": lambda: sys.exit("out"),
    "hang": lambda: os.kill(os.getpid(), signal.SIGSTOP),
    "memory": lambda: np.ones(int(LIMIT), np.uint8),
}


def make_deadly_worker(*arguments: Any) -> Any:
    """A worker that dies when it reads a frame of `DEADLY`."""
    worker, read = REAL_MAKE(*arguments), work.window

    def deadly_read(log: Any, index: int, *num_sweeps: int) -> Any:
        file = Path(os.environ[DEADLY]) / f"{log.log_id}.{log.timestamps[index]}"
        if file.exists():
            cause, count = file.read_text().split(":")
            if int(count) > 0:
                file.write_text(f"{cause}:{int(count) - 1}")
                CAUSES[cause]()
        return read(log, index, *num_sweeps)

    work.window = deadly_read
    return worker


@pytest.mark.slow
@pytest.mark.parametrize("once, always", [(("SIGKILL", "hang"), "SIGSEGV"), (("SystemExit",), "memory")])
def test_dying_workers_lose_only_the_frame_that_always_kills(once, always, fleet, single, tmp_path, monkeypatch):
    monkeypatch.setenv(DEADLY, str(tmp_path))
    monkeypatch.setattr(parallel, "make_worker", make_deadly_worker)
    logs = [AV2Log(folder) for folder in sorted(fleet.iterdir())]
    for log, cause in zip(logs, once):
        (tmp_path / f"{log.log_id}.{log.timestamps[2]}").write_text(f"{cause}:1")
    (tmp_path / f"{logs[2].log_id}.{logs[2].timestamps[1]}").write_text(f"{always}:99")
    report = run(fleet, tmp_path / "out", TWO, timeout=60, memory=LIMIT)
    ((name, message),) = report["failures"]
    assert name == f"{logs[2].log_id}/{logs[2].timestamps[1]}"
    assert ("MemoryError" if always == "memory" else "its worker died again") in message
    assert (report["frames"]["computed"], report["exit_status"]) == (PAIRS - 1, 1)
    assert tree(tmp_path / "out") == {file: c for file, c in single.items() if file != f"{name}.feather"}


COPIES = 8  # of a log of five pairs: a run of some seconds


@pytest.fixture(scope="module")
def many(fleet: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("many")
    for number in range(COPIES):
        shutil.copytree(sorted(fleet.iterdir())[1], root / f"log-{number:02}", copy_function=os.link)
    return root


@pytest.fixture(scope="module")
def expected(fleet: Path, single: dict[str, bytes]) -> dict[str, bytes]:
    """Flow files of a run on `many` that nothing disturbed."""
    log = sorted(fleet.iterdir())[1].name
    names = [name for name in single if name.startswith(log) and name.endswith(".feather")]
    return {f"log-{n:02}/{Path(name).name}": single[name] for n in range(COPIES) for name in names}


def wait_for(condition: Callable[[], bool]) -> None:
    """Wait until the condition holds, at most two minutes."""
    deadline = time.monotonic() + 120
    while not condition() and time.monotonic() < deadline:
        time.sleep(0.01)


def workers(process: subprocess.Popen) -> list[int]:
    threads = Path(f"/proc/{process.pid}/task").iterdir()
    children = [child for thread in threads for child in (thread / "children").read_text().split()]
    return [int(child) for child in children if b"spawn_main" in Path(f"/proc/{child}/cmdline").read_bytes()]


@pytest.mark.parametrize(
    ("send", "name", "status"),
    [(os.kill, "SIGKILL", -9), pytest.param(os.killpg, "SIGTERM", 143, marks=pytest.mark.slow)],
)
def test_a_killed_run_is_resumed_and_its_workers_end(many, expected, tmp_path, send, name, status):
    settings = [f"data.root={many}", f"output={tmp_path}", "engine.batch=2", "engine.workers=2"]
    process = subprocess.Popen(
        [sys.executable, "-m", "cflow_torch.cli.main", *COMMAND, *settings],
        start_new_session=True,
    )
    wait_for(lambda: len(frames(tmp_path)) > 3)
    children = workers(process)
    send(process.pid, signal.Signals[name])
    assert process.wait(timeout=60) == status and len(children) == 2
    wait_for(lambda: not any(Path(f"/proc/{child}").exists() for child in children))
    assert not any(Path(f"/proc/{child}").exists() for child in children)
    assert 3 < len(frames(tmp_path)) < len(expected) and flow_files(tmp_path).items() <= expected.items()
    assert command(f"data.root={many}", f"output={tmp_path}") == 0
    assert flow_files(tmp_path) == expected, "nothing is lost"
    left = list(tmp_path.rglob(".*"))
    assert all(file.name.endswith(".tmp") for file in left)
    for file in left:
        os.utime(file, (0, 0))
    assert command(f"data.root={many}", f"output={tmp_path}") == 0
    assert not list(tmp_path.rglob(".*")), "old temporary files are removed"
