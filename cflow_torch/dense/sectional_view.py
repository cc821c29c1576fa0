"""Vertical motion from the sectional view (second half of Alg. scene_flow_1obj), all clusters at once."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from cflow_torch.config import DenseConfig
from cflow_torch.dense.coarse_to_fine import ProjectedSweeps
from cflow_torch.dense.correlation import Estimates, best_shifts
from cflow_torch.dense.templates import Images, TemplatePairs
from cflow_torch.ops.indices import concat_ranges, flat_nonzero, renumber
from cflow_torch.ops.segments import bounding_boxes


def add_sectional_view(
    estimates: Estimates, cluster: Tensor, sweeps: ProjectedSweeps, config: DenseConfig
) -> Estimates:
    """Add f_z to the estimates of M clusters, and correct f_x and f_y along the heading (Alg. scene_flow_1obj).

    `cluster` is the cluster of each point, (P,) int, M = none. The points have three axes. The heading is the direction
    of (f_x, f_y), or the x axis if both are zero. All X-Z images lie on one grid through the origin, and each is cut to
    the bounding box of its pair. Ties: smallest shift, then smallest dz, then smallest dx'.
    """
    pixel_size = sweeps.grid.pixel_size
    slots = flat_nonzero(estimates.available)  # [J], one pair per cluster and sweep
    flow = estimates.displacement.view(-1, 3)[slots]
    heading = _heading(flow)
    pairs = _section_pairs(slots, flow, heading, estimates.available, cluster.long(), sweeps)
    shift, _ = best_shifts(pairs, config.correlation, config.max_memory)
    up, along = (shift.double() * pixel_size).unbind(1)
    corrected = torch.stack((flow[:, 0] + along * heading[0], flow[:, 1] + along * heading[1], up), 1)
    displacement = estimates.displacement.clone()
    displacement.view(-1, 3)[slots] = corrected
    return replace(estimates, displacement=displacement)


def _heading(flow: Tensor) -> Tensor:
    """Return the unit vectors along x and y of the flow of J pairs, (2, J); the x axis where both are zero."""
    x, y = flow[:, 0], flow[:, 1]
    length = torch.sqrt(x * x + y * y)
    is_moving = length > 0
    divisor = torch.where(is_moving, length, torch.ones_like(length))
    return torch.stack((torch.where(is_moving, x / divisor, torch.ones_like(x)), y / divisor))


def _section_pairs(
    slots: Tensor, flow: Tensor, heading: Tensor, available: Tensor, cluster: Tensor, sweeps: ProjectedSweeps
) -> TemplatePairs:
    """Draw the X-Z images of J pairs. Each rotates its own copy of the target by its own heading.

    Args:
        slots: (J,) int64, cluster * K + sweep of each pair, ascending.
        flow, heading: (J, 3) and (2, J) float64.
        available: (M, K) bool.
        cluster: (P,) int64, cluster of each point, M = none.
        sweeps: the points.
    """
    positions = sweeps.positions()
    num_sources = available.shape[1]
    step = sweeps.batch.image % sweeps.batch.num_steps
    is_member = cluster < len(available)
    older = flat_nonzero(is_member & (step > 0))
    pair_of_slot = renumber(slots, available.numel())
    template_pair = pair_of_slot[cluster[older] * num_sources + step[older] - 1]
    template = positions[:, older].clone()
    template[:2] += flow.t()[:2, template_pair]

    newest = flat_nonzero(is_member & (step == 0))
    copies = available.sum(1)[cluster[newest]]
    target = positions[:, newest.repeat_interleave(copies)]
    first_pair = torch.searchsorted(slots // num_sources, cluster[newest])
    target_pair = concat_ranges(first_pair, copies)

    pair = torch.cat((template_pair, target_pair))
    row_col = _project(torch.cat((template, target), 1), heading[:, pair], sweeps.grid.pixel_size)
    first, size = bounding_boxes(row_col[0], row_col[1], pair, len(slots))
    row_col -= first[pair].t()
    split = len(template_pair)
    return TemplatePairs(
        template=_draw(template_pair, row_col[:, :split], size),
        target=_draw(target_pair, row_col[:, split:], size),
        cluster=torch.arange(len(slots), device=slots.device),
        source=slots % num_sources,
        size=size,
    )


def _project(positions: Tensor, heading: Tensor, pixel_size: float) -> Tensor:
    """Rotate points, (3, K), by minus the heading and apply Eq. 3d_to_bev to (x', z): row and column, (2, K) int64."""
    x, y, z = positions
    along = heading[0] * x + heading[1] * y
    # A tensor, because a GPU multiplies by the reciprocal of a plain number, which rounds differently.
    side = torch.full((), pixel_size, dtype=z.dtype, device=z.device)
    return torch.floor(torch.stack((z, along)) / side).long()


def _draw(pair: Tensor, row_col: Tensor, size: Tensor) -> Images:
    """Draw points, (2, K) int64, into one image per pair; a pixel that several points hit is set once.

    The images follow each other: image 0 in raster order, image 1, ...
    """
    width = size[:, 1]
    end = (size[:, 0] * width).cumsum(0)
    start = end - size[:, 0] * width
    sample = torch.unique(start[pair] + row_col[0] * width[pair] + row_col[1])
    image = torch.searchsorted(end, sample, right=True)
    pixel = sample - start[image]
    return Images(image=image, row=pixel // width[image], col=pixel % width[image])
