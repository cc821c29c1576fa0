"""The spread of a surface: the covariance of the voxels of an object around each of its voxels."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor

from cflow_torch.ops.indices import constant, scatter_count
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


def spread_of(voxels: Voxels, pixel_size: float, layer_height: float) -> Tensor:
    """Return the covariance of the centroids around each voxel, of its object and sweep.

    Args:
        voxels: V of them.
        pixel_size, layer_height: metres, sides of a voxel.

    Returns:
        (3, 3, V) float64, square units.

    Cost: twice 27 searches for each block.
    """
    position, device = voxels.position[:, :-1], voxels.position.device
    xyz = torch.floor(position / _STEP)
    first, second = (constant(axes, torch.int64, device) for axes in ((0, 0, 0, 1, 1, 2), (0, 1, 2, 1, 2, 2)))
    moments = torch.cat((torch.ones_like(xyz[:1]), xyz, xyz.index_select(0, first) * xyz.index_select(0, second)))
    size = constant((pixel_size, pixel_size, layer_height), torch.float64, device)[:, None] * UNITS
    image = voxels.object_id * voxels.num_steps + voxels.step
    (n, spread), (n_of_large, spread_of_large) = (
        _scatter(_sums_around(torch.floor(position / (side * size)).long(), image, moments)) for side in _SIDES
    )
    trace = spread.diagonal(dim1=0, dim2=1).sum(-1)
    is_known = (n >= _FEWEST) & (trace * trace >= _LINE * spread.square().sum((0, 1)))
    n, spread = torch.where(is_known, n, n_of_large), torch.where(is_known, spread, spread_of_large)
    unknown = (_UNKNOWN * UNITS) ** 2 * torch.eye(3, dtype=torch.float64, device=device)[:, :, None]
    return spread * _STEP**2 / (n * n) + unknown * (n < _FEWEST)


def _scatter(sums: Tensor) -> tuple[Tensor, Tensor]:
    """Return the number n of voxels, (V,), and n^2 times their covariance, (3, 3, V), from sums of moments, (10, V)."""
    n, total = sums[0], sums[1:4]
    squares = sums.index_select(0, constant((4, 5, 6, 5, 7, 8, 6, 8, 9), torch.int64, sums.device)).view(3, 3, -1)
    return n, n * squares - total[:, None] * total


def _sums_around(block: Tensor, image: Tensor, values: Tensor) -> Tensor:
    """Return the sums of values, (R, V) float64, over the 27 blocks around the block of each voxel.

    Args:
        block: (3, V) int64, column, row and layer; layers beyond +-2046 are merged.
        image: (V,) int64; only voxels of the same image are added.
        values: (R, V) float64, whole numbers.
    """
    column = torch.add(block[0], torch.add(block[1], image, alpha=_ROW), alpha=_ROW)
    layer = block[2].clamp(2 - _LAYER // 2, _LAYER // 2 - 2)
    key, of_voxel = torch.unique(torch.add(layer, column, alpha=_LAYER), return_inverse=True)
    rows = F.pad(scatter_count(of_voxel, len(key), values).t(), (0, 0, 0, 1))  # the last row is for missing blocks
    # The layers of a column are adjacent, so we search for the lowest of three and read on.
    lowest = tuple((down * _ROW + right) * _LAYER - 1 for down in (-1, 0, 1) for right in (-1, 0, 1))
    lowest = (key + constant(lowest, torch.int64, key.device)[:, None]).view(-1)
    at = torch.searchsorted(key, lowest) + constant((0, 1, 2), torch.int64, key.device)[:, None]
    found = F.pad(key, (0, 3), value=1 << 62).index_select(0, at.view(-1)).view_as(at)
    at = torch.where(found <= lowest + 2, at, len(key)).view(-1)
    return rows.index_select(0, at).view(27, -1).sum(0).view(-1, len(values)).t().index_select(1, of_voxel)
