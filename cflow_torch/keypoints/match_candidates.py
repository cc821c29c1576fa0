"""Key points, their descriptors, and the blocks of key points of t+1 within a radius of a key point of t.

A block is 64 neighbours: consecutive key points, by column, of a band of 12 rows. In the order of window, band and
column, the blocks within the radius of a key point are a few ranges, one a band. No tensor ever holds all pairs of key
points of t and t+1.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from cflow_torch.config import KeypointsConfig
from cflow_torch.ops.indices import concat_ranges, divide, flat_nonzero, index_in_group, split_index
from cflow_torch.ops.morphology import erode_cross
from cflow_torch.windows.collation import Batch

BLOCK_SIZE = 64
_BAND_ROWS = 12
_BAND_BITS = 16
_COL_BITS = 17
# `gate_radius` is the longest distance of a match between sweeps that are this many seconds apart.
_GATE_SECONDS = 0.1


@dataclass(frozen=True)
class Patches:
    """The L x L pixels around each of K key points. `patches[i]` copies some; no tensor holds all of them.

    All images form one line of pixels, and a patch is L runs of L pixels of it:

        image, L = 3     . . . . .          line      . . . . . . a b c . . d e f . . g h i .
                         . a b c .          start                 ^         ^         ^
                         . d e f .
                         . g h i .
    """

    line: Tensor  # (A,) uint8, zeros and ones; the images have an empty border of L // 2 pixels
    start: Tensor  # (K, L) int64, position in the line of the first pixel of each row of each patch

    @classmethod
    def around(cls, points: _Positions, images: Tensor, size: int) -> Patches:
        """Find the patches of L = `size` around pixels of (B, H, W) bool images."""
        half = size // 2
        padded = F.pad(images.view(torch.uint8), (half, half, half, half))
        _, height, width = padded.shape
        corner = (points.window * height + points.row) * width + points.col  # [K]
        start = corner[:, None] + torch.arange(0, size * width, width, device=images.device)
        return cls(padded.flatten(), start)

    @property
    def num_pixels(self) -> int:
        """Number of pixels of a patch, L^2."""
        return self.start.shape[1] ** 2

    def __getitem__(self, points: Tensor) -> Tensor:
        """Copy the patches of key points, (S,) int64: (S, L^2) uint8."""
        runs = self.line.unfold(0, self.start.shape[1], 1)  # a view: L pixels, from each pixel on
        return runs.index_select(0, self.start.index_select(0, points).flatten()).view(-1, self.num_pixels)

    def energy(self) -> Tensor:
        """Count the ones of all patches, (K,) int64."""
        size = self.start.shape[1]
        sums = F.pad(self.line.int().cumsum(0, dtype=torch.int32), (1, 0))  # of all pixels before each one
        of_run = sums[size:] - sums[:-size]
        return of_run.index_select(0, self.start.flatten()).view_as(self.start).sum(1)


class _Positions(NamedTuple):
    """Pixels of images."""

    window: Tensor  # (K,) int64, image of each pixel
    row: Tensor  # (K,) int64
    col: Tensor  # (K,) int64


@dataclass(frozen=True)
class KeyPoints:
    """Key points of one sweep of every window, in order of window, row and column."""

    pixel: Tensor  # (K,) int64, flat indices into the images, ascending
    window: Tensor  # (K,) int64
    row: Tensor  # (K,) int64, row in the image of the window
    col: Tensor  # (K,) int64, column in the image of the window
    patches: Patches  # the descriptors
    energy: Tensor  # (K,) int64, number of ones of each descriptor, at least 1

    def __len__(self) -> int:
        return self.row.numel()


def detect(occupancy: Tensor) -> Tensor:
    """Find the key points of (..., H, W) bool images: set pixels at distance 1 from the background or the outside."""
    return occupancy & ~erode_cross(occupancy)


def describe_keypoints(images: Tensor, patch_size: int) -> KeyPoints:
    """Find the key points of one sweep per window, and describe each by the L x L pixels around it (Sec. Descriptor).

    The images are (B, H, W) bool; patches are zero outside. Cost: 8 L bytes per key point.
    """
    pixel = flat_nonzero(detect(images))
    image_row, col = split_index(pixel, images.shape[2])
    window, row = split_index(image_row, images.shape[1])
    patches = Patches.around(_Positions(window, row, col), images, patch_size)
    return KeyPoints(pixel, window, row, col, patches, patches.energy())


def match_radius(batch: Batch, pixel_size: float, config: KeypointsConfig) -> Tensor:
    """(B,) float64, pixels: longest distance of a match in each window, by `gate_radius` and `max_speed`."""
    seconds = batch.seconds[:, 1]
    gate = divide(config.gate_radius * divide(seconds, _GATE_SECONDS), pixel_size)
    if config.max_speed is None:
        return gate
    return torch.minimum(gate, divide(config.max_speed * seconds, pixel_size) + 1)


@dataclass(frozen=True)
class KeypointBlocks:
    """Key points in blocks, in order of window, band of rows and column. A block lies in one band of one window."""

    block: Tensor  # (K,) int64, block of each key point
    slot: Tensor  # (K,) int64, index of each key point in its block, 0 ... 63
    first: Tensor  # (N,) int64, sorting key of the first key point of each block, ascending
    last: Tensor  # (N,) int64, sorting key of the last key point of each block, ascending
    num_bands: int  # bands of rows in an image, down to the last one with a key point

    def __len__(self) -> int:
        return self.first.numel()

    def arrange(self, values: Tensor, missing: float) -> Tensor:
        """Arrange values of the key points, (K,), by blocks, (N, 64); `missing` where a block has fewer."""
        table = values.new_full((len(self), BLOCK_SIZE), missing)
        table[self.block, self.slot] = values
        return table


def make_blocks(points: KeyPoints) -> KeypointBlocks:
    """Cut the key points of each band of rows into blocks, by column."""
    band = points.row // _BAND_ROWS
    key, order = _sorting_key(points.window, band, points.col).sort()
    rank = order.argsort()
    slot = index_in_group(key >> _COL_BITS) % BLOCK_SIZE
    begin = flat_nonzero(slot == 0)
    end = F.pad(begin[1:], (0, 1), value=len(points))
    block = torch.repeat_interleave(torch.arange(begin.numel(), device=key.device), end - begin)
    return KeypointBlocks(
        block=block[rank],
        slot=slot[rank],
        first=key[begin],
        last=key[end - 1],
        num_bands=int(band.max()) + 1,
    )


def near_blocks(points: KeyPoints, order: Tensor, blocks: KeypointBlocks, reach: Tensor) -> tuple[Tensor, Tensor]:
    """Find the blocks that may have a key point within reach of each point; `reach` is (B,) float64, pixels.

    Returns:
        The blocks near the first point in this order, those near the second one, and so on, int64. The number of
        blocks near each point in this order, (K,) int64.
    """
    window = points.window[order, None]  # [K, 1]
    row = points.row[order, None]
    col = points.col[order, None]
    radius = reach[window]
    first_band = (row - radius.long()).clamp_(min=0) // _BAND_ROWS
    num_bands = min(int(2 * reach.max()) // _BAND_ROWS + 2, blocks.num_bands)
    band = first_band + torch.arange(num_bands, device=row.device)  # [K, bands]
    squared_width = radius * radius - _rows_between(row, band).square()  # negative if the band is out of reach
    half_width = squared_width.clamp(min=0).sqrt().ceil().clamp(max=1 << 15).long()
    begin = torch.searchsorted(blocks.last, _sorting_key(window, band, (col - half_width).clamp(min=0)))
    end = torch.searchsorted(blocks.first, _sorting_key(window, band, col + half_width + 1))
    count = (end - begin) * (squared_width >= 0)
    return concat_ranges(begin.flatten(), count.flatten()), count.sum(1)


def _rows_between(row: Tensor, band: Tensor) -> Tensor:
    """Return how many rows lie between a row and a band, int64; 0 if the band contains the row."""
    top = band * _BAND_ROWS
    bottom = top + _BAND_ROWS - 1
    return torch.maximum(top - row, row - bottom).clamp_(min=0)


def _sorting_key(window: Tensor, band: Tensor, col: Tensor) -> Tensor:
    """Return a key that sorts by window, band, column.

    bits  33 ...  17 ... 32  0 ... 16
          window  band       column
    """
    return (((window << _BAND_BITS) + band) << _COL_BITS) + col
