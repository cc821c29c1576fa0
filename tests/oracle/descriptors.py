"""Key points of one image and their descriptors (Sec. CorrelationFlow-Keypoints: Keypoints, Descriptor)."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np


class Keypoints(NamedTuple):
    """Key points of one image with their descriptors, in raster order.

    Attributes:
        pixels: (K, 2) int64, row and column.
        descriptors: (K, L * L) bool.
        energies: (K,) int64, E = number of ones of each descriptor, its squared norm; at least 1, the centre.
    """

    pixels: np.ndarray
    descriptors: np.ndarray
    energies: np.ndarray


def described_keypoints(image: np.ndarray, patch_size: int) -> Keypoints:
    """Key points of an image (H, W) bool and their descriptors of side L = `patch_size`."""
    pixels = detect_keypoints(image)
    descriptors = describe(image, pixels, patch_size)
    return Keypoints(pixels, descriptors, descriptors.sum(axis=1))


def detect_keypoints(image: np.ndarray) -> np.ndarray:
    """Sec. Keypoints: the foreground pixels whose distance to the background is 1.

    Args:
        image: (H, W) bool.

    Returns:
        (K, 2) int64, row and column, in raster order.

    Convention:
        Distance 1 means that one of the 4 orthogonal neighbours is background. What lies outside the image is
        background, as in the zero padding of the descriptors.
    """
    padded = np.pad(image, 1)
    keypoints = []
    for r, c in np.argwhere(image).tolist():
        # (r, c) of the image is (r + 1, c + 1) of the padded one.
        above, below = padded[r, c + 1], padded[r + 2, c + 1]
        left, right = padded[r + 1, c], padded[r + 1, c + 2]
        if not (above and below and left and right):
            keypoints.append((r, c))
    return np.array(keypoints, dtype=np.int64).reshape(-1, 2)


def describe(image: np.ndarray, keypoints: np.ndarray, patch_size: int) -> np.ndarray:
    """Sec. Descriptor: the L x L patch of the occupancy image around each key point, flattened; 0 outside the image.

    Args:
        image: (H, W) bool.
        keypoints: (K, 2) int64, row and column.
        patch_size: L, odd.

    Returns:
        (K, L * L) bool.
    """
    padded = np.pad(image, patch_size // 2)
    descriptors = np.zeros((len(keypoints), patch_size * patch_size), dtype=bool)
    for k, (r, c) in enumerate(keypoints.tolist()):
        descriptors[k] = padded[r : r + patch_size, c : c + patch_size].ravel()
    return descriptors
