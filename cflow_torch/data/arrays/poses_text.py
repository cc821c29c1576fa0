"""Files of poses and times, as programs for odometry, mapping and reconstruction write them."""

from __future__ import annotations

import re
from decimal import Decimal
from pathlib import Path
from typing import Any, Mapping, Sequence

import numpy as np

from cflow_torch.data.arrays.stamps import nanoseconds_of_numbers
from cflow_torch.data.arrays.tables import MATRIX, Table, parse_table, tables_of_values
from cflow_torch.data.column_names import role_of_name, roles_of_names
from cflow_torch.data.file_errors import file_errors
from cflow_torch.data.folders import natural_key, visible
from cflow_torch.data.npy_file import read_npy
from cflow_torch.data.paths import PathLike, as_path, read_bytes, suffix_of
from cflow_torch.data.trajectory import Trajectory, checked_poses, positions_of_degrees
from cflow_torch.transforms import ROUNDING, as_matrix, poses_from_quaternions, rotations_of
from cflow_torch.types import CFlowError

_POSITION, _ANGLES = ("x", "y", "z"), ("roll", "pitch", "yaw")
_QUATERNION = ("qw", "qx", "qy", "qz")
_ANY_ORDER, _W_LAST = ("q0", "q1", "q2", "q3"), ("qx", "qy", "qz", "qw")
_ROTATIONS = {*MATRIX[0:3], *MATRIX[4:7], *MATRIX[8:11], *_QUATERNION, *_ANY_ORDER}  # not all are zero
_TIMES = {"time", "sec", "nsec"}
# Mean of w, if it is the first of q0 to q3, and of numbers without any name, which are mostly TUM's (x of a roll of 23
# degrees). Of one pose without names, w is last.
_LEAST_W, _LEAST_W_UNNAMED = 0.02, 0.2
_TUM = ("time", *_POSITION, *_ANY_ORDER)
_UNNAMED = {
    7: _TUM[1:],
    8: _TUM,
    9: ("row", *_TUM),
    12: MATRIX[:12],
    13: ("time", *MATRIX[:12]),
    16: MATRIX,
    17: ("time", *MATRIX),
}
"""What columns without names hold, by their number."""
_QUATERNION_FIRST = (*_ANY_ORDER, *_POSITION)  # 7 numbers, or 8 with the time, whose last four are none
_UNNAMED_ANGLES = ("time", *_POSITION, *_ANGLES)  # 7 numbers whose last four are not a quaternion; 6 have no time
STRUCTURED = (".json", ".jsonl", ".yaml", ".yml", ".npz", ".npy")
"""Suffixes of files that must be whole to be read, see `tables_of_values`."""
_IN_ORDER = "write all digits, a line per sweep, in the order of their times"
_STARTS_WITH_NUMBERS = re.compile(rb"\s*[-+.\d]+[eE\d+-]*[ \t,]+[-+.\d]")  # a text, whatever its name
_INVERSE = ("extrinsic", "world2", "world_to", "w2c")  # in names of matrices that map the world to the sensor


def read_poses(path: PathLike) -> Trajectory:
    """Read poses, whose rotations must be orthogonal up to rounding.

    Args:
        path: a file of text, of `STRUCTURED`, or `.npy` with (K, 4, 4), (K, 3, 4) or the numbers of K lines; or a
            folder with a file per pose. A line of text has 12 numbers (KITTI: upper three rows of the matrix), 8 (TUM:
            time in seconds, tx ty tz, qx qy qz qw), 7 (without the time), 16 (the matrix by rows, or
            by columns), 13 or 17 (a time before the matrix), or 9 (the number of the row before TUM). In 7 and 8, the
            quaternion may come before x y z. 7 numbers without a quaternion are a time, x y z, roll pitch yaw; 6 have
            no time. Four lines may have a matrix, below a line of three numbers (Open3D). The last number of matrices
            may be a time in place of 1. Of a g2o graph, vertices are read. If a line before the numbers names the
            columns (timestamp, x, qw, ...), they may have any order, and roll, pitch and yaw may replace the
            quaternion. Other columns, empty lines and comments (`COMMENTS`) are ignored. Times:
            `nanoseconds_of_numbers`.

    Convention: yaw turns x to y, pitch then z to x, roll then y to z. What is not named of z, roll and pitch is 0. The
        angles are degrees if their name says so, or one is larger than 2 pi, else radians. A quaternion q0 to q3, or
        without names, has w first or last, as a vehicle turns mostly about z. Matrices called extrinsic or world to
        camera are inverted.
    """
    path = as_path(path)
    if path.is_dir():
        files = files_of_poses(path)
        poses = [read_poses(file).poses for file in files]
        if not files or any(len(each) != 1 for each in poses):
            raise CFlowError(f"{path} is a folder: its files must have one pose each")
        return Trajectory(np.concatenate(poses), None, False, str(path), [file.stem for file in files])
    with file_errors(path):
        return parse_poses(read_bytes(path), path)


