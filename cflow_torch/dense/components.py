"""Components of binary images: dilated, measured, and split where they are too long (Alg. clustering)."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from cflow_torch.config import ClusteringConfig
from cflow_torch.ops.indices import split_index
from cflow_torch.ops.kornia_engine import close_3x3_kornia, connected_components_kornia
from cflow_torch.ops.labeling import label_together, pad
from cflow_torch.ops.morphology import close_3x3
from cflow_torch.ops.segments import first_of_segment, segment_minmax


@dataclass(frozen=True)
class PixelIndices:
    """Set pixels of padded images."""

    pixel: Tensor  # (P,) int64, flat index into the padded images
    padded_row: Tensor  # (P,) int64, row of the padded images, counted through all of them
    row: Tensor  # (P,) int64, row in the image
    col: Tensor  # (P,) int64, column in the image


def label_components(image: Tensor, pixels: Tensor, pixel_size: float, config: ClusteringConfig) -> Tensor:
    """Label the components of dilated images; erode and label again those that are too long (Alg. clustering).

    The images are (B, H, W) bool, and `pixels` (P,) int64 are the flat indices of their set pixels, ascending. Returns
    (P,) int64: the position in `pixels` of the first (in raster order) pixel of the same component.
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
    """Label the set pixels of padded images of height x width; return the labels, and a number above the largest.

    We erode all oversized components in one image. None affects another, because no 3 x 3 neighbourhood of set pixels
    belongs to two components.
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
    """Component of each pixel, dilated first if `reach` is 3, and a number above the largest component."""
    if config.labeling == "kornia":
        component = connected_components_kornia(padded, indices.pixel, config.connectivity, reach)
        return component, indices.pixel.numel()
    (blocks,) = label_together([(padded, reach)], config.connectivity)
    return blocks.of_pixel(indices.padded_row, indices.col), blocks.num_components
