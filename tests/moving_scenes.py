"""Sweeps of the verified method, from images or from objects that move, and the same as the oracle takes it."""

from __future__ import annotations

from typing import NamedTuple, Sequence

import numpy as np
import torch
from oracle.height_slices import NUM_SLICES, SLICE_HEIGHT, SlicedSweeps, Vector
from scenes import pose

from cflow_torch.config import VerifiedConfig
from cflow_torch.ops.groups import Groups
from cflow_torch.verified.height_slices import HeightSlicedSweeps
from cflow_torch.verified.selection import Objects, number_objects
from cflow_torch.verified.voxel_centroids import ObjectPoints, points_of_objects
from cflow_torch.windows.bev_grid import Grid
from cflow_torch.windows.collation import Batch

LOWER, UPPER = (-3.0, -2.5, -2.0), (3.0, 2.5, 3.0)


class Scene(NamedTuple):
    """Sweeps of B windows and the objects of their occupied pixels.

    Args:
        sweeps: drawn.
        objects: G of them, of all windows.
        flow: (G, 2) float64, x and y, metres per interval, near the truth.
    """

    sweeps: HeightSlicedSweeps
    objects: Objects
    flow: torch.Tensor

    def points(self) -> ObjectPoints:
        """Of all objects."""
        every = torch.ones(len(self.flow), dtype=torch.bool)
        return points_of_objects(self.sweeps, self.objects, every)

    def windows(self) -> list[tuple[SlicedSweeps, np.ndarray, list[Vector]]]:
        """Sweeps, object of each pixel and flow of each object for the oracle, window by window; objects from 0."""
        result, pixels = [], self.sweeps.pixels
        for window in range(self.sweeps.batch.num_windows):
            sweeps = for_oracle(self.sweeps, window)
            numbers = (self.objects.window == window).nonzero()[:, 0].tolist()
            of_pixel = self.objects.by_object.of_item[pixels.window == window].tolist()
            object_of = np.array([numbers.index(own) if own in numbers else -1 for own in of_pixel], dtype=int)
            result.append((sweeps, object_of, [(x, y) for x, y in self.flow[numbers].tolist()]))
        return result


def for_oracle(sweeps: HeightSlicedSweeps, window: int) -> SlicedSweeps:
    """One window of some sweeps; sweeps that it lacks are left out."""
    batch, grid = sweeps.batch, sweeps.grid
    elapsed, seconds = sweeps.elapsed[window].tolist(), batch.seconds[window].tolist()
    steps = [step for step, k in enumerate(elapsed) if step == 0 or k != 0]
    is_drawn = sweeps.points.is_member[: batch.image.numel()]
    rows = [is_drawn & (batch.image == window * sweeps.num_steps + step) for step in steps]
    clouds = [batch.positions.T[mine].numpy() for mine in rows]
    config = VerifiedConfig(pixel_sizes=(grid.pixel_size,), point_cloud_range=(*grid.lower, *grid.upper))
    return SlicedSweeps(clouds, [elapsed[step] for step in steps], [seconds[step] for step in steps], config)


def from_images(images: np.ndarray, pixel_size: float = 0.25, elapsed: np.ndarray | None = None) -> HeightSlicedSweeps:
    """Sweeps with a point in the middle of every slice that is set.

    Args:
        images: (B, S, H, W) uint8, bits of slices.
        pixel_size: metres.
        elapsed: (B, S) float64, intervals to t+1; None = 0, 1, 2, ...
    """
    num_windows, num_steps, height, width = images.shape
    grid = Grid(pixel_size, (0.0, 0.0, -1.0), ((width - 0.5) * pixel_size, (height - 0.5) * pixel_size, 3.0))
    assert (grid.height, grid.width) == (height, width)
    times = np.tile(np.arange(num_steps, dtype=np.float64), (num_windows, 1)) if elapsed is None else elapsed
    window, step, row, col, part = np.nonzero(images[..., None] >> np.arange(NUM_SLICES, dtype=np.uint8) & 1)
    places = np.stack(((col + 0.5) * pixel_size, (row + 0.5) * pixel_size, (part + 0.5) * SLICE_HEIGHT))
    image = torch.from_numpy(window * num_steps + step)
    return HeightSlicedSweeps.of(_batch(torch.from_numpy(places), image, torch.from_numpy(times)), grid)


