"""Components of the finest pixels at several pixel sizes: hypotheses of what moves together."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Tuple

import torch
from torch import Tensor

from cflow_torch.config import Config
from cflow_torch.dense.clustering import Clusters, find_clusters
from cflow_torch.ops.indices import divide, flat_nonzero
from cflow_torch.ops.segments import bounding_boxes, segment_amin
from cflow_torch.verified.height_slices import NUM_SLICES, Cells


@dataclass(frozen=True)
class Level:
    """Components at one pixel size, all windows.

    Args:
        block: k, finest pixels a side of a pixel of this level.
        height, width: pixels of an image of this level.
        image: (B * S * height * width + 1,) uint8, slices of each pixel; the last entry, always 0, is for whatever lies
            outside the images.
        clusters: M components; their boxes and pixels are in pixels of this level.
        node: (P,) int64, component of each occupied finest pixel, M = none.
        too_long: (M,) bool, longer at t+1 than any object: it does not move.
    """

    block: int
    height: int
    width: int
    image: Tensor
    clusters: Clusters
    node: Tensor
    too_long: Tensor


def make_level(cells: Cells, block: int, reach: int, max_object: float, config: Config) -> Level:
    """Components at one pixel size.

    Args:
        cells: finest images and their P occupied pixels.
        block: k, finest pixels a side of a pixel of this level.
        reach: 3 = Alg. clustering (dilated, eroded again if oversized); 1 = plain components, for the parts of those.
        max_object: metres; infinite = nothing is too long.
        config: `connectivity`, `max_extent`, `labeling`.

    Returns:
        The level. A coarse pixel has the slices of all its finest pixels; no point is projected again. Lengths at t+1
        are the longer side of the box of the finest pixels.

    Cost: as `cluster`, and some passes over the images of this level and the finest pixels.
    """
    height, width = -(-cells.grid.height // block), -(-cells.grid.width // block)
    image, column = coarsen(cells, block, height, width)
    images = image[:-1].view(cells.num_windows, cells.num_steps, height, width)
    clusters, columns = find_clusters(images, cells.grid.pixel_size * block, config, reach)
    num_components, area = clusters.window.numel(), height * width
    of_column = torch.empty(cells.num_windows * area, dtype=torch.int64, device=column.device)
    of_column.scatter_(0, torch.add(columns.pixel, columns.window, alpha=area), columns.cluster)
    node = of_column.index_select(0, column)  # empty columns are never asked for
    newest = flat_nonzero((cells.step == 0) & (node < num_components))
    row, col, component = (values.index_select(0, newest) for values in (cells.row, cells.col, node))
    _, size = bounding_boxes(row, col, component, num_components)  # every component has pixels at t+1
    too_long = torch.maximum(size[:, 0], size[:, 1]).double() * cells.grid.pixel_size > max_object
    return Level(block, height, width, image, clusters, node, too_long)


def parents(node: Tensor, num_nodes: int, above: Tensor, num_above: int) -> Tensor:
    """The component of the coarser level that holds each component.

    Components are nested but where an oversized one was eroded and fell apart: then one pixel decides.

    Args:
        node: (P,) int64, component of each finest pixel at a level, M = none.
        num_nodes: M.
        above: (P,) int64, the same at the next coarser level, N = none.
        num_above: N.

    Returns:
        (M,) int64, component of the first pixel (in the order of the list) that has one above; N = none has.
    """
    num_pixels = node.numel()
    held = flat_nonzero(above < num_above)
    first = segment_amin(held, node.index_select(0, held), num_nodes + 1, num_pixels)[:num_nodes]
    padded = torch.cat((above, above.new_full((1,), num_above)))
    return padded.index_select(0, first)


def equals_parent(node: Tensor, num_nodes: int, above: Tensor, num_above: int, parent: Tensor) -> Tensor:
    """Which components have the same pixels as their parent, so that its estimates are theirs.

    Args:
        node, num_nodes, above, num_above: as for `parents`.
        parent: (M,) int64, as `parents` gives it.

    Returns:
        (M,) bool.
    """
    size = torch.bincount(node, minlength=num_nodes + 1)[:num_nodes]
    size_above = torch.bincount(above, minlength=num_above + 1)
    padded = torch.cat((parent, parent.new_full((1,), num_above)))
    shared = flat_nonzero((padded.index_select(0, node) == above) & (above < num_above))
    common = torch.bincount(node.index_select(0, shared), minlength=num_nodes + 1)[:num_nodes]
    return (common == size) & (common == size_above.index_select(0, parent)) & (parent < num_above)


def coarsen(cells: Cells, block: int, height: int, width: int) -> Tuple[Tensor, Tensor]:
    """Image of coarse pixels, as in `Level`, and (P,) int64 the column of each occupied finest pixel.

    A column is a coarse pixel whatever the sweep: (window * height + row) * width + col.
    """
    row, col = (cells.row, cells.col) if block == 1 else (divide(cells.row, block), divide(cells.col, block))
    column = torch.add(col, torch.add(row, cells.window, alpha=height), alpha=width)
    if block == 1:
        return cells.image, column
    area = height * width
    place = torch.add(column, torch.add(cells.step, cells.window, alpha=cells.num_steps - 1), alpha=area)
    image = torch.zeros(cells.num_windows * cells.num_steps * area + 1, dtype=torch.uint8, device=place.device)
    # A pass per slice: within a pass all pixels of a block write the same value, so their order does not matter.
    for index in range(NUM_SLICES):
        at = place.index_select(0, flat_nonzero((cells.slices & (1 << index)).bool()))
        image.index_copy_(0, at, image.index_select(0, at).bitwise_or_(1 << index))
    return image, column
