"""Square patches around pixels of many binary images."""

from __future__ import annotations

import torch.nn.functional as F
from torch import Tensor


def gather_patches(images: Tensor, image: Tensor, row: Tensor, col: Tensor, size: int) -> Tensor:
    """The size x size patch centred at each pixel, zero outside the image.

    Args:
        images: (B, H, W) bool.
        image, row, col: (K,) int64, where each patch is centred.
        size: L, odd.

    Returns:
        (K, L * L) uint8 zeros and ones, rows of the patch one after the other.

    Cost: K L^2 bytes and one padded copy of the images; the view of all patches of an image is never made.
    """
    half = size // 2
    windows = F.pad(images.byte(), (half, half, half, half)).unfold(1, size, 1).unfold(2, size, 1)
    return windows[image, row, col].flatten(1)
