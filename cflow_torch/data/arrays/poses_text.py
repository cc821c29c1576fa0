"""Poses in text files as odometry tools write them: KITTI (12 numbers), TUM (time and quaternion), 4 x 4, or `.npy`."""

from __future__ import annotations

import math
from dataclasses import dataclass
from decimal import Decimal
from pathlib import Path
from typing import List, Optional, Sequence, Tuple

import numpy as np

from cflow_torch.data.atomic import atomic_file
from cflow_torch.data.npy_file import read_npy
from cflow_torch.data.paths import Place, as_path, read_bytes
from cflow_torch.simulator.writers.av2 import quaternions
from cflow_torch.types import CFlowError
from cflow_torch.windows.ego_motion import rigid_transform

QUATERNION_TOLERANCE = 1e-3  # TUM files have 4 to 17 digits
CALIBRATION_KEYS = ("Tr", "Tr_velo_to_cam", "Tr_velo_cam")  # KITTI's odometry, raw and tracking sets
_LONGEST_WORD = 400  # characters of a number; "1e308" has 309 when it is written out
_LONGEST_GAP_NS = 500_000_000  # between two poses, over which an interpolation is still a guess worth making


@dataclass(frozen=True)
class Trajectory:
    """K poses.

    Args:
        poses: (K, 4, 4) float64 `T_world_frame`; which frame, the file does not say.
        times_ns: (K,) int64 nanoseconds, ascending; None where the format has no times.
        layout: "kitti", "tum" or "matrix".
    """

    poses: np.ndarray
    times_ns: Optional[np.ndarray]
    layout: str


def read_poses(path: Place, calibration: Optional[Place] = None) -> Trajectory:
    """Poses of a file; its number of columns tells the format.

    Args:
        path: text with 12 numbers a line (KITTI: upper three rows of the matrix), 8 (TUM: time in seconds, tx ty tz,
            qx qy qz qw, the scalar LAST), or 16 (the whole matrix by rows); or `.npy` of (K, 4, 4) or (K, 3, 4).
        calibration: KITTI's `calib.txt`. Its `Tr` maps the LiDAR's coordinates to those of camera 0, whose poses the
            file then holds; the result are poses of the LiDAR, inv(Tr) P Tr.

    Returns:
        The poses, orthogonal to rounding. Lines that are empty or begin with `#` are skipped.

    Raises:
        CFlowError: no such file, another number of columns, no numbers, no rigid motions, times that do not ascend.
    """
    path = as_path(path)
    times_ns, layout = None, "matrix"
    if path.suffix == ".npy":
        matrices = read_npy(path, "give a .npy file of (K, 4, 4) numbers")
    else:
        rows = _read_rows(path)
        columns = len(rows[0])
        if any(len(row) != columns for row in rows) or columns not in (8, 12, 16):
            raise CFlowError(
                f"{path} has {sorted({len(row) for row in rows})} numbers a line; poses have 12 (KITTI), 8 (TUM: "
                "t x y z qx qy qz qw) or 16 (4 x 4)"
            )
        values = np.array([[float(word) for word in row] for row in rows])
        if columns == 8:
            times_ns = _ascending(path, [to_nanoseconds(row[0]) for row in rows])
            matrices = _from_quaternions(path, values[:, 1:4], values[:, 4:])
        else:
            matrices = values.reshape(len(values), -1, 4)
        layout = {8: "tum", 12: "kitti", 16: "matrix"}[columns]
    if matrices.ndim != 3 or matrices.shape[1:] not in ((3, 4), (4, 4)) or matrices.dtype.kind not in "fiu":
        raise CFlowError(f"{path} has shape {matrices.shape} and dtype {matrices.dtype}; give (K, 4, 4) numbers")
    poses = np.tile(np.eye(4), (len(matrices), 1, 1))
    poses[:, : matrices.shape[1]] = matrices
    for row, pose in enumerate(poses):
        rigid_transform(pose, f"pose {row} of {path}")
    if calibration is not None:
        T_cam_lidar = read_calibration(calibration)
        poses = np.linalg.inv(T_cam_lidar) @ poses @ T_cam_lidar
    return Trajectory(poses, times_ns, layout)


