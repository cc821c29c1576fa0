"""Poses over time: which of them belong to the sweeps of a log."""

from __future__ import annotations

from typing import NamedTuple, Sequence

import numpy as np

from cflow_torch.transforms import ORTHOGONALITY, ROUNDING, interpolate_motion, rigid_transform
from cflow_torch.types import CFlowError

# Nanoseconds between two poses over which we interpolate: half a second, or more if poses are regular and rarer.
_LONGEST_GAP_NS, _LONGEST_STEP_NS, _OF_STEPS = 500_000_000, 1_100_000_000, 1.5
_FEWEST_COVERED = 0.5  # share of sweeps at a pose, if poses are farther apart than that
_SECOND = 10**9  # nanoseconds
_SPARSE = 1.5  # sweep intervals between poses
_TOLERANCE_NS = 1_000_000  # by which programs round times
_EARTH = 6378137.0  # metres, radius of the Mercator projection


class Trajectory(NamedTuple):
    """K poses, and their `source` for messages."""

    # (K, 4, 4) float64 `T_world_frame`; the file does not say which frame. Without times, NaN where the file has NaN.
    poses: np.ndarray
    times_ns: np.ndarray | None  # (K,) int64 nanoseconds, ascending; None if the format has no times
    is_kitti: bool  # 12 numbers without names, as KITTI's poses of a camera
    source: str
    labels: Sequence[str] = ()  # names of the rows, such as those of the clouds; () = unknown

    def is_sparse(self, times_ns: Sequence[int]) -> bool:
        """Test whether poses are clearly rarer than sweeps at these times."""
        known: np.ndarray = np.zeros(0) if self.times_ns is None else self.times_ns
        return bool(np.median(np.diff(known)) > _SPARSE * np.median(np.diff(times_ns)))

    def covers(self, times_ns: Sequence[int]) -> bool:
        """Test whether it has poses at most of these times."""
        if self.times_ns is None:
            return False
        return bool(_neighbours(self.times_ns, np.asarray(times_ns, np.int64))[2].mean() > _FEWEST_COVERED)

    def counted(self, times_ns: Sequence[int] | None) -> Trajectory:
        """Return the poses by number of the sweep, if their times are 0, 1, 2, ... and not those of the sweeps."""
        known: np.ndarray = np.zeros(0, np.int64) if self.times_ns is None else self.times_ns
        if not len(known) or (known % _SECOND).any() or np.median(np.diff(known)) != _SECOND:
            return self
        if times_ns is not None and known[0] <= times_ns[-1] and times_ns[0] <= known[-1]:
            return self
        return self._replace(times_ns=None, labels=[f"sweep {time // _SECOND}" for time in known])


def checked_poses(matrices: np.ndarray, source: str) -> np.ndarray:
    """Check (K, 4, 4) or (K, 3, 4) rigid motions and return them as (K, 4, 4) float64. Errors name the `source`.

    Matrices with few decimals become the nearest rotations. Poses that are not finite, or have a rotation of zeros, are
    unknown: NaN. If all are, that is an error.
    """
    if matrices.ndim != 3 or matrices.shape[1:] not in ((3, 4), (4, 4)) or matrices.dtype.kind not in "fiu":
        raise CFlowError(f"{source} has shape {matrices.shape} and dtype {matrices.dtype}; pass (K, 4, 4) numbers")
    poses = np.tile(np.eye(4, dtype=np.result_type(matrices, np.float16)), (len(matrices), 1, 1))
    poses[:, : matrices.shape[1]] = matrices
    is_unknown = ~(np.isfinite(poses).all(axis=(1, 2)) & (poses[:, :3, :3] != 0).any(axis=(1, 2)))
    if is_unknown.all():
        raise CFlowError(f"{source} has no pose of finite numbers")
    poses[is_unknown] = np.eye(4)
    rotations = poses[:, :3, :3].astype(np.float64)
    error = np.abs(rotations @ rotations.transpose(0, 2, 1) - np.eye(3)).max(axis=(1, 2))
    is_rounded = (error > ORTHOGONALITY) & (error <= ROUNDING)
    left, _, right = np.linalg.svd(rotations[is_rounded])
    poses[is_rounded, :3, :3] = left @ right
    checked = np.stack([rigid_transform(pose, f"pose {row} of {source}") for row, pose in enumerate(poses)])
    checked[is_unknown] = np.nan
    return checked


