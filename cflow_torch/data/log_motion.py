"""Judge the poses of a log by a few pairs of sweeps: under which reading does the static world stand still?"""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import Any, Callable, Collection, Iterator, NamedTuple, Sequence

import numpy as np

from cflow_torch.data.log import Log, known_poses, poses_beyond
from cflow_torch.diagnosis.conventions import EQUAL, MARGIN, OFF, STILL, TIMES, WORLD
from cflow_torch.diagnosis.other_frame import motion_of
from cflow_torch.diagnosis.pair import GIVEN, Pair, difference, make_pair
from cflow_torch.diagnosis.readings import NO_READING, STEPS, UNKNOWN, Judgement, judge
from cflow_torch.diagnosis.stillness import LEAST_SHARE, share_of_sweeps
from cflow_torch.transforms import turn_of

_LONGEST_STEP, _MOST_SWEEPS = 6.4, 5  # metres and sweeps between the two sweeps of a pair
_CHANGES = (-4, -1, 1, 4)  # sweeps between a pair and those whose motion should differ
_REACH = 10  # sweeps before and after a pair, whose poses may be those of the pair
# Metres a sweep, of points 20 m away. If it is less, a wrong direction moves static objects by millimetres only.
_LEAST_SPEED, _LEAST_TIMED = 0.5, 0.1
_UNCLEAR = 0.2  # share in place, below which poses that hardly move are compared with the motion of the sensor
_SMALL = 0.15  # share in place, below which sweeps that repeat the one before are looked for
_LEAST_MOTION = 0.2  # metres between the sweeps of a pair, else the vehicle stands
# A step between two poses is suspect if it differs from its neighbours' by this length plus this share of theirs. The
# points then decide. Pairs of sweeps do not reach over steps that differ by the second length and share.
_SUSPECT, _SUSPECT_SHARE = 0.15, 0.1
_LEFT_OUT, _LEFT_OUT_SHARE = 0.2, 0.3
_ARM = 10.0  # metres; a rotation counts as the motion of a point that far away
_FEWEST_POSES = 5  # that tell a usual step
_AROUND = (-3, -2, -1, 1, 2, 3)  # steps that tell it
POSE, JUMP, MISSING = "pose", "jump", "missing"
_OTHER = "another step"
_AS_OTHERS = 0.75  # part of the share of the steps around, at least, under the right step
_HELD = 0.1  # motion over that next to it, below which a pose repeats the one before
_OF_HELD = 0.25  # least share of such poses
_NUM_SUSPECTS = 4  # steps that are compared with the points, largest first
_LONG = 1.7  # length of a step over the second longest of those around it, if sweeps are missing


class Lapse(NamedTuple):
    """A step between two poses that differs from those around it, and what the points say of it."""

    sweep: int  # index of the sweep after the step
    metres: float  # by which the step differs from those around it, rotations at 10 m; of missing sweeps, its length
    kind: str  # POSE = only the pose of the sweep is wrong; JUMP = all later ones are shifted; MISSING = sweeps are


