"""Poses of another frame: the motion under which points fit, and how the frame of the poses is turned and placed."""

from __future__ import annotations

from functools import partial
from typing import Sequence

import numpy as np
import torch
from torch import Tensor

from cflow_torch.diagnosis.conventions import EQUAL, Reading
from cflow_torch.diagnosis.pair import ARM, FEW_POINTS, GIVEN, MOST_POINTS, Pair
from cflow_torch.diagnosis.stillness import LEAST_SHARE
from cflow_torch.transforms import as_matrix, rotations_about, transform_points, turn_of

_LEVEL = np.radians(5)  # tilt up to which only the angle about z is told
_ITERATIONS = 3
_WEAK, _UNSHOWN = 0.1, 0.15  # metres of no rotation, and of no place a metre away: what the motions do not show
_DIRECTIONS = (("ahead", "back"), ("left", "right"), ("up", "down"))
_PLACES = 0.4 * np.array([(x, y) for x in range(-10, 11) for y in range(-10, 11) if x or y])  # metres, of the LiDAR
_NUM_BEST = 30  # places that are compared by the most points
_YAWS = np.radians([0, -2, 2, -4, 4])  # from the rotation of the motions, which in turns depends on the place
_BETWEEN = 0.2 * np.array([(x, y) for x in range(-1, 2) for y in range(-1, 2)])
# The search for an unknown motion correlates occupied cells of a square.
_CELL, _CELLS = 0.1, 640  # metres, and cells along a side
_TURNS = np.radians([-4, -2.5, -1.2, -0.5, 0, 0.5, 1.2, 2.5, 4]).tolist()
_WITHIN_CELL = np.array([(x, y) for x in (0, -0.5, 0.5) for y in (0, -0.5, 0.5)]) * _CELL
_SMALL_TURNS = np.radians([0, -0.5, 0.5, -1, 1]).tolist()
_FARTHEST_SHIFT = 7.0  # metres


def rotation_between(steps: np.ndarray, motions: np.ndarray, scale: float) -> np.ndarray:
    """Return the rotation from the axes of the points to those of the poses, (3, 3) float64.

    It maps directions and turns of the points' motions, (K, 4, 4) each, to those of the poses, whose steps are scaled.
    In turns, a frame elsewhere has other steps: we estimate where it is, and correct them. What the motions do not
    show, such as the roll on a straight road, stays as it is.
    """
    given, fitted = scale * steps[:, :3, 3], motions[:, :3, 3]
    skew = [T[:, :3, :3] - T[:, :3, :3].transpose(0, 2, 1) for T in (steps, motions)]
    turns = [ARM / 2 * np.stack([each[:, 2, 1], each[:, 0, 2], each[:, 1, 0]], axis=1) for each in skew]
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


def mounting(rotation: np.ndarray, place: np.ndarray) -> Reading:
    """Return the reading of points whose frame is turned, and lies at a place, (3,), in that of the poses."""
    causes = []
    fixes = []
    where = "data.ego_T_lidar with"
    yaw = float(np.arctan2(rotation[1, 0], rotation[0, 0]))
    tilt = turn_of(rotations_about(2, -yaw) @ rotation)
    told = rotation
    if turn_of(rotation) > 0 and tilt < min(abs(yaw), _LEVEL):
        told = rotations_about(2, yaw)
        degrees = np.degrees(yaw)
        side = "left" if degrees > 0 else "right"
        decimals = int(abs(degrees) < 5)
        causes.append(
            f"the points' x axis points about {abs(degrees):.{decimals}f} degrees to the {side} of the poses'"
        )
        fixes.append(f"a rotation of about {degrees:.{decimals}f} degrees about z")
    elif turn_of(rotation) > 0:
        names = [_direction(row) for row in rotation]
        if names == [same for same, _ in _DIRECTIONS]:
            causes.append(f"the points are turned by about {np.degrees(turn_of(rotation)):.0f} degrees")
        else:
            causes.append(f"the poses are of another sensor, whose x, y and z axes point {', '.join(names)}")
            where = (
                "data.ego_T_lidar, the transform from the LiDAR to it (in data=arrays with data.poses_of=sensor), with"
            )
        fixes.append(f"a rotation of about {(np.round(rotation, 3) + 0.0).tolist()}")
    if place.any():
        named = [f"{axis} = {value:.1f} m" for axis, value in zip("xyz", place) if axis != "z" or abs(value) > 0.05]
        causes.append(f"the points' origin is at about {' and '.join(named)} in the frame of the poses")
        fixes.append(f"a position of about {' and '.join(named)}")
    seen_from = partial(_seen_from, as_matrix(rotation, place))
    return Reading(", and ".join(causes), seen_from, fix=f"{where} {' and '.join(fixes)}", mount=as_matrix(told, place))


