"""Local motion: groups of pixels that move within what stands, found by small velocities tried everywhere at once."""

from __future__ import annotations

import math
from collections import defaultdict
from itertools import product
from typing import Dict, List, NamedTuple, Optional, Sequence, Set, Tuple

import numpy as np

from cflow_torch.config import VerifiedConfig
from oracle.height_slices import NUM_SLICES, SLICE_HEIGHT, Pixel, SlicedSweeps, Vector, count
from oracle.paired_test import evidence_of
from oracle.pixels import project_bev
from oracle.visibility import RangeImage, sensor_height

STEP, REACH, FASTEST = 0.1, 3, 0.25  # metres per interval, steps, metres per interval
SIDE = 0.3  # metres, of a cell
FINER, SUSPECT_Z = 2, 2
SEED_Z, LEAST_WON, GROUP_Z, UPRIGHT = 6, 16, 4.0, 3

Cell = Tuple[int, int]


class Look(NamedTuple):
    """A pixel that looks into another sweep.

    Attributes:
        pixel: which.
        other: the sweep.
        own: slices of the pixel.
        found: those of them that the other sweep has where the pixel stands.
        here: those, and those that the other sweep cannot see there.
    """

    pixel: Pixel
    other: int
    own: int
    found: int
    here: int


def find_local_motion(
    sweeps: SlicedSweeps,
    object_of: Dict[Pixel, int],
    motions: Sequence[Vector],
    points: Sequence[np.ndarray],
    seen: Sequence[np.ndarray],
    origins: Sequence[Sequence[float]],
    config: VerifiedConfig,
) -> Tuple[Dict[Pixel, int], List[Vector], Dict[Pixel, float]]:
    """Groups of pixels that move within objects that stand.

    Args:
        sweeps: the window; with fewer than three sweeps nothing is found.
        object_of: object of each pixel that belongs to one.
        motions: of each object (y, x), finest pixels per sweep interval.
        points: of each sweep (N, 3) float64, metres, frame of t+1, the points that are drawn.
        seen: the same with those that were left out as they stand out of the ground by little.
        origins: of each sweep (x, y, z), metres, frame of t+1, origin of its ego frame.
        config: for the finest pixels.

    Returns:
        The objects with the groups as objects of their own, numbered by their first pixel; the motions of all; and z of
        the best velocity in the cell of each pixel, where there is one.

    Convention: see the functions below. Pixels of no object stand as well.
    """
    if len(sweeps.images) < 3:
        return object_of, list(motions), {}
    looks = look(sweeps, object_of, motions, points, seen, origins, config)
    coarse = best_velocity(sweeps, looks, small_velocities(sweeps.pixel_size), origins[1])
    suspects = {cell for cell, (_, z) in coarse.items() if z >= SUSPECT_Z}
    velocities = small_velocities(sweeps.pixel_size, FINER)
    best = best_velocity(sweeps, looks, velocities, origins[1], suspects) if suspects else {}
    side = max(1, round(SIDE / sweeps.pixel_size))
    doubt = {(m, r, c): best.get((r // side, c // side), (0, 0.0))[1] for m, r, c in sweeps.pixels()}
    best = {cell: found for cell, found in best.items() if found[1] >= SEED_Z}
    label: Dict[Pixel, Tuple[int, int]] = {pixel: (0, own) for pixel, own in object_of.items()}
    for number, ((_, index), members) in enumerate(sorted(groups(sweeps, looks, velocities, best).items())):
        pairs = [wins(sweeps, one, velocities[index]) for one in looks if one.pixel in members]
        won, lost = (sum(values) for values in zip(*pairs))
        slices = 0
        for m, r, c in members:
            slices |= sweeps.at(m, r, c)
        if evidence_of(won, lost, GROUP_Z) > 0 and count(slices) >= UPRIGHT:
            label.update(dict.fromkeys(members, (1 + index, number)))
    ordered = list(dict.fromkeys(label[pixel] for pixel in sweeps.pixels() if pixel in label))
    moved = [motions[own] if kind == 0 else velocities[kind - 1] for kind, own in ordered]
    number_of = {one: number for number, one in enumerate(ordered)}
    return {pixel: number_of[label[pixel]] for pixel in sweeps.pixels() if pixel in label}, moved, doubt


def small_velocities(pixel_size: float, parts: int = 1) -> List[Vector]:
    """(y, x), finest pixels per interval, in raster order: parts of steps of 0.1 m, at most three long, not none."""
    reach, step = REACH * parts, STEP / parts / pixel_size
    steps = [(dy, dx) for dy, dx in product(range(-reach, reach + 1), repeat=2) if 0 < dy**2 + dx**2 <= reach**2]
    return [(dy * step, dx * step) for dy, dx in steps]


def look(
    sweeps: SlicedSweeps,
    object_of: Dict[Pixel, int],
    motions: Sequence[Vector],
    points: Sequence[np.ndarray],
    seen: Sequence[np.ndarray],
    origins: Sequence[Sequence[float]],
    config: VerifiedConfig,
) -> List[Look]:
    """The looks of all pixels that stand: into t+1, those of t+1 into every other sweep. Arguments as above.

    Convention: a slice is where the centre of its pixel is, in the middle of the lowest slice of that number that is
        not below the lowest point of the pixel.
    """
    size, (x0, y0) = sweeps.pixel_size, sweeps.lower
    lowest: Dict[Pixel, float] = {}
    for m, cloud in enumerate(points):
        for (r, c), z in zip(project_bev(cloud, config, size).tolist(), cloud[:, 2].tolist()):
            lowest[m, r, c] = min(z, lowest.get((m, r, c), math.inf))
    height = sensor_height(seen[0])
    images = [RangeImage(cloud, origin, height) for cloud, origin in zip(seen, origins)]
    result = []
    for m, r, c in sweeps.pixels():
        if (m, r, c) in object_of and any(motions[object_of[m, r, c]]):
            continue
        first = math.floor(lowest[m, r, c] / SLICE_HEIGHT)
        for other in [0] if m > 0 else range(1, len(sweeps.images)):
            own = sweeps.at(m, r, c)
            found = here = own & sweeps.at(other, r, c)
            for index in range(NUM_SLICES):
                z = (first + (index - first) % NUM_SLICES + 0.5) * SLICE_HEIGHT
                place = (c + 0.5) * size + x0, (r + 0.5) * size + y0, z
                if (own & ~found) >> index & 1 and images[other].hides(place):
                    here |= 1 << index
            result.append(Look((m, r, c), other, own, found, here))
    return result


def wins(sweeps: SlicedSweeps, one: Look, velocity: Vector) -> Tuple[int, int]:
    """Slices that a look wins and loses by a velocity: what cannot be seen where the pixel stands is not won."""
    m, r, c = one.pixel
    dy, dx = _shift(velocity, sweeps.elapsed[m] - sweeps.elapsed[one.other])
    there = one.own & sweeps.at(one.other, r + dy, c + dx)
    return count(there & ~one.here), count(one.found & ~there)


def best_velocity(
    sweeps: SlicedSweeps,
    looks: Sequence[Look],
    velocities: Sequence[Vector],
    origin: Sequence[float],
    asked: Optional[Set[Cell]] = None,
) -> Dict[Cell, Tuple[int, float]]:
    """Velocity, by its number, and z of the cells that have one.

    Convention: what a look wins and loses counts in the 3 x 3 cells around the one where its pixel is at t+1. The
        velocity of largest z, the first of equals, must be believed. Of the cells around, the first of largest z in
        raster order decides. Cells outside the image do not count.

    Args:
        origin: of the ego frame of t.
        asked: cells that may have one; None = all.
    """
    size = sweeps.pixel_size
    side = max(1, round(SIDE / size))
    height, width = (-(-length // side) for length in sweeps.images[0].shape)
    sensor = [-at / (sweeps.elapsed[1] * size) for at in (origin[1], origin[0])]
    own: Dict[Cell, Tuple[int, float]] = {}
    for index, velocity in enumerate(velocities):
        won: Dict[Cell, int] = defaultdict(int)
        lost: Dict[Cell, int] = defaultdict(int)
        for one in looks:
            r, c = cell_at(sweeps, one.pixel, velocity, side)
            counts = wins(sweeps, one, velocity)
            for cell in product(range(r - 1, r + 2), range(c - 1, c + 2)) if any(counts) else ():
                won[cell] += counts[0]
                lost[cell] += counts[1]
        for cell in won:
            surplus, noise = won[cell] - lost[cell], won[cell] + lost[cell]
            may = 0 <= cell[0] < height and 0 <= cell[1] < width and (asked is None or cell in asked)
            if may and won[cell] >= LEAST_WON and surplus > 0:
                z = surplus / math.sqrt(noise)
                if z > own.get(cell, (0, 0.0))[1]:
                    own[cell] = index, z

    def is_believed(velocity: Vector) -> bool:
        off = math.hypot(velocity[0] - sensor[0], velocity[1] - sensor[1])
        stands = math.hypot(*sensor) * size < STEP / 2
        return (off > 1.05 * STEP / size or stands) and math.hypot(*velocity) * size < FASTEST

    own = {cell: found for cell, found in own.items() if is_believed(velocities[found[0]])}
    result: Dict[Cell, Tuple[int, float]] = {}
    for r, c in {(r + dr, c + dc) for r, c in own for dr, dc in product((-1, 0, 1), repeat=2)}:
        if 0 <= r < height and 0 <= c < width:
            around = [own.get(cell, (0, 0.0)) for cell in product(range(r - 1, r + 2), range(c - 1, c + 2))]
            result[r, c] = max(around, key=lambda found: found[1])
    return result


def groups(
    sweeps: SlicedSweeps, looks: Sequence[Look], velocities: Sequence[Vector], best: Dict[Cell, Tuple[int, float]]
) -> Dict[Tuple[Cell, int], Set[Pixel]]:
    """Pixels that win by the velocity of the cell that it takes them to; by the first cell of their component of cells
    and their velocity.

    Convention: a pixel wins if more is won than lost by looks of its velocity whose pixels are within one of it at t+1.
        Of several velocities that of largest z takes it, the first of equals.
    """
    side = max(1, round(SIDE / sweeps.pixel_size))
    first_cell = components(set(best))
    strength: Dict[Pixel, float] = {}
    taken: Dict[Pixel, Tuple[Cell, int]] = {}
    for index in sorted({number for number, _ in best.values()}):
        velocity = velocities[index]
        gain: Dict[Cell, int] = defaultdict(int)
        places: Dict[Pixel, Tuple[Cell, Cell]] = {}
        for one in looks:
            cell = cell_at(sweeps, one.pixel, velocity, side)
            if best.get(cell, (-1, 0.0))[0] == index:
                place = cell_at(sweeps, one.pixel, velocity, 1)
                won, lost = wins(sweeps, one, velocity)
                gain[place] += won - lost
                places[one.pixel] = cell, place
        for pixel, (cell, (r, c)) in places.items():
            around = sum(gain.get(at, 0) for at in product(range(r - 1, r + 2), range(c - 1, c + 2)))
            if around > 0 and best[cell][1] > strength.get(pixel, 0.0):
                strength[pixel], taken[pixel] = best[cell][1], (first_cell[cell], index)
    result: Dict[Tuple[Cell, int], Set[Pixel]] = defaultdict(set)
    for pixel, name in taken.items():
        result[name].add(pixel)
    return dict(result)


def components(cells: Set[Cell]) -> Dict[Cell, Cell]:
    """Of each cell the first one, in raster order, of its component; cells that touch at a corner are joined."""
    first: Dict[Cell, Cell] = {}
    for seed in sorted(cells):
        open_cells = [] if seed in first else [seed]
        first.setdefault(seed, seed)
        while open_cells:
            r, c = open_cells.pop()
            for cell in product(range(r - 1, r + 2), range(c - 1, c + 2)):
                if cell in cells and cell not in first:
                    first[cell] = seed
                    open_cells.append(cell)
    return first


def cell_at(sweeps: SlicedSweeps, pixel: Pixel, velocity: Vector, side: int) -> Cell:
    """The cell of some pixels a side where a velocity takes a pixel at t+1."""
    m, r, c = pixel
    dy, dx = _shift(velocity, sweeps.elapsed[m])
    return (r + dy) // side, (c + dx) // side


def _shift(velocity: Vector, k: float) -> Tuple[int, int]:
    """Whole pixels in k sweep intervals."""
    return math.floor(k * velocity[0] + 0.5), math.floor(k * velocity[1] + 0.5)
