"""Properties that hold exactly (hypothesis): shift, order, batch, threads, representation of the input."""

from __future__ import annotations

import warnings
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from oracle import reference_flow
from scenes import LABELINGS, assert_same, config, pose, scene

from cflow_torch import CorrelationFlow, FlowResult, Sweep, Window
from cflow_torch.config import Config

S = 0.125  # exact in every float format, so whole pixels are exact shifts
RANGE = (-6.0, -6.0, -2.0, 6.0, 6.0, 2.0)
PROFILE = settings(deadline=None, max_examples=25, derandomize=True, suppress_health_check=list(HealthCheck))


def cflow(window: Window, **overrides) -> FlowResult:
    (result,) = CorrelationFlow(small(**overrides))([window])
    return result


def small(**overrides) -> Config:
    base = Config(pixel_sizes=(S,), point_cloud_range=RANGE, num_history=3, max_extent=2.0)
    return base.replace(**overrides)


# A cloud: centres of pixels within 2.5 m, so that shapes touch, split and move.
clouds = st.lists(st.tuples(*[st.integers(-10, 9)] * 2, st.integers(-4, 3)), max_size=25).map(
    lambda cells: (np.array(cells, dtype=np.float64).reshape(-1, 3) + 0.5) * S
)


@st.composite
def windows(draw, max_history: int = 3) -> Window:
    """Sweeps that share most of their shape: a cloud, moved and partly replaced."""
    base = draw(clouds)
    sweeps = []
    for _ in range(2 + draw(st.integers(0, max_history))):
        move = np.array(draw(st.tuples(st.integers(-4, 4), st.integers(-4, 4), st.integers(-1, 1)))) * S
        cloud = base[draw(st.integers(0, 2)) :] + move
        if draw(st.booleans()):
            cloud = np.concatenate([cloud, draw(clouds)])
        ground = np.arange(len(cloud)) % 5 == 4 if draw(st.booleans()) else None
        sweeps.append(Sweep(cloud, ground))
    return Window(sweeps[0], sweeps[1], tuple(sweeps[2:]))


def moved(window: Window, shift: np.ndarray) -> Window:
    sweeps = [replace(s, points=s.points + shift) for s in (window.pc0, window.pc1, *window.pch)]
    return Window(sweeps[0], sweeps[1], tuple(sweeps[2:]))


def reordered(sweep: Sweep, seed: int) -> Sweep:
    order = np.random.default_rng(seed).permutation(len(sweep.points))
    return Sweep(sweep.points[order], None if sweep.is_ground is None else sweep.is_ground[order], sweep.pose)


def rows(result: FlowResult, order: np.ndarray) -> FlowResult:
    return FlowResult(*(value[torch.from_numpy(order)] for value in vars(result).values() if value is not None))


choices = st.fixed_dictionaries(
    {
        "connectivity": st.sampled_from([4, 8]),
        "max_extent": st.sampled_from([0.6, 1.3, 100.0]),
        "max_speed": st.sampled_from([None, 1.0, 3.0]),
        "max_object": st.sampled_from([None, 2 * S, 1.0]),
        "zero_test": st.sampled_from([None, 0.5, 1.0]),
        "subpixel": st.sampled_from(["none", "parabola"]),
        "height_slices": st.sampled_from([0, 2, 4]),
        "slice_height": st.sampled_from([S, 0.3]),
        "sectional_view": st.booleans(),
        "pixel_sizes": st.sampled_from([(S,), (4 * S, S), (0.3, 0.1)]),
        "correlation": st.sampled_from(["fft", "conv"]),
    }
)


@settings(PROFILE, max_examples=60)
@given(windows(), choices)
def test_equals_the_reference(window, overrides):
    assert_same(cflow(window, **overrides), reference_flow(window, small(**overrides)))


@PROFILE
@given(windows(), st.tuples(st.integers(-20, 20), st.integers(-20, 20)), choices)
def test_shift_by_whole_pixels_shifts_the_answer(window, shift, overrides):
    """Flow, clusters, scores stay with their points wherever in the image they lie."""
    overrides = {**overrides, "pixel_sizes": (S,), "sectional_view": False}
    shift = np.array([*shift, 0]) * S
    assert_same(cflow(moved(window, shift), **overrides), cflow(window, **overrides))


@PROFILE
@given(windows(max_history=0), st.tuples(st.integers(-5, 5), st.integers(-5, 5)))
def test_shift_by_whole_coarse_pixels_with_three_scales(window, shift):
    shift = np.array([*shift, 0]) * 4 * S
    sizes = {"pixel_sizes": (4 * S, 2 * S, S)}
    assert_same(cflow(moved(window, shift), **sizes), cflow(window, **sizes))


