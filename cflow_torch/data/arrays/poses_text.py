"""Poses in text files of odometry tools: KITTI (12 numbers), TUM (time and quaternion), 4 x 4; or in `.npy` files."""

from __future__ import annotations

import re
from decimal import Decimal
from pathlib import Path
from typing import Mapping, NamedTuple, Sequence

import numpy as np

from cflow_torch.data.arrays.stamps import nanoseconds_of_dates, nanoseconds_of_numbers
from cflow_torch.data.column_names import role_of_name
from cflow_torch.data.file_errors import file_errors
from cflow_torch.data.folders import natural_key
from cflow_torch.data.npy_file import read_npy
from cflow_torch.data.paths import PathLike, as_path, read_bytes
from cflow_torch.transforms import (
    as_matrix,
    interpolate_poses,
    poses_from_quaternions,
    rigid_transform,
    rotations_about,
)
from cflow_torch.types import CFlowError

_QUATERNION = ("qw", "qx", "qy", "qz")
_ANGLES = ("roll", "pitch", "yaw")
_TIMES = {"time", "sec", "nsec"}
_LONGEST_GAP_NS = 500_000_000  # longest time between two poses over which we interpolate
_FEWEST_COVERED = 0.5  # share of sweeps at a pose, if poses are farther apart than that
_TOLERANCE_NS = 1_000_000  # by which programs round times
_FEWEST_NUMBERS = 7  # of a pose


class Trajectory(NamedTuple):
    """K poses, and their `source` for messages."""

    # (K, 4, 4) float64 `T_world_frame`; the file does not say which frame. Without times, NaN where the file has NaN.
    poses: np.ndarray
    times_ns: np.ndarray | None  # (K,) int64 nanoseconds, ascending; None if the format has no times
    layout: str  # "kitti", "tum" or "matrix"
    source: str


def read_poses(path: PathLike) -> Trajectory:
    """Read poses, whose rotations must be orthogonal up to rounding. Names or the number of columns tell the format.

    Args:
        path: text with 12 numbers per line (KITTI: upper three rows of the matrix), 8 (TUM: time in seconds, tx ty tz,
            qx qy qz qw, the scalar LAST), 7 (without the time), 16 (the matrix by rows), or 13 or 17 (a time before
            the matrix), or four lines of 4 numbers per pose; or `.npy` with (K, 4, 4) or (K, 3, 4); or a folder with a
            file per pose. If a line before the numbers names the columns (timestamp, x, qw, ...), they may have any
            order, and roll, pitch and yaw may replace the quaternion. Other columns, empty lines and lines that begin
            with `#` are ignored. Unix times may be in s, ms, us or ns.

    Convention: yaw turns x to y, pitch then z to x, roll then y to z. What is not named of z, roll and pitch is 0. The
        angles are degrees if their name says so, or one is larger than 2 pi, else radians.
    """
    path = as_path(path)
    if path.is_dir():
        files = files_of_poses(path)
        poses = [read_poses(file).poses for file in files]
        if not files or any(len(each) != 1 for each in poses):
            raise CFlowError(f"{path} is a folder: its .txt files must have one pose each")
        return Trajectory(np.concatenate(poses), None, "matrix", str(path))
    if path.suffix == ".npy":
        matrices = read_npy(path, "pass a .npy file of (K, 4, 4) numbers")
        return Trajectory(checked_poses(matrices, str(path)), None, "matrix", str(path))
    with file_errors(path):
        content = read_bytes(path)
    return parse_poses(content, path)


def files_of_poses(folder: Path) -> list[Path]:
    return sorted((path for path in folder.iterdir() if path.suffix == ".txt"), key=lambda path: natural_key(path.stem))


