"""Bins of directions from a sensor, computed without trigonometry, so that they are the same on every device."""

from __future__ import annotations

from torch import Tensor

_RISE = 1 / 57.3  # of a degree of elevation, height over distance


def azimuth_bin(x: Tensor, y: Tensor, count: int) -> Tensor:
    """Return the bin of azimuth of vectors, 0 ... count - 1, (K,) float32 each to (K,) int64.

    The azimuth is measured by y / (|x| + |y|), so the bins at the axes are half as wide as those at the diagonals.
    """
    # NaN in x or y has bin 0.
    around = y / (x.abs() + y.abs()).clamp_(min=1e-3)
    around = (around + 1).where(x >= 0, 3 - around).nan_to_num_(0.0)  # 0 ... 4
    return around.mul_(count / 4).long().clamp_(max=count - 1)


def elevation_bin(z: Tensor, distance: Tensor, count: int, per_degree: int = 1) -> Tensor:
    """Return the bin of elevation, (K,) int64, by heights and horizontal distances, (K,) float32.

    There are `count` bins, half of them below the horizontal, and `per_degree` of them to about one degree.
    """
    rise = z / distance.clamp(min=0.1).mul_(_RISE / per_degree)
    return rise.add_(count // 2).nan_to_num_(0.0).clamp_(0, count - 1).long()
