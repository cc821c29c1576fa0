"""Track moving objects: match the moving groups of consecutive sweeps by their flow, and filter them in the world."""

from __future__ import annotations

from collections import deque
from typing import Any, Iterable, NamedTuple

import numpy as np
import torch
from torch import Tensor

from cflow_torch.applications.association import TrackMatches, enclosing_boxes, match, of_own_vehicle, regroup, turned
from cflow_torch.applications.completion import TrackedPoints, complete
from cflow_torch.applications.floor import UNKNOWN_FLOOR, Floor
from cflow_torch.applications.missed_sweeps import FreePoints, SweepTracks
from cflow_torch.applications.moving_groups import MOVING, MovingGroups, pose_of
from cflow_torch.applications.people import divide_people
from cflow_torch.applications.static_places import Sighting, static_points
from cflow_torch.applications.track_state import Times, TrackStates
from cflow_torch.applications.track_table import confirmed, join_tables
from cflow_torch.applications.whole_boxes import FLOW_NOISE, KINDS, Edges, kinds_and_sizes
from cflow_torch.config import make_config
from cflow_torch.data.log import CachedLog, Log, TimedLog, window
from cflow_torch.estimate import make_model
from cflow_torch.ops.threads import one_thread
from cflow_torch.types import CENTRE, SIZE, VELOCITY, CFlowError, FlowResult, Sweep, Window, as_numpy

_MAX_MISSED = 3  # sweeps that a track survives unseen
_LONGEST_PAUSE = 1.0  # seconds without a sweep that a track survives, if that is more than `_MAX_MISSED` intervals
_REST_NOISE = 0.1  # metres, standard deviation of the place of a stopped object
_UNKNOWN = 1e6  # variance of a new track, before its first measurement
_MOST_STATIC = 0.5  # share of the points of a track in one sweep; pieces of walls have more
_RECENT = 16  # sweeps whose visible edges decide the size of a track


class Tracked(NamedTuple):
    """Tracks of one sweep.

    Args:
        table: a row for each track that is seen in the sweep; `track` describes the columns.
        track_id: (N,) int64 for every point of the sweep, -1 = no track.
    """

    table: dict[str, np.ndarray]
    track_id: np.ndarray


class _TrackPoints(NamedTuple):
    """Points of tracks."""

    position: Tensor  # (N, 3) float64, metres in the world
    track: Tensor  # (N,) int64, index of each point's track

    def followed_by(self, other: _TrackPoints) -> _TrackPoints:
        """Append other points of the same tracks."""
        return _TrackPoints(torch.cat([self.position, other.position]), torch.cat([self.track, other.track]))

    def renumber(self, number: Tensor) -> _TrackPoints:
        """Give the tracks other numbers, (K,) int64, and drop the points of those with -1."""
        track = number[self.track]
        return _TrackPoints(self.position[track >= 0], track[track >= 0])


_NO_POINTS = _TrackPoints(torch.zeros(0, 3, dtype=torch.float64), torch.zeros(0, dtype=torch.int64))


class _SeenEdges(NamedTuple):
    """Visible edges of tracks in one sweep, relative to their paths."""

    id: Tensor  # (G,) int64
    edges: Edges

    @classmethod
    def join(cls, sweeps: Iterable[_SeenEdges], device: torch.device) -> _SeenEdges:
        """Concatenate those of several sweeps."""
        ids = [each.id for each in sweeps]
        edges = zip(*(each.edges for each in sweeps))
        return cls(torch.cat(ids).to(device), Edges(*(torch.cat(values).to(device) for values in edges)))


