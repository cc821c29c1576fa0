"""Missing returns of organised clouds are no points, in whatever frame and by whatever reader."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch

from cflow_torch import FlowStream, Sweep, Window, estimate_flow
from cflow_torch.data.arrays import ArraysLog
from cflow_torch.diagnosis.inspection import Inspection
from cflow_torch.simulator import make_drive
from cflow_torch.types import CFlowWarning
from cflow_torch.windows.returns import missing_returns, without_missing


@pytest.mark.parametrize("fill", [(0, 0, 0), (np.nan,) * 3, (1.2, 0, 1.8), (-1e3,) * 3, (np.inf, 1, 1)])
@pytest.mark.parametrize("share", [0.02, 0.6])
@pytest.mark.parametrize("count", [20_000, 7918, 15_838])
def test_defaults_are_found_in_any_pattern(fill: tuple, share: float, count: int) -> None:
    rng = np.random.default_rng(0)
    points = rng.normal(0, 20, (count, 3)).astype(np.float32)
    for is_filled in (rng.random(count) < share, np.arange(count) > count * (1 - share)):
        points[is_filled] = fill
        assert np.array_equal(missing_returns(points), is_filled)
        assert without_missing(Sweep(points))[1] == (is_filled.sum() if np.isfinite(points).all() else 0)
        points = rng.normal(0, 20, (count, 3)).astype(np.float32)
    assert not missing_returns(points).any() and len(missing_returns(points[:0])) == 0
    assert not missing_returns(np.repeat(points, 3, axis=0)).any(), "every return three times"
    assert not missing_returns(np.round(points / 4) * 4 + 0.5).any(), "a coarse grid"


@pytest.mark.parametrize("fill", [0.0, np.nan])
def test_returns_of_an_organised_cloud_are_transformed_alone(tmp_path, fill: float) -> None:
    """Results keep a row for every row of the file."""
    drive, mount = make_drive(seed=1, num_sweeps=2, profile="demo"), np.eye(4)
    mount[:3, 3] = 1.2, 0, 1.8
    for k in range(2):
        points = drive.sweep(k).points
        np.save(tmp_path / f"{k}.npy", np.concatenate([points, np.full((500, 3), fill, np.float32)]))
    sweep = ArraysLog(tmp_path, ego_T_lidar=mount).sweep(1)
    assert np.isnan(sweep.points[-500:]).all()
    assert np.allclose(sweep.points[:-500], drive.sweep(1).points + mount[:3, 3].astype(np.float32), atol=1e-5)


@pytest.mark.parametrize(("fill", "kind"), [(0.0, np.asarray), (1.5, torch.from_numpy)])
def test_missing_returns_in_arrays_are_left_out_and_said(fill: float, kind: Any) -> None:
    """Real points get the same flow as without them, and the given arrays stay."""
    drive = make_drive(seed=1, num_sweeps=2, profile="demo")
    pc0, pc1 = drive.sweep(0), drive.sweep(1)
    T = np.linalg.inv(pc1.pose) @ pc0.pose
    settings: dict = {"T_ego1_ego0": T, "ground": "grid", "preset": "paper"}
    alone = estimate_flow(pc0.points, pc1.points, **settings)
    filled = [kind(np.concatenate([one.points, np.full((20_000, 3), fill, np.float32)])) for one in (pc0, pc1)]
    with pytest.warns(CFlowWarning, match="up to 20000 points of a sweep are no returns .* we leave them out"):
        result = estimate_flow(*filled, **settings)
    assert torch.equal(result.flow[:-20_000], alone.flow) and not result.is_valid[-20_000:].any()
    assert (np.asarray(filled[0])[-20_000:] == fill).all()
    stream = FlowStream("paper", ground="grid")
    with pytest.warns(CFlowWarning, match="20000 points of a sweep are no returns"):
        stream.push(filled[0], pc0.pose)
    streamed = stream.push(filled[1], pc1.pose)
    assert not streamed.is_valid[-20_000:].any()
    with pytest.warns(CFlowWarning, match="20000 points of a sweep are no returns .*: leave them out"):
        sweeps = [Sweep(cloud, None, one.pose) for cloud, one in zip(filled, (pc0, pc1))]
        Inspection()([Window(*sweeps)])
