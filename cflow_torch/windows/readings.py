"""Under which reading of poses and points does the static world stand still? One comparison for all such mistakes.

Idea: (1) Take the static structure of two sweeps. (2) Each reading ("the poses are inverted") gives a transform between
them. (3) Measure the share of the structure that is in place under each transform. (4) The reading that is clearly best
is named. If the reading as given is as good, nothing is named.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Iterable, Sequence

import numpy as np

from cflow_torch.types import Array, Sweep, as_numpy
from cflow_torch.windows.ego_motion import rigid_transform
from cflow_torch.windows.stillness import Structure, static_rows, thinned_rows

GIVEN = "as given"
STILL, WORLD, INVERTED, LATE, EARLY, CAMERA = "still", "world", "inverted", "late", "early", "camera"
MOUNT, UNKNOWN, NO_READING = "mount", "unknown", "none"
# Points of the source. All readings are compared by the first few, those that are about as good as given by more.
_FEW_POINTS, _MOST_POINTS = 300, 1500
_NEAR_GIVEN = 0.95  # share of a reading over that as given
CERTAIN = 0.6  # share as given; other readings are not compared
_FEWEST_POINTS = 150  # of source and target; fewer do not show anything
_BLOCK, _FEWEST_BLOCKS = 5.0, 12  # metres; structure in fewer blocks may be a few moving objects
# A sweep shows only readings that move points 20 m away by at least this.
_LEAST_MOTION, _ARM = 0.2, 20.0  # metres
# The best share must exceed the share as given by this factor, and be at least `_LEAST_SHARE`. Right poses gave at most
# 1.09 for a neighbour's pose (KITTI), 1.25 for no motion (highway, vehicles of the same speed), else 1.03.
_BETTER = {STILL: 1.6, WORLD: 1.15, MOUNT: 1.12, UNKNOWN: 1.4, "millimetres": 3.0, "centimetres": 3.0}
_BETTER_ELSE = 1.3
_LEAST_SHARE = 0.15
_EQUAL = 0.95  # readings whose share is at least this part of the best one are named together
# Nothing fits if the best share is below this. Right poses gave at least .17 over 10 m, .26 over one sweep.
_HOPELESS = 0.08
_COLUMN, _TALL = 0.8, 0.35  # metres, side and least height of the columns of structure; ground is flatter
_LEAST_GROUND = 0.02  # share of points
_LEAST_TURN = np.radians(2.0)  # between two sweeps, to see where the LiDAR is mounted
_MOUNTS = (-4.0, -2.7, -1.4, -0.7, 0.7, 1.4, 2.7, 4.0)  # metres along x
_LEAST_SCALED = 20.0  # between two sweeps; a vehicle does not move so far, so the unit may be another one
_UNITS = {"millimetres": 1e-3, "centimetres": 1e-2}  # metres
# ego_T_stored of frames with other axes: x, y and z of the stored frame, as columns.
AXES = {
    CAMERA: np.array([[0, 0, 1], [-1, 0, 0], [0, -1, 0]], float),  # x right, y down, z forward
    "left": np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1]], float),  # x to the left of the vehicle
    "back": np.diag([-1.0, -1.0, 1.0]),
    "right": np.array([[0, 1, 0], [-1, 0, 0], [0, 0, 1]], float),
    "upside_down": np.diag([1.0, -1.0, -1.0]),
}
# The search for an unknown motion correlates occupied cells of a square.
_CELL, _CELLS = 0.1, 640  # metres, and cells along a side
_TURNS = np.radians([-4, -2.5, -1.2, -0.5, 0, 0.5, 1.2, 2.5, 4])
_FARTHEST_SHIFT = 5.0  # metres
# What each reading says. The settings are values of `read_as` in `cflow_torch.data.catalog.open_log`.
CAUSES = {
    WORLD: "the points are in the world's frame",
    INVERTED: "the poses are inverted (T_ego_world instead of T_world_ego), or the sweeps are interchanged",
    STILL: "the static world stands still without the poses, so they are of another log, or the points are compensated",
    LATE: "the poses are one sweep late (sweep i has the pose of sweep i - 1)",
    EARLY: "the poses are one sweep early (sweep i has the pose of sweep i + 1)",
    CAMERA: "the poses are of a camera (x right, y down, z forward)",
    "left": "the poses are of a frame whose x axis points to the left of the points' x axis",
    "back": "the poses are of a frame whose x axis points backward",
    "right": "the poses are of a frame whose x axis points to the right of the points' x axis",
    "millimetres": "the poses are in millimetres",
    "centimetres": "the poses are in centimetres",
}


@dataclass(frozen=True)
class Pair:
    """The static structure of two sweeps, and the transforms between them under each reading.

    Points are relative to `centre`, the position of the vehicle in the frame of the points: 0, or that of the pose if
    the points are in the world's frame.
    """

    source: np.ndarray  # (N, 3) float64, metres
    target: np.ndarray  # (M, 3) float64, metres
    transforms: dict[str, np.ndarray]  # reading -> (4, 4) float64, source to target
    has_poses: bool


@dataclass(frozen=True)
class Judgement:
    """The shares of structure in place, means of all pairs, and the readings that are clearly best."""

    shares: dict[str, float]  # reading -> 0 ... 1; empty = nothing could be compared
    best: tuple[str, ...] = ()  # readings that fit clearly better than as given; equal ones together
    offset: float = 0.0  # metres, of `MOUNT`: x of the LiDAR in the frame of the poses
    motion: np.ndarray | None = None  # of `UNKNOWN`: T_target_source of the first pair
    has_motion: bool = True  # False: the poses of no pair differ, so only an unknown motion can be found

    @property
    def given(self) -> float:
        """Share of structure in place as given, NaN = nothing could be compared."""
        return self.shares.get(GIVEN, float("nan"))

    def __str__(self) -> str:
        """What is wrong, "" = nothing."""
        if not self.best:
            return ""
        name = self.best[0]
        share = f"({self.given:.2f} of the static structure is in place as given, {self.shares.get(name, 0):.2f} then)"
        if name == NO_READING:
            return f"the sweeps fit under no reading of the poses (only {self.given:.2f} of the structure is in place)"
        if name == UNKNOWN:
            x, y, _ = (0.0, 0.0, 0.0) if self.motion is None else self.motion[:3, 3]
            return f"the sensor moves by about {np.hypot(x, y):.1f} m between two sweeps {share}"
        if name == MOUNT:
            where = "behind" if self.offset < 0 else "ahead of"
            return f"the points' origin is about {abs(self.offset):g} m {where} that of the poses {share}"
        return f"{', or '.join(CAUSES[each] for each in self.best)} {share}"


def make_pair(
    pc0: Sweep,
    pc1: Sweep,
    before: np.ndarray | None = None,
    after: np.ndarray | None = None,
    in_world: bool | None = None,
) -> Pair | None:
    """Prepare two sweeps for `judge`. None if they have too little structure.

    Args:
        pc0, pc1: the sweeps, in the order of time.
        before, after: poses of the sweeps before, and after, `pc0` and `pc1`, (2, 4, 4) float64; None = unknown.
        in_world: the points lie around the positions of the poses, see `is_around`; None = test it.
    """
    has_poses = pc0.pose is not None and pc1.pose is not None
    pose0, pose1 = (rigid_transform(each.pose, "pose") if has_poses else np.eye(4) for each in (pc0, pc1))
    if in_world is None:
        in_world = has_poses and is_around(pc1.points, pose1)
    centre = pose1[:3, 3] if in_world else np.zeros(3)
    source, target = (_structure(each, centre) for each in (pc0, pc1))
    if min(len(source), len(target)) < _FEWEST_POINTS or _num_blocks(source) < _FEWEST_BLOCKS:
        return None
    source = source[thinned_rows(source)]
    source = source[np.random.default_rng(0).permutation(len(source))[:_MOST_POINTS]]
    transforms = _transforms(pose0, pose1, before, after) if has_poses else {GIVEN: np.eye(4)}
    if in_world:
        transforms = {name: _about(centre, T) for name, T in transforms.items()}
        transforms[WORLD] = transforms.pop(STILL)
    return Pair(source, target, transforms, has_poses)


def _transforms(
    pose0: np.ndarray, pose1: np.ndarray, before: np.ndarray | None, after: np.ndarray | None
) -> dict[str, np.ndarray]:
    """Return T_1_0 under each reading of the poses."""
    T = np.linalg.inv(pose1) @ pose0
    found = {GIVEN: T, STILL: np.eye(4), INVERTED: pose1 @ np.linalg.inv(pose0)}
    for name, poses in ((LATE, after), (EARLY, before)):
        shifted = T if poses is None else np.linalg.inv(poses[1]) @ poses[0]
        if difference(T, shifted) >= _LEAST_MOTION:
            found[name] = shifted
    for name in (CAMERA, "left", "back", "right"):
        axes = as_matrix(AXES[name])
        found[name] = axes @ T @ axes.T
    if np.linalg.norm(T[:3, 3]) >= _LEAST_SCALED:
        found.update({name: as_matrix(T[:3, :3], unit * T[:3, 3]) for name, unit in _UNITS.items()})
    if turn_of(T) >= _LEAST_TURN:
        for x in _MOUNTS:
            mount = as_matrix(np.eye(3), (x, 0, 0))
            found[f"{MOUNT} {x}"] = np.linalg.inv(mount) @ T @ mount
    return found


def judge(pairs: Iterable[Pair | None]) -> Judgement:
    """Compare all readings over all pairs, and name those that are clearly better than as given.

    Pairs are ignored if no reading moves the structure. Cost: 0.1 s per pair.
    """
    usable = [pair for pair in pairs if pair is not None]
    moving = [pair for pair in usable if _moves(pair)]
    if moving:
        return _judge(moving)
    found = [_search(pair) for pair in usable]
    return max(found, key=lambda each: len(each.best), default=Judgement({}))


def _judge(pairs: Sequence[Pair]) -> Judgement:
    """Compare the readings of pairs whose poses differ."""
    of_pairs = [_shares(pair) for pair in pairs]
    names = list(dict.fromkeys(name for shares in of_pairs for name in shares))
    mean: dict[str, float] = {}
    clear = []  # readings that fit clearly better in the pairs that show them: only a turn shows another mounting
    for name in names:
        shown = [shares for shares in of_pairs if name in shares]
        mean[name] = float(np.mean([shares[name] for shares in shown]))
        given = float(np.mean([shares[GIVEN] for shares in shown]))
        is_always_better = all(shares[name] > shares[GIVEN] for shares in shown)
        if is_always_better and mean[name] > max(_margin(name) * given, _LEAST_SHARE):
            clear.append(name)
    if any(len(shares) == 1 for shares in of_pairs):  # as given is certain there, so what all pairs show is refuted
        clear = [name for name in clear if name in (LATE, EARLY) or name.startswith(MOUNT)]
    if not clear:
        # Two clouds that stand still under no motion at all may have no static structure, so they do not show anything.
        is_hopeless = mean[GIVEN] < _HOPELESS and (len(pairs) > 1 or bool(_search(pairs[0]).best))
        return Judgement(mean, (NO_READING,) if is_hopeless else ())
    if WORLD in clear:  # two signs agree: the points lie around the poses, and stand still without them
        return Judgement(mean, (WORLD,))
    best = max(clear, key=mean.__getitem__)
    if best.startswith(MOUNT):
        return Judgement({**mean, MOUNT: mean[best]}, (MOUNT,), float(best.split()[-1]))
    equal = [name for name in clear if mean[name] >= _EQUAL * mean[best] and not name.startswith(MOUNT)]
    return Judgement(mean, tuple(equal))


def _shares(pair: Pair) -> dict[str, float]:
    """Return the share of structure in place under each reading, from few points if it is worse than given."""
    target = Structure(pair.target)
    few = pair.source[:_FEW_POINTS]
    given = target.share(few, pair.transforms[GIVEN])
    if given >= CERTAIN:
        return {GIVEN: given}
    shares = {name: target.share(few, T) for name, T in pair.transforms.items()}
    rivals = [name for name, share in shares.items() if share >= _NEAR_GIVEN * shares[GIVEN]]
    if len(rivals) > 1:
        shares.update({name: target.share(pair.source, pair.transforms[name]) for name in rivals})
    return shares


def _search(pair: Pair) -> Judgement:
    """Look for a motion in the plane under which the sweeps fit clearly better than in place."""
    target = Structure(pair.target)
    given = target.share(pair.source, pair.transforms[GIVEN])
    if given * _margin(UNKNOWN) >= 1:
        return Judgement({GIVEN: given}, has_motion=False)
    motion = find_motion(pair.source, pair.target)
    shares = {GIVEN: given, UNKNOWN: target.share(pair.source, motion)}
    is_better = shares[UNKNOWN] > max(_margin(UNKNOWN) * given, _LEAST_SHARE)
    return Judgement(shares, (UNKNOWN,) if is_better else (), motion=motion, has_motion=False)


def find_motion(source: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Find the rotation and shift in the plane that brings most points of the source into cells of the target.

    Both are (N, 3) float64, metres. Return (4, 4) float64. Each rotation costs one correlation by FFT, 10 ms.
    """
    image = np.fft.rfft2(_image(target, 1))
    reach = int(_FARTHEST_SHIFT / _CELL)
    steps = np.r_[0 : reach + 1, -reach:0]
    most = -1.0
    found = np.eye(4)
    for turn in _TURNS:
        T = as_matrix(rotation_about_z(turn))
        turned = np.fft.rfft2(_image(source @ T[:3, :3].T, 0))
        counts = np.fft.irfft2(image * np.conj(turned), (_CELLS, _CELLS))[np.ix_(steps, steps)]
        row, column = np.unravel_index(int(counts.argmax()), counts.shape)
        if counts[row, column] > most + 0.5:  # counts are whole but for rounding; ties: the first
            most = float(counts[row, column])
            T[:2, 3] = _CELL * steps[row], _CELL * steps[column]
            found = T
    return found


