"""The conventions that poses and points of a log may have: what each says, and how it is converted to ours."""

from __future__ import annotations

from functools import partial
from itertools import accumulate
from typing import Callable, NamedTuple, Sequence

import numpy as np

from cflow_torch.transforms import (
    as_matrix,
    halfway,
    rotations_of,
    to_quaternions,
    to_rotations,
)
from cflow_torch.windows.deskewing import DIRECTIONS, SCANS

OFF, TIMES = "off", "times"  # scans: the points stay, or move by their times
STILL, WORLD, INVERTED, REVERSED = "still", "world", "inverted", "reversed"
CAMERA, MOUNT = "camera", "mount"
MARGIN = 1.3  # share in place over that as given, from which a reading is clearly better
EQUAL = 0.95  # readings whose share is at least this part of the best one are named together
_SMALL = 1.1  # the same of small mistakes, which make a small difference
_OF_MIRRORED = 1.15  # mirrored axes change little on a straight road: up to 0.99 for right poses
LATEST = 10  # sweeps
_TURN = 2 * np.pi + 1e-3  # larger azimuths are degrees
AXES = {  # ego_T_stored of frames with other axes: x, y and z of the stored frame, as columns
    CAMERA: np.array([[0, 0, 1], [-1, 0, 0], [0, -1, 0]], float),  # x right, y down, z forward
    "opengl": np.array([[0, 0, -1], [-1, 0, 0], [0, 1, 0]], float),  # x right, y up, z backward
    "left": np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1]], float),  # x to the left of the vehicle
    "back": np.diag([-1.0, -1.0, 1.0]),
    "right": np.array([[0, 1, 0], [-1, 0, 0], [0, 0, 1]], float),
    "down": np.diag([1.0, -1.0, -1.0]),  # x forward, y right, z down, as of inertial units
    "mirrored": np.diag([1.0, -1.0, 1.0]),
    "mirrored_back": np.diag([-1.0, 1.0, 1.0]),
    "swapped": np.array([[0, 1, 0], [1, 0, 0], [0, 0, 1]], float),
    "swapped_back": np.array([[0, -1, 0], [-1, 0, 0], [0, 0, 1]], float),
    "z_first": np.array([[0, 1, 0], [0, 0, 1], [1, 0, 0]], float),  # z, x, y
}
MIRRORED = {  # left-handed
    "mirrored": "the y axis of the points or that of the poses is mirrored",
    "mirrored_back": "the x axis of the points or that of the poses is mirrored",
    "swapped": "x and y of the points or of the poses are interchanged",
    "swapped_back": "x and y of the points or of the poses are interchanged and reversed",
}
_DECIMAL = {"millimetres": 1e-3, "centimetres": 1e-2, "decimetres": 0.1, "kilometres": 1e3}
UNITS = {**_DECIMAL, "inches": 0.0254, "feet": 0.3048}

_Convert = Callable[[np.ndarray], np.ndarray]


class Reading(NamedTuple):
    """A convention, and how a log that has it is read."""

    cause: str  # what is said of a log that has it
    of_poses: _Convert | None = None  # converts consecutive poses as given, (K, 4, 4) float64, to `T_world_ego`
    of_points: _Convert | None = None  # converts points as stored, (N, 3+), to metres, x forward and z up
    margin: float = MARGIN
    opposite: str = ""  # the opposite mistake: if this reading is right, the opposite one doubles the mistake
    fix: str = ""  # what corrects it; "" = the value of `read_as` with its name
    mount: np.ndarray | None = None  # (4, 4), from the frame of the points to that of the poses, if this corrects it


def scale_poses(unit: float, poses: np.ndarray) -> np.ndarray:
    return as_matrix(poses[..., :3, :3], unit * poses[..., :3, 3])


def turned(axes: np.ndarray, place: Sequence[float] = (0, 0, 0)) -> _Convert:
    """Return what gives poses of a frame with other axes, or of another place, those of the points."""
    T_stored_ego = as_matrix(axes.T, place)
    return lambda poses: poses @ T_stored_ego


def _mirrored(axes: np.ndarray) -> _Convert:
    mirror = as_matrix(axes)
    return lambda poses: mirror @ poses @ mirror


def _reordered(order: Sequence[int]) -> _Convert:
    return lambda poses: as_matrix(to_rotations(to_quaternions(poses[:, :3, :3])[:, order]), poses[:, :3, 3])


