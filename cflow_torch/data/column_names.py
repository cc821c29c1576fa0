"""Names of columns, of clouds and of tables of poses."""

from __future__ import annotations

import re
from typing import Iterable, Sequence

import numpy as np

from cflow_torch.data.file_errors import shortened
from cflow_torch.errors import CFlowError

AXES = ("x", "y", "z")
# Names without punctuation and units, as drivers, odometry programs and exports of ROS messages write them.
_ROTATION = "(q|.*quat|.*quaternion|.*orientation|.*rot|.*rotation|.*heading|qrs)"
_POSITION = "(t|p|pos|prsr|.*position|.*translation|.*location)?"
_ROLES = {
    "sec": "(.*stamp)?secs?",
    "nsec": "(.*stamp)?(nsecs?|nanosec)",
    "time": "t|.*time|.*stamp|(time|timestamp|stamp|t)(s|sec|secs|ns|us|ms|unix)",
    **{
        axis: f"{_POSITION}({axis}|{name}|.*xyz{k})m?"
        for k, (axis, name) in enumerate(zip("xyz", ("east(ing)?", "north(ing)?", "alt(itude)?|up|height")))
    },
    "latitude": ".*lat(itude)?(deg|degrees|rad|radians)?",
    "longitude": ".*(lon|lng|longitude)(deg|degrees|rad|radians)?",
    **{f"q{axis}": _ROTATION + axis for axis in "wxyz0123"},
    "roll": ".*roll(deg|degrees|rad|radians)?",
    "pitch": ".*pitch(deg|degrees|rad|radians)?",
    "yaw": ".*(yaw|heading|theta)(deg|degrees|rad|radians)?",
}
_QUATERNIONS = ({"qx", "qy", "qz"}, {"q0", "q1", "q2", "q3"})
_ANGLES = {"roll", "pitch", "yaw"}
_TIME_OF_POINT = "((d|delta)?t|.*time|.*stamp|(t|.*time|.*stamp)?offset)(s|secs?|nsecs?|ns|us|ms|unix)?"
_FEWEST_COUNTED = 20  # rows of a column that surely counts them
_OTHERS = "normal|twist|linear|angular|veloc|accel|covariance|rate"


def distinct_names(names: Sequence[str], padding: str = "") -> list[str]:
    """Number the repetitions of a name: intensity, intensity_2. The name of `padding` stays."""
    counts = [list(names[:k]).count(name) for k, name in enumerate(names, 1)]
    return [name if count == 1 or name == padding else f"{name}_{count}" for name, count in zip(names, counts)]


def default_names(count: int) -> list[str]:
    """Return the names of columns without names: x, y, z, column_3, ..."""
    return [*AXES, *(f"column_{k}" for k in range(3, count))]


def with_axes(names: Sequence[str]) -> list[str]:
    """Return distinct names, of which those of a position are x, y and z: also lidar_x, lidar_y, lidar_z."""
    if set(AXES) <= set(names):
        return distinct_names(names)
    roles = [role_of_name(name) for name in names]
    plain = [re.sub(r"[\W_]", "", name.lower()) for name in names]
    ends = [name[:-1] for name in plain if name.endswith("x") and not re.search(_OTHERS, name)]
    alike = next((start for start in ends if {start + axis for axis in AXES} <= set(plain)), None)
    if not set(AXES) <= set(roles) and alike is not None:
        roles = [name[-1] if name[:-1] == alike else None for name in plain]
    return distinct_names(
        [str(role) if role in AXES and roles.index(role) == k else names[k] for k, role in enumerate(roles)]
    )


def first_coordinate(columns: Sequence[np.ndarray]) -> int:
    """Return the index of the column of x among columns without names: 1 if the first one counts the rows, else 0."""
    counter = columns[0]
    is_counter = len(columns) > len(AXES) and len(counter) >= _FEWEST_COUNTED and counter[0] in (0, 1)
    return int(is_counter and np.array_equal(counter, np.arange(len(counter)) + counter[0]))


def role_of_name(name: str) -> str | None:
    """Return what a column holds: a key of `_ROLES`, such as time, x, qw, yaw or latitude; None = else.

    q0 to q3 are a quaternion of unknown order.
    """
    plain = _plain(name)
    if re.search(_OTHERS, plain):
        return None
    return next((role for role, pattern in _ROLES.items() if re.fullmatch(pattern, plain)), None)


def roles_of_names(names: Sequence[str]) -> list[str | None]:
    """Return what the columns of a table hold, see `role_of_name`. Next to phi or a radius, theta is not a yaw."""
    plain = list(map(_plain, names))
    are_spherical = any(re.fullmatch(".*(phi|radius)", name) for name in plain)
    is_angle = [are_spherical and name.endswith("theta") for name in plain]
    return [None if is_other else role_of_name(name) for name, is_other in zip(names, is_angle)]


def are_of_poses(names: Iterable[str]) -> bool:
    """Test whether columns hold rotations, as those of poses or boxes do: a quaternion, or three angles.

    Points of mobile mapping have the angles of the vehicle next to x, y, z.
    """
    names = list(names)
    roles = {role_of_name(name) for name in names}
    has_angles = roles >= _ANGLES and not set(AXES) <= {name.lower() for name in names}
    return has_angles or any(quaternion <= roles for quaternion in _QUATERNIONS)


def check_no_poses(names: Sequence[str]) -> None:
    if are_of_poses(names):
        raise CFlowError(f"its columns {shortened(list(names))} are those of poses or boxes, not of points")


def time_columns(names: Iterable[str]) -> list[str]:
    """Return those of the names that columns with times of points have."""
    return [name for name in names if re.fullmatch(_TIME_OF_POINT, _plain(name))]


def _plain(name: str) -> str:
    ordered = re.sub(r"[ ._-]?(xyzw|wxyz)(?![a-z])", "", name.lower())  # quaternion_xyzw
    return re.sub(r"\[.*?\]|\(.*?\)|[^a-z0-9]", "", ordered)