def _direction(axis: np.ndarray) -> str:
    """Return the name of the direction that is nearest to an axis, (3,)."""
    largest = int(np.abs(axis).argmax())
    return _DIRECTIONS[largest][int(axis[largest] < 0)]


def _seen_from(ego_T_points: np.ndarray, steps: np.ndarray) -> np.ndarray:
    """Convert motions of the vehicle, (..., 4, 4), to those of the points' frame."""
    return np.linalg.inv(ego_T_points) @ steps @ ego_T_points  # type: ignore[no-any-return]


def _shares(pairs: Sequence[Pair], scan: str, ego_T_points: np.ndarray, count: int) -> np.ndarray:
    """Return the sums of the pairs' shares in place under each mounting, (M, 4, 4), by the first `count` points."""
    shares = np.zeros(len(ego_T_points))
    for pair in pairs:
        steps = _seen_from(ego_T_points, pair.transforms[GIVEN])
        shares += pair.target.structure(scan).shares(pair.source.points(scan)[:count], steps)
    return shares


def place_of(pairs: Sequence[Pair], scan: str, rotation: np.ndarray) -> np.ndarray:
    """Return the place in the frame of the poses, (3,), at which the points' origin fits best, if they are turned.

    It is at the height of the poses, as the points see it. 0 if that fits as well, unless the frame is not turned.
    """
    origin = np.zeros((1, 2))
    places = np.concatenate([origin, _PLACES])
    for count in (FEW_POINTS, MOST_POINTS, MOST_POINTS):
        ego_T_points = as_matrix(np.tile(rotation, (len(places), 1, 1)), places @ rotation[:, :2].T)
        shares = _shares(pairs, scan, ego_T_points, count)
        best = places[1:][np.argsort(-shares[1:], kind="stable")]
        places = np.concatenate([origin, best[:_NUM_BEST] if len(best) > _NUM_BEST else best[0] + _BETWEEN])
    is_at_origin = turn_of(rotation) > 0 and shares[0] >= EQUAL * shares[1:].max()
    return np.zeros(3) if is_at_origin else rotation[:, :2] @ best[0]


def mounting_of(pairs: Sequence[Pair], scan: str, rotation: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the rotation of the points near a given one, (3, 3), and their place, (3,), that fit best together.

    The place is 0, and the rotation as given, if that fits as well.
    """
    near = rotations_about(2, _YAWS) @ rotation
    mounts = [(rotation, np.zeros(3)), *((turned, place_of(pairs, scan, turned)) for turned in near)]
    shares = _shares(pairs, scan, np.stack([as_matrix(*mount) for mount in mounts]), MOST_POINTS)
    return mounts[0 if shares[0] >= EQUAL * shares.max() else int(shares.argmax())]


def motion_of(pair: Pair, scan: str) -> np.ndarray:
    """Return the motion of a pair under which its points fit, (4, 4) float64.

    It has about the rotation of the poses. If nothing fits then, it is one in the plane, by the angle of the poses.
    """
    step = pair.transforms[GIVEN].copy()
    step[:2, 3] = 0
    angle = float(turn_of(step))
    most = -1.0
    for rotation in (step, *(as_matrix(rotations_about(2, sign * angle)) for sign in (1, -1))):
        source = transform_points(pair.source.points(scan)[:MOST_POINTS], rotation)
        motion = find_motion(source, pair.target.points(scan), _SMALL_TURNS)
        nearby = np.tile(motion, (len(_WITHIN_CELL), 1, 1))
        nearby[:, :2, 3] += _WITHIN_CELL
        shares = pair.target.structure(scan).shares(source, nearby)
        if shares.max() > most:
            most, found = float(shares.max()), nearby[int(shares.argmax())] @ rotation
        if most >= LEAST_SHARE:
            break
    return found


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
        by_row = torch.fft.ifft(image * turned.conj(), dim=0)[steps]  # a third less work than all shifts
        counts = torch.fft.irfft(by_row, _CELLS, dim=1)[:, steps].round().numpy()
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
