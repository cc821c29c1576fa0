"""The component tree: components at several scales, those of them that may move, and the cut that selects objects."""

from __future__ import annotations

from typing import NamedTuple, Sequence

import numpy as np
from scipy import ndimage

from cflow_torch.config import VerifiedConfig
from oracle.aperture import both_ends_move
from oracle.clustering import SQUARE
from oracle.height_slices import SlicedSweeps, Vector
from oracle.paired_test import count_wins, evidence_of

PRICE = 16 * 4  # what every child costs, sixteenths of a slice
LOCAL = 3.0  # metres, longest component of changed pixels


class Node(NamedTuple):
    """A component that may move."""

    members: np.ndarray  # its pixels, ascending
    level: int  # 0 ... L - 1 in the tree, coarse to fine; L = changed pixels, L + 1 = fast objects
    parent: int  # number of the next coarser node around it, -1 = there is none
    velocity: tuple[float, float] = (0.0, 0.0)  # (y, x) finest pixels per interval, of fast objects


class Tree(NamedTuple):
    """(L, P) component of each pixel at each level, dilated ones coarse to fine, then plain ones; nodes coarse to fine,
    then those of changed pixels."""

    levels: list[np.ndarray]
    nodes: list[Node]


def components(sweeps: SlicedSweeps, drawn: np.ndarray, block: int, is_dilated: bool) -> np.ndarray:
    """(P,): component of each of the pixels that are drawn, (P,) bool, of all sweeps together, 0 = none; at pixels of
    `block` x `block` finest ones."""
    row, col = sweeps.pixels[:, 1:].T // block
    image = np.zeros((row.max(initial=0) + 2, col.max(initial=0) + 2), dtype=bool)
    image[row[drawn], col[drawn]] = True
    labels, _ = ndimage.label(ndimage.binary_dilation(image, SQUARE) if is_dilated else image, SQUARE)
    return np.where(drawn, labels[row, col], 0)


def is_linked(sweeps: SlicedSweeps, members: np.ndarray) -> bool:
    """Has it pixels at t+1 and in another sweep?"""
    step = sweeps.pixels[members, 0]
    return bool(step[0] == 0 < step[-1])


def grow(sweeps: SlicedSweeps, change: np.ndarray, config: VerifiedConfig) -> Tree:
    """Components of all scales, and which of them may move.

    Convention: in windows with history more than 5 % of the pixels of what may move are missing. A plain component that
        equals the dilated one around it is not in the list a second time. Lengths are those of the longer side of the
        box at t+1. Components of changed pixels are at most 3 m long.
    """
    longest, every = config.max_object_length, np.ones(len(sweeps.pixels), dtype=bool)
    is_missing, has_changed, _ = change
    scales = [(round(size / sweeps.size), True) for size in config.pixel_sizes]
    tree = Tree([components(sweeps, every, *scale) for scale in (*scales, (1, False))], [])
    node_of, plain = np.full(len(every), -1), len(scales)
    for level, found in enumerate([*tree.levels, components(sweeps, has_changed, 1, False)]):
        number = node_of.copy()
        for name in np.unique(found[found > 0]):
            members = np.flatnonzero(found == name)
            num_missing = is_missing[members].sum()
            if not is_linked(sweeps, members) or (sweeps.has_history and 20 * num_missing <= len(members)):
                continue
            newest = sweeps.pixels[members[sweeps.pixels[members, 0] == 0], 1:]
            metres = (np.ptp(newest, axis=0).max() + 1) * sweeps.size
            if level > plain:
                is_node = metres <= LOCAL
            else:
                is_long = longest is not None and metres > longest
                around = tree.levels[level - 1]
                is_repeated = level == plain and (around == around[members[0]]).sum() == len(members)
                is_node = (not is_long or both_ends_move(sweeps, members)) and not is_repeated
            if is_node:
                number[members] = len(tree.nodes)
                tree.nodes.append(Node(members, level, -1 if level > plain else node_of[members[0]]))
        node_of = number
    return tree


def cut(nodes: Sequence[Node], evidence: Sequence[int]) -> list[int]:
    """The node whose motion each node takes, -1 = it has none.

    A node wins if it has more evidence than its children together; the coarsest winner around a node counts. A child
    counts with its evidence, or with that of its own children if that is more, less `PRICE`, at least 0.
    """
    of_children = [0] * len(nodes)
    for i in reversed(range(len(nodes))):
        if nodes[i].parent >= 0:
            of_children[nodes[i].parent] += max(max(evidence[i], of_children[i]) - PRICE, 0)
    winner: list[int] = []
    for i, node in enumerate(nodes):
        around = winner[node.parent] if node.parent >= 0 else -1
        winner.append(around if around >= 0 else i if evidence[i] > of_children[i] else -1)
    return winner


