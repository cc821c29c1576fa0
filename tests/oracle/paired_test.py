"""The paired test of a motion: what is found again under it and not without it, against the reverse (McNemar's)."""

from __future__ import annotations

import math

import numpy as np

from oracle.height_slices import COUNT, NUM_SLICES, SlicedSweeps, Vector, value_at


def count_wins(
    sweeps: SlicedSweeps,
    members: np.ndarray,
    motion: Vector | np.ndarray,
    is_near: bool = False,
    is_wide: np.ndarray | None = None,
) -> np.ndarray:
    """Paired counts of a component's motion against "static", over all sweeps and in both directions.

    Args:
        members: (K,) pixels of the component.
        motion: (y, x) pixels per interval, of all or (K, 2) of each.
        is_wide: (K,) bool; None = all are if any of them has a reach of more than one pixel.

    Returns:
        (2, K) of each pixel. Won: slices that another sweep has where the motion takes them, and not where they are.
        Lost: slices that it has where they are, and not where the motion takes them.

    Convention: every sweep is compared with t+1, and t+1 with every other sweep, all of whose pixels count, not the
        component's alone. Of a motion that takes a pixel two pixels or more, in rows or in columns, and of a wide
        pixel, "not" means that no pixel within the reach there has the slice. A pixel outside the image has nothing
        around it either. With `is_near`, "where" means any pixel within the reach as well.
    """
    won, lost = np.zeros((2, len(members)), dtype=int)
    step, row, col = sweeps.pixels[members].T
    if is_wide is None:
        is_wide = are_wide(sweeps, members).any()
    for other, elapsed in enumerate(sweeps.elapsed):
        own = np.where((step == 0) != (other == 0), sweeps.slices[members], 0)
        intervals = (sweeps.elapsed[step] - elapsed)[:, None]
        dy, dx = np.floor(np.array(motion) * intervals + 0.5).astype(int).T
        here, there = sweeps.both[other, row, col], value_at(sweeps.both[other], row + dy, col + dx)
        is_far = (np.maximum(np.abs(dy), np.abs(dx)) >= 2) | is_wide
        near_here, near_there = (np.where(is_far, slices >> NUM_SLICES, slices) for slices in (here, there))
        if is_near:
            here, there = near_here, near_there
        won += COUNT[own & there & ~near_here]
        lost += COUNT[own & here & ~near_there]
    return np.stack((won, lost))


def are_wide(sweeps: SlicedSweeps, members: np.ndarray) -> np.ndarray:
    """(K,) bool: the pixels that have a reach of more than one pixel."""
    _, row, col = sweeps.pixels[members].T
    return sweeps.reach[row, col] > 1


def found_in_place(sweeps: SlicedSweeps, members: np.ndarray, images: np.ndarray) -> np.ndarray:
    """Slices of the pixels of a component that another sweep has in place, whatever the motion: of those of other
    sweeps in t+1, and of those of t+1 in all other sweeps; and how many are compared, (2, 2)."""
    result = np.zeros((2, 2), dtype=int)
    step, row, col = sweeps.pixels[members].T
    for other, image in enumerate(images):
        own = np.where((step == 0) != (other == 0), sweeps.slices[members], 0)
        result[int(other > 0)] += COUNT[own & image[row, col]].sum(), COUNT[own].sum()
    return result


def evidence_of(won: int, lost: int, z: float) -> int:
    """What a motion explains beyond noise, in sixteenths of a slice: (won - lost) - z sqrt(won + lost), at least 0.

    The difference of two counts of independent events has the variance won + lost if both are equally likely.
    """
    return max(math.floor(16 * ((won - lost) - z * math.sqrt(won + lost))), 0)
