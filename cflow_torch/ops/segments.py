"""Reductions over segments (groups of rows that share an index) and batched medians."""

from __future__ import annotations

from typing import Tuple

import torch
from torch import Tensor


def segment_amin(values: Tensor, index: Tensor, num_segments: int, empty: int) -> Tensor:
    """Smallest value of each segment.

    Args:
        values: (N,) integers.
        index: (N,) int64, segment of each value, 0 ... num_segments - 1.
        num_segments: S.
        empty: result of a segment without values; must not be smaller than any value.

    Returns:
        (S,), dtype of `values`.
    """
    return values.new_full((num_segments,), empty).scatter_reduce_(0, index, values, "amin")


def first_of_segment(index: Tensor, num_segments: int) -> Tensor:
    """For each element the position of the first element of the same segment.

    Args:
        index: (N,) int64, segment of each element, 0 ... num_segments - 1.
        num_segments: S.

    Returns:
        (N,) int64.
    """
    position = torch.arange(index.numel(), device=index.device)
    return segment_amin(position, index, num_segments, index.numel()).index_select(0, index)


def bounding_boxes(rows: Tensor, cols: Tensor, index: Tensor, num_segments: int) -> Tuple[Tensor, Tensor]:
    """Bounding box of the pixels of each segment.

    Args:
        rows, cols: (N,) int64 pixel coordinates.
        index: (N,) int64 segment of each pixel.
        num_segments: S; every segment needs at least one pixel.

    Returns:
        first: (S, 2) int64, smallest (row, col).
        size: (S, 2) int64, height and width.
    """
    if num_segments == 0:
        return rows.new_zeros((0, 2)), rows.new_zeros((0, 2))
    pixels = torch.stack((rows, cols), 1)
    segment = index[:, None].expand(-1, 2)
    limit = torch.iinfo(pixels.dtype)
    first = pixels.new_full((num_segments, 2), limit.max).scatter_reduce_(0, segment, pixels, "amin")
    last = pixels.new_full((num_segments, 2), limit.min).scatter_reduce_(0, segment, pixels, "amax")
    return first, last - first + 1


def masked_median(values: Tensor, mask: Tensor) -> Tensor:
    """Median of the masked entries of each row.

    Args:
        values: (M, K) float.
        mask: (M, K) bool, True = counts.

    Returns:
        (M,) float; 0 for a row without entries.

    Convention:
        Even count: mean of the middle two, (a + b) / 2.
    """
    ordered = values.masked_fill(~mask, float("inf")).sort(dim=1).values
    count = mask.sum(dim=1)
    low = ordered.gather(1, ((count - 1).clamp(min=0) // 2)[:, None])[:, 0]
    high = ordered.gather(1, (count // 2).clamp(max=values.shape[1] - 1)[:, None])[:, 0]
    median = torch.where(count % 2 == 1, low, (low + high) / 2)
    return torch.where(count > 0, median, torch.zeros_like(median))


def segment_median(values: Tensor, index: Tensor, num_segments: int) -> Tensor:
    """Median of each segment.

    Args:
        values: (N,) float64.
        index: (N,) int64, segment of each value, 0 ... num_segments - 1.
        num_segments: S.

    Returns:
        (S,) float64; 0 for a segment without values.

    Convention:
        Even count: mean of the middle two, (a + b) / 2.

    Cost: two sorts.
    """
    if values.numel() == 0:
        return values.new_zeros(num_segments)
    order = values.argsort(stable=True)
    order = order.index_select(0, index.index_select(0, order).argsort(stable=True))  # by segment, then by value
    ordered = values.index_select(0, order)
    count = torch.bincount(index, minlength=num_segments)
    start = count.cumsum(0) - count
    last = values.numel() - 1  # only empty segments may point beyond it
    low = ordered.index_select(0, (start + (count - 1).clamp(min=0) // 2).clamp(max=last))
    high = ordered.index_select(0, (start + count // 2).clamp(max=last))
    median = torch.where(count % 2 == 1, low, (low + high) / 2)
    return torch.where(count > 0, median, torch.zeros_like(median))
