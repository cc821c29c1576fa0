"""Real worker processes that die or hang: no other frame is lost, and the run ends and lists what it could not do."""

from __future__ import annotations

import os
import signal
import sys
from pathlib import Path
from typing import Any, Callable

import numpy as np
import pytest
from small_fleet import PAIRS, TWO, run, tree

from cflow_torch.data.av2 import AV2Log
from cflow_torch.fleet import run as running
from cflow_torch.fleet import work

DEADLY = "CFLOW_TEST_DEADLY"  # folder of files <log>.<time stamp> with the name of a cause and how often it occurs
REAL_MAKE = running.make_worker
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
    run_units, read = REAL_MAKE(*arguments), work.window

    def deadly_read(log: Any, index: int, *num_sweeps: int) -> Any:
        file = Path(os.environ[DEADLY]) / f"{log.log_id}.{log.timestamps[index]}"
        if file.exists():
            cause, count = file.read_text().split(":")
            if int(count) > 0:
                file.write_text(f"{cause}:{int(count) - 1}")
                CAUSES[cause]()
        return read(log, index, *num_sweeps)

    work.window = deadly_read
    return run_units


@pytest.mark.slow
@pytest.mark.parametrize("once, always", [(("SIGKILL", "hang"), "SIGSEGV"), (("SystemExit",), "memory")])
def test_dying_workers_lose_only_the_frame_that_always_kills(
    once: tuple[str, ...],
    always: str,
    fleet: Path,
    single: dict[str, bytes],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv(DEADLY, str(tmp_path))
    monkeypatch.setattr(running, "make_worker", make_deadly_worker)
    logs = [AV2Log(folder) for folder in sorted(fleet.iterdir())]
    for log, cause in zip(logs, once):
        (tmp_path / f"{log.log_id}.{log.timestamps[2]}").write_text(f"{cause}:1")
    (tmp_path / f"{logs[2].log_id}.{logs[2].timestamps[1]}").write_text(f"{always}:99")
    report = run(fleet, tmp_path / "out", TWO, timeout=20, memory=LIMIT)
    ((name, message),) = report["failures"]
    assert name == f"{logs[2].log_id}/{logs[2].timestamps[1]}"
    assert ("MemoryError" if always == "memory" else "2 workers died on it") in message
    assert (report["frames"]["computed"], report["exit_status"]) == (PAIRS - 1, 1)
    assert tree(tmp_path / "out") == {file: c for file, c in single.items() if file != f"{name}.feather"}