def read_calibration(path: Place) -> np.ndarray:
    """(4, 4) float64 `T_cam0_lidar` of KITTI's `calib.txt`: the line `Tr: ` and 12 numbers.

    Raises:
        CFlowError: no such file, no such line, no rigid motion.
    """
    for row in _read_rows(as_path(path), numbers=False):
        if row[0].rstrip(":") in CALIBRATION_KEYS:
            try:
                matrix = np.array([float(word) for word in row[1:]]).reshape(3, 4)
            except ValueError as error:
                raise CFlowError(f"{path}: the line {row[0]} needs 12 numbers ({error})") from error
            return rigid_transform(np.concatenate([matrix, [[0, 0, 0, 1]]]), f"{row[0]} of {path}")
    raise CFlowError(f"{path} has no line {', '.join(CALIBRATION_KEYS)} with the LiDAR's place in camera coordinates")


def read_times(path: Place) -> np.ndarray:
    """(K,) int64 nanoseconds of a file with one time in seconds a line (KITTI's `times.txt`).

    Raises:
        CFlowError: no such file, no numbers, or times that do not ascend.
    """
    rows = _read_rows(as_path(path))
    if any(len(row) != 1 for row in rows):
        raise CFlowError(f"{path} must have one time in seconds a line")
    return _ascending(path, [to_nanoseconds(row[0]) for row in rows])


def write_kitti_poses(path: Place, poses: np.ndarray) -> None:
    """Write (K, 4, 4) poses as 12 numbers a line, with 17 digits."""
    _write_lines(path, [" ".join(f"{value:.17g}" for value in pose[:3].ravel()) for pose in np.asarray(poses)])


def write_tum_poses(path: Place, times_ns: Sequence[int], poses: np.ndarray) -> None:
    """Write (K, 4, 4) poses as `t x y z qx qy qz qw`, seconds with 9 decimals, the rest with 17 digits."""
    poses = np.asarray(poses, np.float64)
    rotation = quaternions(poses[:, :3, :3])[:, [1, 2, 3, 0]]
    rows = np.concatenate([poses[:, :3, 3], rotation], axis=1)
    _write_lines(path, [" ".join([_seconds(t), *(f"{value:.17g}" for value in row)]) for t, row in zip(times_ns, rows)])


def write_times(path: Place, times_ns: Sequence[int]) -> None:
    """Write nanoseconds as one time in seconds a line, with 9 decimals."""
    _write_lines(path, [_seconds(time) for time in times_ns])


def poses_at(trajectory: Trajectory, times_ns: Sequence[int], source: str) -> np.ndarray:
    """Poses at given times: linear in position, constant turn rate between two poses.

    Args:
        trajectory: with times.
        times_ns: (M,) nanoseconds.
        source: what to call the trajectory in an error.

    Returns:
        (M, 4, 4) float64; a pose at exactly its time stays as it is.

    Raises:
        CFlowError: a time before the first or after the last pose, or in a gap of more than half a second.
    """
    if trajectory.times_ns is None:
        raise CFlowError(f"{source} has no times, so its poses cannot be interpolated")
    known, wanted = trajectory.times_ns, np.asarray(times_ns, np.int64)
    after = np.searchsorted(known, wanted)  # the first pose that is not before
    outside = (wanted < known[0]) | (wanted > known[-1])
    after = np.clip(after, 0, len(known) - 1)
    before = np.where(known[after] == wanted, after, after - 1).clip(0)
    gap = known[after] - known[before]
    if outside.any() or (gap > _LONGEST_GAP_NS).any():
        row = int(np.flatnonzero(outside | (gap > _LONGEST_GAP_NS))[0])
        raise CFlowError(
            f"{source} covers {known[0]} ... {known[-1]} ns and has no pose near sweep {row} at {wanted[row]} ns; "
            "do both count from the same moment?"
        )
    share = np.where(gap > 0, (wanted - known[before]) / np.maximum(gap, 1), 0.0)[:, None]
    first, last = trajectory.poses[before], trajectory.poses[after]
    q0, q1 = quaternions(first[:, :3, :3]), quaternions(last[:, :3, :3])
    cosine = (q0 * q1).sum(1, keepdims=True)
    q1 = np.where(cosine < 0, -q1, q1)
    angle = np.arccos(np.clip(np.abs(cosine), 0, 1))
    near = angle < 1e-9  # then both weights are the linear ones
    sine = np.where(near, 1.0, np.sin(angle))
    q = np.where(near, 1 - share, np.sin((1 - share) * angle) / sine) * q0
    q += np.where(near, share, np.sin(share * angle) / sine) * q1
    middle = _from_quaternions(source, (1 - share) * first[:, :3, 3] + share * last[:, :3, 3], q[:, [1, 2, 3, 0]])
    return np.where((share == 0)[:, :, None], first, middle)