def dissent(sweeps: SlicedSweeps, tree: Tree, motions: Sequence[Vector], winner: Sequence[int], z: float) -> list[int]:
    """The node whose motion each node takes, -1 = none, from the winners of the cut.

    With history, a node inside a winner takes its own motion, or is static, if that differs from the motion of the
    winner by a pixel in y or in x, and gains more than `PRICE` against the winner in its own pixels.
    """
    taken = list(winner)
    for i, node in enumerate(tree.nodes):
        if node.level >= len(tree.levels) or winner[i] in (-1, i) or not sweeps.has_history:
            continue
        taken[i] = taken[node.parent]
        differs = max(abs(a - b) for a, b in zip(motions[i], motions[winner[i]])) >= 1
        if differs and gain(sweeps, node.members, motions[i], motions[winner[i]], z) > PRICE:
            taken[i] = i if any(motions[i]) else -1
    return taken


def changed_dissents(
    sweeps: SlicedSweeps, tree: Tree, motions: Sequence[Vector], number: int, around: int, z: float
) -> bool:
    """Does a node of changed pixels not move with the winner `around` it, -1 = none?

    The motions differ by two pixels in y or in x, and its own one gains more than `PRICE`.
    """
    node = tree.nodes[number]
    if node.level != len(tree.levels) or not any(motions[number]) or around < 0 or not sweeps.has_history:
        return False
    other = motions[around]
    differs = max(abs(a - b) for a, b in zip(motions[number], other)) >= 2
    return differs and gain(sweeps, node.members, motions[number], other, z) > PRICE


def gain(sweeps: SlicedSweeps, members: np.ndarray, motion: Vector, other: Vector, z: float) -> int:
    """Evidence of one motion against another: what one wins against static, the other loses. z counts four times."""
    total = 0
    for is_near in (False, True):
        (won, lost), (other_won, other_lost) = (
            count_wins(sweeps, members, each, is_near).sum(1).tolist() for each in (motion, other)
        )
        total += evidence_of(won + other_lost, lost + other_won, (8 if is_near else 4) * z)
    return total


def select_objects(
    sweeps: SlicedSweeps, tree: Tree, motions: Sequence[Vector], evidence: Sequence[int], z: float
) -> tuple[np.ndarray, np.ndarray]:
    """Objects, which move or are static as a whole: (P,) object of each pixel, numbered by their first pixels, and node
    of each object; -1 = none.

    A pixel moves with the node whose motion its finest node in the tree takes; but with its first node of changed
    pixels or of a fast object, if that has more evidence, or if the changed pixels dissent from it. Else it is static
    with its plain component, if that is linked.
    """
    nodes, num_levels, plain = tree.nodes, len(tree.levels), tree.levels[-1]
    name, moving, winner_of = np.full((3, len(plain)), -1)
    for label in np.unique(plain):
        if is_linked(sweeps, np.flatnonzero(plain == label)):
            name[plain == label] = len(nodes) + label
    winners = cut(nodes, evidence)
    taken = dissent(sweeps, tree, motions, winners, z)
    for i, node in enumerate(nodes):
        if node.level < num_levels:
            moving[node.members] = taken[i]
            winner_of[node.members] = winners[i]
    name = np.where(moving >= 0, moving, name)
    most = np.zeros(len(plain), dtype=int)  # evidence of the best other node
    for i, node in enumerate(nodes):
        if node.level >= num_levels and evidence[i] > 0:
            there = moving[node.members]
            rivals = np.array([evidence[number] if number >= 0 else 0 for number in there.tolist()])
            around = min((number for number in winner_of[node.members].tolist() if number >= 0), default=-1)
            leaves = changed_dissents(sweeps, tree, motions, i, around, z) & (there == around)
            wins = (evidence[i] > rivals) | leaves
            gained = node.members[wins & (evidence[i] > most[node.members])]
            most[gained] = evidence[i]
            name[gained] = i
    names, first = np.unique(name[name >= 0], return_index=True)
    names = names[first.argsort()]
    position = {own: number for number, own in enumerate(names.tolist())}
    object_of = np.array([position.get(own, -1) for own in name.tolist()], dtype=int)
    return object_of, np.where(names < len(nodes), names, -1)
