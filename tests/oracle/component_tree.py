"""The component tree: components at several scales, those of them that may move, and the cut that selects objects."""

from __future__ import annotations

from itertools import product
from typing import Any, Iterable, NamedTuple, Sequence, Tuple

from cflow_torch.config import VerifiedConfig
from oracle.aperture import both_ends_move
from oracle.changed_pixels import Change
from oracle.height_slices import Pixel, SlicedSweeps

PRICE = 16 * 4  # what every child costs, sixteenths of a slice

Cells = Tuple[Pixel, ...]


class Node(NamedTuple):
    """A component that may move.

    Attributes:
        members: its pixels, sorted.
        level: 0 ... L - 1 in the tree, coarse to fine; L = changed pixels, L + 1 = under an overhang.
        parent: number of the next coarser node around it; None = there is none.
        travels: it is longer than other objects, and both of its ends move.
        sweeps: where its pixels are: the window, or the copies of what lies under something.
    """

    members: Cells
    level: int
    parent: int | None
    travels: bool
    sweeps: SlicedSweeps


class Tree(NamedTuple):
    """Components of each level, dilated ones coarse to fine, then plain ones; nodes coarse to fine, then those of
    changed pixels; pixels of the finest dilated components that may move, long ones included."""

    levels: list[list[Cells]]
    nodes: list[Node]
    may_move: set[Pixel]


def join(cells: Iterable[tuple[int, ...]], reach: int) -> dict[Any, int]:
    """Component of each cell; cells join whose indices differ by at most `reach`. Numbered by their first cells."""
    remaining, result, number = set(cells), {}, 0  # type: ignore[var-annotated]
    for seed in sorted(remaining):
        stack = [seed] if seed in remaining else []
        number += len(stack)
        remaining -= {seed}
        while stack:
            cell = stack.pop()
            result[cell] = number - 1
            for step in product(range(-reach, reach + 1), repeat=len(cell)):
                near = tuple(a + b for a, b in zip(cell, step))
                if near in remaining:
                    remaining.remove(near)
                    stack.append(near)
    return result


def components(pixels: Iterable[Pixel], block: int, reach: int) -> list[Cells]:
    """Components of pixels of all sweeps together, at pixels of `block` x `block` finest ones.

    Dilation by a 3 x 3 square is reach 3: two dilated squares touch if their pixels are at most three apart.
    """
    component = join({(r // block, c // block) for _, r, c in pixels}, reach)
    found: dict[int, list[Pixel]] = {}
    for m, r, c in sorted(pixels):
        found.setdefault(component[r // block, c // block], []).append((m, r, c))
    return [tuple(members) for members in found.values()]


def is_linked(members: Cells) -> bool:
    """Has it pixels at t+1 and in another sweep?"""
    return members[0][0] == 0 < members[-1][0]


def grow(sweeps: SlicedSweeps, change: Change, config: VerifiedConfig) -> Tree:
    """Components of all scales, and which of them may move.

    Convention: in windows with history more than 5 % of the pixels of what may move are missing. A plain component that
        equals the dilated one around it is not in the list a second time. Lengths are those at t+1.
    """
    pixels, longest = sweeps.pixels(), config.max_object_length
    scales = [(round(size / sweeps.size), 3) for size in config.pixel_sizes]
    levels = [components(pixels, block, reach) for block, reach in [*scales, (1, 1)]]
    tree, node_of = Tree(levels, [], set()), {}  # type: ignore[var-annotated]
    for level, found in enumerate([*levels, components(change.has_changed, 1, 1)]):
        in_tree = level < len(levels)
        known = set(levels[level - 1]) if level == len(levels) - 1 else set()
        first = len(tree.nodes)
        for members in found:
            num_missing = sum(pixel in change.is_missing for pixel in members)
            if not is_linked(members) or (len(sweeps.images) > 2 and 20 * num_missing <= len(members)):
                continue
            if level == len(scales) - 1:
                tree.may_move.update(members)
            is_long = in_tree and longest is not None and length(members) * sweeps.size > longest
            travels = is_long and both_ends_move(sweeps, members)
            if members not in known and (travels or not is_long):
                parent = node_of.get(members[0]) if in_tree else None
                tree.nodes.append(Node(members, level, parent, travels, sweeps))
        for i in range(first, len(tree.nodes)):
            node_of.update(dict.fromkeys(tree.nodes[i].members, i))
    return tree


def length(members: Iterable[Pixel]) -> int:
    """Longer side, in pixels, of the box of those at t+1; 0 without any."""
    cells = [(r, c) for m, r, c in members if m == 0]
    return max((max(line) - min(line) + 1 for line in zip(*cells)), default=0)


def cut(nodes: Sequence[Node], evidence: Sequence[int]) -> list[int | None]:
    """The node whose motion each node takes, None = it has none.

    A node wins if it has more evidence than its children together; the coarsest winner around a node counts. A child
    counts with its evidence, or with that of its own children if that is more, less `PRICE`, at least 0.
    """
    of_children = [0] * len(nodes)
    for i in reversed(range(len(nodes))):
        parent = nodes[i].parent
        if parent is not None:
            of_children[parent] += max(max(evidence[i], of_children[i]) - PRICE, 0)
    winner: list[int | None] = []
    for i, node in enumerate(nodes):
        around = None if node.parent is None else winner[node.parent]
        winner.append(around if around is not None else i if evidence[i] > of_children[i] else None)
    return winner


def select_objects(
    nodes: Sequence[Node], evidence: Sequence[int], num_levels: int, plain: Sequence[Cells], sweeps: SlicedSweeps
) -> tuple[dict[Pixel, int], list[int | None]]:
    """What moves together or is static together, among the pixels of a window or of its copies.

    Args:
        nodes, evidence: all of them.
        num_levels: of the tree.
        plain: plain components of the finest pixels; none for copies.
        sweeps: the window, or the copies.

    Returns:
        Object of each pixel that has one, numbered by their first pixels; node of each object, None = it has none.

    A pixel moves with the winner of its finest node in the tree; else with its node out of the tree, if that has any
    evidence; else it is static with its plain component, if that is linked.
    """
    winner = cut(nodes, evidence)
    number_of = {node.members: i for i, node in enumerate(nodes) if node.level == num_levels - 1}
    name: dict[Pixel, Any] = {}
    for members in filter(is_linked, plain):
        name.update(dict.fromkeys(members, number_of.get(members, members)))
    of_finest: dict[Pixel, int | None] = {}
    for i, node in enumerate(nodes):
        if node.sweeps is sweeps and node.level < num_levels:
            of_finest.update(dict.fromkeys(node.members, winner[i]))
        elif node.sweeps is sweeps and evidence[i] > 0:
            name.update(dict.fromkeys(node.members, i))
    name.update({pixel: i for pixel, i in of_finest.items() if i is not None})
    number: dict[Any, int] = {}
    object_of = {pixel: number.setdefault(name[pixel], len(number)) for pixel in sorted(name)}
    return object_of, [own if isinstance(own, int) else None for own in number]
