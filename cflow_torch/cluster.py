"""Spatio-temporal clusters by connected components (Alg. clustering), all windows at once."""

from __future__ import annotations

from dataclasses import dataclass
from functools import reduce
from typing import Tuple

import torch
from torch import Tensor

from cflow_torch.config import Config
from cflow_torch.ops.indices import divide, flat_nonzero, split_index
from cflow_torch.ops.labeling import connected_components_kornia, label_blocks, pad
from cflow_torch.ops.morphology import close_3x3, dilate_3x3_kornia, erode_3x3_kornia
from cflow_torch.ops.segments import bounding_boxes, first_of_segment, segment_ends


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


def cluster(occupancy: Tensor, pixel_size: float, config: Config, reach: int = 3) -> Tuple[Clusters, Tensor]:
    """Alg. clustering, from the projection of the aggregated sweeps on: dilate, label, validate by size.

    Args:
        occupancy: (B, S, H, W) bool, image of every sweep; index 0 of S is sweep t+1.
        pixel_size: s, metres.
        config: `connectivity`, `max_extent` (d^max), `labeling`.
        reach: 3 = Alg. clustering; 1 = plain components: neither dilated nor validated by size.

    Returns:
        clusters: those of all B windows.
        of_pixel: (B * S * H * W + 1,) int32, cluster of each occupied pixel of each sweep, M = none; the last entry, M,
            is for points that are nowhere. Undefined for empty pixels.

    Convention:
        Clusters never join across windows. Both engines give the same clusters.

    Source: Alg. clustering.
    """
    _, num_steps, height, width = occupancy.shape
    area = height * width
    aggregated = pad(occupancy.unbind(1))
    pixels = flat_nonzero(aggregated)
    padded_row, col = split_index(pixels, aggregated.shape[2])
    window, row = split_index(padded_row, aggregated.shape[1])
    places = _Places(pixels, padded_row, row, col)
    if reach == 1:
        component, num_components = _components(aggregated, places, 1, config)
    else:
        component, num_components = _label(aggregated, height, width, places, pixel_size, config)

    # Which sweeps saw each pixel. Sweep m lies m images behind t+1.
    place = torch.add(col, row, alpha=width).add_(window, alpha=num_steps * area)
    images = occupancy.flatten()
    seen = torch.stack([images[index * area :].index_select(0, place) for index in range(num_steps)])
    newest, *older = seen.unbind(0)
    before = reduce(torch.bitwise_or, older, torch.zeros_like(newest))
    live = flat_nonzero(_can_move(component, num_components, newest, before))
    first, last = (values.index_select(0, live) for values in segment_ends(pixels, component, num_components))
    first, order = first.sort()
    live, last = live.index_select(0, order), last.index_select(0, order)
    left, right = (values.index_select(0, live) for values in segment_ends(col, component, num_components))
    top, bottom = divide(first, aggregated.shape[2]), divide(last, aggregated.shape[2])
    window_of_cluster, top_in_window = split_index(top, aggregated.shape[1])
    cluster = _numbers(live, num_components).index_select(0, component)

    member = flat_nonzero((cluster < live.numel()) & seen)
    step, pixel = split_index(member, max(pixels.numel(), 1))
    clusters = Clusters(
        window_of_cluster,
        torch.stack((top_in_window, left), 1),
        torch.stack((bottom - top, right - left), 1).add_(1),
        Pixels(cluster.index_select(0, pixel), step, row.index_select(0, pixel), col.index_select(0, pixel)),
    )
    of_pixel = torch.empty(occupancy.numel() + 1, dtype=torch.int32, device=pixels.device)
    number_of_pixel = cluster.int()
    for index in range(num_steps):
        of_pixel[index * area :].scatter_(0, place, number_of_pixel)
    of_pixel[-1:] = live.numel()
    return clusters, of_pixel


def label_components(image: Tensor, pixels: Tensor, pixel_size: float, config: Config) -> Tensor:
    """Components of a dilated image, the oversized ones eroded and labelled again (Alg. clustering).

    Args:
        image: (B, H, W) bool.
        pixels: (P,) int64, flat indices of its set pixels, ascending.
        pixel_size: s, metres.
        config: `connectivity`, `max_extent` (d^max), `labeling`.

    Returns:
        (P,) int64: the position in `pixels` of the first (in raster order) pixel of the same component.
    """
    _, height, width = image.shape
    padded = pad([image])
    image_row, col = split_index(pixels, width)
    window, row = split_index(image_row, height)
    padded_row = torch.add(row, window, alpha=padded.shape[1])
    places = _Places(torch.add(col, padded_row, alpha=padded.shape[2]), padded_row, row, col)
    return first_of_segment(*_label(padded, height, width, places, pixel_size, config))


def keep_live(
    component: Tensor, num_components: int, window: Tensor, step: Tensor, row: Tensor, col: Tensor
) -> Tuple[Clusters, Tensor]:
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
    number = _numbers(live, num_components)
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


def _numbers(live: Tensor, num_components: int) -> Tensor:
    """(C,) int64, place of each component in `live` (M,), M = it is not there."""
    number = torch.full((num_components,), live.numel(), dtype=torch.int64, device=live.device)
    return number.scatter_(0, live, torch.arange(live.numel(), device=live.device))


@dataclass(frozen=True)
class _Places:
    """Where the set pixels of padded images are.

    Args:
        pixel: (P,) int64, flat index.
        padded_row: (P,) int64, row, counted through all images.
        row, col: (P,) int64, row and column in the image.
    """

    pixel: Tensor
    padded_row: Tensor
    row: Tensor
    col: Tensor


def _label(
    padded: Tensor, height: int, width: int, places: _Places, pixel_size: float, config: Config
) -> Tuple[Tensor, int]:
    """Component, under any name, of the set pixels of padded images of height x width, and more than the largest.

    All oversized components are eroded together: components of a dilated image do not share a 3 x 3 neighbourhood
    that lies in their union, so none sees another.
    """
    dilated = dilate_3x3_kornia(padded) if config.labeling == "kornia" else padded
    component, count = _components(dilated, places, 3, config)
    top, bottom = segment_ends(places.row, component, count)
    left, right = segment_ends(places.col, component, count)
    # The dilation adds a pixel on every side, cut off at the border.
    num_rows = bottom.clamp_(max=height - 2).sub_(top.clamp_(min=1))
    num_cols = right.clamp_(max=width - 2).sub_(left.clamp_(min=1))
    extent = torch.maximum(num_rows, num_cols).add_(3)
    is_oversized = extent.double() * pixel_size > config.max_extent
    if not is_oversized.any():
        return component, count

    oversized = is_oversized.index_select(0, component)
    alone = torch.zeros_like(padded).view(-1).scatter_(0, places.pixel, oversized).view_as(padded)
    if config.labeling == "kornia":
        closed = pad([erode_3x3_kornia(dilate_3x3_kornia(alone[:, :height, :width]))])
    else:
        closed = close_3x3(alone, height, width)
    part, num_parts = _components(closed, places, 1, config)
    return torch.where(oversized, part.add_(count), component), count + num_parts


def _components(padded: Tensor, places: _Places, reach: int, config: Config) -> Tuple[Tensor, int]:
    """Component of pixels of padded images (kornia: dilated ones if `reach` is 3), and more than the largest."""
    if config.labeling == "kornia":
        return connected_components_kornia(padded, places.pixel, config.connectivity), places.pixel.numel()
    blocks = label_blocks(padded, config.connectivity, reach)
    return blocks.of_pixel(places.padded_row, places.col), blocks.num_components
