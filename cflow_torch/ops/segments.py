"""Reductions over segments (groups of rows that share an index) and batched medians."""

from __future__ import annotations

import torch
from torch import Tensor

# Minimum of a segment without values: beyond any index, but differences still fit an int64.
_FAR = 1 << 61


def segment_amin(values: Tensor, index: Tensor, num_segments: int, empty: float) -> Tensor:
    """Smallest value of each segment.

    Args:
        values: (..., N) numbers.
        index: (N,) int64, segment of each value, 0 ... num_segments - 1.
        num_segments: S.
        empty: result of a segment without values; must not be smaller than any value.

    Returns:
        (..., S), dtype of `values`.
    """
    least = values.new_full((*values.shape[:-1], num_segments), empty)
    return least.scatter_reduce_(-1, index.expand_as(values), values, "amin")


def segment_minmax(values: Tensor, index: Tensor, num_segments: int) -> tuple[Tensor, Tensor]:
    """Smallest and largest value of each segment, (..., S) int64 each; 2^61 and -2^61 for a segment without values.

    Args are as for `segment_amin`, and the values are int64 from -2^61 to 2^61.
    """
    last = values.new_full((*values.shape[:-1], num_segments), -_FAR)
    last.scatter_reduce_(-1, index.expand_as(values), values, "amax")
    return segment_amin(values, index, num_segments, _FAR), last


def first_of_segment(index: Tensor, num_segments: int) -> Tensor:
    """For each element, the position of the first element of its segment, (N,) int64. Args as for `segment_amin`."""
    position = torch.arange(index.numel(), device=index.device)
    return segment_amin(position, index, num_segments, index.numel()).index_select(0, index)


def bounding_boxes(rows: Tensor, cols: Tensor, index: Tensor, num_segments: int) -> tuple[Tensor, Tensor]:
    """Bounding box of the pixels of each segment. All arguments and results are int64.

    Returns:
        first: (S, 2), smallest (row, col).
        size: (S, 2), height and width; negative for a segment without pixels.
    """
    # Reductions of one column each are faster than one of several columns.
    top, bottom = segment_minmax(rows, index, num_segments)
    left, right = segment_minmax(cols, index, num_segments)
    return torch.stack((top, left), 1), torch.stack((bottom - top, right - left), 1).add_(1)


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
    """Median of each segment, (S,) float64; 0 for a segment without values. Args as for `segment_amin`.

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
