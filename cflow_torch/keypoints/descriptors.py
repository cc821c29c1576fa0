"""Key points of the occupancy images and their binary descriptors (Sec. Keypoints, Sec. Descriptor)."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from cflow_torch.ops.indices import flat_nonzero, split_index
from cflow_torch.ops.morphology import erode_cross
from cflow_torch.ops.patches import gather_patches


@dataclass(frozen=True)
class KeyPoints:
    """Key points of one sweep of every window, in order of window, row and column."""

    pixel: Tensor  # (K,) int64, flat indices into the images, ascending
    window: Tensor  # (K,) int64
    row: Tensor  # (K,) int64, row in the image of the window
    col: Tensor  # (K,) int64, column in the image of the window
    patch: Tensor  # (K, L * L) uint8, zeros and ones
    energy: Tensor  # (K,) int64, number of ones, at least 1


def detect(occupancy: Tensor) -> Tensor:
    """Find the key points of (..., H, W) bool images: pixels at distance 1 from the background (Sec. Keypoints).

    The distance is Euclidean, so a key point has a free pixel among its four neighbours. The outside of the image is
    background.
    """
    return occupancy & ~erode_cross(occupancy)


def describe(images: Tensor, patch_size: int) -> KeyPoints:
    """Find the key points of one sweep and describe each by the L x L pixels around it (Sec. Descriptor).

    The images are (B, H, W) bool; patches are zero outside. Cost: memory K L^2 bytes; the images are not unfolded.
    """
    pixel = flat_nonzero(detect(images))
    line, col = split_index(pixel, images.shape[2])
    window, row = split_index(line, images.shape[1])
    return KeyPoints(pixel, window, row, col, *gather_patches(images, window, row, col, patch_size))
