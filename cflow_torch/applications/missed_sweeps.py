"""Find moving objects in the sweeps just before their flow begins, and in short gaps of their tracks."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from cflow_torch.applications.association import MIN_STOPPED_SHARE, box_of_point, enclosing_boxes
from cflow_torch.applications.completion import TrackedPoints
from cflow_torch.applications.moving_groups import MIN_POINTS, pose_of
from cflow_torch.applications.static_places import cells_of
from cflow_torch.applications.track_table import Table
from cflow_torch.transforms import transform_points
from cflow_torch.types import FlowResult, Window, as_numpy

_MARGIN = 0.2  # metres, added to length, width and height of a box


class FreePoints(NamedTuple):
    """The valid points of one sweep that belong to no track, sorted by x."""

    row: np.ndarray  # (F,) int64 rows of the sweep
    position: np.ndarray  # (F, 3) float64 metres in the world

    @classmethod
    def of(cls, sweeps: Window, result: FlowResult, points: TrackedPoints) -> FreePoints:
        """Collect them from sweep t of a window."""
        cloud = as_numpy(sweeps.pc0.points)[:, :3]
        is_free = as_numpy(result.is_valid) & np.isfinite(cloud).all(axis=1)
        is_free[points.row] = False
        row = np.flatnonzero(is_free)
        position = transform_points(cloud[row], pose_of(sweeps.pc0))
        order = np.argsort(position[:, 0])
        return cls(row[order], position[order])

    def inside(self, centre: Tensor, size: Tensor, heading: Tensor) -> np.ndarray:
        """(M,) int64 indices of the points in a box, see `box_of_point`."""
        reach = float(size[0, :2].norm()) / 2
        x = float(centre[0, 0])
        first, last = np.searchsorted(self.position[:, 0], [x - reach, x + reach])
        box = box_of_point(torch.from_numpy(self.position[first:last]), centre, size, heading)
        return first + np.flatnonzero(box.numpy() == 0)

    def without(self, index: np.ndarray) -> FreePoints:
        """Remove points by their indices."""
        return FreePoints(np.delete(self.row, index), np.delete(self.position, index, axis=0))


class SweepTracks:
    """The tracks of one sweep of a log: their rows of the table, and their points.

    Args:
        table: rows of this sweep, sorted by id.
        points: the points of the tracks.
        timestamp_ns: time stamp of the sweep in its log.
        free: the other points; None = no track is looked for.

    Attributes:
        static: cells of the points without a track, ascending.
    """

    def __init__(self, table: Table, points: TrackedPoints, timestamp_ns: int, free: FreePoints | None) -> None:
        self.points = points
        self.free = free
        self.static = np.zeros(0, np.int64) if free is None else np.unique(cells_of(free.position))
        self._where = {"sweep": points.sweep, "timestamp_ns": timestamp_ns}
        self.table = {**table, **{name: np.full(len(table["id"]), value) for name, value in self._where.items()}}

    def find(self, later: SweepTracks, row: int) -> bool:
        """Look for the track in a row of a later sweep where its flow there says that it was.

        We add the track to this sweep if its box holds enough points: the share that we ask of stopped objects. If the
        box of the later sweep holds more, the object has not started yet.
        """
        if self.free is None:
            return False
        number = int(later.table["id"][row])
        _, velocity = later.points.of_track(number)
        centre, size, heading = later.box(row)
        size = size + _MARGIN
        step = torch.from_numpy((self.points.seconds - later.points.seconds) * velocity)
        index = self.free.inside(centre + step, size, heading)
        num_there = len(self.free.inside(centre, size, heading))
        if len(index) < max(MIN_POINTS, MIN_STOPPED_SHARE * later.table["num_points"][row], num_there):
            return False
        at = int(np.searchsorted(self.table["id"], number))
        values = {name: column[row] for name, column in later.table.items()}
        values.update(self._where, num_points=len(index), cluster_id=-1, is_confirmed=False)
        self.table = {name: np.insert(column, at, values[name]) for name, column in self.table.items()}
        self.points = self.points.followed_by(number, self.free.row[index], self.free.position[index], velocity)
        self.free = self.free.without(index)
        return True

    def box(self, row: int) -> tuple[Tensor, Tensor, Tensor]:
        """Return the box around the points of the track in a row: centre and size, (1, 3) metres, and heading, (1,)."""
        position, _ = self.points.of_track(int(self.table["id"][row]))
        heading = torch.from_numpy(self.table["heading"][row : row + 1])
        points = torch.from_numpy(position)
        return (*enclosing_boxes(points, torch.zeros(len(points), dtype=torch.int64), heading), heading)

    def divide(self, number: int, ids: np.ndarray) -> None:
        """Give the points of the track `number` new ids, (P,) int64; -1 = no track.

        Each id gets a copy of its row of the table. An id with few points is seen only if no other one is.
        """
        parts, count = np.unique(ids[ids >= 0], return_counts=True)
        is_kept = count >= min(MIN_POINTS, count.max(initial=0))
        parts = parts[is_kept]
        at = int(np.searchsorted(self.table["id"], number))
        others = np.delete(np.arange(len(self.table["id"])), at)
        rows = np.append(others, np.full(len(parts), at))
        columns = {name: column[rows] for name, column in self.table.items()}
        columns["id"] = np.append(self.table["id"][others], parts)
        columns["num_points"] = np.append(self.table["num_points"][others], count[is_kept])
        order = np.argsort(columns["id"])
        self.table = {name: column[order] for name, column in columns.items()}
        id_of_point = self.points.id.copy()
        id_of_point[self.points.id == number] = np.where(np.isin(ids, parts), ids, -1)
        self.points = self.points.renumber(id_of_point)
