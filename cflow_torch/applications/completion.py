"""Replace the visible boxes in the table of tracks of a complete log by whole ones."""

from __future__ import annotations

from typing import NamedTuple, Sequence

import numpy as np
import torch

from cflow_torch.applications.moving_groups import pose_of
from cflow_torch.applications.track_state import Times
from cflow_torch.applications.track_table import Table
from cflow_torch.applications.whole_boxes import KINDS, Sightings, whole_boxes
from cflow_torch.transforms import transform_points
from cflow_torch.types import FlowResult, Window, as_numpy


class TrackedPoints(NamedTuple):
    """The points of a sweep that belong to tracks.

    Args:
        sweep: index of the sweep in its log.
        num_points: N, all points of the sweep.
        row: (M,) int64 rows of the points that have a track.
        id: (M,) int64 ids of their tracks.
    """

    sweep: int
    num_points: int
    row: np.ndarray
    id: np.ndarray

    @classmethod
    def of(cls, sweep: int, track_id: np.ndarray) -> TrackedPoints:
        """Keep the points with an id, of (N,) ids where -1 = no track."""
        row = np.flatnonzero(track_id >= 0)
        return cls(sweep, len(track_id), row, track_id[row])

    def followed_by(self, row: np.ndarray, number: int) -> TrackedPoints:
        """Append rows of the points of another track, with its id."""
        ids = np.append(self.id, np.full(len(row), number))
        return self._replace(row=np.append(self.row, row), id=ids)

    def renumber(self, ids: np.ndarray) -> TrackedPoints:
        """Give the points other ids, (M,) int64, and drop those with -1."""
        return self._replace(row=self.row[ids >= 0], id=ids[ids >= 0])

    def track_id(self, kept: np.ndarray) -> np.ndarray:
        """Return the id of every point, (N,) int64; -1 = no track, or one that is not among the ids `kept`."""
        ids = np.full(self.num_points, -1)
        ids[self.row] = np.where(np.isin(self.id, kept), self.id, -1)
        return ids


class SeenPoints(NamedTuple):
    """The points of tracks in one sweep, float32 relative to the vehicle to save memory."""

    sweep: int  # index in the log
    seconds: float  # time
    id: np.ndarray  # (T,) int64 tracks, ascending
    velocity: np.ndarray  # (T, 3) float64 m/s, mean flow of each track, in the world
    sensor: np.ndarray  # (3,) float64 metres, position of the vehicle in the world
    offset: np.ndarray  # (M, 3) float32 metres, from the vehicle to each point, axes of the world
    track: np.ndarray  # (M,) int32 index in `id` of each point's track

    @classmethod
    def of(cls, sweeps: Window, result: FlowResult, points: TrackedPoints, times: Times) -> SeenPoints:
        """Read the positions and the flow of the points of tracks."""
        T_world_ego0 = pose_of(sweeps.pc0)
        T_world_ego1 = pose_of(sweeps.pc1)
        sensor = T_world_ego0[:3, 3]
        position = transform_points(as_numpy(sweeps.pc0.points)[points.row, :3], T_world_ego0)
        step = as_numpy(result.residual_flow)[points.row].astype(np.float64) @ T_world_ego1[:3, :3].T
        ids, number, count = np.unique(points.id, return_inverse=True, return_counts=True)
        total = [np.bincount(number, step[:, axis], len(ids)) for axis in range(3)]
        velocity = np.stack(total, 1) / count[:, None] / times.interval
        offset = (position - sensor).astype(np.float32)
        return cls(points.sweep, times.now, ids, velocity, sensor, offset, number.astype(np.int32))

    def positions(self, index: int) -> np.ndarray:
        """(P, 3) float64 metres in the world, points of the track `id[index]`."""
        return self.sensor + self.offset[self.track == index]

    def insert(self, index: int, number: int, velocity: np.ndarray, position: np.ndarray) -> SeenPoints:
        """Insert a track with the id `number` before `id[index]`: its velocity, (3,), and its points, (P, 3)."""
        shifted = self.track + (self.track >= index)
        return self._replace(
            id=np.insert(self.id, index, number),
            velocity=np.insert(self.velocity, index, velocity, axis=0),
            offset=np.concatenate([self.offset, (position - self.sensor).astype(np.float32)]),
            track=np.append(shifted, np.full(len(position), index)).astype(np.int32),
        )

    def renumber(self, ids: np.ndarray) -> SeenPoints:
        """Give the points other ids, (M,) int64, and drop those with -1. New tracks keep the velocity."""
        is_kept = ids >= 0
        new, first, track = np.unique(ids[is_kept], return_index=True, return_inverse=True)
        velocity = self.velocity[self.track[is_kept][first]]
        return self._replace(id=new, velocity=velocity, offset=self.offset[is_kept], track=track.astype(np.int32))


def complete(table: Table, seen: Sequence[SeenPoints]) -> Table:
    """Give every row of a table its whole box, the smoothed position and velocity of its centre, its class and its age.

    Args:
        table: rows of confirmed tracks, sorted by sweep.
        seen: points of the tracks in each sweep that was tracked; tracks that are not in the table are ignored.
    """
    if len(table["id"]) == 0:
        return table
    order = np.lexsort((table["sweep"], table["id"]))  # rows by track, then time
    rank = np.argsort(order)  # position of each row in this order
    sightings = _sightings(table, order, rank, seen)
    boxes = whole_boxes(sightings)
    seconds = sightings.seconds.numpy()[rank]
    begin = seconds[np.unique(table["id"], return_index=True)[1]]
    size = boxes.size.numpy()[rank]
    position = boxes.motion.position.numpy()[rank]
    velocity = boxes.motion.velocity.numpy()[rank]
    deviation = boxes.motion.covariance[:, 1, 1].sqrt().numpy()[rank]
    return {
        **table,
        **dict(zip("xyz", position.T)),
        **dict(zip(("vx", "vy", "vz"), velocity.T)),
        "velocity_std": deviation,
        **dict(zip(("length", "width", "height"), size.T)),
        "heading": boxes.heading.numpy()[rank],
        "class": np.array(KINDS)[boxes.kind.numpy()[rank]],
        "age": seconds - begin[sightings.track.numpy()[rank]],
    }


def _sightings(table: Table, order: np.ndarray, rank: np.ndarray, seen: Sequence[SeenPoints]) -> Sightings:
    """Collect what is seen of the rows of a table, in the given order. `rank` is the position of each row in it."""
    sweeps = [each.sweep for each in seen]
    seconds = np.zeros(len(order))
    velocity = np.zeros((len(order), 3))
    sensor = np.zeros((len(order), 3))
    points = []
    rows = []
    first = np.searchsorted(table["sweep"], sweeps)
    last = np.searchsorted(table["sweep"], sweeps, side="right")
    for number, each in enumerate(seen):
        now = slice(first[number], last[number])
        is_in_table = np.isin(each.id, table["id"][now])
        row_of_id = np.full(len(each.id), -1)
        row_of_id[is_in_table] = rank[now]  # both are sorted by id
        row = row_of_id[each.track]
        points.append(each.sensor + each.offset[row >= 0])
        rows.append(row[row >= 0])
        velocity[rank[now]] = each.velocity[is_in_table] * table["is_moving"][now, None]
        seconds[rank[now]] = each.seconds
        sensor[rank[now]] = each.sensor
    columns = (
        np.unique(table["id"][order], return_inverse=True)[1],
        seconds,
        sensor,
        velocity,
        table["heading"][order],
        np.concatenate(points),
        np.concatenate(rows),
    )
    return Sightings(*map(torch.from_numpy, columns))
