"""The component tree: components at several scales, which of them may move, and the selection of objects.

A component contains its children, the components at the next finer scale. It may be one object whose children are too
small to be matched, or several objects with different motions. The components of all scales that may move are nodes of
one list, and every later step runs once, on that list.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Sequence

import torch
import torch.nn.functional as F
from torch import Tensor

from cflow_torch.ops.indices import (
    flat_nonzero,
    floor_divide,
    gather,
    lazy_zeros,
    lookup,
    renumber,
    scatter_count,
    take_columns,
)
from cflow_torch.ops.labeling import label_together, padded_size
from cflow_torch.ops.segments import segment_amin, segment_minmax
from cflow_torch.verified.aperture import both_ends_move
from cflow_torch.verified.changed_pixels import ChangedPixels
from cflow_torch.verified.height_slices import HeightSlicedSweeps

# The static test: a component may move only if more than one in 20 of its pixels has a missing slice (`ChangedPixels`).
_MISSING = 20
_LOCAL = 3.0  # metres; a component of changed pixels that is longer at t+1 is not a pedestrian or a cyclist
# The price of an object, in sixteenths of a slice. Children move separately only if that gains more evidence.
_PRICE = 16 * 4


@dataclass(frozen=True)
class Components:
    """All components of all windows. The name of each is a number below V. Names ascend by level; some are unused."""

    roots: Tensor  # (L, P) int64, component of each pixel at each level, coarse to fine; the last is not dilated
    changed: Tensor  # (Q,) int64, positions of the changed pixels in the list of pixels
    changed_root: Tensor  # (Q,) int64, component of each changed pixel, labelled among the changed pixels alone
    firsts: tuple[int, ...]  # first name of each level, then of the components of changed pixels; V if there are none
    parent: Tensor  # (V + 1,) int64, component of the next coarser level; V = none
    size: Tensor  # (V,) int64, number of pixels; 0 = an unused name
    length: Tensor  # (V,) float64, metres, longer side of the bounding box of its pixels at t+1
    is_linked: Tensor  # (V,) bool, it has pixels at t+1 and before
    may_move: Tensor  # (V,) bool, it is linked, and the static test does not exclude a motion
    blocks: tuple[int, ...]  # side of a pixel at each scale, in finest pixels

    @property
    def count(self) -> int:
        """V."""
        return self.size.numel()

    @property
    def num_levels(self) -> int:
        """L."""
        return len(self.roots)


@dataclass(frozen=True)
class Nodes:
    """N components that may move: coarse to fine, then those of changed pixels, then those under overhangs."""

    component: Tensor  # (N,) int64, name of the component; those under overhangs have names of V or more
    level: Tensor  # (N,) int64, 0 ... L - 1; L = changed pixels, L + 1 = under an overhang
    parent: Tensor  # (N,) int64, the next coarser node around the node; N = none
    window: Tensor  # (N,) int64
    travels: Tensor  # (N,) bool, the node is longer than `max_object_length`, and both of its ends move
    pixel: Tensor  # (A,) int64, pixels of all nodes, as positions in the list; a pixel of several nodes is repeated
    node: Tensor  # (A,) int64, node of each entry of `pixel`

    @property
    def count(self) -> int:
        """N."""
        return self.component.numel()


@dataclass(frozen=True)
class Objects:
    """The components that were selected as objects. They are numbered by window, then by their first pixel."""

    of_pixel: Tensor  # (P,) int64, object of each occupied pixel, G = none
    component: Tensor  # (G,) int64, name of the component
    first: Tensor  # (G,) int64, position of its first pixel in the list

    @property
    def count(self) -> int:
        """Number of objects, G."""
        return self.component.numel()


def find_components(sweeps: HeightSlicedSweeps, change: ChangedPixels, blocks: Sequence[int]) -> Components:
    """Label the components of all scales by one union-find, and find which of them may move.

    Args:
        blocks: side of a pixel at each scale in finest pixels, coarse to fine, the last one 1. Each scale is dilated as
            in Alg. clustering, but not eroded, so the scales are nested. The last level has the plain components: those
            of the finest pixels without dilation.

    Convention: with history, a component cannot move if at most 5 % of its pixels have a missing slice.

    Cost: one pass over the images of each scale, a few rounds of union-find, some passes over the pixels.
    """
    pixels, grid, num_windows = sweeps.pixels, sweeps.grid, sweeps.batch.num_windows
    changed = flat_nonzero(change.has_changed)
    images, positions = [], []
    for block in blocks:
        height, width = -(-grid.height // block), -(-grid.width // block)
        row, col = floor_divide(pixels.row_col, block) if block > 1 else pixels.row_col
        positions.append((torch.add(row, pixels.window, alpha=padded_size(height)), col))
        images.append((_draw(*positions[-1], num_windows, height, width), 3))
    images.append((images[-1][0], 1))
    positions.append(positions[-1])
    of_changed = gather(changed, *positions[-1])
    if sweeps.num_steps > 2:
        images.append((_draw(of_changed[0], of_changed[1], num_windows, grid.height, grid.width), 1))
    found = label_together(images)
    roots = torch.stack([blocks_of.of_pixel(*at) for blocks_of, at in zip(found, positions)])
    changed_root, count = found[-1].of_pixel(*of_changed), found[0].num_components
    parent = torch.full((count + 1,), count, dtype=torch.int64, device=changed.device)
    for coarse, fine in zip(roots, roots[1:]):
        parent.scatter_(0, fine, coarse)

    firsts = (*(blocks_of.first for blocks_of in found), count)[: len(roots) + 1]
    root = torch.cat((roots[-1], changed_root))
    # Sums: pixels, plus 2^32 for each one at t+1; pixels with a missing slice, or in windows without history.
    is_missing = change.is_missing | ~sweeps.has_history.index_select(0, pixels.window)
    codes = torch.stack((((pixels.step == 0) << 32) + 1, is_missing))
    sums = scatter_count(root, count + 1, torch.cat((codes, codes.index_select(1, changed)), 1))
    # Add the sums of the children to those of their parents.
    for level in range(len(roots) - 1, 0, -1):
        names = slice(*firsts[level : level + 2])
        sums += scatter_count(parent[names], count + 1, sums[:, names])
    (size, num_missing), num_newest = sums[:, :-1] & 0xFFFFFFFF, sums[0, :-1] >> 32
    is_linked = (num_newest > 0) & (num_newest < size)
    may_move = is_linked & (num_missing * _MISSING > size)
    newest = flat_nonzero(pixels.step == 0)
    is_older = pixels.step.index_select(0, changed) > 0
    root = torch.cat((roots.index_select(1, newest).flatten(), changed_root.masked_fill(is_older, count)))
    pixel = torch.cat((newest.repeat(len(roots)), changed))
    first, last = segment_minmax(take_columns(pixels.row_col, pixel), root, count + 1)
    length = (last - first)[:, :-1].amax(0).add_(1).double() * grid.pixel_size
    return Components(roots, changed, changed_root, firsts, parent, size, length, is_linked, may_move, tuple(blocks))


def _draw(row: Tensor, col: Tensor, num_windows: int, height: int, width: int) -> Tensor:
    """Draw padded images, (B, H', W') bool, from rows, counted through all images, and columns, (K,) int64 each."""
    shape = num_windows, padded_size(height), padded_size(width)
    image = lazy_zeros(math.prod(shape), torch.bool, row.device)
    return image.index_fill_(0, torch.add(col, row, alpha=shape[2]), True).view(shape)


def movable_nodes(sweeps: HeightSlicedSweeps, components: Components, longest: float | None) -> Nodes:
    """List the components that may move.

    Components longer than `longest` metres at t+1 may move only if both of their ends move. None = no such test.

    Convention: a plain component with as many pixels as its dilated parent is the same one, and not listed again.

    Cost: linear in the pixels of the nodes.
    """
    roots, count, may_move, length = components.roots, components.count, components.may_move, components.length
    is_long = may_move & (length > (math.inf if longest is None else longest))
    travels = both_ends_move(sweeps, roots, is_long)
    may_move = may_move & (travels | ~is_long)
    first_plain, first_changed = components.firsts[-2:]
    may_move[first_changed:].logical_and_(length[first_changed:] <= _LOCAL)
    plain, parent = slice(first_plain, first_changed), components.parent
    size, is_node = F.pad(components.size, (0, 1)), F.pad(may_move, (0, 1))
    is_node[plain].logical_and_(size[plain] != size.index_select(0, parent[plain]))
    name = flat_nonzero(is_node)
    number, around = renumber(name, count), parent.index_select(0, name)
    nearest = torch.where(is_node, torch.arange(count + 1, device=parent.device), parent)
    for _ in range(components.num_levels - 2):
        around = nearest.index_select(0, around)
    pixel = torch.arange(roots.shape[1], device=roots.device).repeat(components.num_levels)
    node = number.index_select(0, torch.cat((roots.flatten(), components.changed_root)))
    kept = flat_nonzero(node < len(name))
    node, pixel = gather(kept, node, torch.cat((pixel, components.changed)))
    return Nodes(
        component=name,
        level=torch.bucketize(name, torch.tensor(components.firsts[1:], device=name.device), right=True),
        parent=number.index_select(0, around),
        window=torch.zeros_like(name).scatter_(0, node, sweeps.pixels.window.index_select(0, pixel)),
        travels=travels.index_select(0, name),
        pixel=pixel,
        node=node,
    )


def select_objects(nodes: Nodes, components: Components, evidence: Tensor, num_pixels: int) -> tuple[Objects, Tensor]:
    """Select objects from the leaves up: a component wins if its motion has more evidence than its children together.

    Args:
        nodes, components: `nodes` includes components under overhangs, `components` does not.
        evidence: (N,) int64, of the best motion of each node; 0 = none is significant. Sums must stay below 2^63.
        num_pixels: P, including the pixels of copies (`HeightSlicedSweeps.with_copies`).

    Returns:
        The objects, and the node of each, (G,) int64, N = none. A pixel belongs to the coarsest of its nodes that won.
        If none won, it belongs to its node of changed pixels if that node has evidence. Otherwise it is static and
        belongs to its finest component, or to no object if that component is not linked. The pixel of a copy belongs to
        its node if that node has evidence, else to no object.

    Convention: the value of a child is its own evidence or the sum of its children's values, whichever is more, minus
        `_PRICE`, but at least 0. Ties: the children win.

    Cost: a few passes over the nodes for each level, and over the pixels.
    """
    count, num_levels = nodes.count, components.num_levels
    children = evidence.new_zeros(count + 1)
    for level in range(num_levels - 1, 0, -1):  # finer levels first: the children of a node are complete
        value = torch.maximum(evidence, children[:-1])
        value = (value - _PRICE).clamp_(min=0)
        children.index_add_(0, nodes.parent, value.masked_fill_(nodes.level != level, 0))
    own = torch.arange(count + 1, device=evidence.device)
    winner = own.masked_fill(F.pad(evidence, (0, 1)) <= children, count)
    parent = F.pad(nodes.parent, (0, 1), value=count)
    for _ in range(num_levels - 1):  # winners spread to their descendants, a level at a time
        winner = torch.minimum(winner, winner.index_select(0, parent))  # nodes are numbered coarse to fine

    # A pixel is in many nodes: those of the tree, those of changed pixels (its own or one that it joined, see
    # `add_unchanged`), or one under an overhang. At most one of those outside the tree has evidence.
    is_other = nodes.level >= num_levels
    finest_or_none = nodes.node.masked_fill(is_other.index_select(0, nodes.node), -1)
    other_or_none = nodes.node.masked_fill(~(is_other & (evidence > 0)).index_select(0, nodes.node), -1)
    both = torch.stack((finest_or_none, other_or_none))
    largest = both.new_full((2, num_pixels), -1).scatter_reduce_(1, nodes.pixel.expand_as(both), both, "amax")
    finest, other = largest.remainder_(count + 1)  # -1 becomes "none"
    moving = torch.minimum(winner.index_select(0, finest), other)
    none, num_own = components.count + count, components.roots.shape[1]
    static = torch.where(components.is_linked.index_select(0, components.roots[-1]), components.roots[-1], none)
    static = F.pad(static, (0, num_pixels - num_own), value=none)
    name = torch.where(moving < count, lookup(nodes.component, moving), static)
    objects = number_objects(name, none)
    return objects, renumber(nodes.component, none).index_select(0, objects.component)


def number_objects(name: Tensor, num_names: int) -> Objects:
    """Number the objects. `name`, (P,) int64, is the component of each pixel, or `num_names` if it has none."""
    is_used = torch.zeros(num_names + 1, dtype=torch.bool, device=name.device).index_fill_(0, name, True)
    component = flat_nonzero(is_used[:-1])
    position = torch.arange(len(name), device=name.device)
    first, order = segment_amin(position, name, num_names + 1, len(name)).index_select(0, component).sort()
    component = component.index_select(0, order)
    return Objects(renumber(component, num_names).index_select(0, name), component, first)
