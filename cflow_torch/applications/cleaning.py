"""Remove dynamic objects from logs, and build maps of the static world."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache, partial
from typing import Any, Callable, Mapping, NamedTuple, Sequence

import numpy as np
import torch

from cflow_torch.applications.association import MARGIN, box_of_point, enclosing_boxes
from cflow_torch.applications.completion import TrackedPoints
from cflow_torch.applications.moving_groups import pose_of, world_points
from cflow_torch.applications.track_table import Table
from cflow_torch.applications.tracking import LogTracker
from cflow_torch.config import make_config
from cflow_torch.data.log import CachedLog, FlowLabels, Log, LogWrapper, window
from cflow_torch.estimate import make_model
from cflow_torch.model import SceneFlowModel
from cflow_torch.types import CFlowError, FlowResult, Sweep, as_numpy, check_array

_SLOW = 3.0  # m/s; an object that is faster in its first sweep did not wait there before
_MAX_DISTANCE = 100.0  # metres from the vehicle to a box, at most
_INTENSITIES = ("intensity", "reflectance", "reflectivity", "remission", "i", "column_3")
_MAX_VOXELS = 1 << 20  # voxels in x, y and z from the first sweep to a point of a map, at most


class MaskedLog(LogWrapper):
    """A log without some rows of its sweeps. Every command, writer and loader accepts it like any other log.

    Cameras, poses and all else that has no rows are those of the log. Labels and masks lose the same rows.

    Args:
        log: any log. Its sweeps are read when they are asked for.
        mask: index -> (N,) bool, True for the rows of sweep `index` that are removed.
    """

    def __init__(self, log: Log, mask: Callable[[int], np.ndarray]) -> None:
        super().__init__(log)
        self._mask = mask

    def removed(self, index: int) -> np.ndarray:
        """(N,) bool, True for the rows of sweep `index` of the log that this log does not have."""
        return self._mask(index)

    def sweep(self, index: int) -> Sweep:
        """Sweep number `index` without the removed rows; pose and time as in the log."""
        sweep = self.log.sweep(index)
        is_kept = ~self.removed(index)
        given = {name: getattr(sweep, name) for name in ("points", "is_ground", "point_times")}
        kept = {name: as_numpy(values)[is_kept] for name, values in given.items() if values is not None}
        return replace(sweep, **kept)

    def columns(self, index: int) -> dict[str, np.ndarray]:
        """Other columns of sweep `index`, such as intensity, without the removed rows."""
        is_kept = ~self.removed(index)
        columns = self.log.columns(index)
        for name, values in columns.items():
            what = f"column {name} of sweep {index}"
            check_array(values, what, is_kept.shape, "biuf", f"({len(is_kept)},) numbers, one per point")
        return {name: values[is_kept] for name, values in columns.items()}

    def labels(self, index: int) -> FlowLabels | None:
        """Truth of the pair (index, index + 1) without the removed rows."""
        labels = self.log.labels(index)
        if labels is None:
            return None
        is_kept = ~self.removed(index)
        return FlowLabels(labels.flow[is_kept], labels.category[is_kept], labels.is_valid[is_kept])

    def eval_mask(self, index: int) -> np.ndarray | None:
        return self._kept(self.log.eval_mask(index), index)

    def moving(self, index: int) -> np.ndarray | None:
        return self._kept(self.log.moving(index), index)

    def units(self, index: int) -> None:
        """None, because the returns of each LiDAR are not known any more."""

    def _kept(self, values: np.ndarray | None, index: int) -> np.ndarray | None:
        return None if values is None else values[~self.removed(index)]


class CleanLog(MaskedLog):
    """A log without its moving points, and without points that have no position (NaN).

    A point moves by `FlowResult.is_moving`. The last sweep, and one before a gap of the log, have no flow. There, we
    take the boxes of the objects that move in the sweep before, shift them by the flow, and remove the points inside.

    Args:
        log: any log. Sweeps are read one after the other, and only a few are held in memory.
        model: the method; None = preset `offline`.
        flow: index -> flow of that pair, in place of a model. We use residual_flow, cluster_id and, if it has it,
            moving; with `remove_stopped` also is_valid and, if it has it, confidence.
        remove_stopped: also remove objects before they start and after they stop, such as cars at a light. Tracking
            finds them, also in a sweep without flow. It takes a pass over the log before the first sweep is returned,
            and the memory of 1 bit per point, of the points of tracks, and of 0.1 to 0.2 MB a sweep for static places.
        sweep_interval: seconds from sweep to sweep where sweeps have no time stamps.

    Attributes:
        log_id, timestamps, gaps: those of the log.
        num_stopped: number of points that only `remove_stopped` removes; None if it is False or no sweep was read.

    Examples:
        >>> write_array_log(CleanLog(log), "outputs/clean")
    """

    def __init__(
        self,
        log: Log,
        model: SceneFlowModel | None = None,
        flow: Callable[[int], FlowResult] | None = None,
        remove_stopped: bool = False,
        sweep_interval: float = 0.1,
    ) -> None:
        if len(log.timestamps) < 2:
            raise CFlowError(f"log {log.log_id} has {len(log.timestamps)} sweeps: give a log of at least two")
        if flow is None and model is None:
            model = make_model(make_config("offline"))
        super().__init__(CachedLog(log, 2 if model is None else model.config.num_sweeps), self._moving_or_missing)
        self._flow: Any = lru_cache(2)(flow or partial(self._estimate, model))
        self._bits: list[np.ndarray] | None = None
        self.num_stopped: int | None = None
        self._tracks_objects = remove_stopped
        self._sweep_interval = sweep_interval

    def _moving_or_missing(self, index: int) -> np.ndarray:
        points = as_numpy(self.log.sweep(index).points)[:, :3]
        return self.moving(index) | ~np.isfinite(points).all(axis=1)

    def moving(self, index: int) -> np.ndarray:
        """(N,) bool, True for the points of sweep `index` of the log that are removed because they move.

        The rows are those of the given log, unlike in `MaskedLog`.

        Raises:
            CFlowError: a sweep cannot be read, or its flow has another number of rows.
        """
        if not self._tracks_objects:
            return self._moves(index)
        if self._bits is None:
            self._bits = self._track()
        return np.unpackbits(self._bits[index], count=len(self.log.sweep(index).points)).astype(bool)

    def _estimate(self, model: Any, index: int) -> FlowResult:
        sweeps = window(self.log, index, model.config.num_history, model.config.num_future)
        return model([sweeps])[0]  # type: ignore[no-any-return]

    def _moves(self, index: int) -> np.ndarray:
        """(N,) bool, True for the points that move according to their flow."""
        sweep = self.log.sweep(index)
        if not self._has_flow(index):
            return self._reached(sweep, index) if self._has_flow(index - 1) else np.zeros(len(sweep.points), bool)
        moves = as_numpy(self._flow(index).is_moving)
        if len(moves) != len(sweep.points):
            raise CFlowError(
                f"sweep {index} has {len(sweep.points)} points, but its flow {len(moves)} rows: give both of one log"
            )
        return moves

    def _has_flow(self, index: int) -> bool:
        """Test whether a sweep has a next one. The pair over a gap has no flow."""
        return 0 <= index < len(self.timestamps) - 1 and index not in self.gaps

    def _reached(self, sweep: Sweep, index: int) -> np.ndarray:
        """(N,) bool, points of the last sweep in the boxes to which the clusters of the sweep before have moved."""
        result = self._flow(index - 1)
        moves = self._moves(index - 1)
        before = world_points(self.log.sweep(index - 1), moves)
        step = as_numpy(result.residual_flow, np.float64)[moves] @ pose_of(sweep)[:3, :3].T
        clusters, group = np.unique(as_numpy(result.cluster_id)[moves], return_inverse=True)
        total = np.zeros((len(clusters), 3))
        np.add.at(total, group, step)
        heading = torch.from_numpy(np.arctan2(total[:, 1], total[:, 0]))
        centre, size = enclosing_boxes(torch.from_numpy(before + step), torch.from_numpy(group), heading)
        return _inside(sweep, centre, size, heading)

    def _track(self) -> list[np.ndarray]:
        """Packed bits of `moving` for every sweep: points of objects that move, have stopped, or have yet to start."""
        tracker = LogTracker(self.log, self._sweep_interval)
        bits = []
        for index in range(len(self.timestamps)):
            bits.append(np.packbits(self._moves(index)))
            if self._has_flow(index):
                tracker.push(index, self._flow(index))
        num_moving = _count(bits)
        table = tracker.table()
        has_no_flow = table["cluster_id"] < 0
        for each in tracker.points:
            ids = table["id"][has_no_flow & (table["sweep"] == each.sweep)]
            bits[each.sweep] |= np.packbits(each.track_id(ids) >= 0)
        start = _slow_starts(table, tracker.points)
        for index in range(int(start.sweep.max(initial=0))):
            bits[index] |= np.packbits(self._waits(index, start))
        self.num_stopped = _count(bits) - num_moving
        return bits

    def _waits(self, index: int, start: _Starts) -> np.ndarray:
        """(N,) bool, points of a sweep in the boxes where objects near the vehicle start later."""
        sweep = self.log.sweep(index)
        distance = np.linalg.norm(start.centre[:, :2] - pose_of(sweep)[:2, 3], axis=1)
        is_waiting = (distance < _MAX_DISTANCE) & (start.sweep > index)
        return _inside(sweep, *(torch.from_numpy(values[is_waiting]) for values in start[1:]))


class _Starts(NamedTuple):
    """Where K tracks begin."""

    sweep: np.ndarray  # (K,) int64
    centre: np.ndarray  # (K, 3) float64 metres, world, of the box around the points
    size: np.ndarray  # (K, 3) float64 metres
    heading: np.ndarray  # (K,) float64 radians


def _count(bits: Sequence[np.ndarray]) -> int:
    return sum(int(np.unpackbits(each).sum()) for each in bits)


def _slow_starts(table: Table, seen: Sequence[TrackedPoints]) -> _Starts:
    """Return where tracks begin that are slow there."""
    first = np.unique(table["id"], return_index=True)[1]
    rows = first[np.hypot(table["vx"][first], table["vy"][first]) < _SLOW]
    of_sweep = {each.sweep: each for each in seen}
    points = [of_sweep[table["sweep"][row]].of_track(table["id"][row])[0] for row in rows.tolist()]
    group = np.repeat(np.arange(len(rows)), [len(each) for each in points])
    heading = table["heading"][rows]
    position = np.concatenate([np.zeros((0, 3)), *points])
    centre, size = enclosing_boxes(*map(torch.from_numpy, (position, group, heading)))
    return _Starts(table["sweep"][rows], centre.numpy(), size.numpy(), heading)


def static_map(log: Log, voxel_size: float = 0.1) -> np.ndarray:
    """Accumulate the points of a log in the world, one per voxel of `voxel_size` metres.

    For a map of the static world, pass a `CleanLog`, or open the files that were written from one.

    Returns:
        (M, 3) float64, metres in the world: the first point of each voxel, in the order of the sweeps.
        `static_map_with_intensity` also returns the intensities.

    Raises:
        CFlowError: a sweep has no pose, the voxel size is not positive, or a point is more than a million voxels from
            the first sweep.

    Cost: memory for the map and one sweep. Each sweep takes a pass over the voxels of the map.
    """
    return static_map_with_intensity(log, voxel_size)[0]


def static_map_with_intensity(log: Log, voxel_size: float = 0.1) -> tuple[np.ndarray, np.ndarray | None]:
    """Return the map of `static_map`, and the (M,) intensities of its points; None if a sweep has no such column.

    The column is called intensity, reflectance, reflectivity, remission or i. In files without names, it is the fourth.
    """
    if not voxel_size > 0:
        raise CFlowError(f"voxel_size={voxel_size}: give a positive length in metres")
    known: Any = np.zeros(0, np.int64)
    clouds: list[Any] = [np.zeros((0, 3))]
    intensities: list[np.ndarray | None] = []
    origin: Any = None
    for index in range(len(log.timestamps)):
        sweep = log.sweep(index)
        if sweep.pose is None:
            raise CFlowError(f"log {log.log_id} has no poses, and a map needs them: data.odometry=true estimates them")
        points = world_points(sweep)
        is_known = np.isfinite(points).all(1)
        points = points[is_known]
        origin = np.floor(pose_of(sweep)[:3, 3] / voxel_size) if origin is None else origin
        voxel = (np.floor(points / voxel_size) - origin).astype(np.int64) + _MAX_VOXELS
        if ((voxel < 0) | (voxel >= 2 * _MAX_VOXELS)).any():
            raise CFlowError(
                f"the map reaches more than {_MAX_VOXELS * voxel_size:.0f} m from its first sweep: give larger voxels, "
                "or parts of the log"
            )
        key, first = np.unique((voxel[:, 0] << 42) | (voxel[:, 1] << 21) | voxel[:, 2], return_index=True)
        position: Any = np.searchsorted(known, key)
        is_new = np.append(known, -1)[position] != key
        rows = np.sort(first[is_new])
        clouds.append(points[rows])
        intensity = _intensity(log.columns(index))
        intensities.append(None if intensity is None else intensity[is_known][rows])
        known = np.insert(known, position[is_new], key[is_new])
    known_intensities = [values for values in intensities if values is not None]
    if len(known_intensities) < len(intensities):
        return np.concatenate(clouds), None
    return np.concatenate(clouds), np.concatenate([np.zeros(0, np.float32), *known_intensities])


def _intensity(columns: Mapping[str, np.ndarray]) -> np.ndarray | None:
    """Return the intensity of each point, (N,) float32; None = it is unknown."""
    names = {name.lower(): name for name in columns}
    for name in _INTENSITIES:
        if name in names:
            return columns[names[name]].astype(np.float32)
    return None


def _inside(sweep: Sweep, centre: torch.Tensor, size: torch.Tensor, heading: torch.Tensor) -> np.ndarray:
    """(N,) bool, points of a sweep that are not ground and lie in one of the boxes (world frame)."""
    points = world_points(sweep)
    is_inside = np.isfinite(points).all(1)
    if sweep.is_ground is not None:
        is_inside &= ~as_numpy(sweep.is_ground).astype(bool)
    box = box_of_point(torch.from_numpy(points[is_inside]), centre, size + MARGIN, heading)
    is_inside[is_inside] = box.numpy() >= 0
    return is_inside