def files_of_poses(folder: Path) -> list[Path]:
    """Return the files of a folder that may have a pose each, in order."""
    files = [path for path in visible(folder) if suffix_of(path) in (".txt", ".json", ".npy")]
    return sorted(files, key=lambda path: natural_key(path.stem))


def parse_poses(content: bytes, path: Path) -> Trajectory:
    """Return the poses in the content of a file of text or `STRUCTURED`."""
    if suffix_of(path) == ".npy":
        numbers = read_npy(path, "pass a .npy file of (K, 4, 4) numbers", content)
        if numbers.shape in ((3, 4), (4, 4)):  # of a folder with a file per pose
            numbers = numbers[None]
        if numbers.ndim == 2 and numbers.shape[1] in _UNNAMED and numbers.dtype.kind in "fiu":
            return _poses_of_table(Table([], numbers.astype(str), []), path)
        return Trajectory(checked_poses(numbers, str(path)), None, False, str(path))
    if suffix_of(path) not in STRUCTURED or _STARTS_WITH_NUMBERS.match(content):
        return _poses_of_table(parse_table(content, path), path)
    error = CFlowError(f"{path} has no list of poses: matrices of 16 or 12 numbers, or positions and rotations")
    found = []
    for table in map(_with_sevens, tables_of_values(content, path)):
        if _roles(table.names):
            try:
                found.append(_poses_of_table(table, path))
            except CFlowError as problem:
                error = problem
    if not found:
        raise error
    return max(found, key=lambda each: len(each.poses))  # ties: the outer one; calibrations have fewer


def _with_sevens(table: Table) -> Table:
    """Name the numbers of lists of seven, such as pose.0 to pose.6, if four are a quaternion, with w first or last."""
    names = list(table.names)
    for stem in [name[:-1] for name in names if name == "0" or name.endswith(".0")]:
        columns = [names.index(f"{stem}{k}") for k in range(8) if f"{stem}{k}" in names]
        roles = _layout(table.words[:, columns], False) if len(columns) == 7 else ()
        for column, role in zip(columns, roles if "time" not in roles else ()):
            names[column] = role
    return table._replace(names=names)


def _poses_of_table(table: Table, path: Path) -> Trajectory:
    names, words, labels = table
    if not names and (words.shape[1], len(words) % 4) == (4, 0) and _are_homogeneous(words[3::4]):  # four lines each
        words = words.reshape(-1, 16)
    roles = _roles(names)
    unnamed = _layout(words, bool(names))
    if not roles and (not names or len(unnamed) > 9 or len(names) == len(_TUM)):
        roles = {role: column for column, role in enumerate(unnamed) if role != "row"}
    if not roles:
        raise CFlowError(
            f"{path} has {words.shape[1]} numbers per line; poses have 12 (KITTI), 8 (TUM) or 16, or a first line with "
            "the names timestamp, x, y, z, qx, qy, qz, qw, or roll, pitch, yaw, in any order"
        )
    numbers = words.astype(np.float64)
    rotation = [column for role, column in roles.items() if role in _ROTATIONS]
    is_known: Any = np.isfinite(numbers[:, list(roles.values())]).all(axis=1)
    if rotation:  # programs write zeros for lost poses
        is_known &= (numbers[:, rotation] != 0).any(axis=1)
    if not is_known.any():
        raise CFlowError(f"{path} has no pose of finite numbers and a rotation that is not 0")
    if not _TIMES.isdisjoint(roles):  # programs write a line twice; without times, lines repeat if the vehicle stands
        rows = np.flatnonzero(is_known)
        rows = rows[np.argsort(_nanoseconds(roles, words[rows]), kind="stable")]
        rows = rows[np.concatenate([[True], (words[rows[1:]] != words[rows[:-1]]).any(axis=1)])]
        words, is_known = words[rows], is_known[rows]
        labels = [labels[row] for row in rows] if labels else []
    poses = np.full((len(words), 4, 4), np.nan)
    poses[is_known] = _poses_of_columns(names, roles, words[is_known], path)
    is_kitti = MATRIX[0] in roles and not names and words.shape[1] in (12, 13)
    times = None
    if not _TIMES.isdisjoint(roles):
        times = _ascending(path, _nanoseconds(roles, words), "write all digits, and one pose of a time")
    return Trajectory(poses, times, is_kitti, str(path), labels)


