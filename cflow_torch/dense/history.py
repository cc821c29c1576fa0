"""Pool the estimates from several earlier sweeps into one motion per cluster (Sec. leverage_past_pcs)."""

from __future__ import annotations

import torch
from torch import Tensor

from cflow_torch.ops.segments import masked_median


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
    num_estimates = estimates.shape[1]
    first = available.int().argmax(1)
    single = estimates[torch.arange(len(estimates), device=estimates.device), first]
    if num_estimates == 1:
        return single
    x, y, z = estimates.masked_fill(~available[:, :, None], 0.0).unbind(2)
    magnitude = torch.sqrt(x * x + y * y)
    oriented = available & (magnitude > 0)
    safe = torch.where(oriented, magnitude, torch.ones_like(magnitude))
    unit = torch.stack((x / safe, y / safe), 2).masked_fill(~oriented[:, :, None], 0.0)
    direction = _angular_median(unit, oriented)
    length, height = masked_median(torch.stack((magnitude, z), 2), available).split(1, 1)
    pooled = torch.cat((length * direction, height), 1)
    return torch.where(available.sum(1, keepdim=True) == 1, single, pooled)


def _angular_median(unit: Tensor, oriented: Tensor) -> Tensor:
    """(M, 2) median direction of the (M, K, 2) unit vectors that are `oriented`, (M, K); 0 if none is."""
    rows = torch.arange(len(unit), device=unit.device)
    mean = torch.zeros_like(unit[:, 0])
    for step in range(unit.shape[1]):  # one after the other, because the order of a float sum changes its last bits
        mean = mean + unit[:, step]
    nearest = unit[rows, oriented.int().argmax(1)]
    mean = torch.where((mean == 0).all(1, keepdim=True), nearest, mean)

    along = mean[:, None, 0] * unit[..., 0] + mean[:, None, 1] * unit[..., 1]
    across = mean[:, None, 0] * unit[..., 1] - mean[:, None, 1] * unit[..., 0]
    total = along.abs() + across.abs()
    slope = torch.where(total > 0, across / torch.where(total > 0, total, torch.ones_like(total)), total)
    behind = torch.where(across >= 0, 2 - slope, -2 - slope)
    angle = torch.where(along >= 0, slope, behind)  # -2 ... 2, grows with the angle from the mean
    order = angle.masked_fill(~oriented, float("inf")).sort(dim=1, stable=True).indices
    count = oriented.sum(1)
    low = unit[rows, order[rows, (count - 1).clamp(min=0) // 2]]
    high = unit[rows, order[rows, (count // 2).clamp(max=unit.shape[1] - 1)]]
    both = low + high
    norm = torch.sqrt(both[:, 0] * both[:, 0] + both[:, 1] * both[:, 1])[:, None]
    halfway = torch.where(norm > 0, both / torch.where(norm > 0, norm, torch.ones_like(norm)), low)
    middle = torch.where((count % 2 == 1)[:, None], low, halfway)
    return torch.where((count > 0)[:, None], middle, torch.zeros_like(middle))
