"""What moves beyond doubt, and how far the flow of a point can be trusted: counts -> a bin -> a probability."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any, Sequence

import cflow_torch
from oracle.aperture import principal_axis
from oracle.height_slices import Cell, Pixel, SlicedSweeps, Vector, count, shift
from oracle.paired_test import count_in_place, count_wins
from oracle.registration import RigidMotion

FILE = Path(cflow_torch.__file__).parent / "verified" / "confidence.json"
TABLE: dict[str, Any] = json.loads(FILE.read_text(encoding="utf-8"))
DISPLACEMENT, BLOCK = 0.4, 1.6  # metres per interval; metres
KINDS = ("left out", "unlinked", "static", "beside", "moving")  # in the order of the table; the last has four parts


def margin(sweeps: SlicedSweeps, members: Sequence[Pixel], rigid: RigidMotion) -> tuple[float, bool]:
    """What an object's motion loses by being displaced by 0.4 m per interval, the best of four ways, in standard
    deviations of what it finds; and whether it is dynamic. 0 for what is static.

    An object that loses at least one standard deviation is dynamic. So is one that is not a line and is found less in
    place than where it moves to, if it loses something or moves at least twice as far as it is displaced.
    """
    off = DISPLACEMENT / sweeps.size
    surpluses = [0] * 5
    for pixel in members:
        y, x = motion_of_pixel(sweeps, pixel, rigid)
        for i, (dy, dx) in enumerate([(0.0, 0.0), (off, 0.0), (-off, 0.0), (0.0, off), (0.0, -off)]):
            won, lost = count_wins(sweeps, [pixel], (y + dy, x + dx))
            surpluses[i] += won - lost
    surplus, *displaced = surpluses
    gain, stays = surplus - max(displaced), count_in_place(sweeps, members)
    if not any(rigid.flow):
        return 0.0, False
    is_line, _, _ = principal_axis([(r, c) for m, r, c in members if m == 0], sweeps.size)
    z = gain / math.sqrt(surplus + stays) if gain > 0 else 0.0
    is_fast = rigid.flow[0] * rigid.flow[0] + rigid.flow[1] * rigid.flow[1] >= (2 * DISPLACEMENT) ** 2
    return z, z >= 1 or ((gain > 0 or is_fast) and surplus > stays and not is_line)


def motion_of_pixel(sweeps: SlicedSweeps, pixel: Pixel, rigid: RigidMotion) -> Vector:
    """(y, x) pixels per interval, of one pixel of an object: that of the centre, if the rotation adds less than a
    pixel in y and in x."""
    (m, r, c), size, lower = pixel, sweeps.size, sweeps.lower
    y, x = rigid.flow[1] / size, rigid.flow[0] / size
    since_t = sweeps.elapsed[1] - sweeps.elapsed[m]
    centre = (c + 0.5) * size + lower[0], (r + 0.5) * size + lower[1]
    at_t = centre[0] - rigid.flow[0] * since_t, centre[1] - rigid.flow[1] * since_t
    own_x, own_y = (value / size for value in rigid.flow_at(*at_t))
    return (own_y, own_x) if max(abs(own_y - y), abs(own_x - x)) >= 1 else (y, x)


def confidences(
    sweeps: SlicedSweeps, object_of: dict[Pixel, int], motions: Sequence[Vector], margins: Sequence[float]
) -> dict[Pixel, float]:
    """Probability of every pixel of t.

    Args:
        sweeps: the window.
        object_of: object of each pixel that belongs to one.
        motions: (y, x) of each object at its centre, pixels per interval.
        margins: of each object.
    """
    at_t = [pixel for pixel in sweeps.pixels() if pixel[0] == 1]
    blocks = neighbourhoods(sweeps, {p: motions[object_of[p]] if p in object_of else (0.0, 0.0) for p in at_t})
    result = {}
    for pixel in at_t:
        _, r, c = pixel
        total, found = blocks[_block(sweeps, r, c)]
        number = object_of.get(pixel)
        if number is None:
            index = first_bin("unlinked") + _bin(total, TABLE["crowd"])
        elif any(motions[number]):
            x, y = (c + 0.5) * sweeps.size + sweeps.lower[0], (r + 0.5) * sweeps.size + sweeps.lower[1]
            kind = 2 * (len(sweeps.images) > 2) + (x * x + y * y >= TABLE["far"] ** 2)
            index = first_bin("moving") + kind * (1 + len(TABLE["margin"])) + _bin(margins[number], TABLE["margin"])
        else:
            near = [(1, r + dy, c + dx) for dy in (-1, 0, 1) for dx in (-1, 0, 1)]
            is_beside = any(q in object_of and any(motions[object_of[q]]) for q in near)
            share = sum(10 * found >= bound * total for bound in TABLE["share"])
            index = first_bin("beside") if is_beside else first_bin("static") + share
        result[pixel] = TABLE["probabilities"][index]
    return result


def neighbourhoods(sweeps: SlicedSweeps, motion: dict[Pixel, Vector]) -> dict[Cell, tuple[int, int]]:
    """Of each block of 1.6 m with pixels of t: slices, and how many of them t+1 has where they move to."""
    sums: dict[Cell, tuple[int, int]] = {}
    for (m, r, c), of_pixel in motion.items():
        dy, dx = shift(of_pixel, sweeps.elapsed[1])
        number, found = sums.get(_block(sweeps, r, c), (0, 0))
        own = sweeps.at(m, r, c)
        sums[_block(sweeps, r, c)] = number + count(own), found + count(own & sweeps.at(0, r + dy, c + dx))
    return sums


def first_bin(kind: str) -> int:
    """Where a kind begins in the table."""
    sizes = [1, 1 + len(TABLE["crowd"]), 1 + len(TABLE["share"]), 1]
    return sum(sizes[: KINDS.index(kind)])


def _bin(value: float, bounds: Sequence[float]) -> int:
    return sum(value >= bound for bound in bounds)


def _block(sweeps: SlicedSweeps, row: int, col: int) -> Cell:
    side = max(1, round(BLOCK / sweeps.size))
    return row // side, col // side
