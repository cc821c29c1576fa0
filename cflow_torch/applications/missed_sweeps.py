"""Find moving objects where they have no flow: just before it begins, in short gaps, and in a sweep after the last."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from cflow_torch.applications.association import MARGIN, MIN_STOPPED_SHARE, enclosing_boxes, points_in_boxes
from cflow_torch.applications.completion import TrackedPoints
from cflow_torch.applications.floor import Floor
from cflow_torch.applications.moving_groups import MIN_POINTS, pose_of, world_points
from cflow_torch.applications.static_places import cells_of
from cflow_torch.applications.track_table import Table
from cflow_torch.types import Sweep, as_numpy


class FreePoints(NamedTuple):
    """The valid points of one sweep that belong to no track, sorted by x."""

    row: np.ndarray  # (F,) int64 rows of the sweep
    position: np.ndarray  # (F, 3) float64 metres in the world

    @classmethod
    def of(cls, sweep: Sweep, is_valid: np.ndarray, taken: np.ndarray) -> FreePoints:
        """Collect those of a sweep that are valid, (N,) bool, without the rows of tracks."""
        cloud = as_numpy(sweep.points)[:, :3]
        is_free = is_valid & np.isfinite(cloud).all(axis=1)
        is_free[taken] = False
        row = np.flatnonzero(is_free)
        position = world_points(sweep, row)
        order = np.argsort(position[:, 0])
        return cls(row[order], position[order])

    def inside(self, centre: Tensor, size: Tensor, heading: Tensor) -> np.ndarray:
        """(M,) int64 indices of the points in a box, see `box_of_point`."""
        (index,) = points_in_boxes(torch.from_numpy(self.position), centre, size, heading)
        return index.numpy()

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

    @classmethod
    def after(cls, before: SweepTracks, sweep: Sweep, timestamp_ns: int) -> SweepTracks:
        """Look for the tracks of a sweep in the next one, which has no flow; it is of a `TimedLog`."""
        cloud = as_numpy(sweep.points)
        is_valid = ~as_numpy(sweep.is_ground, bool) if sweep.is_ground is not None else np.ones(len(cloud), bool)
        points = before.points.renumber(
            np.full(len(before.points.id), -1)
        )._replace(
            sweep=before.points.sweep + 1,
            num_points=len(cloud),
            seconds=sweep.timestamp_ns * 1e-9,  # type: ignore[operator]
            sensor=pose_of(sweep)[:3, 3],
            floor=Floor.of(sweep),
        )
        no_rows = {name: column[:0] for name, column in before.table.items()}
        tracks = cls(no_rows, points, timestamp_ns, FreePoints.of(sweep, is_valid, points.row))
        for row in range(len(before.table["id"])):
            tracks.find(before, row)
        tracks.static = np.unique(cells_of(tracks.free.position))  # type: ignore[union-attr]
        return tracks

    def find(self, other: SweepTracks, row: int) -> bool:
        """Look for the track in a row of another sweep where its flow there says that it was, or will be.

        We add the track to this sweep if its box holds enough points: the share that we ask of stopped objects. If the
        box of a later sweep holds more, the object has not started yet.
        """
        if self.free is None:
            return False
        number = int(other.table["id"][row])
        _, velocity = other.points.of_track(number)
        centre, size, heading = other.box(row)
        size = size + MARGIN
        seconds = self.points.seconds - other.points.seconds
        index = self.free.inside(centre + torch.from_numpy(seconds * velocity), size, heading)
        num_there = len(self.free.inside(centre, size, heading)) if seconds < 0 else 0
        if len(index) < max(MIN_POINTS, MIN_STOPPED_SHARE * other.table["num_points"][row], num_there):
            return False
        at = int(np.searchsorted(self.table["id"], number))
        values = {name: column[row] for name, column in other.table.items()}
        values.update(self._where, num_points=len(index), cluster_id=-1)
        if seconds < 0:
            values["is_confirmed"] = False
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
