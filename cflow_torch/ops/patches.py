"""Square patches around pixels of many binary images."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor


def gather_patches(images: Tensor, image: Tensor, row: Tensor, col: Tensor, size: int) -> tuple[Tensor, Tensor]:
    """The size x size patch centred at each pixel, zero outside the image.

    Args:
        images: (B, H, W) bool.
        image, row, col: (K,) int64, where each patch is centred.
        size: L, odd.

    Returns:
        patches: (K, L * L) uint8 zeros and ones, rows of the patch one after the other.
        energy: (K,) int64, number of ones in each.

    Cost: K L^2 bytes, written a row of a patch at a time; the patches of all pixels are never made.
    """
    half = size // 2
    padded = F.pad(images.byte(), (half, half, half, half))
    _, height, width = padded.shape
    runs = padded.flatten().unfold(0, size, 1)  # the `size` pixels from each one on, nothing is copied
    first = (image * height + row) * width + col
    rows = (first[:, None] + torch.arange(size, device=images.device) * width).flatten()
    patches = runs.index_select(0, rows).view(-1, size * size)
    # A sum over the patches would write them again as integers; a run is the difference of two sums over the image.
    sums = F.pad(padded.flatten().cumsum(0, dtype=torch.int32), (1, 0))
    energy = (sums[size:] - sums[:-size]).index_select(0, rows).view(-1, size).sum(1)
    return patches, energy
