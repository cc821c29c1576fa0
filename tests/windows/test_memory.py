"""Memory: free memory of the machine, and errors before an allocation that does not fit."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
import torch
from preset_windows import PRESETS, small

from cflow_torch import CFlowError, Sweep, Window, estimate_flow, make_model
from cflow_torch.windows import memory

CPU = torch.device("cpu")


def highest_resident_kb() -> int:
    """Largest resident memory of this process."""
    status = Path("/proc/self/status")
    if not status.exists():
        pytest.skip("no /proc/self/status: resident memory cannot be read")
    return int(re.search(r"VmHWM:\s+(\d+)", status.read_text()).group(1))  # type: ignore[union-attr]


@pytest.mark.parametrize("preset", PRESETS)
def test_too_large_windows_are_refused_before_allocation(preset, monkeypatch):
    monkeypatch.setattr(memory, "available_memory", lambda environ: 4_000_000_000)
    before, car = highest_resident_kb(), np.zeros((100, 3))
    wide = (-1000.0, -1000.0, -3.0, 1000.0, 1000.0, 3.0)
    with pytest.raises(CFlowError, match=r"20(00|08)1 x 20(00|08)1 pixels of 0.1 m.*4.0 GB.*smaller point_cloud_range"):
        estimate_flow(car, car, preset=preset, point_cloud_range=wide)
    points = np.broadcast_to(np.float32([1.0, 2.0, 0.5]), (10**8, 3))  # a view that takes no memory
    with pytest.raises(CFlowError, match=r"200000000 points in 2 sweeps.*fewer points"):
        make_model(small(preset), "cpu")([Window(Sweep(points), Sweep(points))])
    assert highest_resident_kb() - before < 50_000


def test_requests_are_compared_with_the_free_memory():
    free = memory.available_memory({})
    if free is None:
        pytest.skip("no /proc/meminfo: free memory is unknown")
    memory.require_memory(free // 2, CPU, "half of it", "")
    with pytest.raises(CFlowError, match="all of it needs about .*GB.*cpu has .* left: use less"):
        memory.require_memory(4 * free + 2**40, CPU, "all of it", "use less")


def test_torchrun_and_control_groups_limit_the_memory(monkeypatch, tmp_path):
    monkeypatch.setattr(memory, "control_groups", list)
    alone = memory.available_memory({})
    if alone is None:
        pytest.skip("no /proc/meminfo: free memory is unknown")
    assert memory.available_memory({"LOCAL_WORLD_SIZE": "4"}) <= alone // 3
    (tmp_path / "memory.max").write_text("9000000\n")
    (tmp_path / "memory.current").write_text("2000000\n")
    monkeypatch.setattr(memory, "control_groups", lambda: [tmp_path])
    assert memory.available_memory({}) == 7_000_000
