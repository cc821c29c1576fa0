"""Height and slope of the ground around a point, from the ground points of t: harnesses may give no other masks."""

from __future__ import annotations

from typing import NamedTuple, Sequence

import torch
import torch.nn.functional as F
from torch import Tensor

from cflow_torch.ops.indices import constant
from cflow_torch.ops.linear import adjugate, full, matvec, upper

# Side of the blocks, metres. A block and the eight around it cover 6 m x 6 m.
_BLOCK = 2.0
# With fewer ground points in 6 m x 6 m (`mean`) or in a block (`slopes`), the height is unknown.
_FEWEST_POINTS = 5
_FEWEST_BLOCKS = 5  # of a plane
# We fit a plane to the blocks at most two away each way (10 m x 10 m), three times. The second and third fit leave out
# blocks more than 100 mm from the last plane, such as a pavement (ties stay). Planes steeper than 0.3 are not ground.
_REACH = 2
_NUM_FITS = 3
_FARTHEST = 100 + 1e-6
_STEEPEST = 0.3
# Terms of the plane in each of these blocks: 1, and its column and row from the middle block.
_DESIGN = tuple((1, dx, dy) for dy in range(-_REACH, _REACH + 1) for dx in range(-_REACH, _REACH + 1))
# Heights are whole centimetres, bounded so that no sum overflows; unknown ground lies below every point.
_HIGHEST = 10**10
_UNKNOWN = -(1 << 40)


class GroundHeights:
    """Sums of the heights of ground points in blocks of 2 m x 2 m: integers, so the order of points does not matter."""

    def __init__(self, num_windows: int, lower: Sequence[float], upper: Sequence[float], device: torch.device) -> None:
        """`lower` and `upper` are the bounds of the region, metres."""
        self._lower = tuple(lower[:2])
        num_cols = int((upper[0] - lower[0]) / _BLOCK) + 1
        num_rows = int((upper[1] - lower[1]) / _BLOCK) + 1
        # Of each block: the sum of the heights of its points, centimetres, and their number.
        self._sums = torch.zeros((2, num_windows, num_rows, num_cols), dtype=torch.int64, device=device)

    def add(self, window: int | Tensor, positions: Tensor) -> None:
        """Add ground points in the region, (3, N) float64, metres, frame of t+1, of one window or (N,) windows."""
        block = self._block(positions, window).long()
        height = torch.floor(positions[2] * 100).clamp_(-_HIGHEST, _HIGHEST).long()
        self._sums[0].view(-1).index_add_(0, block, height)
        self._sums[1].view(-1).index_add_(0, block, torch.ones_like(height))

    def mean(self) -> Tensor:
        """Return the mean height over 3 x 3 blocks, (B, Y, X) int64, centimetres, rounded down. Where they hold fewer
        than five points, it is a height far below every point."""
        height, count = self._around(1).sum((4, 5))
        height.div_(count.clamp(min=1), rounding_mode="floor")
        return height.masked_fill_(count < _FEWEST_POINTS, _UNKNOWN)

    def at(self, positions: Tensor, window: int | Tensor, heights: Tensor) -> Tensor:
        """Return the height of the block of each position, (N,) float64, centimetres.

        Positions are (3, N), metres, in the region; `window` is (N,) or one number. `heights` has one of each block, as
        `mean()` returns them.
        """
        block = self._block(positions, window).clamp_(0, heights.numel() - 1)
        return heights.view(-1).double().index_select(0, block)

    def slopes(self, centre: Tensor, window: Tensor) -> Tensor:
        """Return the slopes of the ground around objects, (G, 2) float64, metres of height per metre in x and in y.

        `centre` has x and y of each object, (G, 2) float64, metres, frame of t+1, in or outside the region. We fit a
        plane to the mean heights of the blocks around it. The slope is 0 if the plane is steeper than 0.3, if a fit
        has fewer than five blocks, or if they lie nearly on a line. `window` is (G,); B + w stands for window w.

        Convention: block heights are whole millimetres, rounded down, so all sums are exact.
        """
        blocks = self._blocks_around(centre, window)
        fits = [_Fit.of(blocks, blocks.is_known)]
        while len(fits) < _NUM_FITS:
            distance = (blocks.height - fits[-1].heights(blocks)).abs()
            fits.append(_Fit.of(blocks, blocks.is_known & (distance <= _FARTHEST)))
        num_blocks = torch.stack([fit.num_blocks for fit in fits])
        determinant = torch.stack([fit.determinant for fit in fits])
        is_spread = num_blocks >= _FEWEST_BLOCKS
        is_spread &= 4 * determinant >= num_blocks**3
        slope = fits[-1].plane[1:] / (1000 * _BLOCK)
        is_gentle = slope.square().sum(0) <= _STEEPEST**2
        return torch.where(is_spread.all(0) & is_gentle, slope, 0.0).t().contiguous()

    def _blocks_around(self, centre: Tensor, window: Tensor) -> _Blocks:
        """Return the 5 x 5 blocks around objects. Arguments as for `slopes`."""
        lower = constant(self._lower, torch.float64, centre.device)
        col_row = torch.floor((centre - lower) / _BLOCK)
        col = col_row[:, 0].clamp(0, self._sums.shape[3] - 1).long()
        row = col_row[:, 1].clamp(0, self._sums.shape[2] - 1).long()
        around = self._around(_REACH)[:, window % self._sums.shape[1], row, col]  # [2, G, 5, 5]
        height, count = around.flatten(2)
        mean = torch.div(10 * height, count.clamp(min=1), rounding_mode="floor").double()
        design = constant(_DESIGN, torch.float64, centre.device)
        terms = torch.cat((design.t().expand(len(mean), 3, -1), mean[:, None]), 1)
        return _Blocks(design, terms, count >= _FEWEST_POINTS)

    def _around(self, reach: int) -> Tensor:
        """Return the sums of the blocks at most `reach` away each way, (2, B, Y, X, K, K); outside they are 0."""
        padded = F.pad(self._sums, (reach, reach, reach, reach))
        return padded.unfold(2, 2 * reach + 1, 1).unfold(3, 2 * reach + 1, 1)

    def _block(self, positions: Tensor, window: int | Tensor) -> Tensor:
        """Return the block of each position in the region, (N,) int32 or int64. There int() rounds down."""
        lower = constant(self._lower, positions.dtype, positions.device)
        col, row = (positions[:2] - lower[:, None]).div_(_BLOCK).int()
        return col.add_(row, alpha=self._sums.shape[3]) + window * self._sums[0, 0].numel()


