"""Legends: the colour wheel, the scale bar, and the corner in which a legend hides least."""

from __future__ import annotations

from typing import TYPE_CHECKING, Optional, Tuple

import numpy as np

from cflow_torch.viz.style import FRAME, INK, inches_of, round_length
from cflow_torch.viz.wheel import wheel_image

if TYPE_CHECKING:
    from matplotlib.axes import Axes

SWEEP_RATE = 10  # Hz
CORNERS = ("upper right", "lower right", "upper left")  # where a legend may stand; the scale bar has the other


def draw_wheel(
    axes: Axes, position: np.ndarray, is_mover: np.ndarray, max_flow: float, corner: Optional[str] = None
) -> None:
    """The colour wheel, in a corner of the panel where it hides little, or in one of `CORNERS`."""
    width, height = wheel_inches(inches_of(axes)[0])
    fill_wheel(legend_box(axes, position, is_mover, (width, height), corner), width, max_flow)


def wheel_inches(panel: float) -> Tuple[float, float]:
    """Width and height of the legend, inches, in a panel of that width."""
    width = float(np.clip(0.2 * panel, 1.6, 1.9))
    return width, 1.14 * width


def fill_wheel(box: Axes, width: float, max_flow: float) -> None:
    """The colour wheel and what its rim means.

    Args:
        box: without ticks, 1.14 times as high as wide.
        width: of the box, inches.
        max_flow: metres per sweep at the rim.
    """
    box.imshow(wheel_image(256), extent=(-1, 1, -1, 1), interpolation="bilinear")
    box.set(xlim=(-1.3, 1.3), ylim=(-1.77, 1.194))
    rim = f"rim: {max_flow:.4g} m per sweep\n{max_flow * SWEEP_RATE:.4g} m/s at {SWEEP_RATE} Hz"
    box.text(0, -1.1, rim, fontsize=6 * width, color=INK, ha="center", va="top", linespacing=1.3)


def draw_scale(axes: Axes) -> None:
    """A bar of a round length, at most a sixth of the panel (10 m in views of 60 to 120 m), bottom left."""
    from matplotlib.patheffects import withStroke

    inches, metres = inches_of(axes), np.diff([axes.get_xlim(), axes.get_ylim()])[:, 0]
    x, y = np.array([axes.get_xlim()[0], axes.get_ylim()[0]]) + 0.25 * metres / inches
    length = round_length(metres[0] / 6)
    for width, color in ((8, "white"), (4, INK)):
        axes.plot([x, x + length], [y, y], linewidth=width, color=color, solid_capstyle="butt", zorder=8)
    above = y + 0.08 * metres[1] / inches[1]
    text = axes.text(x + length / 2, above, f"{length:g} m", fontsize=12, color=INK, ha="center", va="bottom", zorder=8)
    text.set_path_effects([withStroke(linewidth=4, foreground="white")])


def legend_box(
    axes: Axes,
    position: np.ndarray,
    is_loud: np.ndarray,
    inches: Tuple[float, float],
    corner: Optional[str] = None,
) -> Axes:
    """An empty white box of that size in the corner where it hides the fewest points; loud ones count twenty-fold.

    Args:
        axes: a panel.
        position: (N, 3) float64, metres.
        is_loud: (N,) bool.
        inches: width and height.
        corner: one of `CORNERS`; None = the one that hides the fewest.

    Convention: not in the lower left corner, which is the scale bar's.
    """
    panel = inches_of(axes)
    size, margin = np.minimum(np.array(inches) / panel, 0.5), 0.1 / panel
    low, high = np.array([axes.get_xlim(), axes.get_ylim()]).T
    fraction = (position[:, :2] - low) / (high - low)
    far = 1 - margin - size
    corners = np.array([(far[0], far[1]), (far[0], margin[1]), (margin[0], far[1])])
    is_hidden = ((fraction >= corners[:, None]) & (fraction <= corners[:, None] + size)).all(axis=2)
    best = int(np.argmin(is_hidden @ np.where(is_loud, 20, 1)))
    x, y = corners[best if corner is None else CORNERS.index(corner)]
    box = axes.inset_axes((x, y, size[0], size[1]), zorder=7)
    box.set(xticks=[], yticks=[], facecolor="white")
    for spine in box.spines.values():
        spine.set(color=FRAME, linewidth=0.8)
    return box
