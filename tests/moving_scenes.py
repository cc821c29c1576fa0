"""Small batches of groups that move, as tensors and as the lists that the reference takes."""

from __future__ import annotations

from typing import List, NamedTuple, Tuple

import numpy as np
import torch
from oracle.refinement import Point

from cflow_torch.verified.moving import MovingPoints, moving_points
from cflow_torch.windows.bev_grid import Grid
from cflow_torch.windows.collation import Batch

SLICE = 0.5
LOWER, UPPER = (-3.0, -2.5, -2.0), (3.0, 2.5, 3.0)


class Scene(NamedTuple):
    """A batch and the groups of its occupied pixels.

    Args:
        batch: windows of sweeps.
        place: (points,) int64, flat place of each point, the last one = nowhere.
        pixel_of_place: (Q,) int64, number of the occupied pixel at each place, P = none.
        group: (P,) int64, G = none.
        flow: (G, 2) float64, metres per interval, near the truth.
        grid: the pixels.
    """

    batch: Batch
    place: torch.Tensor
    pixel_of_place: torch.Tensor
    group: torch.Tensor
    flow: torch.Tensor
    grid: Grid

    def moving(self) -> MovingPoints:
        return moving_points(
            self.batch, self.place, self.pixel_of_place, self.group, num_groups=len(self.flow), slice_height=SLICE
        )

    def listed(self) -> List[Point]:
        """The same points for the reference, point by point."""
        points, num_steps = [], self.batch.num_steps
        for i, place in enumerate(self.place.tolist()):
            pixel = int(self.pixel_of_place[place])
            group = len(self.flow) if pixel == len(self.group) else int(self.group[pixel])
            if group < len(self.flow):
                x, y, z = self.batch.positions[:, i].tolist()
                window, step = divmod(int(self.batch.image[i]), num_steps)
                points.append(Point(window, step, int(np.floor(z / SLICE)) % 4, group, x, y))
        return points

    def listed_flow(self) -> List[Tuple[float, float]]:
        return [(x, y) for x, y in self.flow.tolist()]


def moving_scene(
    seed: int,
    num_windows: int = 1,
    num_steps: int = 2,
    pixel_size: float = 0.1,
    snap: float = 0.0,
    num_points: int = 40,
    speed: float = 0.4,
    size: Tuple[float, float] = (0.2, 1.5),
) -> Scene:
    """Objects that translate and turn, seen anew in every sweep, some at the border, some missing in some sweeps.

    Args:
        seed: of everything random; the seeds of windows follow it, so that scenes can be put together.
        num_windows: B.
        num_steps: S.
        pixel_size: metres.
        snap: metres, places are rounded to multiples of it: equal distances and shared voxels; 0 = they are not.
        num_points: of an object and sweep.
        speed: metres per interval, standard deviation.
        size: metres, shortest and longest side of an object.
    """
    grid = Grid(pixel_size, LOWER, UPPER)
    points, images, owners, flows, elapsed = [], [], [], [], []
    for window in range(num_windows):
        rng = np.random.default_rng((seed, window))
        times = np.arange(num_steps) * (1.0 if rng.random() < 0.5 else rng.uniform(0.8, 1.2))
        elapsed.append(times)
        for _ in range(int(rng.integers(1, 5))):
            centre = rng.uniform(LOWER, UPPER)[:2] * 0.9
            sides, angle, velocity = rng.uniform(*size, 2), rng.uniform(-0.1, 0.1), rng.normal(0, speed, 2)
            shape = rng.uniform(-0.5, 0.5, (num_points, 2)) * sides
            gone = rng.random(num_steps) < 0.15
            for step in range(num_steps):
                turn, way = -angle * times[step], centre - velocity * times[step]
                rotation = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
                kept = shape[rng.random(num_points) < (0.0 if gone[step] else 0.8)]
                xy = kept @ rotation.T + way + rng.normal(0, 0.01, kept.shape)
                xy = np.round(xy / snap) * snap if snap else xy
                points.append(np.concatenate([xy, rng.uniform(-1.5, 2.0, (len(xy), 1))], 1))
                images.append(np.full(len(xy), window * num_steps + step))
                owners.append(np.full(len(xy), len(flows) if rng.random() < 0.95 else -1))
            flows.append(velocity + rng.normal(0, 0.04, 2))
    return _as_scene(points, images, owners, flows, elapsed, grid, num_windows, num_steps, seed)


