"""Spread sparse matches to one shift for every occupied pixel (Sec. From sparse scene flow to dense scene flow)."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from cflow_torch.config import KeypointsConfig
from cflow_torch.dense.clustering import label_components
from cflow_torch.keypoints.matching import Matches
from cflow_torch.ops.indices import flat_nonzero, index_in_group
from cflow_torch.ops.labeling import connected_components
from cflow_torch.ops.nearest import nearest_set_pixel
from cflow_torch.ops.segments import segment_median


@dataclass(frozen=True)
class DenseShift:
    """Groups of pixels with a common shift, in order of window, then of first pixel (or key point) in raster order."""

    pixel: Tensor  # (P,) int64, flat indices of the occupied pixels, ascending
    group: Tensor  # (P,) int64, group of each pixel, G = none
    shift: Tensor  # (G, 2) float64, (dy, dx) pixels; 0 for a group without a match
    id_in_window: Tensor  # (G,) int64, index of each group among those of its window
    score: Tensor  # (G,) float64, NCC; 0 for a group without a match


def densify(
    images: Tensor, matched: Tensor, matches: Matches, pixel_size: float, config: KeypointsConfig
) -> DenseShift:
    """Find the shift of every occupied pixel of sweep t.

    `images` are the images of sweep t, (B, H, W) bool. `matched` are the key points of `matches` as flat indices into
    the images, (M,) int64, ascending.

    Returns:
        With "components", a group is a connected component of the image. Its shift is the median of dy and the median
        of dx over its matched key points, and its score is the median of their scores. With "clusters", a group is a
        component of Alg. clustering on sweep t alone, with the same medians. With "nearest", a group is a matched key
        point and the pixels nearest to it.

    Convention:
        Even counts: the median is the mean of the middle two. Ties of the nearest key point: first in raster order.

    Source: Sec. From sparse scene flow to dense scene flow; Table keypoint_sparse2dense.
    """
    pixel = flat_nonzero(images)
    image_size = images.shape[1] * images.shape[2]
    shift = matches.shift.double()
    if config.densify == "nearest":
        seeds = torch.zeros_like(images).view(-1).index_fill_(0, matched, True).view_as(images)
        nearest = nearest_set_pixel(seeds, pixel)
        group = torch.where(nearest < 0, matched.numel(), torch.searchsorted(matched, nearest))
        return DenseShift(pixel, group, shift, index_in_group(matched // image_size), matches.score)
    if config.densify == "clusters":
        component = label_components(images, pixel, pixel_size, config)
    else:
        component = connected_components(images, pixel, config.connectivity, engine=config.labeling)
    is_first = component == torch.arange(pixel.numel(), device=pixel.device)
    group = (is_first.cumsum(0) - 1).index_select(0, component)
    first = flat_nonzero(is_first)
    group_of_match = group.index_select(0, torch.searchsorted(pixel, matched))
    num_groups = first.numel()
    dy = segment_median(shift[:, 0], group_of_match, num_groups)
    dx = segment_median(shift[:, 1], group_of_match, num_groups)
    score = segment_median(matches.score, group_of_match, num_groups)
    window = pixel.index_select(0, first) // image_size
    return DenseShift(pixel, group, torch.stack((dy, dx), 1), index_in_group(window), score)
