"""Structure of the static world in the bird's-eye view, to compare two sweeps under a transform."""

from __future__ import annotations

import numpy as np

from cflow_torch.types import Sweep, as_numpy

_NEAREST, _FARTHEST = 2.5, 50.0  # metres from the origin: without the own car, and near enough for dense structure
_CELL = 1.0  # metres, side of the cells whose points form one patch of a wall
_FEWEST = 6  # points in a cell
_BLUR = 0.03  # metres, smallest thickness of a patch: range noise and calibration
_CLEARANCE = 0.4  # metres above the lowest point of a cell, below which a point may be ground
_STEPS = 10  # of the Gauss-Newton fit
_PRIOR = np.diag([1.0, 1.0, 100.0])  # 1 / (m^2, m^2, rad^2), for directions that the scene leaves open (a long wall)
FEWEST_IN_PLACE = 150  # least agreement times number of points from which we judge poses
# Inverted motion must fit better by this factor. Correct poses of real and simulated drives gave smaller factors;
# inverted poses gave 1.3 to 3.
_BETTER = 1.25


def structure(sweep: Sweep) -> np.ndarray:
    """Return the points above ground that are 2.5 to 50 m from the origin, (N, 3) float64, metres."""
    points = as_numpy(sweep.points)[:, :3].astype(np.float64)
    reach = np.hypot(points[:, 0], points[:, 1])
    keep = np.isfinite(points).all(1) & (reach > _NEAREST) & (reach < _FARTHEST)
    if sweep.is_ground is not None:
        return points[keep & ~as_numpy(sweep.is_ground)]
    points = points[keep]
    _, cell = np.unique(_cells(points[:, :2], 2 * _CELL), return_inverse=True)
    lowest = np.full(cell.max(initial=-1) + 1, np.inf)
    np.minimum.at(lowest, cell, points[:, 2])
    return points[points[:, 2] > lowest[cell] + _CLEARANCE]


def _cells(xy: np.ndarray, size: float) -> np.ndarray:
    """Return (N,) int64 cell indices. We clamp coordinates to 10 km; only absurd poses exceed that."""
    column, row = np.floor(np.clip(xy, -1e4, 1e4) / size).astype(np.int64).T
    return row * 100_003 + column


def move(points: np.ndarray, transform: np.ndarray) -> np.ndarray:
    """Return x and y of (N, 3) points after a (4, 4) transform, (N, 2) float64."""
    return points @ transform[:2, :3].T + transform[:2, 3]


def is_better_inverted(given: float, none: float, inverted: float) -> bool:
    """Test whether the given motion between two sweeps is inverted.

    The arguments are the agreements of the sweeps under the given, zero and inverse motion. The motion is inverted only
    if they increase in this order, and the last is more than 1.25 times the first. On a highway, where most structure
    belongs to vehicles of the same speed, zero motion has the largest agreement.
    """
    return given < none < inverted and inverted > _BETTER * given


class Patches:
    """Gaussian patches of structure in the bird's-eye view, one per cell: the mean and precision of its points."""

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
        """Return the mean of exp(-d^2 / 2), d = Mahalanobis distance to the patch of the cell; 0 without a patch."""
        _, offset, precision = self._pairs(xy)
        distance = np.einsum("ni,nij,nj->n", offset, precision, offset)
        return float(np.exp(-distance / 2).sum() / max(len(xy), 1))

    def fit(self, xy: np.ndarray) -> tuple[np.ndarray, float, float]:
        """Return the shift (metres) and rotation (radians) that move points onto the patches, and their agreement."""
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
        """Return which points fall on a patch, (N,) bool. For these: offset from its mean, (M, 2); its precision."""
        if not len(self.cell):
            return np.zeros(len(xy), bool), np.zeros((0, 2)), np.zeros((0, 2, 2))
        key = _cells(xy, _CELL)
        patch = np.searchsorted(self.cell, key).clip(0, len(self.cell) - 1)
        hit = (self.cell[patch] == key) & self.usable[patch]
        return hit, xy[hit] - self.mean[patch[hit]], self.precision[patch[hit]]


def _rotated(xy: np.ndarray, angle: float) -> np.ndarray:
    cos, sin = np.cos(angle), np.sin(angle)
    return xy @ np.array([[cos, sin], [-sin, cos]])
