"""The spread of a surface: covariance of the voxels of an object around each of its voxels."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor

from cflow_torch.ops.indices import scatter_count
from cflow_torch.verified.voxel_centroids import UNITS, Voxels

NOISE = 0.05  # metres, standard deviation of a centroid that is not that of its surface
# Sides of the blocks, voxels; those around are counted as well: 0.6 m and 1.2 m. One ring of beams on a surface looks
# like a line. So where the voxels of the smaller blocks lie on a line, we take the larger blocks.
_SIDES = (2, 4)
_FEWEST = 3  # voxels; a lonely voxel may belong to a surface of any direction
_UNKNOWN = 0.2  # metres, standard deviation of such a surface
_LINE = 5  # sum of the principal minors of a covariance, at least a 5th of its squared trace: not on a line
_STEP = 4  # units: coordinates are whole 256ths of a metre, so that sums are exact
_ROW, _LAYER = 1 << 15, 1 << 12  # more than blocks in a row or column; more than blocks above each other


def spread_of(voxels: Voxels, pixel_size: float, layer_height: float) -> Tensor:
    """Covariance of the centroids around each voxel, of its object and sweep.

    Args:
        voxels: V of them.
        pixel_size, layer_height: metres, sides of a voxel.

    Returns:
        (V, 6) float64, square metres: xx, xy, xz, yy, yz, zz.

    Cost: twice 27 searches for each block.
    """
    position = torch.cat((torch.view_as_real(voxels.place[:-1]).t(), voxels.height[None, :-1]))
    x, y, z = coordinates = torch.floor(position / _STEP)
    moments = torch.stack((torch.ones_like(x), x, y, z, x * x, x * y, x * z, y * y, y * z, z * z))
    size = torch.tensor((pixel_size, pixel_size, layer_height), dtype=torch.float64, device=x.device)[:, None] * UNITS
    image = voxels.owner * voxels.num_steps + voxels.step
    unknown = _UNKNOWN**2 * torch.tensor((1.0, 0, 0, 1, 0, 1), dtype=torch.float64, device=x.device)[:, None]
    spread, is_known = coordinates.new_zeros((len(x), 6)), torch.zeros_like(image, dtype=torch.bool)
    for side in _SIDES:
        sums = _sums_around(torch.floor(position / (side * size)).long(), image, moments)
        n, x, y, z = sums[:4]
        products = torch.stack((x * x, x * y, x * z, y * y, y * z, z * z))
        xx, xy, xz, yy, yz, zz = scaled = n * sums[4:] - products
        trace, minors = xx + yy + zz, xx * yy + xx * zz + yy * zz - xy * xy - xz * xz - yz * yz
        here = scaled / (n * n) * (_STEP / UNITS) ** 2
        here = here + unknown * (n < _FEWEST)
        spread = torch.where(is_known[:, None], spread, here.t())
        is_known |= (n >= _FEWEST) & (_LINE * minors >= trace * trace)
    return spread


def _sums_around(block: Tensor, image: Tensor, values: Tensor) -> Tensor:
    """(R, V) float64: sums of values, (R, V), over the 27 blocks around the block of each voxel.

    Args:
        block: (3, V) int64, column, row and layer; layers beyond +-2046 are one.
        image: (V,) int64, only voxels of one image are added.
        values: whole numbers.
    """
    col, row, layer = block[0] + 1, block[1] + 1, block[2].clamp(2 - _LAYER // 2, _LAYER // 2 - 2) + _LAYER // 2
    key, of_voxel = torch.unique(((image * _ROW + row) * _ROW + col) * _LAYER + layer, return_inverse=True)
    rows = F.pad(scatter_count(of_voxel, len(key), values).t(), (0, 0, 0, 1))  # the last one is for no block
    line = torch.arange(-1, 2, device=key.device)
    # The layers of a column follow each other: we search for the lowest of three and read on.
    middle = (key + ((line[:, None] * _ROW + line) * _LAYER).view(-1, 1)).view(-1)
    at = torch.searchsorted(key, middle - 1) + (line + 1)[:, None]
    found = F.pad(key, (0, 3), value=1 << 62).index_select(0, at.view(-1)).view_as(at)
    at = torch.where(found <= middle + 1, at, len(key)).view(-1)
    return rows.index_select(0, at).view(27, -1).sum(0).view(-1, len(values)).t().index_select(1, of_voxel)


def symmetric_adjugate(
    xx: Tensor, xy: Tensor, xz: Tensor, yy: Tensor, yz: Tensor, zz: Tensor
) -> tuple[tuple[Tensor, ...], Tensor]:
    """Adjugate of symmetric 3 x 3 matrices, by its entries in the same order, and the determinant."""
    a_xx, a_xy, a_xz = yy * zz - yz * yz, xz * yz - xy * zz, xy * yz - xz * yy
    entries = (a_xx, a_xy, a_xz, xx * zz - xz * xz, xy * xz - xx * yz, xx * yy - xy * xy)
    return entries, xx * a_xx + xy * a_xy + xz * a_xz
