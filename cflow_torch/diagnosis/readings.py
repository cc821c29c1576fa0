"""Under which reading of poses and points does the static world stand still? One comparison for all such mistakes.

Idea: (1) Take the static structure of two sweeps. (2) Each reading ("the poses are inverted", "the LiDAR turns
clockwise") places it: by a transform between the sweeps, and by the instants of the points. (3) Measure the share of
the structure that is in place. (4) Name the reading that is clearly best, unless that as given is as good.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import lru_cache, partial
from typing import Callable, Iterable, Mapping, Sequence

import numpy as np
import torch
from torch import Tensor

from cflow_torch.diagnosis.conventions import (
    AXES,
    MIRRORED,
    MOUNT,
    MOUNTS,
    OFF,
    READINGS,
    REVERSED,
    SCAN_READINGS,
    STILL,
    TIMES,
    TIMES_OF_POSES,
    UNITS,
    WORLD,
    Reading,
    scaled,
)
from cflow_torch.diagnosis.stillness import FEWEST_POINTS, LEAST_SHARE, Structure, cell_keys, structure_rows
from cflow_torch.transforms import as_matrix, rigid_transform, rotations_about, transform_points, turn_of
from cflow_torch.types import Array, Sweep, as_numpy
from cflow_torch.windows.deskewing import DIRECTIONS, INSTANTS, SCANS

GIVEN = "as given"
STEPS = ("steps", "steps_back")
HALVES = ("half_late", "half_early")
# Readings that are no conventions: they follow from the points.
UNKNOWN, MOUNTED, SCALED = "unknown", "mounted", "scaled"
INACCURATE, NO_READING = "inaccurate", "none"

_FEW_POINTS, _MOST_POINTS = 300, 1500  # of the source; readings not much worse than as given are compared by the most
_MOST_AROUND = 5000  # points that tell what they lie around
_TIMED_POINTS = 6000  # to compare points with times, moved and as they are: the better of both is used
_NEAR_GIVEN = 0.7  # share of a reading over that as given
_BLOCK, _FEWEST_BLOCKS = 5.0, 12  # metres; structure in fewer blocks may be a few moving objects
_LEAST_MOTION, _ARM = 0.2, 20.0  # metres; poses that move points 20 m away by less do not show anything
LEAST_DISTANCE = 3.0  # metres between pose and origin, to tell whose surroundings points are
_LEAST_DIFFERENCE = 0.05  # metres; a pair shows only the readings that move these points otherwise by this
_OPPOSITE = 0.97  # of the share as given: what the opposite of a near reading has at most, or half of what this has
# After a shift along the path (metres), the share must be smaller by this factor: along smooth walls it is not.
_SHIFT, _PEAK = 0.15, 1.2
_TURN = 1.1  # share of a direction over that of its opposite, from which other starts of its turn are compared
EQUAL = 0.95  # readings whose share is at least this part of the best one are named together
# Traffic stays in place without the ego motion, or under a part of it: up to 2.5 times the share as given, if the poses
# are right. If they are wrong by so many metres, less than this part of that under the right reading is in place.
_FAR, _OF_FAR, _AS_LONG = 2.0, 1 / 3, 0.99
_OF_ERRORS = 1.2  # least share with another motion in each pair over that as given
_EXCUSE = 1.1  # share with another motion in each pair over that of a reading with a name
_LEVEL = np.radians(5)  # tilt up to which only the angle about z is told
_SLIGHT, _OBLIQUE = np.radians((2, 10))  # least angles between axes that are turned and those as given, or with a name
_RESCALED = 1.05  # least factor between motions of another scale
_OF_UNIT = 1.5  # largest factor between a scale, which is not exact, and that of a unit, which the points then confirm
_ITERATIONS = 3
_WEAK, _UNSHOWN = 0.1, 0.15  # metres of no rotation, and of no place a metre away: what the motions do not show
_DIRECTIONS = (("ahead", "back"), ("left", "right"), ("up", "down"))
_UNCLEAR = 0.15  # share of a pair as given, below which its motion is compared with that under which the points fit
# Metres of such a motion from that of the poses. Less in all pairs is within the cells of the search; more, or more
# than half of the motion, is more than an error of measurement.
_SMALLEST_ERROR, _LARGEST_ERROR = 0.08, 1.5
# Nothing fits if the share as given is below this. Of sweeps with so few points, no more fit under right poses.
_HOPELESS, _SPARSE = 0.04, 3000
_SEARCHED = 0.4  # share as given, below which we look for an unknown motion
# The search for an unknown motion correlates occupied cells of a square.
_CELL, _CELLS = 0.1, 640  # metres, and cells along a side
_TURNS = np.radians([-4, -2.5, -1.2, -0.5, 0, 0.5, 1.2, 2.5, 4]).tolist()
_WITHIN_CELL = np.array([(x, y) for x in (0, -0.5, 0.5) for y in (0, -0.5, 0.5)]) * _CELL
_SMALL_TURNS = np.radians([0, -0.5, 0.5, -1, 1]).tolist()
_FARTHEST_SHIFT = 7.0  # metres
_PLACES = 0.4 * np.array([(x, y) for x in range(-10, 11) for y in range(-10, 11) if x or y])  # metres, of the LiDAR
_NUM_BEST = 30  # places that are compared by the most points
_BETWEEN = 0.2 * np.array([(x, y) for x in range(-1, 2) for y in range(-1, 2)])


_COMPARED = {**READINGS, **MOUNTS, **SCAN_READINGS}
_DERIVED = (REVERSED, *UNITS)  # these follow from all poses of a log, and from the lengths of motions
_OF_POSES = {name: reading.of_poses for name, reading in _COMPARED.items() if reading.of_poses and name not in _DERIVED}


class ScannedStructure:
    """The static structure of a sweep, thinned: `points` gives it at the instant of the sweep, for each scan."""

    def __init__(self, points: Callable[[str], np.ndarray]) -> None:
        self.points = lru_cache(None)(points)
        self.structure = lru_cache(None)(lambda scan: Structure(self.points(scan)))


@dataclass(frozen=True)
class Pair:
    """The static structure of two sweeps, and how it may be read.

    Points are relative to the position of the vehicle in the frame of the points: 0, or that of the pose if the points
    are in the world's frame.
    """

    source: ScannedStructure
    target: ScannedStructure
    transforms: dict[str, np.ndarray]  # reading of the poses -> (4, 4) float64, source to target
    scans: tuple[str, ...]  # how points may move to the instant of their sweep, as `deskew`; the first one is expected
    has_motion: bool  # the poses move the structure enough to tell readings apart
    is_sparse: bool = False  # the sweeps have so few points that hardly any is measured again

    def share(self, scan: str, count: int = _MOST_POINTS, shift: float = 0.0) -> float:
        """Return the share of the first `count` points in place as given, moved by `shift` metres along the path."""
        T = self.transforms[GIVEN].copy()
        T[:3, 3] *= 1 + shift / max(float(np.linalg.norm(T[:3, 3])), 1e-9)
        return self.target.structure(scan).share(self.source.points(scan)[:count], T)

    def shares_of_scans(self, scans: Sequence[str]) -> dict[str, float]:
        count = _TIMED_POINTS if TIMES in scans else _MOST_POINTS
        return {scan: self.share(scan, count) for scan in scans}

    def shares_of_poses(self, scan: str) -> dict[str, float]:
        """Return the share of each reading of the poses, by few points if it is much worse than as given."""
        shares = self._shares(list(self.transforms), scan, _FEW_POINTS)
        rivals = [name for name, share in shares.items() if share >= _NEAR_GIVEN * shares[GIVEN]]
        return {**shares, **self._shares(rivals, scan, _MOST_POINTS)}

    def among(self, readings: Sequence[str]) -> Pair:
        """Return the pair with these readings of the poses, and that as given."""
        kept = {name: T for name, T in self.transforms.items() if name in (GIVEN, *readings)}
        return replace(self, transforms=kept)

    def _shares(self, readings: Sequence[str], scan: str, count: int) -> dict[str, float]:
        transforms = np.stack([self.transforms[name] for name in readings])
        shares = self.target.structure(scan).shares(self.source.points(scan)[:count], transforms)
        return dict(zip(readings, shares.tolist()))


@dataclass(frozen=True)
class Judgement:
    """The shares of structure in place, means of all pairs that show the reading, and the readings that are best."""

    shares: dict[str, float]  # reading -> 0 ... 1; empty = nothing could be compared
    best: tuple[str, ...] = ()  # readings of the poses that fit clearly better than as given; equal ones together
    found: Mapping[str, Reading] = field(default_factory=dict)  # readings that follow from these points
    scan: str = ""  # the scan under which this holds; "" = not compared
    shares_of_scans: Mapping[str, float] = field(default_factory=dict)

    @property
    def given(self) -> float:
        """Share of structure in place as given, NaN = nothing could be compared."""
        return self.shares.get(GIVEN, float("nan"))

    @property
    def fits(self) -> float:
        """Share of structure in place under the best reading."""
        return self.shares.get(self.best[0], self.given) if self.best else self.given

    def reading(self, name: str) -> Reading:
        """Return what a reading means."""
        return self.found[name] if name in self.found else _COMPARED[name]

    def __str__(self) -> str:
        """What is wrong, "" = nothing."""
        if not self.best:
            return ""
        if self.best == (NO_READING,):
            return f"the sweeps fit under no reading (only {self.given:.2f} of the static structure is in place)"
        share = self.shares.get(self.best[0], 0)
        causes = ", or ".join(self.reading(name).cause for name in self.best)
        return f"{causes} ({self.given:.2f} of the static structure is in place as given, {share:.2f} then)"


def _as_it_is(sweep: Sweep, rows: np.ndarray, scan: str) -> np.ndarray:
    return as_numpy(sweep.points)[rows, :3].astype(np.float64)


def make_pair(
    pc0: Sweep,
    pc1: Sweep,
    around: np.ndarray | None = None,
    rows: tuple[int, int] = (0, 1),
    in_world: bool | None = None,
    deskew: Sequence[Callable[[Sweep, np.ndarray, str], np.ndarray]] = (_as_it_is, _as_it_is),
    scans: Sequence[str] = (OFF,),
) -> Pair | None:
    """Prepare two sweeps for `judge`. None if they have too little structure.

    Args:
        pc0, pc1: the sweeps, in the order of time.
        around: (L, 4, 4) float64, poses of consecutive sweeps, of which `pc0` and `pc1` are the two `rows`; None = only
            those of the two sweeps are known.
        in_world: the points lie around the positions of the poses, see `is_around`; None = test it.
        deskew: for each sweep, a function that returns some of its rows, (K, 3), at its instant, for one of the scans.
        scans: the scans that are compared, values of `deskew`; the first one is that as given.
    """
    has_poses = pc0.pose is not None and pc1.pose is not None
    poses = np.stack([rigid_transform(each.pose, "pose") if has_poses else np.eye(4) for each in (pc0, pc1)])
    if in_world is None:
        in_world = has_poses and is_around(pc1.points, poses[1])
    centre = poses[1, :3, 3] if in_world else np.zeros(3)
    rows_of = [structure_rows(sweep, centre) for sweep in (pc0, pc1)]
    if min(map(len, rows_of)) < FEWEST_POINTS or _num_blocks(_as_it_is(pc0, rows_of[0], OFF)) < _FEWEST_BLOCKS:
        return None
    rows_of[0] = rows_of[0][: _TIMED_POINTS if TIMES in scans else _MOST_POINTS]
    clouds = [_cloud(*each, centre) for each in zip((pc0, pc1), rows_of, deskew)]
    transforms = _transforms(poses if around is None else around, rows) if has_poses else {GIVEN: np.eye(4)}
    if in_world:
        transforms = {name: _about(centre, T) for name, T in transforms.items()}
        transforms[WORLD] = transforms.pop(STILL)
    has_motion = has_poses and (in_world or bool(difference(transforms[GIVEN], np.eye(4)) >= _LEAST_MOTION))
    is_sparse = min(len(pc0.points), len(pc1.points)) < _SPARSE
    return Pair(clouds[0], clouds[1], transforms, tuple(scans), has_motion, is_sparse)


def _cloud(
    sweep: Sweep, rows: np.ndarray, move: Callable[[Sweep, np.ndarray, str], np.ndarray], centre: np.ndarray
) -> ScannedStructure:
    return ScannedStructure(lambda scan: (_as_it_is if scan == OFF else move)(sweep, rows, scan) - centre)


def _transforms(poses: np.ndarray, rows: tuple[int, int]) -> dict[str, np.ndarray]:
    """Return T_1_0 of two rows of poses, (L, 4, 4), under each reading that moves points otherwise than as given."""
    T = _between(poses, rows)
    read = {name: _between(convert(poses), rows) for name, convert in _OF_POSES.items()}
    shown = {name: other for name, other in read.items() if name == STILL or difference(T, other) >= _LEAST_DIFFERENCE}
    return {GIVEN: T, **shown}


def _between(poses: np.ndarray, rows: tuple[int, int]) -> np.ndarray:
    return np.linalg.inv(poses[rows[1]]) @ poses[rows[0]]  # type: ignore[no-any-return]


def judge(pairs: Iterable[Pair | None]) -> Judgement:
    """Compare the scans, then the readings of the poses, over all pairs, and name those that are clearly best.

    Pairs whose poses do not move the structure do not show anything. If all are such pairs, we look for an unknown
    motion. Cost: 0.1 s per pair.
    """
    usable = [pair for pair in pairs if pair is not None]
    moving = [pair for pair in usable if pair.has_motion]
    if not moving:
        shares, clear = _compare([pair.among(STEPS).shares_of_poses(OFF) for pair in usable])
        judgement = Judgement(shares, tuple(clear[:1])) if clear else _judge_motion(usable)
        is_hopeless = not judgement.best and len(usable) > 1 and judgement.given < _HOPELESS
        return replace(judgement, best=(NO_READING,)) if is_hopeless else judgement
    fast = [pair for pair in moving if len(pair.scans) > 1]
    scan, shares_of_scans = _best_scan(fast) if fast else (moving[0].scans[0], {})
    judgement = _judge_poses(moving, scan)
    if judgement.best in ((NO_READING,), (INACCURATE,)):  # the sweeps may be skewed and the poses be of another frame
        scans = [each for each in DIRECTIONS if fast and each in fast[0].scans]
        named = [each for each in (_judge_poses(moving, scan) for scan in scans) if each.fits > _TURN * judgement.fits]
        judgement = max(named, key=lambda each: each.fits, default=judgement)
    return replace(judgement, shares_of_scans=shares_of_scans if judgement.scan == scan else {})


def _judge_poses(moving: Sequence[Pair], scan: str) -> Judgement:
    """Compare the readings of the poses of pairs that move, under one scan."""
    of_pairs = [pair.shares_of_poses(scan) for pair in moving]
    found: dict[str, Reading] = {}
    if min(each[GIVEN] for each in of_pairs) < _UNCLEAR and not any(WORLD in each for each in of_pairs):
        found, others = _compare_motions(moving, scan)
        of_pairs = [{**each, **other.shares_of_poses(scan)} for each, other in zip(of_pairs, others)]
        moving = [
            replace(pair, transforms={**pair.transforms, **other.transforms}) for pair, other in zip(moving, others)
        ]
    shares, clear = _compare(of_pairs)
    judgement = Judgement(shares, found=found, scan=scan)
    if WORLD in clear:  # two signs agree: the points lie around the poses, and stand still without them
        return replace(judgement, best=(WORLD,))
    clear = [name for name in clear if all(map(partial(_is_clear_in, name), moving, of_pairs))]
    if clear or shares[GIVEN] >= _HOPELESS:
        best = _equals(clear, shares)
        elsewhere = {name: _mounting(np.eye(3), _place_of(moving, scan, np.eye(3))) for name in best if name in MOUNTS}
        return replace(judgement, best=best, found={**found, **elsewhere})
    if any(pair.is_sparse for pair in moving):
        return Judgement({})
    # Two clouds that stand still under no motion at all may have no static structure, so they do not show anything.
    is_hopeless = len(moving) > 1 or bool(_judge_motion(moving).best)
    return replace(judgement, best=(NO_READING,)) if is_hopeless else judgement


def _is_clear_in(name: str, pair: Pair, shares: Mapping[str, float]) -> bool:
    """Test whether hardly any structure of a pair is in place as given, if a reading moves it far."""
    if name not in shares or difference(pair.transforms[name], pair.transforms[GIVEN]) < _FAR:
        return True
    given, read = (np.linalg.norm(pair.transforms[each][:3, 3]) for each in (GIVEN, name))
    if read >= _AS_LONG * given:  # traffic does not stay in place under a motion as long as that of the vehicle
        return True
    return shares[GIVEN] <= _OF_FAR * shares[name]


def _equals(clear: Sequence[str], shares: Mapping[str, float]) -> tuple[str, ...]:
    """Return the best of the readings, best first, and those that are about as good; small mistakes only with others.

    Of mountings and of times, only one is named. Other motions in each pair are named only if they fit clearly better.
    """
    named = [name for name in clear if name != INACCURATE]
    if len(named) < len(clear) and shares[INACCURATE] > _EXCUSE * max([shares[name] for name in named], default=0):
        return (INACCURATE,)
    best = [name for name in named if shares[name] >= EQUAL * shares[named[0]]]
    # Right-handed ones first; in turns, a slight rotation is as good as another position.
    best.sort(key=lambda name: (name in MIRRORED) + 2 * (name == MOUNTED))
    best = [name for name in best if name in (SCALED, MOUNTED) or _is_small(name) == _is_small(best[0])]
    if any(name in READINGS for name in best):  # a convention says more than a number
        best = [name for name in best if name not in (SCALED, MOUNTED)]
    kinds = (MOUNT, *MOUNTS), TIMES_OF_POSES
    others = [name for kind in kinds for name in [name for name in best if name in kind][1:]]
    return tuple(name for name in best if name not in others)


def _is_small(name: str) -> bool:
    return name == MOUNT or (name in _COMPARED and _COMPARED[name].opposite != "")


def _compare_motions(pairs: Sequence[Pair], scan: str) -> tuple[dict[str, Reading], list[Pair]]:
    """Compare the motions of the poses with those under which the points fit.

    They may be of a frame that is turned, and elsewhere, unless such a reading has a name. They may be longer or
    shorter. Or each pair has another small error.

    Returns:
        These readings, and the pairs with those of them that each shows.
    """
    motions = [_motion_of(pair, scan) for pair in pairs]
    steps = [pair.transforms[GIVEN] for pair in pairs]
    errors = [float(np.linalg.norm((motion - step)[:2, 3])) for motion, step in zip(motions, steps)]
    found = _readings_of_motions(pairs, scan, motions)
    found[INACCURATE] = Reading(
        f"the poses are off, by up to {max(errors):.1f} m between two sweeps",
        fix="exact poses and times, or data.odometry=refine if they are noisy",
    )
    read = []
    for pair, step, motion, error in zip(pairs, steps, motions, errors):
        transforms = {name: reading.of_poses(step) for name, reading in found.items() if reading.of_poses}
        if max(errors) > _SMALLEST_ERROR and error <= min(_LARGEST_ERROR, float(np.linalg.norm(step[:2, 3])) / 2):
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
    rotation = _rotation_between(np.array(steps), np.array(motions), scale)
    axes = np.round(rotation)
    is_turned = not np.array_equal(axes, np.eye(3))
    found = {}
    if turn_of(axes.T @ rotation) > _OBLIQUE or not np.array_equal(axes @ axes.T, np.eye(3)):
        found[MOUNTED] = _mounting(rotation, _place_of(pairs, scan, rotation))
    elif is_turned:
        rotation = axes if axes[2, 2] == 1 else rotation
        place = _place_of(pairs, scan, rotation)
        names = [name for name, known in AXES.items() if name in READINGS and np.array_equal(axes.T, known)]
        if place.any() or not names:
            found[MOUNTED] = _mounting(rotation, place)
    elif turn_of(rotation) > _SLIGHT:
        is_better = np.linalg.norm(given - fitted @ rotation.T, axis=1) < np.linalg.norm(given - fitted, axis=1)
        if is_better.all():  # not only in turns
            found[MOUNTED] = _mounting(rotation, np.zeros(3))
    if not is_turned and np.linalg.norm((fitted - given)[:, :2], axis=1).max() > _SMALLEST_ERROR:
        found[MOUNT] = _mounting(axes, _place_of(pairs, scan, axes))
    found.update({name: READINGS[name] for name, unit in UNITS.items() if 1 / _OF_UNIT < scale / unit < _OF_UNIT})
    if scale > _RESCALED or 1e-9 < scale < 1 / _RESCALED:
        found[SCALED] = Reading(
            f"the positions of the poses are {1 / scale:.3g} times as long as the motion of the points",
            scaled(scale),
            fix=f"positions multiplied by {scale:.3g}, unless the points have another unit (feet)",
        )
    return found


def _rotation_between(steps: np.ndarray, motions: np.ndarray, scale: float) -> np.ndarray:
    """Return the rotation from the axes of the points to those of the poses, (3, 3) float64.

    It maps directions and turns of the points' motions, (K, 4, 4) each, to those of the poses, whose steps are scaled.
    In turns, a frame elsewhere has other steps: we estimate where it is, and correct them. What the motions do not
    show, such as the roll on a straight road, stays as it is.
    """
    given, fitted = scale * steps[:, :3, 3], motions[:, :3, 3]
    skew = [T[:, :3, :3] - T[:, :3, :3].transpose(0, 2, 1) for T in (steps, motions)]
    turns = [_ARM / 2 * np.stack([each[:, 2, 1], each[:, 0, 2], each[:, 1, 0]], axis=1) for each in skew]
    levers = np.eye(3) - steps[:, :3, :3]  # [K, 3, 3], times the place of the points is what they change of a step
    place = np.zeros(3)
    for _ in range(_ITERATIONS):
        target = np.concatenate([given - levers @ place, turns[0], _WEAK * np.eye(3)])
        source = np.concatenate([fitted, turns[1], _WEAK * np.eye(3)])
        left, _, right = np.linalg.svd(target.T @ source)
        rotation: np.ndarray = left @ np.diag([1, 1, np.linalg.det(left @ right)]) @ right
        rest = given - fitted @ rotation.T
        shown = np.concatenate([levers.reshape(-1, 3), _UNSHOWN * np.eye(3)])
        place = np.linalg.lstsq(shown, np.concatenate([rest.ravel(), np.zeros(3)]), rcond=None)[0]
    return rotation


def _mounting(rotation: np.ndarray, place: np.ndarray) -> Reading:
    """Return the reading of points whose frame is turned, and lies at a place, (3,), in that of the poses."""
    causes = []
    fixes = []
    where = "data.ego_T_lidar with"
    yaw = float(np.arctan2(rotation[1, 0], rotation[0, 0]))
    tilt = turn_of(rotations_about(2, -yaw) @ rotation)
    if turn_of(rotation) > 0 and tilt < min(abs(yaw), _LEVEL):
        degrees = np.degrees(yaw)
        side = "left" if degrees > 0 else "right"
        causes.append(f"the points' x axis points about {abs(degrees):.0f} degrees to the {side} of the poses'")
        fixes.append(f"a rotation of about {degrees:.0f} degrees about z")
    elif turn_of(rotation) > 0:
        names = [_direction(row) for row in rotation]
        if names == [same for same, _ in _DIRECTIONS]:
            causes.append(f"the points are turned by about {np.degrees(turn_of(rotation)):.0f} degrees")
        else:
            causes.append(f"the poses are of another sensor, whose x, y and z axes point {', '.join(names)}")
        fixes.append(f"a rotation of about {(np.round(rotation, 3) + 0.0).tolist()}")
        where = "data.ego_T_lidar, the transform from the LiDAR to it (in data=arrays with data.poses_of=sensor), with"
    if place.any():
        named = [f"{axis} = {value:.1f} m" for axis, value in zip("xyz", place) if axis != "z" or abs(value) > 0.05]
        causes.append(f"the points' origin is at about {' and '.join(named)} in the frame of the poses")
        fixes.append(f"a position of about {' and '.join(named)}")
    fix = f"{where} {' and '.join(fixes)} (data=arrays, hdf5 or bags)"
    return Reading(", and ".join(causes), partial(_seen_from, as_matrix(rotation, place)), fix=fix)


def _direction(axis: np.ndarray) -> str:
    """Return the name of the direction that is nearest to an axis, (3,)."""
    largest = int(np.abs(axis).argmax())
    return _DIRECTIONS[largest][int(axis[largest] < 0)]


def _seen_from(ego_T_points: np.ndarray, steps: np.ndarray) -> np.ndarray:
    """Convert motions of the vehicle, (..., 4, 4), to those of the points' frame."""
    return np.linalg.inv(ego_T_points) @ steps @ ego_T_points  # type: ignore[no-any-return]


