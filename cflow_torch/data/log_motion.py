"""Judge the poses of a log by a few pairs of sweeps: under which reading does the static world stand still?"""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import Callable, Container, Iterator, NamedTuple, Sequence

import numpy as np

from cflow_torch.data.log import Log, known_poses, poses_beyond
from cflow_torch.diagnosis.conventions import MARGIN, OFF, STILL, TIMES, WORLD
from cflow_torch.diagnosis.inspection import repeats
from cflow_torch.diagnosis.readings import (
    GIVEN,
    LEAST_SHARE,
    UNKNOWN,
    Judgement,
    Pair,
    difference,
    judge,
    make_pair,
)
from cflow_torch.transforms import turn_of

_LONGEST_STEP, _MOST_SWEEPS = 6.4, 5  # metres and sweeps between the two sweeps of a pair
_BEFORE = 100  # sweeps before a suspect step, from whose poses other readings of it follow
_CHANGES = (-4, -1, 1, 4)  # sweeps between a pair and those whose motion should differ
_REACH = 10  # sweeps before and after a pair, whose poses may be those of the pair
# Metres a sweep, of points 20 m away. If it is less, a wrong direction moves static objects by millimetres only.
_LEAST_SPEED, _LEAST_TIMED = 0.5, 0.1
_UNCLEAR = 0.2  # share in place, below which poses that hardly move are compared with the motion of the sensor
_LEAST_MOTION = 0.2  # metres between the sweeps of a pair, else the vehicle stands
# A step between two poses is suspect if it differs from its neighbours' by this, as a length or as a part of theirs.
_SUSPECT, _SUSPECT_SHARE = 0.2, 0.3
_ARM = 10.0  # metres; a rotation counts as the motion of a point that far away
_FEWEST_POSES = 5  # that tell a usual step
POSE, JUMP, MISSING = "pose", "jump", "missing"
_OTHER, _CLEARLY = "another step", 1.3  # factor by which another reading is better than another step
_NUM_SUSPECTS = 4  # steps that are compared with the points, largest first
_LONG = 1.7  # length of a step over all those around it, if sweeps are missing


class Lapse(NamedTuple):
    """A step between two poses that differs from those around it, and what the points say of it."""

    sweep: int  # index of the sweep after the step
    metres: float  # by which the step differs from those around it, rotations at 10 m; of missing sweeps, its length
    kind: str  # POSE = only the pose of the sweep is wrong; JUMP = all later ones are shifted; MISSING = sweeps are


