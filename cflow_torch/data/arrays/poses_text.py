"""Poses in text files of odometry tools: KITTI (12 numbers), TUM (time and quaternion), 4 x 4; or in `.npy` files."""

from __future__ import annotations

import io
import warnings
from decimal import Decimal
from typing import NamedTuple, Sequence

import numpy as np

from cflow_torch.data.files import file_errors, read_npy
from cflow_torch.data.paths import PathLike, as_path, read_bytes
from cflow_torch.data.rigid_motion import interpolate_poses, poses_from_quaternions
from cflow_torch.types import CFlowError
from cflow_torch.windows.ego_motion import rigid_transform

CALIBRATION_KEYS = ("Tr", "Tr_velo_to_cam", "Tr_velo_cam")  # KITTI's odometry, raw and tracking sets
_LONGEST_GAP_NS = 500_000_000  # longest time between two poses over which we interpolate


class Trajectory(NamedTuple):
    """K poses, and their `source` for messages."""

    poses: np.ndarray  # (K, 4, 4) float64 `T_world_frame`; the file does not say which frame
    times_ns: np.ndarray | None  # (K,) int64 nanoseconds, ascending; None if the format has no times
    layout: str  # "kitti", "tum" or "matrix"
    source: str


def read_poses(path: PathLike) -> Trajectory:
    """Read poses, whose rotations must be orthogonal up to rounding. The number of columns tells the format.

    Args:
        path: text with 12 numbers per line (KITTI: upper three rows of the matrix), 8 (TUM: time in seconds, tx ty tz,
            qx qy qz qw, the scalar LAST), or 16 (the matrix by rows); or `.npy` with (K, 4, 4) or (K, 3, 4). Lines that
            are empty or begin with `#` are skipped.
    """
    path, times_ns, layout = as_path(path), None, "matrix"
    if path.suffix == ".npy":
        matrices = read_npy(path, "pass a .npy file of (K, 4, 4) numbers")
    else:
        words, values = _read_table(path)
        layout = {8: "tum", 12: "kitti", 16: "matrix"}.get(values.shape[1], "")
        if not layout:
            raise CFlowError(f"{path} has {values.shape[1]} numbers per line; poses have 12 (KITTI), 8 (TUM) or 16")
        if layout == "tum":
            times_ns = _nanoseconds(path, words[:, 0])
            shifts, quaternions = values[:, 1:4], values[:, [7, 4, 5, 6]]
            matrices = poses_from_quaternions(shifts, quaternions, lambda row: f"{path}: pose {row}")
        else:
            matrices = values.reshape(len(values), -1, 4)
    return Trajectory(checked_poses(matrices, str(path)), times_ns, layout, str(path))


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
    words, _ = _read_table(path)
    if words.shape[1] != 1:
        raise CFlowError(f"{path} must have one time in seconds per line")
    return _nanoseconds(path, words[:, 0])


def write_kitti_poses(path: PathLike, poses: np.ndarray) -> None:
    """Write (K, 4, 4) poses as 12 numbers per line, with 17 digits."""
    np.savetxt(path, np.asarray(poses)[:, :3].reshape(-1, 12), "%.17g")


def write_times(path: PathLike, times_ns: Sequence[int]) -> None:
    """Write nanoseconds as one time in seconds per line, with 9 decimals."""
    np.savetxt(path, [f"{Decimal(int(time)).scaleb(-9):.9f}" for time in times_ns], "%s")


def covered_poses(trajectory: Trajectory, times_ns: Sequence[int]) -> np.ndarray:
    """Interpolate poses at (M,) nanoseconds: positions linearly, rotations at a constant rate.

    A time before the first pose, after the last one, or in a gap of more than half a second is a `CFlowError`. At
    exactly the time of a pose, the result is this pose, unchanged.
    """
    known, wanted = np.asarray(trajectory.times_ns), np.asarray(times_ns, np.int64)
    after = np.searchsorted(known, wanted).clip(0, len(known) - 1)  # the first pose at the time or after it
    before = np.where(known[after] == wanted, after, after - 1).clip(0)
    gap = known[after] - known[before]
    bad = (wanted < known[0]) | (wanted > known[-1]) | (gap > _LONGEST_GAP_NS)
    if bad.any():
        row = int(bad.argmax())
        raise CFlowError(
            f"{trajectory.source} covers {known[0]} ... {known[-1]} ns and has no pose near sweep {row} at "
            f"{wanted[row]} ns; do both count from the same time?"
        )
    share = (wanted - known[before]) / np.maximum(gap, 1)
    return interpolate_poses(trajectory.poses[before], trajectory.poses[after], share)


def _read_table(path: PathLike) -> tuple[np.ndarray, np.ndarray]:
    """Read a table in a text file: (K, C) words and their values, finite float64. K and C are at least 1."""
    with file_errors(path, "every line must have the same number of numbers"), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # NumPy warns about a file without lines
        text = read_bytes(as_path(path)).decode("utf-8").replace(",", " ")
        words = np.loadtxt(io.StringIO(text), str, ndmin=2)
        values = words.astype(np.float64)
    if not values.size or not np.isfinite(values).all():
        raise CFlowError(f"{path} {'has numbers that are not finite' if values.size else 'is empty'}")
    return words, values


def _nanoseconds(path: PathLike, seconds: np.ndarray) -> np.ndarray:
    """Convert (K,) texts of ascending seconds to int64 exactly: unix times need 19 digits, and a float has 16."""
    times = [(Decimal(word) * 10**9).to_integral_value() for word in seconds.tolist()]
    if max(map(abs, times)) >= 2**62:
        raise CFlowError(f"{path} has {max(times)} ns: times in seconds go up to 4.6e9; are they nanoseconds?")
    result = np.array([int(time) for time in times], dtype=np.int64)
    falls = np.diff(result) <= 0
    if falls.any():
        raise CFlowError(f"{path}: times must ascend, line {int(falls.argmax()) + 2} does not")
    return result
