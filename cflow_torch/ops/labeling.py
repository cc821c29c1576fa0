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
from typing import NamedTuple, Sequence

import torch
import torch.nn.functional as F
from torch import Tensor

from cflow_torch.ops.groups import Groups
from cflow_torch.ops.indices import constant, flat_nonzero, floor_divide, index_dtype, split_index
from cflow_torch.ops.kornia_engine import connected_components_kornia

# Half of the eight neighbours of a block. Links to the other half are found from the other block.
_NEIGHBOURS = ((0, 1), (1, 0), (1, 1), (1, -1))
# We pad images so that whole blocks of any side (1 ... 4) fill them and the last row and column of blocks are empty.
# Then neighbours need no bounds checks.
_GRAIN = 12
_FREE = 4
# We read one row of a block as one number. Rows of three pixels get an empty fourth pixel.
_WORD = {1: torch.int8, 2: torch.int16, 3: torch.int32, 4: torch.int32}
# Rounds of union-find before the first test for convergence, and pointer jumps per round. LiDAR images need three to
# five rounds. After the first test, we test after every round.
_ROUNDS = 3
_JUMPS = 3


@dataclass(frozen=True)
class Blocks:
    """The connected component of each square block of pixels in a set of padded images."""

    side: int  # pixels per side of a block
    cols: int  # blocks per row
    num_components: int  # V, larger than the number of every component
    component: Tensor  # (all blocks,) int32 or int64, 0 ... V - 1; undefined for blocks without set pixels

    def of_pixel(self, row: Tensor, col: Tensor) -> Tensor:
        """Component of the pixels at (row, col), (P,) int64. Rows continue from one padded image to the next."""
        block = floor_divide(row, self.side) * self.cols + floor_divide(col, self.side)
        return self.component.index_select(0, block).long()


def pad(images: Sequence[Tensor]) -> Tensor:
    """Combine sets of (B, H, W) bool images with OR, and add the margin to the right and below that `label_together`
    needs: (B, H', W') bool."""
    num_images, height, width = images[0].shape
    padded = images[0].new_empty((num_images, padded_size(height), padded_size(width)))
    padded[:, height:] = 0
    padded[:, :height, width:] = 0
    inside = padded[:, :height, :width]
    if len(images) == 1:
        inside.copy_(images[0])
    else:
        torch.bitwise_or(images[0], images[1], out=inside)
    for image in images[2:]:
        inside |= image
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
    kinds = tuple(_Kind(reach, connectivity, padded.shape[2]) for padded, reach in images)
    parts = [_block_masks(padded, kind.side) for (padded, _), kind in zip(images, kinds)]
    lengths = [len(part) for part in parts]
    masks = torch.cat(parts) if len(parts) > 1 else parts[0]
    nodes = flat_nonzero(masks.bool())  # [V]; on the CPU ten times faster than `masks != 0`
    first_blocks = constant(tuple(accumulate(lengths[:-1])), torch.int64, masks.device)  # of all sets but the first
    components = _components(masks, nodes, kinds, first_blocks).split(lengths)
    return [Blocks(kind.side, kind.cols, len(nodes), component) for kind, component in zip(kinds, components)]


class _Kind(NamedTuple):
    """What a set of images says about the links of its blocks."""

    reach: int
    connectivity: int
    width: int  # W', pixels of a row

    @property
    def side(self) -> int:
        """Pixels per side of a block, in which all pixels are linked."""
        return self.reach + 1 if self.connectivity == 8 else self.reach

    @property
    def cols(self) -> int:
        """Blocks per row."""
        return self.width // self.side


