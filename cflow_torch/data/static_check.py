"""Check poses and frames against the points: is the static world static?"""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from typing import Any

import numpy as np

from cflow_torch.data.log import Log
from cflow_torch.types import CFlowError, Sweep
from cflow_torch.windows.ego_motion import rigid_transform

BASELINE = 5  # sweeps between the two that are compared: the error of a wrong frame grows with the vehicle's rotation
_PAIRS = 2  # compared per log
_NEAREST, _FARTHEST = 2.5, 50.0  # metres from the origin: without the own car, and near enough for dense structure
_CELL = 1.0  # metres, side of the cells whose points form one patch of a wall
_FEWEST = 6  # points in a cell
_BLUR = 0.03  # metres, smallest thickness of a patch: range noise and calibration
_CLEARANCE = 0.4  # metres above the lowest point of a cell, below which a point may be ground
_MOST_POINTS = 8000
_STEPS = 10
_PRIOR = np.diag([1.0, 1.0, 100.0])  # 1 / (m^2, m^2, rad^2), for directions that the scene leaves open (a long wall)
_FEWEST_IN_PLACE = 150  # smallest agreement times points that we judge
# Tolerances. Correct poses gave at most 13 mm on a real drive without de-skewing and 7 mm on simulated ones; sweeps
# at the beginning of a turn, not de-skewed, 58 mm together with 0.7 degrees.
_SHIFT, _SHIFT_PER_METRE, _SHIFT_PER_RADIAN = 0.03, 0.01, 10.0
_ROTATION = np.radians(1.5)
_BETTER, _GOOD = 2.0, 0.15  # factor by which other poses must fit better, and their least agreement, to be suggested
_HOPELESS = 0.2  # share of `own`; correct poses gave 0.27 (the case above) or more than 0.5
_ALIGNED = 0.5  # share of `own` from which a fit has converged; a LiDAR at a wrong position gave 0.7 and more


class StaticWorldWarning(UserWarning):
    """The static world moves under the poses of a log."""


@dataclass(frozen=True)
class StaticResidual:
    """Motion of the static world that remains after ego motion is removed.

    Args:
        index, later: the two sweeps.
        shift: (2,) float64 metres by which structure of `index`, moved by the poses, misses that of `later`; x, y of
            the later sweep's frame.
        rotation: radians about z by which it is rotated.
        agreement: 0 ... 1, how well the structure of both coincides under the poses; 0.3 to 0.5 for two sweeps of a
            street. NaN if too little can be compared.
        aligned: agreement after `shift` and `rotation` are removed.
        verdict: the likely mistake, "" = none.
    """

    index: int
    later: int
    shift: np.ndarray
    rotation: float
    agreement: float
    aligned: float
    verdict: str


