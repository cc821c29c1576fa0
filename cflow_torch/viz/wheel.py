"""Colours of flow: the Middlebury colour wheel, which the field's viewers use."""

from __future__ import annotations

import numpy as np

from cflow_torch.types import Array, CFlowError, as_numpy

# Steps from one primary hue to the next: the eye tells some hues apart more finely than others.
TRANSITIONS = (15, 6, 4, 11, 13, 6)
PRIMARIES = np.array(
    [(255, 0, 0), (255, 255, 0), (0, 255, 0), (0, 255, 255), (0, 0, 255), (255, 0, 255), (255, 0, 0)], np.float64
)
_POSITION = np.cumsum((0, *TRANSITIONS))  # of each primary on the wheel


def flow_to_rgb(flow: Array, max_flow: float | None = None) -> np.ndarray:
    """Convert flow (..., 2+), metres, to (..., 3) uint8 RGB: direction to hue, length to saturation.

    Flow of `max_flow` metres gets the full hue; None = the length of the longest flow. Longer flow is darker. Zero, NaN
    and infinite flow is white. Columns after x and y are ignored.

    Convention:
        +x is red, then counter-clockwise yellow, green, cyan, blue, magenta. The angle in [0, 2 pi) is spread over 54
        of the 55 steps, as in the viewers, so +y is (255, 230, 0), -x (0, 209, 255), -y (88, 0, 255).

    Raises:
        CFlowError: `max_flow` is not positive, or the flow has no columns x and y.

    Source: Baker et al., A Database and Evaluation Methodology for Optical Flow (2011); flowpy. The field's viewers cut
        the steps of their wheel to integers, so their colours differ by up to 2 levels.
    """
    vectors = as_numpy(flow).astype(np.float64)
    if vectors.ndim == 0 or vectors.shape[-1] < 2:
        raise CFlowError(f"flow has shape {vectors.shape}: give (..., 2) or more columns, x and y first")
    if max_flow is not None and not max_flow > 0:
        raise CFlowError(f"max_flow={max_flow}: give a positive length in metres, or None for the longest flow")

    x, y = vectors[..., 0], vectors[..., 1]
    is_known = np.isfinite(x) & np.isfinite(y)
    x, y = np.where(is_known, x, 0), np.where(is_known, y, 0)
    radius = np.hypot(x, y)
    longest = max_flow or radius.max(initial=0) or 1.0
    radius = radius / longest

    step = np.mod(np.arctan2(y, x), 2 * np.pi) * ((_POSITION[-1] - 1) / (2 * np.pi))
    hue = np.stack([np.interp(step, _POSITION, channel) for channel in PRIMARIES.T], axis=-1)
    inside = 255 + np.minimum(radius, 1)[..., None] * (hue - 255)
    outside = hue / np.maximum(radius, 1)[..., None]
    return np.rint(np.where(radius[..., None] > 1, outside, inside)).astype(np.uint8)


def wheel_image(size: int) -> np.ndarray:
    """Draw the wheel, +x right, +y up, full hues at the rim: (size, size, 4) uint8 RGBA, transparent outside."""
    axis = (np.arange(size) + 0.5) * (2 / size) - 1
    flow = np.stack(np.meshgrid(axis, -axis), axis=-1)
    distance = np.hypot(flow[..., 0], flow[..., 1])
    # The rim fades over one pixel, so it looks smooth.
    alpha = np.clip((1 - distance) * (size / 2), 0, 1) * 255
    rgb = flow_to_rgb(flow / np.maximum(distance, 1)[..., None], 1.0)
    return np.concatenate([rgb, alpha[..., None].astype(np.uint8)], axis=-1)
