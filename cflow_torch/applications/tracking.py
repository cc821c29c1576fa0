"""Objects through time: the moving groups of each sweep, linked by their own flow, and filtered in the world frame."""

from __future__ import annotations

from typing import Dict, Iterable, NamedTuple

import numpy as np
import torch
from torch import Tensor

from cflow_torch.applications.kalman import States
from cflow_torch.applications.linking import box_of_point, boxes, link
from cflow_torch.applications.moving_groups import MIN_POINTS, MOVING, MovingGroups
from cflow_torch.applications.track_table import confirmed, join_tables
from cflow_torch.config import make_config
from cflow_torch.data.log import CachedLog, Log, window
from cflow_torch.estimate import make_model
from cflow_torch.types import CFlowError, FlowResult, Window

# A track is confirmed by what it has shown while it moved: most groups that do not last are noise of what stands.
_MIN_MOVING = 3  # sweeps
_MIN_EVIDENCE = 2.0  # sum of the log-odds of its confidence
_NO_CONFIDENCE = 0.7  # log-odds, of methods without
_THIN = 0.12  # metres; a narrower box is no evidence: posts, and slices of fronts along which a shadow glides
_MIN_WAY = (0.5, 0.5)  # metres that its box must have gone the way of its flow, and their share of that way
_MIN_SHARE = 0.1  # of voxels that two groups have in common, for a link
_STANDS = 0.3  # share of a track's points that must be found in its box where it is said to stand
_MARGIN = 0.2  # metres by which that box is larger
_MAX_MISSED = 3  # sweeps that a track survives unseen
_ACCELERATION = 3.0  # m/s², standard deviation
_NOISE = (0.4, 0.02)  # standard deviations: metres of a box's centre, metres per sweep of a group's flow


# Of K tracks, by name: states; the measured box; where the next sweep should have it (place), where it was first
# (start), and the sum of its flow since (way); when that was (begin, seconds).
_Tracks = Dict[str, Tensor]
_NO_TRACKS: _Tracks = {
    **{
        name: torch.zeros(0, 3, dtype=torch.float64)
        for name in ("position", "velocity", "place", "size", "start", "way")
    },
    **{name: torch.zeros(0, dtype=torch.float64) for name in ("heading", "begin", "confidence", "evidence")},
    **{name: torch.zeros(0, dtype=torch.int64) for name in ("id", "num_points", "cluster", "num_moving", "missed")},
    **{name: torch.zeros(0, dtype=torch.bool) for name in ("is_moving", "is_confirmed")},
    "covariance": torch.zeros(0, 2, 2, dtype=torch.float64),
}


class Tracked(NamedTuple):
    """What a `Tracker` says about one sweep.

    Args:
        table: a row for each track that is seen in the sweep, see `track`.
        track_id: (N,) int64 for every point of the sweep, -1 = of no track.
    """

    table: dict[str, np.ndarray]
    track_id: np.ndarray