def as_scene(clouds: List[np.ndarray], flow: List[np.ndarray]) -> Scene:
    """One object, (N, 3) points in every sweep, t+1 first, and the motion to start from; one interval apart."""
    owners = [np.zeros(len(cloud), dtype=np.int64) for cloud in clouds]
    images = [np.full(len(cloud), step) for step, cloud in enumerate(clouds)]
    times, grid = [np.arange(len(clouds), dtype=np.float64)], Grid(0.1, LOWER, UPPER)
    return _as_scene(clouds, images, owners, flow, times, grid, 1, len(clouds), 0)


def _as_scene(points, images, owners, flows, elapsed, grid, num_windows, num_steps, seed) -> Scene:
    positions = torch.from_numpy(np.concatenate(points).T.copy())
    image, owner = (torch.from_numpy(np.concatenate(values)) for values in (images, owners))
    inside = grid.contains(positions)
    place = grid.pixel_of_image(positions, image.int(), num_windows * num_steps, inside).long()
    nowhere = num_windows * num_steps * grid.height * grid.width
    pixels, index = torch.unique(place[place < nowhere], return_inverse=True)
    # The first point of a pixel says whose it is.
    group = torch.full_like(pixels, len(flows))
    group[index.flip(0)] = owner[place < nowhere].flip(0)
    group[group < 0] = len(flows)
    of_place = torch.full((nowhere + 1,), len(pixels))
    of_place[pixels] = torch.arange(len(pixels))
    order = torch.from_numpy(np.random.default_rng(seed).permutation(len(place)))
    batch = Batch(
        positions=positions[:, order],
        takes_part=inside[order],
        image=image[order].int(),
        num_newest=0,
        num_windows=num_windows,
        num_steps=num_steps,
        elapsed=torch.from_numpy(np.stack(elapsed)),
        seconds=torch.from_numpy(np.stack(elapsed) * 0.1),
        sources=(),
    )
    flow = torch.from_numpy(np.array(flows).reshape(-1, 2))
    return Scene(batch, place[order], of_place, group, flow, grid)


def one_window(scene: Scene, window: int) -> Tuple[Scene, torch.Tensor]:
    """A window of a scene on its own, and which groups of the scene (K,) it holds; points in the same order."""
    batch, grid = scene.batch, scene.grid
    rows = torch.div(batch.image, batch.num_steps, rounding_mode="floor") == window
    area = batch.num_steps * grid.height * grid.width
    nowhere = scene.pixel_of_place.numel() - 1
    place = torch.where(scene.place < nowhere, scene.place - window * area, area)[rows]
    old = scene.pixel_of_place[window * area : (window + 1) * area]
    here = old < len(scene.group)
    of_place = torch.full((area + 1,), int(here.sum()))
    of_place[:-1][here] = torch.arange(int(here.sum()))
    old_group = scene.group[old[here]]
    groups = torch.unique(old_group[old_group < len(scene.flow)])
    number = torch.full((len(scene.flow) + 1,), len(groups))
    number[groups] = torch.arange(len(groups))
    alone = Batch(
        positions=batch.positions[:, rows],
        takes_part=batch.takes_part[rows],
        image=batch.image[rows] - window * batch.num_steps,
        num_newest=0,
        num_windows=1,
        num_steps=batch.num_steps,
        elapsed=batch.elapsed[window : window + 1],
        seconds=batch.seconds[window : window + 1],
        sources=(),
    )
    return Scene(alone, place, of_place, number[old_group], scene.flow[groups], grid), groups
