"""The paired test of a motion: what is found again under it and not without it, against the reverse (McNemar's)."""

from __future__ import annotations

import math
from typing import Iterable, Sequence

from oracle.height_slices import Pixel, SlicedSweeps, Vector, count, shift


def count_wins(
    sweeps: SlicedSweeps, members: Iterable[Pixel], motion: Vector, is_near: bool = False
) -> tuple[int, int]:
    """Paired counts of a component's motion against "static", over all sweeps and in both directions.

    Returns:
        won: slices of the component that another sweep has where the motion takes them, and not where they are.
        lost: slices that it has where they are, and not where the motion takes them.

    Convention: every sweep is compared with t+1, and t+1 with every other sweep, all of whose pixels count, not the
        component's alone. Of a motion that takes a pixel two pixels or more, in rows or in columns, "not" means that
        none of the 3 x 3 pixels there has the slice. A pixel outside the image has nothing around it either. With
        `is_near`, "where" means any of the 3 x 3 pixels as well.
    """
    won = lost = 0
    for m, r, c in members:
        for other in sweeps.others(m):
            dy, dx = shift(motion, sweeps.elapsed[m] - sweeps.elapsed[other])
            own = sweeps.at(m, r, c)
            here, there = own & sweeps.at(other, r, c), own & sweeps.at(other, r + dy, c + dx)
            near_here, near_there = here, there
            if max(abs(dy), abs(dx)) >= 2:
                near_here, near_there = own & sweeps.around(other, r, c), own & sweeps.around(other, r + dy, c + dx)
            if is_near:
                here, there = near_here, near_there
            won += count(there & ~near_here)
            lost += count(here & ~near_there)
    return won, lost


def count_in_place(sweeps: SlicedSweeps, members: Iterable[Pixel]) -> int:
    """Slices of a component that another sweep has where they are, whatever the motion."""
    return sum(count(sweeps.at(m, r, c) & sweeps.at(o, r, c)) for m, r, c in members for o in sweeps.others(m))


def evidence_of(won: int, lost: int, z: float) -> int:
    """What a motion explains beyond noise, in sixteenths of a slice: (won - lost) - z sqrt(won + lost), at least 0.

    The difference of two counts of independent events has the variance won + lost if both are equally likely.
    """
    return max(math.floor(16 * ((won - lost) - z * math.sqrt(won + lost))), 0)


def best_candidate(evidence: Sequence[int], candidates: Sequence[Vector]) -> tuple[Vector, int]:
    """The candidate with most evidence, and how much; no motion if none has any. Ties: the first."""
    best = evidence.index(max(evidence))
    return (candidates[best], evidence[best]) if evidence[best] > 0 else ((0.0, 0.0), 0)