def static_world_residual(log: Log, index: int, baseline: int = BASELINE) -> StaticResidual:
    """Compare two sweeps of a log in one frame.

    Args:
        log: without poses the sensor is assumed to be static; without ground masks, a simple rule removes low points.
        index: the older sweep.
        baseline: sweeps between the two.

    Convention:
        Only the horizontal plane is compared. The points of the later sweep above ground, 2.5 to 50 m away, become
        Gaussian patches in cells of 1 m. A Gauss-Newton fit with robust weights (for moving objects) finds the shift
        and rotation that align the older sweep with them. Along a wall without corners no shift is detected. A LiDAR at
        another position than the poses state shows only when the vehicle turns: by its distance times the rotation, 12
        cm for 1.35 m and 5 degrees.

    Raises:
        CFlowError: no such pair of sweeps.

    Cost: reads two sweeps and takes about 0.15 s on one core.

    Source: the fit is the normal distributions transform in the plane (Biber and Strasser, 2003).
    """
    count = len(log.timestamps)
    if baseline < 1 or not 0 <= index < count - baseline:
        raise CFlowError(f"log {log.log_id} has {count} sweeps; there is no pair {index}, {index + baseline}")
    older, newer = log.sweep(index), log.sweep(index + baseline)
    has_poses = older.pose is not None and newer.pose is not None
    pose0, pose1 = (rigid_transform(s.pose, "pose") if has_poses else np.eye(4) for s in (older, newer))
    T_1_0 = np.linalg.inv(pose1) @ pose0
    source, target = _structure(older), _structure(newer)[:, :2]
    patches = _Patches(target)
    source = source[np.random.default_rng(0).permutation(len(source))[:_MOST_POINTS]]
    moved = _move(source, T_1_0)
    agreement, (shift, rotation, aligned) = patches.agreement(moved), patches.fit(moved)
    own = patches.agreement(target)  # an upper bound for other sweeps
    if own * min(len(source), len(target)) < _FEWEST_IN_PLACE:
        return StaticResidual(index, index + baseline, shift, rotation, float("nan"), float("nan"), "")
    inverted = patches.agreement(_move(source, pose1 @ np.linalg.inv(pose0)))
    unmoved = patches.agreement(source[:, :2])
    size, distance = float(np.linalg.norm(shift)), float(np.linalg.norm(T_1_0[:3, 3]))
    verdict = ""
    if inverted > max(_BETTER * agreement, _GOOD, unmoved):
        verdict = "The poses seem to be inverted. They must map ego coordinates to the world (T_world_ego)."
    elif unmoved > max(_BETTER * agreement, _GOOD) or max(agreement / _HOPELESS, aligned / _ALIGNED) < own:
        verdict = (
            "The sweeps do not fit. Do the poses have another log, other axes (a camera's), times or units? Or are the "
            "points already in one common frame (then pass no poses)?"
        )
    elif abs(rotation) > _ROTATION or size > _SHIFT + _SHIFT_PER_METRE * distance + _SHIFT_PER_RADIAN * abs(rotation):
        verdict = (
            f"It is off by {100 * size:.0f} cm and {np.degrees(abs(rotation)):.1f} degrees. Points in the frame of the "
            "LiDAR with poses of the vehicle cause this in turns: pass ego_T_lidar. Other causes: axes or times of the "
            "poses, sweeps that are not de-skewed."
        )
    if verdict and not has_poses:
        verdict = (
            "There are no poses, but the sensor seems to move. Pass poses, or set data.odometry=true (in Python "
            "`with_poses` of cflow_torch.data.odometry)."
        )
    return StaticResidual(index, index + baseline, shift, rotation, agreement, aligned, verdict)


def check_static_world(log: Log) -> list[StaticResidual]:
    """Warn if the static world moves between two sweeps of a log.

    Args:
        log: any log. We compare the two pairs over which the vehicle turns most if it has `poses`, else first and last.

    Returns:
        The residuals; empty for a log of one sweep.

    Warns:
        StaticWorldWarning: once, with the verdict on the worst pair.

    Cost: reads two sweeps per pair; 0.15 s each.
    """
    baseline = min(BASELINE, len(log.timestamps) - 1)
    if baseline < 1:
        return []
    found = [static_world_residual(log, index, baseline) for index in _choose(log, baseline)]
    bad = [residual for residual in found if residual.verdict]
    if bad:
        worst = max(bad, key=lambda residual: float(np.linalg.norm(residual.shift)))
        warnings.warn(
            f"log {log.log_id}, sweeps {worst.index} and {worst.later}: the static world is not static. "
            + worst.verdict,
            StaticWorldWarning,
            stacklevel=2,
        )
    return found


def _choose(log: Any, baseline: int) -> list[int]:
    """Return the first sweeps of pairs that do not overlap, largest rotation first."""
    last = len(log.timestamps) - 1 - baseline
    poses: np.ndarray | None = getattr(log, "poses", None)
    if poses is None:
        return sorted({0, last})
    relative = np.linalg.inv(poses[baseline:]) @ poses[:-baseline]
    order = np.argsort(-np.abs(np.arctan2(relative[:, 1, 0], relative[:, 0, 0])), kind="stable")
    chosen: list[int] = []
    for index in order.tolist():
        if len(chosen) < _PAIRS and all(abs(index - other) >= baseline for other in chosen):
            chosen.append(index)
    return chosen