def _transposed(axes: np.ndarray) -> _Convert:
    return lambda poses: as_matrix(axes @ poses[:, :3, :3].transpose(0, 2, 1), poses[:, :3, 3])


def _unturned(poses: np.ndarray) -> np.ndarray:
    return as_matrix(np.tile(np.eye(3), (len(poses), 1, 1)), poses[:, :3, 3])


def _joined(poses: np.ndarray) -> np.ndarray:
    return np.array(list(accumulate(poses, np.matmul)))


def _of_angles(convert: _Convert) -> _Convert:
    """Return what converts the angles of poses: roll, pitch and yaw, (3, K) radians, unwrapped."""

    def converted(poses: np.ndarray) -> np.ndarray:
        r = poses[:, :3, :3]
        roll = np.arctan2(r[:, 2, 1], r[:, 2, 2])
        pitch = -np.arcsin(r[:, 2, 0].clip(-1, 1))
        yaw = np.arctan2(r[:, 1, 0], r[:, 0, 0])
        return as_matrix(rotations_of(convert(np.unwrap((roll, pitch, yaw)))), poses[:, :3, 3])

    return converted


def _later(by: float) -> _Convert:
    """Return what gives each sweep the pose `by` sweeps later. Beyond the ends, the motion continues."""

    def convert(poses: np.ndarray) -> np.ndarray:
        if abs(by) < 1:
            return halfway(poses, _later(np.sign(by))(poses))
        rows = np.arange(len(poses)) + int(by)
        inside = rows.clip(0, len(poses) - 1)
        before = 0 if by < 0 else -2  # the step at the end beyond which the motion continues
        step = np.linalg.inv(poses[before]) @ poses[before + 1]
        moved = poses[inside]
        for row in np.flatnonzero(rows != inside):
            moved[row] = moved[row] @ np.linalg.matrix_power(step, int(rows[row] - inside[row]))
        return moved

    return convert


def _of_axes(axes: np.ndarray) -> _Convert:
    return lambda points: points[:, :3] @ axes.T


def _from_spherical(points: np.ndarray) -> np.ndarray:
    """Return x, y, z of range, azimuth and elevation, which are degrees if one is larger than 2 pi."""
    distance, azimuth, elevation = np.asarray(points[:, :3], np.float64).T
    if np.nanmax(np.abs(azimuth), initial=0) > _TURN:
        azimuth, elevation = np.radians(azimuth), np.radians(elevation)
    flat = distance * np.cos(elevation)
    return np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), distance * np.sin(elevation)], axis=1)


def _times_of_poses() -> dict[str, Reading]:
    """Return the readings of poses of another time, the pairs that are opposite next to each other."""
    early = "the poses are half a sweep early (or the times of the sweeps are half a sweep late)"
    late = "the poses are half a sweep late (or the times of the sweeps are half a sweep early)"
    readings = {
        "half_late": Reading(late, _later(0.5), margin=_SMALL, opposite="half_early"),
        "half_early": Reading(early, _later(-0.5), margin=_SMALL, opposite="half_late"),
    }
    for count in range(1, LATEST + 1):
        ending = f"_{count}" if count > 1 else ""
        for name, sign, other in (("late", 1, "early"), ("early", -1, "late")):
            cause = f"the poses are {name} (sweep i has the pose of sweep i {'-+'[sign < 0]} {count})"
            readings[name + ending] = Reading(cause, _later(sign * count), opposite=other + ending)
    return readings


def _mounts() -> dict[str, Reading]:
    """Return the readings of points whose origin is elsewhere in the frame of the poses, up to 4 m away.

    They show that it is. Where it is follows from the points.
    """
    readings = {}
    for size in (0.7, 1.4, 2.7, 4.0):
        for x, y in ((size, 0), (-size, 0), (0, size), (0, -size)):
            name, opposite = (f"{MOUNT} {sign * x:g} {sign * y:g}" for sign in (1, -1))
            readings[name] = Reading("", turned(np.eye(3), (x, y, 0)), margin=_SMALL, opposite=opposite)
    return readings


