"""Spatio-temporal clusters by connected components (Alg. clustering), all windows at once."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Tuple

import torch
from torch import Tensor

from cflow_torch.config import Config
from cflow_torch.ops.indices import flat_nonzero
from cflow_torch.ops.labeling import connected_components, connected_components_kornia
from cflow_torch.ops.morphology import dilate_3x3, dilate_3x3_kornia, erode_3x3, erode_3x3_kornia
from cflow_torch.ops.segments import bounding_boxes, first_of_segment


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

    def id_in_window(self) -> Tensor:
        """(M,) int64, number of each cluster counted from 0 in its own window."""
        start = torch.searchsorted(self.window, self.window)  # first cluster of the same window
        return torch.arange(self.window.numel(), device=start.device) - start


def cluster(occupancy: Tensor, pixel_size: float, config: Config) -> Tuple[Clusters, Tensor]:
    """Alg. clustering, from the projection of the aggregated sweeps on: dilate, label, validate by size.

    Args:
        occupancy: (B, S, H, W) bool, image of every sweep; index 0 of S is sweep t+1.
        pixel_size: s, metres.
        config: `connectivity`, `max_extent` (d^max), `labeling`.

    Returns:
        clusters: those of all B windows.
        of_pixel: (B * S * H * W + 1,) int32, cluster of each occupied pixel of each sweep, M = none; the last entry, M,
            is for points that are nowhere. Undefined for empty pixels.

    Convention:
        Clusters never join across windows. Both engines give the same clusters.

    Source: Alg. clustering.
    """
    num_windows, num_steps, height, width = occupancy.shape
    aggregated = occupancy[:, 0].clone()
    for index in range(1, num_steps):
        aggregated |= occupancy[:, index]
    pixels = flat_nonzero(aggregated)
    window = pixels // (height * width)
    raster = pixels - window * (height * width)
    row_of_pixel = raster // width
    component = label_components(aggregated, pixels, pixel_size, config)

    # Which sweeps saw each pixel. Components are named by their first pixel.
    sweeps = torch.arange(num_steps, device=pixels.device)[:, None]
    pixel_of_sweep = (window * num_steps + sweeps) * (height * width) + raster  # (S, P)
    seen = flat_nonzero(occupancy.flatten().take(pixel_of_sweep))
    step = seen // pixels.numel() if pixels.numel() else seen
    pixel = seen - step * pixels.numel()
    col_of_pixel = raster - row_of_pixel * width
    place = (values.index_select(0, pixel) for values in (component, window, row_of_pixel, col_of_pixel))
    of_component, of_window, row, col = place
    clusters, number = keep_live(of_component, pixels.numel(), of_window, step, row, col)

    of_pixel = torch.empty(occupancy.numel() + 1, dtype=torch.int32, device=pixels.device)
    of_pixel.scatter_(0, pixel_of_sweep.flatten(), number.index_select(0, component).int().repeat(num_steps))
    of_pixel[-1] = clusters.window.numel()
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
    component = _label_dilated(image, pixels, config)
    return _split_oversized(image, pixels, component, pixel_size, config)


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
    seen = torch.zeros(2 * num_components, dtype=torch.bool, device=component.device)
    seen.index_fill_(0, 2 * component + (step > 0), True)  # before, at t+1
    live = flat_nonzero(seen.view(-1, 2).all(1))
    num_clusters = live.numel()
    number = torch.full((num_components,), num_clusters, dtype=torch.int64, device=component.device)
    number.scatter_(0, live, torch.arange(num_clusters, device=component.device))

    cluster = number.index_select(0, component)
    kept = flat_nonzero(cluster < num_clusters)
    pixels = Pixels(*(values.index_select(0, kept) for values in (cluster, step, row, col)))
    window_of_cluster = torch.zeros(num_clusters, dtype=torch.int64, device=component.device)
    window_of_cluster.scatter_(0, pixels.cluster, window.index_select(0, kept))
    return Clusters(
        window_of_cluster, *bounding_boxes(pixels.row, pixels.col, pixels.cluster, num_clusters), pixels
    ), number


def _label_dilated(image: Tensor, pixels: Tensor, config: Config) -> Tensor:
    """Component of each occupied pixel after a 3 x 3 dilation."""
    if config.labeling == "kornia":
        return connected_components_kornia(dilate_3x3_kornia(image), pixels, config.connectivity)
    return connected_components(image, pixels, config.connectivity, reach=3)


def _split_oversized(image: Tensor, pixels: Tensor, component: Tensor, pixel_size: float, config: Config) -> Tensor:
    """Erode components whose bounding box is longer than d^max and label what is left of them.

    All oversized components are eroded together: components of a dilated image do not share a 3 x 3 neighbourhood
    that lies in their union, so none sees another.
    """
    _, height, width = image.shape
    place = pixels % (height * width)
    is_root = component == torch.arange(pixels.numel(), device=pixels.device)
    segment = (is_root.cumsum(0) - 1).index_select(0, component)
    first, size = bounding_boxes(place // width, place % width, segment, int(is_root.sum()))
    border = torch.tensor([height - 1, width - 1], device=pixels.device)
    last = torch.minimum(first + size, border)  # the dilation adds a pixel on every side, cut off at the border
    extent = (last - (first - 1).clamp(min=0) + 1).amax(1)
    oversized = flat_nonzero((extent.double() * pixel_size > config.max_extent)[segment])
    if oversized.numel() == 0:
        return component

    alone = torch.zeros_like(image)
    alone.view(-1)[pixels[oversized]] = True
    if config.labeling == "kornia":
        closed = erode_3x3_kornia(dilate_3x3_kornia(alone))
        part = connected_components_kornia(closed, pixels[oversized], config.connectivity)
    else:
        closed = erode_3x3(dilate_3x3(alone))
        closed_pixels = flat_nonzero(closed)
        part = connected_components(closed, closed_pixels, config.connectivity, reach=1)
        part = part.index_select(0, torch.searchsorted(closed_pixels, pixels[oversized]))
        part = first_of_segment(part, closed_pixels.numel())
    component = component.clone()
    component[oversized] = oversized[part]
    return component
