"""Small seeded windows and comparisons of results, shared by the tests."""

from __future__ import annotations

from dataclasses import fields, replace
from functools import partial
from typing import Any, Iterator

import numpy as np
import pytest
import torch
from kornia import contrib
from oracle import reference_flow

from cflow_torch.config import METHODS, Config, VerifiedConfig
from cflow_torch.estimate import make_model
from cflow_torch.types import FlowResult, Sweep, Window
from cflow_torch.verified.height_slices import HeightSlicedSweeps
from cflow_torch.verified.method import VerifiedFlow
from cflow_torch.verified.refinement import refine
from cflow_torch.verified.selection import Objects
from cflow_torch.windows.bev_grid import Grid
from cflow_torch.windows.collation import Batch, make_batch

RANGE = (-8.0, -7.0, -2.0, 8.0, 7.0, 3.0)


def config(method: str = "dense", **overrides) -> Config:
    """Settings for the small scenes: 0.25 m pixels, 16 m x 14 m; the paper's components are split beyond 5 m."""
    of_method = {} if method == "verified" else {"max_extent": 5.0}
    return METHODS[method](pixel_sizes=(0.25,), point_cloud_range=RANGE, **of_method).replace(**overrides)


def pose(x: float, y: float, yaw: float, z: float = 0.0) -> np.ndarray:
    """(4, 4) float64 `T_world_ego`."""
    cos, sin = np.cos(yaw), np.sin(yaw)
    return np.array([[cos, -sin, 0, x], [sin, cos, 0, y], [0, 0, 1, z], [0, 0, 0, 1.0]])


def box(rng: np.random.Generator, length: float, width: float, height: float, num_points: int) -> np.ndarray:
    """(N, 3) points on the four sides of a box around the origin."""
    side = rng.integers(0, 4, num_points)
    along = rng.uniform(-0.5, 0.5, num_points)
    x = np.where(side < 2, along * length, np.where(side == 2, -length / 2, length / 2))
    y = np.where(side >= 2, along * width, np.where(side == 0, -width / 2, width / 2))
    return np.stack([x, y, rng.uniform(0, height, num_points)], 1)


def ell(rng: np.random.Generator, length: float, width: float, height: float, num_points: int) -> np.ndarray:
    """(N, 3) points on two sides of a box, as a LiDAR sees a car."""
    on_long = rng.random(num_points) < length / (length + width)
    along = rng.uniform(0, 1, num_points)
    x, y = np.where(on_long, along * length, 0.0), np.where(on_long, 0.0, along * width)
    return np.stack([x, y, rng.uniform(0, height, num_points)], 1)


def scene(
    seed: int,
    *,
    num_history: int = 0,
    num_future: int = 0,
    poses: bool = True,
    stamps: bool = False,
    num_objects: int = 9,
    num_points: int = 70,
    rotation: float | None = None,
) -> Window:
    """Boxes, L-shapes and a wall, moving at constant velocity, seen by a sensor that drives and turns (rad per sweep).

    Every sweep has new noise and new points, ground points with a mask, a few points out of range, NaN and infinite
    points. Some objects are missing in some sweeps, so clusters with gaps in their history occur.
    """
    rng = np.random.default_rng(seed)
    objects: list[tuple[str, np.ndarray, float, np.ndarray, np.ndarray]] = []
    for i in range(num_objects):
        size = rng.uniform((0.3, 0.3, 0.5), (4.5, 2.0, 2.0))
        velocity = np.array([*rng.normal(0, 0.35, 2), rng.normal(0, 0.1)]) * (rng.random() < 0.7)
        objects.append(("box" if i % 2 else "ell", size, rng.uniform(-3, 3), rng.uniform((-7, -6), (7, 6)), velocity))
    drawn, speed = rng.normal(0, 0.02), rng.normal(0.5, 0.2)
    rotation = drawn if rotation is None else rotation
    sweeps = []
    for k in [*range(num_history + 2), *range(-1, -1 - num_future, -1)]:  # sweeps t+1, t, t-1, ..., then t+2, t+3, ...
        clouds = []
        for kind, size, yaw, place, velocity in objects:
            if k and rng.random() < 0.12:
                continue
            points = (box if kind == "box" else ell)(rng, *size, num_points=num_points)
            points = points @ pose(0, 0, yaw)[:3, :3].T
            clouds.append(points + [*place, 0.0] - k * velocity)
        wall = np.stack([rng.uniform(-8.5, 8.5, 120), np.full(120, 6.2), rng.uniform(0, 2.9, 120)], 1)
        world = np.concatenate([*clouds, wall])
        world = world + rng.normal(0, 0.02, world.shape)
        ground = np.stack([rng.uniform(-9, 9, 60), rng.uniform(-8, 8, 60), rng.normal(-0.1, 0.02, 60)], 1)
        far = rng.uniform((9, 8, 0), (20, 20, 5), (8, 3))
        is_ground = np.repeat([False, True, False], [len(world), len(ground), len(far)])
        T_world_ego = pose(-k * speed, 0.02 * k, -k * rotation) if poses else np.eye(4)
        points = np.concatenate([world, ground, far]) - T_world_ego[:3, 3]
        points = (points @ T_world_ego[:3, :3]).astype(np.float32)
        points[5, 0], points[11, 2], points[17, 1] = np.nan, np.inf, -np.inf
        order = rng.permutation(len(points))
        stamp = 1_700_000_000_000_000_000 - 100_000_000 * k - int(k != 0) * int(rng.integers(0, 20_000_000))
        sweeps.append(Sweep(points[order], is_ground[order], T_world_ego if poses else None, stamp if stamps else None))
    first_future = num_history + 2
    return Window(sweeps[1], sweeps[0], tuple(sweeps[2:first_future]), tuple(sweeps[first_future:]))


