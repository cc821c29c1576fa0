"""Nothing piles up over many windows of one process: memory, files, threads, objects, caches. Linux only.

`CFLOW_LEAK_WINDOWS=10000 pytest -m slow tests/long` is the long run, in which memory counts too.
"""

from __future__ import annotations

import gc
import os
import sys
import threading
import warnings
from functools import _lru_cache_wrapper
from pathlib import Path
from typing import Any, Callable, Iterator

import numpy as np
import pytest
import torch

from cflow_torch import CFlowError, estimate_flow, make_config, make_model
from cflow_torch.data.arrays import ArraysLog, write_array_log
from cflow_torch.data.catalog import find_sources, open_log
from cflow_torch.data.flow_file import read_flow, write_flow
from cflow_torch.data.log import CachedLog, FlowLabels, window
from cflow_torch.evaluation.frame import EvalFrame
from cflow_torch.evaluation.metrics import SceneFlowMetrics
from cflow_torch.types import Sweep

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not Path("/proc/self/fd").is_dir(), reason="needs Linux's /proc"),
]
WINDOWS = int(os.environ.get("CFLOW_LEAK_WINDOWS", "100"))
# What may grow from a fifth of the windows on: per window, and at all.
ALLOWED = {"files": 1, "threads": 0, "tensors": 10, "cached": 10, "objects": 0.5 * WINDOWS}
LONG = 1000  # windows from which on memory is looked at: before, the allocator moves by itself
MOST_BYTES = 20e6
RANGE = (-12.8, -12.8, -3.0, 12.8, 12.8, 3.0)
LOG_SWEEPS = 4


def make_sweep(rng: np.random.Generator, index: int) -> Sweep:
    """A wall, and a few boxes that move by themselves; 100 to 4,000 points."""
    count = int(rng.integers(100, 4000))
    wall = rng.uniform((-12, 9, -1), (12, 9.3, 2), (count // 2, 3))
    number = rng.integers(0, 5, count - count // 2)
    boxes = rng.uniform(-0.5, 0.5, (len(number), 3)) * (4, 2, 1.5) + np.array([-8, -6, 0]) + number[:, None] * (4, 2, 0)
    boxes[:, 0] += 0.3 * index * number
    return Sweep(np.concatenate([wall, boxes]).astype(np.float32), None, np.eye(4), 100_000_000 * index)


class SmallDrive:
    """A log of small sweeps in which nothing is known to move."""

    def __init__(self, seed: int) -> None:
        rng = np.random.default_rng(seed)
        self.log_id, self.timestamps = f"log-{seed}", [100_000_000 * index for index in range(LOG_SWEEPS)]
        self._sweeps = [make_sweep(rng, index) for index in range(LOG_SWEEPS)]

    def sweep(self, index: int) -> Sweep:
        return self._sweeps[index]

    def labels(self, index: int) -> FlowLabels:
        count = len(self._sweeps[index].points)
        return FlowLabels(np.zeros((count, 3), np.float32), np.zeros(count, np.uint8), np.ones(count, bool))


def estimates(preset: str) -> Iterator[None]:
    """New clouds through `estimate_flow`, for ever."""
    rng = np.random.default_rng(0)
    while True:
        first, second = make_sweep(rng, 0), make_sweep(rng, 1)
        masks = [np.zeros(len(sweep.points), bool) for sweep in (first, second)]
        estimate_flow(first.points, second.points, gm0=masks[0], gm1=masks[1], preset=preset, point_cloud_range=RANGE)
        yield


def logs(root: Path) -> Iterator[None]:
    """Logs opened, read, estimated, written, read again and scored, for ever; after each one that is broken."""
    folders = [write_array_log(SmallDrive(seed), root) for seed in range(3)]
    model = make_model(make_config("paper", point_cloud_range=RANGE))
    broken = root / "broken.feather"
    broken.write_bytes(b"ARROW1 half")
    while True:
        for seed, folder in enumerate(folders):
            metrics, log = SceneFlowMetrics(), CachedLog(ArraysLog(folder), 2)
            for index in range(LOG_SWEEPS - 1):
                sweeps = window(log, index)
                write_flow(root / "flow" / f"{index}.feather", model([sweeps])[0])
                estimate = read_flow(root / "flow" / f"{index}.feather")
                metrics.update(EvalFrame.from_result(sweeps, estimate, SmallDrive(seed).labels(index)))
                yield
            metrics.compute()
            with pytest.raises(CFlowError):
                read_flow(broken)


def held() -> dict[str, float]:
    """What this process holds now."""
    gc.collect()
    objects = gc.get_objects()
    return {
        "files": len(os.listdir("/proc/self/fd")),
        "threads": threading.active_count(),
        "objects": len(objects),
        "tensors": sum(type(one) is torch.Tensor for one in objects),
        "cached": sum(one.cache_info().currsize for one in objects if type(one) is _lru_cache_wrapper),
        "bytes": int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE"),
    }


def grown(windows: Iterator[None]) -> list[str]:
    """Names of what grew between a fifth of the windows and their end."""
    early: dict[str, float] = {}
    for number in range(WINDOWS):
        next(windows)
        if number == WINDOWS // 5:
            early = held()
    late = held()
    names = [name for name, allowed in ALLOWED.items() if late[name] - early[name] > allowed]
    return names + ["bytes"] * (WINDOWS >= LONG and late["bytes"] - early["bytes"] > MOST_BYTES)


@pytest.fixture()
def unclosed(monkeypatch: pytest.MonkeyPatch) -> Iterator[list[str]]:
    """Files that nobody closed but the collector."""
    found: list[str] = []
    monkeypatch.setattr(sys, "unraisablehook", lambda told: found.append(str(told.exc_value)))
    with warnings.catch_warnings():
        warnings.simplefilter("error", ResourceWarning)
        yield found


@pytest.mark.parametrize("preset", ["paper", "default"])
def test_estimates_pile_up_nothing(preset: str) -> None:
    assert grown(estimates(preset)) == []


def test_logs_pile_up_nothing(tmp_path: Path, unclosed: list[str]) -> None:
    assert grown(logs(tmp_path)) == [] and unclosed == []


@pytest.mark.parametrize("profile", ["av2", "nuscenes", "truckscenes", "waymo", "aevascenes"])
def test_every_reader_closes_its_files(tmp_path: Path, profile: str, unclosed: list[str]) -> None:
    """Also those that turn out to be broken, one file after the other."""
    from cflow_torch.simulator.benchmark import benchmark_logs, format_of

    try:
        benchmark_logs(tmp_path, profile, [0], 3)
    except CFlowError as error:
        pytest.skip(str(error))
    chosen = format_of(profile)
    (root,) = [folder for folder in tmp_path.iterdir() if folder.is_dir()]
    files = sorted(file for file in root.rglob("*") if file.is_file())
    look: Callable[[], None] = lambda: read_all(chosen.data_set, root, {"check": False, **chosen.settings})  # noqa: E731
    look()
    before = held()["files"]
    for file in files[:40]:
        whole = file.read_bytes()
        file.write_bytes(whole[: len(whole) // 2])
        look()
        file.write_bytes(whole)
    look()
    assert held()["files"] <= before + 4, "Waymo keeps its last four"
    assert unclosed == []


def read_all(data_set: str, root: Path, settings: dict[str, Any]) -> None:
    """Open every log, read a window and labels; what is broken may refuse."""
    try:
        for source in find_sources(data_set, root):
            log = open_log(data_set, source, **settings)
            window(log, 0)
            log.labels(0)
            log.close()
    except (CFlowError, OSError):
        pass
