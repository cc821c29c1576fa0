"""Dissent: nodes inside a winner that do not move with it.

A winner (`selection.py`) may hold two objects, and the motion of the larger one wins. Where the smaller one is, hardly
anything is found, neither in place nor at the targets of that motion, so the evidence does not fall. Therefore a node
inside a winner *dissents* if its own motion, or "static", beats the motion of the winner in its own pixels. Two sweeps
are too few to tell:

    winner     [   A     A  c  p ]     a car A, a cyclist c behind it and a parked car p: all move as A
    dissent              [c][p]        c moves by itself, p is static

A component of changed pixels is in no other node, but its pixels may take the motion of a winner. It dissents likewise.
"""

from __future__ import annotations

import torch
from torch import Tensor

from cflow_torch.ops.groups import Groups
from cflow_torch.ops.indices import flat_nonzero
from cflow_torch.verified.component_tree import NodeKind, Tree
from cflow_torch.verified.height_slices import HeightSlicedSweeps
from cflow_torch.verified.paired_test import NEAR_Z, Counts, Verdict, count_wins

_DISSENT_Z = 4.0  # factor of z for nodes that dissent
# Finest pixels per sweep interval, between the motions of a winner and of a node that dissents. Changed pixels are
# often the outline of an object, which tells its motion less well than the whole object.
_LEAST_DIFFERENCE = 1.0
_LEAST_DIFFERENCE_OF_CHANGED = 2.0


def with_dissent(
    sweeps: HeightSlicedSweeps, tree: Tree, verdict: Verdict, winner: Tensor, significance: float, price: int
) -> Tensor:
    """Return the node whose motion each node takes, (N,) int64; N = it is static.

    `winner` is (N,) int64, the coarsest winner among each node and those that contain it; N = none. A node dissents if
    it gains more than `price`, in units of `PER_SLICE`.
    """
    none = tree.count
    node = torch.arange(none, device=winner.device)
    has_history = sweeps.has_history.index_select(0, tree.window)
    is_inside = (tree.kind < tree.num_levels) & (winner < none) & (winner != node) & has_history
    dissents = _dissent(sweeps, tree, verdict, is_inside, winner, _LEAST_DIFFERENCE, significance, price)
    own = torch.where(verdict.motion.any(1), node, none)
    taken = winner
    for level in range(1, tree.num_levels):
        of_level = torch.where(dissents, own, tree.by_parent.spread(taken, none=none))
        taken = torch.where(is_inside & (tree.kind == level), of_level, taken)
    return taken


def changed_dissent(
    sweeps: HeightSlicedSweeps, tree: Tree, verdict: Verdict, of_pixel: Tensor, significance: float, price: int
) -> Tensor:
    """Tell which nodes of changed pixels do not move with the winner around them, (N,) bool.

    `of_pixel` is (P',) int64, the node of the levels whose motion each pixel takes; N = none. If the pixels of a node
    take several motions, the node is compared with the first of these nodes, the coarsest.
    """
    winner = tree.members.min(of_pixel.index_select(0, tree.pixel), empty=tree.count)
    is_inside = (tree.kind == NodeKind.CHANGED) & (winner < tree.count) & verdict.motion.any(1)
    return _dissent(sweeps, tree, verdict, is_inside, winner, _LEAST_DIFFERENCE_OF_CHANGED, significance, price)


def _dissent(
    sweeps: HeightSlicedSweeps,
    tree: Tree,
    verdict: Verdict,
    is_inside: Tensor,
    winner: Tensor,
    least_difference: float,
    significance: float,
    price: int,
) -> Tensor:
    """Tell which nodes inside a winner dissent, (N,) bool. `is_inside` is (N,) bool, `winner` (N,) int64."""
    motion = verdict.motion
    motion_around = Groups(winner, tree.count).spread(motion)  # [N, 2]
    differs = ((motion - motion_around).abs() >= least_difference).any(1)
    inside = flat_nonzero(is_inside & differs)
    dissents = torch.zeros_like(is_inside)
    if len(inside) > 0:
        dissents[inside] = _gain(sweeps, tree, inside, motion, motion_around, _DISSENT_Z * significance) > price
    return dissents


def _gain(sweeps: HeightSlicedSweeps, tree: Tree, node: Tensor, motion: Tensor, other: Tensor, z: float) -> Tensor:
    """Return the evidence of motions against others in the pixels of K nodes, (K,) int64, units of `PER_SLICE`.

    The motions are (N, 2) each, of all nodes. What one motion wins against "static", the other one loses against it.
    """
    pixel, members = tree.pixels_of(node)
    motions = torch.stack((motion.index_select(0, node), other.index_select(0, node)), 1)  # [K, 2, 2]
    wins = count_wins(sweeps, sweeps.pixels[pixel], members, motions)
    exact, near = (Counts(n.won[:, 0] + n.lost[:, 1], n.lost[:, 0] + n.won[:, 1]) for n in (wins.exact, wins.near))
    return exact.evidence(z) + near.evidence(NEAR_Z * z)