def _structure(sweep: Sweep) -> np.ndarray:
    """Return (N, 3) float64 points above ground, neither too near nor too far."""
    points = np.asarray(sweep.points)[:, :3].astype(np.float64)
    reach = np.hypot(points[:, 0], points[:, 1])
    keep = np.isfinite(points).all(1) & (reach > _NEAREST) & (reach < _FARTHEST)
    if sweep.is_ground is not None:
        return points[keep & ~np.asarray(sweep.is_ground)]
    points = points[keep]
    _, cell = np.unique(_cells(points[:, :2], 2 * _CELL), return_inverse=True)
    lowest = np.full(cell.max(initial=-1) + 1, np.inf)
    np.minimum.at(lowest, cell, points[:, 2])
    return points[points[:, 2] > lowest[cell] + _CLEARANCE]


def _cells(xy: np.ndarray, size: float) -> np.ndarray:
    """Return (N,) int64 cell indices; coordinates are within 10 km under all but hopeless poses."""
    column, row = np.floor(np.clip(xy, -1e4, 1e4) / size).astype(np.int64).T
    return row * 100_003 + column


def _move(points: np.ndarray, transform: np.ndarray) -> np.ndarray:
    """Return (N, 2) float64, x and y after a transform."""
    return points @ transform[:2, :3].T + transform[:2, 3]


class _Patches:
    """Gaussian patches of structure in the bird's-eye view."""

    def __init__(self, xy: np.ndarray) -> None:
        self.cell, member, count = np.unique(_cells(xy, _CELL), return_inverse=True, return_counts=True)
        self.mean = np.stack([np.bincount(member, xy[:, k], len(count)) / count for k in (0, 1)], 1)
        dx, dy = (xy - self.mean[member]).T
        xx, xyy, yy = (np.bincount(member, product, len(count)) / count for product in (dx * dx, dx * dy, dy * dy))
        xx, yy = xx + _BLUR**2, yy + _BLUR**2
        inverse = np.stack([yy, -xyy, -xyy, xx], 1) / (xx * yy - xyy**2)[:, None]
        self.precision = inverse.reshape(-1, 2, 2)
        self.usable = count >= _FEWEST

    def agreement(self, xy: np.ndarray) -> float:
        """Mean over points of exp(-d^2 / 2), d = Mahalanobis distance to the patch of the cell; 0 without a patch."""
        _, offset, precision = self._pairs(xy)
        distance = np.einsum("ni,nij,nj->n", offset, precision, offset)
        return float(np.exp(-distance / 2).sum() / max(len(xy), 1))

    def fit(self, xy: np.ndarray) -> tuple[np.ndarray, float, float]:
        """Return the shift and rotation that move points onto the patches, and the agreement after them."""
        x, y, rotation = 0.0, 0.0, 0.0
        for _ in range(_STEPS):
            moved = _rotated(xy, rotation) + (x, y)
            hit, offset, precision = self._pairs(moved)
            pull = np.einsum("nij,nj->ni", precision, offset)
            weight = 1 / (1 + (offset * pull).sum(1) / 4) ** 2
            jacobian = np.zeros((len(offset), 2, 3))
            jacobian[:, 0, 0] = jacobian[:, 1, 1] = 1
            jacobian[:, 0, 2], jacobian[:, 1, 2] = -(moved[hit, 1] - y), moved[hit, 0] - x
            weighted = jacobian * weight[:, None, None]
            hessian = np.einsum("nia,nij,njb->ab", weighted, precision, jacobian) / max(len(xy), 1) + _PRIOR
            gradient = np.einsum("nia,ni->a", weighted, pull) / max(len(xy), 1) + _PRIOR @ (x, y, rotation)
            x, y, rotation = np.array([x, y, rotation]) - np.linalg.solve(hessian, gradient)
        return np.array([x, y]), float(rotation), self.agreement(_rotated(xy, rotation) + (x, y))

    def _pairs(self, xy: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return which points fall on a patch, their offsets from its mean (M, 2), and its precision (M, 2, 2)."""
        if not len(self.cell):
            return np.zeros(len(xy), bool), np.zeros((0, 2)), np.zeros((0, 2, 2))
        key = _cells(xy, _CELL)
        patch = np.searchsorted(self.cell, key).clip(0, len(self.cell) - 1)
        hit = (self.cell[patch] == key) & self.usable[patch]
        return hit, xy[hit] - self.mean[patch[hit]], self.precision[patch[hit]]


def _rotated(xy: np.ndarray, angle: float) -> np.ndarray:
    cos, sin = np.cos(angle), np.sin(angle)
    return xy @ np.array([[cos, sin], [-sin, cos]])
