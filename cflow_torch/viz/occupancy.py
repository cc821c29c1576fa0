"""Two sweeps as pixels: sweep t in blue, t+1 in red, both dark; axes in pixels or metres."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, List, Sequence, Tuple

import numpy as np

from cflow_torch.viz.style import FAINT, FRAME, INK
from cflow_torch.viz.watch import Occupancy

if TYPE_CHECKING:
    from matplotlib.axes import Axes

T_COLOR, T1_COLOR, BOTH_COLOR = "#4f86d9", "#e8604c", "#2b2140"


def draw_occupancy(axes: Axes, images: Occupancy, fade: float = 0.0) -> None:
    """Pixels where they lie, metres.

    Args:
        axes: any.
        images: what is drawn.
        fade: 0 ... 1, how far the colours go towards white.
    """
    height, width = images.t.shape
    x, y = images.lower
    extent = (x, x + width * images.pixel_size, y, y + height * images.pixel_size)
    axes.imshow(occupancy_rgb(images.t, images.t1, fade), extent=extent, origin="lower", interpolation="nearest")


def occupancy_rgb(t: np.ndarray, t1: np.ndarray, fade: float = 0.0) -> np.ndarray:
    """(H, W, 3) float64, 0 ... 1, of two (H, W) bool images; white where neither is set."""
    from matplotlib.colors import to_rgb

    image = np.ones((*t.shape, 3))
    for is_set, color in ((t & ~t1, T_COLOR), (t1 & ~t, T1_COLOR), (t & t1, BOTH_COLOR)):
        image[is_set] = fade + (1 - fade) * np.array(to_rgb(color))
    return image


def crop(images: Occupancy, low: np.ndarray, high: np.ndarray) -> Occupancy:
    """The pixels between two corners (x, y), metres, and those that are cut by the edge."""
    height, width = images.t.shape
    first = np.floor((low - images.lower) / images.pixel_size).astype(int).clip(0, (width, height))
    last = np.ceil((high - images.lower) / images.pixel_size).astype(int).clip(0, (width, height))
    part = slice(first[1], last[1]), slice(first[0], last[0])
    return Occupancy(images.t[part], images.t1[part], images.lower + first * images.pixel_size, images.pixel_size)


def frame(axes: Axes, low: np.ndarray, high: np.ndarray) -> None:
    """A thin frame, equal scales, and metres along the edges."""
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal")
    thin(axes)


def thin(axes: Axes, integer: bool = False) -> None:
    """The house's look of axes with ticks."""
    axes.locator_params(nbins=6, min_n_ticks=2, integer=integer)
    axes.tick_params(labelsize=10, labelcolor=INK, color=FRAME, length=3)
    for spine in axes.spines.values():
        spine.set(color=FRAME, linewidth=0.8)


def add_metres(axes: Axes, origin: Tuple[float, float], pixel_size: float, names: Sequence[str]) -> None:
    """A second pair of axes, above and to the right, in metres, for axes in pixels.

    Args:
        axes: in pixels.
        origin: metres at pixel 0, x and y.
        pixel_size: metres.
        names: labels of the two.
    """
    from matplotlib.ticker import MaxNLocator

    def both_ways(start: float):  # type: ignore[no-untyped-def]
        return lambda pixel: start + pixel * pixel_size, lambda metre: (metre - start) / pixel_size

    above = axes.secondary_xaxis("top", functions=both_ways(origin[0]))
    beside = axes.secondary_yaxis("right", functions=both_ways(origin[1]))
    above.set_xlabel(names[0], fontsize=9, color=FAINT, labelpad=3)
    beside.set_ylabel(names[1], fontsize=9, color=FAINT, labelpad=3)
    for second, axis in ((above, above.xaxis), (beside, beside.yaxis)):
        axis.set_major_locator(MaxNLocator(5, steps=(1, 2, 5, 10), min_n_ticks=2))
        for spine in second.spines.values():
            spine.set(color=FRAME, linewidth=0.8)
        second.tick_params(labelsize=9, labelcolor=FAINT, color=FRAME, length=3)


def sweep_marks() -> List[Any]:
    """For a legend: what the colours of the pixels are."""
    from matplotlib.lines import Line2D

    names = {T_COLOR: "sweep t", T1_COLOR: "sweep t+1", BOTH_COLOR: "both"}
    return [Line2D([], [], marker="s", ls="", markersize=10, color=color, label=name) for color, name in names.items()]
