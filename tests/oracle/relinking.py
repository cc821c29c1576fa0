"""Relinking by plain loops: things of single sweeps that are linked to nothing, found again in other sweeps."""

from __future__ import annotations

import math
from itertools import product
from typing import Dict, List, NamedTuple, Sequence, Set, Tuple

from cflow_torch.config import VerifiedConfig
from oracle.height_slices import Pixel, SlicedSweeps, Vector, count
from oracle.local_motion import components
from oracle.paired_test import around


class Thing(NamedTuple):
    """Pixels of one sweep, in raster order, and the first and last corner of their box."""

    pixels: List[Pixel]
    first: Tuple[int, int]
    last: Tuple[int, int]


def relink(
    sweeps: SlicedSweeps, object_of: Dict[Pixel, int], motions: Sequence[Vector], config: VerifiedConfig
) -> Tuple[Dict[Pixel, int], List[Vector]]:
    """Things of t that are found again in two of the sweeps t+1, t-1, t-2 become objects of their own.

    Returns:
        The object of each pixel, objects numbered by their first pixel; their motions.
    """
    lone = {pixel for pixel in sweeps.pixels() if pixel not in object_of and pixel[0] < 4}
    rest = sweeps._replace(images=[image.copy() for image in sweeps.images])
    for m, r, c in sweeps.pixels():
        if (m, r, c) not in lone:
            rest.images[m][r, c] = 0
    things = [things_of(rest, m) for m in range(min(4, len(sweeps.images)))]
    owner, found_motions = dict(object_of), list(motions)
    claims: Dict[Pixel, int] = {}
    for thing in things[1]:
        best, most = None, 0
        for velocity in candidates(thing, things, sweeps, config):
            found = [found_in(rest, thing, velocity, m) for m in (0, 2, 3) if m < len(sweeps.images)]
            num_slices = sum(count(rest.at(*pixel)) for pixel in thing.pixels)
            if sum(10 * number >= 6 * num_slices for number in found) >= 2 and sum(found) > most:
                best, most = velocity, sum(found)
        if best is None:
            continue
        for pixel in claimed(rest, thing, best):
            if pixel in lone:
                claims.setdefault(pixel, len(found_motions))
        found_motions.append(best)
    owner.update(claims)
    order = list(dict.fromkeys(owner[pixel] for pixel in sweeps.pixels() if pixel in owner))
    return {pixel: order.index(i) for pixel, i in owner.items()}, [found_motions[i] for i in order]


def things_of(rest: SlicedSweeps, m: int) -> List[Thing]:
    """The things of a sweep, in the order of their first pixels."""
    side = max(1, round(0.8 / rest.pixel_size))
    pixels = [pixel for pixel in rest.pixels() if pixel[0] == m]
    cells: Set[Tuple[int, int]] = {(r // side, c // side) for _, r, c in pixels}
    component = components(cells)
    members: Dict[Tuple[int, int], List[Pixel]] = {}
    for _, r, c in pixels:
        members.setdefault(component[r // side, c // side], []).append((m, r, c))
    things = []
    for own in members.values():
        rows, cols = [r for _, r, _ in own], [c for _, _, c in own]
        thing = Thing(own, (min(rows), min(cols)), (max(rows), max(cols)))
        longest = 1 + max(last - first for first, last in zip(thing.first, thing.last))
        if sum(count(rest.at(*pixel)) for pixel in own) >= 4 and longest * rest.pixel_size <= 12.0:
            things.append(thing)
    return things


def candidates(
    thing: Thing, things: Sequence[Sequence[Thing]], sweeps: SlicedSweeps, config: VerifiedConfig
) -> List[Vector]:
    """Velocities, finest pixels per interval, that take corners or the middle of a thing to those of another one."""
    fastest = math.inf
    if config.max_speed is not None:
        fastest = config.max_speed * config.sweep_interval / sweeps.pixel_size
    result = []
    for m in (0, 2):
        for other in things[m] if m < len(things) else []:
            k = sweeps.elapsed[1] - sweeps.elapsed[m]
            first = [there - here for here, there in zip(thing.first, other.first)]
            last = [there - here for here, there in zip(thing.last, other.last)]
            for y, x in (first, last, [(a + b) / 2 for a, b in zip(first, last)]):
                if (y / k) ** 2 + (x / k) ** 2 <= fastest**2:
                    result.append((y / k, x / k))
    return result


def shift(sweeps: SlicedSweeps, velocity: Vector, m: int) -> Tuple[int, int]:
    """Whole pixels from t to sweep m."""
    k = sweeps.elapsed[1] - sweeps.elapsed[m]
    return math.floor(velocity[0] * k + 0.5), math.floor(velocity[1] * k + 0.5)


def found_in(rest: SlicedSweeps, thing: Thing, velocity: Vector, m: int) -> int:
    """Slices of a thing that another sweep has within a pixel of where a velocity takes them."""
    dy, dx = shift(rest, velocity, m)
    return sum(count(rest.at(1, r, c) & around(rest, m, r + dy, c + dx)) for _, r, c in thing.pixels)


def claimed(rest: SlicedSweeps, thing: Thing, velocity: Vector) -> Set[Pixel]:
    """Pixels of a thing, and those within a pixel of where the velocity takes them in the other sweeps."""
    result = set(thing.pixels)
    for m in (m for m in (0, 2, 3) if m < len(rest.images)):
        dy, dx = shift(rest, velocity, m)
        for _, r, c in thing.pixels:
            result |= {(m, r + dy + i, c + dx + j) for i, j in product((-1, 0, 1), repeat=2)}
    return result