class Tracker:
    """Links moving groups over the sweeps of a drive, sweep by sweep.

    A group's points, moved by its flow, overlap with the points of one group of the next sweep. What stops is followed
    as long as there are points in its box; what is not seen for up to three sweeps is expected where its velocity takes
    it. Memory: the points of the tracks that are alive.

    Args:
        sweep_interval: seconds from sweep to sweep where sweeps have no time stamps.

    Example:
        >>> tracker = Tracker()
        >>> for window in windows(log, num_history=model.config.num_history):
        ...     table, track_id = tracker.push(window, model([window])[0])
    """

    def __init__(self, sweep_interval: float = 0.1) -> None:
        if not sweep_interval > 0:
            raise CFlowError(f"sweep_interval={sweep_interval}: give the seconds from one sweep to the next")
        self._interval = sweep_interval
        self._clock: tuple[float, float] | None = None  # of the last sweep, and when its flow ends
        self._num_sweeps, self._num_tracks = 0, 0
        self._tracks: _Tracks = {}
        self._points, self._owner = torch.zeros(0, 3, dtype=torch.float64), torch.zeros(0, dtype=torch.int64)

    def push(self, sweeps: Window, result: FlowResult) -> Tracked:
        """Go on by one sweep.

        Args:
            sweeps: the window of the pair t, t+1; its pc0, the poses and the time stamps are looked at.
            result: its flow; residual_flow, cluster_id, is_valid and, if there, confidence.

        Returns:
            The tracks at t. Those that are not `is_confirmed` (yet) are mostly noise of what stands.

        Raises:
            CFlowError: a sweep that is not later than the one before, a result of another sweep, or without what is
                needed.
        """
        if any(getattr(result, name) is None for name in ("residual_flow", "cluster_id", "is_valid")):
            raise CFlowError("tracks need residual flow, cluster_id and is_valid: `cflow flow` writes them by default")
        now, interval, elapsed, late = self._times(sweeps)
        seen = MovingGroups.of(sweeps, result)
        tracks, points, owner = self._predicted(seen.point.device, elapsed, late)
        linked, group, stands, boxed = self._found(tracks, points, owner, seen)
        flow = seen.mean(seen.step)
        tracks, of_group = self._measured(tracks, seen, flow, (linked, group), stands, (now, interval))

        # Which track each point is of, and where the next sweep should have it.
        moves = seen.group >= 0
        point_track = torch.full_like(seen.group, -1)
        point_track[moves] = of_group[seen.group[moves]]
        point_track[~moves] = boxed
        has = point_track >= 0
        track_id = torch.full((len(result.residual_flow),), -1, device=owner.device)
        track_id[seen.row[has]] = tracks["id"][point_track[has]]
        onward = tracks["velocity"] * interval
        onward[of_group] = flow
        tracks["place"] = tracks["place"] + onward
        missing = tracks["missed"][owner] > 0
        moved = seen.point[has] + torch.where(moves[has, None], seen.step[has], onward[point_track[has]])
        points = torch.cat([points[missing] + onward[owner[missing]], moved])
        table = self._table(tracks, now, sweeps.pc0.timestamp_ns)
        self._keep(tracks, points, torch.cat([owner[missing], point_track[has]]))
        self._num_sweeps += 1
        return Tracked(table, track_id.cpu().numpy())

    def _predicted(self, device: torch.device, elapsed: float, late: float) -> tuple[_Tracks, Tensor, Tensor]:
        """Tracks, and their points with the numbers of their tracks, where they are expected now.

        Boxes and points are where the last flow brings them, and go on by `late` seconds if that was for too short.
        """
        tracks = {name: values.to(device) for name, values in (self._tracks or _NO_TRACKS).items()}
        points, owner = self._points.to(device), self._owner.to(device)
        tracks["place"] = tracks["place"] + late * tracks["velocity"]
        tracks.update(vars(_states(tracks).predict(elapsed, _ACCELERATION)))
        return tracks, points + late * tracks["velocity"][owner], owner

    @staticmethod
    def _found(
        tracks: _Tracks, points: Tensor, owner: Tensor, seen: MovingGroups
    ) -> tuple[Tensor, Tensor, tuple[Tensor, Tensor], Tensor]:
        """Tracks and the groups that they are linked to; tracks that stand, with how many points; and of each point
        that does not move, the track whose box it is in, -1 = none."""
        moves = seen.group >= 0
        linked, group = link(points, owner, seen.point[moves], seen.group[moves], _MIN_SHARE)
        may_stand = tracks["is_confirmed"].clone()
        may_stand[linked] = False
        waiting = may_stand.nonzero()[:, 0]
        size = tracks["size"][waiting] + _MARGIN
        boxed = box_of_point(seen.point[~moves], tracks["place"][waiting], size, tracks["heading"][waiting])
        count = torch.bincount(boxed[boxed >= 0], minlength=len(waiting))
        is_there = count >= (_STANDS * tracks["num_points"][waiting]).clamp(min=MIN_POINTS)
        of_box = torch.cat([torch.where(is_there, waiting, -1), waiting.new_full((1,), -1)])
        return linked, group, (waiting[is_there], count[is_there]), of_box[boxed]

    def _measured(
        self,
        tracks: _Tracks,
        seen: MovingGroups,
        flow: Tensor,
        links: tuple[Tensor, Tensor],
        stands: tuple[Tensor, Tensor],
        times: tuple[float, float],
    ) -> tuple[_Tracks, Tensor]:
        """The tracks after this sweep, new ones last, and the track of each group."""
        (linked, group), (now, interval), num_old = links, times, len(tracks["id"])
        heading = torch.atan2(flow[:, 1], flow[:, 0])
        velocity = tracks["velocity"][linked]
        is_fast = velocity[:, :2].norm(dim=1) >= MOVING / interval
        heading[group] = torch.where(is_fast, torch.atan2(velocity[:, 1], velocity[:, 0]), heading[group])
        moves = seen.group >= 0
        centre, size = boxes(seen.point[moves], seen.group[moves], heading)
        is_new = torch.ones_like(seen.count, dtype=torch.bool)
        is_new[group] = False
        of_group = num_old + is_new.cumsum(0) - 1
        of_group[group] = linked
        noise = centre.new_tensor([_NOISE[0], _NOISE[1] / interval])

        count = int(is_new.sum())
        fresh = {name: values.new_zeros(count, *values.shape[1:]) for name, values in tracks.items()}
        fresh["id"] += self._num_tracks + torch.arange(count, device=centre.device)
        fresh["covariance"] += torch.diag(noise**2)
        fresh["begin"] += now
        fresh.update(start=centre[is_new], position=centre[is_new], velocity=flow[is_new] / interval)
        self._num_tracks += count
        tracks = {name: torch.cat([values, fresh[name]]) for name, values in tracks.items()}

        tracks["missed"] += 1
        tracks["is_moving"][:] = False
        tracks["cluster"][:] = -1
        measured = {"place": centre, "size": size, "heading": heading, "num_points": seen.count}
        measured.update(cluster=seen.cluster, confidence=seen.confidence)
        measured.update(is_moving=torch.ones_like(is_new), missed=torch.zeros_like(seen.count))
        for name, values in measured.items():
            tracks[name][of_group] = values
        tracks["missed"][stands[0]] = 0
        tracks["num_points"][stands[0]] = torch.maximum(stands[1], tracks["num_points"][stands[0]])
        tracks["num_moving"][of_group] += 1
        odds = torch.logit(seen.confidence, 0.01).nan_to_num(_NO_CONFIDENCE)
        tracks["evidence"][of_group] += odds * (size[:, :2].amin(1) >= _THIN)
        _confirm(tracks)
        tracks["way"][of_group] += flow  # to the next sweep

        both, step = torch.cat([linked, stands[0]]), torch.zeros_like(tracks["place"])
        step[of_group] = flow
        old = _states({name: values[both] for name, values in tracks.items()})
        better = old.update(tracks["place"][both], step[both] / interval, noise.expand(len(both), 2))
        for name, values in vars(better).items():
            tracks[name][both] = values
        return tracks, of_group

    def _times(self, sweeps: Window) -> tuple[float, float, float, float]:
        """Seconds: of t; from t to t+1; from the sweep before to t; of these, what its flow does not span."""
        begin, end = sweeps.pc0.timestamp_ns, sweeps.pc1.timestamp_ns
        has_times = begin is not None and end is not None
        interval = (end - begin) * 1e-9 if has_times else self._interval  # type: ignore[operator]
        last, due = self._clock or (None, None)
        now = begin * 1e-9 if has_times else 0.0 if due is None else due  # type: ignore[operator]
        self._clock = now, now + interval
        if last is None or due is None:
            return now, interval, interval, 0.0
        if now <= last:
            raise CFlowError(f"a sweep {last - now:.3f} s before the last one: push sweeps in the order of time")
        return now, interval, now - last, now - due

    def _table(self, tracks: _Tracks, now: float, stamp: int | None) -> dict[str, np.ndarray]:
        part = {name: values[tracks["missed"] == 0].cpu().numpy() for name, values in tracks.items()}
        count = len(part["id"])
        axes = {"": part["position"], "v": part["velocity"]}
        columns = {f"{name}{axis}": values[:, k] for name, values in axes.items() for k, axis in enumerate("xyz")}
        return {
            "sweep": np.full(count, self._num_sweeps),
            "timestamp_ns": np.full(count, self._num_sweeps if stamp is None else stamp),
            "id": part["id"],
            **columns,
            "velocity_std": np.sqrt(part["covariance"][:, 1, 1]),
            **dict(zip(("length", "width", "height"), part["size"].T)),
            "heading": part["heading"],
            "age": now - part["begin"],
            "num_moving": part["num_moving"],
            "is_moving": part["is_moving"],
            "is_confirmed": part["is_confirmed"],
            "cluster_id": part["cluster"],
            "num_points": part["num_points"],
            "confidence": part["confidence"],
        }

    def _keep(self, tracks: _Tracks, points: Tensor, owner: Tensor) -> None:
        """Forget tracks that have not been seen for too long."""
        lives = tracks["missed"] <= _MAX_MISSED
        number = torch.where(lives, lives.cumsum(0) - 1, -1)[owner]
        self._tracks = {name: values[lives] for name, values in tracks.items()}
        self._points, self._owner = points[number >= 0], number[number >= 0]


