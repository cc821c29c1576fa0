"""Sweeps after t+1: which side decides, and the motion of most evidence nearby."""

from __future__ import annotations

from itertools import product
from typing import List, NamedTuple, Sequence

import numpy as np

from cflow_torch.config import VerifiedConfig
from oracle.height_slices import Pixel, SlicedSweeps, Vector
from oracle.paired_test import best_candidate, count_wins, evidence_of
from oracle.sweeps import PointMotion


class Estimate(NamedTuple):
    """The motion of every point of sweep t by some sweeps.

    Attributes:
        motion: what is found.
        shown: of each point, how many sweeps beside t and t+1 show its object; 0 if it has none.
        num_ids: one more than the largest id of a point of t+1 or t.
    """

    motion: PointMotion
    shown: List[int]
    num_ids: int


def by_side(before: Estimate, after: Estimate) -> PointMotion:
    """Each point goes by the sweeps after t+1 if they show its object more than twice as often as those before t.

    Convention: ids of the second go on after those of the first.
    """
    (first, shown, num_ids), (second, shown_after, _) = before, after
    chosen = [(second if more > 2 * less else first) for less, more in zip(shown, shown_after)]
    ids_after = second.cluster_id + (second.cluster_id >= 0) * num_ids
    flow, ids, scores, trust = (
        np.array([values[motion is second][i] for i, motion in enumerate(chosen)])
        for values in (
            (first.flow[0], second.flow[0]),
            (first.cluster_id, ids_after),
            (first.score, second.score),
            (first.confidence, second.confidence),
        )
    )
    return PointMotion([flow.reshape(-1, 3)], ids.astype(np.int64), scores, trust)


def best_nearby(sweeps: SlicedSweeps, members: Sequence[Pixel], motion: Vector, config: VerifiedConfig) -> Vector:
    """The motion of most evidence within two pixels of that of an object; of equals the nearest, then the first."""
    offsets = sorted(product(range(-2, 3), repeat=2), key=lambda offset: offset[0] ** 2 + offset[1] ** 2)
    found = [(motion[0] + dy, motion[1] + dx) for dy, dx in offsets]
    if not any(motion):
        return motion
    best, most = best_candidate(
        [evidence_of(*count_wins(sweeps, members, one), config.significance) for one in found], found
    )
    return best if most > 0 else motion
