"""What a caller's torch is set to must not matter: default dtype, autocast. And limits that are no limits."""

from __future__ import annotations

import pytest
import torch
from scenes import assert_same, config, scene

from cflow_torch import CFlowError, Sweep, Window, make_model

METHODS = {
    "dense": {"num_history": 2},
    "conv": {"num_history": 2, "correlation": "conv"},
    "sectional": {"num_history": 2, "sectional_view": True},
    "beyond": {"num_history": 2, "max_object": 2.0, "zero_test": 1.5, "subpixel": "parabola", "height_slices": 4},
    "key points": {"method": "keypoints"},
}


def window_of(name: str) -> Window:
    return scene(1, num_history=METHODS[name].get("num_history", 0))


@pytest.mark.parametrize("dtype", [torch.float64, torch.float16, torch.bfloat16], ids=str)
@pytest.mark.parametrize("name", METHODS)
def test_default_dtype_does_not_matter(name: str, dtype: torch.dtype) -> None:
    model = make_model(config(**METHODS[name]), "cpu")
    windows = [window_of(name), Window(Sweep(torch.zeros((0, 3))), Sweep(torch.zeros((0, 3))))]
    expected = [model([window])[0] for window in windows]  # alone: nothing to correlate in the second
    before = torch.get_default_dtype()
    torch.set_default_dtype(dtype)
    try:
        found = [model([window])[0] for window in windows]
    finally:
        torch.set_default_dtype(before)
    for one, other in zip(found, expected):
        assert_same(one, other)


@pytest.mark.parametrize("name", METHODS)
def test_autocast_does_not_matter(name: str) -> None:
    model = make_model(config(**METHODS[name]), "cpu")
    expected = model([window_of(name)])[0]
    with torch.autocast("cpu", dtype=torch.bfloat16):
        assert_same(model([window_of(name)])[0], expected)


def test_counts_above_those_of_bfloat16_survive_autocast() -> None:
    car = 0.1 * torch.cartesian_prod(torch.arange(40.0), torch.arange(20.0), torch.zeros(1)) + 0.05
    window = Window(Sweep(car), Sweep(car + torch.tensor([0.3, 0.1, 0.0])))
    model = make_model(config(pixel_sizes=(0.1,), correlation="conv"), "cpu")
    with torch.autocast("cpu", dtype=torch.bfloat16):
        assert model([window])[0].residual_flow[0].tolist() == pytest.approx([0.3, 0.1, 0.0])


@pytest.mark.parametrize("most", [float("inf"), 1e300, 1e20, 1e19])
def test_a_speed_that_bounds_nothing_is_no_bound(most: float) -> None:
    expected = make_model(config(num_history=2), "cpu")([window_of("dense")])[0]
    assert expected.residual_flow.abs().sum() > 0
    assert_same(make_model(config(num_history=2, max_speed=most), "cpu")([window_of("dense")])[0], expected)


def test_a_point_far_above_is_named_by_the_sectional_view() -> None:
    car = 0.1 * torch.cartesian_prod(torch.arange(40.0), torch.arange(18.0), torch.arange(15.0)) + 0.05
    car[7, 2] = 1e5
    window = Window(Sweep(car), Sweep(car + torch.tensor([0.5, 0.0, 0.0])))
    endless = (-8.0, -7.0, -float("inf"), 8.0, 7.0, float("inf"))
    with pytest.raises(CFlowError, match="finite z bounds"):
        make_model(config(sectional_view=True, point_cloud_range=endless), "cpu")([window])
