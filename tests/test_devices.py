"""Devices: the bits of the CPU, no mixed devices, few launches and few waits. Runs on a pretend accelerator."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pretend_device
import pytest
from preset_windows import changed, small, windows_for
from pretend_device import PretendDevice
from scenes import assert_same_bits

from cflow_torch import Config, make_model

pytestmark = pytest.mark.skipif(not pretend_device.IS_THERE, reason="torch before 2.9 has no backends in Python")

SCALES = (0.8, 0.4, 0.3, 0.2, 0.1)
# The most launches and waits of one window, and launches of sixteen windows. The last two rows are what we counted.
BOUNDS: dict[str, tuple[Config, int, int, int]] = {
    "paper": (small("paper", num_history=0), 608, 32, 736),
    "paper, h = 4, 5 scales": (small("paper", num_history=4, pixel_sizes=SCALES), 3510, 129, 3539),
    "keypoints": (small("keypoints"), 868, 35, 898),
    "default": (small("default"), 4836, 127, 4996),
    "offline": (small("offline"), 5259, 140, 5403),
}


@pytest.mark.parametrize(
    "name",
    [
        *("paper", "keypoints", "default"),
        *(pytest.param(name, marks=pytest.mark.slow) for name in ("paper, h = 4, 5 scales", "offline")),
    ],
)
def test_a_device_gives_the_bits_of_the_cpu_with_few_launches(name: str) -> None:
    config, *bounds = BOUNDS[name]
    windows = windows_for(config, 4)
    with PretendDevice() as device:
        model = make_model(config, pretend_device.DEVICE)
        results = [result.to("cpu") for result in model(windows)]
        one, sixteen = (device.count(lambda batch=batch: model(batch)) for batch in (windows[:1], windows[:1] * 16))
    for result, expected in zip(results, make_model(config, "cpu")(windows)):
        assert_same_bits(result, expected)
    counted = (*one, sixteen[0])
    assert all(number <= bound for number, bound in zip(counted, bounds)), f"counted {counted}, allowed {bounds}"


def test_a_batch_may_mix_windows_with_and_without_poses_masks_and_times() -> None:
    config = small("default")
    moved, plain, timed, _ = windows_for(config, 4)
    plain = changed(plain, lambda sweep: replace(sweep, pose=None, is_ground=None))
    timed = changed(timed, lambda sweep: replace(sweep, point_times=np.linspace(0, 0.1, len(sweep.points))))
    windows = [moved, plain, replace(plain, pch=()), timed]
    with PretendDevice():
        results = [result.to("cpu") for result in make_model(config, pretend_device.DEVICE)(windows)]
    for result, window in zip(results, windows):
        (alone,) = make_model(config, "cpu")([window])
        assert_same_bits(result, alone)
