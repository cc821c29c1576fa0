"""Count the set pixels of binary images inside shifted windows. Each window has the size of its image."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from cflow_torch.ops.indices import concat_ranges, scatter_count, take_columns


class WindowCounts:
    """Tables for counting, made from the set pixels of N images.

    Args:
        image, row, col: (P,) int64, image and position of each pixel, each pixel once.
        size: (N, 2) int64, height H and width W of each image; on the host, because table lengths depend on it.

    Cost: linear in the area of the images.
    """

    def __init__(self, image: Tensor, row: Tensor, col: Tensor, size: np.ndarray) -> None:
        edges = np.ascontiguousarray(size.T) + 1
        first_edge = (edges.cumsum() - edges.ravel()).reshape(edges.shape)
        area = size[:, 0] * edges[1]
        numbers = np.concatenate((size.T, first_edge, area.cumsum()[None] - area, edges[1:]))
        self._numbers = torch.from_numpy(numbers).to(image.device)
        numbers_of_pixel = take_columns(self._numbers[2:], image)
        edge, (start, stride) = numbers_of_pixel[:2], numbers_of_pixel[2:]
        # Number of pixels above every row, and to the left of every column. In differences, earlier images cancel.
        line = torch.stack((row, col)).add_(edge).add_(1)
        self._before = scatter_count(line.flatten(), int(edges.sum())).cumsum(0)
        # Running sum over all rows. Each row has W + 1 samples, of which the first is empty.
        table = torch.zeros(int(area.sum()), dtype=torch.int32, device=image.device)
        self._table = table.index_fill_(0, stride.mul_(row).add_(start).add_(col).add_(1), 1).cumsum(0)

    def bounds(self, image: Tensor, shift: Tensor) -> tuple[Tensor, Tensor]:
        """Lower and upper bounds of `count`, (K,) int64 each. Args as for `count`."""
        size, first = take_columns(self._numbers[:4], image).view(2, 2, -1)
        begin, end = shift.clamp(min=0), torch.minimum(size, size + shift)
        edges = torch.stack((begin, end, torch.zeros_like(size), size)).add_(first)
        begin, end, first, last = self._before.index_select(0, edges.view(-1)).view(edges.shape)
        rows, cols = end - begin
        return rows + cols - (last - first)[0], torch.minimum(rows, cols)

    def count(self, image: Tensor, shift: Tensor) -> Tensor:
        """(K,) int64, number of set pixels in rows dy ... H - 1 + dy and columns dx ... W - 1 + dx.

        Args:
            image: (K,) int64, number of the image of each window.
            shift: (2, K) int64, dy and dx, |dy| <= H, |dx| <= W.

        Cost: linear in the height of the windows.
        """
        height, width, _, _, start, stride = take_columns(self._numbers, image)
        (top, left), (down, right) = shift.clamp(min=0), shift.abs()
        num_rows = height - down
        row = concat_ranges(top, num_rows)
        window = torch.repeat_interleave(num_rows, output_size=row.numel())
        start, stride, width = take_columns(torch.stack((start + left, stride, width - right)), window)
        start += row.mul_(stride)
        in_row = self._table.index_select(0, start + width) - self._table.index_select(0, start)
        return torch.zeros_like(image).index_add_(0, window, in_row)
