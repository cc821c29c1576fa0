"""Vertical motion from the sectional view (second half of Alg. scene_flow_1obj), all clusters at once."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from cflow_torch.config import DenseConfig
from cflow_torch.dense.coarse_to_fine import ProjectedSweeps
from cflow_torch.dense.correlation import Estimates, best_shifts
from cflow_torch.dense.templates import Images, TemplatePairs
from cflow_torch.ops.indices import concat_ranges, renumber
from cflow_torch.ops.segments import bounding_boxes


def add_sectional_view(
    estimates: Estimates, cluster: Tensor, sweeps: ProjectedSweeps, config: DenseConfig
) -> Estimates:
    """Add f_z to the estimates of M clusters, and correct f_x and f_y along the heading (Alg. scene_flow_1obj).

    `cluster` is the cluster of each point, (P,) int, M = none. The points have three axes. The heading is the direction
    of (f_x, f_y), or the x axis if both are zero. All X-Z images lie on one grid through the origin, and each is cut to
    the bounding box of its pair. Ties: smallest shift, then smallest dz, then smallest dx'.
    """
    available, positions, pixel_size = estimates.available, sweeps.positions(), sweeps.grid.pixel_size
    step = sweeps.batch.image % sweeps.batch.num_steps
    num_sources = available.shape[1]
    slots = available.flatten().nonzero()[:, 0]  # one pair per cluster and sweep
    flow = estimates.displacement.view(-1, 3)[slots]

    x, y = flow[:, 0], flow[:, 1]
    length = torch.sqrt(x * x + y * y)
    safe = torch.where(length > 0, length, torch.ones_like(length))
    heading = torch.stack((torch.where(length > 0, x / safe, torch.ones_like(x)), y / safe))

    cluster = cluster.long()
    member = cluster < len(available)
    older = (member & (step > 0)).nonzero()[:, 0]
    template_pair = renumber(slots, available.numel())[cluster[older] * num_sources + step[older] - 1]
    moved = positions[:, older].clone()
    moved[:2] += flow.t()[:2, template_pair]
    newest = (member & (step == 0)).nonzero()[:, 0]
    # Each pair rotates the target by its own heading, so it needs its own copy of the points.
    copies = available.sum(1)[cluster[newest]]
    target = positions[:, newest.repeat_interleave(copies)]
    target_pair = concat_ranges(torch.searchsorted(slots // num_sources, cluster[newest]), copies)

    pair = torch.cat((template_pair, target_pair))
    # Rotate by minus the heading, then apply Eq. 3d_to_bev to (x', z).
    (x_of_point, y_of_point, up), (cos, sin) = torch.cat((moved, target), 1), heading[:, pair]
    side = torch.full((), pixel_size, dtype=up.dtype, device=up.device)
    along = cos * x_of_point + sin * y_of_point
    row, col = torch.floor(up / side).long(), torch.floor(along / side).long()
    first, size = bounding_boxes(row, col, pair, slots.numel())
    row, col = row - first[pair, 0], col - first[pair, 1]
    split = template_pair.numel()
    pairs = TemplatePairs(
        template=_draw(pair[:split], row[:split], col[:split], size),
        target=_draw(pair[split:], row[split:], col[split:], size),
        cluster=torch.arange(slots.numel(), device=slots.device),
        source=slots % num_sources,
        size=size,
    )
    shift, _ = best_shifts(pairs, config.correlation, config.max_memory)
    up, along = (shift.double() * pixel_size).unbind(1)
    displacement = estimates.displacement.clone()
    displacement.view(-1, 3)[slots] = torch.stack((x + along * heading[0], y + along * heading[1], up), 1)
    return replace(estimates, displacement=displacement)


def _draw(pair: Tensor, row: Tensor, col: Tensor, size: Tensor) -> Images:
    """Draw points into one image per pair; a pixel that several points hit is set once."""
    area = size[:, 0] * size[:, 1]
    end = area.cumsum(0)
    key = torch.unique((end - area)[pair] + row * size[pair, 1] + col)
    pair = torch.searchsorted(end, key, right=True)
    pixel = key - (end - area)[pair]
    return Images(pair, pixel // size[pair, 1], pixel % size[pair, 1])