def _place_of(pairs: Sequence[Pair], scan: str, rotation: np.ndarray) -> np.ndarray:
    """Return the place in the frame of the poses, (3,), at which the points' origin fits best, if they are turned.

    It is at the height of the poses, as the points see it. 0 if that fits as well, unless the frame is not turned.
    """
    origin = np.zeros((1, 2))
    places = np.concatenate([origin, _PLACES])
    for count in (_FEW_POINTS, _MOST_POINTS, _MOST_POINTS):
        ego_T_points = as_matrix(np.tile(rotation, (len(places), 1, 1)), places @ rotation[:, :2].T)
        shares = np.zeros(len(places))
        for pair in pairs:
            steps = _seen_from(ego_T_points, pair.transforms[GIVEN])
            shares += pair.target.structure(scan).shares(pair.source.points(scan)[:count], steps)
        best = places[1:][np.argsort(-shares[1:], kind="stable")]
        places = np.concatenate([origin, best[:_NUM_BEST] if len(best) > _NUM_BEST else best[0] + _BETWEEN])
    is_at_origin = turn_of(rotation) > 0 and shares[0] >= EQUAL * shares[1:].max()
    return np.zeros(3) if is_at_origin else rotation[:, :2] @ best[0]


def _motion_of(pair: Pair, scan: str) -> np.ndarray:
    """Return the motion of a pair under which its points fit, (4, 4) float64.

    It has about the rotation of the poses. If nothing fits then, it is one in the plane, by the angle of the poses.
    """
    step = pair.transforms[GIVEN].copy()
    step[:2, 3] = 0
    angle = float(turn_of(step))
    most = -1.0
    for rotation in (step, *(as_matrix(rotations_about(2, sign * angle)) for sign in (1, -1))):
        source = transform_points(pair.source.points(scan)[:_MOST_POINTS], rotation)
        motion = find_motion(source, pair.target.points(scan), _SMALL_TURNS)
        nearby = np.tile(motion, (len(_WITHIN_CELL), 1, 1))
        nearby[:, :2, 3] += _WITHIN_CELL
        shares = pair.target.structure(scan).shares(source, nearby)
        if shares.max() > most:
            most, found = float(shares.max()), nearby[int(shares.argmax())] @ rotation
        if most >= LEAST_SHARE:
            break
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
    shares, clear = _compare(of_pairs, expected)
    if expected == TIMES and OFF in others:
        return max(shares, key=shares.__getitem__), shares  # ties: the times
    best, *opposite = sorted(others, key=shares.__getitem__, reverse=True)
    if best in SCANS and shares[best] >= _TURN * max(shares[scan] for scan in opposite):
        starts = [scan for scan in SCANS if SCANS[scan][::2] == SCANS[best][::2]]
        # A start that is clearly better is so in each pair, so the first pair rules out most.
        of_first = pairs[0].shares_of_scans(starts)
        starts = [start for start in starts if start == best or of_first[start] > of_first[best]]
        of_pairs = [{**pair.shares_of_scans(starts), **each} for pair, each in zip(pairs, of_pairs)]
        of_starts, clear = _compare(of_pairs, expected)
        _, better = _compare([{start: each[start] for start in starts} for each in of_pairs], best)
        clear = clear[:1] if best not in clear else [*better, best]
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
            motion = find_motion(pair.source.points(OFF)[:_MOST_POINTS], pair.target.points(OFF))
            if difference(motion, given[GIVEN]) >= _LEAST_MOTION:
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


