"""Two sweeps as pixels: sweep t in blue, t+1 in red, both dark."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from cflow_torch.viz.stages import Occupancy

if TYPE_CHECKING:
    from matplotlib.axes import Axes

COLORS = {"sweep t": (79, 134, 217), "sweep t+1": (232, 96, 76), "both": (43, 33, 64)}


def draw_occupancy(axes: Axes, images: Occupancy, fade: float = 0.0, **settings: Any) -> None:
    """Pixels where they lie, metres.

    Args:
        axes: any.
        images: what is drawn.
        fade: 0 ... 1, how far the colours go towards white.
        settings: of `Axes.imshow`.
    """
    height, width = images.t.shape
    x, y = images.lower
    extent = (x, x + width * images.pixel_size, y, y + height * images.pixel_size)
    image = occupancy_rgb(images, fade)
    axes.imshow(image, extent=extent, origin="lower", interpolation="nearest", **settings)


def occupancy_rgb(images: Occupancy, fade: float = 0.0) -> np.ndarray:
    """(H, W, 3) uint8 RGB; white where neither sweep has a point."""
    image = np.full((*images.t.shape, 3), 255, np.uint8)
    parts = images.t & ~images.t1, images.t1 & ~images.t, images.t & images.t1
    for is_set, color in zip(parts, COLORS.values()):
        image[is_set] = 255 * fade + (1 - fade) * np.array(color)
    return image


def sweep_marks() -> list[Any]:
    """For a legend: what the colours of the pixels are."""
    from matplotlib.lines import Line2D

    marks = [Line2D([], [], marker="s", ls="", markersize=10, label=name) for name in COLORS]
    for mark, (red, green, blue) in zip(marks, COLORS.values()):
        mark.set_color((red / 255, green / 255, blue / 255))
    return marks
