"""Replace the visible boxes in the table of tracks of a complete log by whole ones, found from their points."""

from __future__ import annotations

from typing import NamedTuple, Sequence

import numpy as np
import torch

from cflow_torch.applications.floor import Floor
from cflow_torch.applications.moving_groups import pose_of, world_points
from cflow_torch.applications.track_state import Times
from cflow_torch.applications.track_table import Table
from cflow_torch.applications.whole_boxes import KINDS, Sightings, whole_boxes
from cflow_torch.types import CENTRE, SIZE, VELOCITY, FlowResult, Window, as_numpy, vectors


class TrackedPoints(NamedTuple):
    """The M points of a sweep that belong to tracks."""

    sweep: int  # index of the sweep in its log
    num_points: int  # N, all points of the sweep
    seconds: float  # time
    sensor: np.ndarray  # (3,) float64 metres, position of the vehicle in the world
    row: np.ndarray  # (M,) int64 rows of the points
    id: np.ndarray  # (M,) int64 ids of their tracks
    offset: np.ndarray  # (M, 3) float32 metres, from the vehicle to each point, axes of the world
    velocity: np.ndarray  # (M, 3) float32 m/s, flow in the world
    floor: Floor  # the ground

    @classmethod
    def of(
        cls, index: int, sweeps: Window, result: FlowResult, track_id: np.ndarray, times: Times, floor: Floor
    ) -> TrackedPoints:
        """Keep the points of sweep `index` that have an id, of (N,) ids where -1 = no track."""
        T_world_ego1 = pose_of(sweeps.pc1)
        sensor = pose_of(sweeps.pc0)[:3, 3]
        row = np.flatnonzero(track_id >= 0)
        position = world_points(sweeps.pc0, row)
        step = as_numpy(result.residual_flow)[row].astype(np.float64) @ T_world_ego1[:3, :3].T
        offset = (position - sensor).astype(np.float32)
        velocity = (step / times.interval).astype(np.float32)
        return cls(index, len(track_id), times.now, sensor, row, track_id[row], offset, velocity, floor)

    def of_track(self, number: int) -> tuple[np.ndarray, np.ndarray]:
        """Return the positions of the points of a track, (P, 3) float64 metres in the world, and its mean velocity."""
        is_on_track = self.id == number
        return self.sensor + self.offset[is_on_track], self.velocity[is_on_track].mean(0, dtype=np.float64)

    def followed_by(self, number: int, row: np.ndarray, position: np.ndarray, velocity: np.ndarray) -> TrackedPoints:
        """Append the points of another track: rows, positions (P, 3), and their velocity (3,)."""
        offset = (position - self.sensor).astype(np.float32)
        velocities = np.broadcast_to(velocity.astype(np.float32), offset.shape)
        return self._replace(
            row=np.append(self.row, row),
            id=np.append(self.id, np.full(len(row), number)),
            offset=np.concatenate([self.offset, offset]),
            velocity=np.concatenate([self.velocity, velocities]),
        )

    def renumber(self, ids: np.ndarray) -> TrackedPoints:
        """Give the points other ids, (M,) int64, and drop those with -1."""
        is_kept = ids >= 0
        columns = {name: getattr(self, name)[is_kept] for name in ("row", "offset", "velocity")}
        return self._replace(id=ids[is_kept], **columns)

    def track_id(self, kept: np.ndarray) -> np.ndarray:
        """Return the id of every point, (N,) int64; -1 = no track, or one that is not among the ids `kept`."""
        ids = np.full(self.num_points, -1)
        ids[self.row] = np.where(np.isin(self.id, kept), self.id, -1)
        return ids


def complete(table: Table, seen: Sequence[TrackedPoints]) -> Table:
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
        **dict(zip(CENTRE, position.T)),
        **dict(zip(VELOCITY, velocity.T)),
        "velocity_std": deviation,
        **dict(zip(SIZE, size.T)),
        "heading": boxes.heading.numpy()[rank],
        "class": np.array(KINDS)[boxes.kind.numpy()[rank]],
        "age": seconds - begin[sightings.track.numpy()[rank]],
    }


def _sightings(table: Table, order: np.ndarray, rank: np.ndarray, seen: Sequence[TrackedPoints]) -> Sightings:
    """Collect what is seen of the rows of a table, in the given order. `rank` is the position of each row in it."""
    sweeps = [each.sweep for each in seen]
    seconds = np.zeros(len(order))
    sensor = np.zeros((len(order), 3))
    floor = np.zeros(len(order))
    centre = vectors(table, CENTRE)
    points = []
    velocities = []
    rows = []
    first = np.searchsorted(table["sweep"], sweeps)
    last = np.searchsorted(table["sweep"], sweeps, side="right")
    for number, each in enumerate(seen):
        now = slice(first[number], last[number])
        is_in_table = np.isin(each.id, table["id"][now])
        row = rank[now][np.searchsorted(table["id"][now], each.id[is_in_table])]  # ids of a sweep ascend
        points.append(each.sensor + each.offset[is_in_table])
        velocities.append(each.velocity[is_in_table].astype(np.float64))
        rows.append(row)
        seconds[rank[now]] = each.seconds
        sensor[rank[now]] = each.sensor
        floor[rank[now]] = each.floor.below(centre[now])
    row_of_point = np.concatenate(rows)
    moves = table["is_moving"][order]
    columns = (
        np.unique(table["id"][order], return_inverse=True)[1],
        seconds,
        sensor,
        table["heading"][order],
        floor,
        np.concatenate(points),
        np.concatenate(velocities) * moves[row_of_point][:, None],
        row_of_point,
    )
    return Sightings(*map(torch.from_numpy, columns))
