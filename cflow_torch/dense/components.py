"""Components of binary images: dilated and validated by size (Alg. clustering)."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from cflow_torch.config import ClusteringConfig
from cflow_torch.ops.indices import split_index
from cflow_torch.ops.labeling import connected_components_kornia, label_blocks, pad
from cflow_torch.ops.morphology import close_3x3, dilate_3x3_kornia, erode_3x3_kornia
from cflow_torch.ops.segments import first_of_segment, segment_ends


@dataclass(frozen=True)
class Places:
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


def label_components(image: Tensor, pixels: Tensor, pixel_size: float, config: ClusteringConfig) -> Tensor:
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
    places = Places(torch.add(col, padded_row, alpha=padded.shape[2]), padded_row, row, col)
    return first_of_segment(*components_by_size(padded, height, width, places, pixel_size, config))


def components_by_size(
    padded: Tensor, height: int, width: int, places: Places, pixel_size: float, config: ClusteringConfig
) -> tuple[Tensor, int]:
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


def _components(padded: Tensor, places: Places, reach: int, config: ClusteringConfig) -> tuple[Tensor, int]:
    """Component of pixels of padded images (kornia: dilated ones if `reach` is 3), and more than the largest."""
    if config.labeling == "kornia":
        return connected_components_kornia(padded, places.pixel, config.connectivity), places.pixel.numel()
    blocks = label_blocks(padded, config.connectivity, reach)
    return blocks.of_pixel(places.padded_row, places.col), blocks.num_components
