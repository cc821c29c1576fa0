"""Occupancy images of two sweeps: sweep t in blue, t+1 in red, both in a dark colour."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from matplotlib.axes import Axes

COLORS = {"sweep t": (79, 134, 217), "sweep t+1": (232, 96, 76), "both": (43, 33, 64)}


@dataclass(frozen=True)
class Occupancy:
    """Occupancy images of a pair of sweeps from above.

    Args:
        t, t1: (H, W) bool, sweep t moved by the flow so far, and sweep t+1; row from y, column from x.
        lower: (2,) float64, metres, corner (x, y) of pixel (0, 0), frame of t+1.
        pixel_size: metres.
    """

    t: np.ndarray
    t1: np.ndarray
    lower: np.ndarray
    pixel_size: float

    def rgb(self, fade: float = 0.0) -> np.ndarray:
        """(H, W, 3) uint8 RGB; white where neither sweep has a point."""
        image = np.full((*self.t.shape, 3), 255, np.uint8)
        for is_set, color in zip((self.t & ~self.t1, self.t1 & ~self.t, self.t & self.t1), COLORS.values()):
            image[is_set] = 255 * fade + (1 - fade) * np.array(color)
        return image

    def draw(self, axes: Axes, fade: float = 0.0, **settings: Any) -> None:
        """Draw the pixels at their positions in metres.

        Args:
            axes: any axes.
            fade: 0 ... 1, how far the colours go towards white.
            settings: of `Axes.imshow`.
        """
        (height, width), (x, y) = self.t.shape, self.lower
        extent = (x, x + width * self.pixel_size, y, y + height * self.pixel_size)
        axes.imshow(self.rgb(fade), extent=extent, origin="lower", interpolation="nearest", **settings)


def sweep_marks() -> list[Any]:
    """Legend entries of the colours of the pixels."""
    from matplotlib.lines import Line2D

    colors = {name: "#{:02x}{:02x}{:02x}".format(*color) for name, color in COLORS.items()}
    return [Line2D([], [], marker="s", ls="", markersize=10, label=name, color=color) for name, color in colors.items()]
