"""Motion candidates of the nodes of the component tree.

The candidates of a node are its correlation peaks with each sweep, their median, and the median of its parent.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple, Sequence

import torch
from torch import Tensor

from cflow_torch.config import VerifiedConfig
from cflow_torch.dense.clustering import ClusterPixels, Clusters
from cflow_torch.dense.correlation import Estimates, best_shifts
from cflow_torch.dense.templates import TemplatePairs, make_pairs
from cflow_torch.ops.groups import FAR, Groups
from cflow_torch.ops.indices import constant, flat_nonzero, gather, lazy_empty, lazy_zeros
from cflow_torch.ops.medians import masked_median
from cflow_torch.verified.columns import OWN, Pixels, count_slices
from cflow_torch.verified.component_tree import Tree
from cflow_torch.verified.height_slices import HeightSlicedSweeps

# A node whose box has more pixels is correlated at a coarser scale. Its children are correlated at the finer scales.
_LARGEST_BOX = 1 << 12


class Candidates(NamedTuple):
    """Motion candidates of N nodes."""

    motion: Tensor  # (N, C, 2) float64, (y, x), finest pixels per sweep interval; 0 = unknown
    score: Tensor  # (N,) float32, NCC with the nearest sweep in which the node has pixels


def propose(sweeps: HeightSlicedSweeps, tree: Tree, blocks: Sequence[int], config: VerifiedConfig) -> Candidates:
    """Return the candidates of all nodes, each correlated at its own pixel size.

    Convention: a peak at shift 0 is not refined. The parabola is fitted to counts of slices of the node's own pixels.
        We take the median of y and the median of x if any window has at least two sweeps besides t+1. The median of a
        single estimate is that estimate, so a pair gets the same motion in any batch.

    Source: adapted from Sec. leverage_past_pcs, which takes the medians of magnitude and of orientation.
    """
    images = _NodeImages.of(sweeps, tree, blocks)
    boxes = images.boxes
    clusters = Clusters(tree.window, boxes.top_left, boxes.size, images.pixels)
    pairs = make_pairs(clusters, sweeps.batch, boxes.block.double() * sweeps.grid.pixel_size, config.max_speed)
    shift, score = best_shifts(pairs, config.correlation, config.max_memory)
    peak = shift + _parabola(images, pairs, shift)
    peak *= boxes.block.index_select(0, pairs.cluster)[:, None]
    estimates = Estimates.of(pairs, peak, score, sweeps.elapsed.index_select(0, tree.window)[:, 1:])

    motion = estimates.per_interval().masked_fill_(~estimates.available[:, :, None], 0.0)
    if sweeps.num_steps > 2:
        motion = torch.cat((masked_median(motion, estimates.available)[:, None], motion), 1)
    motion = motion + 0.0  # turns -0.0 into 0.0
    # A fast object has no parent: its velocity takes this place.
    of_parent = tree.by_parent.spread(motion[:, 0]) + tree.linked_velocity
    return Candidates(torch.cat((motion, of_parent[:, None]), 1), estimates.newest_score())


@dataclass(frozen=True)
class _Boxes:
    """The boxes of nodes over all sweeps, in pixels of the scale at which each node is correlated."""

    # (N, 6) int64: side of a pixel in finest pixels, where the images of the node begin, top and left of its box, and
    # height and width of the box.
    table: Tensor
    num_samples: int  # I, of the images of all nodes

    @property
    def block(self) -> Tensor:
        """(N,) int64, side of a pixel in finest pixels."""
        return self.table[:, 0]

    @property
    def start(self) -> Tensor:
        """(N,) int64, first sample of the images of each node."""
        return self.table[:, 1]

    @property
    def top_left(self) -> Tensor:
        """(N, 2) int64."""
        return self.table[:, 2:4]

    @property
    def size(self) -> Tensor:
        """(N, 2) int64, height and width."""
        return self.table[:, 4:]

    def __getitem__(self, node: Tensor) -> _Boxes:
        """Select the boxes of K nodes, (K,) int64."""
        return _Boxes(self.table.index_select(0, node), self.num_samples)

    def sample_at(self, step: Tensor, row_col: Tensor) -> Tensor:
        """Return a sample of each node, (N,) int64: that of a sweep, (N,), and a pixel of the scale, (2, N)."""
        height, width = self.size.t()
        row, col = row_col - self.top_left.t()
        return self.start + (step * height + row) * width + col


@dataclass(frozen=True)
class _NodeImages:
    """A small image of each of N nodes for each of S sweeps, at the scale at which the node is correlated.

    All images lie one after the other in `slices`: node by node, sweep by sweep, row by row.
    """

    boxes: _Boxes
    slices: Tensor  # (I,) uint8
    pixels: ClusterPixels  # the Q occupied pixels of the images
    slices_of_pixel: Tensor  # (Q,) uint8

    @classmethod
    def of(cls, sweeps: HeightSlicedSweeps, tree: Tree, blocks: Sequence[int]) -> _NodeImages:
        """Draw the nodes. At coarser scales, all slices of a pixel are set."""
        node = tree.members.of_item  # [A]
        members = sweeps.pixels[tree.pixel]  # [A]
        boxes = _boxes(tree, members, blocks, sweeps.num_steps)
        of_member = boxes[node]  # [A]
        row_col = torch.div(members.row_col, of_member.block, rounding_mode="floor")  # [2, A]
        sample = of_member.sample_at(members.step, row_col)  # [A]
        slices = lazy_zeros(boxes.num_samples, torch.uint8, node.device)
        slices.scatter_(0, sample, members.slices.masked_fill(of_member.block > 1, OWN))
        # Several finest pixels may fall into one pixel of the scale. They are equal there, so any of them may remain.
        member_at = lazy_empty(boxes.num_samples, torch.int32, node.device)
        member_at.scatter_(0, sample, torch.arange(len(node), dtype=torch.int32, device=node.device))
        drawn = flat_nonzero(slices.bool())  # [Q]
        member = member_at.index_select(0, drawn).long()
        return cls(
            boxes=boxes,
            slices=slices,
            pixels=ClusterPixels(*gather(member, node, members.step, *row_col)),
            slices_of_pixel=slices.index_select(0, drawn),
        )

    def look_up_newest(self, node: Tensor, row: Tensor, col: Tensor) -> Tensor:
        """Return the slices of pixels of nodes at t+1; 0 outside of the box. Node is (K,), row and col (..., K)."""
        boxes = self.boxes[node]
        height, width = boxes.size.t()
        is_inside = (row >= 0) & (row < height) & (col >= 0) & (col < width)
        sample = (boxes.start + row * width + col) * is_inside
        return self.slices.index_select(0, sample.view(-1)).view_as(sample) * is_inside


def _boxes(tree: Tree, members: Pixels, blocks: Sequence[int], num_steps: int) -> _Boxes:
    """Choose the scale and the box of each node.

    Convention: a node has the scale of its level, unless its box has more than `_LARGEST_BOX` pixels there. Then it has
        the finest scale at which the box fits, or the coarsest if it fits nowhere.
    """
    block = constant(tuple(blocks), torch.int64, members.step.device)[:, None]  # [scales, 1], coarse to fine
    first = tree.members.min(members.row_col, empty=FAR)  # [2, N], finest pixels
    last = tree.members.max(members.row_col, empty=0)
    top_left = torch.div(first[:, None], block, rounding_mode="floor")  # [2, scales, N]
    size = torch.div(last[:, None], block, rounding_mode="floor") - top_left + 1
    num_fitting = (size.prod(0) <= _LARGEST_BOX).sum(0)  # these scales come first
    scale = torch.minimum(tree.kind.clamp(max=len(blocks) - 1), (num_fitting - 1).clamp(min=0))
    node = torch.arange(tree.count, device=scale.device)
    size = size[:, scale, node]  # [2, N]
    num_samples = size.prod(0) * num_steps
    end = num_samples.cumsum(0)
    return _Boxes(
        table=torch.stack((block[scale, 0], end - num_samples, *top_left[:, scale, node], *size), 1),
        num_samples=int(end[-1]) if tree.count else 0,
    )


def _parabola(images: _NodeImages, pairs: TemplatePairs, shift: Tensor) -> Tensor:
    """Return the sub-pixel offset of each peak, (J, 2) float64, (y, x), pixels of its scale.

    `shift` is the shift of each peak, (J, 2). The offset is the vertex of the parabolas through the counts of common
    slices at the peak and at its four neighbours, at most half a pixel. It is 0 for pairs whose peak is at shift 0, and
    where a parabola is not concave.
    """
    is_moved = shift.any(1)
    counts = _counts_around(images, pairs, shift, is_moved)  # [5, J]
    before = counts[1:3]
    after = counts[3:]
    curve = (2 * counts[:1] - before - after).double()
    vertex = ((after - before) / (2 * curve)).masked_fill(curve <= 0, 0.0).clamp(-0.5, 0.5)  # [2, J]
    return (vertex * is_moved).t()


def _counts_around(images: _NodeImages, pairs: TemplatePairs, shift: Tensor, is_wanted: Tensor) -> Tensor:
    """Count the common slices of J pairs at their shift, one pixel above, left, below and right of it, (5, J) int64.

    `is_wanted` is (J,) bool; the counts of other pairs are 0.
    """
    template = pairs.template
    assert pairs.pixel is not None
    some = flat_nonzero(is_wanted.index_select(0, template.image))  # [K], template pixels
    pair = template.image.index_select(0, some)
    row = template.row.index_select(0, some) + shift[:, 0].index_select(0, pair)
    col = template.col.index_select(0, some) + shift[:, 1].index_select(0, pair)
    down, right = constant(((0, -1, 0, 1, 0), (0, 0, -1, 0, 1)), torch.int64, shift.device)[..., None]  # [5, 1] each
    target = images.look_up_newest(pairs.cluster.index_select(0, pair), row + down, col + right)  # [5, K]
    source = images.slices_of_pixel.index_select(0, pairs.pixel.index_select(0, some))
    return Groups(pair, len(shift)).sum(count_slices(source & target))
