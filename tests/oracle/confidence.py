"""How far the flow of a point can be trusted: counts -> a bin -> a probability (docs/verified.md)."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any, Dict, List, Sequence, Tuple

import cflow_torch
from oracle.aperture import principal_axis
from oracle.height_slices import Pixel, SlicedSweeps, Vector, count
from oracle.paired_test import count_wins

FILE = Path(cflow_torch.__file__).parent / "verified" / "confidence.json"
TABLE: Dict[str, Any] = json.loads(FILE.read_text(encoding="utf-8"))
DISPLACEMENT = 0.4  # metres per interval
BLOCK = 1.6  # metres


def confidences(
    sweeps: SlicedSweeps, object_of: Dict[Pixel, int], flows: Sequence[Vector], doubt: Dict[Pixel, float]
) -> Tuple[Dict[Pixel, float], float]:
    """Probability of every pixel of t, and that of a point whose pixel was left out.

    Args:
        sweeps: the window.
        object_of: object of each pixel that belongs to one.
        flows: (x, y) metres per interval of each object at its centre.
        doubt: how much speaks for a local motion around a pixel; 0 where it is not named.
    """
    size = sweeps.pixel_size
    motions = [(y / size, x / size) for x, y in flows]
    members: List[List[Pixel]] = [[] for _ in flows]
    for pixel, owner in object_of.items():
        members[owner].append(pixel)
    margins = {i: margin(sweeps, members[i], motion)[0] for i, motion in enumerate(motions) if any(motion)}
    at_t = [pixel for pixel in sweeps.pixels() if pixel[0] == 1]
    blocks = neighbourhoods(sweeps, at_t, {p: motions[object_of[p]] for p in at_t if p in object_of})
    result = {}
    for pixel in at_t:
        _, r, c = pixel
        number, found = blocks[_block(sweeps, r, c)]
        owner = object_of.get(pixel)
        if owner is None:
            place = table_place("unlinked", sum(number >= bound for bound in TABLE["crowd"]))
        elif owner not in margins:
            doubts = sum(doubt.get(pixel, 0.0) >= bound for bound in TABLE["doubt"])
            place = (
                table_place("doubt", doubts - 1)
                if doubts
                else table_place("still", sum(10 * found >= bound * number for bound in TABLE["share"]))
            )
        else:
            x, y = (c + 0.5) * size + sweeps.lower[0], (r + 0.5) * size + sweeps.lower[1]
            is_far = x * x + y * y >= TABLE["far"] ** 2
            place = table_place("moving", margins[owner], len(sweeps.images) > 2, is_far)
        result[pixel] = TABLE["probabilities"][place]
    return result, TABLE["probabilities"][table_place("left out", 0)]


def neighbourhoods(
    sweeps: SlicedSweeps, pixels: Sequence[Pixel], motion: Dict[Pixel, Vector]
) -> Dict[Tuple[int, int], Tuple[int, int]]:
    """Of each block of 1.6 m with pixels of t: slices, and how many of them t+1 has where they move to."""
    sums: Dict[Tuple[int, int], Tuple[int, int]] = {}
    for m, r, c in pixels:
        dy, dx = (math.floor(f * sweeps.elapsed[1] + 0.5) for f in motion.get((m, r, c), (0.0, 0.0)))
        number, found = sums.get(_block(sweeps, r, c), (0, 0))
        own = sweeps.at(m, r, c)
        sums[_block(sweeps, r, c)] = number + count(own), found + count(own & sweeps.at(0, r + dy, c + dx))
    return sums


def margin(sweeps: SlicedSweeps, members: Sequence[Pixel], motion: Vector) -> Tuple[int, bool]:
    """Bin of what an object's motion loses by being displaced by 0.4 m per interval, the best of four ways; and whether
    it moves at all.

    In standard deviations of what it finds: what it has more than standing still, and what is found where it stands.
    0 for what stands still. What loses at least one standard deviation moves; of the rest that which loses something,
    is found less where it stands than where it moves to, and is no line.
    """
    if not any(motion):
        return 0, False
    off = DISPLACEMENT / sweeps.pixel_size
    counts = [
        count_wins(sweeps, members, (motion[0] + y, motion[1] + x))
        for y, x in ((0.0, 0.0), (off, 0.0), (-off, 0.0), (0.0, off), (0.0, -off))
    ]
    surplus, *displaced = (won - lost for won, lost in counts)
    gain, stays = surplus - max(displaced), found_where_it_stands(sweeps, members)
    number = sum(gain > 0 and gain**2 >= bound**2 * (surplus + stays) for bound in TABLE["margin"])
    is_line, _, _ = principal_axis([(r, c) for m, r, c in members if m == 0], sweeps.pixel_size)
    moves = gain > 0 and (gain**2 >= surplus + stays or (surplus > stays and not is_line))
    return number, moves


def found_where_it_stands(sweeps: SlicedSweeps, members: Sequence[Pixel]) -> int:
    """Slices of an object that another sweep has at the same place: m looks at t+1 and t+1 at m."""
    return sum(
        count(sweeps.at(m, r, c) & sweeps.at(other, r, c))
        for m, r, c in members
        for other in ([0] if m > 0 else range(1, len(sweeps.images)))
    )


def table_place(kind: str, bin_of_kind: int, has_history: bool = False, is_far: bool = False) -> int:
    """Place in the table, whose kinds are "left out", "unlinked", "still", "doubt", "moving" (which has four parts)."""
    sizes: List[int] = [1, 1 + len(TABLE["crowd"]), 1 + len(TABLE["share"]), len(TABLE["doubt"])]
    start = sum(sizes[: ["left out", "unlinked", "still", "doubt", "moving"].index(kind)])
    return start + bin_of_kind + (2 * has_history + is_far) * (1 + len(TABLE["margin"]))


def _block(sweeps: SlicedSweeps, row: int, col: int) -> Tuple[int, int]:
    side = max(1, round(BLOCK / sweeps.pixel_size))
    return row // side, col // side
