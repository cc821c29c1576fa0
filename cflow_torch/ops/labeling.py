"""Connected components of sparse binary images, many images at once, in a handful of tensor operations.

Two pixels are linked if they lie within `reach` of each other (Chebyshev distance); with connectivity 4 the
corner offsets |dx| = |dy| = reach do not link. `reach=1` is plain labelling. `reach=3` labels the pixels as if the
image had been dilated with a 3 x 3 square first: two dilated squares touch exactly at those offsets. No dilated
image is needed.

Idea: in a block of `reach + 1` pixels a side (`reach` for connectivity 4) every two pixels are linked, so a block is
one node of a graph and only adjacent blocks can be linked. Whether they are is one table look-up on the blocks' bit
masks. Union-find then works on a few thousand blocks instead of pixels.
"""

from __future__ import annotations

from functools import lru_cache

import torch
from torch import Tensor

from cflow_torch.ops.indices import flat_nonzero
from cflow_torch.ops.segments import first_of_segment
from cflow_torch.types import CFlowError

# Half of the eight neighbours of a block; the other half is the same links seen from the other side.
_NEIGHBOURS = ((0, 1), (1, 0), (1, 1), (1, -1))


def connected_components(occupancy: Tensor, pixels: Tensor, connectivity: int = 8, reach: int = 1) -> Tensor:
    """Component of every set pixel.

    Args:
        occupancy: (B, H, W) bool images.
        pixels: (P,) int64, flat indices into `occupancy` of the set pixels, ascending (`flatten().nonzero()`).
        connectivity: 4 or 8.
        reach: 1 (plain) or 3 (as after a 3 x 3 dilation).

    Returns:
        (P,) int64: the position in `pixels` of the first (in raster order) pixel of the same component.

    Convention:
        Components never join across images. The result does not depend on thread count or device.

    Cost: linear in set pixels plus B * H * W / block area; a few rounds of union-find with one host
    synchronisation each.
    Source: Sec. clustering; contraction of blocks as in block-based labelling (bolelli2022connected).
    """
    num_images, height, width = occupancy.shape
    if pixels.numel() == 0:
        return pixels.clone()
    side = reach + 1 if connectivity == 8 else reach
    rows_of_blocks, cols_of_blocks = -(-height // side) + 1, -(-width // side) + 2  # free border: no bounds checks
    image_row = pixels // width
    image, col = image_row // height, pixels - image_row * width
    row = image_row - image * height
    block_row, block_col = row // side, col // side
    block = (image * rows_of_blocks + block_row) * cols_of_blocks + block_col + 1
    bit = torch.ones_like(pixels) << ((row - block_row * side) * side + col - block_col * side)

    # One more row of blocks than needed keeps the look-ups below the last row inside the tensor.
    masks = pixels.new_zeros(num_images * rows_of_blocks * cols_of_blocks + cols_of_blocks + 2)
    masks.scatter_add_(0, block, bit)  # distinct bits: adding is OR-ing
    nodes = flat_nonzero(masks > 0)
    node_of_block = torch.empty_like(masks)
    node_of_block.scatter_(0, nodes, torch.arange(nodes.numel(), device=pixels.device))

    # Four look-ups per block: which of its neighbours hold a pixel that one of its own pixels reaches?
    offsets = torch.tensor([down * cols_of_blocks + right for down, right in _NEIGHBOURS], device=pixels.device)
    neighbours = nodes[:, None] + offsets
    reached = _reachable(side, connectivity, reach, pixels.device).index_select(0, masks.index_select(0, nodes))
    edges = flat_nonzero((reached & masks.take(neighbours)) != 0)
    targets = node_of_block.index_select(0, neighbours.flatten().index_select(0, edges))
    root = union_find(nodes.numel(), edges // len(_NEIGHBOURS), targets)

    component = root.index_select(0, node_of_block.index_select(0, block))
    return first_of_segment(component, nodes.numel())


def union_find(num_nodes: int, sources: Tensor, targets: Tensor) -> Tensor:
    """Connected components of a graph by hooking and pointer jumping.

    Args:
        num_nodes: V.
        sources, targets: (E,) int64, the two ends of each edge.

    Returns:
        (V,) int64: the smallest node of the same component.

    Cost: a few rounds (about log V), each linear in V + E, with one host synchronisation.
    """
    parent = torch.arange(num_nodes, device=sources.device)
    while sources.numel() > 0:
        low, high = torch.minimum(sources, targets), torch.maximum(sources, targets)
        parent.scatter_reduce_(0, high, low, "amin")  # hook roots onto smaller roots: never a cycle
        while True:
            ancestor = parent.index_select(0, parent)
            ancestor = ancestor.index_select(0, ancestor)  # twice as far for one look whether anything moved
            if torch.equal(ancestor, parent):
                break
            parent = ancestor
        sources, targets = parent.index_select(0, sources), parent.index_select(0, targets)
        open_edges = flat_nonzero(sources != targets)
        sources, targets = sources.index_select(0, open_edges), targets.index_select(0, open_edges)
    return parent


def connected_components_kornia(occupancy: Tensor, pixels: Tensor, connectivity: int = 8) -> Tensor:
    """`connected_components` with reach 1 by kornia's exact union-find on the dense images.

    Args, Returns: as `connected_components`.

    Raises:
        CFlowError: kornia older than 0.9, which has no exact labelling (its iterative one splits long components).

    Convention:
        kornia labels with 8-connectivity. Connectivity 4 labels an image of twice the size, in which a link pixel
        stands between two set pixels that share a side; there the two connectivities agree.

    Cost: linear in B * H * W.
    """
    try:
        from kornia.contrib import connected_components_union_find
    except ImportError:
        from kornia import __version__ as version

        raise CFlowError(
            f"labeling='kornia' needs kornia >= 0.9 (exact union-find labelling), found {version}: "
            "upgrade kornia or use labeling='sparse', which gives the same result"
        ) from None
    image = occupancy
    if connectivity == 4:
        num_images, height, width = occupancy.shape
        image = occupancy.new_zeros((num_images, 2 * height, 2 * width))
        image[:, ::2, ::2] = occupancy
        image[:, 1:-1:2, ::2] = occupancy[:, 1:] & occupancy[:, :-1]
        image[:, ::2, 1:-1:2] = occupancy[:, :, 1:] & occupancy[:, :, :-1]
    labels = connected_components_union_find(image[:, None])[:, 0]
    if connectivity == 4:
        labels = labels[:, ::2, ::2]
    return first_of_segment(labels.reshape(-1)[pixels], image.numel() + 1)


@lru_cache(maxsize=None)
def _reachable(side: int, connectivity: int, reach: int, device: torch.device) -> Tensor:
    """(2^(side^2), 4) int64: mask of a block -> for each neighbour, the mask of its pixels that are linked to it."""
    masks = torch.arange(1 << side * side)
    tables = []
    for down, right in _NEIGHBOURS:
        table = torch.zeros_like(masks)
        for bit in range(side * side):
            linked = 0
            for other in range(side * side):
                dy = abs(down * side + other // side - bit // side)
                dx = abs(right * side + other % side - bit % side)
                near = max(dy, dx) <= reach and not (connectivity == 4 and dy == dx == reach)
                linked |= near << other
            table |= torch.where((masks >> bit) & 1 == 1, linked, 0)
        tables.append(table)
    return torch.stack(tables, 1).to(device)