class _Blocks(NamedTuple):
    """The 5 x 5 blocks around G objects, row by row."""

    design: Tensor  # (25, 3) float64: 1, column and row, from the middle block
    terms: Tensor  # (G, 4, 25) float64: 1, column, row, and the mean height in whole millimetres
    is_known: Tensor  # (G, 25) bool

    @property
    def height(self) -> Tensor:
        return self.terms[:, 3]


class _Fit(NamedTuple):
    """Planes a + b column + c row, fitted to the blocks around G objects."""

    plane: Tensor  # (3, G) float64, millimetres; undefined if the blocks lie on a line
    num_blocks: Tensor  # (G,) float64
    determinant: Tensor  # (G,) float64, of the normal equations

    @classmethod
    def of(cls, blocks: _Blocks, is_used: Tensor) -> _Fit:
        """Fit planes by least squares to the blocks that are used, (G, 25) bool."""
        sums = ((blocks.terms * is_used[:, None]) @ blocks.design).permute(1, 2, 0)  # [4, 3, G]
        cofactors, determinant = adjugate(upper(sums[:3]))
        plane = matvec(full(cofactors), sums[3]) / determinant
        return cls(plane, sums[0, 0], determinant)

    def heights(self, blocks: _Blocks) -> Tensor:
        """Return the height of each plane at the blocks around its object, (G, 25) float64, millimetres."""
        return (self.plane[:, :, None] * blocks.design.t()[:, None]).sum(0)
