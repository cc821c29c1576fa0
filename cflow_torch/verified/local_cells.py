"""Cells as wide as a walker's step, and where small velocities take pixels among them."""

from __future__ import annotations

import math
from typing import List

import torch
from torch import Tensor

from cflow_torch.ops.indices import divide
from cflow_torch.verified.height_slices import HeightSlicedSweeps
from cflow_torch.verified.local_evidence import Looks
from cflow_torch.verified.paired_test import moves_of

_CELL = 0.3  # metres; won and lost are summed over 3 x 3 cells


class Cells:
    """Cells of all windows, with free ones around each image, so that no velocity leads out of them.

    Args:
        sweeps: finest images.
        velocities: (V, 2) float64, (y, x), finest pixels per sweep interval.

    Attributes:
        side: pixels a side of a cell.
        reach: number of free cells on each side of an image.
        shape: (windows, rows, cols), the free ones counted.
        count: of all windows.
    """

    def __init__(self, sweeps: HeightSlicedSweeps, velocities: Tensor) -> None:
        grid = sweeps.grid
        self.velocities, self._num_steps = velocities, sweeps.num_steps
        self.side = max(1, round(_CELL / grid.pixel_size))
        moves = moves_of(sweeps.elapsed, velocities.expand(sweeps.num_windows, -1, -1))
        moves = moves.view(sweeps.num_windows, 2, self._num_steps, -1, 2)[:, 0]  # from each sweep to t+1
        self.reach = int(moves.abs().amax()) // self.side + 2
        rows, cols = (-(-size // self.side) + 2 * self.reach for size in (grid.height, grid.width))
        self.shape = (sweeps.num_windows, rows, cols)
        self.count = math.prod(self.shape)
        # How many cells further a pixel is taken, by its place in its own; velocity after velocity.
        line = torch.arange(self.side, device=moves.device)
        down, right = (divide(moves[:, :, None, :, axis] + line[:, None], self.side) for axis in (0, 1))
        ways = down[:, :, :, None] * cols + right[:, :, None]
        ways = ways.reshape(-1, len(velocities)) + torch.arange(len(velocities), device=moves.device) * self.count
        self._ways = ways.int() if len(velocities) * self.count < 1 << 31 else ways

    def own(self, window: Tensor, row: Tensor, col: Tensor) -> Tensor:
        """(K,) int64, the cell of pixels."""
        _, rows, cols = self.shape
        return (window * rows + divide(row, self.side) + self.reach) * cols + divide(col, self.side) + self.reach

    def at_newest(self, some: Looks) -> Tensor:
        """(L, V) int32 or int64, velocity * count + the cell where it takes the pixel at t+1."""
        kind = some.window * self._num_steps + some.step
        for place in (some.row, some.col):
            kind = kind * self.side + place % self.side
        ways = self._ways.index_select(0, kind)
        return ways.add_(self.own(some.window, some.row, some.col).to(ways.dtype)[:, None])

    def add_around(self, sums: Tensor, place: Tensor, counts: Tensor) -> None:
        """Add counts (K,) to those of the 3 x 3 cells around places, (K,) as of `at_newest`."""
        for offset in self.around():
            sums.index_add_(0, place + offset, counts)

    def around(self) -> List[int]:
        """How far the 3 x 3 cells around one are from it."""
        return [down * self.shape[2] + right for down in (-1, 0, 1) for right in (-1, 0, 1)]

    def within_reach(self) -> Tensor:
        """(K,) int64: how far the cells are from one that a velocity may lead from beside it."""
        line = torch.arange(-self.reach, self.reach + 1, device=self._ways.device)
        return (line[:, None] * self.shape[2] + line).view(-1)

    def is_free(self) -> Tensor:
        """(windows, rows, cols) bool: which cells lie around the images."""
        free = torch.ones(self.shape, dtype=torch.bool, device=self._ways.device)
        free[:, self.reach : -self.reach, self.reach : -self.reach] = False
        return free
