"""Check a log before its flow is used: what is right, what was found, what is wrong, and how to fix it."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace
from functools import cached_property
from operator import methodcaller
from typing import Any, Callable, Iterable, Iterator, List

import numpy as np

from cflow_torch.data.finding import CHOOSE, FOUND, RIGHT, UNREAD, WRONG, Finding
from cflow_torch.data.log import CachedLog, Log, gaps_in, intervals_of, known_poses, typical_sweeps
from cflow_torch.data.log_motion import MISSING, POSE, Lapse, find_lapses, held_poses, judge_log
from cflow_torch.data.neighbours import Neighbours
from cflow_torch.data.read_as import ReadAs, problem_of_columns
from cflow_torch.diagnosis.conventions import READINGS, REVERSED, STILL, TIMES_OF_POSES, UNITS, WORLD, Reading
from cflow_torch.diagnosis.inspection import is_usual_interval, mask_problem
from cflow_torch.diagnosis.pair import difference, is_around
from cflow_torch.diagnosis.point_frame import frame_problem, tilt_problem
from cflow_torch.diagnosis.readings import INACCURATE, NO_READING, UNKNOWN, Judgement
from cflow_torch.diagnosis.stillness import IN_PLACE, LEAST_SHARE, Structure, are_finite, share_of_sweeps
from cflow_torch.errors import CFlowError, warn
from cflow_torch.transforms import as_matrix, relative_transform, transform_points
from cflow_torch.types import Array, Sweep, as_numpy

_CACHED = 12  # sweeps that several checks read
_ALTERNATING = 8  # sweeps in the middle of a log that tell whether two sensors alternate
_STRIP = 4.0  # metres, half width of the strip whose points are looked for in the next sweep
_SAMPLE = 1000  # points of the strip that are looked for
_SAME = 0.001  # metres between two equal points
_ACCUMULATED = 0.3  # share of points that come again, if sweeps are added up
_LEAST_MOTION = 0.2  # metres between two sweeps, or the sensor stands
_GRID = 0.2  # share of different coordinates, below which points lie on a grid
_UNEVEN = 0.1  # change of the intervals of times from one to the next
_EVEN = 0.5  # change of the motion over that of the intervals
_MOST_SEEN = 20_000  # points that show in which directions a sweep measures, and whether they lie on a grid
_DIRECTIONS = 36  # of a turn, and from straight down to straight up
_NUM_SPREAD = 5  # sweeps that tell whether the sensor is tilted
_LEAST_SHARED = 0.6  # share of the points in directions in which neighbouring sweeps both measure
_FEWEST_SEEN = 300  # points that show in which directions a sweep measures
_TOPICS = (
    "log",
    "sensor",
    "frame",
    "times",
    "ego motion",
    "poses",
    "de-skewing",
    "sweeps",
    "ground",
    "own vehicle",
    "labels",
    "reader",
)
_TWO_SENSORS = Finding(
    "sweeps",
    WRONG,
    "each sweep fits the second next one, but not the next, so they seem to be those of two sensors, alternating: give "
    "those of one sensor (data.suffix, data.topic)",
    True,
)
_OF_SPARSE_POSES = "its poses are interpolated over several sweeps, which data.odometry=refine corrects"
_OTHER_GROUND = "choose another method (data.find_ground=grid, patchwork or null), or give masks"
_UNITS_OF_POINTS = [f"points_{unit}" for unit in UNITS]


class _CheckedLog(CachedLog):
    """A log with what several checks ask."""

    @cached_property
    def typical(self) -> list[int]:
        return typical_sweeps(self)

    @cached_property
    def is_empty(self) -> bool:
        """Whether no typical sweep has a finite point."""
        return not any(are_finite(as_numpy(self.sweep(index).points)).any() for index in self.typical)

    @cached_property
    def frame(self) -> tuple[str, str]:
        """The reading that corrects the points, and what is wrong with them; both "" if nothing is."""
        problem = problem_of_columns(self)
        return ("", problem) if problem else frame_problem(self.sweep(self.typical[0]).points)

    @cached_property
    def tilt(self) -> str:
        """By how much the sensor is tilted, if nothing else is wrong with the points; "" = it is not."""
        return "" if self.frame[1] else tilt_problem(self._spread())

    def _spread(self) -> Iterator[Array]:
        """Yield the points of a typical sweep, then of others spread over the log that can be read."""
        others = np.linspace(0, len(self) - 1, _NUM_SPREAD).round().astype(int).tolist()
        for index in dict.fromkeys([self.typical[0], *others]):
            with suppress(CFlowError, OSError):
                yield self.sweep(index).points

    @cached_property
    def motion(self) -> Judgement:
        """How well readings of the poses fit the points as they are."""
        return self.judgement or judge_log(self)

    @cached_property
    def misfit(self) -> list[Finding]:
        """Why neighbouring sweeps do not fit: poses are held, or sweeps measure other directions, or alternate."""
        count = min(_ALTERNATING, len(self))
        first = (len(self) - count) // 2
        middle = range(first, first + count)
        return _held(self) or _parts(self) or ([_TWO_SENSORS] if Neighbours.of(self, middle).alternate else [])

    @cached_property
    def lapses(self) -> list[Lapse]:
        """Single wrong poses, if no other reading of all poses fits better."""
        return [] if self.motion.best else find_lapses(self)


def _held(log: Log) -> list[Finding]:
    held = held_poses(log)
    if not held:
        return []
    text = f"{len(held)} poses repeat the one before while the vehicle moves, the first is that of sweep {held[0]}"
    fix = "give a pose of each sweep (interpolate between those that differ), or set data.odometry=true"
    return [Finding("poses", WRONG, f"{text}: {fix}", True)]


_Check = Callable[[_CheckedLog], List[Finding]]
_OF_READER: _Check = methodcaller("findings")


def check_log(log: Log) -> None:
    """Give a `CFlowWarning` for each problem that `find_problems` lists."""
    for text in find_problems(log):
        warn(f"log {log.log_id}: {text}")


def find_problems(log: Log) -> list[str]:
    """List likely mistakes that raise no error, and say if we find the ground or the frame of the points.

    We skip a check if a sweep that it needs cannot be read. Reading this sweep later raises the error.

    Cost: reads up to eight sweeps; about 0.4 s.
    """
    findings = _collect(_CheckedLog(log, _CACHED), (_OF_READER, _frame, _mask, _repeated, _lapses))
    return [finding.text for finding in findings if finding.status != RIGHT and finding.is_quick]


def examine(log: Log) -> list[Finding]:
    """Check everything that `cflow check` shows, in the order of its page.

    Cost: 1 to 2 s, and reads every sweep, and 20 ms each, to tell those that are missing, damaged or misplaced.
    """
    checks = (
        _sensor,
        _OF_READER,
        _frame,
        _times,
        _poses,
        _lapses,
        _repeated,
        _each_sweep,
        _mask,
        _labels,
    )
    findings = _collect(_CheckedLog(log, _CACHED), checks, tells_errors=True)
    # The error that ended a check is told once, with the count of such sweeps.
    texts = [finding.text for finding in findings if finding.topic != "log"]
    findings = [one for one in findings if one.topic != "log" or not any(one.text in text for text in texts)]
    # Notes are complete only now, as readers note what they see in the sweeps.
    return [*findings, *(Finding("reader", FOUND, note) for note in log.notes)]


def _collect(log: _CheckedLog, checks: Iterable[_Check], tells_errors: bool = False) -> list[Finding]:
    """Return what the checks find, by topic. One that cannot read a sweep finds its error, if it `tells_errors`."""
    found: list[Finding] = []
    for check in checks:
        try:
            findings = check(log)
        except (CFlowError, OSError) as error:
            findings = [Finding("log", WRONG, str(error))] if tells_errors else []
        found += [finding for finding in findings if finding not in found]
    return sorted(found, key=lambda finding: _TOPICS.index(finding.topic))


def _frame(log: _CheckedLog) -> list[Finding]:
    """Check a typical sweep; without poses also the last one, which is far away if points are in the world's frame.

    Then check the ego motion in the frame that the points will have.
    """
    if log.is_empty and not log.frame[1]:
        names = ", ".join(map(_name_of, log.typical))
        return [Finding("sweeps", WRONG, f"no point is finite in {names}: are the files complete?", True)]
    reading, problem = log.frame
    checked = log.typical[0]
    is_last = not problem and known_poses(log) is None
    if is_last:
        checked = log.typical[-1]
        problem = frame_problem(log.sweep(checked).points)[1] or _problem_in_world(log)
    if not problem:
        right = Finding("frame", RIGHT, "metres, around the vehicle, z up", True)
        if not log.tilt:
            return [right, *_motion(log, "")]
        # Under a tilt, poses of the vehicle may fit under no reading.
        has_misfit = log.motion.is_low or NO_READING in log.motion.best
        is_explained = has_misfit and known_poses(log) is not None
        return [Finding("frame", WRONG, log.tilt, True), *([] if is_explained else _motion(log, ""))]
    # The unit under which the points fit the poses may be another one.
    is_unit = reading in _UNITS_OF_POINTS and known_poses(log) is not None
    unit, _ = _fitting(log, [reading, *_UNITS_OF_POINTS]) if is_unit else ("", 0)
    if unit not in ("", reading):
        reading, problem = unit, f"{READINGS[unit].cause}, because the motion then fits that of the poses"
    fix = f"; {_setting(log, reading)} converts them" if reading else ""
    wrong = Finding("frame", WRONG, f"in {_name_of(checked)} {problem}{fix}", True)
    # In another frame that we do not know, readings of the poses mean nothing, and sweeps need not fit.
    is_judged = reading or (is_last and not log.motion.is_low)
    return [wrong, *(_motion(log, reading) if is_judged else [])]


def _problem_in_world(log: _CheckedLog) -> str:
    """Return where the last sweep lies, if it lies elsewhere than the first one, but the static world stays in place.

    Where the points of the first sweep lie need not be the sensor, because it may only look ahead.
    """
    if not log.motion.shares or log.motion.best or log.motion.is_low:
        return ""
    first, last = (as_numpy(log.sweep(index).points) for index in (log.typical[0], log.typical[-1]))
    middles = [np.append(np.median(points[are_finite(points), :2], axis=0), 0) for points in (first, last)]
    if not is_around(last[:, :3] - middles[0], as_matrix(np.eye(3), middles[1] - middles[0])):
        return ""
    x, y, _ = middles[1]
    where = f"the points lie around x = {x:.0f} m, y = {y:.0f} m, so they are in the world's frame"
    return f"{where}, and there are no poses: pass them, because points far from the origin have no flow"


def _fitting(log: Log, readings: Iterable[str]) -> tuple[str, float]:
    """Return the first of the readings under which the points fit the poses, and the share in place; "" = none.

    Readings under which one pair does not fit at all are left out, because a judgement takes 30 times longer.
    """
    middle = (len(log.timestamps) - 2) // 2
    logs = ((name, ReadAs(log, name)) for name in readings)
    pairs = ((name, read, read.sweep(middle), read.sweep(middle + 1)) for name, read in logs)
    fitting_at_all = ((name, read) for name, read, *pair in pairs if share_of_sweeps(*pair) >= LEAST_SHARE)
    judged = ((name, judge_log(read)) for name, read in fitting_at_all)
    fitting = ((name, each.given) for name, each in judged if not each.best and each.given >= LEAST_SHARE)
    return next(fitting, ("", 0.0))


def _motion(checked: _CheckedLog, reading: str) -> list[Finding]:
    """Check the ego motion of a log whose points are converted by a reading; "" = they are right."""
    # The poses are judged in the frame that the points will have.
    log: Log = ReadAs(checked, reading) if reading else checked
    judgement = judge_log(log) if reading else checked.motion
    if not judgement.shares or (judgement.is_low and judgement.is_sparse):
        return [Finding("ego motion", RIGHT, "not compared, because the sweeps have too little static structure", True)]
    judgement = replace(judgement, best=(NO_READING,)) if judgement.is_low else judgement
    has_poses = log.sweep(0).pose is not None
    if has_poses and judgement.best and checked.misfit:
        return checked.misfit
    if has_poses and judgement.best:
        candidates = [unit for unit in UNITS if reading == f"points_{unit}"]  # poses may have the unit of the points
        candidates += (REVERSED, *_UNITS_OF_POINTS) if NO_READING in judgement.best else ()
        fitting, share = _fitting(log, candidates)
        if fitting:
            shares = f"{judgement.given:.2f} of the static structure is in place as given, {share:.2f} then"
            text = f"{READINGS[fitting].cause} ({shares}): give {_setting(log, fitting)}"
            return [Finding("frame" if fitting in _UNITS_OF_POINTS else "ego motion", WRONG, text, True)]
    if not judgement.best:
        text = f"{judgement.given:.2f} of the static structure is in place some sweeps later"
        return [Finding("ego motion", RIGHT, text + ("" if has_poses else ", without poses"), True)]
    if log.has_estimated_poses:
        fit = f"only {judgement.given:.2f} of the static structure is in place"
        text = f"the poses that we estimated from the points do not fit well ({fit}): give measured poses, if any"
        return [Finding("ego motion", WRONG, text, True)]
    name = judgement.best[0]
    if name == UNKNOWN:
        why = "there are no poses, but" if not has_poses else "the poses hardly move, but"
        choices = [note[note.index(CHOOSE) :] for note in log.notes if CHOOSE in note]
        unread = [f"pass poses ({note})" for note in log.notes if note.startswith(UNREAD)]
        poses = [*choices, *unread, "pass poses"][0]
        fix = f"{poses}, or set data.odometry=true (in Python `with_poses` of cflow_torch.data.odometry)"
    elif name in (NO_READING, INACCURATE) and log.unwrapped.has_sparse_poses:
        why, fix = "", _OF_SPARSE_POSES
    elif name == NO_READING:
        why, fix = "", "check that the points are x, y, z in metres, and "
        of_poses = "that the poses belong to this log and are of the points' frame (else give data.ego_T_lidar), "
        fix += f"{of_poses}their times, units and quaternions" if has_poses else "pass poses or data.odometry=true"
        fix += "" if has_poses else ", unless the files are no successive sweeps of one drive, which have no flow"
    else:
        why = "the static world moves under the poses:" if name != WORLD else ""
        fix = " or ".join(_fix_of(log, each, judgement.reading(each)) for each in judgement.best)
        fix = f"give {fix}" + (", or no poses (data.poses=null)" if name == STILL else "")
        if name in TIMES_OF_POSES and log.trajectory is not None:
            why += " the clocks of sweeps and poses may differ, because"
    return [Finding("ego motion", WRONG, f"{why} {judgement}: {fix}".strip(), True)]


def _fix_of(log: Log, name: str, reading: Reading) -> str:
    if reading.mount is None:
        return reading.fix or _setting(log, name)
    ego_T_lidar = log.mounting_with(reading.mount)
    more = "" if np.array_equal(ego_T_lidar, reading.mount) else " in addition to the mounting in use"
    matrix = str((ego_T_lidar.round(3) + 0.0).tolist()).replace(" ", "")
    return f"{reading.fix}{more}: data.ego_T_lidar={matrix} (data=arrays, hdf5 or bags)"


def _setting(log: Log, reading: str) -> str:
    readings = [*log.readings, reading]
    return f"data.read_as=[{','.join(readings)}]" if len(readings) > 1 else f"data.read_as={reading}"


def _lapses(log: _CheckedLog) -> list[Finding]:
    wrong = [lapse for lapse in log.lapses if lapse.kind != MISSING]
    if not wrong:
        return []
    if log.misfit:
        return log.misfit
    texts = [
        f"the pose of sweep {each.sweep} is {each.metres:.1f} m off (for points 10 m away)"
        if each.kind == POSE
        else f"the poses jump by {each.metres:.1f} m before sweep {each.sweep}"
        for each in wrong
    ]
    fix = "correct it, remove the sweep, or give data.odometry=refine if the poses are noisy"
    fix += "; for a jump, give poses of a continuous frame (odometry, not the map)"
    return [Finding("poses", WRONG, f"{', '.join(texts)}: {fix}", True)]


def _mask(log: _CheckedLog) -> list[Finding]:
    masks = {index: log.sweep(index).is_ground for index in log.typical}
    known = [index for index, mask in masks.items() if mask is not None]
    if not known:
        return [Finding("ground", RIGHT, "no masks, so no point is taken for ground (data.find_ground=grid finds it)")]
    for index in known:
        problem = "" if log.frame[1] or log.tilt else mask_problem(log.sweep(index))
        if problem:
            text = f"the mask of {_name_of(index)} is {problem}; data.find_ground=grid replaces it"
            mask: Any = masks[index]
            if log.finds_ground(index):
                what = "other points than those of the ground" if as_numpy(mask).any() else "no ground"
                text = f"we find {what} in {_name_of(index)}, which has some: {_OTHER_GROUND}"
            return [Finding("ground", WRONG, text, True)]
    mask = masks[known[0]]
    share = float(as_numpy(mask).mean()) if len(mask) else 0.0
    return [Finding("ground", RIGHT, f"{100 * share:.0f} % of the points of {_name_of(known[0])}", True)]


def _name_of(index: int) -> str:
    return f"sweep {index}" if index else "the first sweep"


def _repeated(log: _CheckedLog) -> list[Finding]:
    first = [log.sweep(index) for index in range(2)]
    if log.repeats(1):
        text = "sweep 1 repeats the points of sweep 0: leave one out, or copy its file again"
        return [Finding("sweeps", WRONG, text, True)]
    spacing = _spacing_of_grid(first[0])
    if spacing > IN_PLACE and not log.frame[0]:
        text = f"the points lie on a grid of {spacing:.2g} m, so static objects seem to move by as much"
        return [Finding("sweeps", WRONG, f"{text}: give points as measured, such as one of each voxel", True)]
    is_known = spacing > 0 or bool(log.frame[0])  # then "to the millimetre" means nothing
    again = 0.0 if is_known else _share_again(*first)
    if again > _ACCUMULATED:
        text = f"{100 * again:.0f} % of the points of the first sweep are also in the second one, to the millimetre"
        fix = "give the points that each sweep has measured itself, not a map or sweeps that were added up"
        return [Finding("sweeps", WRONG, f"{text}: {fix}", True)]
    return _parts(log)


def _parts(log: Log) -> list[Finding]:
    """Compare the directions of the first two sweeps and, if they share few, also those after them: one may be cut."""
    shared = 0.0
    for index in range(min(4, len(log) - 1)):
        shared = max(shared, _shared_directions(log.sweep(index), log.sweep(index + 1)))
        if shared >= _LEAST_SHARED:
            return []
    text = f"neighbouring sweeps share {100 * shared:.0f} % of the directions in which they measure"
    fix = "join the clouds of one rotation and view, or give those of one sensor (data.suffix, data.topic)"
    return [Finding("sweeps", WRONG, f"{text}: {fix}", True)]


def _share_again(pc0: Sweep, pc1: Sweep) -> float:
    """Return the share of points of a sweep that the next one has, too, moved by the ego motion.

    0 if the sensor has poses and stands, because it may measure the same points again.
    """
    T = np.eye(4) if pc0.pose is None or pc1.pose is None else relative_transform(pc1.pose, pc0.pose)
    if pc0.pose is not None and difference(T, np.eye(4)) < _LEAST_MOTION:
        return 0.0
    points0, points1 = (as_numpy(sweep.points)[:, :3].astype(np.float64) for sweep in (pc0, pc1))
    is_in_strip = are_finite(points0) & (np.abs(points0[:, 1]) < _STRIP) & (np.abs(points0[:, 0]) < 5 * _STRIP)
    if not is_in_strip.any():
        return 0.0
    strip = points0[is_in_strip]  # along the vehicle, so that few points are searched
    moved = transform_points(strip[:: len(strip) // _SAMPLE + 1], T)
    around = ((points1 > moved.min(0) - _SAME) & (points1 < moved.max(0) + _SAME)).all(axis=1)
    scale = IN_PLACE / _SAME
    return Structure(scale * points1[around]).share(scale * moved, np.eye(4))


def _spacing_of_grid(sweep: Sweep) -> float:
    """Return the metres between points of a grid to which a sweep was thinned or rounded; 0 = they lie on none.

    On a grid, most points have an x that others have.
    """
    points = as_numpy(sweep.points)
    x = points[:: len(points) // _MOST_SEEN + 1, 0]
    different = np.unique(x)
    return float(np.median(np.diff(different))) if 1 < len(different) < _GRID * len(x) else 0.0


def _shared_directions(pc0: Sweep, pc1: Sweep) -> float:
    """Return the share of points of a sweep in directions where the other has points, too; of both shares, the smaller.

    1 if one of them has too few points to tell.
    """
    in0, in1 = _directions(pc0), _directions(pc1)
    if min(in0.sum(), in1.sum()) < _FEWEST_SEEN:
        return 1.0
    return float(min(in0[in1 > 0].sum() / in0.sum(), in1[in0 > 0].sum() / in1.sum()))


def _directions(sweep: Sweep) -> np.ndarray:
    """Count the points of a sweep in each direction of azimuth and elevation, (36 * 36,) int64."""
    points = as_numpy(sweep.points)
    x, y, z = points[:: len(points) // _MOST_SEEN + 1, :3].astype(np.float64).T
    is_known = np.isfinite(x + y + z)
    azimuth = np.arctan2(y, x)[is_known] / (2 * np.pi) + 0.5  # 0 to 1
    elevation = np.arctan2(z, np.hypot(x, y))[is_known] / np.pi + 0.5
    row, column = (np.minimum(share * _DIRECTIONS, _DIRECTIONS - 1).astype(np.int64) for share in (azimuth, elevation))
    return np.bincount(row * _DIRECTIONS + column, minlength=_DIRECTIONS**2)


def _each_sweep(log: _CheckedLog) -> list[Finding]:
    """Read every sweep: find those that cannot be read, have few points, repeat the one before, or are misplaced."""
    log.sweep(0)  # its error is that of the log
    neighbours = Neighbours.of(log, range(len(log)))
    errors, small = neighbours.errors, neighbours.small
    findings = []
    if errors:
        first = min(errors)
        text = f"{len(errors)} of {len(log)} sweeps cannot be read, the first is sweep {first}: {errors[first]}"
        findings.append(Finding("sweeps", WRONG, f"{text}. Their pairs have no flow"))
    if small:
        first = min(small)
        text = f"{len(small)} of them have few points, the first is sweep {first} with {neighbours.num_points[first]:,}"
        fix = "are their files complete? Else leave these sweeps out"
        findings.append(Finding("sweeps", WRONG, f"{text}, while those around it have {small[first]:,}: {fix}"))
    with suppress(CFlowError, OSError):  # of a sweep that cannot be read
        findings += _misplaced(log, neighbours)
    return findings


def _misplaced(log: _CheckedLog, neighbours: Neighbours) -> list[Finding]:
    """Find sweeps that repeat the one before, and others that fit neither the sweep before them nor the one after."""
    findings = []
    repeated = [index for index in neighbours.repeated if index > 1]  # `_repeated` tells the first
    if repeated:
        text = f"{len(repeated)} of them repeat the points of the sweep before, the first is sweep {repeated[0]}"
        findings.append(Finding("sweeps", WRONG, f"{text}: leave them out, or copy their files again"))
    for lapse in log.lapses:
        if lapse.kind == MISSING:
            where = f"before sweep {lapse.sweep}, because the vehicle moves {lapse.metres:.1f} m there"
            text = f"sweeps seem to be missing {where}: give the times of the sweeps"
            findings.append(Finding("sweeps", WRONG, text))
    known = {lapse.sweep for lapse in log.lapses} | set(repeated) | set(neighbours.small)
    misplaced = neighbours.misplaced(log)
    if misplaced and (log.misfit or set(log.motion.best) - {NO_READING}):
        misplaced = []  # they are explained
    for first, last in misplaced:
        if not known.isdisjoint(range(first, last + 2)):
            continue
        if last < first:
            what = f"sweeps {last} and {first} do not fit each other, while those around do"
            fix = "are sweeps missing between them, or do poses jump? Give the parts as logs of their own, or"
            fix += " data.odometry=refine if the poses are noisy"
        else:
            what = f"sweep {first} does" if first == last else f"sweeps {first} to {last} do"
            what += " not fit those around"
            fix = "has it points or a pose of another time? Correct its files, or leave it out"
            fix = _OF_SPARSE_POSES if log.unwrapped.has_sparse_poses else fix
        findings.append(Finding("sweeps", WRONG, f"{what}: {fix}"))
    return findings


def _sensor(log: _CheckedLog) -> list[Finding]:
    index = log.typical[0]
    sweep = log.sweep(index)
    points = as_numpy(sweep.points)[:, :3].astype(np.float64)
    kept = points[np.isfinite(points).all(1)]
    distance = np.linalg.norm(kept, axis=1)
    parts = [f"{len(log.timestamps)} sweeps", f"{len(points):,} points in {_name_of(index) if index else 'the first'}"]
    if len(kept) < len(points):
        parts.append(f"{len(points) - len(kept):,} of them not finite")
    if len(kept):
        parts.append(f"range {np.quantile(distance, 0.01):.1f} to {np.quantile(distance, 0.99):.0f} m")
        beams, spacing = _beams(kept)
        parts += [f"about {beams} beams"] if beams else []
        parts += [f"{spacing:.2f} degrees between points"] if spacing else []
    columns = sorted(log.columns(index))
    parts += [f"columns {', '.join(columns)}"] if columns else []
    return [Finding("sensor", RIGHT, ", ".join(parts))]


def _beams(points: np.ndarray) -> tuple[int, float]:
    """Estimate the number of beams, and the angle between neighbouring points of a beam in degrees; 0 = unknown.

    Points in the order of a scan follow one beam, or one column. The origin must be near the LiDAR, else the elevations
    of a beam are not equal.
    """
    azimuth = np.degrees(np.arctan2(points[:, 1], points[:, 0]))
    elevation = np.degrees(np.arctan2(points[:, 2], np.hypot(points[:, 0], points[:, 1])))
    steps = np.abs((np.diff(azimuth) + 180) % 360 - 180)
    along = steps[(steps > 0.01) & (steps < 2)]
    spacing = float(np.median(along)) if len(along) > len(points) // 4 else 0.0
    counts, _ = np.histogram(elevation, np.arange(-40, 40, 0.1))
    peaks = (counts[1:-1] > counts[:-2]) & (counts[1:-1] >= counts[2:]) & (counts[1:-1] > 3 * counts.mean())
    beams = int(peaks.sum()) if counts[1:-1][peaks].sum() > 0.3 * len(points) else 0
    return beams, spacing


def _times(log: Log) -> list[Finding]:
    interval = intervals_of(log)
    if interval is None:
        return [Finding("times", RIGHT, "the sweeps have no times, so motion is known per sweep, not per second")]
    usual = float(np.median(interval))
    if usual <= 0 or (interval <= 0).any():
        return [Finding("times", WRONG, "times of sweeps do not ascend: give the time of each sweep")]
    gaps = gaps_in(interval)
    text = f"{1 / (usual if gaps else interval.mean()):.1f} Hz"  # two sensors in turns: a short, then a long interval
    if gaps:
        longest = max(gaps, key=interval.__getitem__)
        text += f"; {len(gaps)} gaps, the longest of {interval[longest]:.1f} s after sweep {longest}"
        return [Finding("times", FOUND, f"{text}. No history or future of a window reaches over them")]
    if not is_usual_interval(float(interval.mean())):
        return [Finding("times", WRONG, f"{text}: are the times in the unit that the reader expects?")]
    if _change(interval) > _UNEVEN:
        text += f", and intervals change by {100 * _change(interval):.0f} % from one to the next"
        poses = known_poses(log)
        steps = np.zeros(len(interval)) if poses is None else np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1)
        if np.median(steps) > _LEAST_MOTION and _change(steps) < _EVEN * _change(steps / interval):
            return [Finding("times", WRONG, f"{text}, but the motion does not: give times of measurement, or none")]
    return [Finding("times", RIGHT, text)]


def _change(values: np.ndarray) -> float:
    """Return the median change from one value to the next, as a part of the median value."""
    return float(np.median(np.abs(np.diff(values))) / np.median(values)) if len(values) > 1 else 0.0


def _poses(log: Log) -> list[Finding]:
    poses = known_poses(log)
    if poses is None:
        pose = log.sweep(0).pose
        if pose is None:
            return [Finding("poses", RIGHT, "none: we take the sensor for static (data.odometry=true estimates them)")]
        return [Finding("poses", RIGHT, "of each sweep, read with its points")]
    steps = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1)
    text = f"of all sweeps; the vehicle moves {steps.sum():.1f} m, up to {steps.max(initial=0):.2f} m a sweep"
    return [Finding("poses", RIGHT, text)]


def _labels(log: Log) -> list[Finding]:
    indices = np.unique(np.linspace(0, len(log.timestamps) - 2, 5).astype(int)).tolist()
    labels = next(filter(None, map(log.labels, indices)), None)
    if labels is None:
        return [Finding("labels", RIGHT, "none: `cflow flow` needs none, `cflow eval` does")]
    valid = float(labels.is_valid.mean()) if len(labels.is_valid) else 0.0
    longest = float(np.linalg.norm(labels.flow[labels.is_valid], axis=1).max(initial=0))
    return [Finding("labels", RIGHT, f"flow of {100 * valid:.0f} % of the points, up to {longest:.2f} m a sweep")]