def _layout(words: np.ndarray, have_names: bool) -> Sequence[str]:
    """Return what the columns hold by their number and values, if names do not tell it; () = unknown."""
    count = words.shape[1]
    usual = _UNNAMED.get(count, ())
    if count == 9:
        counts_rows = (np.diff(words[:, 0].astype(np.float64)) == 1).all()
        return usual if counts_rows else ()
    if count == 13 and _are_matrices(words[:, :12]) and not _are_matrices(words[:, 1:]):
        return (*MATRIX[:12], "time")
    if count == 16:
        ends_with_1 = (words[:, 15].astype(np.float64) == 1).all()
        has_time = not ends_with_1 and _are_homogeneous(words[:, 12:])
        return (*MATRIX[:12], *["row"] * 3, "time") if has_time else usual
    if count not in (6, 7, 8) or have_names or _are_quaternions(words[:, -4:]):
        return usual
    if count > 6 and _are_quaternions(words[:, -7:-3]):
        return ("time", *_QUATERNION_FIRST)[8 - count :]
    return _UNNAMED_ANGLES[7 - count :] if count < 8 else usual


def _are_homogeneous(rows: np.ndarray) -> bool:
    """Test whether rows, (K, 4), are the last ones of matrices: 0, 0, 0, and 1 or, as some programs write, a time.

    One row does not tell a time.
    """
    numbers = rows.astype(np.float64)
    last = numbers[:, 3]
    return not numbers[:, :3].any() and bool((last == 1).all() or (len(last) > 1 and (np.diff(last) > 0).all()))


def _are_matrices(words: np.ndarray) -> bool:
    rotations = words.astype(np.float64).reshape(-1, 3, 4)[:, :, :3]
    errors = np.abs(rotations @ rotations.transpose(0, 2, 1) - np.eye(3)).max(axis=(1, 2))
    return bool(np.nanmedian(errors) < 0.1)


def _are_quaternions(words: np.ndarray) -> bool:
    norms = np.linalg.norm(words.astype(np.float64), axis=1)
    return bool(np.nanmedian(np.abs(norms - 1)) < 0.1)


def _roles(names: Sequence[str]) -> dict[str, int]:
    """Return the columns of the position, rotation and time that names tell; {} = they do not tell a pose."""
    first: dict[str, int] = {}
    roles = roles_of_names(names)
    for column, name in sorted(enumerate(names), key=lambda named: "stamp" not in named[1].lower()):  # not of arrival
        last = name.rpartition(".")[2]
        role = last if last in MATRIX else roles[column]
        if role is not None:
            first.setdefault(role, column)
    if "sec" in first and "nsec" not in first:
        first.setdefault("time", first.pop("sec"))
    has_rotation = any(set(group) <= set(first) for group in ({"z", *_QUATERNION}, {"z", *_ANY_ORDER}, {"yaw"}))
    has_position = {"x", "y"} <= set(first) or {"latitude", "longitude"} <= set(first)
    return first if MATRIX[0] in first or (has_position and has_rotation) else {}


