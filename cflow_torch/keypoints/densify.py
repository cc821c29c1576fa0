"""Spread sparse matches to one shift for every occupied pixel (Sec. From sparse scene flow to dense scene flow)."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from cflow_torch.config import KeypointsConfig
from cflow_torch.dense.clustering import label_components
from cflow_torch.keypoints.matching import KeypointMatches
from cflow_torch.ops.indices import draw, flat_nonzero, index_in_group
from cflow_torch.ops.labeling import connected_components
from cflow_torch.ops.medians import segment_median
from cflow_torch.ops.nearest import nearest_set_pixel


@dataclass(frozen=True)
class DenseShift:
    """Groups of pixels with a common shift, in order of window, then of first pixel (or key point) in raster order."""

    pixel: Tensor  # (P,) int64, flat indices of the occupied pixels, ascending
    group: Tensor  # (P,) int64, group of each pixel, G = none
    shift: Tensor  # (G, 2) float64, (dy, dx) pixels; 0 for a group without a match
    id_in_window: Tensor  # (G,) int64, index of each group among those of its window
    score: Tensor  # (G,) float64, NCC; 0 for a group without a match


def densify(
    images: Tensor, matched: Tensor, matches: KeypointMatches, pixel_size: float, config: KeypointsConfig
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
    if config.densify == "nearest":
        return _by_nearest(images, pixel, matched, matches)
    if config.densify == "clusters":
        component = label_components(images, pixel, pixel_size, config)
    else:
        component = connected_components(images, pixel, config.connectivity, engine=config.labeling)
    is_first = component == torch.arange(pixel.numel(), device=pixel.device)
    group = (is_first.cumsum(0) - 1).index_select(0, component)
    first_pixel = pixel.index_select(0, flat_nonzero(is_first))
    group_of_match = group.index_select(0, torch.searchsorted(pixel, matched))
    dy, dx, score = (
        segment_median(values, group_of_match, first_pixel.numel())
        for values in (*matches.shift.double().unbind(1), matches.score)
    )
    return DenseShift(
        pixel=pixel,
        group=group,
        shift=torch.stack((dy, dx), 1),
        id_in_window=_id_in_window(first_pixel, images),
        score=score,
    )


def _by_nearest(images: Tensor, pixel: Tensor, matched: Tensor, matches: KeypointMatches) -> DenseShift:
    """Give each pixel the shift of the nearest matched key point."""
    seeds = draw(matched, images.numel()).view_as(images)
    nearest = nearest_set_pixel(seeds, pixel)
    return DenseShift(
        pixel=pixel,
        group=torch.where(nearest < 0, matched.numel(), torch.searchsorted(matched, nearest)),
        shift=matches.shift.double(),
        id_in_window=_id_in_window(matched, images),
        score=matches.score,
    )


def _id_in_window(pixels: Tensor, images: Tensor) -> Tensor:
    """Number some pixels of each image, flat indices (G,) int64, ascending."""
    return index_in_group(pixels // images[0].numel())
