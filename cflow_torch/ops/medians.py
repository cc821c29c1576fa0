"""Medians of rows of matrices, and of segments: values that share a number."""

from __future__ import annotations

import torch
from torch import Tensor


def masked_median(values: Tensor, mask: Tensor) -> Tensor:
    """Median of the selected rows of each matrix, column by column.

    `values` are (M, K, C) floats, and `mask` is (M, K) bool, True = selected. The result is (M, C), and 0 for a matrix
    without selected rows. Even count: mean of the middle two, (a + b) / 2.
    """
    ordered = values.masked_fill(~mask[:, :, None], float("inf")).sort(dim=1).values
    count = mask.sum(dim=1)[:, None, None]
    middle = torch.cat((count - 1, count), 1).clamp_(min=0) >> 1  # an odd count has the same row twice
    median = ordered.gather(1, middle.expand(-1, -1, values.shape[2])).mean(1)
    return median.masked_fill_(count[:, 0] == 0, 0)


def segment_median(values: Tensor, index: Tensor, num_segments: int) -> Tensor:
    """Median of each segment, (S,) float64; 0 for a segment without values.

    Args:
        values: (N,) float64.
        index: (N,) int64, segment of each value, 0 ... num_segments - 1.
        num_segments: S.

    Even count: mean of the middle two, (a + b) / 2. Cost: two sorts.
    """
    if values.numel() == 0:
        return values.new_zeros(num_segments)
    order = values.argsort(stable=True)
    order = order.index_select(0, index.index_select(0, order).argsort(stable=True))  # by segment, then by value
    ordered = values.index_select(0, order)
    count = torch.bincount(index, minlength=num_segments)
    start = count.cumsum(0) - count
    last = values.numel() - 1  # only empty segments would start after it
    low = ordered.index_select(0, (start + (count - 1).clamp(min=0) // 2).clamp(max=last))
    high = ordered.index_select(0, (start + count // 2).clamp(max=last))
    return ((low + high) / 2).masked_fill_(count == 0, 0)