def parse_poses(content: bytes, path: Path) -> Trajectory:
    """Return the poses in the content of a text file."""
    names, words = _table_of(content, path)
    roles = _roles(names)
    columns = words.shape[1]
    if not names and columns == 4 and len(words) % 4 == 0:  # a matrix in four lines
        words = words.reshape(-1, 16)
        columns = 16
    has_time = not _TIMES.isdisjoint(roles) if roles else columns in (8, 13, 17)
    if not roles and columns in (7, 8) and len(names) in (0, 8):
        roles = dict(zip(("time", "x", "y", "z", "qx", "qy", "qz", "qw")[8 - columns :], range(columns)))
    is_known = np.isfinite(words.astype(np.float64)).all(axis=1)
    if not is_known.any():
        raise CFlowError(f"{path} has no line of finite numbers")
    if has_time:  # programs write a line twice; without times, lines repeat if the vehicle stands
        words = words[is_known & np.concatenate([[True], (words[1:] != words[:-1]).any(axis=1)])]
        is_known = np.ones(len(words), bool)
    poses = np.full((len(words), 4, 4), np.nan)
    if roles:
        poses[is_known] = _poses_of_columns(names, roles, words[is_known], path)
    elif columns in (12, 13, 16, 17):
        matrices = words[is_known, columns % 4 :].astype(np.float64).reshape(-1, columns // 4, 4)
        poses[is_known] = checked_poses(matrices, str(path))
        roles = {"time": 0} if has_time else {}
    else:
        raise CFlowError(
            f"{path} has {columns} numbers per line; poses have 12 (KITTI), 8 (TUM) or 16, or a first line with the "
            "names timestamp, x, y, z, qx, qy, qz, qw, or roll, pitch, yaw, in any order"
        )
    layout = "kitti" if columns in (12, 13) and not set(roles) - _TIMES else "tum" if has_time else "matrix"
    return Trajectory(poses, _times_of_columns(roles, words, path), layout, str(path))


def _roles(names: Sequence[str]) -> dict[str, int]:
    """Return the columns of the position, rotation and time that names tell; {} = they do not tell a pose."""
    first: dict[str, int] = {}
    for column, name in enumerate(names):
        role = role_of_name(name)
        if role is not None:
            first.setdefault(role, column)
    if "sec" in first and "nsec" not in first:
        first.setdefault("time", first.pop("sec"))
    is_pose = {"x", "y"} <= set(first) and ({"z", *_QUATERNION} <= set(first) or "yaw" in first)
    return first if is_pose else {}


def _poses_of_columns(names: Sequence[str], roles: Mapping[str, int], words: np.ndarray, path: Path) -> np.ndarray:
    """Return the poses, (K, 4, 4), of columns of positions and of quaternions or angles."""
    zeros = np.zeros(len(words))
    values = {role: words[:, column].astype(np.float64) for role, column in roles.items() if role not in _TIMES}
    positions = np.stack([values.get(axis, zeros) for axis in "xyz"], axis=1)
    if set(_QUATERNION) <= set(roles):
        quaternions = np.stack([values[name] for name in _QUATERNION], axis=1)
        return poses_from_quaternions(positions, quaternions, lambda row: f"{path}: pose {row}")
    angles = np.stack([values.get(name, zeros) for name in _ANGLES])
    if "deg" in names[roles["yaw"]].lower() or np.abs(angles).max() > 2 * np.pi:
        angles = np.radians(angles)
    roll, pitch, yaw = (rotations_about(axis, angle) for axis, angle in enumerate(angles))
    return as_matrix(yaw @ pitch @ roll, positions)


def _times_of_columns(roles: Mapping[str, int], words: np.ndarray, path: Path) -> np.ndarray | None:
    """Return the nanoseconds of poses, ascending; None = there are no times."""
    if {"sec", "nsec"} <= set(roles):
        pairs = words[:, [roles["sec"], roles["nsec"]]].tolist()
        return _ascending(path, [str(int(second) * 10**9 + int(rest)) for second, rest in pairs])
    return _ascending(path, words[:, roles["time"]].tolist()) if "time" in roles else None


def checked_poses(matrices: np.ndarray, source: str) -> np.ndarray:
    """Check (K, 4, 4) or (K, 3, 4) rigid motions and return them as (K, 4, 4) float64. Errors name the `source`."""
    if matrices.ndim != 3 or matrices.shape[1:] not in ((3, 4), (4, 4)) or matrices.dtype.kind not in "fiu":
        raise CFlowError(f"{source} has shape {matrices.shape} and dtype {matrices.dtype}; pass (K, 4, 4) numbers")
    poses = np.tile(np.eye(4), (len(matrices), 1, 1))
    poses[:, : matrices.shape[1]] = matrices
    for row, pose in enumerate(poses):
        rigid_transform(pose, f"pose {row} of {source}")
    return poses


def read_numbers(path: Path) -> np.ndarray:
    """Read a table without names, (K, C) float64."""
    with file_errors(path):
        return _table_of(read_bytes(path), path)[1].astype(np.float64)


def read_times(path: PathLike) -> np.ndarray:
    """Read a file with one ascending time per line (KITTI's `times.txt`) as (K,) int64 nanoseconds.

    Times are seconds, unix times in s, ms, us or ns, or dates (2011-09-26 13:02:25.594360375).
    """
    path = as_path(path)
    with file_errors(path):
        content = read_bytes(path)
    return parse_times(content, path)


def parse_times(content: bytes, path: Path) -> np.ndarray:
    with file_errors(path):
        lines = [line for line in content.decode("utf-8-sig").splitlines() if line.strip() and line.strip()[0] != "#"]
    dates = nanoseconds_of_dates(lines)
    if dates:
        return _ascending(path, [str(date) for date in dates])
    _, words = _table_of(content, path)
    if words.shape[1] != 1:
        raise CFlowError(f"{path} must have one time in seconds per line")
    return _ascending(path, words[:, 0].tolist())


def write_kitti_poses(path: PathLike, poses: np.ndarray) -> None:
    """Write (K, 4, 4) poses as 12 numbers per line, with 17 digits."""
    np.savetxt(path, np.asarray(poses)[:, :3].reshape(-1, 12), "%.17g")


def write_times(path: PathLike, times_ns: Sequence[int]) -> None:
    """Write nanoseconds as one time in seconds per line, with 9 decimals."""
    np.savetxt(path, [f"{Decimal(int(time)).scaleb(-9):.9f}" for time in times_ns], "%s")


def fit_to_sweeps(trajectory: Trajectory, times_ns: Sequence[int]) -> tuple[np.ndarray, np.ndarray, str]:
    """Interpolate a trajectory at the times of sweeps: positions linearly, rotations at a constant rate.

    Args:
        trajectory: poses with times.
        times_ns: M nanoseconds.

    Returns:
        (K, 4, 4) float64 poses of the sweeps that have one; which sweeps these are, (M,) bool; and how many have none,
        and where, "" if all have one. At exactly the time of a pose, the result is this pose, unchanged.

    Raises:
        CFlowError: no sweep has a pose, or poses are mostly more than half a second apart.

    Convention: a sweep has no pose more than a millisecond before the first pose or after the last one, and within a
        gap of more than half a second.
    """
    known, wanted = np.asarray(trajectory.times_ns), np.asarray(times_ns, np.int64)
    before, after, covered = _neighbours(known, wanted)
    is_rare = bool(np.median(np.diff(known)) > _LONGEST_GAP_NS) and covered.mean() < _FEWEST_COVERED
    if is_rare or not covered.any():
        raise CFlowError(_describe_misfit(trajectory.source, known, wanted))
    left, right, time = before[covered], after[covered], wanted[covered]
    share = np.where(left == right, 0.0, (time - known[left]) / np.maximum(known[right] - known[left], 1))
    poses = interpolate_poses(trajectory.poses[left], trajectory.poses[right], share)
    return poses, covered, _describe_uncovered(trajectory.source, known, wanted, covered)


def _describe_misfit(source: str, known: np.ndarray, wanted: np.ndarray) -> str:
    where = f"the sweeps are at {wanted[0]} ... {wanted[-1]} ns"
    if (wanted < known[0]).all() or (wanted > known[-1]).all():
        lag = wanted[len(wanted) // 2] - known[len(known) // 2]
        return (
            f"{source} covers {known[0]} ... {known[-1]} ns, and {where}: the clocks differ by about "
            f"{lag * 1e-9:.6g} s. Both must count from the same time; shift the times of one, or pass no poses"
        )
    rate = np.median(np.diff(known)) * 1e-9
    return f"{source} has a pose every {rate:.3g} s; between poses, we interpolate up to 0.5 s; {where}"


def _describe_uncovered(source: str, known: np.ndarray, wanted: np.ndarray, covered: np.ndarray) -> str:
    """Say how many sweeps have no pose, and where; "" if all have one."""
    lost = wanted[~covered]
    if not len(lost):
        return ""
    early, late = int((lost < known[0]).sum()), int((lost > known[-1]).sum())
    in_gaps = len(lost) - early - late
    places = ((early, "before the first pose"), (late, "after the last pose"), (in_gaps, "in gaps"))
    where = ", ".join(f"{count} {place}" for count, place in places if count)
    gaps = f" of more than {_LONGEST_GAP_NS * 1e-9:g} s without poses" if in_gaps else ""
    return f"{len(lost)} of {len(wanted)} sweeps have no pose in {source} and are left out: {where}{gaps}"


def _neighbours(known: np.ndarray, wanted: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the index of the pose before each time, of the one after it, and whether we may interpolate, (M,) each.

    A time at a pose has this pose on both sides. So has a time outside of all poses or in a gap, if a pose is within a
    millisecond: programs round times.
    """
    after = np.searchsorted(known, wanted).clip(0, len(known) - 1)  # the first pose at the time or after it
    before = np.where(known[after] == wanted, after, after - 1).clip(0)
    is_far = (wanted < known[0]) | (wanted > known[-1]) | (known[after] - known[before] > _LONGEST_GAP_NS)
    nearest = np.where(np.abs(known[after] - wanted) <= np.abs(known[before] - wanted), after, before)
    is_rounded = is_far & (np.abs(known[nearest] - wanted) <= _TOLERANCE_NS)
    before = np.where(is_rounded, nearest, before)
    after = np.where(is_rounded, nearest, after)
    return before, after, ~is_far | is_rounded


def _table_of(content: bytes, path: Path) -> tuple[list[str], np.ndarray]:
    """Read a table in a text file: the names of its columns, and its (K, C) words, which are finite numbers.

    Names are those of the last line before the numbers, also if it begins with "#". They are empty if this line does
    not have one name for each column. Columns of texts, such as the names of frames, are left out. K and C are at
    least 1.
    """
    with file_errors(path, "every line must have the same number of numbers"):
        lines = [line.strip() for line in content.decode("utf-8-sig").splitlines() if line.strip()]
        start = next((k for k, line in enumerate(lines) if _is_row(_split(line))), len(lines))
        names = re.split("[,;]", lines[start - 1].lstrip("#")) if start else []
        names = names if len(names) > 1 or not start else lines[start - 1].lstrip("#").split()
        words = np.array([_split(line) for line in lines[start:] if line[0] != "#"], str)
        if any(line[0] != "#" for line in lines[: max(start - 1, 0)]) or words.ndim != 2 or not start < len(lines):
            raise ValueError("it is empty, or has text before its numbers" if start else "its lines differ in length")
        columns = [column for column, word in enumerate(words[0]) if _is_number(word)]
        names = [names[column] for column in columns] if len(names) == words.shape[1] else []
        words = words[:, columns]
        words.astype(np.float64)  # raises the error
    return names, words


def _split(line: str) -> list[str]:
    return re.split(r"[\s,;]+", line.rstrip(",; "))


def _is_row(words: list[str]) -> bool:
    """Test whether words are a row of numbers, or a pose with a few texts."""
    num_numbers = sum(map(_is_number, words))
    return num_numbers == len(words) or num_numbers >= _FEWEST_NUMBERS


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


def _ascending(path: Path, words: Sequence[str]) -> np.ndarray:
    """Convert texts of times to (K,) int64 nanoseconds, see `nanoseconds_of_numbers`; they must ascend."""
    result = np.array(nanoseconds_of_numbers(words), dtype=np.int64)
    falls = np.diff(result) <= 0
    if falls.any():
        raise CFlowError(f"{path}: times must ascend, line {int(falls.argmax()) + 2} does not")
    return result