def _components(masks: Tensor, nodes: Tensor, kinds: tuple[_Kind, ...], first_blocks: Tensor) -> Tensor:
    """Return the component of each block, (blocks,); undefined for blocks without set pixels. Args: `_links`."""
    dtype = index_dtype(len(nodes), masks.device)
    node_of_block = torch.empty(masks.shape, dtype=dtype, device=masks.device)
    node_of_block.scatter_(0, nodes, torch.arange(len(nodes), dtype=dtype, device=masks.device))
    node, block = _links(masks, nodes, kinds, first_blocks)
    root = union_find(len(nodes), node, node_of_block.index_select(0, block).long())
    return node_of_block.scatter_(0, nodes, root.to(dtype))


def _links(masks: Tensor, nodes: Tensor, kinds: tuple[_Kind, ...], first_blocks: Tensor) -> tuple[Tensor, Tensor]:
    """Find the linked neighbours of all nodes.

    A byte of a mask is a column of a block, its bits are the rows. As no column has more than four rows, half a block
    fits a byte, and this byte is a row of the table of `_reachable`:

        mask        ....dddd ....cccc ....bbbb ....aaaa     columns a b c d
        halves                        ddddcccc bbbbaaaa     right and left half

    Args:
        masks: (blocks,) int8, int16 or int32, of all sets.
        nodes: (V,) int64, blocks that have pixels.
        kinds: of each set.
        first_blocks: (sets - 1,) int64, first block of each set but the first.

    Returns:
        The node and the linked block, (E,) int64 each, of each link.
    """
    offsets, tables = _neighbourhoods(kinds, masks.device)
    mask = masks.index_select(0, nodes).int()
    columns = mask | mask >> 4
    left = columns & 0xFF
    right = (columns >> 16 & 0xFF) + 256
    if len(kinds) > 1:
        set_of_node = torch.bucketize(nodes, first_blocks, right=True)
        left = left + 512 * set_of_node
        right = right + 512 * set_of_node
        offsets = offsets.index_select(0, set_of_node)
    reached = tables.index_select(0, left)  # [V, 4], masks of the pixels that each neighbour would need
    if max(kind.side for kind in kinds) > 2:
        reached |= tables.index_select(0, right)
    neighbours = nodes[:, None] + offsets  # [V, 4]
    is_linked = (reached & masks.index_select(0, neighbours.view(-1)).view_as(reached)).bool()
    links = flat_nonzero(is_linked)
    return floor_divide(links, len(_NEIGHBOURS)), neighbours.view(-1).index_select(0, links)


