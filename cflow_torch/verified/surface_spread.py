"""The spread of a surface: the covariance of the voxels of an object around each of its voxels."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor

from cflow_torch.ops.indices import constant, scatter_count, take_columns
from cflow_torch.verified.voxel_centroids import UNITS, Voxels

NOISE = 0.05  # metres, standard deviation of a centroid, besides the spread of its surface
# Sides of the blocks in voxels. With the blocks around, they cover 0.6 m and 1.2 m. A ring of beams on a surface forms
# a line, so if the voxels of the smaller blocks form a line, we take the larger blocks.
_SIDES = (2, 4)
_FEWEST = 3  # voxels; an isolated voxel may belong to a surface of any direction
_UNKNOWN = 0.2  # metres, standard deviation of such a surface
_LINE = 5 / 3  # squared trace of a covariance over the sum of its squared entries; below this, voxels form a line
_STEP = 4  # units; coordinates are multiples of 1/256 m, so that sums are exact
_ROW, _LAYER = 1 << 15, 1 << 12  # more than the blocks in a row or column; more than the blocks in a stack
# The moments are products of two of 1, x, y and z. Then: which moments are the entries of the 3 x 3 matrix of squares.
_FACTORS = ((0, 0, 0, 0, 1, 1, 1, 2, 2, 3), (0, 1, 2, 3, 1, 2, 3, 2, 3, 3))
_SQUARES = (4, 5, 6, 5, 7, 8, 6, 8, 9)


def spread_of(voxels: Voxels, pixel_size: float, layer_height: float) -> Tensor:
    """Return the covariance of the centroids around each voxel, of its object and sweep.

    Args:
        voxels: V of them.
        pixel_size, layer_height: metres, sides of a voxel.

    Returns:
        (3, 3, V) float64, square units.

    Cost: 18 searches for each block of either size.
    """
    position, device = voxels.position[:, :-1], voxels.position.device
    one_xyz = F.pad(torch.floor(position / _STEP).long(), (0, 0, 1, 0), value=1)
    first, second = (one_xyz.index_select(0, constant(of, torch.int64, device)) for of in _FACTORS)
    size = (pixel_size * UNITS, pixel_size * UNITS, layer_height * UNITS)
    sizes = constant(tuple(tuple(side * of for side in _SIDES) for of in size), torch.float64, device)
    block = torch.floor(position[:, None] / sizes[..., None]).long()
    sums = _sums_around(block, voxels.object_id * voxels.num_steps + voxels.step, first * second).double()

    both, total = sums[0], sums[1:4]  # number of voxels around, for blocks of both sizes
    squares = sums.index_select(0, constant(_SQUARES, torch.int64, device)).view(3, 3, *both.shape)
    (n, n_of_large), (spread, spread_of_large) = both, (both * squares - total[:, None] * total).unbind(2)  # times n^2
    trace = spread.diagonal(dim1=0, dim2=1).sum(-1)
    is_known = (n >= _FEWEST) & (trace * trace >= _LINE * spread.square().sum((0, 1)))
    n, spread = torch.where(is_known, n, n_of_large), torch.where(is_known, spread, spread_of_large)
    unknown = tuple((_UNKNOWN * UNITS) ** 2 * (i == j) for i in range(3) for j in range(3))
    return spread * _STEP**2 / (n * n) + constant(unknown, torch.float64, device).view(3, 3, 1) * (n < _FEWEST)


def _sums_around(block: Tensor, image: Tensor, values: Tensor) -> Tensor:
    """Return the sums of values, (R, 2, V) int64, over the 27 blocks around the block of each voxel.

    Args:
        block: (3, 2, V) int64, column, row and layer, for blocks of two sizes; layers beyond +-2046 are merged.
        image: (V,) int64; only voxels of the same image are added.
        values: (R, V) int64.
    """
    image = torch.add(torch.arange(2, device=image.device)[:, None], image, alpha=2)
    column = torch.add(block[0], torch.add(block[1], image, alpha=_ROW), alpha=_ROW)
    layer = block[2].clamp(2 - _LAYER // 2, _LAYER // 2 - 2)
    key, of_voxel = torch.unique(torch.add(layer, column, alpha=_LAYER).flatten(), return_inverse=True)
    # The layers of a column are adjacent, so we subtract the sum of all blocks below three layers from the sum of all
    # blocks up to them. Running sums may overflow, but their differences are right.
    below = scatter_count(of_voxel, len(key), values.repeat(1, 2)).cumsum(1)
    below = F.pad(below, (1, 0)).t().contiguous()
    columns = [(down * _ROW + right) * _LAYER for down in (-1, 0, 1) for right in (-1, 0, 1)]
    ends = constant(tuple(column + end for end in (-1, 2) for column in columns), torch.int64, key.device)
    at = torch.searchsorted(key, key + ends[:, None])
    first, last = below.index_select(0, at.view(-1)).view(2, 9, len(key), len(values))
    return take_columns((last - first).sum(0).t(), of_voxel).view(len(values), *image.shape)