def _poses_of_columns(names: Sequence[str], roles: Mapping[str, int], words: np.ndarray, path: Path) -> np.ndarray:
    """Return the poses, (K, 4, 4), of columns of matrices, or of positions and of quaternions or angles."""
    values = {role: words[:, column].astype(np.float64) for role, column in roles.items() if role not in _TIMES}
    zeros = np.zeros(len(words))
    if MATRIX[0] in roles:
        matrices = np.stack([values[name] for name in MATRIX if name in values], axis=1).reshape(len(words), -1, 4)
        if matrices.shape[1] == 4 and not matrices[:, :3, 3].any() and matrices[:, 3, :3].any():
            matrices = matrices.transpose(0, 2, 1)  # by columns
        poses = checked_poses(matrices[:, :3], str(path))
        is_inverse = bool(names) and any(each in names[roles[MATRIX[0]]].lower() for each in _INVERSE)
        return np.linalg.inv(poses) if is_inverse else poses
    if "x" not in values:
        values["x"], values["y"] = positions_of_degrees(values["latitude"], values["longitude"])
    positions = np.stack([values.get(axis, zeros) for axis in _POSITION], axis=1)
    if "q0" in values and not set(_QUATERNION) <= set(values):
        # A vehicle hardly rolls or pitches: if w comes first, the two in the middle are small, else the first two, and
        # also the third while its heading is that of the start. A camera turns about the second if w comes last.
        w, *middle = (np.abs(values[name]).mean() for name in _ANY_ORDER[:3])
        of_unnamed = _LEAST_W_UNNAMED if len(words) > 1 else 1.0
        is_first = w > max(*middle, _LEAST_W if names else of_unnamed)
        values.update(zip(_QUATERNION if is_first else _W_LAST, (values[name] for name in _ANY_ORDER)))
    if set(_QUATERNION) <= set(values):
        quaternions = np.stack([values[name] for name in _QUATERNION], axis=1)
        length: np.ndarray = np.linalg.norm(quaternions, axis=1)
        if len(length) > 1 and np.ptp(length) < ROUNDING * length.min():  # integers, or rounded
            quaternions = quaternions / length[:, None]
        return poses_from_quaternions(positions, quaternions, lambda row: f"{path}: pose {row}")
    angles = np.stack([values.get(name, zeros) for name in _ANGLES])
    if np.abs(angles).max() > 2 * np.pi or (names and "deg" in names[roles["yaw"]].lower()):
        angles = np.radians(angles)
    return as_matrix(rotations_of(angles), positions)


def _nanoseconds(roles: Mapping[str, int], words: np.ndarray) -> np.ndarray:
    """Return the times of poses, (K,) int64 nanoseconds."""
    if {"sec", "nsec"} <= set(roles):
        pairs = words[:, [roles["sec"], roles["nsec"]]].tolist()
        return np.array([int(Decimal(second) * 10**9 + Decimal(rest)) for second, rest in pairs], np.int64)
    return np.array(nanoseconds_of_numbers(words[:, roles["time"]].tolist()), np.int64)


def read_times(path: PathLike, is_sorted: bool = True) -> np.ndarray:
    """Read a file with one ascending time per line (KITTI's `times.txt`) as (K,) int64 nanoseconds.

    Times are seconds, unix times in s, ms, us or ns, or dates (2011-09-26 13:02:25.594360375). If they need not be
    sorted, pass False.
    """
    path = as_path(path)
    with file_errors(path, _IN_ORDER):
        return parse_times(read_bytes(path), path, is_sorted)


def parse_times(content: bytes, path: Path, is_sorted: bool = True) -> np.ndarray:
    content = re.sub(rb"(?m)(:\d\d),(?=\d{3,}\s*$)", rb"\1.", content)  # a fraction of a second, no other column
    names, words, _ = parse_table(content, path)
    columns = [column for column, name in enumerate(names) if role_of_name(name) == "time"]
    if words.shape[1] > 1 and not columns:
        raise CFlowError(f"{path} must have one time per line, or a column called time")
    words = words[:, columns[0] if columns else 0]
    times: np.ndarray = np.array(nanoseconds_of_numbers(words.tolist()), np.int64)
    return _ascending(path, times, _IN_ORDER) if is_sorted else times


def _ascending(path: Path, times: np.ndarray, fix: str) -> np.ndarray:
    """Return (K,) int64 nanoseconds, which must ascend; `fix` says how to correct those that do not."""
    falls = np.diff(times) <= 0
    if falls.any():
        raise CFlowError(f"{path}: times must ascend, and number {int(falls.argmax()) + 2} does not: {fix}")
    return times


def write_kitti_poses(path: PathLike, poses: np.ndarray) -> None:
    """Write (K, 4, 4) poses as 12 numbers per line, with 17 digits."""
    np.savetxt(path, np.asarray(poses)[:, :3].reshape(-1, 12), "%.17g")


def write_times(path: PathLike, times_ns: Sequence[int]) -> None:
    """Write nanoseconds as one time in seconds per line, with 9 decimals."""
    np.savetxt(path, [f"{Decimal(int(time)).scaleb(-9):.9f}" for time in times_ns], "%s")
