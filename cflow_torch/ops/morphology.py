"""Dilation and erosion of boolean images, many images at once."""

from __future__ import annotations

import torch
from torch import Tensor


def dilate_3x3(image: Tensor) -> Tensor:
    """Dilation with a 3 x 3 square of ones: a pixel is set if any pixel of its 3 x 3 neighbourhood is.

    Args:
        image: (..., H, W) bool.

    Returns:
        (..., H, W) bool.

    Convention:
        Pixels outside the image are ignored, that is, they count as background.

    Cost: four passes over the image (the square is separable), no floating-point numbers.
    """
    rows = image.clone()
    rows[..., 1:, :] |= image[..., :-1, :]
    rows[..., :-1, :] |= image[..., 1:, :]
    result = rows.clone()
    result[..., :, 1:] |= rows[..., :, :-1]
    result[..., :, :-1] |= rows[..., :, 1:]
    return result


def erode_3x3(image: Tensor) -> Tensor:
    """Erosion with a 3 x 3 square of ones: a pixel stays if every pixel of its 3 x 3 neighbourhood is set.

    Args:
        image: (..., H, W) bool.

    Returns:
        (..., H, W) bool.

    Convention:
        Pixels outside the image are ignored, that is, they count as foreground; so a closing
        (dilation, then erosion) never loses a pixel, at the border neither.
    """
    return ~dilate_3x3(~image)


def erode_cross(image: Tensor) -> Tensor:
    """Erosion with a plus of five pixels: a pixel stays if it and its four neighbours are set.

    Args:
        image: (..., H, W) bool.

    Returns:
        (..., H, W) bool: the pixels whose Euclidean distance to the background is more than 1.

    Convention:
        Pixels outside the image count as background (other than in `erode_3x3`): pixels on the border never stay.

    Cost: four passes over the image.
    """
    inner = torch.zeros_like(image)
    middle = image[..., 1:-1, 1:-1] & image[..., :-2, 1:-1]
    middle &= image[..., 2:, 1:-1]
    middle &= image[..., 1:-1, :-2]
    inner[..., 1:-1, 1:-1] = middle.logical_and_(image[..., 1:-1, 2:])
    return inner


def dilate_3x3_kornia(image: Tensor) -> Tensor:
    """`dilate_3x3` by `kornia.morphology.dilation`: same result, float images inside.

    Args:
        image: (B, H, W) bool.

    Returns:
        (B, H, W) bool.
    """
    from kornia.morphology import dilation

    return dilation(image[:, None].float(), torch.ones(3, 3, device=image.device))[:, 0] > 0.5


def erode_3x3_kornia(image: Tensor) -> Tensor:
    """`erode_3x3` by `kornia.morphology.erosion`: same result, float images inside.

    Args:
        image: (B, H, W) bool.

    Returns:
        (B, H, W) bool.
    """
    from kornia.morphology import erosion

    return erosion(image[:, None].float(), torch.ones(3, 3, device=image.device))[:, 0] > 0.5
