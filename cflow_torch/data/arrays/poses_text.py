"""Poses in text files of odometry tools: KITTI (12 numbers), TUM (time and quaternion), 4 x 4; or in `.npy` files."""

from __future__ import annotations

import re
from decimal import Decimal
from typing import NamedTuple, Sequence

import numpy as np

from cflow_torch.data.file_errors import file_errors
from cflow_torch.data.npy_file import read_npy
from cflow_torch.data.paths import PathLike, as_path, read_bytes
from cflow_torch.transforms import interpolate_poses, poses_from_quaternions, rigid_transform
from cflow_torch.types import CFlowError

CALIBRATION_KEYS = ("Tr", "Tr_velo_to_cam", "Tr_velo_cam")  # KITTI's odometry, raw and tracking sets
# Names of columns without punctuation, as odometry programs and exports of ROS messages write them.
_ROTATION = "(q|.*quat|.*quaternion|.*orientation|.*rot|.*rotation|qrs)"
_POSITION = "(t|p|pos|prsr|.*position|.*translation)?"
_NAMES = {
    "time": "t|.*time|.*stamp|(time|timestamp|stamp|t)(s|sec|secs|ns|us|ms|unix)",
    "sec": "(.*stamp)?secs?",
    "nsec": "(.*stamp)?(nsecs?|nanosec)",
    **{axis: _POSITION + axis for axis in "xyz"},
    **{f"q{axis}": _ROTATION + axis for axis in "wxyz"},
}
_OTHERS = "twist|linear|angular|veloc|accel|covariance"
_LONGEST_GAP_NS = 500_000_000  # longest time between two poses over which we interpolate
_UNITS = ((10**17, 1), (10**14, 10**3), (10**11, 10**6))  # sizes of unix times, and the ns of their unit; else seconds
_TOLERANCE_NS = 1_000_000  # by which programs round times


class Trajectory(NamedTuple):
    """K poses, and their `source` for messages."""

    poses: np.ndarray  # (K, 4, 4) float64 `T_world_frame`; the file does not say which frame
    times_ns: np.ndarray | None  # (K,) int64 nanoseconds, ascending; None if the format has no times
    layout: str  # "kitti", "tum" or "matrix"
    source: str


def read_poses(path: PathLike) -> Trajectory:
    """Read poses, whose rotations must be orthogonal up to rounding. Names or the number of columns tell the format.

    Args:
        path: text with 12 numbers per line (KITTI: upper three rows of the matrix), 8 (TUM: time in seconds, tx ty tz,
            qx qy qz qw, the scalar LAST), or 16 (the matrix by rows); or `.npy` with (K, 4, 4) or (K, 3, 4). If a line
            before the numbers names the columns (timestamp, x, qw, ...), they may have any order. Other columns, empty
            lines and lines that begin with `#` are ignored. Unix times may be in s, ms, us or ns.
    """
    path, times_ns, layout = as_path(path), None, "matrix"
    if path.suffix == ".npy":
        matrices = read_npy(path, "pass a .npy file of (K, 4, 4) numbers")
        return Trajectory(checked_poses(matrices, str(path)), None, layout, str(path))
    names, words = _read_table(path)
    roles = _roles(names)
    if (roles is not None and len(roles) > 7) or words.shape[1] == 8:  # with times; others repeat if the vehicle stands
        words = words[np.concatenate([[True], (words[1:] != words[:-1]).any(axis=1)])]  # programs write a line twice
    if roles is not None:
        time, columns = roles[:-7], roles[-7:]
    elif words.shape[1] == 8:
        time, columns = [0], [1, 2, 3, 7, 4, 5, 6]
    elif words.shape[1] in (12, 16):
        matrices = words.astype(np.float64).reshape(len(words), -1, 4)
        layout = "kitti" if words.shape[1] == 12 else "matrix"
        return Trajectory(checked_poses(matrices, str(path)), None, layout, str(path))
    else:
        raise CFlowError(
            f"{path} has {words.shape[1]} numbers per line; poses have 12 (KITTI), 8 (TUM) or 16, or a first line with "
            "the names timestamp, x, y, z, qx, qy, qz, qw in any order"
        )
    numbers = words[:, columns].astype(np.float64)
    poses = poses_from_quaternions(numbers[:, :3], numbers[:, 3:], lambda row: f"{path}: pose {row}")
    if len(time) == 2:  # seconds and nanoseconds
        stamps = [str(int(second) * 10**9 + int(rest)) for second, rest in words[:, time].tolist()]
        times_ns = _nanoseconds(path, np.array(stamps))
    elif time:
        times_ns = _nanoseconds(path, words[:, time[0]])
    return Trajectory(poses, times_ns, "tum" if time else "matrix", str(path))


