"""What is certainly dynamic, and how far the flow of a point can be trusted: counts -> a bin -> a probability."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any, Sequence

import cflow_torch
from oracle.aperture import principal_axis
from oracle.height_slices import NEAR, Cell, Pixel, SlicedSweeps, Vector, count, shift
from oracle.paired_test import count_in_place, count_wins
from oracle.registration import RigidMotion

FILE = Path(cflow_torch.__file__).parent / "verified" / "confidence.json"
TABLE: dict[str, Any] = json.loads(FILE.read_text(encoding="utf-8"))
DISPLACEMENT, BLOCK = 0.4, 1.6  # metres per interval; metres


def margin(sweeps: SlicedSweeps, members: Sequence[Pixel], rigid: RigidMotion) -> tuple[float, bool]:
    """What an object's motion loses by being displaced by 0.4 m per interval, the best of four displacements, in
    standard deviations of what it finds; and whether it is dynamic. 0 for a static object.

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
    z = gain / math.sqrt(surplus + stays) if gain > 0 else 0.0
    is_line = principal_axis([(r, c) for m, r, c in members if m == 0], sweeps.size) is not None
    is_fast = rigid.flow[0] * rigid.flow[0] + rigid.flow[1] * rigid.flow[1] >= (2 * DISPLACEMENT) ** 2
    return z, z >= 1 or ((gain > 0 or is_fast) and surplus > stays and not is_line)


def motion_of_pixel(sweeps: SlicedSweeps, pixel: Pixel, rigid: RigidMotion) -> Vector:
    """(y, x) pixels per interval, of one pixel of an object: that of the centre, if the rotation adds less than a
    pixel in y and in x."""
    size, since_t = sweeps.size, sweeps.elapsed[1] - sweeps.elapsed[pixel[0]]
    y, x = rigid.flow[1] / size, rigid.flow[0] / size
    at_x, at_y = middle_of(sweeps, pixel)
    own = rigid.flow_at(at_x - rigid.flow[0] * since_t, at_y - rigid.flow[1] * since_t)
    own_x, own_y = (value / size for value in own)
    return (own_y, own_x) if max(abs(own_y - y), abs(own_x - x)) >= 1 else (y, x)


def middle_of(sweeps: SlicedSweeps, pixel: Pixel) -> Vector:
    """(x, y), metres."""
    _, r, c = pixel
    return (c + 0.5) * sweeps.size + sweeps.lower[0], (r + 0.5) * sweeps.size + sweeps.lower[1]


def confidences(
    sweeps: SlicedSweeps, object_of: dict[Pixel, int], motions: Sequence[Vector], margins: Sequence[float]
) -> dict[Pixel, float]:
    """Probability of every pixel of t.

    Args:
        sweeps: the window.
        object_of: object of each pixel that belongs to one.
        motions: (y, x) of each object at its centre, pixels per interval.
        margins: of each object.

    The bins of the table: left out; unlinked, by how many slices lie in the block around; static, by the share of them
    that is found; static beside something that moves; moving, by the margin, for pairs near and far, then with history.
    """
    at_t = [pixel for pixel in sweeps.pixels() if pixel[0] == 1]
    motion_of = {pixel: motions[object_of[pixel]] if pixel in object_of else (0.0, 0.0) for pixel in at_t}
    blocks = neighbourhoods(sweeps, motion_of)
    crowd, share, bounds = TABLE["crowd"], TABLE["share"], TABLE["margin"]
    static = 1 + len(crowd) + 1
    beside = static + len(share) + 1
    result = {}
    for pixel in at_t:
        _, r, c = pixel
        total, found = blocks[block_of(sweeps, r, c)]
        if pixel not in object_of:
            index = 1 + sum(total >= bound for bound in crowd)
        elif any(motion_of[pixel]):
            x, y = middle_of(sweeps, pixel)
            is_far = x * x + y * y >= TABLE["far"] ** 2
            kind = 2 * (len(sweeps.images) > 2) + is_far
            margin_bin = sum(margins[object_of[pixel]] >= bound for bound in bounds)
            index = beside + 1 + kind * (1 + len(bounds)) + margin_bin
        elif any(any(motion_of.get((1, r + dy, c + dx), ())) for dy, dx in NEAR):
            index = beside
        else:
            index = static + sum(10 * found >= bound * total for bound in share)
        result[pixel] = TABLE["probabilities"][index]
    return result


def neighbourhoods(sweeps: SlicedSweeps, motion: dict[Pixel, Vector]) -> dict[Cell, tuple[int, int]]:
    """Of each block of 1.6 m with pixels of t: slices, and how many of them t+1 has where they move to."""
    sums: dict[Cell, tuple[int, int]] = {}
    for (m, r, c), of_pixel in motion.items():
        dy, dx = shift(of_pixel, sweeps.elapsed[1])
        total, found = sums.get(block_of(sweeps, r, c), (0, 0))
        own = sweeps.at(m, r, c)
        sums[block_of(sweeps, r, c)] = total + count(own), found + count(own & sweeps.at(0, r + dy, c + dx))
    return sums


def block_of(sweeps: SlicedSweeps, row: int, col: int) -> Cell:
    side = max(1, round(BLOCK / sweeps.size))
    return row // side, col // side
