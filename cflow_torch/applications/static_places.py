"""Take static points out of tracks: where a track was, what was there before it came and after it left is not of it."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

_CELL = (0.3, 0.3, 0.9)  # metres; the beams hit an object at different heights in each sweep
_APART = 0.5  # metres around the box of a track that may still belong to it
_NEAR = 5  # sweeps before a track comes, and after it has left
_SHARE = 0.3  # of these sweeps in which a static cell holds points


def cells_of(position: np.ndarray) -> np.ndarray:
    """Number the cells of (N, 3) positions in the world, metres; (N,) int64.

    bits 63 ... 40   39 ... 16   15 ... 0
         x           y           z         of the cell, counted from the origin, negative ones from the top
    """
    x, y, z = np.floor(position / _CELL).astype(np.int64).T
    return ((x & 0xFFFFFF) << 40) | ((y & 0xFFFFFF) << 16) | (z & 0xFFFF)


class Sighting(NamedTuple):
    """What is seen of a track in one sweep."""

    position: np.ndarray  # (P, 3) float64 metres in the world
    static: np.ndarray  # (C,) int64 cells of the points without a track, each once


def static_points(sightings: list[Sighting]) -> list[np.ndarray]:
    """Tell which points of a track are static: where they are, there are points also while the track is elsewhere.

    A wall is there in the sweeps before the track comes near, and in those after it has left. An object that starts is
    not there any more, one that stops was not there before. If only one side can be seen, because the track begins or
    ends here, it decides. If the track is never elsewhere, no point is static.

    Args:
        sightings: of a track, in the order of time.

    Returns:
        (P,) bool for each sighting.

    Cost: memory for the points, not for each cell in each sweep.
    """
    cells = [cells_of(each.position) for each in sightings]
    cell, first = np.unique(np.concatenate(cells), return_index=True)
    place = np.concatenate([each.position for each in sightings])[first]
    comes, leaves = _visits(place, sightings)
    full_before, num_before = _count_full(cell, comes - _NEAR, sightings)
    full_after, num_after = _count_full(cell, leaves + 1, sightings)
    is_seen_elsewhere = num_before + num_after > 0
    is_static = (full_before >= _SHARE * num_before) & (full_after >= _SHARE * num_after) & is_seen_elsewhere
    return [is_static[np.searchsorted(cell, each)] for each in cells]


def _visits(place: np.ndarray, sightings: list[Sighting]) -> tuple[np.ndarray, np.ndarray]:
    """(V,) int64 each: the first and the last sighting whose points have the (V, 3) places in the box around them.

    The box is along the axes of the world, and a little larger.
    """
    comes = np.full(len(place), len(sightings))
    leaves = np.full(len(place), -1)
    by_x = np.argsort(place[:, 0])
    x = place[by_x, 0]
    for number, each in enumerate(sightings):
        low = each.position[:, :2].min(0) - _APART
        high = each.position[:, :2].max(0) + _APART
        rows = by_x[np.searchsorted(x, low[0]) : np.searchsorted(x, high[0], side="right")]
        rows = rows[(place[rows, 1] >= low[1]) & (place[rows, 1] <= high[1])]
        comes[rows] = np.minimum(comes[rows], number)
        leaves[rows] = number
    return comes, leaves


def _count_full(cell: np.ndarray, first: np.ndarray, sightings: list[Sighting]) -> tuple[np.ndarray, np.ndarray]:
    """Count the sightings that have points without a track in each of V cells, among the `_NEAR` from `first` on.

    Returns this number and that of all sightings there, (V,) int64 each.
    """
    num_full = np.zeros(len(cell), np.int64)
    num_all = np.zeros(len(cell), np.int64)
    by_first = np.argsort(first)
    ascending = first[by_first]
    for number, each in enumerate(sightings):
        begin, end = np.searchsorted(ascending, [number - _NEAR, number], side="right")
        rows = by_first[begin:end]
        num_full[rows] += np.isin(cell[rows], each.static, assume_unique=True)
        num_all[rows] += 1
    return num_full, num_all
