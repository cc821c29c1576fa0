"""Under which reading of poses and points does the static world stand still? One comparison for all such mistakes.

Idea: (1) Take the static structure of two sweeps. (2) Each reading ("the poses are inverted", "the LiDAR turns
clockwise") places it: by a transform between the sweeps, and by the instants of the points. (3) Measure the share of
the structure that is in place. (4) Name the reading that is clearly best, unless that as given is as good.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import partial
from typing import Iterable, Mapping, Sequence

import numpy as np

from cflow_torch.diagnosis.conventions import (
    AXES,
    EQUAL,
    MARGIN,
    MIRRORED,
    MOUNT,
    MOUNTS,
    OFF,
    READINGS,
    TIMES,
    TIMES_OF_POSES,
    UNITS,
    WORLD,
    Reading,
    scale_poses,
)
from cflow_torch.diagnosis.other_frame import find_motion, motion_of, mounting, mounting_of, place_of, rotation_between
from cflow_torch.diagnosis.pair import COMPARED, GIVEN, LEAST_MOTION, MOST_POINTS, Pair, difference
from cflow_torch.diagnosis.stillness import LEAST_SHARE
from cflow_torch.transforms import turn_of
from cflow_torch.windows.deskewing import DIRECTIONS, INSTANTS, SCANS

STEPS = ("steps", "steps_back")
HALVES = ("half_late", "half_early")
# Readings that are no conventions: they follow from the points.
UNKNOWN, MOUNTED, SLIGHT, SCALED = "unknown", "mounted", "slightly turned", "scaled"
INACCURATE, NO_READING = "inaccurate", "none"

_OPPOSITE = 0.97  # of the share as given: what the opposite of a near reading has at most, or half of what this has
# After a shift along the path (metres), the share must be smaller by this factor: along smooth walls it is not.
_SHIFT, _PEAK = 0.15, 1.2
_BESIDE, _OF_BESIDE = 0.5, 1.5  # metres, and share as given over that so far along the path: if sweeps fit, 2.5 to 4
_TURN = 1.1  # share of a direction over that of its opposite, from which other starts of its turn are compared
# Traffic stays in place without the ego motion, or under one that is shorter by so many metres, or by half: up to 2.5
# times the share as given, if the poses are right. But traffic fills few places, and the static world fits better as
# given in others: in 0.19 to 1.1 times as many blocks on 20 simulated highways. If poses are wrong, up to 0.13 times.
_SHORTER, _OF_BLOCKS = 2.0, 0.15
_OF_ERRORS = 1.2  # least share with another motion in each pair over that as given
_EXCUSE = 1.1  # share with another motion in each pair over that of a reading with a name
_OBLIQUE = np.radians(10)  # least angle between axes and those with a name
_RESCALED = 1.05  # least factor between motions of another scale
_OF_UNIT = 1.5  # largest factor between a scale, which is not exact, and that of a unit, which the points then confirm
_UNCLEAR = 0.15  # share under the best reading of fast sweeps, below which they may be skewed, too
# Share under the motions that fit best over that as given, from which other motions are compared; if poses and points
# are right, up to 1.13.
_FREE = 1.1
# Metres between the motion under which the points fit and that of the poses. A smaller difference than the first is
# within the cells of the search. Noise does not make a larger one than the second.
_SMALLEST_ERROR, _LARGEST_ERROR = 0.08, 1.5
_HOPELESS = 0.04  # share as given, below which nothing fits
_SEARCHED = 0.4  # share as given, below which we look for an unknown motion


@dataclass(frozen=True)
class Judgement:
    """The shares of structure in place, means of all pairs that show the reading, and the readings that are best."""

    shares: dict[str, float]  # reading -> 0 ... 1; empty = nothing could be compared
    best: tuple[str, ...] = ()  # readings of the poses that fit clearly better than as given; equal ones together
    found: Mapping[str, Reading] = field(default_factory=dict)  # readings that follow from these points
    free: float = float("nan")  # share in place under the motions that fit best
    is_peak: bool = False  # the share as given is clearly larger than half a metre farther
    scan: str = ""  # the scan under which this holds; "" = not compared
    shares_of_scans: Mapping[str, float] = field(default_factory=dict)
    is_sparse: bool = False  # the sweeps have so few points that hardly any is measured again

    @property
    def given(self) -> float:
        """Share of structure in place as given, NaN = nothing could be compared."""
        return self.shares.get(GIVEN, float("nan"))

    @property
    def fits(self) -> float:
        """Share of structure in place under the best reading."""
        return self.shares.get(self.best[0], self.given) if self.best else self.given

    @property
    def is_low(self) -> bool:
        """Whether less of the structure is in place as given than in sweeps that fit, and no reading is better.

        Sweeps of few or noisy points have small shares, but these are larger than half a metre farther.
        """
        return not self.best and self.given < LEAST_SHARE and not self.is_peak

    def confirmed_by(self, again: Judgement) -> Judgement:
        """Return the judgement without small mistakes that other pairs do not show.

        Noise may fit one of them by chance, and poses are then inaccurate. The motion of the points fits noise better.
        """
        if not self.best or not again.shares:
            return self
        others = {name.partition(" ")[0] for name in again.best}  # any mounting confirms one
        names = [
            name
            for name in self.best
            if not _is_small(name)
            or name.partition(" ")[0] in others
            or again.shares.get(name, 0) >= MARGIN * again.given
            or self.shares.get(name, 0) >= self.free
        ]
        if names or not self.free >= _FREE * self.given:
            return replace(self, best=tuple(names))
        return replace(self, best=(INACCURATE,), shares={**self.shares, INACCURATE: self.free})

    def reading(self, name: str) -> Reading:
        """Return what a reading means."""
        return self.found[name] if name in self.found else COMPARED[name]

    def __str__(self) -> str:
        """What is wrong, "" = nothing."""
        if not self.best:
            return ""
        if self.best == (NO_READING,):
            return f"the sweeps fit under no reading (only {self.given:.2f} of the static structure is in place)"
        share = self.shares.get(self.best[0], 0)
        causes = ", or ".join(self.reading(name).cause for name in self.best)
        return f"{causes} ({self.given:.2f} of the static structure is in place as given, {share:.2f} then)"


def judge(pairs: Iterable[Pair | None]) -> Judgement:
    """Compare the scans, then the readings of the poses, over all pairs, and name those that are clearly best.

    Pairs whose poses do not move the structure do not show anything. If all are such pairs, we look for an unknown
    motion. Cost: 0.1 s per pair.
    """
    usable = [pair for pair in pairs if pair is not None]
    return replace(_judge(usable), is_sparse=any(pair.is_sparse for pair in usable))


def _judge(usable: Sequence[Pair]) -> Judgement:
    moving = [pair for pair in usable if pair.has_motion]
    if not moving:
        shares, clear = _compare([pair.among(STEPS).shares_of_poses(OFF) for pair in usable])
        judgement = Judgement(shares, tuple(clear[:1])) if clear else _judge_motion(usable)
        is_hopeless = not judgement.best and len(usable) > 1 and judgement.given < _HOPELESS
        return replace(judgement, best=(NO_READING,)) if is_hopeless else judgement
    fast = [pair for pair in moving if len(pair.scans) > 1]
    scan, shares_of_scans = _best_scan(fast) if fast else (moving[0].scans[0], {})
    judgement = _judge_poses(moving, scan)
    is_unclear = judgement.best in ((NO_READING,), (INACCURATE,)) or judgement.fits < _UNCLEAR
    if fast and is_unclear:  # the sweeps may be skewed and the poses be of another frame
        scans = [each for each in fast[0].scans if each != scan]
        named = [each for each in (_judge_poses(moving, scan) for scan in scans) if each.fits > _TURN * judgement.fits]
        judgement = max(named, key=lambda each: each.fits, default=judgement)
    return replace(judgement, shares_of_scans=shares_of_scans if judgement.scan == scan else {})


def _judge_poses(moving: Sequence[Pair], scan: str) -> Judgement:
    """Compare the readings of the poses of pairs that move, under one scan."""
    of_pairs = [pair.shares_of_poses(scan) for pair in moving]
    given = float(np.mean([each[GIVEN] for each in of_pairs]))
    free, found, others = _read_motions(moving, scan, given)
    if found:
        of_pairs = [{**each, **other.shares_of_poses(scan)} for each, other in zip(of_pairs, others)]
        moving = [
            replace(pair, transforms={**pair.transforms, **other.transforms}) for pair, other in zip(moving, others)
        ]
    shares, clear = _compare(of_pairs)
    beside = np.mean([pair.share(scan, shift=_BESIDE) for pair in moving])
    is_peak = bool(given > max(_HOPELESS, _OF_BESIDE * beside))
    judgement = Judgement(shares, found=found, scan=scan, free=free, is_peak=is_peak)
    if WORLD in clear:  # two signs agree: the points lie around the poses, and stand still without them
        return replace(judgement, best=(WORLD,))
    clear = [name for name in clear if not _may_be_traffic(name, moving, scan)]
    if clear or shares[GIVEN] >= _HOPELESS:
        best = _equals(clear, shares)
        elsewhere = {name: mounting(np.eye(3), place_of(moving, scan, np.eye(3))) for name in best if name in MOUNTS}
        return replace(judgement, best=best, found={**found, **elsewhere})
    if any(pair.is_sparse for pair in moving):
        return Judgement({})
    # Two clouds that stand still under no motion at all may have no static structure, so they do not show anything.
    is_hopeless = len(moving) > 1 or bool(_judge_motion(moving).best)
    return replace(judgement, best=(NO_READING,)) if is_hopeless else judgement


def _read_motions(pairs: Sequence[Pair], scan: str, given: float) -> tuple[float, dict[str, Reading], Sequence[Pair]]:
    """Return the share in place under the motions of the points and, if it is larger than `given`, what these tell.

    The readings that follow from the motions, and the pairs with them, are those of `_compare_motions`.
    """
    motions = [motion_of(pair, scan) for pair in pairs]
    fitted = [replace(pair, transforms={GIVEN: motion}) for pair, motion in zip(pairs, motions)]
    free = float(np.mean([pair.share(scan) for pair in fitted]))
    if free <= _FREE * given or any(WORLD in pair.transforms for pair in pairs):
        return free, {}, ()
    return free, *_compare_motions(pairs, scan, motions)


def _may_be_traffic(name: str, pairs: Sequence[Pair], scan: str) -> bool:
    """Test whether a motion far shorter than as given leaves less in place in many blocks of the static world."""
    shown = [pair for pair in pairs if name in pair.transforms]
    given, read = (np.mean([np.linalg.norm(pair.transforms[each][:3, 3]) for pair in shown]) for each in (GIVEN, name))
    if given - read < min(_SHORTER, given / 2):
        return False
    num_given, num_read = np.sum([pair.blocks(name, scan) for pair in shown], axis=0)
    return bool(num_given >= _OF_BLOCKS * num_read)


def _equals(clear: Sequence[str], shares: Mapping[str, float]) -> tuple[str, ...]:
    """Return the best of the readings, best first, and those that are about as good; small mistakes only with others.

    Of mountings and of times, only one is named. Other motions in each pair are named only if they fit clearly better.
    """
    named = [name for name in clear if name != INACCURATE]
    if len(named) < len(clear) and shares[INACCURATE] > _EXCUSE * max([shares[name] for name in named], default=0):
        return (INACCURATE,)
    best = [name for name in named if shares[name] >= EQUAL * shares[named[0]]]
    # Right-handed ones first; in turns, a slight rotation is as good as another position.
    best.sort(key=lambda name: (name in MIRRORED) + 2 * (name in (MOUNTED, SLIGHT)))
    best = [name for name in best if name in (SCALED, MOUNTED, SLIGHT) or _is_small(name) == _is_small(best[0])]
    # A convention says more than a number. But on a straight road, several remove a slight turn by chance.
    if any(name in READINGS for name in best):
        best = [name for name in best if name not in (SCALED, MOUNTED)]
    kinds = (MOUNT, *MOUNTS), TIMES_OF_POSES
    others = [name for kind in kinds for name in [name for name in best if name in kind][1:]]
    return tuple(name for name in best if name not in others)


def _is_small(name: str) -> bool:
    return name == MOUNT or (name in COMPARED and COMPARED[name].opposite != "")


def _compare_motions(
    pairs: Sequence[Pair], scan: str, motions: Sequence[np.ndarray]
) -> tuple[dict[str, Reading], list[Pair]]:
    """Compare the motions of the poses with those under which the points fit.

    They may be of a frame that is turned, and elsewhere, unless such a reading has a name. They may be longer or
    shorter. Or each pair has another small error.

    Returns:
        These readings, and the pairs with those of them that each shows.
    """
    steps = [pair.transforms[GIVEN] for pair in pairs]
    errors = [float(np.linalg.norm((motion - step)[:2, 3])) for motion, step in zip(motions, steps)]
    found = _readings_of_motions(pairs, scan, motions)
    farthest = max(float(difference(motion, step)) for motion, step in zip(motions, steps))
    found[INACCURATE] = Reading(
        f"the poses are off, by up to {farthest:.1f} m between two sweeps for points 20 m away",
        fix="exact poses and times, or data.odometry=refine if they are noisy",
    )
    read = []
    for pair, step, motion, error in zip(pairs, steps, motions, errors):
        transforms = {name: reading.of_poses(step) for name, reading in found.items() if reading.of_poses}
        if error <= _LARGEST_ERROR:
            fitted = replace(pair, transforms={GIVEN: motion})
            transforms.update({INACCURATE: motion} if fitted.share(scan) > pair.share(scan) else {})
        read.append(replace(pair, transforms={GIVEN: step, **transforms}))
    if sum(INACCURATE in pair.transforms for pair in read) < min(2, len(pairs)):  # one of several: another cause
        for pair in read:
            pair.transforms.pop(INACCURATE, None)
    return found, read


def _readings_of_motions(pairs: Sequence[Pair], scan: str, motions: Sequence[np.ndarray]) -> dict[str, Reading]:
    """Return how motions of the poses may differ from those of the points, (4, 4) each: of another frame, or scaled."""
    steps = [pair.transforms[GIVEN] for pair in pairs]
    given, fitted = (np.array(each)[:, :3, 3] for each in (steps, motions))
    lengths = [np.linalg.norm(each, axis=1) for each in (given, fitted)]
    scale = float(lengths[0] @ lengths[1] / max(lengths[0] @ lengths[0], 1e-9))
    rotation = rotation_between(np.array(steps), np.array(motions), scale)
    axes = np.round(rotation)
    is_turned = not np.array_equal(axes, np.eye(3))
    found = {}
    if turn_of(axes.T @ rotation) > _OBLIQUE or not np.array_equal(axes @ axes.T, np.eye(3)):
        found[MOUNTED] = mounting(*mounting_of(pairs, scan, rotation))
    elif is_turned:
        rotation = axes if axes[2, 2] == 1 else rotation
        place = place_of(pairs, scan, rotation)
        names = [name for name, known in AXES.items() if name in READINGS and np.array_equal(axes.T, known)]
        if place.any() or not names:
            found[MOUNTED] = mounting(rotation, place)
    elif turn_of(rotation) * lengths[0].max() > _SMALLEST_ERROR:
        is_better = np.linalg.norm(given - fitted @ rotation.T, axis=1) < np.linalg.norm(given - fitted, axis=1)
        if is_better.all():  # not only in turns
            found[SLIGHT] = mounting(rotation, np.zeros(3))
    if not is_turned and np.linalg.norm((fitted - given)[:, :2], axis=1).max() > _SMALLEST_ERROR:
        found[MOUNT] = mounting(axes, place_of(pairs, scan, axes))
    if lengths[1].max() < LEAST_MOTION:  # the vehicle stands
        return found
    found.update({name: READINGS[name] for name, unit in UNITS.items() if 1 / _OF_UNIT < scale / unit < _OF_UNIT})
    if scale > _RESCALED or 1e-9 < scale < 1 / _RESCALED:
        found[SCALED] = Reading(
            f"the positions of the poses are {1 / scale:.3g} times as long as the motion of the points",
            partial(scale_poses, scale),  # picklable
            fix=f"positions multiplied by {scale:.3g}, unless the points have another unit (feet)",
        )
    return found


def _best_scan(pairs: Sequence[Pair]) -> tuple[str, dict[str, float]]:
    """Return the scan under which the world stands still, and the shares of those that were compared.

    Points with times may be compensated already, or their times may be wrong: then we compare directions with the
    better of both. The instant of a sweep is when the LiDAR looks ahead. If no such scan is clearly better, and points
    have no times, it may be the start or the end of a turn, which shows where the motion changes.
    """
    expected, *others = [scan for scan in pairs[0].scans if scan not in DIRECTIONS]
    scan, of_times = _best_of(pairs, expected, others) if others else (expected, {})
    turned = [pair for pair in pairs if any(direction in pair.scans for direction in DIRECTIONS)]
    if not turned:
        return scan, of_times
    ahead, *instants = INSTANTS
    found, shares = _best_of(turned, scan, [direction + ahead for direction in DIRECTIONS])
    if found == scan and not others and any(name in pair.transforms for pair in turned for name in HALVES):
        of_instants = [_best_of(turned, scan, [name + instant for name in DIRECTIONS]) for instant in instants]
        best, of_best = max(of_instants, key=lambda each: each[1][each[0]])
        found, shares = (best, of_best) if best != scan else (found, shares)
    return found, {**of_times, **shares} if found != scan else of_times or shares


def _best_of(pairs: Sequence[Pair], expected: str, others: Sequence[str]) -> tuple[str, dict[str, float]]:
    """Return the best of scans, and the shares of those that were compared.

    Points with times that are expected are moved by these if they then fit at least as well. If a direction fits better
    than its opposite, turns may begin behind the vehicle or elsewhere: we choose behind, unless another start is
    clearly better. If the structure is shifted along the path, less of it must be in place: along smooth walls this is
    not so.
    """
    of_pairs = [pair.shares_of_scans((expected, *others)) for pair in pairs]
    shares, clear = _compare(of_pairs, expected, LEAST_SHARE / 2)
    if expected == TIMES and OFF in others:
        return max(shares, key=shares.__getitem__), shares  # ties: the times
    best, *opposite = sorted(others, key=shares.__getitem__, reverse=True)
    if best in SCANS and shares[best] >= _TURN * max(shares[scan] for scan in opposite):
        starts = [scan for scan in SCANS if SCANS[scan][::2] == SCANS[best][::2]]
        # A start that is clearly better is so in each pair, so the first pair rules out most.
        of_first = pairs[0].shares_of_scans(starts)
        starts = [start for start in starts if start == best or of_first[start] > of_first[best]]
        of_pairs = [{**pair.shares_of_scans(starts), **each} for pair, each in zip(pairs, of_pairs)]
        of_starts, clear = _compare(of_pairs, expected, LEAST_SHARE / 2)
        _, better = _compare([{start: each[start] for start in starts} for each in of_pairs], best)
        clear = [*better, best] if clear else []
        shares.update({scan: of_starts[scan] for scan in clear[:1]})
    if not clear:
        return expected, shares
    at_place, beside = (np.mean([pair.share(clear[0], shift=by) for pair in pairs]) for by in (0, _SHIFT))
    return (clear[0] if at_place >= _PEAK * beside else expected), shares


def _judge_motion(pairs: Sequence[Pair]) -> Judgement:
    """Look for an unknown motion in the plane, under which sweeps fit clearly better than as given."""
    motions = []
    of_pairs = []
    for pair in pairs:
        given = {GIVEN: pair.transforms[GIVEN]}
        if pair.share(OFF) < _SEARCHED:
            motion = find_motion(pair.source.points(OFF)[:MOST_POINTS], pair.target.points(OFF))
            if difference(motion, given[GIVEN]) >= LEAST_MOTION:
                motions.append(motion)
                given[UNKNOWN] = motion
        of_pairs.append(replace(pair, transforms=given).shares_of_poses(OFF))
    # Where a motion was not found, the vehicle may stand.
    shares, clear = _compare([each for each in of_pairs if UNKNOWN in each] or of_pairs)
    if not clear:
        return Judgement(shares)
    distance = np.hypot(*motions[0][:2, 3])
    moves = Reading(f"the sensor moves by about {distance:.1f} m between two sweeps")
    return Judgement(shares, tuple(clear), {UNKNOWN: moves})


def _compare(
    of_pairs: Sequence[Mapping[str, float]], given: str = GIVEN, least: float = LEAST_SHARE
) -> tuple[dict[str, float], list[str]]:
    """Compare the shares of readings over the pairs that show them.

    A reading is clearly better than as given if it is so in the mean, and better in each pair that shows it. It may be
    a small mistake, such as the direction of the scan or another mounting: then a smaller margin is enough, but the
    opposite mistake must be worse than as given, or much worse than the reading.

    Returns:
        The mean share of each reading, and those that are clearly better than as given, best first.
    """
    shares: dict[str, float] = {}
    gains: dict[str, float] = {}
    better = []
    for name in dict.fromkeys(name for each in of_pairs for name in each):
        # In a pair that does not show it, the reading is about the same as that as given.
        share, as_given = np.mean([(each.get(name, each[given]), each[given]) for each in of_pairs], axis=0)
        shares[name] = float(share)
        gains[name] = float(share / max(as_given, 1e-9))
        if share >= least and all(each[name] > each[given] for each in of_pairs if name in each):
            better.append(name)
    others = {INACCURATE: Reading("", margin=_OF_ERRORS)}
    known = {name: {**others, **COMPARED}.get(name, Reading("")) for name in better}
    clear = [name for name in better if gains[name] >= known[name].margin]
    clear = [name for name in clear if gains.get(known[name].opposite, 0) <= max(_OPPOSITE, gains[name] / 2)]
    return shares, sorted(clear, key=gains.__getitem__, reverse=True)
