"""Changed pixels: pixels with a slice that is missing in another sweep, although that sweep saw its position.

Near objects cast shadows on the background, and the shadows move with the sensor. So a missing slice is a change only
if the other sweep has a return in the same direction that is at least as far away.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from cflow_torch.ops.chunks import chunks
from cflow_torch.ops.indices import constant, flat_nonzero, floor_divide, scatter_count, split_index, take_columns
from cflow_torch.ops.segments import segment_amin
from cflow_torch.verified.height_slices import NUM_SLICES, SLICE_HEIGHT, HeightSlicedSweeps

# Range images: bins of about half a degree of azimuth and one degree of elevation, half of them below the horizontal.
_AZIMUTHS, _ELEVATIONS, _RISE = 720, 120, 1 / 57.3
# Sweeps do not contain the sensor position. We assume that it is above the origin of the ego frame, at this height over
# the lowest points within 12 m. Of these points, we ignore the lowest fiftieth as outliers.
_ABOVE_LOWEST, _NEAR, _OUTLIERS = 1.6, 12.0, 50
_PER_METRE, _HIGHEST = 256, 8192  # bins of height: number per metre; number above the origin, and below it


class ChangedPixels(NamedTuple):
    """The change of P pixels. All values are False in windows of two sweeps, where one other sweep is too few."""

    is_missing: Tensor  # (P,) bool, a slice is missing in another sweep and not occluded there
    has_changed: Tensor  # (P,) bool, a slice is missing in another sweep that saw its position


def find_changed(sweeps: HeightSlicedSweeps) -> ChangedPixels:
    """Compare every pixel in place with every other sweep of its window.

    Convention:
        A slice is missing if none of the 3 x 3 pixels around its position has it. Slices repeat every 2 m, so the
        height of a slice is ambiguous. From the lowest point of the pixel, we go up to the first 0.5 m layer that is in
        this slice, and take its middle. A sweep saw a position if a return in its direction is at least as far away.
        The position is occluded if all returns in its direction are nearer. Without a return, neither holds.

    Cost: a lookup for each pixel and sweep, and a range image of every sweep.
    """
    pixels, num_steps = sweeps.pixels, sweeps.num_steps
    nothing = torch.zeros_like(pixels.slices, dtype=torch.bool)
    if num_steps == 2:
        return ChangedPixels(nothing, nothing)
    every, area = torch.arange(num_steps, device=nothing.device), sweeps.grid.height * sweeps.grid.width
    index = torch.add((pixels.index - pixels.step * area)[:, None], every, alpha=area)
    around = sweeps.image.index_select(0, index.view(-1)).view_as(index) >> NUM_SLICES
    is_given = ((sweeps.elapsed != 0) | (every == 0)) & sweeps.has_history[:, None]
    missing = (pixels.slices[:, None] & ~around).mul_(is_given.index_select(0, pixels.window))
    # One entry for each set bit of the masks.
    some = flat_nonzero(missing.bool())
    bits = missing.view(-1).index_select(0, some)[:, None] & constant((1, 2, 4, 8), torch.uint8, missing.device)
    entry, bit = split_index(flat_nonzero(bits.bool()), NUM_SLICES)
    pixel, step = split_index(some.index_select(0, entry), num_steps)
    sweep = pixels.window.index_select(0, pixel) * num_steps + step
    farther = RangeImages(sweeps).farther(sweep, _centre(sweeps, pixel, bit))
    is_seen = farther >= 0
    of_missing = torch.stack((is_seen | (farther == -math.inf), is_seen)).view(torch.uint8)
    change = of_missing.new_zeros((2, len(nothing)))
    change.scatter_reduce_(1, pixel.expand(2, -1), of_missing, "amax")
    return ChangedPixels(*change.view(torch.bool))


def _centre(sweeps: HeightSlicedSweeps, pixel: Tensor, bit: Tensor) -> Tensor:
    """Return the centres of slices, (3, K) float64, metres, by their pixels and bits, (K,) int64 each."""
    lowest = segment_amin(sweeps.batch.positions[2], sweeps.pixel_of_point, sweeps.num_pixels + 1, math.inf)
    first = torch.floor(lowest.index_select(0, pixel) / SLICE_HEIGHT)
    height = first + torch.remainder(bit - first, NUM_SLICES) + 0.5
    y, x = sweeps.grid.centre(take_columns(sweeps.pixels.row_col, pixel))
    return torch.stack((x, y, height * SLICE_HEIGHT))


class RangeImages:
    """Range images of all sweeps: the distance of the farthest return in each direction.

    Args:
        sweeps: we use their active points (see `FlowResult.is_valid`).

    Convention: bins are computed without trigonometry, so that they are the same on every device. The azimuth is
    measured by y / (|x| + |y|), in bins of 0.32 to 0.64 degrees, and the elevation by height over distance. Distances
    are float32.
    """

    def __init__(self, sweeps: HeightSlicedSweeps) -> None:
        batch, device = sweeps.batch, sweeps.image.device
        origin = batch.origin.clone()
        origin[:, :, 2].add_(self._sensor_height(sweeps)[:, None])
        self._origin = origin.view(-1, 3).t().contiguous()
        size = origin[:, :, 0].numel() * _ELEVATIONS * _AZIMUTHS
        farthest = torch.full((size,), -math.inf, dtype=torch.float32, device=device)
        for points in chunks(0, batch.image.numel(), device):
            direction, distance = self._direction(batch.image[points].long(), batch.positions[:, points])
            distance.masked_fill_(~batch.is_active[points], -math.inf)
            farthest.scatter_reduce_(0, direction, distance, "amax")
        self._farthest = farthest

    def farther(self, sweep: Tensor, positions: Tensor) -> Tensor:
        """Return the distance of the farthest return in the direction of each position, minus the position's own.

        (K,) float32, metres; -infinity = no return. Sweeps are window * S + step, (K,) int64. Positions are (3, K).
        """
        direction, distance = self._direction(sweep, positions)
        return self._farthest.index_select(0, direction).sub_(distance)

    def _direction(self, sweep: Tensor, positions: Tensor) -> tuple[Tensor, Tensor]:
        """Return the bin of each position, (K,) int64, and its horizontal distance, (K,) float32, metres."""
        offset = positions.sub(take_columns(self._origin, sweep)).float()
        x, y, z = offset
        distance, sum_of_sides = offset[:2].square().sum(0).sqrt_(), offset[:2].abs().sum(0).clamp_(min=1e-3)
        around = y.div_(sum_of_sides)
        around = torch.where(x >= 0, around + 1, 3 - around).nan_to_num_(0.0)  # 0 ... 4
        azimuth = around.mul_(_AZIMUTHS / 4).long().clamp_(max=_AZIMUTHS - 1)
        rise = z.div_(distance.clamp(min=0.1).mul_(_RISE)).add_(_ELEVATIONS // 2).nan_to_num_(0.0)
        elevation = rise.clamp_(0, _ELEVATIONS - 1).long()
        return elevation.add_(sweep, alpha=_ELEVATIONS).mul_(_AZIMUTHS).add_(azimuth), distance

    @staticmethod
    def _sensor_height(sweeps: HeightSlicedSweeps) -> Tensor:
        """Return the height of the sensor above the origin of t+1, (B,) float64, metres."""
        batch, (x, y, z) = sweeps.batch, sweeps.batch.positions.unbind(0)
        is_near = (x * x + y * y <= _NEAR**2) & batch.is_active
        height = (z * _PER_METRE).floor_().nan_to_num_(0.0).clamp_(-_HIGHEST, _HIGHEST - 1).long().add_(_HIGHEST)
        height.add_(batch.image, alpha=2 * _HIGHEST)
        count = scatter_count(height, batch.num_windows * batch.num_steps * 2 * _HIGHEST, is_near.long())
        below = count.view(batch.num_windows, batch.num_steps, -1)[:, 0].cumsum(1)  # of t+1
        low = (below <= floor_divide(below[:, -1:], _OUTLIERS)).sum(1)
        # Without near points, the height is 0.
        return torch.where(below[:, -1] > 0, (low - _HIGHEST).double() / _PER_METRE + _ABOVE_LOWEST, 0.0)
