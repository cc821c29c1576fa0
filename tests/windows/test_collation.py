"""Collation: active points, repeated sweeps, the ego box, memory and groups of windows, forms of arrays."""

from __future__ import annotations

import math
import re
import warnings
from dataclasses import replace
from pathlib import Path
from typing import Any, Callable

import numpy as np
import pytest
import torch
from preset_windows import PRESETS, changed, num_moving, small, windows_for
from scenes import RANGE, assert_same_bits, assert_zeros, config, flow_as_oracle, pose, rows_of, scene

from cflow_torch import CFlowError, FlowResult, Sweep, Window, estimate_flow, make_model
from cflow_torch.config import Config
from cflow_torch.windows import memory
from cflow_torch.windows.bev_grid import Grid
from cflow_torch.windows.memory import split_windows

CPU = torch.device("cpu")
EMPTY, FAR, LOST = np.zeros((0, 3), dtype=np.float32), np.full((3, 3), 1000.0), np.full((5, 3), np.nan)
P0, P1 = np.random.default_rng(0).uniform(-5, 5, (2, 50, 3)).astype(np.float32)


def cflow(window: Window, settings: Config) -> FlowResult:
    (result,) = make_model(settings, "cpu")([window])
    return result


@pytest.mark.parametrize("preset", PRESETS)
@pytest.mark.parametrize(
    "pc0, pc1, others",
    [
        (EMPTY, EMPTY, ()),
        (EMPTY, P1, (P0,)),
        (P0, EMPTY, (P1,)),
        (P0[:1], P0[:1] + 3, ()),
        (P0[:1], P0[:1], (LOST,)),
        (LOST, P0[:1], (EMPTY,)),
        (P0[:1], LOST, (P0[:1],)),
        (FAR, P1, ()),
        (P0, FAR, (P1,)),
    ],
)
def test_sweeps_without_matches_give_zero_flow(pc0, pc1, others, preset):
    """The others are sweeps before t, and after t+1 if the preset uses any."""
    overrides = {"sectional_view": True, "pixel_sizes": (0.4, 0.2), "max_speed": 5.0} if preset == "paper" else {}
    settings = small(preset, **overrides)
    sweeps, more = ([Sweep(p, pose=pose(1, 2, 0.3)) for p in clouds] for clouds in ((pc0, pc1), others))
    result = flow_as_oracle(Window(*sweeps, tuple(more), tuple(more) if settings.num_future else ()), settings)
    if preset == "paper" and pc1 is not pc0:
        assert_zeros(result, len(pc0))
    assert result.residual_flow.shape == (len(pc0), 3) and not result.residual_flow.any()
    low, high = np.array(RANGE[:3]), np.array(RANGE[3:])
    assert result.is_valid.tolist() == [bool(((p >= low) & (p <= high)).all()) for p in pc0]


@pytest.mark.parametrize("preset", ["default", "paper", "keypoints"])
def test_finite_points_beyond_all_bounds_change_nothing(preset):
    """Their squares are infinite, and their height slices and pixels do not fit an integer."""
    settings = small(preset, point_cloud_range=(*RANGE[:2], -math.inf, *RANGE[3:5], math.inf))
    (window,) = windows_for(settings)
    wild = np.array([[1e300, 0, 0], [0, -1e20, 0], [1.0, 2.0, 1e300], [1e300, 1e300, 1e300]])

    def with_wild(sweep: Sweep) -> Sweep:
        points = np.concatenate([sweep.points.astype(np.float64), wild])
        return replace(sweep, points=points, is_ground=np.concatenate([sweep.is_ground, [False] * 4]))

    result = flow_as_oracle(changed(window, with_wild), settings)
    assert all(torch.isfinite(values.double()).all() for values in vars(result).values() if values is not None)