def positions_of_degrees(latitude: np.ndarray, longitude: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the metres east and north of the first place, (K,) float64 each, by the Mercator projection there."""
    scale = _EARTH * np.cos(np.radians(latitude[0]))
    north = scale * np.log(np.tan(np.pi / 4 + np.radians(latitude) / 2))
    return scale * np.radians(longitude - longitude[0]), north - north[0]


def fit_to_sweeps(trajectory: Trajectory, times_ns: Sequence[int]) -> tuple[np.ndarray, np.ndarray, str]:
    """Interpolate a trajectory at the times of sweeps, with constant speed and rate of turn between two poses.

    Args:
        trajectory: poses with times.
        times_ns: M nanoseconds.

    Returns:
        (K, 4, 4) float64 poses of the sweeps that have one; which sweeps these are, (M,) bool; and how many have none,
        and where, "" if all have one. At exactly the time of a pose, the result is this pose, unchanged.

    Raises:
        CFlowError: no sweep has a pose, or poses are mostly more than 1.1 seconds apart.

    Convention: a sweep has no pose more than a millisecond before the first pose or after the last one, and within a
        gap: more than half a second, and one and a half usual steps of the poses.
    """
    known, wanted = np.asarray(trajectory.times_ns), np.asarray(times_ns, np.int64)
    before, after, covered = _neighbours(known, wanted)
    is_rare = bool(np.median(np.diff(known)) > _longest_gap(known)) and covered.mean() < _FEWEST_COVERED
    if is_rare or not covered.any():
        raise CFlowError(_describe_misfit(trajectory.source, known, wanted))
    poses = trajectory.poses[before[covered]]
    is_between = (before != after)[covered]
    if is_between.any():
        left, right = (rows[covered][is_between] for rows in (before, after))
        share = (wanted[covered][is_between] - known[left]) / (known[right] - known[left])
        poses[is_between] = interpolate_motion(trajectory.poses[left], trajectory.poses[right], share)
    notes = [_describe_uncovered(trajectory.source, known, wanted, covered)]
    usual = _longest_gap(known) / _OF_STEPS
    if usual > _LONGEST_GAP_NS:
        fix = "if static points move, try data.odometry=refine"
        notes.append(f"its poses are {usual * 1e-9:.2g} s apart, and we interpolate: {fix}")
    return poses, covered, "; ".join(filter(None, notes))


def _describe_misfit(source: str, known: np.ndarray, wanted: np.ndarray) -> str:
    where = f"the sweeps are at {wanted[0]} ... {wanted[-1]} ns"
    if (wanted < known[0]).all() or (wanted > known[-1]).all():
        lag = wanted[len(wanted) // 2] - known[len(known) // 2]
        return (
            f"{source} covers {known[0]} ... {known[-1]} ns, and {where}: the clocks differ by about "
            f"{lag * 1e-9:.6g} s. Both must count from the same time; shift the times of one, or give no poses "
            "(data.poses=null)"
        )
    rate = np.median(np.diff(known)) * 1e-9
    fix = "give more poses, or none and data.odometry=true"
    return f"{source} has a pose every {rate:.3g} s, and we interpolate up to 1.1 s: {fix}; {where}"


def _describe_uncovered(source: str, known: np.ndarray, wanted: np.ndarray, covered: np.ndarray) -> str:
    """Say how many sweeps have no pose, and where; "" if all have one."""
    lost = wanted[~covered]
    if not len(lost):
        return ""
    early, late = int((lost < known[0]).sum()), int((lost > known[-1]).sum())
    in_gaps = len(lost) - early - late
    places = ((early, "before the first pose"), (late, "after the last pose"), (in_gaps, "in gaps"))
    where = ", ".join(f"{count} {place}" for count, place in places if count)
    gaps = f" of more than {_longest_gap(known) * 1e-9:.2g} s without poses" if in_gaps else ""
    return f"{len(lost)} of {len(wanted)} sweeps have no pose in {source} and are left out: {where}{gaps}"


def _longest_gap(known: np.ndarray) -> float:
    """Return the longest time between two poses over which we interpolate, nanoseconds."""
    usual = float(np.median(np.diff(known))) if len(known) > 1 else 0.0
    return max(_LONGEST_GAP_NS, _OF_STEPS * usual) if usual <= _LONGEST_STEP_NS else _LONGEST_GAP_NS


def _neighbours(known: np.ndarray, wanted: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the index of the pose before each time, of the one after it, and whether we may interpolate, (M,) each.

    A time at a pose has this pose on both sides. So has a time outside of all poses or in a gap, if a pose is within a
    millisecond: programs round times.
    """
    after = np.searchsorted(known, wanted).clip(0, len(known) - 1)  # the first pose at the time or after it
    before = np.where(known[after] == wanted, after, after - 1).clip(0)
    is_far = (wanted < known[0]) | (wanted > known[-1]) | (known[after] - known[before] > _longest_gap(known))
    nearest = np.where(np.abs(known[after] - wanted) <= np.abs(known[before] - wanted), after, before)
    is_rounded = is_far & (np.abs(known[nearest] - wanted) <= _TOLERANCE_NS)
    before = np.where(is_rounded, nearest, before)
    after = np.where(is_rounded, nearest, after)
    return before, after, ~is_far | is_rounded
