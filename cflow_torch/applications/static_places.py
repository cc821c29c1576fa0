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
    """
    count = len(sightings)
    cells = [cells_of(each.position) for each in sightings]
    cell, first = np.unique(np.concatenate(cells), return_index=True)
    place = np.concatenate([each.position for each in sightings])[first]
    is_near = np.stack([_is_near(place, each.position) for each in sightings], 1)  # [V, S]
    is_full = np.stack([np.isin(cell, each.static, assume_unique=True) for each in sightings], 1)  # [V, S]
    order = np.arange(count)
    comes = np.where(is_near, order, count).min(1)[:, None]
    leaves = np.where(is_near, order, -1).max(1)[:, None]
    is_before = (order < comes) & (order >= comes - _NEAR)
    is_after = (order > leaves) & (order <= leaves + _NEAR)
    is_static = _is_often(is_full, is_before) & _is_often(is_full, is_after) & (is_before | is_after).any(1)
    return [is_static[np.searchsorted(cell, each)] for each in cells]


def _is_near(place: np.ndarray, points: np.ndarray) -> np.ndarray:
    """(V,) bool: the (V, 3) places are in the box around (P, 3) points along the axes of the world, or nearly."""
    low = points[:, :2].min(0) - _APART
    high = points[:, :2].max(0) + _APART
    return ((place[:, :2] >= low) & (place[:, :2] <= high)).all(1)


def _is_often(is_full: np.ndarray, is_counted: np.ndarray) -> np.ndarray:
    """(V,) bool: a cell is full in enough of the counted sweeps, or none is counted."""
    return (is_full & is_counted).sum(1) >= _SHARE * is_counted.sum(1)