def test_repeated_sweeps_are_dropped_and_the_others_keep_their_times():
    window = scene(3, num_history=3)
    assert np.isnan(window.pc0.points).any()  # sweeps with NaN points can be equal, too
    copy = replace(window.pc0, points=window.pc0.points.copy(), pose=window.pc0.pose.copy())
    other_pose = replace(window.pc0, pose=window.pch[0].pose)  # same points, other pose: not repeated
    for pch in [(window.pc0, *window.pch), (window.pch[0], copy, window.pch[1]), (other_pose,), (window.pc1,)]:
        flow_as_oracle(replace(window, pch=pch), config(num_history=4))
    once, thrice = (cflow(replace(window, pch=(window.pc0,) * n), config(num_history=3)) for n in (0, 3))
    assert_same_bits(once, thrice)


BOX = (-1.5, -1.0, 2.5, 1.0)


def drive(num_history: int) -> Window:
    """The vehicle drives past a wall at 0.8 m per sweep. The sensor sees its hood and mirrors."""
    rng, sweeps = np.random.default_rng(0), []
    wall = rng.uniform((-6, 3.0, -1.0), (6, 3.2, 1.0), (600, 3))
    for k in range(num_history + 2):
        T_world_ego = pose(-0.8 * k, 0.0, 0.0)
        own = rng.uniform((1.2, -0.8, -1.0), (2.4, 0.8, -0.8), (200, 3))
        points = np.concatenate((wall - T_world_ego[:3, 3], own)).astype(np.float32)
        sweeps.append(Sweep(points, pose=T_world_ego))
    return Window(sweeps[1], sweeps[0], tuple(sweeps[2:]))


@pytest.mark.parametrize("method, num_history", [("dense", 2), ("keypoints", 0), ("verified", 2)])
def test_the_ego_box_removes_returns_of_the_vehicle(method, num_history):
    window, overrides = drive(num_history), {} if method == "keypoints" else {"num_history": num_history}
    without, result = (cflow(window, config(method, ego_box=box, **overrides)) for box in (None, BOX))
    assert without.residual_flow[600:, 0].mean() > 0.6
    assert not result.residual_flow[600:].any() and not result.is_valid[600:].any()
    bare = changed(window, lambda sweep: replace(sweep, points=sweep.points[:600]))
    assert_same_bits(rows_of(result, np.arange(600)), cflow(bare, config(method, **overrides)))


def test_the_ego_box_is_in_the_frame_of_each_sweep_and_includes_its_ends():
    # At t the post is in the box of t, not in the box of t+1, 5 m ahead. NaN is outside every box.
    points = np.array([[2.5, 1.0, 0], [np.nextafter(2.5, 3), 0, 0], [math.nan, 0, 0], [0, 0, 0], [7.5, 0, 0]])
    window = Window(Sweep(points, pose=np.eye(4)), Sweep(points, pose=pose(5.0, 0.0, 0.0)))
    settings = config(ego_box=BOX, point_cloud_range=(-10, -10, -5, 10, 10, 5))
    assert cflow(window, settings).is_valid.tolist() == [False, True, False, False, True]


def test_windows_are_grouped_by_memory(monkeypatch):
    grid, windows = Grid(1.0, RANGE[:3], RANGE[3:]), [scene(seed) for seed in range(5)]

    def sizes(max_memory=None, device=CPU) -> list:
        return [len(group) for group in split_windows(windows, grid, device, 160, max_memory)]

    assert sizes() == [5] and sizes(1) == [1] * 5
    assert sum(sizes(1_000_000)) == 5 and 1 < len(sizes(1_000_000)) < 5
    monkeypatch.setattr(memory, "_BYTES_ON_CPU", 1)
    assert sizes() == [1] * 5 and split_windows([], grid, CPU, 160, None) == []
    monkeypatch.setattr(memory, "_free_memory", lambda device: 2_000_000)
    assert sizes(device=torch.device("cuda")) == sizes(1_000_000)


