"""Vertical motion from the sectional view (second half of Alg. scene_flow_1obj), all clusters at once."""

from __future__ import annotations

from typing import Tuple

import torch
from torch import Tensor

from cflow_torch.config import Config
from cflow_torch.dense.correlation import best_shifts
from cflow_torch.dense.packing import Images
from cflow_torch.ops.exact import exact_sqrt
from cflow_torch.ops.segments import bounding_boxes


def add_sectional_view(
    estimates: Tensor,
    available: Tensor,
    positions: Tensor,
    cluster: Tensor,
    step: Tensor,
    pixel_size: float,
    config: Config,
) -> Tensor:
    """Estimates with f_z, and with f_x, f_y corrected along the heading.

    Args:
        estimates: (M, K, 3) float64, metres m -> t+1 from the BEV, nearest sweep first.
        available: (M, K) bool, which estimates exist.
        positions: (3, P) float64, metres, frame of t+1, as they were projected to the BEV.
        cluster: (P,) int32 or int64, cluster of each point, M = none.
        step: (P,) int64, 0 = sweep t+1, 1 = t, ...
        pixel_size: s, metres.
        config: `correlation`.

    Returns:
        (M, K, 3) float64.

    Convention:
        The heading is the direction of (f_x, f_y), the x axis if that is zero. The X-Z images lie on one grid through
        the origin, cut to the bounding box of the pair. Ties: smallest shift, then smallest dz, then smallest dx'.

    Source: Alg. scene_flow_1obj.
    """
    num_sources = available.shape[1]
    slots = available.flatten().nonzero()[:, 0]  # one job per cluster and sweep
    flow = estimates.view(-1, 3)[slots]
    job_of_slot = torch.full((available.numel(),), -1, dtype=torch.int64, device=slots.device)
    job_of_slot[slots] = torch.arange(slots.numel(), device=slots.device)

    x, y = flow[:, 0], flow[:, 1]
    length = exact_sqrt(x * x + y * y)
    safe = torch.where(length > 0, length, torch.ones_like(length))
    heading = torch.stack((torch.where(length > 0, x / safe, torch.ones_like(x)), y / safe))

    cluster = cluster.long()
    member = cluster < len(available)
    older = (member & (step > 0)).nonzero()[:, 0]
    template_job = job_of_slot[cluster[older] * num_sources + step[older] - 1]
    moved = positions[:, older].clone()
    moved[:2] += flow.t()[:2, template_job]
    newest = (member & (step == 0)).nonzero()[:, 0]
    # Every job turns its cluster's target by its own heading: one copy of the target's points per job.
    target_point, target_job = _copies(cluster[newest], slots // num_sources, available.sum(1))
    target = positions[:, newest[target_point]]

    job = torch.cat((template_job, target_job))
    row, col = _project(torch.cat((moved, target), 1), heading[:, job], pixel_size)
    first, size = bounding_boxes(row, col, job, slots.numel())
    row, col = row - first[job, 0], col - first[job, 1]
    split = template_job.numel()
    shift, _ = best_shifts(
        Images(*_distinct(job[:split], row[:split], col[:split], size)),
        Images(*_distinct(job[split:], row[split:], col[split:], size)),
        torch.arange(slots.numel(), device=slots.device),
        size,
        engine=config.correlation,
        max_memory=config.max_memory,
    )
    along, up = shift[:, 1].double() * pixel_size, shift[:, 0].double() * pixel_size
    result = estimates.clone().view(-1, 3)
    result[slots, 0] = x + along * heading[0]
    result[slots, 1] = y + along * heading[1]
    result[slots, 2] = up
    return result.view_as(estimates)


def _project(positions: Tensor, heading: Tensor, pixel_size: float) -> Tuple[Tensor, Tensor]:
    """(row, col) of points in the X-Z view: rotation by minus the heading, then Eq. 3d_to_bev on (x', z)."""
    size = torch.full((), pixel_size, dtype=positions.dtype, device=positions.device)
    along = heading[0] * positions[0] + heading[1] * positions[1]
    return torch.floor(positions[2] / size).long(), torch.floor(along / size).long()


def _copies(cluster_of_point: Tensor, cluster_of_job: Tensor, jobs_of_cluster: Tensor) -> Tuple[Tensor, Tensor]:
    """Each point once for every job of its cluster: (point, job), where jobs are sorted by cluster."""
    repeats = jobs_of_cluster[cluster_of_point]
    point = torch.repeat_interleave(torch.arange(repeats.numel(), device=repeats.device), repeats)
    start = torch.searchsorted(cluster_of_job, cluster_of_point)
    place = torch.arange(point.numel(), device=point.device) - (repeats.cumsum(0) - repeats)[point]
    return point, start[point] + place


def _distinct(job: Tensor, row: Tensor, col: Tensor, size: Tensor) -> Tuple[Tensor, Tensor, Tensor]:
    """Pixels that are hit at least once, each once."""
    area = size[:, 0] * size[:, 1]
    end = area.cumsum(0)
    key = torch.unique((end - area)[job] + row * size[job, 1] + col)
    job = torch.searchsorted(end, key, right=True)
    place = key - (end - area)[job]
    return job, place // size[job, 1], place % size[job, 1]
