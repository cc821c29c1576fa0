"""Sub-pixel motion of pairs: find slow objects by matching the centroids of small cubes.

Between two sweeps, the pixels of a slow object hardly change, but the points within them shift. We put the points into
cubes as high as a pixel is wide, and find the shift under which their centroids match best by a few mean-shift steps. A
static object becomes a moving one if its match improves significantly. Registration then refines its motion.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor

from cflow_torch.ops.indices import constant, flat_nonzero, gather, lookup, scatter_count, take_columns
from cflow_torch.verified.component_tree import Objects
from cflow_torch.verified.height_slices import REACH, HeightSlicedSweeps, count_slices
from cflow_torch.verified.voxel_centroids import UNITS, Voxels, points_of_objects

_BIAS_Z, _LEAST_BIAS = 3, 0.1  # least |a - b| of `_is_biased`: in standard deviations of noise, as a share of slices
_NUM_LAYERS = 16  # layers of cubes, after which their numbers repeat
# Number and length of the steps. The length is above 1, because the nearest cubes change with each step.
NUM_STEPS, STEP_LENGTH = 4, 1.4
_Z, _LEAST_GAIN = 4.0, 0.05  # standard deviations of noise; gain per cube, as a share of a perfect match
_SIGMA = 0.07  # metres, of the Gaussian that weights two centroids by their distance
BYTES_PER_POINT = 560  # a cube and the 25 cubes around it


def subpixel_motion(sweeps: HeightSlicedSweeps, objects: Objects, motion: Tensor, may_be_slow: Tensor) -> Tensor:
    """Return the motion of all objects, including slow objects of pairs.

    Args:
        motion: (G, 2) float64, (y, x), finest pixels per sweep interval; 0 = static.
        may_be_slow: (G,) bool, the static objects to test. Those in windows with history are not tested.

    Returns:
        (G, 2) float64, x and y, metres per sweep interval.

    Cost: eight lookups for each pixel of objects that may be slow. Of these, biased objects (`_is_biased`) cost 25
        lookups for each cube, and 25 comparisons for each cube and step.
    """
    flow = motion.flip(1) * sweeps.grid.pixel_size
    window = sweeps.pixels.window.index_select(0, objects.first)
    slow = may_be_slow & ~sweeps.has_history.index_select(0, window) & ~motion.any(1)
    if not bool(slow.any()):
        return flow
    slow &= _is_biased(sweeps, objects, slow)
    points = points_of_objects(sweeps, objects, slow, sweeps.grid.pixel_size, _NUM_LAYERS)
    shift = _significant_shift(Voxels(points, sweeps, _NUM_LAYERS), len(flow)) / UNITS
    return flow + shift / sweeps.elapsed[:, 1].index_select(0, window)[:, None]


def _is_biased(sweeps: HeightSlicedSweeps, objects: Objects, wanted: Tensor) -> Tensor:
    """Find objects of pairs that match the other sweep better one pixel ahead than one pixel behind, or vice versa.

    `wanted` and the result are (G,) bool. Of the slices of both sweeps, a are matched only ahead and b only behind. An
    object is biased if, in one of four directions, (a - b)^2 >= z^2 (a + b), and |a - b| is at least a tenth of its
    slices. For t+1, "ahead" is the opposite side. The result is False for objects that are not wanted.
    """
    pixels = sweeps.pixels
    some = flat_nonzero(lookup(wanted, objects.of_pixel) & (pixels.step < 2))
    of, asked = objects.of_pixel.index_select(0, some), pixels.take(some)
    grid, from_t = sweeps.grid, 2 * asked.step - 1  # opposite for t+1
    # Rows and columns of a pixel ahead in four directions, then of a pixel behind.
    sides = ((0, 1, 1, 1, 0, -1, -1, -1), (1, -1, 0, 1, -1, 1, 0, -1))
    offsets = tuple(dy * grid.width + dx - grid.height * grid.width for dy, dx in zip(*sides))
    offset, at = (constant(values, torch.int64, of.device)[..., None] * from_t for values in (offsets, sides))
    index = sweeps.or_outside(asked.index + offset, asked.row_col[:, None] + at)
    own = asked.slices
    ahead, behind = (own & sweeps.image.index_select(0, index.view(-1)).view_as(index)).view(2, 4, -1)
    counts = count_slices(torch.cat((ahead & ~behind, behind & ~ahead, own[None])))
    sums = scatter_count(of, objects.count, counts)
    a, b = sums[:-1].view(2, 4, -1)
    bias = (a - b).abs()
    is_significant = bias * bias >= _BIAS_Z**2 * (a + b)
    return (is_significant & (bias >= _LEAST_BIAS * sums[-1])).any(0) & (sums[-1] > 0)


def _significant_shift(voxels: Voxels, num_objects: int) -> Tensor:
    """Return the shift from t to t+1 under which the cubes of each object match best, (G, 2) float64, x and y, whole
    units; 0 = it is not significant.

    Convention: a cube of t, moved by the shift, matches the nearest cube of t+1 among those in the 5 x 5 pixels around
        it. A cube of t+1, moved back, likewise matches one of t. Cubes 4 m apart never match. Ties: the first in raster
        order. Each step changes the shift by `STEP_LENGTH` times the weighted mean of the errors. The gain is the
        weight of all matches with the shift minus their weight without it. It must exceed `_Z` standard deviations of
        noise, and reach `_LEAST_GAIN` per cube.
    """
    some = flat_nonzero(voxels.step < 2)
    window, step, layer, of = gather(some, voxels.window, voxels.step, voxels.layer, voxels.object_id)
    position = take_columns(voxels.position[:2], some)
    near = voxels.around(window * voxels.num_steps + 1 - step, layer[None], position, REACH)
    ahead = take_columns(voxels.position[:2], near.view(-1)).view(2, *near.shape) - position[:, None]
    ahead = ahead.clamp_(-4096, 4096).mul_((2 * step - 1).double())  # for t+1, all signs change

    weights, shift = _match_weights(step.device), position.new_zeros((2, num_objects))
    weight, error = _nearest_match(ahead, weights)
    unshifted = weight
    for _ in range(NUM_STEPS):
        sums = scatter_count(of, num_objects, torch.cat((weight[None], weight * error)))
        shift += (STEP_LENGTH * sums[1:] / sums[0].clamp(min=1 / 256)).round_()  # the least weight above 0
        weight, error = _nearest_match(ahead - take_columns(shift, of)[:, None], weights)
    gain = weight - unshifted
    gain, square, count = scatter_count(of, num_objects, torch.stack((gain, gain * gain, torch.ones_like(gain))))
    return shift.t() * ((gain > _Z * square.sqrt()) & (gain >= _LEAST_GAIN * count))[:, None]


def _nearest_match(ahead: Tensor, weights: Tensor) -> tuple[Tensor, Tensor]:
    """Return the weight of the nearest of 25 cubes, (K,) float64, and its offset, (2, K); `ahead` is (2, 25, K)."""
    slot = constant(tuple(range(ahead.shape[1])), torch.float64, ahead.device)[:, None]
    # Square and slot share one number, because taking the minimum is several times faster than argmin.
    key = torch.add(slot, ahead.square().sum(0), alpha=32).amin(0).long()
    weight = weights.index_select(0, (key >> 11).clamp_(max=2048))
    return weight, ahead.gather(1, (key & 31).expand(2, 1, -1))[:, 0]


def _match_weights(device: torch.device) -> Tensor:
    """Return the weights exp(-d^2 / (2 sigma^2)) of centroids at distance d, (2049,) float64, multiples of 1/256. Entry
    i is for d^2 from 64 i to 64 (i + 1) square units; the last entry, 0, is for larger distances."""
    square = 64 * torch.arange(2048, dtype=torch.float64) + 32
    return F.pad((256 * torch.exp(square / (-2 * (_SIGMA * UNITS) ** 2))).round_() / 256, (0, 1)).to(device)
