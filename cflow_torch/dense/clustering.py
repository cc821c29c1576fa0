"""Spatio-temporal clusters: connected components of all sweeps of a window together (Alg. clustering)."""

from __future__ import annotations

from dataclasses import dataclass
from functools import reduce

import torch
from torch import Tensor

from cflow_torch.config import ClusteringConfig
from cflow_torch.dense.coarse_to_fine import ProjectedSweeps
from cflow_torch.dense.components import PixelIndices, components_by_size
from cflow_torch.ops.indices import flat_nonzero, floor_divide, gather, lazy_empty, renumber, split_index
from cflow_torch.ops.labeling import pad
from cflow_torch.ops.segments import segment_minmax


@dataclass(frozen=True)
class Pixels:
    """Occupied pixels of clusters, one entry per pixel and sweep."""

    cluster: Tensor  # (P,) int64
    step: Tensor  # (P,) int64, sweep that occupies the pixel: 0 = t+1, 1 = t, ...
    row: Tensor  # (P,) int64, in the image of the window
    col: Tensor  # (P,) int64, in the image of the window


@dataclass(frozen=True)
class Clusters:
    """Clusters that have pixels at t+1 and before, in order of window, then of first pixel in raster order."""

    window: Tensor  # (M,) int64, window of each cluster, ascending
    first: Tensor  # (M, 2) int64, top-left (row, col) of the bounding box over all sweeps
    size: Tensor  # (M, 2) int64, height and width of the box
    pixels: Pixels  # all occupied pixels of the clusters


def find_clusters(sweeps: ProjectedSweeps, config: ClusteringConfig) -> tuple[Clusters, Tensor, Tensor]:
    """Aggregate the sweeps of each window, dilate, label, split oversized components, drop those that cannot move.

    All engines of `labeling` return identical clusters.

    Returns:
        clusters: M clusters, which never join across windows (Alg. clustering).
        cluster_of_cell: (B * S * H * W + 1,) int32, cluster of each occupied pixel of each sweep, M = none. The last
            entry, M, is for points outside the images. Undefined for empty pixels.
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

    # A pixel of sweep m lies m images behind that of t+1.
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
    """(C,) bool: the component has a pixel at t+1 and a pixel before.

    `component` is (P,) int64, below C; `occupied` is (S, P) bool, the sweeps that occupy each pixel, index 0 = t+1.
    """
    newest, *older = occupied.unbind(0)
    before = reduce(torch.bitwise_or, older, torch.zeros_like(newest))
    kind = newest.byte() + (newest & before).byte()  # 0: occupied before only, 1: at t+1 only, 2: both
    index = torch.add(component, kind, alpha=num_components)
    has_kind = torch.zeros(3 * num_components, dtype=torch.bool, device=index.device).index_fill_(0, index, True)
    before_only, newest_only, both = has_kind.view(3, -1)
    return (before_only & newest_only).logical_or_(both)
