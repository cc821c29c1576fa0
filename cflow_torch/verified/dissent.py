"""Dissent: nodes inside a winner that do not move with it.

A winner (`selection.py`) may hold two objects, and the motion of the larger one wins. Where the smaller one is, hardly
anything is found, neither in place nor at the targets of that motion, so the evidence does not fall. Therefore a node
inside a winner *dissents* if its own motion, or "static", beats the motion of the winner in its own pixels. Two sweeps
are too few to tell:

    winner     [   A     A  c  p ]     a car A, a cyclist c behind it and a parked car p: all move as A
    dissent              [c][p]        c moves by itself, p is static

A component of changed pixels has no parent, but its pixels may take the motion of a winner. It dissents likewise.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from cflow_torch.ops.groups import Groups
from cflow_torch.ops.indices import flat_nonzero
from cflow_torch.verified.component_tree import NodeKind, Tree
from cflow_torch.verified.height_slices import HeightSlicedSweeps
from cflow_torch.verified.paired_test import NEAR_Z, Counts, Verdict, count_wins

_DISSENT_Z = 4.0  # factor of z for nodes that dissent
# Finest pixels per sweep interval, between the motions of a winner and of a node that dissents. Changed pixels are
# often the outline of an object, which tells its motion less well than the whole object, so theirs differs by more.
_LEAST_DIFFERENCE = 1.0
_LEAST_OF_CHANGED = 2.0


class Dissent(NamedTuple):
    """The motions of N nodes after dissent."""

    taken: Tensor  # (N,) int64, the node whose motion each node of the levels takes; N = it is static
    left: Tensor  # (N,) int64, the winner from which each node dissents; -1 = it does not


def with_dissent(
    sweeps: HeightSlicedSweeps, tree: Tree, verdict: Verdict, winner: Tensor, significance: float, price: int
) -> Dissent:
    """Find the nodes that do not move with the winner around them.

    `winner` is (N,) int64, the winner among each node and those around it; N = none. Fast objects and those under
    overhangs have no node around them. A node dissents if it gains more than `price`, in units of `PER_SLICE`.
    """
    none = tree.count
    node = torch.arange(none, device=winner.device)
    motion = verdict.motion
    motion_around = Groups(winner, none).spread(motion)  # [N, 2]
    moves = motion.any(1)
    is_whole = tree.kind != NodeKind.CHANGED
    has_history = sweeps.has_history.index_select(0, tree.window)
    # Changed pixels without a motion of their own move with the winner.
    is_inside = (winner < none) & (winner != node) & (is_whole | moves) & has_history
    least = torch.where(is_whole, _LEAST_DIFFERENCE, _LEAST_OF_CHANGED)
    differs = (motion - motion_around).abs().amax(1) >= least
    inside = flat_nonzero(is_inside & differs)
    left = torch.full_like(winner, -1)
    if len(inside) == 0:
        return Dissent(winner, left)
    dissents = torch.zeros_like(is_inside)
    dissents[inside] = _gain(sweeps, tree, inside, motion, motion_around, _DISSENT_Z * significance) > price
    own = torch.where(moves, node, none)
    taken = winner
    for level in range(1, tree.num_levels):
        of_level = torch.where(dissents, own, tree.by_parent.spread(taken, none=none))
        taken = torch.where(is_inside & (tree.kind == level), of_level, taken)
    return Dissent(taken, torch.where(dissents, winner, left))


def _gain(sweeps: HeightSlicedSweeps, tree: Tree, node: Tensor, motion: Tensor, other: Tensor, z: float) -> Tensor:
    """Return the evidence of motions against others in the pixels of K nodes, (K,) int64, units of `PER_SLICE`.

    The motions are (N, 2) each, of all nodes. What one motion wins against "static", the other one loses against it.
    """
    pixel, members = tree.pixels_of(node)
    motions = torch.stack((motion.index_select(0, node), other.index_select(0, node)), 1)  # [K, 2, 2]
    wins = count_wins(sweeps, sweeps.pixels[pixel], members, motions)
    exact, near = (Counts(n.won[:, 0] + n.lost[:, 1], n.lost[:, 0] + n.won[:, 1]) for n in (wins.exact, wins.near))
    return exact.evidence(z) + near.evidence(NEAR_Z * z)
