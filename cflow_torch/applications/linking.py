"""Which points are which object's: groups of two sweeps that share voxels, one to one; points inside boxes."""

from __future__ import annotations

import torch
from torch import Tensor

from cflow_torch.ops.segments import first_of_segment

VOXEL = (0.3, 0.3, 0.9)  # metres; high, because beams meet an object at other heights in each sweep


def link(points0: Tensor, group0: Tensor, points1: Tensor, group1: Tensor, least: float) -> tuple[Tensor, Tensor]:
    """Pairs of groups that overlap, one to one.

    Args:
        points0: (N0, 3) float64, metres: where the points of the earlier groups should be now.
        group0: (N0,) int64, group of each, from 0.
        points1, group1: the same of the groups that are there, in the same frame.
        least: share of common voxels (of those of either group, intersection over union) below which no pair is made.

    Returns:
        (K,) int64 earlier groups and (K,) int64 groups that are there.

    Convention:
        Greedy: the pair of the largest share first; of equals that of the smaller earlier group, then of the smaller
        other one.

    Cost: three sorts of the points; rounds until nothing is left, mostly two or three.
    """
    voxel0, voxel1 = _voxels(points0, points1)
    own0, size0 = _distinct(group0, voxel0)
    own1, size1 = _distinct(group1, voxel1)
    own1 = own1[:, own1[1].argsort(stable=True)]
    begin, end = (torch.searchsorted(own1[1], own0[1].contiguous(), right=right) for right in (False, True))
    count = end - begin
    first = count.cumsum(0) - count
    at = torch.arange(int(count.sum()), device=count.device) + (begin - first).repeat_interleave(count)
    pairs = torch.stack([own0[0].repeat_interleave(count), own1[0].index_select(0, at)])
    pairs, shared = torch.unique(pairs, dim=1, return_counts=True)
    share = shared / (size0[pairs[0]] + size1[pairs[1]] - shared)
    order = share.argsort(descending=True, stable=True)
    earlier, later = pairs[:, order[share[order] >= least]]
    taken = [pairs[:, :0]]
    while earlier.numel():
        position = torch.arange(len(earlier), device=earlier.device)
        best = (first_of_segment(earlier, int(earlier.max()) + 1) == position) & (
            first_of_segment(later, int(later.max()) + 1) == position
        )
        taken.append(torch.stack([earlier[best], later[best]]))
        left = ~(torch.isin(earlier, earlier[best]) | torch.isin(later, later[best]))
        earlier, later = earlier[left], later[left]
    found = torch.cat(taken, 1)
    return found[0], found[1]


def box_of_point(points: Tensor, centre: Tensor, size: Tensor, heading: Tensor) -> Tensor:
    """(N,) int64 number of the first box that holds each point, -1 = none.

    Args:
        points: (N, 3) float64, metres.
        centre, size: (K, 3) metres; size is length along the heading, width, height.
        heading: (K,) radians from +x.

    Cost: K * N comparisons.
    """
    found = torch.full((len(points),), -1, device=points.device)
    if not len(centre) or not len(points):
        return found
    offset = points[None] - centre[:, None]
    along, across = turned(offset[..., 0], offset[..., 1], -heading[:, None])
    inside = (along.abs() <= size[:, None, 0] / 2) & (across.abs() <= size[:, None, 1] / 2)
    inside &= offset[..., 2].abs() <= size[:, None, 2] / 2
    return torch.where(inside.any(0), inside.to(torch.uint8).argmax(0), found)


def boxes(points: Tensor, group: Tensor, heading: Tensor) -> tuple[Tensor, Tensor]:
    """Centre and size, (K, 3) float64 each, of the upright boxes along `heading` (K,) that hold groups (N,) of points.

    No group may be empty.
    """
    along, across = turned(points[:, 0], points[:, 1], -heading[group])
    local = torch.stack([along, across, points[:, 2]], 1)
    index, ends = group[:, None].expand(-1, 3), local.new_zeros(len(heading), 3)
    low = ends.scatter_reduce(0, index, local, "amin", include_self=False)
    high = ends.scatter_reduce(0, index, local, "amax", include_self=False)
    middle = (low + high) / 2
    return torch.stack([*turned(middle[:, 0], middle[:, 1], heading), middle[:, 2]], 1), high - low


def turned(x: Tensor, y: Tensor, angle: Tensor) -> tuple[Tensor, Tensor]:
    """x, y after a turn by `angle` radians to the left."""
    cos, sin = angle.cos(), angle.sin()
    return cos * x - sin * y, sin * x + cos * y


def _voxels(points0: Tensor, points1: Tensor) -> tuple[Tensor, Tensor]:
    """(N0,), (N1,) int64: number of the voxel of each point, the same in both."""
    both = torch.cat([points0, points1])
    voxel = (both / both.new_tensor(VOXEL)).floor().long()
    number = torch.unique(voxel, dim=0, return_inverse=True)[1]
    return number[: len(points0)], number[len(points0) :]


def _distinct(group: Tensor, voxel: Tensor) -> tuple[Tensor, Tensor]:
    """(2, V) int64 (group, voxel) without repetition, sorted; number of voxels of each group."""
    own = torch.unique(torch.stack([group, voxel]), dim=1)
    return own, torch.bincount(own[0])
