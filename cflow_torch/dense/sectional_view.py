"""Vertical motion from the sectional view (second half of Alg. scene_flow_1obj), all clusters at once."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor

from cflow_torch.config import DenseConfig
from cflow_torch.dense.clustering import cluster_boxes
from cflow_torch.dense.coarse_to_fine import ProjectedSweeps
from cflow_torch.dense.correlation import Estimates, best_shifts
from cflow_torch.dense.templates import Images, TemplatePairs
from cflow_torch.ops.groups import Groups
from cflow_torch.ops.indices import concat_ranges, divide, flat_nonzero, renumber


def add_sectional_view(
    estimates: Estimates, cluster: Tensor, sweeps: ProjectedSweeps, config: DenseConfig
) -> Estimates:
    """Add f_z to the estimates of M clusters, and correct f_x and f_y along the heading (Alg. scene_flow_1obj).

    `cluster` is the cluster of each point, (P,) int, M = none. The points have three axes. The heading is the direction
    of (f_x, f_y), or the x axis if both are zero. All X-Z images lie on one grid through the origin, and each is cut to
    the bounding box of its pair. Ties: smallest shift, then smallest dz, then smallest dx'.
    """
    pairs = _Pairs.of(estimates)
    members = _Members(
        positions=sweeps.positions(), step=sweeps.batch.image % sweeps.batch.num_steps, cluster=cluster.long()
    )
    shift, _ = best_shifts(_draw_pairs(pairs, members, sweeps.grid.pixel_size), config.correlation, config.max_memory)
    up, along = (shift.double() * sweeps.grid.pixel_size).unbind(1)
    x = pairs.flow[:, 0] + along * pairs.heading[0]
    y = pairs.flow[:, 1] + along * pairs.heading[1]
    displacement = estimates.displacement.clone()
    displacement.view(-1, 3)[pairs.slot] = torch.stack((x, y, up), 1)
    return replace(estimates, displacement=displacement)


class _Pairs(NamedTuple):
    """J pairs of a cluster and an earlier sweep in which it has pixels, in order of cluster, then of sweep."""

    slot: Tensor  # (J,) int64, cluster * K + sweep of each pair
    flow: Tensor  # (J, 3) float64, metres, from the sweep to t+1
    heading: Tensor  # (2, J) float64
    available: Tensor  # (M, K) bool, whether there is a pair

    @classmethod
    def of(cls, estimates: Estimates) -> _Pairs:
        """Collect the pairs that have an estimate."""
        slot = flat_nonzero(estimates.available)
        flow = estimates.displacement.view(-1, 3)[slot]
        return cls(slot, flow, _heading(flow), estimates.available)


class _Members(NamedTuple):
    """The points of the sweeps."""

    positions: Tensor  # (3, P) float64, metres, frame of t+1
    step: Tensor  # (P,) int, sweep of each point: 0 = t+1, 1 = t, ...
    cluster: Tensor  # (P,) int64, cluster of each point, M = none


def _heading(flow: Tensor) -> Tensor:
    """Return the unit vectors along x and y of the flow of J pairs, (2, J); the x axis where both are zero."""
    x = flow[:, 0]
    y = flow[:, 1]
    length = torch.sqrt(x * x + y * y)
    is_moving = length > 0
    one = torch.ones_like(length)
    divisor = torch.where(is_moving, length, one)
    return torch.stack((torch.where(is_moving, x / divisor, one), y / divisor))


def _draw_pairs(pairs: _Pairs, members: _Members, pixel_size: float) -> TemplatePairs:
    """Draw the X-Z images of J pairs. Each rotates its own copy of the target by its own heading."""
    template = _template_points(pairs, members)
    target = _target_points(pairs, members)
    pair = torch.cat((template.pair, target.pair))
    row_col = _project(torch.cat((template.positions, target.positions), 1), pairs.heading[:, pair], pixel_size)
    first, size = cluster_boxes(Groups(pair, len(pairs.slot)), row_col)
    row_col -= first[pair].t()
    of_template, of_target = row_col.split((len(template.pair), len(target.pair)), 1)
    return TemplatePairs(
        template=_draw(template.pair, of_template, size),
        target=_draw(target.pair, of_target, size),
        cluster=torch.arange(len(pairs.slot), device=pair.device),
        source=pairs.slot % pairs.available.shape[1],
        size=size,
    )


class _PointsOfPairs(NamedTuple):
    """K points to draw."""

    pair: Tensor  # (K,) int64
    positions: Tensor  # (3, K) float64, metres, frame of t+1


def _template_points(pairs: _Pairs, members: _Members) -> _PointsOfPairs:
    """Return the points of earlier sweeps, moved by their flow."""
    num_clusters, num_sources = pairs.available.shape
    points = flat_nonzero((members.cluster < num_clusters) & (members.step > 0))
    slot = members.cluster[points] * num_sources + members.step[points] - 1
    pair = renumber(pairs.slot, num_clusters * num_sources)[slot]
    positions = members.positions[:, points].clone()
    positions[:2] += pairs.flow.t()[:2, pair]
    return _PointsOfPairs(pair, positions)


def _target_points(pairs: _Pairs, members: _Members) -> _PointsOfPairs:
    """Return the points of t+1: a copy for each pair."""
    num_clusters, num_sources = pairs.available.shape
    points = flat_nonzero((members.cluster < num_clusters) & (members.step == 0))
    cluster = members.cluster[points]
    num_copies = pairs.available.sum(1)[cluster]
    first_pair = torch.searchsorted(pairs.slot // num_sources, cluster)
    return _PointsOfPairs(
        pair=concat_ranges(first_pair, num_copies),
        positions=members.positions[:, points.repeat_interleave(num_copies)],
    )


def _project(positions: Tensor, heading: Tensor, pixel_size: float) -> Tensor:
    """Rotate points, (3, K), by minus the heading and apply Eq. 3d_to_bev to (x', z): row and column, (2, K) int64."""
    x, y, z = positions
    along = heading[0] * x + heading[1] * y
    return divide(torch.stack((z, along)), pixel_size).floor().long()


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