_FRAME = "the poses are of a frame whose"
TIMES_OF_POSES = _times_of_poses()
MOUNTS = _mounts()
READINGS: dict[str, Reading] = {
    WORLD: Reading("the points are in the world's frame", margin=_SMALL),
    INVERTED: Reading(
        "the poses are inverted (T_ego_world instead of T_world_ego), or the sweeps are interchanged", np.linalg.inv
    ),
    # Only all poses of a log tell this one.
    REVERSED: Reading("the clouds are in reverse order, or the poses are", lambda poses: poses[::-1]),
    "world_axes": Reading("the points have the axes of the world, but lie around the vehicle", _unturned),
    STILL: Reading(
        "the static world stands still without the poses, so they are of another log, or the points are compensated",
        lambda poses: np.tile(np.eye(4), (len(poses), 1, 1)),
    ),
    **TIMES_OF_POSES,
    "steps": Reading("the poses are steps (each is that of a sweep in the frame of the sweep before)", _joined),
    "steps_back": Reading(
        "the poses are steps (each maps the sweep before to the frame of the sweep)",
        lambda poses: _joined(np.linalg.inv(poses)),
    ),
    **{
        name: Reading(f"{cause} (left-handed)", _mirrored(AXES[name]), margin=_OF_MIRRORED)
        for name, cause in MIRRORED.items()
    },
    "transposed": Reading("the rotations of the poses are transposed, but not their positions", _transposed(np.eye(3))),
    "compass": Reading(
        "the angles of the poses are compass headings (clockwise from north)", _transposed(AXES["left"])
    ),
    "degrees": Reading("the angles of the poses are degrees, but were read as radians", _of_angles(np.radians)),
    "radians": Reading("the angles of the poses are radians, but were read as degrees", _of_angles(np.degrees)),
    "yaw_first": Reading(
        "the angles of the poses are yaw, pitch, roll, but were read as roll, pitch, yaw",
        _of_angles(lambda angles: angles[::-1]),
    ),
    CAMERA: Reading("the poses are of a camera (x right, y down, z forward)", turned(AXES[CAMERA])),
    "opengl": Reading("the poses are of a camera as in OpenGL (x right, y up, z backward)", turned(AXES["opengl"])),
    "left": Reading(f"{_FRAME} x axis points to the left of the points' x axis", turned(AXES["left"])),
    "back": Reading(f"{_FRAME} x axis points backward", turned(AXES["back"])),
    "right": Reading(f"{_FRAME} x axis points to the right of the points' x axis", turned(AXES["right"])),
    "down": Reading(f"{_FRAME} z axis points down (x forward, y right)", turned(AXES["down"]), margin=_OF_MIRRORED),
    "w_first": Reading(
        "the quaternions of the poses begin with w, but were read with w last", _reordered((1, 2, 3, 0))
    ),
    "w_last": Reading("the quaternions of the poses end with w, but were read with w first", _reordered((3, 0, 1, 2))),
    **{name: Reading(f"the poses are in {name}", partial(scale_poses, unit)) for name, unit in UNITS.items()},
    **{
        f"points_{name}": Reading(f"the points are in {name}", of_points=_of_axes(unit * np.eye(3)))
        for name, unit in UNITS.items()
    },
    "points_camera": Reading("the points have a camera's axes", of_points=_of_axes(AXES[CAMERA])),
    "points_opengl": Reading("y of the points is up", of_points=_of_axes(AXES["opengl"])),
    "points_z_first": Reading("the columns of the points are z, x, y", of_points=_of_axes(AXES["z_first"])),
    "points_upside_down": Reading("z of the points is down", of_points=_of_axes(AXES["down"])),
    "points_spherical": Reading("the points are range, azimuth and elevation", of_points=_from_spherical),
}
"""Value of `read_as` in `cflow_torch.data.catalog.open_log` -> what it means."""
OF_POINTS = tuple(name for name, reading in READINGS.items() if reading.of_points)
"""Readings under which the numbers of the points are others than those in the files."""

_OPPOSITE = dict(zip(DIRECTIONS, reversed(list(DIRECTIONS))))
SCAN_READINGS = {
    **{name: Reading("", margin=_SMALL) for name in (OFF, TIMES)},
    **{
        name: Reading("", margin=_SMALL, opposite=_OPPOSITE[direction] + instant)
        for name, (direction, _, instant) in SCANS.items()
    },
}
"""How points may move to the instant of their sweep: values of `deskew`, compared as readings of the poses are."""
