"""The paired test of a motion: what is found again under it and not without it, against the reverse (McNemar's)."""

from __future__ import annotations

import math
from itertools import product
from typing import Sequence, Tuple

from oracle.height_slices import Pixel, SlicedSweeps, Vector, count


def count_wins(sweeps: SlicedSweeps, members: Sequence[Pixel], motion: Vector) -> Tuple[int, int]:
    """Paired counts of a component's motion against standing still, over all sweeps and in both directions.

    Returns:
        won: slices of the component that another sweep has where the motion takes them, and not where they are.
        lost: slices that it has where they are, and not where the motion takes them.

    A motion of two pixels or more, in rows or in columns of that look, finds a slice "not" in a place only if none of
    the 3 x 3 pixels there has it.

    Convention: every sweep before t+1 is compared with t+1, and t+1 with every sweep before, all of whose pixels count,
        not the component's alone. A pixel is taken by floor(k f + 0.5) pixels, k the elapsed time, negative from t+1
        into the past. A place outside the image has nothing, nor has any of the pixels around it.
    """
    won = lost = 0
    for m, r, c in members:
        for other in [0] if m > 0 else range(1, len(sweeps.images)):
            k = sweeps.elapsed[m] - sweeps.elapsed[other]
            dy, dx = (math.floor(f * k + 0.5) for f in motion)
            own = sweeps.at(m, r, c)
            here, there = own & sweeps.at(other, r, c), own & sweeps.at(other, r + dy, c + dx)
            near_here, near_there = here, there
            if max(abs(dy), abs(dx)) >= 2:
                near_here, near_there = around(sweeps, other, r, c), around(sweeps, other, r + dy, c + dx)
            won += count(there & ~near_here)
            lost += count(here & ~near_there)
    return won, lost


def around(sweeps: SlicedSweeps, m: int, row: int, col: int) -> int:
    """The slices that any of the 3 x 3 pixels around a place has; none if the place lies outside the image."""
    slices, (height, width) = 0, sweeps.images[m].shape
    if not (0 <= row < height and 0 <= col < width):
        return 0
    for r, c in product((row - 1, row, row + 1), (col - 1, col, col + 1)):
        slices |= sweeps.at(m, r, c)
    return slices


def evidence_of(won: int, lost: int, z: float) -> int:
    """What a motion explains beyond noise, in sixteenths of a slice: (won - lost) - z sqrt(won + lost), at least 0.

    The difference of two counts of independent events has the variance won + lost if both are equally likely.
    """
    return max(math.floor(16 * ((won - lost) - z * math.sqrt(won + lost))), 0)


def best_candidate(evidence: Sequence[int], candidates: Sequence[Vector]) -> Tuple[Vector, int]:
    """The candidate with most evidence, and how much; of equals the first; no motion if none has any."""
    best = evidence.index(max(evidence))
    return (candidates[best], evidence[best]) if evidence[best] > 0 else ((0.0, 0.0), 0)


def is_found_where_it_stands(sweeps: SlicedSweeps, members: Sequence[Pixel], motion: Vector) -> bool:
    """Whether a component has not moved as a whole: of its slices in the looks that the motion takes four pixels or
    more, in rows or in columns, 97 per cent are within a pixel of where they stand."""
    total = found = 0
    for m, r, c in members if any(motion) else ():
        for other in [0] if m > 0 else range(1, len(sweeps.images)):
            k = sweeps.elapsed[m] - sweeps.elapsed[other]
            if max(abs(math.floor(f * k + 0.5)) for f in motion) >= 4:
                own = sweeps.at(m, r, c)
                total += count(own)
                found += count(own & around(sweeps, other, r, c))
    return total > 0 and 100 * found >= 97 * total