def to_nanoseconds(seconds: str) -> int:
    """Decimal seconds to whole nanoseconds, without the rounding of a float (unix times need 19 digits).

    Raises:
        CFlowError: no number, or or above 4.6e9 seconds either way (the year 2116): 64 bits hold differences of those.
    """
    try:
        time = (Decimal(seconds) * 10**9).to_integral_value()
        if abs(time) < 2**62:
            return int(time)
    except (ArithmeticError, ValueError) as error:
        raise CFlowError(f"{seconds[:80]!r} is no time in seconds") from error
    raise CFlowError(f"{seconds[:80]!r} is no time in seconds: up to 4.6e9 fit, the year 2116; are they nanoseconds?")


def _seconds(time_ns: int) -> str:
    sign, time_ns = ("-", -int(time_ns)) if time_ns < 0 else ("", int(time_ns))
    return f"{sign}{time_ns // 10**9}.{time_ns % 10**9:09d}"


def _from_quaternions(path: Place, translation: np.ndarray, xyzw: np.ndarray) -> np.ndarray:
    """(K, 4, 4) float64 from (K, 3) metres and (K, 4) quaternions, scalar last."""
    norm = np.linalg.norm(xyzw, axis=1)
    bad = np.flatnonzero(~(np.abs(norm - 1) <= QUATERNION_TOLERANCE))
    if bad.size:
        raise CFlowError(f"{path}: the quaternion of pose {bad[0]} has length {norm[bad[0]]:.4g}, it must be 1")
    x, y, z, w = (xyzw / norm[:, None]).T
    poses = np.zeros((len(xyzw), 4, 4))
    poses[:, 0, :3] = np.stack([1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)], 1)
    poses[:, 1, :3] = np.stack([2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)], 1)
    poses[:, 2, :3] = np.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], 1)
    poses[:, :3, 3] = translation
    poses[:, 3, 3] = 1
    return poses


def _read_rows(path: Path, numbers: bool = True) -> List[Tuple[str, ...]]:
    """Words of every line that says something, at least one line."""
    try:
        lines = read_bytes(path).decode("utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise CFlowError(f"{path} cannot be read ({error}); give a text file") from error
    words = (line.replace(",", " ").split() for line in lines)
    rows = [tuple(row) for row in words if row and not row[0].startswith("#")]
    if not rows:
        raise CFlowError(f"{path} is empty")
    if numbers:
        for row in rows:
            try:
                finite = all(math.isfinite(float(word)) for word in row)
            except ValueError:
                finite = False
            if not finite or max(map(len, row)) > _LONGEST_WORD:
                raise CFlowError(f"{path} has a line that is no row of finite numbers: {' '.join(row)[:80]!r}")
    return rows


def _ascending(path: Place, times: List[int]) -> np.ndarray:
    result = np.array(times, dtype=np.int64)
    falls = result[1:] <= result[:-1]
    if falls.any():
        raise CFlowError(f"{path}: times must ascend, line {int(np.argmax(falls)) + 2} does not")
    return result


def _write_lines(path: Place, lines: Sequence[str]) -> None:
    with atomic_file(path) as file:
        file.write("".join(line + "\n" for line in lines).encode("ascii"))
