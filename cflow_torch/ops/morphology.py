"""Dilation and erosion of boolean images, many images at once."""

from __future__ import annotations

from typing import Callable

import torch
from torch import Tensor

from cflow_torch.ops.kornia_engine import close_3x3_kornia


def close_3x3(padded: Tensor, height: int, width: int, engine: str = "sparse") -> Tensor:
    """Dilate, then erode, with a 3 x 3 square of ones.

    Args:
        padded: (B, H', W') bool, images with an empty margin to the right and below, at least a pixel wide.
        height, width: H, W of the images without the margin.
        engine: "sparse" or "kornia"; the same result.

    Returns:
        (B, H', W') bool, margin empty.

    Convention:
        Pixels outside the image are background for the dilation and foreground for the erosion, so that no pixel is
        lost, not even at the border.

    Cost: eight passes over the images, because the square is separable; no floating-point numbers.
    """
    if engine == "kornia":
        closed = torch.zeros_like(padded)
        closed[:, :height, :width] = close_3x3_kornia(padded[:, :height, :width])
        return closed
    closed = padded
    for combine, outside in ((torch.bitwise_or, True), (torch.bitwise_and, False)):
        # All images form one long row of pixels. The margin separates pixels that are not neighbours.
        flat = _with_both_neighbours(combine, closed.view(-1), 1)
        closed = _with_both_neighbours(combine, flat, padded.shape[2]).view_as(padded)
        closed[:, height:] = outside
        closed[:, :, width:] = outside
    return closed


def _with_both_neighbours(combine: Callable[..., Tensor], values: Tensor, distance: int) -> Tensor:
    """(N,): combine each value with the values `distance` before and after it, if they exist."""
    pairs = combine(values[:-distance], values[distance:])
    result = torch.empty_like(values)
    combine(pairs[:-distance], pairs[distance:], out=result[distance:-distance])
    result[:distance] = pairs[:distance]
    result[-distance:] = pairs[-distance:]
    return result


def erode_cross(image: Tensor) -> Tensor:
    """Erosion of (..., H, W) bools with a plus: a pixel stays if its distance to the background is more than 1.

    Pixels outside the image are background, unlike in `close_3x3`, so pixels on the border never stay. Cost: four
    passes over the image.
    """
    inner = torch.zeros_like(image)
    middle = image[..., 1:-1, 1:-1] & image[..., :-2, 1:-1]
    middle &= image[..., 2:, 1:-1]
    middle &= image[..., 1:-1, :-2]
    inner[..., 1:-1, 1:-1] = middle.logical_and_(image[..., 1:-1, 2:])
    return inner