def _compare(of_pairs: Sequence[Mapping[str, float]], given: str = GIVEN) -> tuple[dict[str, float], list[str]]:
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
        if share >= LEAST_SHARE and all(each[name] > each[given] for each in of_pairs if name in each):
            better.append(name)
    others = {INACCURATE: Reading("", margin=_OF_ERRORS)}
    known = {name: {**others, **_COMPARED}.get(name, Reading("")) for name in better}
    clear = [name for name in better if gains[name] >= known[name].margin]
    clear = [name for name in clear if gains.get(known[name].opposite, 0) <= max(_OPPOSITE, gains[name] / 2)]
    return shares, sorted(clear, key=gains.__getitem__, reverse=True)


def find_motion(source: np.ndarray, target: np.ndarray, turns: Sequence[float] = _TURNS) -> np.ndarray:
    """Find the rotation and shift in the plane that brings most points of the source into cells of the target.

    Both are (N, 3) float64, metres. Return (4, 4) float64. Each rotation costs one correlation by FFT, 10 ms.
    """
    image = torch.fft.rfft2(_image(target, 1))
    reach = int(_FARTHEST_SHIFT / _CELL)
    steps = np.r_[0 : reach + 1, -reach:0]
    most = -1
    found = np.eye(4)
    for turn in turns:
        T = as_matrix(rotations_about(2, turn))
        turned = torch.fft.rfft2(_image(source @ T[:3, :3].T, 0))
        counts = torch.fft.irfft2(image * turned.conj(), (_CELLS, _CELLS)).round().numpy()[np.ix_(steps, steps)]
        row, column = np.unravel_index(int(counts.argmax()), counts.shape)
        if counts[row, column] > most:  # ties: the first
            most = int(counts[row, column])
            T[:2, 3] = _CELL * steps[row], _CELL * steps[column]
            found = T
    return found


