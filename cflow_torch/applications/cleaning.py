"""A log without what moves, and the map of what stands."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from typing import Any, Callable

import numpy as np
import torch

from cflow_torch.applications.linking import box_of_point, boxes
from cflow_torch.applications.moving_groups import MOVING
from cflow_torch.applications.track_table import confirmed, join_tables
from cflow_torch.applications.tracking import Tracker
from cflow_torch.config import make_config
from cflow_torch.data.log import CachedLog, Log, window
from cflow_torch.estimate import make_model
from cflow_torch.model import SceneFlowModel
from cflow_torch.types import CFlowError, FlowResult, Sweep, as_numpy

_MARGIN = 0.2  # metres by which a box is larger than what was seen
_SLOW = 3.0  # m/s; what is faster when it is first seen has not waited there
_NEAR = 100.0  # metres from the vehicle that a box may be
_REACH = 1 << 20  # voxels of a map in each direction from its first sweep


class CleanLog(Log):
    """A log without the points that move: a log again, for every command, writer and loader.

    A point moves if its residual flow is 0.05 m a sweep or more. Of the last sweep, which has no successor, what lies
    in a box that the movers of the sweep before have reached is taken out.

    Args:
        log: any log. Sweeps are read one after the other, and few are held.
        model: the method; None = preset `offline`.
        flow: index -> flow of that pair, in place of a model; with residual_flow, and cluster_id and is_valid for
            `standing`.
        standing: also take out what moves at another time of the log and stands now, by its track (a car that waits).
            The log is gone through once for that before the first sweep is given; a bit per point is kept.

    Attributes:
        log_id, timestamps: those of the log.

    Example:
        >>> write_array_log(CleanLog(log), "outputs/clean")
    """

    def __init__(
        self,
        log: Log,
        model: SceneFlowModel | None = None,
        flow: Callable[[int], FlowResult] | None = None,
        standing: bool = False,
    ) -> None:
        self.log_id, self.timestamps = log.log_id, log.timestamps
        if len(log.timestamps) < 2:
            raise CFlowError(f"log {log.log_id} has {len(log.timestamps)} sweeps: motion is seen in two or more")
        if flow is None and model is None:
            model = make_model(make_config("offline"))
        self._log = CachedLog(log, 2 if model is None else model.config.num_sweeps)
        self._flow: Any = lru_cache(2)(flow if flow is not None else lambda index: self._estimate(model, index))
        self._standing: list[np.ndarray] | None = None
        self._follows = standing

    def sweep(self, index: int) -> Sweep:
        """Sweep number `index` without the rows that `moving` tells; pose, time and ground mask as in the log."""
        sweep, stays = self._log.sweep(index), ~self.moving(index)

        def rows(values: Any) -> Any:
            return None if values is None else as_numpy(values)[stays]

        return replace(
            sweep,
            points=rows(sweep.points),
            is_ground=rows(sweep.is_ground),
            point_times=rows(sweep.point_times),
        )

    def moving(self, index: int) -> np.ndarray:
        """(N,) bool, True for the points of the log's sweep `index` that are taken out.

        Raises:
            CFlowError: a sweep cannot be read, or its flow has other rows.
        """
        if not self._follows:
            return self._moves(index)
        if self._standing is None:
            self._standing = self._follow()
        sweep = self._log.sweep(index)
        return np.unpackbits(self._standing[index], count=len(sweep.points)).astype(bool)

    def _estimate(self, model: Any, index: int) -> FlowResult:
        sweeps = window(self._log, index, model.config.num_history, model.config.num_future)
        return model([sweeps])[0]  # type: ignore[no-any-return]

    def _moves(self, index: int) -> np.ndarray:
        """As `moving`, by flow alone."""
        sweep = self._log.sweep(index)
        if index == len(self.timestamps) - 1:
            return self._reached(sweep, index)
        moves = (self._flow(index).residual_flow.norm(dim=1) >= MOVING).cpu().numpy()
        if len(moves) != len(sweep.points):
            raise CFlowError(f"sweep {index} has {len(sweep.points)} points, its flow {len(moves)} rows")
        return moves

    def _reached(self, sweep: Sweep, index: int) -> np.ndarray:
        """Of the last sweep: what is in a box that a cluster of the sweep before has moved to."""
        result, moves = self._flow(index - 1), self._moves(index - 1)
        before = self._log.sweep(index - 1)
        at = _world(before)[moves]
        step = as_numpy(result.residual_flow, np.float64)[moves] @ _rotation(sweep).T
        number, group = np.unique(as_numpy(result.cluster_id)[moves], return_inverse=True)
        total = np.zeros((len(number), 3))
        np.add.at(total, group, step)
        heading = torch.from_numpy(np.arctan2(total[:, 1], total[:, 0]))
        centre, size = boxes(torch.from_numpy(at + step), torch.from_numpy(group), heading)
        return _inside(sweep, centre, size, heading)

    def _follow(self) -> list[np.ndarray]:
        """Packed bits of `moving` for every sweep: what moves, what a track says has stopped, what has yet to start."""
        tracker, tables, bits = Tracker(), [], []
        for index in range(len(self.timestamps)):
            taken = self._moves(index)
            if index < len(self.timestamps) - 1:
                table, track_id = tracker.push(window(self._log, index), self._flow(index))
                tables.append({**table, "sweep": np.full(len(table["id"]), index)})
                stopped = table["id"][table["is_confirmed"] & ~table["is_moving"]]
                taken = taken | np.isin(track_id, stopped)
            bits.append(np.packbits(taken))
        start = _first_rows(confirmed(join_tables(tables)))
        start = {name: values[np.hypot(start["vx"], start["vy"]) < _SLOW] for name, values in start.items()}
        for index in range(int(start["sweep"].max(initial=0))):
            sweep = self._log.sweep(index)
            away = np.hypot(*(start[axis] - _pose(sweep)[k, 3] for k, axis in enumerate("xy")))
            waits = (start["sweep"] > index) & (away < _NEAR)
            centre, size = (
                torch.from_numpy(np.stack([start[name][waits] for name in names], 1))
                for names in ("xyz", ("length", "width", "height"))
            )
            waiting = _inside(sweep, centre, size, torch.from_numpy(start["heading"][waits]))
            bits[index] = bits[index] | np.packbits(waiting)
        return bits


def static_map(log: Log, voxel_size: float = 0.1) -> np.ndarray:
    """All points of a log in the world, one per voxel.

    Args:
        log: with poses; a `CleanLog` or what was written of one, if the map is to hold what stands.
        voxel_size: metres.

    Returns:
        (M, 3) float64, metres in the world: the first point of each voxel, in the order of the sweeps.

    Raises:
        CFlowError: a sweep without pose, a voxel size that is not positive, a map of more than a million voxels across.

    Cost: memory for the map and one sweep; a pass over the map's voxels per sweep.
    """
    if not voxel_size > 0:
        raise CFlowError(f"voxel_size={voxel_size}: give a positive length in metres")
    known: Any = np.zeros(0, np.int64)
    parts: list[Any] = [np.zeros((0, 3))]
    origin: Any = None
    for index in range(len(log.timestamps)):
        sweep = log.sweep(index)
        if sweep.pose is None:
            raise CFlowError(f"log {log.log_id} has no poses, and a map needs them: data.odometry=true finds some")
        points = _world(sweep)
        points = points[np.isfinite(points).all(1)]
        origin = np.floor(_pose(sweep)[:3, 3] / voxel_size) if origin is None else origin
        voxel = (np.floor(points / voxel_size) - origin).astype(np.int64) + _REACH
        if ((voxel < 0) | (voxel >= 2 * _REACH)).any():
            raise CFlowError(f"the map is more than {_REACH * voxel_size:.0f} m long: give larger voxels, or parts")
        key, first = np.unique((voxel[:, 0] << 42) | (voxel[:, 1] << 21) | voxel[:, 2], return_index=True)
        place: Any = np.searchsorted(known, key)
        is_new = np.append(known, -1)[place] != key
        parts.append(points[np.sort(first[is_new])])
        known = np.insert(known, place[is_new], key[is_new])
    return np.concatenate(parts)


def _first_rows(table: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """The first row of each track."""
    first = np.unique(table["id"], return_index=True)[1]
    return {name: values[first] for name, values in table.items()}


def _inside(sweep: Sweep, centre: torch.Tensor, size: torch.Tensor, heading: torch.Tensor) -> np.ndarray:
    """(N,) bool, points of a sweep that are no ground and lie in one of some boxes in the world."""
    found = box_of_point(torch.from_numpy(_world(sweep)), centre, size + _MARGIN, heading).numpy() >= 0
    return found if sweep.is_ground is None else found & ~as_numpy(sweep.is_ground).astype(bool)


def _world(sweep: Sweep) -> np.ndarray:
    """(N, 3) float64, points in the world."""
    pose = _pose(sweep)
    return as_numpy(sweep.points, np.float64)[:, :3] @ pose[:3, :3].T + pose[:3, 3]


def _pose(sweep: Sweep) -> np.ndarray:
    return np.eye(4) if sweep.pose is None else as_numpy(sweep.pose, np.float64)


def _rotation(sweep: Sweep) -> np.ndarray:
    return _pose(sweep)[:3, :3]