def choose_pairs(
    num_sweeps: int, poses: np.ndarray | None, jumps: Sequence[int] = (), without: Collection[int] = ()
) -> list[tuple[int, int]]:
    """Choose pairs of sweeps that show wrong readings best, up to three, in order.

    With poses, these are the pairs over which the vehicle turns most, in which it is fastest, and whose motion differs
    most from that one sweep earlier, and later, because they show poses that are early or late. The sweeps of a pair
    are up to five apart, and up to 6.4 m, because readings differ more over a longer motion. No pair and no neighbour
    of it reaches over the steps `jumps`, if others are left. No pair has a sweep that is in `without`. Without poses,
    and if the vehicle does not move, they are neighbours spread over the log.
    """
    first = np.arange(num_sweeps - 1)
    second = first + 1
    rows: np.ndarray = first  # of the pairs that may be chosen
    if poses is not None:
        second = first + _num_intervals(poses, jumps)
        rows = first[~(np.isin(first, [*without]) | np.isin(second, [*without]))]
        if len(rows) == 0:
            return []
    if poses is None or difference(_motions(poses, first[rows], second[rows]), np.eye(4)).max() < _LEAST_MOTION:
        spread = {min(num_sweeps * part // 6, num_sweeps - 2) for part in (1, 3, 5)}
        return [(index, index + 1) for index in sorted(spread)]
    has_neighbours = (first > 0) & (second + 1 < num_sweeps)
    rows = _preferred(rows, ~np.isin(first, jumps))
    rows = _preferred(rows, has_neighbours)
    is_cut = np.isin(first - 1, jumps) | np.isin(second, jumps)
    if is_cut[rows].all():  # the step over missing sweeps does not tell how the sweep before it is skewed
        length = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1)
        long = [jump for jump in jumps if length[jump] > _LONG * np.delete(length, jumps).max(initial=_LEAST_MOTION)]
        second = np.maximum(second - np.isin(second, long), first + 1)
        is_cut = np.isin(first - 1, jumps) | np.isin(second, jumps)
    rows = _preferred(rows, ~is_cut)
    first, second = first[rows], second[rows]
    turn = turn_of(_motions(poses, first, second))
    speed = np.linalg.norm(poses[second, :3, 3] - poses[first, :3, 3], axis=1) / (second - first)
    criteria = [turn, speed]
    if has_neighbours[rows].any():
        criteria.append(_changes(poses, first, second))
    chosen = {int(criterion.argmax()) for criterion in criteria}  # ties: the first
    return [(int(first[row]), int(second[row])) for row in sorted(chosen)]


def _preferred(rows: np.ndarray, is_preferred: np.ndarray) -> np.ndarray:
    """Return the rows that are preferred, or all if none is."""
    preferred = rows[is_preferred[rows]]
    return preferred if len(preferred) else rows


def _num_intervals(poses: np.ndarray, jumps: Sequence[int]) -> np.ndarray:
    """Return how many sweeps later the pair of each sweep but the last one ends, (K-1,) int64, see `choose_pairs`."""
    first = np.arange(len(poses) - 1)[:, None]
    second = first + np.arange(1, _MOST_SWEEPS + 1)
    ends = np.array([*sorted(jumps), len(poses) - 1])
    last = ends[np.searchsorted(ends, first, side="right").clip(max=len(ends) - 1)]
    position = poses[:, :3, 3]
    distance = np.linalg.norm(position[second.clip(max=len(poses) - 1)] - position[first], axis=2)
    is_near = (second <= last) & (distance < _LONGEST_STEP)
    return is_near.cumprod(1).sum(1).clip(min=1)  # type: ignore[no-any-return]


def _motions(poses: np.ndarray, first: Any, second: Any) -> np.ndarray:
    """Return the motions from sweeps to others, (..., 4, 4), of which the indices are given, (...)."""
    return np.linalg.inv(poses[second]) @ poses[first]  # type: ignore[no-any-return]


def _changes(poses: np.ndarray, first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Return how much the motion of each pair differs from that some sweeps earlier and later, (n,) metres."""
    given = _motions(poses, first, second)
    change = np.zeros(len(first))
    for step in _CHANGES:
        inside = np.flatnonzero((first + step >= 0) & (second + step < len(poses)))
        other = _motions(poses, first[inside] + step, second[inside] + step)
        change[inside] += difference(given[inside], other)
    return change


def judge_log(log: Log, deskew: Callable[..., np.ndarray] | None = None, scans: Sequence[str] = (OFF,)) -> Judgement:
    """Compare the readings of a log over up to three pairs of sweeps, and over others before one is named.

    Args:
        log: the log, as given.
        deskew: returns points at the instant of their sweep, from its index, the sweep, rows, and the scan.
        scans: the scans that are compared where the vehicle is fast enough; the first one is that as given.

    Cost: reads two sweeps per pair, and 0.1 s each.
    """
    poses = known_poses(log)
    jumps = _jumps(log)
    chosen = choose_pairs(len(log.timestamps), poses, jumps)
    make_pairs = partial(_make_pairs, log, poses, deskew)
    judgement = judge(make_pairs(chosen, scans, False))
    if log.surrounds_poses:
        in_world = judge(make_pairs(chosen, (OFF,), True))
        # Points near the origin may lie around both, and other readings fit better. Still is the same transform.
        is_as_good = STILL in judgement.best or not in_world.fits < EQUAL * judgement.fits
        if WORLD in in_world.best and is_as_good:
            return in_world
    hardly_moves = poses is not None and bool(np.median(_step_sizes(poses)) < _LEAST_TIMED)
    is_small = judgement.given < _SMALL and not hardly_moves
    if poses is not None and (_does_not_fit(judgement, hardly_moves) or is_small):  # are only a few sweeps wrong?
        pairs = _pairs_without_repeats(log, poses, jumps, ()) or chosen  # all may repeat the one before
        judgement = judgement if pairs == chosen else judge(make_pairs(pairs, scans, False))
        if _does_not_fit(judgement, hardly_moves):
            others = _pairs_without_repeats(log, poses, jumps, {index for pair in pairs for index in pair})
            again = judge(make_pairs(others, scans, False))
            judgement = again if _contradicts(again, judgement) else judgement.confirmed_by(again)
    is_unclear = judgement.best in ((), (UNKNOWN,), (NO_READING,)) and judgement.given < _UNCLEAR
    if is_unclear and hardly_moves:
        spread = make_pairs(choose_pairs(len(log.timestamps), None), (OFF,), False)
        of_spread = judge(_without_motion(pair) for pair in spread if pair is not None)
        judgement = of_spread if {UNKNOWN, *STEPS}.intersection(of_spread.best) else judgement
    if STILL in judgement.best and log.unwrapped.has_viewpoints:
        return replace(judgement, shares={**judgement.shares, WORLD: judgement.shares[STILL]}, best=(WORLD,))
    return judgement


def _step_sizes(poses: np.ndarray) -> np.ndarray:
    """Return how far each step between (K, 4, 4) poses moves points 20 m away, (K-1,) metres."""
    first = np.arange(len(poses) - 1)
    return difference(_motions(poses, first, first + 1), np.eye(4))


def _does_not_fit(judgement: Judgement, hardly_moves: bool) -> bool:
    """Test whether another reading is better or, if the poses move, little of the structure is in place."""
    return bool(judgement.best) or (judgement.is_low and not hardly_moves)


def _without_motion(pair: Pair) -> Pair:
    return replace(pair, transforms={**pair.transforms, GIVEN: np.eye(4)}, has_motion=False)


def _contradicts(again: Judgement, judgement: Judgement) -> bool:
    """Test whether other sweeps fit clearly better as given, and show that the best reading, if any, is wrong.

    Then only a few sweeps are wrong, such as one that repeats the one before. Errors of measurement differ by sweep.
    """
    is_worse = not judgement.best or again.shares.get(judgement.best[0], float("nan")) <= again.given
    return not again.best and is_worse and again.given >= max(LEAST_SHARE, MARGIN * judgement.given)


def fits_better(log: Log, others: np.ndarray) -> bool:
    """Test whether the points of a log fit other poses, (K, 4, 4) float64, clearly better than its own."""
    poses = known_poses(log)
    if poses is None:
        return False
    chosen = _pairs_without_repeats(log, poses, _jumps(log), ())
    prepared = []
    for first, second in chosen:
        pair = make_pair(log.sweep(first), log.sweep(second), in_world=False)
        transforms = {GIVEN: _motions(poses, first, second), _OTHER: _motions(others, first, second)}
        prepared.append(pair and replace(pair, transforms=transforms))
    return _OTHER in judge(prepared).best


def _pairs_without_repeats(
    log: Log, poses: np.ndarray, jumps: Sequence[int], without: Collection[int]
) -> list[tuple[int, int]]:
    """Choose pairs of sweeps that are not in `without`, and do not repeat the one before."""
    excluded = set(without)
    while True:
        pairs = choose_pairs(len(log.timestamps), poses, jumps, excluded)
        sweeps = {index for pair in pairs for index in pair if index > 0}
        repeated = {index for index in sweeps if log.repeats(index)}
        if not repeated:
            return pairs
        excluded |= repeated


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
        speed = 0.0
        if poses is not None:
            motion = _motions(poses, first, second)
            speed = float(difference(motion, np.eye(4))) / (second - first)
        least = {OFF: _LEAST_TIMED, TIMES: _LEAST_TIMED}
        shown = [scan for scan in scans if scan == scans[0] or speed >= least.get(scan, _LEAST_SPEED)]
        how = {} if deskew is None else {"deskew": [partial(deskew, index) for index in (first, second)]}
        rows = (0, 1) if around is None else (first - start, second - start)
        yield make_pair(sweeps[first], sweeps[second], around, rows, in_world, scans=shown, **how)


class Steps(NamedTuple):
    """The steps between neighbouring poses, and what those around each let expect."""

    given: np.ndarray  # (K-1, 4, 4), maps each sweep to the next
    usual: np.ndarray  # (K-1, 4, 4), of the median rotation and speed of the steps around it
    is_long: np.ndarray  # (K-1,) bool, much longer than all but one of those around it, as if sweeps were missing
    excess: np.ndarray  # (K-1,) metres by which a step differs, rotations at 10 m

    def beyond(self, metres: float, share: float) -> list[int]:
        """Return indices of steps that differ from those around them by more, up to four, largest first."""
        limit = metres + share * np.linalg.norm(self.usual[:, :3, 3], axis=1)
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
    turn = np.arctan2(steps[:, 1, 0], steps[:, 0, 0])
    around = np.arange(len(steps))[:, None] + _AROUND  # [K-1, 6]
    is_step = (around >= 0) & (around < len(steps))
    around = around.clip(0, len(steps) - 1)
    by_turn = np.where(is_step, turn[around], np.inf).argsort(1, kind="stable")
    middle = np.take_along_axis(by_turn, is_step.sum(1, keepdims=True) // 2, 1)
    usual = steps[np.take_along_axis(around, middle, 1)[:, 0]]  # of the median rotation
    rates = np.where(is_step[..., None], rate[around], np.nan)
    usual[:, :3, 3] = np.nanmedian(rates, 1) * interval[:, None]
    speeds = np.sort(np.nan_to_num(np.linalg.norm(rates, axis=2)), axis=1)
    longest = speeds[:, -2] * interval  # sweeps may be missing twice
    is_long = np.linalg.norm(steps[:, :3, 3], axis=1) > _LONG * longest.clip(_LEAST_MOTION)
    return Steps(steps, usual, is_long, _apart(steps, usual))


def held_poses(log: Log) -> list[int]:
    """Return the sweeps that have about the pose of the one before, next to long steps: poses of a lower rate, held."""
    poses = known_poses(log)
    if poses is None or len(poses) < _FEWEST_POSES:
        return []
    motion = _step_sizes(poses)
    beside = np.maximum(np.append(motion[1:], 0), np.append(0, motion[:-1]))
    held = (np.flatnonzero((beside > _LEAST_MOTION) & (motion < _HELD * beside)) + 1).tolist()
    return held if len(held) >= _OF_HELD * len(poses) else []


def _apart(step: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Return by how much steps, (..., 4, 4), differ from others, (...,) metres, rotations about z at 10 m."""
    shift, turn = (step - other)[..., :3, 3], (step - other)[..., :2, 0]
    return np.linalg.norm(shift, axis=-1) + _ARM * np.linalg.norm(turn, axis=-1)  # type: ignore[no-any-return]


def _jumps(log: Log) -> list[int]:
    """Return indices of the steps between poses over which no pair of sweeps should reach."""
    steps = steps_of(log)
    return [] if steps is None else steps.beyond(_LEFT_OUT, _LEFT_OUT_SHARE)


def find_lapses(log: Log) -> list[Lapse]:
    """Find wrong poses, jumps of the poses, and sweeps that are missing, in the order of the log.

    A step between neighbouring poses is suspect if it differs from the steps around it. We read the two sweeps of the
    most suspect steps, and compare the points under the step, under that of the neighbours, and under the motion that
    fits them best, because the vehicle may speed up. In logs with times, steps are in proportion to them. Give logs
    whose poses fit: another convention of poses changes steps, too.
    """
    steps = steps_of(log)
    if steps is None:
        return []
    lapses: list[Lapse] = []
    for index in sorted(steps.beyond(_SUSPECT, _SUSPECT_SHARE)):
        given, usual = steps.given[index], steps.usual[index]
        pair = make_pair(log.sweep(index), log.sweep(index + 1), in_world=False)
        if pair is None:
            continue
        fitting = usual
        is_wrong = _is_contradicted(pair, given, usual)
        if not is_wrong:
            fitting = motion_of(pair, OFF)
            is_wrong = _is_contradicted(pair, given, fitting)
        if is_wrong and _fits_as_others(log, index, pair, fitting):
            if lapses and lapses[-1].sweep == index and lapses[-1].kind == JUMP:
                lapses[-1] = lapses[-1]._replace(kind=POSE)  # away from, and back to the trajectory
            else:
                lapses.append(Lapse(index + 1, float(_apart(given, fitting)), JUMP))
        elif steps.is_long[index] and index not in log.gaps and _is_contradicted(pair, usual, given):
            lapses.append(Lapse(index + 1, float(np.linalg.norm(given[:3, 3])), MISSING))
    return lapses


def _is_contradicted(pair: Pair, step: np.ndarray, other: np.ndarray) -> bool:
    """Test whether the points fit clearly better under another step."""
    judgement = judge([replace(pair, transforms={GIVEN: step, _OTHER: other}, has_motion=True)])
    return bool(judgement.best) and judgement.shares[_OTHER] >= MARGIN * judgement.given


def _fits_as_others(log: Log, index: int, pair: Pair, step: np.ndarray) -> bool:
    """Test whether under a step, two sweeps fit about as well as those around them: raw sweeps may fit badly."""
    around = [other for other in (index - 2, index + 2) if 0 <= other < len(log.timestamps) - 1]
    others = [share_of_sweeps(log.sweep(other), log.sweep(other + 1)) for other in around]
    share = replace(pair, transforms={GIVEN: step}).share(OFF)
    return all(share >= _AS_OTHERS * other for other in others if np.isfinite(other))
