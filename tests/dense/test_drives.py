"""The whole dense method on drives, real and simulated: equal to the reference to the last bit."""

from __future__ import annotations

from typing import Any, Dict

import pytest
from oracle import reference_flow
from scenes import assert_same

from cflow_torch import CorrelationFlow, Window, make_config
from cflow_torch.data.hdf5.reader import HDF5Log
from cflow_torch.data.log import window as window_of
from cflow_torch.simulator import make_drive

FIVE = (0.8, 0.4, 0.3, 0.2, 0.1)
NEAR = (-15.0, -15.0, -5.0, 15.0, 15.0, 5.0)
SETTINGS: Dict[str, Dict[str, Any]] = {
    "h2-3scales": {"num_history": 2, "pixel_sizes": (0.4, 0.2, 0.1)},
    "h4-5scales": {"num_history": 4, "pixel_sizes": FIVE},
    "h8-5scales": {"num_history": 8, "pixel_sizes": FIVE},
    "h2-sectional": {"num_history": 2, "pixel_sizes": (0.4, 0.1), "sectional_view": True},
    "h8-connectivity4": {"num_history": 8, "connectivity": 4, "max_speed": 30.0, "max_extent": 8.0},
    "h2-hdbscan": {"num_history": 2, "pixel_sizes": (0.4, 0.1), "clustering": "hdbscan", "point_cloud_range": NEAR},
    "h1-hdbscan-sectional": {
        "num_history": 1,
        "clustering": "hdbscan",
        "sectional_view": True,
        "point_cloud_range": NEAR,
    },
    "h4-timestamps": {"num_history": 4, "use_timestamps": True, "max_speed": 30.0},
}
QUICK = ("h2-3scales",)
CASES = [
    pytest.param(settings, id=name, marks=() if name in QUICK else (pytest.mark.slow,))
    for name, settings in SETTINGS.items()
]


def check(window: Window, settings: Dict[str, Any]) -> None:
    config = make_config("paper", **settings)
    if config.clustering == "hdbscan":
        pytest.importorskip("hdbscan")
    window = Window(window.pc0, window.pc1, window.pch[: config.num_history])
    (result,) = CorrelationFlow(config)([window])
    assert (result.residual_flow.norm(dim=1) >= 0.05).sum() > 500  # there is something to find
    assert_same(result, reference_flow(window, config))


@pytest.mark.parametrize("settings", CASES)
def test_simulated_drive_equals_the_reference(settings):
    check(window_of(make_drive(seed=11, num_sweeps=11), 9, 8), settings)


@pytest.mark.parametrize("settings", CASES)
def test_kitti_equals_the_reference(kitti_file, settings):
    pytest.importorskip("h5py")
    with HDF5Log(kitti_file) as log:
        check(window_of(log, 9, 8), settings)


@pytest.mark.slow
def test_kitti_engines_and_batches_agree(kitti_file):
    pytest.importorskip("h5py")
    pytest.importorskip("kornia", minversion="0.9")
    config = make_config("paper", num_history=4, pixel_sizes=(0.4, 0.2))
    with HDF5Log(kitti_file) as log:
        windows = [window_of(log, index, 4) for index in (0, 3, 8)]
    expected = [CorrelationFlow(config)([window])[0] for window in windows]
    for overrides in ({}, {"labeling": "kornia"}, {"correlation": "conv"}, {"max_memory": 30_000_000}):
        for found, result in zip(CorrelationFlow(config.replace(**overrides))(windows), expected):
            assert_same(found, result)
