"""Gather square patches around pixels of many binary images."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor


def gather_patches(images: Tensor, image: Tensor, row: Tensor, col: Tensor, size: int) -> tuple[Tensor, Tensor]:
    """Gather the size x size patch around each pixel, zero outside the image.

    Args:
        images: (B, H, W) bool.
        image, row, col: (K,) int64, centre of each patch.
        size: L, odd.

    Returns:
        patches: (K, L * L) uint8 zeros and ones, row by row.
        energy: (K,) int64, number of ones of each patch.

    Cost: K L^2 bytes, written one row of a patch at a time.
    """
    half = size // 2
    padded = F.pad(images.byte(), (half, half, half, half))
    _, height, width = padded.shape
    runs = padded.flatten().unfold(0, size, 1)  # a view: the `size` pixels from each one on
    first = (image * height + row) * width + col
    rows = (first[:, None] + torch.arange(size, device=images.device) * width).flatten()
    patches = runs.index_select(0, rows).view(-1, size * size)
    # A sum over the patches would write them again as integers, so we take differences of running sums of the images.
    sums = F.pad(padded.flatten().cumsum(0, dtype=torch.int32), (1, 0))
    energy = (sums[size:] - sums[:-size]).index_select(0, rows).view(-1, size).sum(1)
    return patches, energy
