"""Write labels for self-supervised training into OpenSceneFlow's scenes: moving points, and groups of points.

A group moves if some of its points have a flow of at least `MOVING`, and the mean confidence of these points plus their
agreement is at least `AGREEMENT`. The agreement, 0 ... 1, is the share of these points for which we find a similar
motion at the predicted position, averaged over the sweeps before and after. False motion of a single window (leaves,
edges that come into view) rarely passes. Like tracks, labels do not ask for P(moving), because several sweeps tell more
than one.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any, Callable, Iterable, Iterator, NamedTuple, Sequence

import numpy as np

from cflow_torch.applications.moving_groups import MOVING, pose_of, world_points
from cflow_torch.data.catalog import open_log
from cflow_torch.data.hdf5.writer import write_hdf5_labels
from cflow_torch.data.log import CachedLog, Log, window
from cflow_torch.errors import import_optional
from cflow_torch.model import SceneFlowModel
from cflow_torch.transforms import transform_points
from cflow_torch.types import CFlowError, FlowResult, Sweep, Window, as_numpy

AGREEMENT = 1.3  # we chose it on simulated drives of five sensors, seeds 100 to 103, and on KITTI 0000
_MAX_DISTANCE = 0.5  # metres from the predicted position of a point to the nearest moving point, at most
_SIMILAR = (0.1, 0.5)  # largest difference of motions that agree: metres, or share of the motion if that is more
_MIN_POINTS = 20  # of a static group, as in OpenSceneFlow's own recipe
_MAX_GROUPS = 32_767  # the largest int16
_WRONG_NUMBER = "log {} has {} pairs and {} flows: give one for each pair, in order"
_NND = (0.14, 4.4)  # metres from a point to the nearest one of the next sweep: 5 to 160 km/h at 10 Hz


class DynamicPoints(NamedTuple):
    """The M points of a sweep with a flow of at least `MOVING`."""

    rows: np.ndarray  # (M,) int64
    positions: np.ndarray  # (M, 3) float64, metres, world
    velocity: np.ndarray  # (M, 3) float64, m/s, world
    group: np.ndarray  # (M,) int64 cluster_id
    confidence: np.ndarray  # (M,) float64
    seconds: float  # time of the sweep


def label_scene(file: str | Path, model: SceneFlowModel, find_ground: str = "grid", overwrite: bool = False) -> int:
    """Estimate the flow of a scene, write labels of all sweeps into its file, and return the number of sweeps.

    Args:
        file: `<scene>.h5` in OpenSceneFlow's layout.
        model: a `VerifiedFlow`; the preset `offline` is the most accurate.
        find_ground: method for the ground of sweeps without a mask, "grid" or "patchwork".
        overwrite: replace labels that the scene already has.

    Raises:
        CFlowError: the scene cannot be read or written, it already has labels, or the model gives no confidence. The
            file is then unchanged.
    """
    log = open_log("hdf5", file, find_ground=find_ground)
    cached = CachedLog(log, model.config.num_sweeps)
    sweeps = (window(cached, index, model.config.num_history, model.config.num_future) for index in log.pairs)
    flows = (model([each])[0] for each in sweeps)
    return write_hdf5_labels(file, find_labels(log, flows, model), overwrite=overwrite)


def find_labels(
    log: Log, flows: Iterable[FlowResult], model: SceneFlowModel, workers: int = 1
) -> Iterator[tuple[int, dict[str, np.ndarray]]]:
    """Yield the labels of every sweep of a log.

    Args:
        log: its sweeps have ground masks and poses.
        flows: results of all pairs (`log.pairs`), in order, by the verified method.
        model: the method that computed `flows`. It also estimates the flow from the last sweep to the one before, and
            from the last one before each gap.
        workers: threads of the nearest-neighbour search for `nnd`.

    Yields:
        (time stamp, labels), in order. The labels of N points are:
        `ground_mask` (N,) bool.
        `dufo` (N,) uint8, 1 = has a flow of at least `MOVING`, in a moving group; 0 for ground.
        `cluster` (N,) int16, moving groups and groups of at least 20 points; 0 = ground or no group. Moving groups have
        the first numbers, from 1, because `seflowpp_auto` keeps numbers in 8 bits.
        `dufocluster` (N,) int16, `cluster` where `dufo` is 1, else 0.
        `nnd` (N,) uint8, 1 = the nearest point of the next sweep is 0.14 m to 4.4 m away after compensation of ego
        motion. Ground points have it, too.

    Convention: the last sweep, and one before a gap, has no successor, so its flow and its `nnd` lead to the sweep
        before. In a sweep between two gaps, nothing moves. Groups of a sweep after the 32,767th have the number 0.

    Raises:
        CFlowError: a sweep has no ground mask, a result has no confidence or not one row per point, results are
            missing, or SciPy is not installed.

    Cost: reads the log twice. Each sweep takes a nearest-neighbour search of all points, and two of the moving points.
    """
    tree: Callable[..., Any] = import_optional(
        "scipy.spatial", "labels need SciPy (extra label): pip install scipy"
    ).cKDTree
    seconds = log.sweep_times(model.config.sweep_interval)
    log = CachedLog(log, 3)
    last = [*sorted(log.gaps), len(log) - 1]
    parts = [range(begin, end + 1) for begin, end in zip([0, *(index + 1 for index in last)], last)]
    given = iter(flows)
    for part in parts:
        yield from _label_part(log, part, given, model, tree, workers, seconds)
    if next(given, None) is not None:
        raise CFlowError(_WRONG_NUMBER.format(log.log_id, len(log.pairs), "more"))


def _label_part(
    log: Log,
    part: range,
    flows: Iterator[FlowResult],
    model: SceneFlowModel,
    tree: Callable[..., Any],
    workers: int,
    seconds: np.ndarray,
) -> Iterator[tuple[int, dict[str, np.ndarray]]]:
    """Yield the labels of sweeps without a gap, see `find_labels`; `flows` goes on to those of later parts."""
    dynamic: list[DynamicPoints] = []
    groups: list[np.ndarray] = []
    others = [*part[1:], part[-2:][0]]  # index of the sweep to which the flow of each sweep leads
    for index, other in zip(part, others):
        sweep = log.sweep(index)
        result = flow_back(log, model, part) if index == part[-1] else next(flows, None)
        if result is None:
            raise CFlowError(_WRONG_NUMBER.format(log.log_id, len(log.pairs), "fewer"))
        if result.confidence is None or len(result.cluster_id) != len(sweep.points):
            raise CFlowError(
                f"flow {index} of log {log.log_id} has no confidence, or rows of another sweep: labels need the flow "
                "of each of its pairs by the preset offline or default"
            )
        if sweep.is_ground is None:
            raise CFlowError(
                f"sweep {index} of log {log.log_id} has no ground mask, which labels need: open the log with "
                "find_ground='grid'"
            )
        groups.append(as_numpy(result.cluster_id, np.int32))
        dynamic.append(_dynamic_points(sweep, log.sweep(other), result, seconds[[index, other]]))
    trees = [tree(each.positions) for each in dynamic]
    for number, (index, other) in enumerate(zip(part, others)):
        sweep = log.sweep(index)
        is_ground = as_numpy(sweep.is_ground, bool)  # type: ignore[arg-type]  # checked above
        moves = np.zeros(len(is_ground), bool)
        moves[dynamic[number].rows[_is_confirmed(dynamic, trees, number)]] = True
        moves &= ~is_ground
        cluster = _number_groups(groups[number], moves, is_ground)
        yield (
            int(log.timestamps[index]),
            {
                "ground_mask": is_ground,
                "dufo": moves.astype(np.uint8),
                "cluster": cluster,
                "dufocluster": np.where(moves, cluster, np.int16(0)),
                "nnd": _has_moved_by_nearest(tree, sweep, log.sweep(other), workers),
            },
        )


def flow_back(log: Log, model: SceneFlowModel, part: range) -> FlowResult:
    """Estimate the flow of the last sweep of a part to the one before it, by playing the part backwards.

    Up to `num_future` earlier sweeps take the place of `pcf`. The flow has the axes of the sweep before the last. In a
    part of one sweep, nothing moves.
    """
    played = [_played_backwards(log.sweep(index)) for index in part[::-1][: 2 + model.config.num_future]]
    if len(played) == 1:
        played = 2 * [replace(played[0], timestamp_ns=None, point_times=None)]
    pc0, pc1, *rest = played
    return model([Window(pc0, pc1, (), tuple(rest))])[0]


def _played_backwards(sweep: Sweep) -> Sweep:
    stamp = None if sweep.timestamp_ns is None else -sweep.timestamp_ns
    times = None if sweep.point_times is None else -as_numpy(sweep.point_times)
    return replace(sweep, timestamp_ns=stamp, point_times=times)


def _dynamic_points(sweep: Sweep, other: Sweep, result: FlowResult, seconds: np.ndarray) -> DynamicPoints:
    """Collect the moving points of a sweep whose flow leads to another one; `seconds` are the times of both."""
    residual = as_numpy(result.residual_flow, np.float64)
    group = as_numpy(result.cluster_id)
    rows = np.flatnonzero((np.linalg.norm(residual, axis=1) >= MOVING) & (group >= 0))
    interval = seconds[1] - seconds[0]  # negative where the flow leads to the sweep before
    velocity = residual[rows] @ pose_of(other)[:3, :3].T / interval
    confidence = as_numpy(result.confidence, np.float64)[rows]  # type: ignore[arg-type]  # checked before
    return DynamicPoints(rows, world_points(sweep, rows), velocity, group[rows], confidence, float(seconds[0]))


def _is_confirmed(dynamic: Sequence[DynamicPoints], trees: Sequence[Any], index: int) -> np.ndarray:
    """(M,) bool: dynamic points of sweep `index` whose group is plausible, by the threshold `AGREEMENT`."""
    own = dynamic[index]
    score = own.confidence.copy()
    neighbours = [other for other in (index - 1, index + 1) if 0 <= other < len(dynamic)]
    for other in neighbours:
        if len(dynamic[other].rows) == 0:
            continue
        interval = dynamic[other].seconds - own.seconds
        target = own.positions + interval * own.velocity
        distance, nearest = trees[other].query(target, distance_upper_bound=_MAX_DISTANCE)
        is_near = np.isfinite(distance)
        change = dynamic[other].velocity[np.where(is_near, nearest, 0)] - own.velocity
        difference, length = (abs(interval) * np.linalg.norm(each, axis=1) for each in (change, own.velocity))
        score += (is_near & (difference <= np.maximum(_SIMILAR[0], _SIMILAR[1] * length))) / len(neighbours)
    mean = np.bincount(own.group, score) / np.maximum(np.bincount(own.group), 1)
    return mean[own.group] >= AGREEMENT


def _number_groups(group: np.ndarray, moves: np.ndarray, is_ground: np.ndarray) -> np.ndarray:
    """(N,) int16: moving groups, numbered from 1 in the order of their ids, then static ones that are large enough."""
    has_group = (group >= 0) & ~is_ground
    count = np.bincount(group[has_group], minlength=1)
    is_moving = np.bincount(group[moves], minlength=len(count)) > 0
    ids = np.concatenate([np.flatnonzero(is_moving), np.flatnonzero(~is_moving & (count >= _MIN_POINTS))])
    number = np.zeros(len(count), np.int16)
    number[ids[:_MAX_GROUPS]] = np.arange(1, len(ids[:_MAX_GROUPS]) + 1)
    return np.where(has_group, number[np.where(has_group, group, 0)], np.int16(0))


def _has_moved_by_nearest(tree: Callable[..., Any], sweep: Sweep, other: Sweep, workers: int) -> np.ndarray:
    """(N,) uint8 `nnd`; 0 for points that are not finite."""
    points = transform_points(as_numpy(sweep.points)[:, :3], np.linalg.inv(pose_of(other)) @ pose_of(sweep))
    others = as_numpy(other.points)[:, :3].astype(np.float64)
    is_finite = np.isfinite(points).all(axis=1)
    nnd = np.zeros(len(points), np.uint8)
    nearest = tree(others[np.isfinite(others).all(axis=1)])
    distance, _ = nearest.query(points[is_finite], distance_upper_bound=_NND[1], workers=workers)
    nnd[is_finite] = (distance >= _NND[0]) & (distance < _NND[1])
    return nnd
