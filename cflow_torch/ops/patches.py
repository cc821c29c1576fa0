"""Square patches around pixels of many binary images."""

from __future__ import annotations

from typing import Tuple

import torch
import torch.nn.functional as F
from torch import Tensor


def gather_patches(images: Tensor, image: Tensor, row: Tensor, col: Tensor, size: int) -> Tuple[Tensor, Tensor]:
    """The size x size patch centred at each pixel, zero outside the image.

    Args:
        images: (B, H, W) bool.
        image, row, col: (K,) int64, where each patch is centred.
        size: L, odd.

    Returns:
        patches: (K, L * L) uint8 zeros and ones, rows of the patch one after the other.
        energy: (K,) int64, number of ones in each.

    Cost: K L^2 bytes and a few passes over the padded images; the patches of all pixels are never made.
    """
    half = size // 2
    padded = F.pad(images.byte(), (half, half, half, half))
    patches = padded.unfold(1, size, 1).unfold(2, size, 1)[image, row, col].flatten(1)
    # A sum over patches would write them again as int64; the table of sums above and to the left needs four look-ups.
    table = F.pad(padded.cumsum(1, dtype=torch.int32).cumsum(2, dtype=torch.int32), (1, 0, 1, 0))
    height, width = table.shape[1:]
    above = (image * height + row) * width + col
    below = above + size * width
    corners = table.take(torch.stack((below + size, below, above + size, above)))
    return patches, (corners[0] - corners[1] - corners[2] + corners[3]).long()
