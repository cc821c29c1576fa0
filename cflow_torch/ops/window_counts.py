"""Set pixels of binary images of different sizes under a window of the image's size that is moved by a shift."""

from __future__ import annotations

from typing import Tuple

import torch
from torch import Tensor

from cflow_torch.ops.spans import spans


class WindowCounts:
    """Tables of N images given by their set pixels.

    Args:
        image, row, col: (P,) int64, which image and where in it; each pixel once.
        size: (N, 2) int64, height and width H, W of each image.

    Cost: linear in the area of the images.
    """

    def __init__(self, image: Tensor, row: Tensor, col: Tensor, size: Tensor) -> None:
        self._size = size
        self._energy = torch.bincount(image, minlength=len(size))
        # Pixels in the rows above, and in the columns to the left, of every row and column.
        self._edges = size + 1
        self._first_edge = self._edges.cumsum(0) - self._edges
        above, left = (
            torch.bincount(
                self._first_edge[:, axis].index_select(0, image) + place + 1, minlength=int(self._edges[:, axis].sum())
            ).cumsum(0)
            for axis, place in enumerate((row, col))
        )
        self._before = above, left
        # Running sum over rows of W + 1 samples, the first of them free. What lies before a row cancels.
        self._stride = self._edges[:, 1]
        area = size[:, 0] * self._stride
        self._start = area.cumsum(0) - area
        pixel = self._start.index_select(0, image) + row * self._stride.index_select(0, image) + col + 1
        table = torch.zeros(int(area.sum()), dtype=torch.int32, device=size.device)
        self._table = table.index_fill_(0, pixel, 1).cumsum(0)

    def bounds(self, image: Tensor, dy: Tensor, dx: Tensor) -> Tuple[Tensor, Tensor]:
        """(K,) int64 each, `count` is at least the first and at most the second. Args as for `count`."""
        energy = self._energy.index_select(0, image)
        rows, cols = (self._within(axis, image, shift) for axis, shift in enumerate((dy, dx)))
        return rows + cols - energy, torch.minimum(rows, cols)

    def count(self, image: Tensor, dy: Tensor, dx: Tensor) -> Tensor:
        """(K,) int64, set pixels in rows dy ... H - 1 + dy and columns dx ... W - 1 + dx.

        Args:
            image: (K,) int64.
            dy, dx: (K,) int64, |dy| <= H, |dx| <= W.

        Cost: linear in the height of the windows.
        """
        height, width = self._size.index_select(0, image).t()
        stride = self._stride.index_select(0, image)
        num_rows = height - dy.abs()
        row = spans(dy.clamp(min=0), num_rows)
        window = torch.repeat_interleave(num_rows, output_size=row.numel())
        left = (self._start.index_select(0, image) + dx.clamp(min=0)).index_select(0, window)
        left += row.mul_(stride.index_select(0, window))
        right = left + (width - dx.abs()).index_select(0, window)
        in_row = self._table.index_select(0, right) - self._table.index_select(0, left)
        return torch.zeros_like(image).index_add_(0, window, in_row)

    def _within(self, axis: int, image: Tensor, shift: Tensor) -> Tensor:
        """(K,) int64, pixels in the rows (columns) under the window."""
        length = self._size[:, axis].index_select(0, image)
        first = self._first_edge[:, axis].index_select(0, image)
        before = self._before[axis]
        begin, end = shift.clamp(min=0), torch.minimum(length, length + shift)
        return before.index_select(0, first + end) - before.index_select(0, first + begin)