def sweeps_of(windows: list[Window], settings: VerifiedConfig) -> HeightSlicedSweeps:
    """Windows as the verified method sees them."""
    box = settings.point_cloud_range
    grid = Grid(settings.pixel_sizes[-1], box[:3], box[3:])
    batch = make_batch(windows, settings, grid, torch.device("cpu"), 3, settings.min_height is not None)
    return HeightSlicedSweeps.of(batch, grid, settings.min_height)


def reordered(window: Window, seed: int = 0) -> tuple[Window, np.ndarray]:
    """Points of every sweep in another order, and the order of those of pc0."""
    rng = np.random.default_rng(seed)
    orders = [rng.permutation(len(sweep.points)) for sweep in window.sweeps]
    mixed = []
    for sweep, order in zip(window.sweeps, orders):
        columns = {name: getattr(sweep, name) for name in ("points", "is_ground", "point_times")}
        mixed.append(replace(sweep, **{k: None if column is None else column[order] for k, column in columns.items()}))
    return window.with_sweeps(mixed), orders[0]


def rows_of(result: FlowResult, rows: np.ndarray) -> FlowResult:
    values = {f.name: getattr(result, f.name) for f in fields(FlowResult)}
    return FlowResult(**{name: None if v is None else v[torch.from_numpy(rows)] for name, v in values.items()})


def same_bits(a: torch.Tensor, b: torch.Tensor) -> bool:
    """Same shape, dtype and bytes (so -0.0 differs from 0.0)."""
    return a.shape == b.shape and a.dtype == b.dtype and a.cpu().numpy().tobytes() == b.cpu().numpy().tobytes()


def assert_same(a: FlowResult, b: FlowResult, atol: float = 1e-6) -> None:
    """Two results are equal: clusters and validity exactly, flow, score and confidence to `atol` (metres)."""
    for name, left, right in _pairs(a, b):
        differ = (left != right) if not left.is_floating_point() else ~((left - right).abs() <= atol)
        assert not differ.any(), f"{name} differs in {int(differ.sum())} places, first {differ.nonzero()[:3].tolist()}"


def flow_as_oracle(window: Window, settings: Config) -> FlowResult:
    """The result of the method of the settings, which is the oracle's, without the steps that the oracle lacks."""
    with pytest.MonkeyPatch.context() as without:
        without.setattr(VerifiedFlow, "add_overhung", staticmethod(lambda sweeps, components, tree: (sweeps, tree)))
        without.setattr(VerifiedFlow, "refine", staticmethod(partial(refine, slow=_nothing_is_slow)))
        without.setattr(VerifiedFlow, "draw", staticmethod(_draw_as_if_all_was_measured))
        (result,) = make_model(settings)([window])
    assert_same(result, reference_flow(window, settings))
    return result


def _draw_as_if_all_was_measured(batch: Batch, *given: Any) -> HeightSlicedSweeps:
    """The sweeps without their coverage, which the oracle does not know."""
    return HeightSlicedSweeps.of(replace(batch, coverage=None), *given)


def _nothing_is_slow(sweeps: HeightSlicedSweeps, objects: Objects, flow: torch.Tensor, _: object) -> torch.Tensor:
    """No motion, instead of `find_slow`."""
    return torch.zeros_like(flow)


def assert_same_bits(a: FlowResult, b: FlowResult) -> None:
    """Two results are equal to the last bit: the same window, computed in another batch on the same device."""
    for name, left, right in _pairs(a, b):
        assert same_bits(left, right), f"{name} differs in {int((left != right).sum())} places"


def _pairs(a: FlowResult, b: FlowResult) -> Iterator[tuple[str, torch.Tensor, torch.Tensor]]:
    """Name and both values of every field, on the CPU, of the same type and shape."""
    for field in fields(FlowResult):
        left, right = getattr(a, field.name), getattr(b, field.name)
        assert (left is None) == (right is None), field.name
        if left is not None:
            assert left.dtype == right.dtype and left.shape == right.shape, field.name
            yield field.name, left.cpu(), right.cpu()


def assert_zeros(result: FlowResult, num_points: int) -> None:
    """What a window without any motion to find must give: right shapes and types, nothing found, nothing valid."""
    for name in ("residual_flow", "pose_flow", "flow"):
        value = getattr(result, name)
        assert value.shape == (num_points, 3) and value.dtype == torch.float32, name
    assert not result.residual_flow.any()
    assert result.cluster_id.dtype == torch.int64 and result.cluster_id.tolist() == [-1] * num_points
    assert result.score.dtype == torch.float32 and result.score.tolist() == [0.0] * num_points
    assert result.is_valid.dtype == torch.bool and result.is_valid.shape == (num_points,)


needs_kornia_labelling = pytest.mark.skipif(
    not hasattr(contrib, "connected_components_union_find"), reason="kornia < 0.9 has no exact union-find labelling"
)
needs_gpu = pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA GPU")
# For parametrize: every labelling engine, kornia's visibly skipped where it cannot label.
LABELINGS = ("sparse", pytest.param("kornia", marks=needs_kornia_labelling))
