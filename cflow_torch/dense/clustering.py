"""Spatio-temporal clusters by connected components (Alg. clustering), all windows at once."""

from __future__ import annotations

from dataclasses import dataclass
from functools import reduce
from typing import NamedTuple

import torch
from torch import Tensor

from cflow_torch.config import ClusteringConfig
from cflow_torch.dense.components import Places, components_by_size
from cflow_torch.dense.projection import ProjectedSweeps
from cflow_torch.ops.indices import divide, flat_nonzero, lazy_empty, renumber, split_index
from cflow_torch.ops.labeling import pad
from cflow_torch.ops.segments import bounding_boxes, segment_ends


@dataclass(frozen=True)
class Pixels:
    """Occupied pixels of clusters.

    Args:
        cluster: (P,) int64, cluster of each pixel.
        step: (P,) int64, sweep it was seen in: 0 = t+1, 1 = t, ...
        row, col: (P,) int64, place in the image of its window.
    """

    cluster: Tensor
    step: Tensor
    row: Tensor
    col: Tensor


@dataclass(frozen=True)
class Clusters:
    """Clusters that have pixels at t+1 and before, numbered by window, then by first pixel in raster order.

    Args:
        window: (M,) int64, window of each cluster, ascending.
        first: (M, 2) int64, top-left (row, col) of the bounding box over all sweeps.
        size: (M, 2) int64, its height and width.
        pixels: every occupied pixel of every sweep that belongs to a cluster.
    """

    window: Tensor
    first: Tensor
    size: Tensor
    pixels: Pixels

    def take(self, wanted: Tensor) -> Clusters:
        """Some of M clusters, numbered anew from 0. Args: wanted: (M,) bool."""
        index = flat_nonzero(wanted)
        member = flat_nonzero(wanted.index_select(0, self.pixels.cluster))
        number = (wanted.cumsum(0) - 1).index_select(0, self.pixels.cluster.index_select(0, member))
        pixels = self.pixels
        step, row, col = (values.index_select(0, member) for values in (pixels.step, pixels.row, pixels.col))
        window, first, size = (values.index_select(0, index) for values in (self.window, self.first, self.size))
        return Clusters(window, first, size, Pixels(number, step, row, col))

    def id_in_window(self) -> Tensor:
        """(M,) int64, number of each cluster counted from 0 in its own window."""
        start = torch.searchsorted(self.window, self.window)  # first cluster of the same window
        return torch.arange(self.window.numel(), device=start.device) - start


class Columns(NamedTuple):
    """Pixels that are occupied in any sweep, by window, in raster order.

    Args:
        window: (Q,) int64.
        pixel: (Q,) int64, row * W + col.
        cluster: (Q,) int64, M = none.
    """

    window: Tensor
    pixel: Tensor
    cluster: Tensor


def find_clusters(sweeps: ProjectedSweeps, config: ClusteringConfig) -> tuple[Clusters, Tensor, Tensor]:
    """Alg. clustering, from the projection of the aggregated sweeps on: dilate, label, validate by size.

    Args:
        sweeps: of all B windows.
        config: `connectivity`, `max_extent` (d^max), `labeling`.

    Returns:
        clusters: those of all windows.
        cluster_of_cell: (B * S * H * W + 1,) int32, cluster of each occupied pixel of each sweep, M = none. The last
            entry, M, is for points outside the images. Undefined for empty pixels.
        cell_of_point: (P,) int64, index of each point into `cluster_of_cell`.
    """
    occupancy = sweeps.occupancy
    _, num_steps, height, width = occupancy.shape
    area = height * width
    clusters, columns = cluster_images(occupancy, sweeps.grid.pixel_size, config)
    cluster_of_cell = lazy_empty(occupancy.numel() + 1, torch.int32, occupancy.device)
    place = torch.add(columns.pixel, columns.window, alpha=num_steps * area)
    number_of_place = columns.cluster.int()
    for index in range(num_steps):
        cluster_of_cell[index * area :].scatter_(0, place, number_of_place)
    cluster_of_cell[-1:] = clusters.window.numel()
    return clusters, cluster_of_cell, sweeps.pixel