def track(
    log: Log, results: Iterable[tuple[int, FlowResult]] | None = None, sweep_interval: float = 0.1
) -> dict[str, np.ndarray]:
    """The moving objects of a drive, each with one id.

    Args:
        log: the drive. Without poses, all sweeps lie in one frame, which is then the world.
        results: (index, flow of sweep `index` to `index + 1`), ascending; sweeps without a result are bridged. None =
            flow of the preset `default`, estimated now.
        sweep_interval: seconds from sweep to sweep where sweeps have no time stamps.

    Returns:
        Column -> (R,) array, a row per track and sweep in which it is seen, sorted by sweep, then id: `sweep`,
        `timestamp_ns`, `id`; x, y, z middle of the box, filtered, metres in the world; vx, vy, vz m/s over ground,
        filtered; `velocity_std` m/s, standard deviation of each of the three (errors are taken to be independent);
        length (along the heading), width, height metres, of what is seen of it; `heading` radians in the world from +x
        to the left; `age` seconds since it was first seen; `num_moving` sweeps so far in which it moved; `is_moving`,
        False = it has moved and stands now; `cluster_id` of this sweep's flow, -1 where it stands; `num_points`;
        `confidence` of the flow when it last moved, NaN where the method has none.
        `pandas.DataFrame(table)` takes it. `is_confirmed` is True from the sweep on in which enough has been seen of
        its motion: three sweeps, half a metre, and confidence; tracks that never get there are left out.

    Raises:
        CFlowError: see `Tracker.push`; a sweep cannot be read.
    """
    if results is None:
        model = make_model(make_config("default"))
        recent = CachedLog(log, model.config.num_sweeps)
        every = (window(recent, index, model.config.num_history) for index in range(len(log.timestamps) - 1))
        results = ((index, model([sweeps])[0]) for index, sweeps in enumerate(every))
    else:
        recent = CachedLog(log, 2)
    tracker, tables = Tracker(sweep_interval), []
    for index, result in results:
        table = tracker.push(window(recent, index), result).table
        where = {"sweep": index, "timestamp_ns": int(log.timestamps[index])}
        tables.append({**table, **{name: np.full(len(table["id"]), value) for name, value in where.items()}})
    return confirmed(join_tables(tables))


def _confirm(tracks: _Tracks) -> None:
    """Say of each track whether it has shown by now that it moves: by evidence, and by the way that its box has gone
    beside the way that its flow tells."""
    way = tracks["way"].norm(dim=1)
    along = ((tracks["place"] - tracks["start"]) * tracks["way"]).sum(1) / way.clamp(min=1e-9)
    has_gone = tracks["is_moving"] & (along >= (_MIN_WAY[1] * way).clamp(min=_MIN_WAY[0]))
    is_evident = (tracks["num_moving"] >= _MIN_MOVING) & (tracks["evidence"] >= _MIN_EVIDENCE)
    tracks["is_confirmed"] |= has_gone & is_evident


def _states(tracks: _Tracks) -> States:
    return States(tracks["position"], tracks["velocity"], tracks["covariance"])
