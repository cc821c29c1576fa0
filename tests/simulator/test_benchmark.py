"""data=benchmark: drives are made once and cached under a digest of the code that makes them."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest

from cflow_torch import CFlowError
from cflow_torch.data.av2 import AV2Log
from cflow_torch.data.log import window
from cflow_torch.simulator import benchmark, make_drive
from cflow_torch.simulator.benchmark import benchmark_logs


def test_a_drive_is_made_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    first = benchmark_logs(tmp_path, "demo", [1, 2], 3)
    drive, log = make_drive(seed=2, num_sweeps=3, profile="demo"), AV2Log(first[1])
    assert log.log_id == drive.log_id and list(log.timestamps) == list(drive.timestamps)
    np.testing.assert_array_equal(window(log, 1).pc0.points, drive.sweep(1).points.astype(np.float16))
    stamps = {file: file.stat().st_mtime_ns for file in tmp_path.rglob("*.feather")}
    (first[0].parent / ".making-x" / "synthetic-demo-0003").mkdir(parents=True)  # left over from a run that was killed
    again = benchmark_logs(tmp_path, "demo", [1, 2, 3], 3)
    assert again[:2] == first and len(list(again[2].rglob("*.feather"))) > 3
    assert {file: file.stat().st_mtime_ns for file in stamps} == stamps
    with pytest.raises(CFlowError, match="profile"):
        benchmark_logs(tmp_path, "none", [1], 3)


def test_a_changed_generator_makes_new_drives(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    shutil.copytree(benchmark._HERE, tmp_path / "code")
    key = benchmark.generator_key()
    monkeypatch.setattr(benchmark, "_HERE", tmp_path / "code")
    assert benchmark.generator_key() == key
    file = tmp_path / "code" / "street.py"
    file.write_bytes(file.read_bytes() + b"\n")
    assert benchmark.generator_key() != key
