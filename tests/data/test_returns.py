"""Missing returns of organised clouds are no points, in whatever frame and by whatever reader."""

from __future__ import annotations

import numpy as np
import pytest

from cflow_torch.data.arrays import ArraysLog
from cflow_torch.data.returns import missing_returns
from cflow_torch.simulator import make_drive


@pytest.mark.parametrize("fill", [(0, 0, 0), (np.nan,) * 3, (1.2, 0, 1.8), (-1e3,) * 3, (np.inf, 1, 1)])
@pytest.mark.parametrize("share", [0.02, 0.6])
def test_defaults_are_found_in_any_pattern(fill: tuple, share: float) -> None:
    rng = np.random.default_rng(0)
    points = rng.normal(0, 20, (20_000, 3)).astype(np.float32)
    for is_filled in (rng.random(20_000) < share, np.arange(20_000) > 20_000 * (1 - share)):
        points[is_filled] = fill
        assert np.array_equal(missing_returns(points), is_filled)
        points = rng.normal(0, 20, (20_000, 3)).astype(np.float32)
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