def choose_pairs(
    num_sweeps: int, poses: np.ndarray | None, jumps: Sequence[int] = (), without: Container[int] = ()
) -> list[tuple[int, int]]:
    """Choose pairs of sweeps that show wrong readings best, up to three, in order.

    With poses, these are the pairs over which the vehicle turns most, in which it is fastest, and whose motion differs
    most from that one sweep earlier, and later, because they show poses that are early or late. The sweeps of a pair
    are up to five apart, and up to 6.4 m, because readings differ more over a longer motion. No pair and no neighbour
    of it reaches over the steps `jumps`, if others are left. No pair has a sweep that is in `without`. Without poses,
    and if the vehicle does not move, they are neighbours spread over the log.
    """
    firsts = range(num_sweeps - 1)
    pairs = [] if poses is None else [(first, _partner(poses, first, jumps)) for first in firsts]
    pairs = [pair for pair in pairs if pair[0] not in without and pair[1] not in without]
    if poses is not None and not pairs:
        return []
    if poses is None or max(difference(_motion(poses, *pair), np.eye(4)) for pair in pairs) < _LEAST_MOTION:
        spread = {min(num_sweeps * part // 6, num_sweeps - 2) for part in (1, 3, 5)}
        return [(first, first + 1) for first in sorted(spread)]
    smooth = [pair for pair in pairs if pair[0] not in jumps] or pairs
    inner = [pair for pair in smooth if pair[0] > 0 and pair[1] + 1 < num_sweeps]  # with poses before and after
    inner = [pair for pair in inner if not {pair[0] - 1, pair[1]} & set(jumps)] or inner
    criteria = (partial(_turn, poses), partial(_speed, poses), *([partial(_change, poses)] if inner else []))
    return sorted({max(inner or smooth, key=lambda pair: criterion(*pair)) for criterion in criteria})


def _partner(poses: np.ndarray, first: int, jumps: Sequence[int]) -> int:
    last = min([first + _MOST_SWEEPS, len(poses) - 1, *(step for step in jumps if step > first)])
    near = np.linalg.norm(poses[first + 1 : last + 1, :3, 3] - poses[first, :3, 3], axis=1) < _LONGEST_STEP
    return first + 1 + max(int(near.cumprod().sum()) - 1, 0)


def _motion(poses: np.ndarray, first: int, second: int) -> np.ndarray:
    return np.linalg.inv(poses[second]) @ poses[first]


def _speed(poses: np.ndarray, first: int, second: int) -> float:
    """Return the metres that the vehicle moves in a sweep interval of a pair."""
    return float(np.linalg.norm(poses[second, :3, 3] - poses[first, :3, 3])) / (second - first)


def _usual_speed(poses: np.ndarray) -> float:
    """Return the median metres between neighbouring poses, rotations at 20 m."""
    return float(np.median([difference(_motion(poses, k, k + 1), np.eye(4)) for k in range(len(poses) - 1)]))


def _turn(poses: np.ndarray, first: int, second: int) -> float:
    return turn_of(_motion(poses, first, second))


def _change(poses: np.ndarray, first: int, second: int) -> float:
    """Return how much the motion of a pair differs from that some sweeps earlier and later, metres."""
    given = _motion(poses, first, second)
    firsts = [first + step for step in _CHANGES if first + step >= 0 and second + step < len(poses)]
    return sum(difference(given, _motion(poses, other, other + second - first)) for other in firsts)


def judge_log(log: Log, deskew: Callable[..., np.ndarray] | None = None, scans: Sequence[str] = (OFF,)) -> Judgement:
    """Compare the readings of a log over up to three pairs of sweeps, and over others before one is named.

    Args:
        log: the log, as given.
        deskew: returns points at the instant of their sweep, from its index, the sweep, rows, and the scan.
        scans: the scans that are compared where the vehicle is fast enough; the first one is that as given.

    Cost: reads two sweeps per pair, and 0.1 s each.
    """
    poses = known_poses(log)
    steps = steps_of(log)
    jumps = () if steps is None else steps.suspects
    chosen = choose_pairs(len(log.timestamps), poses, jumps)
    make_pairs = partial(_make_pairs, log, poses, deskew)
    if log.surrounds_poses:
        judgement = judge(make_pairs(chosen, (OFF,), True))
        if WORLD in judgement.best:
            return judgement
    judgement = judge(make_pairs(chosen, scans, False))
    if judgement.best and poses is not None:  # are only a few sweeps wrong?
        pairs = _pairs_without_repeats(log, poses, jumps, ()) or chosen  # all may repeat the one before
        judgement = judgement if pairs == chosen else judge(make_pairs(pairs, scans, False))
        others = _pairs_without_repeats(log, poses, jumps, {index for pair in pairs for index in pair})
        again = judge(make_pairs(others, scans, False)) if judgement.best and others else judgement
        judgement = again if _contradicts(again, judgement) else judgement
    is_unclear = not judgement.best and judgement.given < _UNCLEAR
    if poses is not None and is_unclear and _usual_speed(poses) < _LEAST_TIMED:
        spread = choose_pairs(len(log.timestamps), None)
        clouds = [[replace(log.sweep(index), pose=None) for index in pair] for pair in spread]
        unposed = judge(make_pair(pc0, pc1) for pc0, pc1 in clouds)
        judgement = unposed if UNKNOWN in unposed.best else judgement
    if STILL in judgement.best and log.unwrapped.has_viewpoints:
        return replace(judgement, shares={**judgement.shares, WORLD: judgement.shares[STILL]}, best=(WORLD,))
    return judgement


def _pairs_without_repeats(
    log: Log, poses: np.ndarray, jumps: Sequence[int], without: Container[int]
) -> list[tuple[int, int]]:
    """Choose pairs of sweeps that are not in `without`, and do not repeat the one before."""
    excluded = {index for index in range(len(log.timestamps)) if index in without}
    while True:
        pairs = choose_pairs(len(log.timestamps), poses, jumps, excluded)
        sweeps = {index for pair in pairs for index in pair if index > 0}
        repeated = {index for index in sweeps if repeats(log.sweep(index - 1), log.sweep(index))}
        if not repeated:
            return pairs
        excluded |= repeated


def _contradicts(again: Judgement, judgement: Judgement) -> bool:
    """Test whether other sweeps fit clearly better as given, and show that the best reading is wrong.

    Then only a few sweeps are wrong, such as one that repeats the one before. Errors of measurement differ by sweep.
    """
    shown = again.shares.get(judgement.best[0], float("nan")) if judgement.best else float("nan")
    return not again.best and shown <= again.given and again.given >= max(LEAST_SHARE, MARGIN * judgement.given)


def _make_pairs(
    log: Log,
    poses: np.ndarray | None,
    deskew: Callable[..., np.ndarray] | None,
    chosen: Sequence[tuple[int, int]],
    scans: Sequence[str],
    in_world: bool,
) -> Iterator[Pair | None]:
    """Read and prepare the pairs."""
    # Where poses are interpolated over several sweeps, an error of it looks as if they were of another time.
    extended, num_before = None, 0
    if poses is not None and not log.unwrapped.has_sparse_poses:
        extended, num_before = poses_beyond(log, poses, _REACH)
    sweeps = {index: log.sweep(index) for pair in chosen for index in pair}
    for first, second in chosen:
        start = max(first - _REACH, -num_before)
        around = None if extended is None else extended[start + num_before : second + num_before + _REACH + 1]
        least = _LEAST_TIMED if TIMES in scans else _LEAST_SPEED
        is_fast = poses is not None and difference(_motion(poses, first, second), np.eye(4)) >= least * (second - first)
        how = {} if deskew is None else {"deskew": [partial(deskew, index) for index in (first, second)]}
        shown = scans if is_fast else scans[:1]
        rows = (0, 1) if around is None else (first - start, second - start)
        yield make_pair(sweeps[first], sweeps[second], around, rows, in_world, scans=shown, **how)


class Steps(NamedTuple):
    """The steps between neighbouring poses, and what those around each let expect."""

    given: np.ndarray  # (K-1, 4, 4), maps each sweep to the next
    usual: np.ndarray  # (K-1, 4, 4), of the median rotation and speed of the steps around it
    longest: np.ndarray  # (K-1,) metres, of the largest speed of the steps around it
    excess: np.ndarray  # (K-1,) metres by which a step differs, rotations at 10 m

    @property
    def suspects(self) -> list[int]:
        """Indices of steps that differ much from those around them, up to four, largest first."""
        limit = _SUSPECT + _SUSPECT_SHARE * np.linalg.norm(self.usual[:, :3, 3], axis=1)
        order = np.argsort(-self.excess, kind="stable")[:_NUM_SUSPECTS]
        return [int(k) for k in order if self.excess[k] > limit[k]]


def steps_of(log: Log) -> Steps | None:
    """Return the steps between the poses of a log; None = there are too few poses."""
    poses = known_poses(log)
    if poses is None or len(poses) < _FEWEST_POSES:
        return None
    steps = np.linalg.inv(poses[1:]) @ poses[:-1]
    interval = np.diff(np.asarray(log.timestamps, np.float64)).clip(1e-9)
    rate = steps[:, :3, 3] / interval[:, None]
    usual = np.empty_like(steps)
    longest = np.zeros(len(steps))
    for index in range(len(steps)):
        around = [k for k in range(index - 3, index + 4) if 0 <= k < len(steps) and k != index]
        turns = np.arctan2(steps[around, 1, 0], steps[around, 0, 0])
        usual[index] = steps[around[int(np.argsort(turns, kind="stable")[len(around) // 2])]]  # of median rotation
        usual[index, :3, 3] = np.median(rate[around], 0) * interval[index]
        longest[index] = np.linalg.norm(rate[around], axis=1).max() * interval[index]
    excess = np.linalg.norm(steps[:, :3, 3] - usual[:, :3, 3], axis=1)
    excess += _ARM * np.linalg.norm(steps[:, :2, 0] - usual[:, :2, 0], axis=1)
    return Steps(steps, usual, longest, excess)


def find_lapses(log: Log) -> list[Lapse]:
    """Find wrong poses, jumps of the poses, and sweeps that are missing, in the order of the log.

    A step between neighbouring poses is suspect if it differs from the steps around it. We read the two sweeps of the
    most suspect steps, and compare the points under the step and under that of the neighbours. In logs with times,
    steps are in proportion to them.
    """
    steps = steps_of(log)
    if steps is None:
        return []
    lapses: list[Lapse] = []
    for index in sorted(steps.suspects):
        given, usual = steps.given[index], steps.usual[index]
        length = float(np.linalg.norm(given[:3, 3]))
        is_long = index not in log.gaps and length > _LONG * max(steps.longest[index], _LEAST_MOTION)
        pair = _pair_around(log, index)
        if pair is None:
            continue
        if _is_contradicted(pair, given, usual):
            if lapses and lapses[-1].sweep == index and lapses[-1].kind == JUMP:
                lapses[-1] = lapses[-1]._replace(kind=POSE)  # away from, and back to the trajectory
            else:
                lapses.append(Lapse(index + 1, float(steps.excess[index]), JUMP))
        elif is_long and _is_contradicted(pair, usual, given):
            lapses.append(Lapse(index + 1, length, MISSING))
    return lapses


def _pair_around(log: Log, index: int) -> Pair | None:
    """Prepare sweep `index` and the next one, with the poses before them; None = they have too little structure."""
    start = max(index - _BEFORE, 0)
    poses = known_poses(log)
    around = None if poses is None else poses[start : index + 2]
    return make_pair(log.sweep(index), log.sweep(index + 1), around, (index - start, index + 1 - start), False)


def _is_contradicted(pair: Pair, step: np.ndarray, other: np.ndarray) -> bool:
    """Test whether the points fit best under another step, and not under another reading of all poses."""
    transforms = {GIVEN: step, _OTHER: other}
    if not judge([replace(pair, transforms=transforms, has_motion=True)]).best:
        return False
    shares = replace(pair, transforms={**pair.transforms, **transforms}).shares_of_poses(OFF)
    return max(shares.values()) < max(_CLEARLY * shares[_OTHER], LEAST_SHARE)
