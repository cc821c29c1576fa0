"""Dissent: nodes inside a winner that do not move with it.

A winner (`selection.py`) may hold two objects, and the motion of the larger one wins. Where the smaller one is, hardly
anything is found, neither in place nor at the targets of that motion, so the evidence does not fall. Therefore a node
inside a winner *dissents* if its own motion, or "static", beats the motion of the winner in its own pixels. Two sweeps
are too few to tell:

    winner     [   A     A  c  p ]     a car A, a cyclist c behind it and a parked car p: all move as A
    dissent              [c][p]        c moves by itself, p is static
"""

from __future__ import annotations

import torch
from torch import Tensor

from cflow_torch.ops.groups import Groups
from cflow_torch.ops.indices import flat_nonzero
from cflow_torch.verified.component_tree import Tree
from cflow_torch.verified.height_slices import HeightSlicedSweeps
from cflow_torch.verified.paired_test import NEAR_Z, Counts, Verdict, count_wins

_DISSENT_Z = 4.0  # factor of z for nodes that dissent
_LEAST_DIFFERENCE = 1.0  # finest pixels per sweep interval, between the motions of a winner and of a node that dissents


def with_dissent(
    sweeps: HeightSlicedSweeps, tree: Tree, verdict: Verdict, winner: Tensor, significance: float, price: int
) -> Tensor:
    """Return the node whose motion each node takes, (N,) int64; N = it is static.

    `winner` is (N,) int64, the coarsest winner among each node and those that contain it; N = none. A node dissents if
    it gains more than `price`, in units of `PER_SLICE`.
    """
    none = tree.count
    node = torch.arange(none, device=winner.device)
    motion = verdict.motion
    motion_around = Groups(winner, none).spread(motion)  # [N, 2]
    has_history = sweeps.has_history.index_select(0, tree.window)
    is_inside = (tree.kind < tree.num_levels) & (winner < none) & (winner != node) & has_history
    differs = ((motion - motion_around).abs() >= _LEAST_DIFFERENCE).any(1)
    inside = flat_nonzero(is_inside & differs)
    if len(inside) == 0:
        return winner
    dissents = torch.zeros_like(is_inside)
    dissents[inside] = _gain(sweeps, tree, inside, motion, motion_around, _DISSENT_Z * significance) > price
    own = torch.where(motion.any(1), node, none)
    taken = winner
    for level in range(1, tree.num_levels):
        of_level = torch.where(dissents, own, tree.by_parent.spread(taken, none=none))
        taken = torch.where(is_inside & (tree.kind == level), of_level, taken)
    return taken


def _gain(sweeps: HeightSlicedSweeps, tree: Tree, node: Tensor, motion: Tensor, other: Tensor, z: float) -> Tensor:
    """Return the evidence of motions against others in the pixels of K nodes, (K,) int64, units of `PER_SLICE`.

    The motions are (N, 2) each, of all nodes. What one motion wins against "static", the other one loses against it.
    """
    pixel, members = tree.pixels_of(node)
    motions = torch.stack((motion.index_select(0, node), other.index_select(0, node)), 1)  # [K, 2, 2]
    wins = count_wins(sweeps, sweeps.pixels[pixel], members, motions)
    exact, near = (Counts(n.won[:, 0] + n.lost[:, 1], n.lost[:, 0] + n.won[:, 1]) for n in (wins.exact, wins.near))
    return exact.evidence(z) + near.evidence(NEAR_Z * z)
