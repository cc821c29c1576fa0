"""Does the static world stay put? A check of poses and frames against the points themselves."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from typing import Any

import numpy as np

from cflow_torch.data.log import Log
from cflow_torch.types import CFlowError, Sweep
from cflow_torch.windows.ego_motion import rigid_transform

BASELINE = 5  # sweeps between the two that are compared: a wrong frame shows by how far the vehicle turned
_PAIRS = 2  # that are looked at in a log
_NEAREST, _FARTHEST = 2.5, 50.0  # metres from the origin: without the own car, and near enough for dense structure
_CELL = 1.0  # metres, side of the cells whose points are taken as one patch of a wall
_FEWEST = 6  # points in a cell
_BLUR = 0.03  # metres, the least thickness of a patch: range noise and calibration
_CLEARANCE = 0.4  # metres above the lowest point of a cell, below which a point may be ground
_MOST_POINTS = 8000
_STEPS = 10
_PRIOR = np.diag([1.0, 1.0, 100.0])  # 1 / (m^2, m^2, rad^2), against what the scene does not show (a long wall)
_FEWEST_IN_PLACE = 150  # agreement times points; fewer show nothing
# What is still no mistake. Correct poses gave at most 13 mm on a real drive without de-skewing and 7 mm on simulated
# ones; sweeps taken while the vehicle begins to turn, not de-skewed, 58 mm together with 0.7 degrees.
_SHIFT, _SHIFT_PER_METRE, _SHIFT_PER_RADIAN = 0.03, 0.01, 10.0
_TURN = np.radians(1.5)
_BETTER, _GOOD = 2.0, 0.15  # how much better, and how good at least, other poses fit before they are suggested
_HOPELESS = 0.2  # share of `own`; correct poses gave 0.27 (the case above) or more than 0.5
_ALIGNED = 0.5  # share of `own` from which a fit has found its place; a LiDAR at a wrong place gave 0.7 and more


class StaticWorldWarning(UserWarning):
    """The static world does not stay put under the poses of a log."""


@dataclass(frozen=True)
class StaticResidual:
    """What is left of the motion of the static world after ego motion is taken out.

    Args:
        index, later: the two sweeps.
        shift: (2,) float64 metres, by which structure of `index`, moved by the poses, misses that of `later`; x, y of
            the later sweep's frame.
        turn: radians about z, likewise.
        agreement: 0 ... 1, how well the structure of both coincides under the poses; of two sweeps of a street 0.3 to
            0.5. NaN where too little can be compared.
        aligned: agreement after `shift` and `turn` are taken out.
        verdict: what is likely wrong, "" = nothing.
    """

    index: int
    later: int
    shift: np.ndarray
    turn: float
    agreement: float
    aligned: float
    verdict: str


def static_world_residual(log: Log, index: int, baseline: int = BASELINE) -> StaticResidual:
    """Compare two sweeps of a log in one frame.

    Args:
        log: without poses the sensor is taken to stand still; without ground masks, low points are left out by a
            simple rule.
        index: the older sweep.
        baseline: sweeps to the later one.

    Convention:
        Only the horizontal plane is looked at: the points of the later sweep above ground, 2.5 to 50 m away, become
        Gaussian patches in cells of 1 m; a Gauss-Newton fit with weights that forget outliers (movers) finds the shift
        and turn that bring the older sweep onto them. Along a wall without any corner nothing can be seen and nothing
        is reported. A LiDAR that is not where the poses say shows only where the vehicle turns: by its distance times
        the turn, 12 cm for 1.35 m and 5 degrees.

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
    agreement, (shift, turn, aligned) = patches.agreement(moved), patches.fit(moved)
    own = patches.agreement(target)  # more than any other sweep can have
    if own * min(len(source), len(target)) < _FEWEST_IN_PLACE:
        return StaticResidual(index, index + baseline, shift, turn, float("nan"), float("nan"), "")
    inverted = patches.agreement(_move(source, pose1 @ np.linalg.inv(pose0)))
    still = patches.agreement(source[:, :2])
    size, distance = float(np.linalg.norm(shift)), float(np.linalg.norm(T_1_0[:3, 3]))
    verdict = ""
    if inverted > max(_BETTER * agreement, _GOOD, still):
        verdict = "The poses seem to be inverted: they must map ego coordinates to the world (T_world_ego)."
    elif still > max(_BETTER * agreement, _GOOD) or max(agreement / _HOPELESS, aligned / _ALIGNED) < own:
        verdict = (
            "It does not fit: are the poses of another log, of other axes (a camera's), times or units, or do the "
            "points lie in one common frame already (then pass no poses)?"
        )
    elif abs(turn) > _TURN or size > _SHIFT + _SHIFT_PER_METRE * distance + _SHIFT_PER_RADIAN * abs(turn):
        verdict = (
            f"It is off by {100 * size:.0f} cm and {np.degrees(abs(turn)):.1f} degrees. Points in the frame of the "
            "LiDAR with poses of the vehicle do this in turns: pass ego_T_lidar. Other causes: axes or times of the "
            "poses, sweeps that are not de-skewed."
        )
    if verdict and not has_poses:
        verdict = (
            "There are no poses, and the sensor seems to move: give poses, or data.odometry=true (in Python "
            "`with_poses` of cflow_torch.data.odometry)."
        )
    return StaticResidual(index, index + baseline, shift, turn, agreement, aligned, verdict)


