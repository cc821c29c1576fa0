"""Properties on small windows drawn by hypothesis: equality with the oracle, shifts."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from preset_windows import changed
from scenes import assert_same, flow_as_oracle

from cflow_torch import FlowResult, Sweep, Window, make_model
from cflow_torch.config import CONFIGS, Config

S = 0.125  # exact in every float format, so whole pixels are exact shifts
RANGE = (-6.0, -6.0, -2.0, 6.0, 6.0, 2.0)
PROFILE = settings(deadline=None, max_examples=15, derandomize=True, suppress_health_check=list(HealthCheck))


def small(method: str = "dense", **overrides) -> Config:
    of_method = {} if method == "keypoints" else {"num_history": 3}
    if method != "verified":
        of_method["max_extent"] = 2.0
    return CONFIGS[method](pixel_sizes=(S,), point_cloud_range=RANGE, **of_method).replace(**overrides)


def cflow(window: Window, *method: str, **overrides) -> FlowResult:
    (result,) = make_model(small(*method, **overrides), "cpu")([window])
    return result


# A cloud has points at the centres of pixels within 2.5 m, so that shapes touch, split and move.
clouds = st.lists(st.tuples(*[st.integers(-10, 9)] * 2, st.integers(-4, 3)), max_size=25).map(
    lambda cells: (np.array(cells, dtype=np.float64).reshape(-1, 3) + 0.5) * S
)


@st.composite
def windows(draw, max_history: int = 3) -> Window:
    """Sweeps that share most of their shape: one cloud, moved and partly replaced."""
    base, sweeps = draw(clouds), []
    for _ in range(2 + draw(st.integers(0, max_history))):
        move = np.array(draw(st.tuples(st.integers(-4, 4), st.integers(-4, 4), st.integers(-1, 1)))) * S
        cloud = base[draw(st.integers(0, 2)) :] + move
        if draw(st.booleans()):
            cloud = np.concatenate([cloud, draw(clouds)])
        ground = np.arange(len(cloud)) % 5 == 4 if draw(st.booleans()) else None
        sweeps.append(Sweep(cloud, ground))
    return Window(sweeps[0], sweeps[1], tuple(sweeps[2:]))


def moved(window: Window, shift: np.ndarray) -> Window:
    return changed(window, lambda sweep: replace(sweep, points=sweep.points + shift))


dense = st.fixed_dictionaries(
    {
        "connectivity": st.sampled_from([4, 8]),
        "max_extent": st.sampled_from([0.6, 1.3, 100.0]),
        "max_speed": st.sampled_from([None, 1.0, 3.0]),
        "sectional_view": st.booleans(),
        "pixel_sizes": st.sampled_from([(S,), (4 * S, S), (0.3, 0.1)]),
        "correlation": st.sampled_from(["fft", "conv"]),
    }
)
verified = st.fixed_dictionaries(
    {
        "max_speed": st.sampled_from([None, 3.0]),
        "significance": st.sampled_from([0.0, 1.0]),
        "min_height": st.sampled_from([None, 0.2]),
        "pixel_sizes": st.sampled_from([(S,), (4 * S, S), (2 * S, S)]),
    }
)
keypoints = st.fixed_dictionaries(
    {
        "densify": st.sampled_from(["components", "clusters", "nearest"]),
        "patch_size": st.sampled_from([1, 3, 11]),
        "ratio_threshold": st.sampled_from([1.0, 1.1]),
        "gate_radius": st.sampled_from([0.3, 3.0]),
    }
)


@settings(PROFILE, max_examples=50)
@given(windows(), dense)
def test_dense_equals_the_oracle(window, overrides):
    flow_as_oracle(window, small(**overrides))


@settings(PROFILE, max_examples=40)
@given(windows(), verified, st.sampled_from([None, 2 * S, 1.0]))
def test_verified_equals_the_oracle(window, overrides, longest):
    flow_as_oracle(window, small("verified", max_object_length=longest, **overrides))


@settings(PROFILE, max_examples=30)
@given(windows(max_history=0), keypoints)
def test_keypoints_equal_the_oracle(window, overrides):
    flow_as_oracle(window, small("keypoints", **overrides))


@PROFILE
@given(windows(), st.tuples(st.integers(-20, 20), st.integers(-20, 20)), dense)
def test_a_shift_by_whole_pixels_shifts_the_scene(window, shift, overrides):
    """Flow, clusters and scores stay with their points, anywhere in the image."""
    overrides = {**overrides, "pixel_sizes": (S,), "sectional_view": False}
    shifted = moved(window, np.array([*shift, 0]) * S)
    assert_same(cflow(shifted, **overrides), cflow(window, **overrides))


@PROFILE
@given(windows(), st.integers(-3, 3))
def test_a_shift_along_z_shifts_the_sectional_view(window, steps):
    shifted = moved(window, np.array([0, 0, steps * S]))
    assert_same(cflow(shifted, sectional_view=True), cflow(window, sectional_view=True))