def _image(points: np.ndarray, margin: int) -> np.ndarray:
    """Return the occupied cells, (C, C) float64, 1 = occupied, with a margin of so many cells around each point."""
    cell = np.floor(points[:, :2] / _CELL).astype(np.int64) + _CELLS // 2
    cell = cell[((cell > margin) & (cell < _CELLS - 1 - margin)).all(1)]
    image = np.zeros((_CELLS, _CELLS))
    for row in range(-margin, margin + 1):
        for col in range(-margin, margin + 1):
            image[cell[:, 0] + row, cell[:, 1] + col] = 1
    return image


def is_around(points: Array, pose: np.ndarray) -> bool:
    """Test whether points lie around the position of a pose rather than around their origin.

    A LiDAR sees most points near itself, so the mean logarithm of the distance to it is small. The pose must be at
    least 3 m from the origin.
    """
    position = pose[:2, 3]
    if np.linalg.norm(position) < 3:
        return False
    xy = as_numpy(points)[:, :2].astype(np.float64)
    xy = xy[np.isfinite(xy).all(1)]
    if len(xy) == 0:
        return False
    near_pose, near_origin = (np.log(np.hypot(*(xy - each).T) + 1.0).mean() for each in (position, np.zeros(2)))
    return bool(near_pose < near_origin)


