"""Spatio-temporal clusters: connected components of all sweeps of a window together (Alg. clustering).

We dilate binary images, label their components, and split components that are too long.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import reduce

import torch
from torch import Tensor

from cflow_torch.config import ClusteringConfig
from cflow_torch.dense.coarse_to_fine import ProjectedSweeps
from cflow_torch.ops.indices import flat_nonzero, floor_divide, gather, lazy_empty, renumber, split_index
from cflow_torch.ops.kornia_engine import close_3x3_kornia, connected_components_kornia
from cflow_torch.ops.labeling import label_together, pad
from cflow_torch.ops.morphology import close_3x3
from cflow_torch.ops.segments import first_of_segment, segment_minmax


@dataclass(frozen=True)
class Pixels:
    """Occupied pixels of clusters, one entry per pixel and sweep."""

    cluster: Tensor  # (P,) int64
    step: Tensor  # (P,) int64, sweep that occupies the pixel: 0 = t+1, 1 = t, ...
    row: Tensor  # (P,) int64, in the image of the window
    col: Tensor  # (P,) int64, in the image of the window


@dataclass(frozen=True)
class Clusters:
    """Clusters with pixels both at t+1 and before, in order of window, then of first pixel in raster order."""

    window: Tensor  # (M,) int64, window of each cluster, ascending
    first: Tensor  # (M, 2) int64, top-left (row, col) of the bounding box over all sweeps
    size: Tensor  # (M, 2) int64, height and width of the box
    pixels: Pixels  # all occupied pixels of the clusters


def find_clusters(sweeps: ProjectedSweeps, config: ClusteringConfig) -> tuple[Clusters, Tensor, Tensor]:
    """Aggregate, dilate and label the sweeps of each window, split long components, keep those at t+1 and before.

    All engines of `labeling` return identical clusters.

    Returns:
        clusters: M clusters, which never join across windows (Alg. clustering).
        cluster_of_cell: (B * S * H * W + 1,) int32, cluster of each occupied pixel of each sweep, M = none; undefined
            for empty pixels. The last entry is for points outside the images; it is M.
        cell_of_point: (P,) int64, index of each point into `cluster_of_cell`.
    """
    images, pixel_size = sweeps.occupancy, sweeps.grid.pixel_size
    _, num_steps, height, width = images.shape
    area = height * width
    aggregated = pad(images.unbind(1))
    pixels = flat_nonzero(aggregated)
    padded_row, col = split_index(pixels, aggregated.shape[2])
    window, row = split_index(padded_row, aggregated.shape[1])
    indices = PixelIndices(pixels, padded_row, row, col)
    component, num_components = components_by_size(aggregated, height, width, indices, pixel_size, config)

    # The image of step m lies m images behind the image of t+1.
    cell = torch.add(col, row, alpha=width).add_(window, alpha=num_steps * area)
    flat = images.flatten()
    occupied = torch.stack([flat[m * area :].index_select(0, cell) for m in range(num_steps)])
    kept = flat_nonzero(_can_move(component, num_components, occupied))
    first, last = gather(kept, *segment_minmax(pixels, component, num_components))
    first, order = first.sort()
    kept, last = gather(order, kept, last)
    left, right = gather(kept, *segment_minmax(col, component, num_components))
    top, bottom = floor_divide(first, aggregated.shape[2]), floor_divide(last, aggregated.shape[2])
    window_of_cluster, top_in_window = split_index(top, aggregated.shape[1])
    cluster = renumber(kept, num_components).index_select(0, component)

    step, pixel = split_index(flat_nonzero((cluster < kept.numel()) & occupied), max(pixels.numel(), 1))
    cluster_of_pixel, row, col = gather(pixel, cluster, row, col)
    clusters = Clusters(
        window_of_cluster,
        torch.stack((top_in_window, left), 1),
        torch.stack((bottom - top, right - left), 1).add_(1),
        Pixels(cluster_of_pixel, step, row, col),
    )
    cluster_of_cell = lazy_empty(images.numel() + 1, torch.int32, images.device)
    cluster = cluster.int()
    for m in range(num_steps):
        cluster_of_cell[m * area :].scatter_(0, cell, cluster)
    cluster_of_cell[-1:] = kept.numel()
    return clusters, cluster_of_cell, sweeps.pixel


def _can_move(component: Tensor, num_components: int, occupied: Tensor) -> Tensor:
    """Return which components have pixels both at t+1 and before, (C,) bool. `occupied` is (S, P) bool, t+1 first."""
    newest, *older = occupied.unbind(0)
    before = reduce(torch.bitwise_or, older, torch.zeros_like(newest))
    kind = newest.byte() + (newest & before).byte()  # 0: occupied before only, 1: at t+1 only, 2: both
    index = torch.add(component, kind, alpha=num_components)
    has_kind = torch.zeros(3 * num_components, dtype=torch.bool, device=index.device).index_fill_(0, index, True)
    before_only, newest_only, both = has_kind.view(3, -1)
    return (before_only & newest_only).logical_or_(both)


@dataclass(frozen=True)
class PixelIndices:
    """Set pixels of padded images."""

    pixel: Tensor  # (P,) int64, flat index into the padded images
    padded_row: Tensor  # (P,) int64, row of the padded images, counted through all of them
    row: Tensor  # (P,) int64, row in the image
    col: Tensor  # (P,) int64, column in the image


def label_components(image: Tensor, pixels: Tensor, pixel_size: float, config: ClusteringConfig) -> Tensor:
    """Label the components of dilated images; erode those that are too long and label them again (Alg. clustering).

    `image` is (B, H, W) bool. `pixels` are the flat indices of its set pixels, (P,) int64, ascending. The result, (P,)
    int64, gives for each pixel the position in `pixels` of the first pixel of its component.
    """
    _, height, width = image.shape
    padded = pad([image])
    image_row, col = split_index(pixels, width)
    window, row = split_index(image_row, height)
    padded_row = torch.add(row, window, alpha=padded.shape[1])
    indices = PixelIndices(torch.add(col, padded_row, alpha=padded.shape[2]), padded_row, row, col)
    return first_of_segment(*components_by_size(padded, height, width, indices, pixel_size, config))


def components_by_size(
    padded: Tensor, height: int, width: int, indices: PixelIndices, pixel_size: float, config: ClusteringConfig
) -> tuple[Tensor, int]:
    """Return the component of each set pixel, (P,) int64, and a number above the largest component.

    `height` and `width` are H and W of the images without padding. We erode all oversized components together. They do
    not affect each other, because no 3 x 3 square inside the dilated components has pixels of two of them.
    """
    component, count = _components(padded, indices, 3, config)
    top, bottom = segment_minmax(indices.row, component, count)
    left, right = segment_minmax(indices.col, component, count)
    # The dilation adds a pixel on every side, except at the border of the image.
    num_rows = bottom.clamp_(max=height - 2).sub_(top.clamp_(min=1))
    num_cols = right.clamp_(max=width - 2).sub_(left.clamp_(min=1))
    extent = torch.maximum(num_rows, num_cols).add_(3)
    is_oversized = extent.double() * pixel_size > config.max_extent
    if not is_oversized.any():
        return component, count

    oversized = is_oversized.index_select(0, component)
    alone = torch.zeros_like(padded).view(-1).scatter_(0, indices.pixel, oversized).view_as(padded)
    if config.labeling == "kornia":
        closed = pad([close_3x3_kornia(alone[:, :height, :width])])
    else:
        closed = close_3x3(alone, height, width)
    piece, num_pieces = _components(closed, indices, 1, config)
    return torch.where(oversized, piece.add_(count), component), count + num_pieces


def _components(padded: Tensor, indices: PixelIndices, reach: int, config: ClusteringConfig) -> tuple[Tensor, int]:
    """Label once, after a 3 x 3 dilation if `reach` is 3. Returns as for `components_by_size`."""
    if config.labeling == "kornia":
        component = connected_components_kornia(padded, indices.pixel, config.connectivity, reach)
        return component, indices.pixel.numel()
    (blocks,) = label_together([(padded, reach)], config.connectivity)
    return blocks.of_pixel(indices.padded_row, indices.col), blocks.num_components