def moving_scene(seeds: Sequence[int], num_steps: int = 2, pixel_size: float = 0.1, snap: float = 0.0) -> Scene:
    """Objects that translate and turn, seen anew in every sweep, some at the border, some missing in some sweeps.

    Args:
        seeds: one per window, which depends on nothing else.
        num_steps: sweeps, t+1 first.
        pixel_size: metres.
        snap: metres, places are rounded to multiples of it: equal distances and shared voxels; 0 = they are not.
    """
    clouds: list[list[np.ndarray]] = []
    numbers: list[list[np.ndarray]] = []
    flows: list[np.ndarray] = []
    elapsed = []
    for seed in seeds:
        rng = np.random.default_rng(seed)
        times = np.arange(num_steps) * (1.0 if rng.random() < 0.5 else rng.uniform(0.8, 1.2))
        times[:2] = 0.0, 1.0
        elapsed.append(times)
        parts: list[list[np.ndarray]] = [[] for _ in range(num_steps)]
        of_parts: list[list[np.ndarray]] = [[] for _ in range(num_steps)]
        for _ in range(int(rng.integers(1, 5))):
            centre = rng.uniform(LOWER, UPPER)[:2] * 0.9
            sides, angle, velocity = rng.uniform(0.2, 1.5, 2), rng.uniform(-0.1, 0.1), rng.normal(0, 0.4, 2)
            shape = rng.uniform(-0.5, 0.5, (40, 2)) * sides
            gone = rng.random(num_steps) < 0.15
            for step in range(num_steps):
                rotation = pose(0.0, 0.0, -angle * times[step])[:2, :2]
                kept = shape[rng.random(40) < (0.0 if gone[step] else 0.8)]
                xy = kept @ rotation.T + (centre - velocity * times[step]) + rng.normal(0, 0.01, kept.shape)
                xy = np.round(xy / snap) * snap if snap else xy
                parts[step].append(np.concatenate([xy, rng.uniform(-1.5, 2.0, (len(xy), 1))], 1))
                of_parts[step].append(np.full(len(xy), len(flows) if rng.random() < 0.95 else -1))
            flows.append(velocity + rng.normal(0, 0.04, 2))
        clouds.append([np.concatenate(of_step) for of_step in parts])
        numbers.append([np.concatenate(of_step) for of_step in of_parts])
    return _draw(clouds, numbers, flows, elapsed, pixel_size)


def one_object(clouds: Sequence[np.ndarray], flow: Sequence[float], elapsed: Sequence[float] | None = None) -> Scene:
    """One object, (N, 3) points in every sweep, t+1 first, and the motion to start from; sweeps `elapsed` before t+1,
    None = 0, 1, 2, ... intervals."""
    times = np.arange(len(clouds)) if elapsed is None else np.array(elapsed)
    numbers = [np.zeros(len(cloud), dtype=np.int64) for cloud in clouds]
    return _draw([list(clouds)], [numbers], [np.array(flow)], [times.astype(np.float64)], 0.1)


def _draw(
    clouds: list[list[np.ndarray]],
    numbers: list[list[np.ndarray]],
    flows: list[np.ndarray],
    elapsed: list[np.ndarray],
    pixel_size: float,
) -> Scene:
    grid, num_steps = Grid(pixel_size, LOWER, UPPER), len(elapsed[0])
    positions = torch.from_numpy(np.concatenate([cloud for window in clouds for cloud in window]).T.copy())
    number_of_point = np.concatenate([of_sweep for window in numbers for of_sweep in window])
    sizes = [len(cloud) for window in clouds for cloud in window]
    image = torch.arange(len(sizes)).repeat_interleave(torch.tensor(sizes))
    inside = grid.contains(positions)
    batch = _batch(positions[:, inside], image[inside], torch.from_numpy(np.stack(elapsed)))
    assert batch.num_steps == num_steps
    sweeps = HeightSlicedSweeps.of(batch, grid)
    # The first point of a pixel says whose it is. Objects are numbered by their first pixel, so by window.
    _, first_point = np.unique(sweeps.points.of_item.numpy(), return_index=True)
    of_pixel = number_of_point[inside.numpy()][first_point]
    name = Groups(torch.from_numpy(np.where(of_pixel < 0, len(flows), of_pixel)), len(flows))
    objects = number_objects(sweeps, name, len(flows))
    flow = np.array(flows, dtype=np.float64).reshape(-1, 2)[objects.by_node.of_item.numpy()]
    return Scene(sweeps, objects, torch.from_numpy(flow))


def _batch(positions: torch.Tensor, image: torch.Tensor, elapsed: torch.Tensor) -> Batch:
    return Batch(
        positions=positions,
        is_active=torch.ones(image.numel(), dtype=torch.bool),
        has_result=torch.ones(image.numel(), dtype=torch.bool),
        image=image.int(),
        num_newest=0,
        num_windows=elapsed.shape[0],
        num_steps=elapsed.shape[1],
        has_pairs=bool(((elapsed != 0).sum(1) == 1).any()),
        elapsed=elapsed,
        seconds=elapsed * 0.1,
        origin=torch.zeros((*elapsed.shape, 3), dtype=torch.float64),
        rows=(),
        pose_flow=torch.zeros(0, 3),
    )