@PROFILE
@given(windows(), st.integers(-3, 3))
def test_shift_along_z_shifts_the_sectional_view(window, steps):
    shift = np.array([0, 0, steps * S])
    assert_same(cflow(moved(window, shift), sectional_view=True), cflow(window, sectional_view=True))


@PROFILE
@given(windows(), st.integers(0, 99), choices)
def test_order_of_points_does_not_matter(window, seed, overrides):
    result = cflow(window, **overrides)
    order = np.random.default_rng(seed).permutation(len(window.pc0.points))
    assert_same(cflow(replace(window, pc0=reordered(window.pc0, seed)), **overrides), rows(result, order))
    others = replace(
        window, pc1=reordered(window.pc1, seed), pch=tuple(reordered(s, seed + i) for i, s in enumerate(window.pch))
    )
    sources = [window.pc0, *window.pch]
    repeated = any(np.array_equal(s.points, o.points) for i, s in enumerate(sources) for o in sources[:i])
    if not repeated:  # a repeated sweep in another order is no repetition any more
        assert_same(cflow(others, **overrides), result)


@PROFILE
@given(windows())
def test_points_given_twice_count_once(window):
    twice = replace(
        window, pc1=Sweep(np.repeat(window.pc1.points, 2, 0), ground_twice(window.pc1)), pch=tuple(window.pch)
    )
    assert_same(cflow(twice), cflow(window))


def ground_twice(sweep: Sweep):
    return None if sweep.is_ground is None else np.repeat(sweep.is_ground, 2)


@PROFILE
@given(st.lists(windows(), min_size=1, max_size=5), choices)
def test_batch_equals_loop(batch, overrides):
    for together, window in zip(CorrelationFlow(small(**overrides))(batch), batch):
        assert_same(together, cflow(window, **overrides))


@PROFILE
@given(windows(), choices)
def test_points_of_a_cluster_share_one_flow(window, overrides):
    result = cflow(window, **{**overrides, "pixel_sizes": (S,)})
    ids = result.cluster_id
    for i in range(int(ids.max()) + 1 if ids.numel() else 0):
        assert len(result.residual_flow[ids == i].unique(dim=0)) <= 1
        assert len(result.score[ids == i].unique()) <= 1
    assert not result.residual_flow[ids < 0].any() and not result.score[ids < 0].any()
    assert (ids[~result.is_valid] == -1).all()
    assert ((result.score >= 0) & (result.score <= 1)).all()


@PROFILE
@given(windows(max_history=1), st.integers(0, 30))
def test_total_flow_is_the_sum(window, angle):
    poses = [pose(0.3 * i, 0.1 * i, 0.01 * angle * i) for i in range(3)]
    posed = Window(
        replace(window.pc0, pose=poses[1]),
        replace(window.pc1, pose=poses[2]),
        tuple(replace(s, pose=poses[0]) for s in window.pch),
    )
    result = cflow(posed)
    assert torch.equal(result.flow, result.pose_flow + result.residual_flow)
    assert_same(result, reference_flow(posed, small()))


# --------------------------------------------------------------------------- batches, threads, memory: real sizes


def mixed_batch() -> list:
    """Windows of different sizes, numbers of sweeps, with and without poses; two of them empty."""
    first = scene(1)
    nothing = Sweep(np.zeros((0, 3), dtype=np.float32))
    return [
        scene(0, num_history=3),
        first,
        Window(nothing, nothing),
        scene(2, num_history=1, poses=False, num_objects=2, num_points=15),
        Window(nothing, replace(nothing, points=np.zeros((0, 5))), (nothing,)),
        replace(first, pc1=Sweep(first.pc1.points[:0], pose=first.pc1.pose)),
        scene(3, num_history=2, num_objects=16),
    ]


MIXED = {"num_history": 3, "sectional_view": True, "pixel_sizes": (0.5, 0.25), "max_speed": 8.0}


@pytest.mark.parametrize("labeling", LABELINGS)
@pytest.mark.parametrize("correlation", ["fft", "conv"])
def test_a_mixed_batch_equals_the_loop(correlation, labeling):
    settings_ = config(**MIXED, labeling=labeling, correlation=correlation)
    model, batch = CorrelationFlow(settings_), mixed_batch()
    together = model(batch)
    backwards = model(batch[::-1])[::-1]
    for window, result, again in zip(batch, together, backwards):
        (alone,) = model([window])
        assert_same(result, alone)
        assert_same(again, alone)
        assert_same(alone, reference_flow(window, settings_))


@pytest.fixture
def threads():
    """Sets the number of threads, and sets it back."""
    before = torch.get_num_threads()
    yield torch.set_num_threads
    torch.set_num_threads(before)


