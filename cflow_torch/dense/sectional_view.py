"""Vertical motion from the sectional view (second half of Alg. scene_flow_1obj), all clusters at once."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from cflow_torch.config import DenseConfig
from cflow_torch.dense.correlation import Estimates, best_shifts
from cflow_torch.dense.projection import ProjectedSweeps
from cflow_torch.dense.templates import Images, TemplatePairs
from cflow_torch.ops.segments import bounding_boxes


def add_sectional_view(
    estimates: Estimates, cluster: Tensor, sweeps: ProjectedSweeps, config: DenseConfig
) -> Estimates:
    """Estimates with f_z, and with f_x, f_y corrected along the heading.

    Args:
        estimates: from the BEV, of M clusters.
        cluster: (P,) int32 or int64, cluster of each point, M = none.
        sweeps: whose points have three axes.
        config: `correlation`, `max_memory`.

    Returns:
        The same with other displacements.

    Convention:
        The heading is the direction of (f_x, f_y), the x axis if that is zero. The X-Z images lie on one grid through
        the origin, cut to the bounding box of the pair. Ties: smallest shift, then smallest dz, then smallest dx'.

    Source: Alg. scene_flow_1obj.
    """
    available, positions, pixel_size = estimates.available, sweeps.positions(), sweeps.grid.pixel_size
    step = sweeps.batch.image % sweeps.batch.num_steps
    num_sources = available.shape[1]
    slots = available.flatten().nonzero()[:, 0]  # one pair per cluster and sweep
    flow = estimates.displacement.view(-1, 3)[slots]
    pair_of_slot = torch.full((available.numel(),), -1, dtype=torch.int64, device=slots.device)
    pair_of_slot[slots] = torch.arange(slots.numel(), device=slots.device)

    x, y = flow[:, 0], flow[:, 1]
    length = torch.sqrt(x * x + y * y)
    safe = torch.where(length > 0, length, torch.ones_like(length))
    heading = torch.stack((torch.where(length > 0, x / safe, torch.ones_like(x)), y / safe))

    cluster = cluster.long()
    member = cluster < len(available)
    older = (member & (step > 0)).nonzero()[:, 0]
    template_pair = pair_of_slot[cluster[older] * num_sources + step[older] - 1]
    moved = positions[:, older].clone()
    moved[:2] += flow.t()[:2, template_pair]
    newest = (member & (step == 0)).nonzero()[:, 0]
    # Every pair turns its cluster's target by its own heading: one copy of the target's points per pair.
    target_point, target_pair = _copies(cluster[newest], slots // num_sources, available.sum(1))
    target = positions[:, newest[target_point]]

    pair = torch.cat((template_pair, target_pair))
    row, col = _project(torch.cat((moved, target), 1), heading[:, pair], pixel_size)
    first, size = bounding_boxes(row, col, pair, slots.numel())
    row, col = row - first[pair, 0], col - first[pair, 1]
    split = template_pair.numel()
    pairs = TemplatePairs(
        template=Images(*_distinct(pair[:split], row[:split], col[:split], size)),
        target=Images(*_distinct(pair[split:], row[split:], col[split:], size)),
        cluster=torch.arange(slots.numel(), device=slots.device),
        source=slots % num_sources,
        size=size,
    )
    shift, _ = best_shifts(pairs, config.correlation, config.max_memory)
    along, up = shift[:, 1].double() * pixel_size, shift[:, 0].double() * pixel_size
    displacement = estimates.displacement.clone().view(-1, 3)
    displacement[slots, 0] = x + along * heading[0]
    displacement[slots, 1] = y + along * heading[1]
    displacement[slots, 2] = up
    return replace(estimates, displacement=displacement.view_as(estimates.displacement))


def _project(positions: Tensor, heading: Tensor, pixel_size: float) -> tuple[Tensor, Tensor]:
    """(row, col) of points in the X-Z view: rotation by minus the heading, then Eq. 3d_to_bev on (x', z)."""
    size = torch.full((), pixel_size, dtype=positions.dtype, device=positions.device)
    along = heading[0] * positions[0] + heading[1] * positions[1]
    return torch.floor(positions[2] / size).long(), torch.floor(along / size).long()


def _copies(cluster_of_point: Tensor, cluster_of_pair: Tensor, pairs_of_cluster: Tensor) -> tuple[Tensor, Tensor]:
    """Each point once for every pair of its cluster: (point, pair), where pairs are sorted by cluster."""
    repeats = pairs_of_cluster[cluster_of_point]
    point = torch.repeat_interleave(torch.arange(repeats.numel(), device=repeats.device), repeats)
    start = torch.searchsorted(cluster_of_pair, cluster_of_point)
    place = torch.arange(point.numel(), device=point.device) - (repeats.cumsum(0) - repeats)[point]
    return point, start[point] + place


def _distinct(pair: Tensor, row: Tensor, col: Tensor, size: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Pixels that are hit at least once, each once."""
    area = size[:, 0] * size[:, 1]
    end = area.cumsum(0)
    key = torch.unique((end - area)[pair] + row * size[pair, 1] + col)
    pair = torch.searchsorted(end, key, right=True)
    place = key - (end - area)[pair]
    return pair, place // size[pair, 1], place % size[pair, 1]