def _roles(names: list[str]) -> list[int] | None:
    """Return the columns of the time (none, one, or seconds and nanoseconds), of x, y, z, and of qw, qx, qy, qz.

    None = the names do not tell them.
    """
    plain = [re.sub(r"\[.*?\]|\(.*?\)|[^a-z0-9]", "", name.lower()) for name in names]
    first: dict[str, int] = {}
    for column, name in enumerate(plain):
        for role, pattern in _NAMES.items():
            if re.fullmatch(pattern, name) and not re.search(_OTHERS, name):
                first.setdefault(role, column)
    pose = ["x", "y", "z", "qw", "qx", "qy", "qz"]
    if not set(pose) <= set(first):
        return None
    time = ["sec", "nsec"] if {"sec", "nsec"} <= set(first) else ["time"] if "time" in first else []
    return [first[role] for role in (*time, *pose)]


def checked_poses(matrices: np.ndarray, source: str) -> np.ndarray:
    """Check (K, 4, 4) or (K, 3, 4) rigid motions and return them as (K, 4, 4) float64. Errors name the `source`."""
    if matrices.ndim != 3 or matrices.shape[1:] not in ((3, 4), (4, 4)) or matrices.dtype.kind not in "fiu":
        raise CFlowError(f"{source} has shape {matrices.shape} and dtype {matrices.dtype}; pass (K, 4, 4) numbers")
    poses = np.tile(np.eye(4), (len(matrices), 1, 1))
    poses[:, : matrices.shape[1]] = matrices
    for row, pose in enumerate(poses):
        rigid_transform(pose, f"pose {row} of {source}")
    return poses


def read_calibration(path: PathLike) -> np.ndarray:
    """Read the (4, 4) float64 `T_cam0_lidar` of KITTI's `calib.txt`: the line `Tr: ` and 12 numbers.

    It converts the poses P of KITTI's camera to poses of the LiDAR: inv(T) P T.
    """
    with file_errors(path, f"pass a file with a line {' or '.join(CALIBRATION_KEYS)} and 12 numbers"):
        lines = [line.replace(":", " ").split() for line in read_bytes(as_path(path)).decode("utf-8").splitlines()]
        row = next((words for words in lines if words and words[0] in CALIBRATION_KEYS), ["no line Tr"])
        matrix = np.array(row[1:], np.float64).reshape(3, 4)
    return rigid_transform(np.concatenate([matrix, [[0, 0, 0, 1]]]), f"{row[0]} of {path}")


def read_times(path: PathLike) -> np.ndarray:
    """Read a file with one ascending time in seconds per line (KITTI's `times.txt`) as (K,) int64 nanoseconds."""
    _, words = _read_table(path)
    if words.shape[1] != 1:
        raise CFlowError(f"{path} must have one time in seconds per line")
    return _nanoseconds(path, words[:, 0])


def write_kitti_poses(path: PathLike, poses: np.ndarray) -> None:
    """Write (K, 4, 4) poses as 12 numbers per line, with 17 digits."""
    np.savetxt(path, np.asarray(poses)[:, :3].reshape(-1, 12), "%.17g")


def write_times(path: PathLike, times_ns: Sequence[int]) -> None:
    """Write nanoseconds as one time in seconds per line, with 9 decimals."""
    np.savetxt(path, [f"{Decimal(int(time)).scaleb(-9):.9f}" for time in times_ns], "%s")


