"""Divide the tracks of people who walk together, whose points the flow takes for one object."""

from __future__ import annotations

from typing import Sequence

import numpy as np
import torch
from torch import Tensor

from cflow_torch.applications.association import turned
from cflow_torch.applications.missed_sweeps import SweepTracks
from cflow_torch.applications.moving_groups import MIN_POINTS
from cflow_torch.applications.track_table import Table
from cflow_torch.applications.whole_boxes import RUNNING, quantiles_of_axes
from cflow_torch.ops.labeling import connected_components
from cflow_torch.ops.nearest import nearest_set_pixel
from cflow_torch.types import CENTRE

_REACH = 3.0  # metres from the middle of the group; strays are farther
_CELL = 0.15  # metres
_GAP = 0.1  # in the gap between two people, a cell has at most this share of the points of the fullest cell
_LEAST_SHARE = 0.1  # of the points of the group that a person has
_LEAST_DISTANCE = 0.4  # metres between the middles of two people
_LEAST_HEIGHT, _MOST_HEIGHT = 0.5, 2.2  # metres that nine tenths of the points of a person span; walls are higher
_MOST_WIDTH = 1.0  # metres that they span along and across
_LEAST_SWEEPS = 0.5  # share of the sweeps of the group in which a person is seen


def divide_people(sweeps: Sequence[SweepTracks], table: Table) -> bool:
    """Give each person of a group a track. `table` has the boxes of the groups. Returns whether a group was divided."""
    next_id = 1 + max((int(each.points.id.max(initial=-1)) for each in sweeps), default=-1)
    is_divided = False
    for number in np.unique(table["id"]).tolist():
        rows = np.flatnonzero(table["id"] == number)
        if np.median(np.hypot(table["vx"][rows], table["vy"][rows])) >= RUNNING:
            continue
        row_of_sweep = dict(zip(table["sweep"][rows].tolist(), rows.tolist()))
        seen = [each for each in sweeps if each.points.sweep in row_of_sweep and number in each.points.id]
        person = _people_of_track([_in_box(each, table, row_of_sweep[each.points.sweep]) for each in seen])
        others = max(int(each.max()) for each in person)
        has_strays = any(int(each.min()) < 0 for each in person)
        is_on_foot = table["class"][rows[0]] in ("pedestrian", "cyclist")
        if others > 0 and not has_strays or is_on_foot and has_strays:
            ids = np.array([number, *range(next_id, next_id + others), -1])  # of person 0, 1, ...; of nobody
            for each, of_points in zip(seen, person):
                each.divide(number, ids[of_points.numpy()])
            next_id += others
            is_divided = True
    return is_divided


def _in_box(sweep: SweepTracks, table: Table, row: int) -> Tensor:
    """Return the points of a track along the axes of its box, (P, 3) metres from its centre."""
    position, _ = sweep.points.of_track(int(table["id"][row]))
    offset = position - [table[axis][row] for axis in CENTRE]
    return turned(torch.from_numpy(offset), torch.full((len(offset),), -table["heading"][row], dtype=torch.float64))


def _people_of_track(points: Sequence[Tensor]) -> Sequence[Tensor]:
    """Tell the people apart in the points of each sweep, see `people`."""
    counts = [len(each) for each in points]
    sweep = torch.arange(len(counts)).repeat_interleave(torch.tensor(counts))
    return people(torch.cat(list(points)), sweep).split(counts)


def people(points: Tensor, sweep: Tensor) -> Tensor:
    """Tell the people of a group apart by the gaps between them.

    Seen from the group, people who walk together stay in place. Over many sweeps, gaps between them remain.

    Args:
        points: (P, 3) metres in all sweeps, along the axes of the box of the group, from its centre.
        sweep: (P,) int64 sweep of each point, from 0.

    Returns:
        (P,) int64 person of each point, 0 for the one with most points; -1 = it belongs to nobody. All 0 if there is
        one person.
    """
    part = _parts(points[:, :2])
    count = int(part.max()) + 1
    low, middle, high = quantiles_of_axes(points, part, count, 0.05, 0.5, 0.95)  # (count, 3) each
    length, width, height = (high - low).unbind(1)
    if count == 1 or height.min() < _LEAST_HEIGHT or torch.pdist(middle[:, :2]).min() < _LEAST_DISTANCE:
        return torch.zeros_like(part)
    num_sweeps = torch.stack([(torch.bincount(sweep[part == k]) >= MIN_POINTS).sum() for k in range(count)])
    is_person = num_sweeps >= _LEAST_SWEEPS * num_sweeps.max()
    is_person &= (height <= _MOST_HEIGHT) & (torch.maximum(length, width) <= _MOST_WIDTH)
    return torch.where(is_person, is_person.cumsum(0) - 1, -1)[part] if is_person.any() else torch.zeros_like(part)


def _parts(points: Tensor) -> Tensor:
    """Number the parts of a group of (P, 2) points between which there are gaps, (P,) int64, the largest part first."""
    side = int(2 * _REACH / _CELL) + 1
    cell = ((points.clamp(-_REACH, _REACH) + _REACH) / _CELL).long()
    pixel = cell[:, 0] * side + cell[:, 1]
    count = torch.bincount(pixel, minlength=side**2)
    is_full = count > _GAP * count.max()
    full = is_full.nonzero()[:, 0]
    component = torch.full_like(count, -1)
    component[full] = connected_components(is_full.view(1, side, side), full)

    component_of_point = component[nearest_set_pixel(is_full.view(1, side, side), pixel)]
    is_large = torch.bincount(component_of_point) >= _LEAST_SHARE * len(points)
    # Points of small components go to the nearest large one.
    is_kept = is_full & is_large[component]
    component_of_point = component[nearest_set_pixel(is_kept.view(1, side, side), pixel)]
    _, part, size = torch.unique(component_of_point, return_inverse=True, return_counts=True)
    return size.argsort(descending=True, stable=True).argsort()[part]
