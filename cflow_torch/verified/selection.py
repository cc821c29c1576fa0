"""Select objects among the nodes of the component tree: which motion does each pixel take?

A component wins if its motion has more evidence than its children together. A node inside a winner may dissent
(`dissent.py`).

P is the number of drawn pixels. The pixels of copies follow, and P' counts both.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Callable

import torch
import torch.nn.functional as F
from torch import Tensor

from cflow_torch.ops.groups import Groups
from cflow_torch.ops.indices import flat_nonzero
from cflow_torch.verified.component_tree import Components, NodeKind, Tree, corners_at_newest, longer_side
from cflow_torch.verified.dissent import Dissent, with_dissent
from cflow_torch.verified.height_slices import HeightSlicedSweeps
from cflow_torch.verified.paired_test import PER_SLICE, Verdict

# The price of an object on each level. Children move separately only if that gains more evidence. It is two slices that
# both the exact counts and the near counts win.
PRICE = 4 * PER_SLICE


@dataclass(frozen=True)
class Objects:
    """The selected objects, in order of their first pixel in the list: those of copies come last."""

    by_object: Groups  # the P' pixels
    by_node: Groups  # the G objects, by the node whose motion they take; static objects are in no group
    window: Tensor  # (G,) int64, window of each object

    @property
    def count(self) -> int:
        """Number of objects, G."""
        return self.by_object.count

    def length_at_newest(self, sweeps: HeightSlicedSweeps) -> Tensor:
        """(G,) float64, metres, longer side of the bounding box of the pixels at t+1; 0 without any."""
        return longer_side(corners_at_newest(sweeps.pixels, self.by_object), sweeps.grid.pixel_size)


def select_objects(
    sweeps: HeightSlicedSweeps,
    components: Components,
    tree: Tree,
    verdict: Verdict,
    significance: float,
    price: int = PRICE,
    dissent: Callable[..., Dissent] = with_dissent,
) -> Objects:
    """Select objects from the leaves up, then let nodes inside the winners dissent.

    Args:
        components, tree: `tree` includes nodes under overhangs, `components` does not.
        verdict: the best motion of each node, and its evidence; 0 = none is significant.
        significance: z of the paired test. For a node against the winner around it, z is four times as large.
        price: of an object, in units of `PER_SLICE`.
        dissent: finds the nodes inside a winner that do not move with it.

    Returns:
        The objects. A pixel moves with the node whose motion the finest of its nodes of the levels takes. If the pixel
        is also in nodes of other kinds, each of these that has more evidence, or dissents from that node, takes the
        pixel; of several, the one with the most evidence. A pixel that moves with no node belongs to its plain
        component if that is linked, else to no object, and is static.

    Convention:
        The value of a child is its own evidence or the sum of its children's values, whichever is more, minus `price`,
        but at least 0. The coarsest node with more evidence than its children wins. Ties: the children win.
        With history, a node inside a winner dissents if its motion differs from that of the winner by a pixel per sweep
        interval in y or in x, and gains more than `price`. Otherwise, it takes the motion that its parent takes. A node
        of changed pixels dissents if its motion differs by two pixels.

    Cost: a few passes over the nodes for each level, and over the members; the paired test of nodes that may dissent.
    """
    none = tree.count
    winner = _winners(tree, verdict.evidence, price)
    finest = _finest_of_levels(tree, sweeps.num_pixels)  # [P']
    around = _around_changed(tree, winner, finest)
    taken, left = dissent(sweeps, tree, verdict, around, significance, price)
    moving = _moving_nodes(tree, _of_finest(taken, finest), verdict.evidence, left)

    # The key of an object is the number of its node if it moves, else N plus the number of its component.
    static = _keys_of_components(components, none, sweeps.num_pixels)
    key = torch.where(moving < none, moving, static)
    return number_objects(sweeps, Groups(key, none + components.count), none)


def _winners(tree: Tree, evidence: Tensor, price: int) -> Tensor:
    """Return the coarsest winner among each node and those that contain it, (N,) int64; N = none of them won."""
    # From the leaves up: the value of the children of each node.
    of_children = torch.zeros_like(evidence)
    for level in range(tree.num_levels - 1, 0, -1):
        value = (torch.maximum(evidence, of_children) - price).clamp(min=0)
        of_children += tree.by_parent.sum(torch.where(tree.kind == level, value, 0))

    # From the roots down: a node follows the coarsest winner that contains it, which has the smallest number.
    node = torch.arange(tree.count, device=evidence.device)
    winner = torch.where(evidence > of_children, node, tree.count)
    for _ in range(tree.num_levels - 1):
        winner = torch.minimum(winner, tree.by_parent.spread(winner, none=tree.count))
    return winner


def _finest_of_levels(tree: Tree, num_pixels: int) -> Tensor:
    """Return the number of the finest node of the levels of each pixel, (P',) int64, from 1 on; 0 = none."""
    number = torch.arange(1, tree.count + 1, device=tree.pixel.device)
    # Nodes are listed level by level, so the finest node of a pixel has the largest number.
    of_level = torch.where(tree.kind < tree.num_levels, number, 0)
    return Groups(tree.pixel, num_pixels).max(tree.members.spread(of_level, none=0), empty=0)


def _of_finest(node: Tensor, finest: Tensor) -> Tensor:
    """Return what each of N nodes has, (N,) int64, for the finest nodes of K pixels, (K,) int64; N for 0 = none."""
    return F.pad(node, (1, 0), value=len(node)).index_select(0, finest)


def _around_changed(tree: Tree, winner: Tensor, finest: Tensor) -> Tensor:
    """Return the winners, but for nodes of changed pixels the winner around their pixels, (N,) int64; N = none.

    If their pixels have several winners, it is the first, the coarsest. `finest` is the result of `_finest_of_levels`.
    """
    around = tree.members.min(_of_finest(winner, finest.index_select(0, tree.pixel)), empty=tree.count)
    return torch.where(tree.kind == NodeKind.CHANGED, around, winner)


def _moving_nodes(tree: Tree, of_level: Tensor, evidence: Tensor, left: Tensor) -> Tensor:
    """Return the moving node of each pixel, (P',) int64; N = none; see `select_objects`.

    Args:
        of_level: (P',) int64, the node whose motion the finest node of the levels takes; N = none.
        left: (N,) int64, see `Dissent`.
    """
    none = tree.count
    member = flat_nonzero(tree.members.spread(tree.kind >= tree.num_levels))
    node = tree.members.of_item.index_select(0, member)
    pixel = tree.pixel.index_select(0, member)
    rival = of_level.index_select(0, pixel)
    own = evidence.index_select(0, node)
    has_more = own > F.pad(evidence, (0, 1)).index_select(0, rival)  # of none, 0
    wins = has_more | (left.index_select(0, node) == rival)
    winners = Groups(pixel, len(of_level)).where(wins)
    most = winners.max(own, empty=-1)  # [P']
    best = winners.where(own == winners.spread(most, none=-1)).min(node, empty=none)  # ties: the first
    return torch.where(best < none, best, of_level)


def _keys_of_components(components: Components, first: int, num_pixels: int) -> Tensor:
    """Return `first` plus the plain component of each pixel, (P',) int64, if that is linked.

    Otherwise, and for the pixels of copies, the result is the number after the last component.
    """
    plain = components.of_level(-1)
    linked = plain.where(plain.spread(components.is_linked))
    num_copies = num_pixels - len(linked.of_item)
    return F.pad(first + linked.of_item, (0, num_copies), value=first + components.count)


def number_objects(sweeps: HeightSlicedSweeps, by_key: Groups, num_nodes: int = 0) -> Objects:
    """Number the objects in order of their first pixel in the list.

    `by_key` groups the P' pixels. The first `num_nodes` groups are objects that are nodes, the others are components.
    """
    first = by_key.first()
    used = flat_nonzero(first < len(by_key.of_item))
    first, order = first[used].sort()
    used = used[order]
    by_node = Groups(used.clamp(max=num_nodes), num_nodes)
    return Objects(by_key.select(used), by_node, sweeps.pixels.window[first])
