"""Motion candidates of the nodes of the component tree.

The candidates of a node are its correlation peaks with each sweep, their median, and the medians of the coarser nodes
around it.
"""

from __future__ import annotations

from typing import NamedTuple, Sequence

import torch
import torch.nn.functional as F
from torch import Tensor

from cflow_torch.config import VerifiedConfig
from cflow_torch.dense.clustering import Clusters
from cflow_torch.dense.clustering import Pixels as ClusterPixels
from cflow_torch.dense.correlation import Estimates, best_shifts
from cflow_torch.dense.templates import TemplatePairs, make_pairs
from cflow_torch.ops.indices import (
    constant,
    flat_nonzero,
    gather,
    lazy_empty,
    lazy_zeros,
    lookup,
    scatter_count,
    take_columns,
)
from cflow_torch.ops.segments import masked_median, segment_minmax
from cflow_torch.verified.component_tree import Components, Nodes
from cflow_torch.verified.height_slices import OWN, HeightSlicedSweeps, count_slices

# A node whose box has more pixels is correlated at a coarser scale. Its children are correlated at the finer scales.
_LARGEST_BOX = 1 << 12


class Candidates(NamedTuple):
    """Motion candidates of N nodes."""

    motion: Tensor  # (N, C, 2) float64, (y, x), finest pixels per sweep interval; 0 = unknown
    score: Tensor  # (N,) float32, NCC with the nearest sweep in which the node has pixels


def propose(nodes: Nodes, components: Components, sweeps: HeightSlicedSweeps, config: VerifiedConfig) -> Candidates:
    """Return the candidates of all nodes, each correlated at its own pixel size.

    Convention: a peak at shift 0 is not refined. The parabola is fitted to counts of slices of the node's own pixels.
        We take the median of y and the median of x if any window has at least two sweeps besides t+1. The median of a
        single estimate is that estimate, so a pair gets the same motion in any batch.

    Source: adapted from Sec. leverage_past_pcs, which takes the medians of magnitude and of orientation.
    """
    images = _NodeImages.of(nodes, components.blocks, sweeps)
    clusters = Clusters(nodes.window, images.first, images.size, images.pixels)
    pairs = make_pairs(clusters, sweeps.batch, images.block.double() * sweeps.grid.pixel_size, config.max_speed)
    shift, score = best_shifts(pairs, config.correlation, config.max_memory)
    peak = shift + _parabola(images, pairs, shift)
    peak *= images.block.index_select(0, pairs.cluster)[:, None]
    estimates = Estimates.of(pairs, peak, score, sweeps.elapsed.index_select(0, nodes.window)[:, 1:])

    own = estimates.per_interval().masked_fill_(~estimates.available[:, :, None], 0.0)
    if sweeps.num_steps > 2:
        own = torch.cat((masked_median(own, estimates.available)[:, None], own), 1)
    own = own + 0.0  # turns -0.0 into 0.0
    parent = F.pad(nodes.parent, (0, 1), value=nodes.count)
    around = [nodes.parent]
    for _ in range(components.num_levels - 2):
        around.append(parent.index_select(0, around[-1]))
    others = lookup(own[:, 0], torch.cat(around)).view(len(around), nodes.count, 2).transpose(0, 1)
    return Candidates(torch.cat((own, others), 1), estimates.newest_score())


