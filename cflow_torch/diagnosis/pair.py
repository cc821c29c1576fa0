"""Pairs of sweeps: the static structure of both, and how it moves under each reading of the poses."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Callable, Sequence

import numpy as np

from cflow_torch.diagnosis.conventions import MOUNTS, OFF, READINGS, REVERSED, SCAN_READINGS, STILL, TIMES, UNITS, WORLD
from cflow_torch.diagnosis.stillness import FEWEST_POINTS, Structure, cell_keys, structure_rows
from cflow_torch.transforms import as_matrix, rigid_transform, transform_points
from cflow_torch.types import Array, Sweep, as_numpy

GIVEN = "as given"
COMPARED = {**READINGS, **MOUNTS, **SCAN_READINGS}
_DERIVED = (REVERSED, *UNITS)  # these follow from all poses of a log, and from the lengths of motions
_OF_POSES = {name: reading.of_poses for name, reading in COMPARED.items() if reading.of_poses and name not in _DERIVED}

FEW_POINTS, MOST_POINTS = 300, 1500  # of the source; readings not much worse than as given are compared by the most
_MOST_AROUND = 5000  # points that tell what they lie around
_TIMED_POINTS = 6000  # to compare points with times, moved and as they are: the better of both is used
_NEAR_GIVEN = 0.7  # share of a reading over that as given
_BLOCK, _FEWEST_BLOCKS = 5.0, 12  # metres; structure in fewer blocks may be a few moving objects
_CLEAR_COUNT, _CLEAR_SHARE = 1, 0.1  # more points of a block in place than this are clearly more
LEAST_MOTION, ARM = 0.2, 20.0  # metres; poses that move points 20 m away by less do not show anything
LEAST_DISTANCE = 3.0  # metres between pose and origin, to tell whose surroundings points are
_LEAST_DIFFERENCE = 0.05  # metres; a pair shows only the readings that move these points otherwise by this
_SPARSE = 3000  # points of a sweep; with fewer, no more of the structure is in place under right poses


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

    def share(self, scan: str, count: int = MOST_POINTS, shift: float = 0.0) -> float:
        """Return the share of the first `count` points in place as given, moved by `shift` metres along the path."""
        T = self.transforms[GIVEN].copy()
        T[:3, 3] *= 1 + shift / max(float(np.linalg.norm(T[:3, 3])), 1e-9)
        return self.target.structure(scan).share(self.source.points(scan)[:count], T)

    def shares_of_scans(self, scans: Sequence[str]) -> dict[str, float]:
        count = _TIMED_POINTS if TIMES in scans else MOST_POINTS
        return {scan: self.share(scan, count) for scan in scans}

    def shares_of_poses(self, scan: str) -> dict[str, float]:
        """Return the share of each reading of the poses, by few points if it is much worse than as given."""
        shares = self._shares(list(self.transforms), scan, FEW_POINTS)
        rivals = [name for name, share in shares.items() if share >= _NEAR_GIVEN * shares[GIVEN]]
        return {**shares, **self._shares(rivals, scan, MOST_POINTS)}

    def blocks(self, reading: str, scan: str) -> np.ndarray:
        """Count the blocks of 5 m in which clearly more is in place as given, and under a reading: (2,) int64."""
        source = self.source.points(scan)[:MOST_POINTS]
        structure = self.target.structure(scan)
        given, read = (
            structure.in_place(transform_points(source, self.transforms[name])).astype(np.int64)
            for name in (GIVEN, reading)
        )
        _, block, count = np.unique(_blocks(source), return_inverse=True, return_counts=True)
        gain = np.bincount(block.ravel(), read - given)
        least = np.maximum(_CLEAR_COUNT, _CLEAR_SHARE * count)
        return np.array([(-gain > least).sum(), (gain > least).sum()])

    def among(self, readings: Sequence[str]) -> Pair:
        """Return the pair with these readings of the poses, and that as given."""
        kept = {name: T for name, T in self.transforms.items() if name in (GIVEN, *readings)}
        return replace(self, transforms=kept)

    def _shares(self, readings: Sequence[str], scan: str, count: int) -> dict[str, float]:
        transforms = np.stack([self.transforms[name] for name in readings])
        shares = self.target.structure(scan).shares(self.source.points(scan)[:count], transforms)
        return dict(zip(readings, shares.tolist()))


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
    num_blocks = len(np.unique(_blocks(_as_it_is(pc0, rows_of[0], OFF))))
    if min(map(len, rows_of)) < FEWEST_POINTS or num_blocks < _FEWEST_BLOCKS:
        return None
    rows_of[0] = rows_of[0][: _TIMED_POINTS if TIMES in scans else MOST_POINTS]
    clouds = [_cloud(*each, centre) for each in zip((pc0, pc1), rows_of, deskew)]
    transforms = _transforms(poses if around is None else around, rows) if has_poses else {GIVEN: np.eye(4)}
    if in_world:
        # For points relative to the centre.
        about = {name: (T[:3, :3], T[:3, :3] @ centre + T[:3, 3] - centre) for name, T in transforms.items()}
        transforms = {name: as_matrix(*parts) for name, parts in about.items()}
        transforms[WORLD] = transforms.pop(STILL)
    has_motion = has_poses and (in_world or bool(difference(transforms[GIVEN], np.eye(4)) >= LEAST_MOTION))
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
    return np.linalg.norm(apart[..., :3, 3], axis=-1) + ARM * rotation  # type: ignore[no-any-return]


def _blocks(points: np.ndarray) -> np.ndarray:
    """Return the key of the block of 5 m in the plane that holds each point, (N,) int64."""
    return cell_keys(np.floor(points * (1, 1, 0) / _BLOCK).astype(np.int64))