@pytest.mark.parametrize("correlation", ["fft", "conv"])
def test_number_of_threads_does_not_change_a_bit(threads, correlation):
    model = CorrelationFlow(config(**MIXED, correlation=correlation))
    batch = [scene(seed, num_history=3, num_objects=25, num_points=300) for seed in range(6)]
    threads(1)
    on_one = model(batch)
    threads(2)
    for one, two in zip(on_one, model(batch)):
        assert_same(one, two)


@pytest.mark.parametrize("max_memory", [1, 10**5, 10**6, 10**7])
def test_memory_limit_does_not_change_a_bit(max_memory):
    batch = mixed_batch()
    limited = CorrelationFlow(config(**MIXED, max_memory=max_memory))(batch)
    for less, free in zip(limited, CorrelationFlow(config(**MIXED))(batch)):
        assert_same(less, free)


# -------------------------------------------------------------------------------- representation of the input


def read_only(array: np.ndarray) -> np.ndarray:
    array = array.copy()
    array.flags.writeable = False
    return array


FORMS = {
    "float32": lambda p: p.astype(np.float32),
    "float16": lambda p: p.astype(np.float16),
    "longdouble": lambda p: p.astype(np.longdouble),
    "big-endian": lambda p: p.astype(">f8"),
    "fortran": np.asfortranarray,
    "negative stride": lambda p: p[::-1].copy()[::-1],
    "negative column stride": lambda p: p[:, ::-1].copy()[:, ::-1],
    "every second row": lambda p: np.repeat(p, 2, 0)[::2],
    "more columns": lambda p: np.pad(p, [(0, 0), (0, 2)], constant_values=np.nan),
    "part of wider rows": lambda p: np.pad(p, [(0, 0), (0, 2)])[:, :3],
    "read-only": read_only,
    "read-only float32": lambda p: read_only(p.astype(np.float32)),
    "torch": lambda p: torch.from_numpy(p.copy()),
    "torch float32": lambda p: torch.from_numpy(p).float(),
    "torch float16": lambda p: torch.from_numpy(p).half(),
    "torch bfloat16": lambda p: torch.from_numpy(p).bfloat16(),
    "torch transposed": lambda p: torch.from_numpy(p.T.copy()).t(),
    "torch expanded": lambda p: torch.from_numpy(p)[:, None].expand(-1, 2, -1)[:, 1],
    "torch with gradient": lambda p: torch.from_numpy(p.copy()).requires_grad_(),
}


def as_bytes(array) -> bytes:
    if isinstance(array, torch.Tensor):
        array = array.detach().double().numpy()
    return np.ascontiguousarray(array).tobytes()


@pytest.mark.parametrize("form", FORMS)
def test_form_of_the_input_does_not_matter_and_is_left_alone(form):
    rng = np.random.default_rng(0)
    # Multiples of 1/16 below 4: exact in every format, bfloat16 included (6 bits before rounding).
    base = (rng.integers(-32, 32, (120, 3)) / 16.0).clip(-1.9, 1.9)
    base = np.round(base * 16) / 16
    sweeps = [base[:100] + m for m in ([0.0, 0, 0], [0.25, -0.125, 0], [-0.25, 0.125, 0])]
    ground = np.arange(100) % 7 == 0
    plain = Window(*(Sweep(p, ground) for p in sweeps[:2]), pch=(Sweep(sweeps[2]),))
    expected = cflow(plain, sectional_view=True)
    assert expected.residual_flow.any()

    given_points = [FORMS[form](p) for p in sweeps]
    mask = ground[::-1].copy()[::-1] if "stride" in form else read_only(ground)
    mask = torch.from_numpy(ground.copy()) if "torch" in form else mask
    before = [as_bytes(p) for p in (*given_points, mask)]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        result = cflow(
            Window(*(Sweep(p, mask) for p in given_points[:2]), pch=(Sweep(given_points[2]),)), sectional_view=True
        )
    assert_same(result, expected)
    assert not result.flow.requires_grad
    assert [as_bytes(p) for p in (*given_points, mask)] == before


def test_numpy_and_torch_may_be_mixed():
    window = scene(7, num_history=1)
    mixed = Window(
        Sweep(torch.from_numpy(window.pc0.points), window.pc0.is_ground, torch.from_numpy(window.pc0.pose)),
        Sweep(window.pc1.points, torch.from_numpy(window.pc1.is_ground), window.pc1.pose.tolist()),
        (replace(window.pch[0], points=torch.from_numpy(window.pch[0].points).double()),),
    )
    model = CorrelationFlow(config(num_history=1))
    assert_same(model([mixed])[0], model([window])[0])


def test_a_second_call_gives_the_same():
    model, window = CorrelationFlow(config(**MIXED)), scene(5, num_history=3)
    first, second = model([window])[0], model([window])[0]
    assert_same(first, second)
