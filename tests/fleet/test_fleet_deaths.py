"""Real worker processes that die in the main ways: no other log is lost, the run ends and says what it could not do."""

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
from cflow_torch.fleet import local, work

DEADLY = "CFLOW_TEST_DEADLY"  # folder of files log.time stamp, each of which holds a name of `WAYS` and how often
REAL_MAKE = local._make_worker
LIMIT = 12e9  # bytes, of a worker's address space

WAYS: dict[str, Callable[[], Any]] = {
    "SIGKILL": lambda: os.kill(os.getpid(), signal.SIGKILL),
    "SIGSEGV": lambda: os.kill(os.getpid(), signal.SIGSEGV),
    "SystemExit": lambda: sys.exit("out"),
    "hang": lambda: os.kill(os.getpid(), signal.SIGSTOP),
    "memory": lambda: np.ones(int(LIMIT), np.uint8),
}


def deadly_make(*arguments: Any) -> Any:
    """A worker process that dies when it reads a frame of `DEADLY`."""
    step = REAL_MAKE(*arguments)
    read = work.window

    def deadly_read(log: Any, index: int, *num_sweeps: int) -> Any:
        file = Path(os.environ[DEADLY]) / f"{log.log_id}.{log.timestamps[index]}"
        if file.exists():
            way, count = file.read_text().split(":")
            if int(count) > 0:
                file.write_text(f"{way}:{int(count) - 1}")
                WAYS[way]()
        return read(log, index, *num_sweeps)

    work.window = deadly_read
    return step


@pytest.fixture
def deadly(fleet: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[int, int, str, int], str]:
    """Makes a frame (number of a log, of a sweep) deadly in a way, so many times; gives its name."""
    folder = tmp_path / "deadly"
    folder.mkdir()
    monkeypatch.setenv(DEADLY, str(folder))
    monkeypatch.setattr(local, "_make_worker", deadly_make)

    def mark(number: int, index: int, way: str, count: int) -> str:
        log = AV2Log(sorted(fleet.iterdir())[number])
        (folder / f"{log.log_id}.{log.timestamps[index]}").write_text(f"{way}:{count}")
        return f"{log.log_id}/{log.timestamps[index]}"

    return mark


@pytest.mark.slow
def test_workers_that_die_once_lose_nothing_and_one_without_memory_its_frame(
    fleet: Path, single: dict[str, bytes], tmp_path: Path, deadly: Any
) -> None:
    deadly(0, 2, "SIGKILL", 1)
    deadly(1, 4, "hang", 1)
    greedy = deadly(2, 1, "memory", 99)
    report = run(fleet, tmp_path / "out", TWO, timeout=20, memory=LIMIT)
    ((name, message),) = report["failures"]
    assert name == greedy and "MemoryError" in message
    assert (report["frames"]["computed"], report["exit_status"]) == (PAIRS - 1, 1)
    assert tree(tmp_path / "out") == {name: c for name, c in single.items() if name != f"{greedy}.feather"}


@pytest.mark.slow
@pytest.mark.parametrize("way", [way for way in WAYS if way not in ("hang", "memory")])
def test_a_frame_that_always_kills_takes_no_other_with_it(
    fleet: Path, single: dict[str, bytes], tmp_path: Path, deadly: Any, way: str
) -> None:
    name = deadly(1, 3, way, 1000)
    report = run(fleet, tmp_path / "out", TWO)
    ((failed, message),) = report["failures"]
    assert failed == name and "2 workers died on it" in message
    assert report["frames"]["computed"] == PAIRS - 1
    assert tree(tmp_path / "out") == {file: c for file, c in single.items() if file != f"{name}.feather"}
