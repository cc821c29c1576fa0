"""Pool the estimates from several earlier sweeps into one motion per cluster (Sec. leverage_past_pcs)."""

from __future__ import annotations

import torch
from torch import Tensor

from cflow_torch.ops.medians import masked_median


def pool(estimates: Tensor, available: Tensor) -> Tensor:
    """Return a vector for each cluster, (M, 3) float64, with the median magnitude and orientation of its estimates.

    `estimates` are (M, K, 3) float64, metres per sweep interval, nearest sweep first. z has its own median.
    `available`, (M, K) bool, is False where the cluster is empty in that sweep. At least one per row is True.

    Convention:
        A single estimate is returned unchanged. Even counts: mean of the middle two (for orientations: the direction
        half-way between them). Orientations are ordered by their angle from the circular mean; an estimate of
        length zero has a magnitude but no orientation. We use only additions, products, divisions and square roots,
        because trigonometric functions round differently on other devices.

    Source: Sec. leverage_past_pcs; the paper defines neither the median of an even count nor the angular median.
    """
    first = _take(estimates, available.int().argmax(1))
    if estimates.shape[1] == 1:
        return first
    x, y, z = estimates.masked_fill(~available[:, :, None], 0.0).unbind(2)
    magnitude = torch.sqrt(x * x + y * y)
    is_oriented = available & (magnitude > 0)
    unit = torch.stack((x, y), 2) / _or_one(magnitude)[:, :, None]
    direction = _angular_median(unit.masked_fill(~is_oriented[:, :, None], 0.0), is_oriented)
    length, height = masked_median(torch.stack((magnitude, z), 2), available).split(1, 1)
    is_single = available.sum(1, keepdim=True) == 1
    return torch.where(is_single, first, torch.cat((length * direction, height), 1))


def _take(vectors: Tensor, index: Tensor) -> Tensor:
    """Take one vector of each row: (M, C) of (M, K, C); `index` is (M,) int64."""
    return vectors.gather(1, index[:, None, None].expand(-1, 1, vectors.shape[2]))[:, 0]


def _or_one(divisor: Tensor) -> Tensor:
    """Replace numbers that are not positive by 1."""
    return torch.where(divisor > 0, divisor, torch.ones_like(divisor))


def _angular_median(unit: Tensor, is_oriented: Tensor) -> Tensor:
    """(M, 2) median direction of the (M, K, 2) unit vectors that are oriented, (M, K); 0 if none is.

    The other vectors are 0.
    """
    angle = _angle(unit, _circular_mean(unit, is_oriented))
    order = angle.masked_fill(~is_oriented, float("inf")).sort(dim=1, stable=True).indices
    count = is_oriented.sum(1, keepdim=True)
    low = _take(unit, order.gather(1, (count - 1).clamp(min=0) // 2)[:, 0])
    high = _take(unit, order.gather(1, (count // 2).clamp(max=unit.shape[1] - 1))[:, 0])
    median = torch.where(count % 2 == 1, low, _halfway(low, high))
    return torch.where(count > 0, median, torch.zeros_like(median))


def _circular_mean(unit: Tensor, is_oriented: Tensor) -> Tensor:
    """Return the sum of unit vectors, (M, 2); the nearest oriented one where the sum is 0."""
    total = torch.zeros_like(unit[:, 0])
    for sweep in range(unit.shape[1]):  # one after the other, because the order of a float sum changes its last bits
        total = total + unit[:, sweep]
    nearest = _take(unit, is_oriented.int().argmax(1))
    return torch.where((total == 0).all(1, keepdim=True), nearest, total)


def _angle(unit: Tensor, mean: Tensor) -> Tensor:
    """Return numbers from -2 to 2 that grow with the angle from the mean to each vector, (M, K)."""
    along = mean[:, None, 0] * unit[..., 0] + mean[:, None, 1] * unit[..., 1]
    across = mean[:, None, 0] * unit[..., 1] - mean[:, None, 1] * unit[..., 0]
    slope = across / _or_one(along.abs() + across.abs())
    behind = torch.where(across >= 0, 2 - slope, -2 - slope)
    return torch.where(along >= 0, slope, behind)


def _halfway(one: Tensor, other: Tensor) -> Tensor:
    """Return the direction half-way between two, (M, 2) each; the first of two that are opposite."""
    both = one + other
    norm = torch.sqrt(both[:, :1] * both[:, :1] + both[:, 1:] * both[:, 1:])
    return torch.where(norm > 0, both / _or_one(norm), one)