def cluster_images(images: Tensor, pixel_size: float, config: ClusteringConfig) -> tuple[Clusters, Columns]:
    """The clusters of images, and where they are.

    Args:
        images: (B, S, H, W) bool, or uint8 that is 0 where nothing is, of every sweep; index 0 of S is sweep t+1.
        pixel_size: s, metres.
        config: `connectivity`, `max_extent` (d^max), `labeling`.

    Convention:
        Clusters never join across windows. Both engines give the same clusters.

    Source: Alg. clustering.
    """
    _, num_steps, height, width = images.shape
    area = height * width
    aggregated = pad(images.unbind(1))
    pixels = flat_nonzero(aggregated)
    padded_row, col = split_index(pixels, aggregated.shape[2])
    window, row = split_index(padded_row, aggregated.shape[1])
    places = Places(pixels, padded_row, row, col)
    component, num_components = components_by_size(aggregated, height, width, places, pixel_size, config)

    # Which sweeps saw each pixel. Sweep m lies m images behind t+1.
    pixel_in_window = torch.add(col, row, alpha=width)
    place = torch.add(pixel_in_window, window, alpha=num_steps * area)
    flat = images.flatten()
    seen = torch.stack([flat[index * area :].index_select(0, place) for index in range(num_steps)]).bool()
    newest, *older = seen.unbind(0)
    before = reduce(torch.bitwise_or, older, torch.zeros_like(newest))
    live = flat_nonzero(_can_move(component, num_components, newest, before))
    first, last = (values.index_select(0, live) for values in segment_ends(pixels, component, num_components))
    first, order = first.sort()
    live, last = live.index_select(0, order), last.index_select(0, order)
    left, right = (values.index_select(0, live) for values in segment_ends(col, component, num_components))
    top, bottom = divide(first, aggregated.shape[2]), divide(last, aggregated.shape[2])
    window_of_cluster, top_in_window = split_index(top, aggregated.shape[1])
    cluster = renumber(live, num_components).index_select(0, component)

    member = flat_nonzero((cluster < live.numel()) & seen)
    step, pixel = split_index(member, max(pixels.numel(), 1))
    clusters = Clusters(
        window_of_cluster,
        torch.stack((top_in_window, left), 1),
        torch.stack((bottom - top, right - left), 1).add_(1),
        Pixels(cluster.index_select(0, pixel), step, row.index_select(0, pixel), col.index_select(0, pixel)),
    )
    return clusters, Columns(window, pixel_in_window, cluster)


def keep_live(
    component: Tensor, num_components: int, window: Tensor, step: Tensor, row: Tensor, col: Tensor
) -> tuple[Clusters, Tensor]:
    """The components that can move: a pixel at t+1 and a pixel before.

    Args:
        component: (P,) int64, component of each occupied pixel of each sweep; numbered by window, then by first pixel
            in raster order (gaps are allowed).
        num_components: C, more than the largest component.
        window, step, row, col: (P,) int64, where each pixel was seen.

    Returns:
        clusters: the M components that can move.
        number: (C,) int64, cluster of each component, M = none.
    """
    live = flat_nonzero(_can_move(component, num_components, step == 0, step > 0))
    number = renumber(live, num_components)[:-1]
    cluster = number.index_select(0, component)
    kept = flat_nonzero(cluster < live.numel())
    pixels = Pixels(*(values.index_select(0, kept) for values in (cluster, step, row, col)))
    window_of_cluster = torch.zeros_like(live).scatter_(0, pixels.cluster, window.index_select(0, kept))
    boxes = bounding_boxes(pixels.row, pixels.col, pixels.cluster, live.numel())
    return Clusters(window_of_cluster, *boxes, pixels), number


def _can_move(component: Tensor, num_components: int, newest: Tensor, before: Tensor) -> Tensor:
    """(C,) bool, which components were seen at t+1 and before.

    Args:
        component: (P,) int64.
        num_components: C, more than the largest component.
        newest, before: (P,) bool, whether the pixel was seen at t+1, in an earlier sweep; at least one of them.
    """
    # Pixels of a component that were seen only before, only at t+1, in both.
    kind = newest.view(torch.uint8) + (newest & before).view(torch.uint8)
    kind = torch.add(component, kind, alpha=num_components)
    kinds = torch.zeros(3 * num_components, dtype=torch.bool, device=kind.device).index_fill_(0, kind, True)
    only_before, only_newest, both = kinds.view(3, -1)
    return (only_before & only_newest).logical_or_(both)
