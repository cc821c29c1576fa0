"""Trams and trains: long components whose ends are both seen to travel."""

from __future__ import annotations

from typing import List, Sequence

from oracle.aperture import principal_axis
from oracle.height_slices import Pixel, SlicedSweeps


def ends_travel(sweeps: SlicedSweeps, members: Sequence[Pixel]) -> bool:
    """Whether both ends of a component have gone the same way along it since the sweep that is farthest from t+1.

    Convention: at least 1.2 m, alike to a tenth of their sum; and the pixels at t+1 have two height slices on average.
    Ends are those of the projections on the principal axis of its pixels at t+1. Of sweeps equally far the first.
    """
    newest = [(r, c) for m, r, c in members if m == 0]
    _, axis_y, axis_x = principal_axis(newest, sweeps.pixel_size)
    farthest = max(range(len(sweeps.images)), key=lambda m: abs(sweeps.elapsed[m]))
    oldest = [(r, c) for m, r, c in members if m == farthest]
    if not oldest:
        return False
    slices = sum(bin(int(sweeps.images[0][r, c]) & 15).count("1") for r, c in newest)

    def places(pixels: Sequence[Sequence[int]]) -> List[float]:
        return [r * axis_y + c * axis_x for r, c in pixels]

    low, high = (end(places(newest)) - end(places(oldest)) for end in (min, max))
    both, least = low + high, 2 * 1.2 / sweeps.pixel_size
    is_far = both * both >= (least * least) * (axis_y * axis_y + axis_x * axis_x)
    return slices >= 2 * len(newest) and is_far and abs(low - high) <= 0.1 * abs(both)
