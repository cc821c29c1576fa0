"""Height slices of the occupied pixels of clusters."""

from __future__ import annotations

import torch
from torch import Tensor

from cflow_torch.config import Config
from cflow_torch.dense.clustering import Clusters
from cflow_torch.ops.bits import pack_bits
from cflow_torch.ops.chunks import chunks
from cflow_torch.windows.bev_grid import Grid
from cflow_torch.windows.collation import Batch

# Heights beyond this count as this, so that the number of a slice is exact.
_HIGHEST = 1e12


def slices_of_pixels(batch: Batch, z: Tensor, place: Tensor, clusters: Clusters, grid: Grid, config: Config) -> Tensor:
    """In which height slices a pixel holds a point.

    Args:
        batch: points of all windows.
        z: (P,) float64, metres, frame of t+1, height of each point.
        place: (P,) int64, flat index of each point's pixel into images (B, S, H, W); B * S * H * W = left out.
        clusters: components of those images.
        grid: the BEV.
        config: `height_slices` n, `slice_height`.

    Returns:
        (Q,) uint8 for the Q pixels of the clusters: bit c is set if a point lies in slice c = floor(z / slice_height)
        mod n.

    Cost: one pass over the points, n bytes a pixel of the images.
    """
    num_slices, step = config.height_slices, torch.full((), config.slice_height, dtype=z.dtype, device=z.device)
    num_pixels = batch.num_windows * batch.num_steps * grid.height * grid.width
    table = torch.zeros((num_pixels + 1) * num_slices, dtype=torch.bool, device=z.device)
    for points in chunks(0, len(z), z.device):
        # Heights of points that are left out mean nothing, not even a number.
        height = z[points].masked_fill(place[points] == num_pixels, 0.0).clamp_(-_HIGHEST, _HIGHEST)
        number = height.div_(step).floor_().long().remainder_(num_slices)
        table.index_fill_(0, number.add_(place[points], alpha=num_slices), True)
    pixels = clusters.pixels
    image = clusters.window.index_select(0, pixels.cluster) * batch.num_steps + pixels.step
    pixel = (image * grid.height + pixels.row) * grid.width + pixels.col
    return pack_bits(table.view(-1, num_slices).index_select(0, pixel))
