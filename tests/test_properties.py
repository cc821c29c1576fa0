"""A shift of the scene shifts the flow of the dense method, on small windows drawn by hypothesis."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from preset_windows import changed
from scenes import assert_same

from cflow_torch import Sweep, Window, make_model
from cflow_torch.config import DenseConfig

S = 0.125  # exact in every float format, so whole pixels are exact shifts
SMALL = {"pixel_sizes": (S,), "point_cloud_range": (-6.0, -6.0, -2.0, 6.0, 6.0, 2.0), "num_history": 3}
PROFILE = settings(deadline=None, max_examples=15, derandomize=True, suppress_health_check=list(HealthCheck))

# A cloud has points at the centres of pixels within 2.5 m, so that shapes touch, split and move.
clouds = st.lists(st.tuples(*[st.integers(-10, 9)] * 2, st.integers(-4, 3)), max_size=25).map(
    lambda cells: (np.array(cells, dtype=np.float64).reshape(-1, 3) + 0.5) * S
)


@st.composite
def windows(draw) -> Window:
    """Sweeps that share most of their shape: one cloud, moved and partly replaced."""
    base, sweeps = draw(clouds), []
    for _ in range(2 + draw(st.integers(0, 3))):
        move = np.array(draw(st.tuples(st.integers(-4, 4), st.integers(-4, 4), st.integers(-1, 1)))) * S
        cloud = base[draw(st.integers(0, 2)) :] + move
        if draw(st.booleans()):
            cloud = np.concatenate([cloud, draw(clouds)])
        ground = np.arange(len(cloud)) % 5 == 4 if draw(st.booleans()) else None
        sweeps.append(Sweep(cloud, ground))
    return Window(sweeps[0], sweeps[1], tuple(sweeps[2:]))


dense = st.fixed_dictionaries(
    {
        "connectivity": st.sampled_from([4, 8]),
        "max_extent": st.sampled_from([0.6, 1.3, 100.0]),
        "max_speed": st.sampled_from([None, 1.0, 3.0]),
        "correlation": st.sampled_from(["fft", "conv"]),
    }
)


def assert_shift_keeps_the_flow(window: Window, shift: np.ndarray, config: DenseConfig) -> None:
    shifted = changed(window, lambda sweep: replace(sweep, points=sweep.points + shift))
    result, of_shifted = make_model(config, "cpu")([window, shifted])
    assert_same(of_shifted, result)


@PROFILE
@given(windows(), st.tuples(st.integers(-20, 20), st.integers(-20, 20)), dense)
def test_a_shift_by_whole_pixels_shifts_the_scene(window, shift, overrides):
    """Flow, clusters and scores stay with their points, anywhere in the image."""
    assert_shift_keeps_the_flow(window, np.array([*shift, 0]) * S, DenseConfig(**SMALL).replace(**overrides))


@PROFILE
@given(windows(), st.integers(-3, 3))
def test_a_shift_along_z_shifts_the_sectional_view(window, steps):
    config = DenseConfig(**SMALL, max_extent=2.0, sectional_view=True)
    assert_shift_keeps_the_flow(window, np.array([0, 0, steps * S]), config)