class Tracker:
    """Track moving objects sweep by sweep.

    The flow moves the points of a group to the next sweep. There, the group that shares the most voxels with them is
    the same object. We track a stopped object as long as its box holds at least 5 static points, and 0.3 of those that
    it had. If an object is not seen for up to three sweeps, we predict its position from its velocity. We do the same
    if sweeps are missing, for up to three intervals or one second, whichever is longer. Memory: the points of the
    current tracks.

    Args:
        sweep_interval: seconds from sweep to sweep where sweeps have no time stamps.

    Examples:
        >>> tracker = Tracker()
        >>> for window in windows(log, num_history=model.config.num_history):
        ...     table, track_id = tracker.push(window, model([window])[0])
    """

    def __init__(self, sweep_interval: float = 0.1) -> None:
        if not sweep_interval > 0:
            raise CFlowError(f"sweep_interval={sweep_interval}: give the seconds from one sweep to the next")
        self._interval = sweep_interval
        self._clock: tuple[float, float] | None = None  # time of the last sweep, and of the end of its flow
        self.times = Times(0.0, sweep_interval, 0.0, 0.0)  # of the last sweep
        self.floor = UNKNOWN_FLOOR  # of the last sweep
        self._num_sweeps = 0
        self._num_tracks = 0
        self._tracks = TrackStates()
        self._recent: deque[_SeenEdges] = deque(maxlen=_RECENT)
        # Points of the tracks, at their predicted positions in the next sweep.
        self._points = _NO_POINTS

    @one_thread()
    def push(self, sweeps: Window | tuple[Sweep, Sweep], result: FlowResult) -> Tracked:
        """Continue the tracks by one sweep.

        Args:
            sweeps: the window of the pair t, t+1, or the two sweeps; the points of t, poses and time stamps are used.
            result: its flow; residual_flow, cluster_id, is_valid and, if present, confidence.

        Returns:
            The tracks at t. Tracks that are not (yet) `is_confirmed` are mostly noise of the static world.

        Raises:
            CFlowError: the sweep is not later than the one before, t+1 is not later than t, or the result has another
                number of rows or lacks a field.
        """
        sweeps = sweeps if isinstance(sweeps, Window) else Window(*sweeps)
        if any(getattr(result, name) is None for name in ("residual_flow", "cluster_id", "is_valid")):
            raise CFlowError("tracks need residual flow, cluster_id and is_valid: `cflow flow` writes them by default")
        groups = MovingGroups.of(sweeps, result)
        self.times = self._times(sweeps)
        self.floor = Floor.of(sweeps.pc0)
        groups = groups.divide(torch.where(of_own_vehicle(groups, sweeps), -1, 0))
        tracks, points = self._predict(self.times, groups.point.device)
        groups = regroup(groups, tracks)
        matches = match(tracks, points.position, points.track, groups)
        flow = groups.mean(groups.step)
        sensor = groups.point.new_tensor(pose_of(sweeps.pc0)[:3, 3])
        tracks, track_of_group = self._update(tracks, groups, flow, matches, self.times, sensor)
        track_of_point = _track_of_point(groups, matches, track_of_group)
        has_track = track_of_point >= 0
        track_id = torch.full((len(result.residual_flow),), -1, device=track_of_point.device)
        track_id[groups.row[has_track]] = tracks.id[track_of_point[has_track]]
        table = self._table(tracks, self.times.now, sweeps.pc0.timestamp_ns)

        step = tracks.motion.velocity * self.times.interval
        step[track_of_group] = flow
        points = _missing_points(points, tracks, step).followed_by(_seen_points(groups, track_of_point, step))
        self._keep(tracks._replace(box=tracks.box + step, path=tracks.path + step), points)
        self._num_sweeps += 1
        return Tracked(table, track_id.cpu().numpy())

    def _keep(self, tracks: TrackStates, points: _TrackPoints) -> None:
        """Keep the tracks that were seen lately, and their points, for the next sweep."""
        is_kept = tracks.missed <= _MAX_MISSED
        self._tracks = tracks.take(is_kept)
        self._points = points.renumber(torch.where(is_kept, is_kept.cumsum(0) - 1, -1))

    def _times(self, sweeps: Window) -> Times:
        """Return the times of the pair t, t+1, and note them for the next one."""
        begin = sweeps.pc0.timestamp_ns
        end = sweeps.pc1.timestamp_ns
        last, due = self._clock or (None, 0.0)
        now = due
        interval = self._interval
        if begin is not None and end is not None:
            now = begin * 1e-9
            interval = (end - begin) * 1e-9
        elapsed = interval if last is None else now - last
        if not (interval > 0 and elapsed > 0):
            late = f"t is {elapsed:.3f} s after the last sweep" if interval > 0 else f"t+1 is {interval:.3f} s after t"
            raise CFlowError(f"sweep {late}: push sweeps in the order of time")
        self._clock = now, now + interval
        return Times(now, interval, elapsed, late=0.0 if last is None else now - due)

    def _predict(self, times: Times, device: torch.device) -> tuple[TrackStates, _TrackPoints]:
        """Move the tracks and their points to t.

        The last flow has already moved boxes and points. If the sweep is late, their velocity moves them further. If it
        is later than tracks survive, there are none.
        """
        if _is_after_pause(times):
            self._tracks = TrackStates()
            self._points = _NO_POINTS
        tracks = self._tracks.map(lambda values: values.to(device))
        position, track = (values.to(device) for values in self._points)
        late = times.late * tracks.motion.velocity
        points = _TrackPoints(position + late[track], track)
        tracks = tracks._replace(box=tracks.box + late, path=tracks.path + late, travel=tracks.travel + late)
        return tracks.predict(times.elapsed), points

    def _update(
        self,
        tracks: TrackStates,
        groups: MovingGroups,
        flow: Tensor,
        matches: TrackMatches,
        times: Times,
        sensor: Tensor,
    ) -> tuple[TrackStates, Tensor]:
        """Begin tracks for groups without a match, and update all tracks by the mean flow (G, 3) of each group.

        Returns the tracks, new ones last, and the (G,) int64 track of each group.
        """
        velocity = tracks.motion.velocity[matches.track]
        is_fast = velocity[:, :2].norm(dim=1) >= MOVING / times.interval
        heading = torch.atan2(flow[:, 1], flow[:, 0])
        track_heading = torch.atan2(velocity[:, 1], velocity[:, 0])
        heading[matches.group] = torch.where(is_fast, track_heading, tracks.heading[matches.track])
        box, size = enclosing_boxes(*groups.moving, heading)

        is_new = torch.ones_like(groups.count, dtype=torch.bool)
        is_new[matches.group] = False
        number = is_new.cumsum(0) - 1  # index of a new track among the new ones
        track_of_group = len(tracks.id) + number
        track_of_group[matches.group] = matches.track
        new = track_of_group[is_new]
        tracks = tracks.extend(len(new))
        tracks.write(new, id=self._num_tracks + number[is_new], begin=times.now, path=box[is_new])
        tracks.write(new, start=box[is_new], start_length=size[is_new, 0])
        state = torch.stack([box, flow / times.interval], 1)
        tracks.write(new, state=state[is_new], covariance=_UNKNOWN * torch.eye(2, dtype=box.dtype, device=box.device))
        self._num_tracks += len(new)

        length = tracks.size[matches.track, 0]
        tracks.missed.add_(1)
        tracks.is_moving.fill_(False)
        tracks.cluster.fill_(-1)
        tracks.write(track_of_group, box=box, size=size, heading=heading, is_moving=True, missed=0)
        tracks.write(track_of_group, num_points=groups.count, cluster=groups.cluster, confidence=groups.confidence)
        stopped = matches.stopped
        tracks.write(stopped, missed=0, num_points=torch.maximum(matches.num_points, tracks.num_points[stopped]))
        tracks.num_moving[track_of_group] += 1
        tracks.start_again(matches.track, length)
        tracks.add_evidence(track_of_group, groups.confidence)
        tracks.is_confirmed.logical_or_(tracks.have_shown_motion())
        tracks.travel[track_of_group] += flow  # to the next sweep

        self._measure(tracks, track_of_group, groups, flow / times.interval, sensor)
        position = tracks.motion.position[stopped]
        at_rest = torch.stack([position, torch.zeros_like(position)], 1)
        tracks.measure(stopped, at_rest, at_rest.new_tensor([_REST_NOISE, FLOW_NOISE]).expand(len(stopped), 2))
        return tracks, track_of_group

    def _measure(
        self, tracks: TrackStates, track_of_group: Tensor, groups: MovingGroups, velocity: Tensor, sensor: Tensor
    ) -> None:
        """Update the whole boxes of moving tracks by the visible edges and the mean velocity (G, 3) of their groups."""
        heading = tracks.heading[track_of_group]
        height = torch.from_numpy(self.floor.below(tracks.box[track_of_group].cpu().numpy())).to(heading.device)
        edges = Edges.of(*groups.moving, sensor.expand_as(velocity), heading, height)
        kind, whole = self._whole_sizes(tracks, track_of_group, edges, velocity)
        centre, deviation = edges.anchor(whole, kind)
        measured = torch.stack([turned(centre, heading), velocity], 1)
        noise = torch.stack([deviation, torch.full_like(deviation, FLOW_NOISE)], 1)
        tracks.write(track_of_group, whole=whole, kind=kind)
        tracks.measure(track_of_group, measured, noise)

    def _whole_sizes(
        self, tracks: TrackStates, track_of_group: Tensor, edges: Edges, velocity: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Estimate kind (G,) and whole size (G, 3) of each group from what was seen of its track in recent sweeps."""
        count = len(track_of_group)
        path = turned(tracks.path[track_of_group], -tracks.heading[track_of_group])
        self._recent.append(_SeenEdges(tracks.id[track_of_group], edges.relative_to(path)))
        recent = _SeenEdges.join(self._recent, path.device)
        group_of_id = torch.full((self._num_tracks,), -1, device=path.device)
        group_of_id[tracks.id[track_of_group]] = torch.arange(count, device=path.device)
        group = group_of_id[recent.id]
        is_seen = group >= 0
        return kinds_and_sizes(recent.edges.at(is_seen), group[is_seen], count, velocity[:, :2].norm(dim=1))

    def _table(self, tracks: TrackStates, now: float, stamp: int | None) -> dict[str, np.ndarray]:
        rows: Any = tracks.take(tracks.missed == 0).map(lambda values: values.cpu().numpy())
        return {
            "sweep": np.full(len(rows.id), self._num_sweeps),
            "timestamp_ns": np.full(len(rows.id), self._num_sweeps if stamp is None else stamp),
            "id": rows.id,
            **dict(zip(CENTRE, rows.state[:, 0].T)),
            **dict(zip(VELOCITY, rows.state[:, 1].T)),
            "velocity_std": np.sqrt(rows.covariance[:, 1, 1]),
            **dict(zip(SIZE, rows.whole.T)),
            "heading": rows.heading,
            "class": np.array(KINDS)[rows.kind],
            "age": now - rows.begin,
            "num_moving": rows.num_moving,
            "is_moving": rows.is_moving,
            "is_confirmed": rows.is_confirmed,
            "cluster_id": rows.cluster,
            "num_points": rows.num_points,
            "confidence": rows.confidence,
        }


def _is_after_pause(times: Times) -> bool:
    """Test whether no sweep came for so long that tracks and their velocities are worth nothing."""
    return times.late > max(_MAX_MISSED * times.interval, _LONGEST_PAUSE)


def _track_of_point(groups: MovingGroups, matches: TrackMatches, track_of_group: Tensor) -> Tensor:
    """Return the track of each point that moves or lies in the box of a stopped object, (P,) int64; -1 = none."""
    track = torch.full_like(groups.group, -1)
    track[groups.moves] = track_of_group[groups.group[groups.moves]]
    track[~groups.moves] = matches.track_of_static
    return track


def _missing_points(points: _TrackPoints, tracks: TrackStates, step: Tensor) -> _TrackPoints:
    """Move the points of tracks that are not seen by the steps of their tracks, (K, 3) metres."""
    is_missing = tracks.missed[points.track] > 0
    track = points.track[is_missing]
    return _TrackPoints(points.position[is_missing] + step[track], track)


def _seen_points(groups: MovingGroups, track_of_point: Tensor, step: Tensor) -> _TrackPoints:
    """Move moving points by their own flow, and all others by the steps of their tracks, (K, 3) metres."""
    has_track = track_of_point >= 0
    track = track_of_point[has_track]
    moves = groups.moves[has_track, None]
    return _TrackPoints(groups.point[has_track] + torch.where(moves, groups.step[has_track], step[track]), track)


def track(
    log: Log, results: Iterable[tuple[int, FlowResult]] | None = None, sweep_interval: float = 0.1
) -> dict[str, np.ndarray]:
    """Track the moving objects of a drive, each with one id.

    Args:
        log: the drive. Without poses, we assume that all sweeps are in one frame, the world.
        results: (index, flow of sweep `index` to `index + 1`), ascending; sweeps without a result are bridged. None =
            estimate the flow of `log.pairs` with the preset `default`.
        sweep_interval: seconds from sweep to sweep where sweeps have no time stamps.

    Returns:
        Column -> (R,) array, which `pandas.DataFrame(table)` takes. There is a row for each track and sweep in which it
        is seen, sorted by sweep, then id. In up to three sweeps before its flow begins, and in such gaps, it is seen
        where enough points are in the place from which its flow comes. In a sweep without a result that follows one
        with a result, such as the last sweep, it is seen where enough points are in the place to which its flow leads.
        No track goes on after a pause that is longer than three intervals and longer than a second. The columns are:
        `sweep`, `timestamp_ns`, `id`;
        x, y, z: smoothed centre of the whole box, metres in the world; vx, vy, vz: its velocity over ground, m/s;
        `velocity_std`: m/s, standard deviation of each of vx, vy and vz, if errors are independent;
        length (along the heading), width, height: metres, of the whole box, the same in all rows of a track;
        `heading`: radians in the world from +x to the left, from the motion, kept at rest;
        `class`: pedestrian, cyclist, car or truck, by size and speed alone;
        `age`: seconds since the track was first seen; `num_moving`: sweeps so far in which it moved; where its flow is
        missing, the number of the sweep whose flow led there;
        `is_moving`: False = the track moved before, and is static now;
        `cluster_id`: of this sweep's flow, -1 while it is static or where its flow is missing; `num_points`;
        `confidence`: of the flow when it last moved, NaN where the method has none;
        `is_confirmed`: True as soon as the track has moved enough. With enough confidence, both ends of its box must
        have moved by 0.3 m plus a tenth of its length, and the box by 0.5 to 2 times its summed flow. With much, it is
        enough that one end has moved by its summed flow ± 25 %, at least 0.3 m plus a twentieth of the length.
        Otherwise, and if it is narrower or lower than 0.12 m, its flow in at least three sweeps must add up to the
        larger of 1.5 m and its length, and the box must have moved by this sum ± 25 %. Tracks that are never confirmed
        are left out. Points whose place also holds static points before the track comes and after it has left are not
        of the track. A track of which this holds for most of its points, in most of the sweeps in which it moves, is
        left out.

    Raises:
        CFlowError: a sweep cannot be read, or a result does not belong to its sweep.

    Cost: one CPU thread. More threads take longer, because the work is many small operations.
    """
    return track_points(log, results, sweep_interval)[0]


def track_points(
    log: Log, results: Iterable[tuple[int, FlowResult]] | None = None, sweep_interval: float = 0.1
) -> tuple[dict[str, np.ndarray], list[TrackedPoints]]:
    """Track the moving objects of a drive, and return the table of `track` and the points of the tracks.

    Arguments and errors are those of `track`. There is a `TrackedPoints` for each sweep with a result, and for the
    sweep after it if that has none, in order. They also have the ids of tracks that are never confirmed;
    `each.track_id(table["id"])` leaves these out.
    """
    if results is None:
        model = make_model(make_config("default"))
        log = CachedLog(log, model.config.num_sweeps)
        num_history = model.config.num_history
        results = ((index, model([window(log, index, num_history)])[0]) for index in log.pairs)
    tracker = LogTracker(CachedLog(log, 2), sweep_interval)
    for pair in results:
        if not (isinstance(pair, tuple) and len(pair) == 2):
            raise CFlowError(
                f"results holds {type(pair).__name__}: give pairs (index of the sweep, its flow), such as "
                "enumerate(results)"
            )
        index, result = pair
        tracker.push(index, result)
    return tracker.table(), tracker.points


class LogTracker:
    """Track the moving objects of a log as its flow arrives, and complete their boxes at the end.

    Arguments are those of `track`. The flow of an object often begins a few sweeps late, or has gaps. So we look for
    each track in up to three sweeps before, where its flow says that it was. After the last flow, and before a gap, we
    look for each track in the next sweep, where its flow says that it will be.
    """

    def __init__(self, log: Log, sweep_interval: float = 0.1) -> None:
        self._log = TimedLog(log, sweep_interval)
        self._tracker = Tracker(sweep_interval)
        self._sweeps: list[SweepTracks] = []
        self._after: int | None = None  # index of the sweep after the last one that was pushed; None = we looked there
        self._last: dict[int, int] = {}  # id -> number of the last sweep in which the track is seen

    def push(self, index: int, result: FlowResult) -> None:
        """Continue the tracks by the flow of sweep `index`; indices ascend."""
        if self._after != index:
            self._find_after()
        sweeps = window(self._log, index)
        table, track_id = self._tracker.push(sweeps, result)
        self._after = index + 1
        if _is_after_pause(self._tracker.times):
            for each in self._sweeps[-_MAX_MISSED:]:
                each.free = None  # new tracks were not there
        points = TrackedPoints.of(index, sweeps, result, track_id, self._tracker.times, self._tracker.floor)
        free = FreePoints.of(sweeps.pc0, as_numpy(result.is_valid), points.row)
        now = SweepTracks(table, points, int(self._log.timestamps[index]), free)
        self._find_before(now)
        self._append(now)

    def _append(self, now: SweepTracks) -> None:
        self._sweeps.append(now)
        if len(self._sweeps) > _MAX_MISSED:
            self._sweeps[-_MAX_MISSED - 1].free = None  # to save memory

    def _find_after(self) -> None:
        """Look for all tracks in the sweep after the last one that was pushed, which has no flow."""
        if self._after is not None:
            sweep = self._log.sweep(self._after)
            now = SweepTracks.after(self._sweeps[-1], sweep, int(self._log.timestamps[self._after]))
            self._last.update(dict.fromkeys(now.table["id"].tolist(), len(self._sweeps)))
            self._append(now)
            self._after = None

    def _find_before(self, now: SweepTracks) -> None:
        """Look for tracks that move now in the sweeps before, up to three, in which they were not seen."""
        count = len(self._sweeps)
        for row, number in enumerate(now.table["id"].tolist()):
            first = max(self._last.get(number, -1) + 1, count - _MAX_MISSED, 0)
            self._last[number] = count
            if now.table["is_moving"][row]:
                for before in reversed(self._sweeps[first:count]):
                    if not before.find(now, row):
                        break

    @property
    def points(self) -> list[TrackedPoints]:
        """The points of the tracks of each sweep that was pushed, and of those that followed without a flow."""
        return [each.points for each in self._sweeps]

    @one_thread()
    def table(self) -> dict[str, np.ndarray]:
        """Return the table of `track`."""
        self._find_after()
        self._take_out_static_points()
        table = self._whole()
        return self._whole() if divide_people(self._sweeps, table) else table

    def _take_out_static_points(self) -> None:
        """Take static points out of confirmed tracks.

        A track is not seen in a sweep where most of its points are static. If this is so in most of the sweeps in which
        it moves, it is not a track.
        """
        sweeps_of: dict[int, list[SweepTracks]] = {}
        for each in self._sweeps:
            for number in np.unique(each.points.id).tolist():
                sweeps_of.setdefault(number, []).append(each)
        for number in np.unique(self._confirmed()["id"]).tolist():
            sweeps = sweeps_of[number]
            seen = [Sighting(each.points.of_track(number)[0], each.static) for each in sweeps]
            is_static = static_points(seen)
            share = np.array([each.mean() for each in is_static])
            moves = np.array([each.table["is_moving"][each.table["id"] == number][0] for each in sweeps])
            is_wall = np.median(share[moves]) > _MOST_STATIC
            for each, points, is_lost in zip(sweeps, is_static, is_wall | (share > _MOST_STATIC)):
                if points.any() or is_lost:
                    each.divide(number, np.where(points | is_lost, -1, number))

    def _confirmed(self) -> dict[str, np.ndarray]:
        return confirmed(join_tables([each.table for each in self._sweeps]))

    def _whole(self) -> dict[str, np.ndarray]:
        return complete(self._confirmed(), self.points)
