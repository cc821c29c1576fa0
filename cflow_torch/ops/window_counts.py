"""Count the set pixels of binary images inside shifted windows. Each window has the size of its image."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from cflow_torch.ops.groups import Groups
from cflow_torch.ops.indices import concat_ranges, draw, take_columns


class WindowCounts:
    """Tables for counting, made from the set pixels of N images.

    Args:
        image, row, col: (P,) int64, image and position of each pixel, each pixel once.
        size: (N, 2) int64, height H and width W of each image; on the host, because table lengths depend on it.
        energy: (N,) int64, number of set pixels of each image.

    Cost: linear in the area of the images.
    """

    def __init__(self, image: Tensor, row: Tensor, col: Tensor, size: np.ndarray, energy: Tensor) -> None:
        lines = size.T + 1  # [2, N]: H + 1 and W + 1
        ends = lines.cumsum().reshape(lines.shape)
        area = size[:, 0] * lines[1]
        first = area.cumsum() - area
        table = torch.from_numpy(np.concatenate((size.T, ends - lines, np.stack((first, lines[1]))))).to(image.device)
        self._size = table[:2]  # (2, N)
        self._first_line = table[2:4]  # (2, N), of the rows and of the columns of each image, see `_num_before`
        self._start_stride = table[4:]  # (2, N), of each image in `_num_so_far`

        # Number of pixels above every row, then to the left of every column, of all images. Each image has one line
        # more than rows or columns. We count through all images, because differences are all that we need.
        line = torch.stack((row, col)) + take_columns(self._first_line, image) + 1
        self._num_before = Groups(line.flatten(), int(lines.sum())).size().cumsum(0)
        self.energy = energy
        # Number of pixels so far, in raster order. A row of W pixels has W + 1 entries:
        #
        #     row      . x x      entries   0 0 1 2
        #              x . x                2 3 3 4
        start, stride = take_columns(self._start_stride, image)
        drawn = draw(start + row * stride + col + 1, int(area.sum()))
        self._num_so_far = drawn.cumsum(0)

    def bounds(self, image: Tensor, shift: Tensor) -> tuple[Tensor, Tensor]:
        """Lower and upper bounds of `count`, (K,) int64 each. Args as for `count`."""
        size = take_columns(self._size, image)
        first = shift.clamp(min=0)  # [2, K], row and column
        last = torch.minimum(size, size + shift)
        lines = torch.stack((first, last)) + take_columns(self._first_line, image)  # [2, 2, K]
        before_first, before_last = self._num_before.index_select(0, lines.view(-1)).view(lines.shape)
        rows, cols = before_last - before_first  # pixels in the rows, and in the columns, of the window
        return rows + cols - self.energy.index_select(0, image), torch.minimum(rows, cols)

    def count(self, image: Tensor, shift: Tensor) -> Tensor:
        """(K,) int64, number of set pixels in rows dy ... H - 1 + dy and columns dx ... W - 1 + dx.

        Args:
            image: (K,) int64, number of the image of each window.
            shift: (2, K) int64, dy and dx, |dy| <= H, |dx| <= W.

        Cost: linear in the height of the windows.
        """
        start, stride = take_columns(self._start_stride, image)
        num_rows, num_cols = take_columns(self._size, image) - shift.abs()
        top, left = shift.clamp(min=0)
        row = concat_ranges(top, num_rows)  # [R], the rows of all windows
        window = torch.repeat_interleave(num_rows, output_size=len(row))
        start, stride, num_cols = take_columns(torch.stack((start + left, stride, num_cols)), window)
        first = start + row * stride
        in_row = self._num_so_far.index_select(0, first + num_cols) - self._num_so_far.index_select(0, first)
        return torch.zeros_like(image).index_add_(0, window, in_row)