def check_static_world(log: Log) -> list[StaticResidual]:
    """Warn if the static world does not stay put in two pairs of sweeps of a log.

    Args:
        log: any log. The pairs are those over which the vehicle turns most, if it has `poses`, else first and last.

    Returns:
        What was found; empty for a log of one sweep.

    Warns:
        StaticWorldWarning: once, with the verdict on the worst pair.

    Cost: reads two sweeps a pair; 0.15 s each.
    """
    baseline = min(BASELINE, len(log.timestamps) - 1)
    if baseline < 1:
        return []
    found = [static_world_residual(log, index, baseline) for index in _choose(log, baseline)]
    bad = [residual for residual in found if residual.verdict]
    if bad:
        worst = max(bad, key=lambda residual: float(np.linalg.norm(residual.shift)))
        warnings.warn(
            f"log {log.log_id}, sweeps {worst.index} and {worst.later}: the static world does not stay put. "
            + worst.verdict,
            StaticWorldWarning,
            stacklevel=2,
        )
    return found


def _choose(log: Any, baseline: int) -> list[int]:
    """First sweeps of pairs that do not overlap, those with the largest turn first."""
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
    """(N, 3) float64, points above ground, neither too near nor too far."""
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
    """(N,) int64, one number per cell; coordinates are within 10 km after any pose that is worth a look."""
    column, row = np.floor(np.clip(xy, -1e4, 1e4) / size).astype(np.int64).T
    return row * 100_003 + column


def _move(points: np.ndarray, transform: np.ndarray) -> np.ndarray:
    """(N, 2) float64, x and y after a transform."""
    return points @ transform[:2, :3].T + transform[:2, 3]


class _Patches:
    """Gaussian patches of structure seen from above."""

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
        """Mean over points of exp(-d^2 / 2), d = Mahalanobis distance to the patch of the cell; 0 where none is."""
        _, offset, precision = self._pairs(xy)
        distance = np.einsum("ni,nij,nj->n", offset, precision, offset)
        return float(np.exp(-distance / 2).sum() / max(len(xy), 1))

    def fit(self, xy: np.ndarray) -> tuple[np.ndarray, float, float]:
        """(shift, turn, agreement after them) that bring points onto the patches."""
        x, y, turn = 0.0, 0.0, 0.0
        for _ in range(_STEPS):
            moved = _turned(xy, turn) + (x, y)
            hit, offset, precision = self._pairs(moved)
            pull = np.einsum("nij,nj->ni", precision, offset)
            weight = 1 / (1 + (offset * pull).sum(1) / 4) ** 2
            jacobian = np.zeros((len(offset), 2, 3))
            jacobian[:, 0, 0] = jacobian[:, 1, 1] = 1
            jacobian[:, 0, 2], jacobian[:, 1, 2] = -(moved[hit, 1] - y), moved[hit, 0] - x
            weighted = jacobian * weight[:, None, None]
            hessian = np.einsum("nia,nij,njb->ab", weighted, precision, jacobian) / max(len(xy), 1) + _PRIOR
            gradient = np.einsum("nia,ni->a", weighted, pull) / max(len(xy), 1) + _PRIOR @ (x, y, turn)
            x, y, turn = np.array([x, y, turn]) - np.linalg.solve(hessian, gradient)
        return np.array([x, y]), float(turn), self.agreement(_turned(xy, turn) + (x, y))

    def _pairs(self, xy: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Which points fall on a patch, their offsets from its middle (M, 2), and its precision (M, 2, 2)."""
        if not len(self.cell):
            return np.zeros(len(xy), bool), np.zeros((0, 2)), np.zeros((0, 2, 2))
        key = _cells(xy, _CELL)
        place = np.searchsorted(self.cell, key).clip(0, len(self.cell) - 1)
        hit = (self.cell[place] == key) & self.usable[place]
        return hit, xy[hit] - self.mean[place[hit]], self.precision[place[hit]]


def _turned(xy: np.ndarray, turn: float) -> np.ndarray:
    cos, sin = np.cos(turn), np.sin(turn)
    return xy @ np.array([[cos, sin], [-sin, cos]])