class _NodeImages(NamedTuple):
    """A small image of each of N nodes for each of S sweeps, at the scale at which the node is correlated."""

    block: Tensor  # (N,) int64, side of a pixel in finest pixels
    first: Tensor  # (N, 2) int64, top-left (row, col) of the box over all sweeps, in pixels of the scale
    size: Tensor  # (N, 2) int64, height and width of the box
    start: Tensor  # (N,) int64, where the images of each node begin in `image`
    image: Tensor  # (I,) uint8, slices of the pixels of all images, one image after the other
    pixels: ClusterPixels  # the Q occupied pixels of the images
    occupied: Tensor  # (Q,) int64, index of each occupied pixel into `image`

    @classmethod
    def of(cls, nodes: Nodes, blocks: Sequence[int], sweeps: HeightSlicedSweeps) -> _NodeImages:
        """Draw the nodes.

        Convention: a node has the scale of its level, unless its box has more than `_LARGEST_BOX` pixels there. Then it
            has the finest scale at which the box fits, or the coarsest if it fits nowhere.
        """
        members, node, device = sweeps.pixels.take(nodes.pixel), nodes.node, nodes.node.device
        block = constant(tuple(blocks), torch.int64, device)
        ends = torch.cat(segment_minmax(members.row_col, node, nodes.count)).t()[:, None]
        ends = torch.div(ends, block[:, None], rounding_mode="floor")  # (N, scales, 4)
        sizes = ends[:, :, 2:] - ends[:, :, :2] + 1
        num_small = (sizes.prod(2) <= _LARGEST_BOX).sum(1)  # these come first, because scales are coarse to fine
        scale = torch.minimum(nodes.level.clamp(max=len(blocks) - 1), (num_small - 1).clamp(min=0))
        at = (torch.arange(nodes.count, device=device), scale)
        block, first, size = block[scale], ends[at][:, :2], sizes[at]
        area = size.prod(1) * sweeps.num_steps
        end = area.cumsum(0)

        # Several finest pixels may fall into one pixel of the scale. They are equal there, so any of them may remain.
        begin = end - area
        table = torch.stack((begin, block, *size.unbind(1), *first.unbind(1)))
        of_member = take_columns(table, node)
        start, side, height, width = of_member[:4]
        pixel = torch.div(members.row_col, side, rounding_mode="floor")
        row, col = pixel - of_member[4:]
        index = (members.step * height + row).mul_(width).add_(start).add_(col)
        total = int(end[-1]) if nodes.count else 0
        # At coarser scales, all slices of a pixel are set.
        slices = members.slices.masked_fill(side > 1, OWN)
        image = lazy_zeros(total, torch.uint8, device).index_copy_(0, index, slices)
        member = torch.arange(len(node), dtype=torch.int32, device=device)
        member = lazy_empty(total, torch.int32, device).scatter_(0, index, member)
        drawn = flat_nonzero(image)
        member = member.index_select(0, drawn).long()
        pixels = ClusterPixels(*gather(member, node, members.step, *pixel))
        return cls(block, first, size, begin, image, pixels, drawn)


def _parabola(images: _NodeImages, pairs: TemplatePairs, shift: Tensor) -> Tensor:
    """Return the sub-pixel offset of each peak, (J, 2) float64, (y, x), pixels of its scale.

    `shift` is the shift of each peak, (J, 2). The offset is the vertex of the parabolas through the counts of common
    slices at the peak and at its four neighbours, at most half a pixel. It is 0 for pairs whose peak is at shift 0, and
    where a parabola is not concave.
    """
    is_moved = shift.any(1)
    template = pairs.template
    assert pairs.pixel is not None
    some = flat_nonzero(is_moved.index_select(0, template.image))
    pair, row, col, pixel = gather(some, template.image, template.row, template.col, pairs.pixel)
    node = pairs.cluster.index_select(0, pair)
    start, size = images.start.index_select(0, node), images.size.index_select(0, node).t()
    beside = constant(((0, -1, 1, 0, 0), (0, 0, 0, -1, 1)), torch.int64, shift.device)
    peak = torch.stack((row, col)) + shift.index_select(0, pair).t()
    at = peak[:, None] + beside[..., None]  # (2, 5, pixels)
    is_row, is_col = (at >= 0) & (at < size[:, None])
    inside = is_row & is_col
    index = (at[0] * size[1]).add_(at[1]).add_(start).mul_(inside)
    own = images.image.index_select(0, images.occupied.index_select(0, pixel))
    target = images.image.index_select(0, index.view(-1)).view_as(index)
    sums = scatter_count(pair, len(shift), count_slices(own & target) * inside)
    # Counts at the peak, before it (above, left) and after it (below, right).
    middle, low, high = sums[:1], sums[1::2], sums[2::2]
    curve = (2 * middle - low - high).double()
    vertex = ((high - low) / (2 * curve)).masked_fill_(curve <= 0, 0.0).clamp_(-0.5, 0.5)
    return (vertex * is_moved).t()