def test_results_of_a_batch_hold_their_own_rows_alone():
    results = make_model(config("verified", num_history=0), "cpu")([scene(seed) for seed in range(3)])
    for result in results:
        assert result.flow.untyped_storage().nbytes() == 12 * len(result.flow)
        assert result.cluster_id.untyped_storage().nbytes() == 8 * len(result.flow)


def test_arrays_are_on_the_device_of_the_model_whatever_the_default_device_is():
    model, window = make_model(config("verified", num_history=0), "cpu"), scene(0)
    (expected,) = model([window])
    with torch.device("meta"):
        assert_same_bits(model([window])[0], expected)


def test_sweeps_that_are_ignored_need_no_memory(monkeypatch):
    sizes: list[int] = []
    model = make_model(config(num_history=1, max_memory=1.5e6), "cpu")
    motion = model.motion
    monkeypatch.setattr(model, "motion", lambda batch: sizes.append(batch.num_windows) or motion(batch))
    windows = [scene(seed, num_history=4) for seed in range(4)]
    model(windows)
    model([replace(window, pch=window.pch[:1]) for window in windows])
    assert sizes == [2, 2, 2, 2]


FORMS: dict[str, Callable[[np.ndarray], Any]] = {
    "float16": lambda p: p.astype(np.float16),
    "float64": lambda p: p.astype(np.float64),
    "big-endian": lambda p: p.astype(">f8"),
    "columns first": np.asfortranarray,
    "both backwards": lambda p: p[::-1, ::-1].copy()[::-1, ::-1],
    "not aligned": lambda p: np.frombuffer(b"x" + p.tobytes(), np.uint8)[1:].view(p.dtype).reshape(p.shape),
    "read-only": lambda p: np.frombuffer(p.tobytes(), p.dtype).reshape(p.shape),
    "more columns": lambda p: np.pad(p, [(0, 0), (0, 2)], constant_values=np.nan),
    "tensor of bfloat16": lambda p: torch.from_numpy(p).bfloat16(),
    "tensor, transposed": lambda p: torch.from_numpy(np.ascontiguousarray(p.T)).t(),
    "tensor with gradient": lambda p: torch.from_numpy(p.copy()).requires_grad_(),
}


def as_bytes(value: Any) -> bytes:
    value = value.detach().double().numpy() if isinstance(value, torch.Tensor) else value
    return np.ascontiguousarray(value).tobytes()


def coarse(sweep: Sweep) -> Sweep:
    """Points at multiples of 1/16 m within 8 m, where bfloat16 holds multiples of 1/32 m."""
    points = np.nan_to_num(np.asarray(sweep.points), nan=0.0, posinf=0.0, neginf=0.0).clip(-7.9, 7.9)
    return Sweep((np.round(points * 16) / 16).astype(np.float32), sweep.is_ground)


def test_results_do_not_depend_on_the_form_of_arrays():
    settings = small("paper", num_history=1, sectional_view=True)
    plain = changed(windows_for(settings)[0], coarse)
    expected = cflow(plain, settings)
    assert num_moving(expected) > 100
    for form in FORMS.values():
        given = changed(plain, lambda sweep, form=form: replace(sweep, points=form(sweep.points)))
        before = [as_bytes(sweep.points) for sweep in given.sweeps]
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            result = cflow(given, settings)
        assert_same_bits(result, expected)
        assert not result.flow.requires_grad
        assert [as_bytes(sweep.points) for sweep in given.sweeps] == before


def test_results_share_no_memory_with_the_input():
    settings = small("paper")
    given = changed(windows_for(settings)[0], lambda sweep: Sweep(torch.from_numpy(sweep.points), sweep.is_ground))
    result = cflow(given, settings)
    kept = rows_of(result, np.arange(len(result.flow)))
    for sweep in (given.pc0, given.pc1, *given.pch, *given.pcf):
        sweep.points.fill_(7.0)
    assert_same_bits(result, kept)


def highest_resident_kb() -> int:
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