def _block_masks(padded: Tensor, side: int) -> Tensor:
    """(blocks,) int8, int16 or int32: a byte for each column of a block, whose bits are its rows."""
    cells = F.pad(padded.view(-1, 3), (0, 1)) if side == 3 else padded
    words = cells.view(-1).view(_WORD[side]).view(-1, side, padded.shape[2] // side)
    masks = words[:, 0]
    for row in range(1, side):
        masks = torch.add(masks, words[:, row], alpha=1 << row)
    return masks.flatten()


def label_pixels(
    padded: Tensor, pixel: Tensor, row: Tensor, col: Tensor, connectivity: int, reach: int, engine: str
) -> tuple[Tensor, int]:
    """Label the set pixels of padded images.

    Args:
        padded: (B, H', W') bool, from `pad`.
        pixel, row, col: (P,) int64, flat index of each set pixel, ascending, and its row and column. Rows continue from
            one image to the next.
        connectivity: 4 or 8.
        reach: 1 (plain) or 3 (as after a 3 x 3 dilation).
        engine: "sparse" or "kornia"; the same components, whose numbers differ.

    Returns:
        The component of each pixel, (P,) int64, and a number above the largest component.
    """
    if engine == "kornia":
        return connected_components_kornia(padded, pixel, connectivity, reach), pixel.numel()
    (blocks,) = label_together([(padded, reach)], connectivity)
    return blocks.of_pixel(row, col), blocks.num_components


def connected_components(
    occupancy: Tensor, pixels: Tensor, connectivity: int = 8, reach: int = 1, engine: str = "sparse"
) -> Tensor:
    """Label every set pixel.

    Args:
        occupancy: (B, H, W) bool images.
        pixels: (P,) int64, flat indices into `occupancy` of the set pixels, ascending (`flatten().nonzero()`).
        connectivity: 4 or 8.
        reach: 1 (plain) or 3 (as after a 3 x 3 dilation).
        engine: "sparse" or "kornia"; the same result.

    Returns:
        (P,) int64: for each pixel, the position in `pixels` of the first pixel of its component, in raster order.

    Convention:
        Components never join across images. The result does not depend on thread count or device.

    Cost: as `label_together`.
    """
    padded = pad([occupancy])
    row, col = split_index(pixels, occupancy.shape[2])
    height = occupancy.shape[1]
    row = torch.add(row, floor_divide(row, height), alpha=padded.shape[1] - height)
    pixel = row * padded.shape[2] + col
    components = Groups(*label_pixels(padded, pixel, row, col, connectivity, reach, engine))
    return components.spread(components.first())


def union_find(num_nodes: int, sources: Tensor, targets: Tensor) -> Tensor:
    """Find the connected components of a graph of V nodes by hooking and pointer jumping.

    `sources` and `targets`, (E,) int64, are the two ends of each edge. The result, (V,) int64, is the smallest node of
    the component of each node.

    Cost: a few rounds (about log V), each linear in V + E, with one host synchronisation after three rounds and after
    each further one. A parent only changes to a smaller node of the same component. Once both ends of every edge have
    the same parent, that parent is the root.
    """
    parent = torch.arange(num_nodes, device=sources.device)
    ends = torch.cat((sources, targets))
    parents = torch.stack((sources, targets))  # [2, E], of both ends of each edge
    num_rounds = _ROUNDS
    while True:
        for _ in range(num_rounds):
            parent = _hook(parent, *parents)
            for _ in range(_JUMPS):
                parent = parent.index_select(0, parent)
            parents = parent.index_select(0, ends).view(2, -1)
        if torch.equal(parents[0], parents[1]):
            return parent
        num_rounds = 1


def _hook(parent: Tensor, one: Tensor, other: Tensor) -> Tensor:
    """Hook the larger parent of each edge to the smaller one. The other direction has no effect."""
    return parent.scatter_reduce_(0, other, one, "amin").scatter_reduce_(0, one, other, "amin")


@lru_cache(maxsize=256)
def _neighbourhoods(kinds: tuple[_Kind, ...], device: torch.device) -> tuple[Tensor, Tensor]:
    """(sets, 4) int64 offsets of the neighbours of a block, and (512 sets, 4) int32 tables of `_reachable`."""
    offsets = [[down * kind.cols + right for down, right in _NEIGHBOURS] for kind in kinds]
    tables = [_reachable(kind.side, kind.connectivity, kind.reach) for kind in kinds]
    return torch.tensor(offsets, device=device), torch.cat(tables).to(device)


@lru_cache(maxsize=32)
def _reachable(side: int, connectivity: int, reach: int) -> Tensor:
    """(512, 4) int32: mask of the pixels of each neighbour that are linked to a block.

    Rows 0 ... 255 are for the left half of the block, rows 256 ... 511 for the right half, see `_links`.
    """
    half = torch.arange(2)[:, None]
    bits = torch.arange(256, dtype=torch.int32)
    tables = []
    for down, right in _NEIGHBOURS:
        table = torch.zeros((2, 256), dtype=torch.int32)
        for row, col, other_row, other_col in product(range(side), repeat=4):
            dy = abs(down * side + other_row - row)
            dx = abs(right * side + other_col - col)
            if max(dy, dx) <= reach and not (connectivity == 4 and dy == dx == reach):
                is_set = (bits >> (4 * (col % 2) + row)) & 1
                table |= torch.where(half == col // 2, is_set, 0) << (8 * other_col + other_row)
        tables.append(table.flatten())
    return torch.stack(tables, 1)