def _image(points: np.ndarray, margin: int) -> Tensor:
    """Return the occupied cells, (C, C) float32, 1 = occupied, with a margin of so many cells around each point."""
    cell = np.floor(points[:, :2] / _CELL).astype(np.int64) + _CELLS // 2
    cell = cell[((cell > margin) & (cell < _CELLS - 1 - margin)).all(1)]
    image = np.zeros((_CELLS, _CELLS), np.float32)
    for row in range(-margin, margin + 1):
        for col in range(-margin, margin + 1):
            image[cell[:, 0] + row, cell[:, 1] + col] = 1
    return torch.from_numpy(image)


def is_around(points: Array, pose: np.ndarray) -> bool:
    """Test whether points lie around the position of a pose rather than around their origin.

    A LiDAR sees most points near itself, so the mean logarithm of the distance to it is small. The pose must be at
    least 3 m from the origin.
    """
    position = pose[:2, 3]
    if np.linalg.norm(position) < LEAST_DISTANCE:
        return False
    xy = as_numpy(points)[:: len(points) // _MOST_AROUND + 1, :2].astype(np.float64)
    xy = xy[np.isfinite(xy).all(1)]
    if len(xy) == 0:
        return False
    near_pose, near_origin = (np.log(np.hypot(*(xy - each).T) + 1.0).mean() for each in (position, np.zeros(2)))
    return bool(near_pose < near_origin)


def difference(T: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Return about how far apart rigid transforms, (..., 4, 4), move points 20 m away, (...) float64, metres."""
    apart = T - other
    rotation = np.linalg.norm(apart[..., :3, :3], axis=(-2, -1)) / np.sqrt(2)
    return np.linalg.norm(apart[..., :3, 3], axis=-1) + _ARM * rotation  # type: ignore[no-any-return]


def _num_blocks(points: np.ndarray) -> int:
    """Return how many blocks of 5 m in the plane hold points."""
    block = np.floor(points / _BLOCK).astype(np.int64)
    block[:, 2] = 0
    return len(np.unique(cell_keys(block)))


def _about(centre: np.ndarray, T: np.ndarray) -> np.ndarray:
    """Return a transform for points relative to `centre`."""
    return as_matrix(T[:3, :3], T[:3, :3] @ centre + T[:3, 3] - centre)
