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
_AROUND = tuple((1, dx, dy) for dy in range(-_REACH, _REACH + 1) for dx in range(-_REACH, _REACH + 1))
# Heights are whole centimetres, bounded so that no sum overflows; unknown ground lies below every point.
_HIGHEST = 10**10
_UNKNOWN = -(1 << 40)


class GroundHeights:
    """Sums of the heights of ground points in blocks of 2 m x 2 m: integers, so the order of points does not matter."""

    def __init__(self, num_windows: int, lower: Sequence[float], upper: Sequence[float], device: torch.device) -> None:
        """`lower` and `upper` are the bounds of the region, metres."""
        self._lower = tuple(lower)
        shape = tuple(int((upper[axis] - lower[axis]) / _BLOCK) + 1 for axis in (1, 0))
        # Of each block: the sum of the heights of its points, centimetres, and their number.
        self._sums = torch.zeros((2, num_windows, *shape), dtype=torch.int64, device=device)

    def add(self, window: int | Tensor, positions: Tensor) -> None:
        """Add ground points in the region, (3, N) float64, metres, frame of t+1, of one window or (N,) windows."""
        block = self._block(positions).long() + window * self._sums[0, 0].numel()
        height = torch.floor(positions[2] * 100).clamp_(-_HIGHEST, _HIGHEST).long()
        self._sums[0].view(-1).index_add_(0, block, height)
        self._sums[1].view(-1).index_add_(0, block, torch.ones_like(height))

    def mean(self) -> Tensor:
        """Return the mean height over 3 x 3 blocks, (B, Y, X) int64, centimetres, rounded down. Where they hold fewer
        than five points, it is a height far below every point."""
        rows, cols = self._sums.shape[2:]
        sums = F.pad(self._sums, (1, 1, 1, 1))
        around = [sums[:, :, down : down + rows, right : right + cols] for down in range(3) for right in range(3)]
        height, count = torch.stack(around).sum(0)
        mean = torch.div(height, count.clamp(min=1), rounding_mode="floor")
        return mean.masked_fill_(count < _FEWEST_POINTS, _UNKNOWN)

    def at(self, positions: Tensor, window: int | Tensor, mean: Tensor) -> Tensor:
        """Return the height of the ground around each position, (N,) float64, centimetres.

        Positions are (3, N), metres, in the region; `window` is (N,) or one number. `mean` is what `mean()` returns.
        """
        block = self._block(positions) + window * (mean.shape[1] * mean.shape[2])
        return mean.view(-1).double().index_select(0, block.clamp_(0, mean.numel() - 1))

    def slopes(self, centre: Tensor, window: Tensor) -> Tensor:
        """Return the slopes of the ground around objects, (G, 2) float64, metres of height per metre in x and in y.

        `centre` has x and y of each object, (G, 2) float64, metres, frame of t+1, in or outside the region. We fit a
        plane to the mean heights of the blocks around it. The slope is 0 if the plane is steeper than 0.3, if a fit
        has fewer than five blocks, or if they lie nearly on a line. `window` is (G,); B + w stands for window w.

        Convention: block heights are whole millimetres, rounded down, so all sums are exact.
        """
        height, is_known = self._around(centre, window)
        design = constant(_AROUND, torch.float64, window.device)  # [25, 3]
        terms = torch.cat((design.t().expand(len(window), 3, -1), height[:, None]), 1)  # [G, 4, 25]
        fits = [_fit_plane(terms, design, is_known)]
        for _ in range(1, _NUM_FITS):
            height_of_plane = (fits[-1].plane[:, :, None] * design.t()[:, None]).sum(0)  # [G, 25]
            is_near = (height - height_of_plane).abs() <= _FARTHEST
            fits.append(_fit_plane(terms, design, is_known & is_near))
        num_blocks = torch.stack([fit.num_blocks for fit in fits])
        determinant = torch.stack([fit.determinant for fit in fits])
        is_flat = ((num_blocks >= _FEWEST_BLOCKS) & (4 * determinant >= num_blocks**3)).all(0)
        slope = fits[-1].plane[1:] / (1000 * _BLOCK)
        is_ground = is_flat & (slope.square().sum(0) <= _STEEPEST**2)
        return torch.where(is_ground, slope, 0.0).t().contiguous()

    def _around(self, centre: Tensor, window: Tensor) -> tuple[Tensor, Tensor]:
        """Return the mean heights of the 5 x 5 blocks around objects, in whole millimetres, (G, 25) float64.

        Also return which of them are known, (G, 25) bool. Arguments as for `slopes`.
        """
        block = self._padded_blocks_around(centre, window)  # [G, 25]
        padded = F.pad(self._sums, (_REACH, _REACH, _REACH, _REACH)).view(2, -1)
        height, count = padded.index_select(1, block.view(-1)).view(2, *block.shape)
        mean = torch.div(10 * height, count.clamp(min=1), rounding_mode="floor").double()
        return mean, count >= _FEWEST_POINTS

    def _padded_blocks_around(self, centre: Tensor, window: Tensor) -> Tensor:
        """Return the 5 x 5 blocks around objects, (G, 25) int64, as indices into sums with `_REACH` blocks around."""
        num_windows, rows, cols = self._sums.shape[1:]
        stride = cols + 2 * _REACH
        offset = tuple((dy + _REACH) * stride + dx + _REACH for _, dx, dy in _AROUND)
        ends = constant(((0, 0), (cols - 1, rows - 1)), torch.int64, window.device)
        lower = constant(self._lower[:2], torch.float64, window.device)
        col, row = torch.floor((centre - lower) / _BLOCK).clamp_(*ends).long().unbind(1)
        line = window % num_windows * (rows + 2 * _REACH) + row
        return torch.add(col, line, alpha=stride)[:, None] + constant(offset, torch.int64, window.device)

    def _block(self, positions: Tensor) -> Tensor:
        """Return the block of positions in the region, (N,) int32. There int() rounds down."""
        lower = constant(self._lower[:2], positions.dtype, positions.device)
        col, row = (positions[:2] - lower[:, None]).div_(_BLOCK).int()
        return col.add_(row, alpha=self._sums.shape[3])


class _Fit(NamedTuple):
    """Planes a + b column + c row, fitted to the blocks around G objects."""

    plane: Tensor  # (3, G) float64, millimetres; undefined if the blocks lie on a line
    num_blocks: Tensor  # (G,) float64
    determinant: Tensor  # (G,) float64, of the normal equations


def _fit_plane(terms: Tensor, design: Tensor, is_used: Tensor) -> _Fit:
    """Fit planes by least squares.

    Args:
        terms: (G, 4, 25) float64: 1, column, row and height of each block.
        design: (25, 3) float64: 1, column and row.
        is_used: (G, 25) bool.
    """
    sums = ((terms * is_used[:, None]) @ design).permute(1, 2, 0)  # [4, 3, G]
    cofactors, determinant = adjugate(upper(sums[:3]))
    plane = matvec(full(cofactors), sums[3]) / determinant
    return _Fit(plane, sums[0, 0], determinant)