def are_covered(trajectory: Trajectory, times_ns: Sequence[int]) -> np.ndarray:
    """Test at which (M,) nanoseconds a trajectory has poses, (M,) bool.

    It has none more than a millisecond before the first pose or after the last one, nor within a gap of more than half
    a second. Poses that are all more than half a second apart, and no time at all, are a `CFlowError`.
    """
    known, wanted = np.asarray(trajectory.times_ns), np.asarray(times_ns, np.int64)
    covered = _neighbours(known, wanted)[2]
    if not covered.any():
        name, where = trajectory.source, f"the sweeps are at {wanted[0]} ... {wanted[-1]} ns"
        if (wanted < known[0]).all() or (wanted > known[-1]).all():
            lag = wanted[len(wanted) // 2] - known[len(known) // 2]
            raise CFlowError(
                f"{name} covers {known[0]} ... {known[-1]} ns, and {where}: the clocks differ by about "
                f"{lag * 1e-9:.6g} s. Both must count from the same time; shift the times of one, or pass no poses"
            )
        rate = np.median(np.diff(known)) * 1e-9
        raise CFlowError(f"{name} has a pose every {rate:.3g} s; between poses, we interpolate up to 0.5 s; {where}")
    return covered


def describe_uncovered(trajectory: Trajectory, times_ns: Sequence[int], covered: np.ndarray) -> str:
    """Say how many sweeps have no pose, and where; "" if all have one."""
    known, wanted = np.asarray(trajectory.times_ns), np.asarray(times_ns, np.int64)[~covered]
    early, late = int((wanted < known[0]).sum()), int((wanted > known[-1]).sum())
    places = ((early, "before the first pose"), (late, "after the last pose"), (len(wanted) - early - late, "in gaps"))
    where = ", ".join(f"{count} {place}" for count, place in places if count)
    gaps = f" of more than {_LONGEST_GAP_NS * 1e-9:g} s without poses" if early + late < len(wanted) else ""
    text = (
        f"{len(wanted)} of {len(times_ns)} sweeps have no pose in {trajectory.source} and are left out: {where}{gaps}"
    )
    return text if len(wanted) else ""


def covered_poses(trajectory: Trajectory, times_ns: Sequence[int]) -> np.ndarray:
    """Interpolate poses at (M,) nanoseconds that `are_covered`: positions linearly, rotations at a constant rate.

    At exactly the time of a pose, the result is this pose, unchanged.
    """
    known, wanted = np.asarray(trajectory.times_ns), np.asarray(times_ns, np.int64)
    before, after, _ = _neighbours(known, wanted)
    share = np.where(before == after, 0.0, (wanted - known[before]) / np.maximum(known[after] - known[before], 1))
    return interpolate_poses(trajectory.poses[before], trajectory.poses[after], share)


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


def _read_table(path: PathLike) -> tuple[list[str], np.ndarray]:
    """Read a table in a text file: the names of its columns, and its (K, C) words, which are finite numbers.

    Names are those of the last line before the numbers, also if it begins with "#". They are empty if this line does
    not have one name for each column. K and C are at least 1.
    """
    with file_errors(path, "every line must have the same number of numbers"):
        lines = [line.strip() for line in read_bytes(as_path(path)).decode("utf-8-sig").splitlines() if line.strip()]
        start = next((k for k, line in enumerate(lines) if _are_numbers(_split(line))), len(lines))
        names = re.split("[,;]", lines[start - 1].lstrip("#")) if start else []
        names = names if len(names) > 1 or not start else lines[start - 1].lstrip("#").split()
        words = np.array([_split(line) for line in lines[start:] if line[0] != "#"], str)
        if any(line[0] != "#" for line in lines[: max(start - 1, 0)]) or words.ndim != 2 or not start < len(lines):
            raise ValueError("it is empty, or has text before its numbers" if start else "its lines differ in length")
        values = words.astype(np.float64)
    if not np.isfinite(values).all():
        raise CFlowError(f"{path} has numbers that are not finite")
    return names if len(names) == words.shape[1] else [], words


def _split(line: str) -> list[str]:
    return re.split(r"[\s,;]+", line.rstrip(",; "))


def _are_numbers(words: list[str]) -> bool:
    try:
        return bool([float(word) for word in words])
    except ValueError:
        return False


def _nanoseconds(path: PathLike, words: np.ndarray) -> np.ndarray:
    """Convert (K,) texts of ascending times to int64 nanoseconds exactly: unix times need 19 digits, a float has 16.

    Unix times may be in s, ms, us or ns, which their size tells. Smaller times are seconds. A line that has the time of
    the one before it is an error.
    """
    numbers = [Decimal(word) for word in words.tolist()]
    largest = max(map(abs, numbers))
    unit = next((unit for first, unit in _UNITS if largest >= first), 10**9)
    result = np.array([int((number * unit).to_integral_value()) for number in numbers], dtype=np.int64)
    falls = np.diff(result) <= 0
    if falls.any():
        raise CFlowError(f"{path}: times must ascend, line {int(falls.argmax()) + 2} does not")
    return result
