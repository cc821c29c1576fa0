"""Judge the poses of a log by a few pairs of sweeps: under which reading does the static world stand still?"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from cflow_torch.data.log import Log
from cflow_torch.errors import CFlowError
from cflow_torch.windows.readings import (
    CERTAIN,
    STILL,
    WORLD,
    Judgement,
    difference,
    is_around,
    judge,
    make_pair,
    turn_of,
)
from cflow_torch.windows.stillness import Structure

_LONGEST_STEP, _MOST_SWEEPS = 3.2, 5  # metres and sweeps between the two sweeps of a pair
_LEAST_DISTANCE = 3.0  # metres between pose and origin, to tell whose surroundings points are
# A step between two poses is suspect if it differs from its neighbours' by this, as a length or as a part of theirs.
_SUSPECT, _SUSPECT_SHARE = 0.2, 0.3
_ARM = 10.0  # metres; a rotation counts as the motion of a point that far away
_NUM_SUSPECTS = 4  # steps that are compared with the points, largest first
_CONFIRMED = 1.25  # the neighbours' motion fits better than the step between the poses, by this factor


class Lapse(NamedTuple):
    """A step between two poses that the points contradict."""

    sweep: int  # index of the sweep whose pose is wrong, or before which the poses jump
    metres: float  # how much the step differs from those around it; a rotation counts at 10 m
    is_single: bool  # True: only this pose is wrong; False: all later poses are shifted


def known_poses(log: Log) -> np.ndarray | None:
    """Return the poses that a log knows without reading points, (K, 4, 4) float64; None = it knows none."""
    try:
        poses = getattr(log, "poses", None)
    except CFlowError:
        return None
    if poses is None or np.shape(poses) != (len(log.timestamps), 4, 4) or not np.isfinite(poses).all():
        return None
    return np.asarray(poses, np.float64)


def choose_pairs(num_sweeps: int, poses: np.ndarray | None, count: int) -> list[tuple[int, int]]:
    """Choose pairs of sweeps spread over a log, up to `count`, in order.

    With poses, two pairs are those whose motion differs most from that one sweep earlier, and later, because they show
    poses that are early or late. The others are those over which the vehicle turns most, each in its part of the log.
    The sweeps of a pair are up to five apart, and up to 3.2 m, because readings differ more over a longer motion.
    """
    if poses is None:
        middle = np.linspace(0, num_sweeps - 1, 2 * count + 1).astype(int)[1::2]
        return sorted({(min(first, num_sweeps - 2), min(first, num_sweeps - 2) + 1) for first in middle.tolist()})
    pairs = [(first, _partner(poses, first)) for first in range(num_sweeps - 1)]
    inner = [pair for pair in pairs if pair[0] > 0 and pair[1] + 1 < num_sweeps]  # with poses before and after
    chosen = {max(inner, key=lambda pair: _change(poses, *pair, step)) for step in (-1, 1)} if inner else set()
    edges = np.linspace(0, num_sweeps - 1, max(count - len(chosen), 1) + 1).astype(int)
    for low, high in zip(edges, edges[1:]):
        part = [pair for pair in inner or pairs if low <= pair[0] < high and pair not in chosen]
        chosen |= {max(part, key=lambda pair: turn_of(_motion(poses, *pair)))} if part else set()
    return sorted(chosen)


def _partner(poses: np.ndarray, first: int) -> int:
    last = min(first + _MOST_SWEEPS, len(poses) - 1)
    near = np.linalg.norm(poses[first + 1 : last + 1, :3, 3] - poses[first, :3, 3], axis=1) < _LONGEST_STEP
    return first + 1 + max(int(near.cumprod().sum()) - 1, 0)


def _motion(poses: np.ndarray, first: int, second: int) -> np.ndarray:
    return np.linalg.inv(poses[second]) @ poses[first]


def _change(poses: np.ndarray, first: int, second: int, step: int) -> float:
    """Return how much the motion of a pair differs from that of the pair `step` sweeps later, metres."""
    return difference(_motion(poses, first, second), _motion(poses, first + step, second + step))


def judge_log(log: Log, count: int = 3) -> Judgement:
    """Compare the readings of the poses of a log over `count` pairs. Cost: reads two sweeps per pair, 0.1 s each."""
    poses = known_poses(log)
    judgement = _judge_pairs(log, poses, count)
    if poses is not None and not judgement.has_motion and judgement.given < CERTAIN and not judgement.best:
        return _judge_pairs(log, None, count)  # the sensor may move although the poses do not: neighbouring sweeps
    return judgement


def _judge_pairs(log: Log, poses: np.ndarray | None, count: int) -> Judgement:
    in_world = None if poses is None else _surrounds_poses(log, poses)
    pairs = []
    for first, second in choose_pairs(len(log.timestamps), poses, count):
        before = None if poses is None or first == 0 else poses[[first - 1, second - 1]]
        after = None if poses is None or second + 1 == len(poses) else poses[[first + 1, second + 1]]
        pairs.append(make_pair(log.sweep(first), log.sweep(second), before, after, in_world))
    return judge(pairs)


def is_in_world(log: Log) -> bool:
    """Test whether the points of a log are in the world's frame.

    They lie around the positions of the poses, or the poses come with the clouds (`ArraysLog.has_viewpoints`), and the
    static world stands still without the poses. False for logs without `poses`, and if a sweep that we need cannot be
    read; `sweep` will raise its error.

    Cost: reads one sweep, and up to six more if one of the signs is there.
    """
    poses = known_poses(log)
    has_viewpoints = bool(getattr(log.unwrapped, "has_viewpoints", False))
    try:
        if poses is None or not (has_viewpoints or _surrounds_poses(log, poses)):
            return False
        best = judge_log(log).best
    except (CFlowError, OSError):
        return False
    return WORLD in best or (has_viewpoints and STILL in best)


def _surrounds_poses(log: Log, poses: np.ndarray) -> bool:
    """Test whether points lie around the position of their pose, by the sweep farthest from the origin."""
    distance = np.linalg.norm(poses[:, :2, 3], axis=1)
    farthest = int(distance.argmax())
    return bool(distance[farthest] >= _LEAST_DISTANCE) and is_around(log.sweep(farthest).points, poses[farthest])


def find_lapses(log: Log) -> list[Lapse]:
    """Find poses that are wrong, and jumps of the poses, in the order of the log.

    A step between neighbouring poses is suspect if it differs from the steps around it. We read the two sweeps of the
    most suspect steps, and compare the points under the step and under that of the neighbours.
    """
    poses = known_poses(log)
    if poses is None or len(poses) < 5:
        return []
    steps = np.linalg.inv(poses[1:]) @ poses[:-1]
    interval = np.diff(np.asarray(log.timestamps, np.float64)).clip(1e-9)
    rate = steps[:, :3, 3] / interval[:, None]
    usual = np.empty_like(steps)
    for index in range(len(steps)):
        around = [k for k in range(index - 3, index + 4) if 0 <= k < len(steps) and k != index]
        turns = np.arctan2(steps[around, 1, 0], steps[around, 0, 0])
        usual[index] = steps[around[int(np.argsort(turns, kind="stable")[len(around) // 2])]]  # of median rotation
        usual[index, :3, 3] = np.median(rate[around], 0) * interval[index]
    excess = np.linalg.norm(steps[:, :3, 3] - usual[:, :3, 3], axis=1)
    excess += _ARM * np.linalg.norm(steps[:, :2, 0] - usual[:, :2, 0], axis=1)
    limit = _SUSPECT + _SUSPECT_SHARE * np.linalg.norm(usual[:, :3, 3], axis=1)
    suspects = [int(k) for k in np.argsort(-excess, kind="stable")[:_NUM_SUSPECTS] if excess[k] > limit[k]]
    wrong = sorted(k for k in suspects if _contradicted(log, k, steps[k], usual[k]))
    lapses: list[Lapse] = []
    for step in wrong:
        if lapses and lapses[-1].sweep == step and not lapses[-1].is_single:
            lapses[-1] = lapses[-1]._replace(is_single=True)  # away from, and back to the trajectory
        else:
            lapses.append(Lapse(step + 1, float(excess[step]), False))
    return lapses


def _contradicted(log: Log, index: int, step: np.ndarray, usual: np.ndarray) -> bool:
    pair = make_pair(log.sweep(index), log.sweep(index + 1), in_world=False)
    if pair is None:
        return False
    target = Structure(pair.target)
    return target.share(pair.source, usual) > _CONFIRMED * target.share(pair.source, step)
