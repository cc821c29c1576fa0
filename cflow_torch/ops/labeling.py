"""Label the connected components of sparse binary images, many images at once, in a few tensor operations.

Two pixels are linked if they are within `reach` of each other (Chebyshev distance). With connectivity 4 the corner
offsets |dx| = |dy| = reach do not link. `reach=1` is plain labelling. `reach=3` gives the labels of the image after a
3 x 3 dilation, without a dilated image, because two dilated pixels touch or overlap exactly at these offsets.

Idea: in a block with sides of `reach + 1` pixels (`reach` for connectivity 4), all pixels are linked. So a block is one
node of a graph, and only adjacent blocks can be linked. Table lookups on the bit masks of two blocks tell whether they
are. Union-find then works on a few thousand blocks instead of pixels.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from itertools import accumulate, product
from typing import Sequence

import torch
import torch.nn.functional as F
from torch import Tensor

from cflow_torch.ops.indices import constant, flat_nonzero, floor_divide, split_index
from cflow_torch.ops.segments import first_of_segment

# Half of the eight neighbours of a block. Links to the other half are found from the other block.
_NEIGHBOURS = ((0, 1), (1, 0), (1, 1), (1, -1))
# We pad images so that whole blocks of any side (1 ... 4) fill them and the last row and column of blocks are empty.
# Then neighbours need no bounds checks.
_GRAIN, _FREE = 12, 4
# We read one row of a block as one number. Rows of three pixels get an empty fourth pixel.
_WORD = {1: torch.int8, 2: torch.int16, 3: torch.int32, 4: torch.int32}
# Rounds of union-find before the first test for convergence, and pointer jumps per round. LiDAR images need three to
# five rounds. After the first test, we test after every round.
_ROUNDS, _JUMPS = 3, 3


@dataclass(frozen=True)
class Blocks:
    """The connected component of each square block of pixels in a set of padded images."""

    side: int  # pixels per side of a block
    cols: int  # blocks per row
    first: int  # no component of these images has a smaller number
    num_components: int  # V, larger than the number of every component
    component: Tensor  # (all blocks,) int64, 0 ... V - 1; undefined for blocks without set pixels

    def of_pixel(self, row: Tensor, col: Tensor) -> Tensor:
        """Component of the pixels at (row, col), (P,) int64. Rows continue from one padded image to the next."""
        row, col = floor_divide(row, self.side), floor_divide(col, self.side)
        return self.component.index_select(0, torch.add(col, row, alpha=self.cols))


def pad(images: Sequence[Tensor]) -> Tensor:
    """Combine sets of (B, H, W) bool images with OR, and add the margin to the right and below that `label_together`
    needs: (B, H', W') bool."""
    first = images[0]
    num_images, height, width = first.shape
    padded = first.new_empty((num_images, padded_size(height), padded_size(width)))
    padded[:, height:] = 0
    padded[:, :height, width:] = 0
    inside = padded[:, :height, :width]
    if len(images) == 1:
        inside.copy_(first)
    else:
        torch.bitwise_or(first, images[1], out=inside)
    for more in images[2:]:
        inside |= more
    return padded.bool()


def padded_size(size: int) -> int:
    """Height or width of padded images."""
    return -(-(size + _FREE) // _GRAIN) * _GRAIN


def label_together(images: Sequence[tuple[Tensor, int]], connectivity: int = 8) -> list[Blocks]:
    """Label several sets of padded images with one union-find.

    Args:
        images: a pair for each set: (B, H', W') bool from `pad`, and the reach, 1 (plain) or 3 (as after a 3 x 3
            dilation).
        connectivity: 4 or 8.

    Returns:
        The components of each set. The number of a component is that of one of its blocks that have set pixels. Sets
        share the numbering: the numbers of a set follow those of the set before, and `num_components` is the same.

    Cost: one pass over the images, a few rounds of union-find over their blocks, and some host synchronisations. The
    number of kernel launches hardly grows with the number of sets.

    Source: Sec. clustering; contraction of blocks as in block-based labelling (bolelli2022connected).
    """
    device, num_sets = images[0][0].device, len(images)
    sides = [reach + 1 if connectivity == 8 else reach for _, reach in images]
    cols = [padded.shape[2] // side for (padded, _), side in zip(images, sides)]
    parts = [_block_masks(padded, side) for (padded, _), side in zip(images, sides)]
    masks = parts[0] if num_sets == 1 else torch.cat(parts)
    nodes = flat_nonzero(masks.bool())  # on the CPU ten times faster than `masks != 0`
    node_of_block = torch.empty(masks.shape, dtype=torch.int64, device=device)
    node_of_block.scatter_(0, nodes, torch.arange(nodes.numel(), device=device))

    # One lookup for each half of a block tells which pixels of its four neighbours it reaches.
    own = masks.index_select(0, nodes).int()
    own |= own >> 4  # two columns of at most four bits in a byte
    offsets, tables = _neighbourhoods(tuple(sides), tuple(cols), connectivity, tuple(r for _, r in images), device)
    left, right = own & 0xFF, ((own >> 16) & 0xFF).add_(1 << 8)
    if num_sets > 1:
        ends = constant(tuple(accumulate(len(part) for part in parts[:-1])), torch.int64, device)
        of_set = torch.bucketize(nodes, ends, right=True)
        left, right = (torch.add(columns, of_set, alpha=1 << 9) for columns in (left, right))
        offsets = offsets.index_select(0, of_set)
    reached = tables.index_select(0, left)
    if max(sides) > 2:
        reached |= tables.index_select(0, right)
    neighbours = nodes[:, None] + offsets
    edges = flat_nonzero((reached & masks.take(neighbours)).bool())
    targets = node_of_block.index_select(0, neighbours.view(-1).index_select(0, edges))
    root = union_find(nodes.numel(), edges >> 2, targets)  # four neighbours
    component = node_of_block.scatter_(0, nodes, root).split([len(part) for part in parts])
    first = [0, *torch.searchsorted(nodes, ends).tolist()] if num_sets > 1 else [0]
    return [
        Blocks(side, width, start, nodes.numel(), part)
        for side, width, start, part in zip(sides, cols, first, component)
    ]


def _block_masks(padded: Tensor, side: int) -> Tensor:
    """(blocks,) int8, int16 or int32: a byte for each column of a block, whose bits are its rows."""
    cells = F.pad(padded.view(-1, 3), (0, 1)) if side == 3 else padded
    words = cells.view(-1).view(_WORD[side]).view(-1, side, padded.shape[2] // side)
    masks = words[:, 0]
    for row in range(1, side):
        masks = torch.add(masks, words[:, row], alpha=1 << row)
    return masks.flatten()


def connected_components(occupancy: Tensor, pixels: Tensor, connectivity: int = 8, reach: int = 1) -> Tensor:
    """Label every set pixel.

    Args:
        occupancy: (B, H, W) bool images.
        pixels: (P,) int64, flat indices into `occupancy` of the set pixels, ascending (`flatten().nonzero()`).
        connectivity: 4 or 8.
        reach: 1 (plain) or 3 (as after a 3 x 3 dilation).

    Returns:
        (P,) int64: for each pixel, the position in `pixels` of the first pixel of its component, in raster order.

    Convention:
        Components never join across images. The result does not depend on thread count or device.

    Cost: as `label_together`.
    """
    (blocks,) = label_together([(pad([occupancy]), reach)], connectivity)
    row, col = split_index(pixels, occupancy.shape[2])
    height = occupancy.shape[1]
    row = torch.add(row, floor_divide(row, height), alpha=padded_size(height) - height)
    component = blocks.of_pixel(row, col)
    return first_of_segment(component, blocks.num_components)


def union_find(num_nodes: int, sources: Tensor, targets: Tensor) -> Tensor:
    """Find the connected components of a graph of V nodes by hooking and pointer jumping.

    `sources` and `targets`, (E,) int64, are the two ends of each edge. The result, (V,) int64, is the smallest node of
    the component of each node.

    Cost: a few rounds (about log V), each linear in V + E, with one host synchronisation after three rounds and after
    each further one. A parent only changes to a smaller node of the same component. Once both ends of every edge have
    the same parent, that parent is the root.
    """
    parent = torch.arange(num_nodes, device=sources.device)
    ends, low, high, num_rounds = torch.cat((sources, targets)), sources, targets, _ROUNDS
    while True:
        for _ in range(num_rounds):
            # Hook the larger parent of an edge to the smaller one; the other direction has no effect.
            parent.scatter_reduce_(0, high, low, "amin").scatter_reduce_(0, low, high, "amin")
            for _ in range(_JUMPS):
                parent = parent.index_select(0, parent)
            low, high = parent.index_select(0, ends).view(2, -1)
        if torch.equal(low, high):
            return parent
        num_rounds = 1


@lru_cache(maxsize=256)
def _neighbourhoods(
    sides: tuple[int, ...], cols: tuple[int, ...], connectivity: int, reaches: tuple[int, ...], device: torch.device
) -> tuple[Tensor, Tensor]:
    """(sets, 4) int64 offsets of the neighbours of a block, and (512 sets, 4) int32 tables of `_reachable`."""
    offsets = torch.tensor([[down * width + right for down, right in _NEIGHBOURS] for width in cols], device=device)
    tables = [_reachable(side, connectivity, reach, device) for side, reach in zip(sides, reaches)]
    return offsets, torch.cat(tables)


@lru_cache(maxsize=32)
def _reachable(side: int, connectivity: int, reach: int, device: torch.device) -> Tensor:
    """(512, 4) int32: mask of the pixels of each neighbour that are linked to a block.

    Rows 0 ... 255 are for the first two columns of the block, four bits each, rows 256 ... 511 for the last two.
    """
    half, bits = torch.arange(2)[:, None], torch.arange(1 << 8, dtype=torch.int32)
    tables = []
    for down, right in _NEIGHBOURS:
        table = torch.zeros((2, 1 << 8), dtype=torch.int32)
        for row, col, other_row, other_col in product(range(side), repeat=4):
            dy, dx = abs(down * side + other_row - row), abs(right * side + other_col - col)
            if max(dy, dx) <= reach and not (connectivity == 4 and dy == dx == reach):
                is_set = (bits >> (4 * (col % 2) + row)) & 1
                table |= torch.where(half == col // 2, is_set, 0) << (8 * other_col + other_row)
        tables.append(table.flatten())
    return torch.stack(tables, 1).to(device)