def as_matrix(rotation: np.ndarray, shift: Sequence[float] | np.ndarray = (0, 0, 0)) -> np.ndarray:
    """Return the (4, 4) float64 rigid transform of a (3, 3) rotation and a shift, metres."""
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = rotation, shift
    return matrix


def rotation_about_z(angle: float) -> np.ndarray:
    """Return the (3, 3) rotation by an angle, radians, about z."""
    cos, sin = np.cos(angle), np.sin(angle)
    return np.array([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1]])


def turn_of(T: np.ndarray) -> float:
    """Return the angle of the rotation of a rigid transform, radians."""
    return float(np.arccos(np.clip((np.trace(T[:3, :3]) - 1) / 2, -1, 1)))


def difference(T: np.ndarray, other: np.ndarray) -> float:
    """Return about how far apart two rigid transforms move points 20 m away, metres."""
    rotation = np.linalg.norm(T[:3, :3] - other[:3, :3]) / np.sqrt(2)
    return float(np.linalg.norm(T[:3, 3] - other[:3, 3]) + _ARM * rotation)


def _structure(sweep: Sweep, centre: np.ndarray) -> np.ndarray:
    """Return the points of static structure, (N, 3) float64, metres, relative to `centre`.

    Only points in columns with different heights count, because flat ground without a mask looks the same everywhere.
    """
    points = as_numpy(sweep.points)[:, :3].astype(np.float64) - centre
    if len(points) == 0:
        return points
    mask = sweep.is_ground  # without ground, one is not believed: clouds may contain what it does not say
    is_found = mask is None or as_numpy(mask).mean() < _LEAST_GROUND
    points = points[static_rows(replace(sweep, points=points, is_ground=None if is_found else mask))]
    if len(points) == 0:
        return points
    column, row = np.floor(points[:, :2] / _COLUMN).astype(np.int64).T
    cell = column * (1 << 20) + row
    order = np.lexsort((points[:, 2], cell))
    start = np.flatnonzero(np.diff(cell[order], prepend=cell[order[0]] - 1))  # of each column
    count = np.diff(start, append=len(order))
    height = points[order, 2]
    is_tall = height[start + count - 1] - height[start] >= _TALL
    return points[np.sort(order[np.repeat(is_tall, count)])]


def _num_blocks(points: np.ndarray) -> int:
    """Return how many blocks of 5 m in the plane hold points."""
    column, row = np.floor(points[:, :2] / _BLOCK).astype(np.int64).T
    return len(np.unique(column * (1 << 20) + row))


def _about(centre: np.ndarray, T: np.ndarray) -> np.ndarray:
    """Return a transform for points relative to `centre`."""
    return as_matrix(T[:3, :3], T[:3, :3] @ centre + T[:3, 3] - centre)


def _moves(pair: Pair) -> bool:
    """Test whether the poses move the structure enough to tell readings apart."""
    if not pair.has_poses:
        return False
    T = pair.transforms[GIVEN]
    return WORLD in pair.transforms or difference(T, np.eye(4)) >= _LEAST_MOTION


def _margin(reading: str) -> float:
    return _BETTER.get(reading.split()[0], _BETTER_ELSE)
