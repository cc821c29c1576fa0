"""Style that all pictures share: colours of lines and texts, empty figures, panels, legends, the scale bar."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from cflow_torch.errors import CFlowError, import_optional
from cflow_torch.viz.wheel import wheel_image

if TYPE_CHECKING:
    from matplotlib.axes import Axes as Axes
    from matplotlib.figure import Figure as Figure
else:
    Axes = Figure = Any  # matplotlib is an extra

INK, FAINT, STATIC, GROUND, FRAME = "#20262e", "#5b6570", "#b4bbc3", "#eff1f3", "#c9ced4"
SWEEP_RATE = 10  # Hz
CORNERS = ("upper right", "lower right", "upper left")  # corners for a legend; the fourth has the scale bar
WHEEL_INCHES = (1.6, 1.82)  # width and height of the legend
_TITLE = 7.2  # characters of a heading per inch


def checked_path(path: str | Path, *endings: str) -> Path:
    """Return the path of a picture or page. It must end in one of `endings`, such as ".png"."""
    if Path(path).suffix.lower() not in endings:
        raise CFlowError(f"{path} does not end in {' or '.join(endings)}: give a file that does")
    return Path(path)


def blank_figure(inches: tuple[float, float], dpi: int, **settings: Any) -> Figure:
    """Create an empty white figure without touching pyplot's state; a missing matplotlib is a `CFlowError`."""
    import_optional("matplotlib", "pictures need matplotlib (extra viz): pip install matplotlib")
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=inches, dpi=dpi, facecolor="white", **settings)
    FigureCanvasAgg(figure)
    return figure


def add_panel(figure: Figure, left: float, bottom: float, width: float, height: float, **settings: Any) -> Any:
    """Add axes at a position in inches, with the settings of `Figure.add_axes`."""
    across, up = figure.get_size_inches()
    return figure.add_axes((left / across, bottom / up, width / across, height / up), **settings)


def add_heading(figure: Figure, inches: float, title: str) -> None:
    """Write one line, its middle `inches` below the upper edge; a long line gets a smaller font."""
    size = 17 * min(1, _TITLE * figure.get_figwidth() / max(len(title), 1))
    height = 1 - inches / figure.get_figheight()
    # A log's name may contain "$", which is not a formula.
    figure.text(0.5, height, title, fontsize=size, color=INK, ha="center", va="center", parse_math=False)


def add_caption(figure: Figure, caption: str) -> None:
    """Write one line at the lower edge that explains the colours."""
    height = 0.2 / figure.get_figheight()
    figure.text(0.5, height, caption, fontsize=11, color=FAINT, ha="center", va="center")


def set_view(axes: Axes, low: np.ndarray, high: np.ndarray, has_ticks: bool = False) -> None:
    """Set the limits `low` and `high`, (2,) metres each, with equal scales and a thin frame."""
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal")
    if has_ticks:
        thin_ticks(axes)
    else:
        axes.set(xticks=[], yticks=[])
    thin_frame(axes)
    axes.apply_aspect()  # now, so that sizes in inches are right from here on


def thin_frame(axes: Axes) -> None:
    """Draw the frame of a panel or legend thinly."""
    for spine in axes.spines.values():
        spine.set(color=FRAME, linewidth=0.8)


def thin_ticks(axes: Axes) -> None:
    """Draw few, faint ticks."""
    axes.locator_params(nbins=6, min_n_ticks=2)
    axes.tick_params(labelsize=10, labelcolor=INK, color=FRAME, length=3)


def name_axes(axes: Axes, x: str, y: str, size: int = 9) -> None:
    """Label the two axes."""
    axes.set_xlabel(x, fontsize=size, color=INK, labelpad=2)
    axes.set_ylabel(y, fontsize=size, color=INK, labelpad=2)


def round_length(most: float) -> float:
    """Round `most` (above 0) down to a number of the series 1, 2, 5, 10, 20, 50 ..., which also goes below 1."""
    power = 10.0 ** math.floor(math.log10(most))
    return max(power * digit for digit in (1, 2, 5) if power * digit <= most * (1 + 1e-9))


def inches_of(axes: Axes) -> np.ndarray:
    """(2,) width and height of a panel."""
    return np.array([axes.bbox.width, axes.bbox.height]) / axes.figure.dpi


def draw_wheel(axes: Axes, position: np.ndarray, moves: np.ndarray, max_flow: float, corner: str | None = None) -> None:
    """Draw the colour wheel in a corner of the panel, see `legend_box`, where it covers few moving points."""
    fill_wheel(legend_box(axes, position, moves, WHEEL_INCHES, corner), max_flow)


def fill_wheel(box: Axes, max_flow: float) -> None:
    """Draw the colour wheel and its scale into a box of `WHEEL_INCHES`. `max_flow` is at the rim, metres per sweep."""
    box.imshow(wheel_image(256), extent=(-1, 1, -1, 1), interpolation="bilinear")
    box.set(xlim=(-1.3, 1.3), ylim=(-1.77, 1.194))
    rim = f"rim: {max_flow:.4g} m per sweep\n{max_flow * SWEEP_RATE:.4g} m/s at {SWEEP_RATE} Hz"
    box.text(0, -1.1, rim, fontsize=9.6, color=INK, ha="center", va="top", linespacing=1.3)


def draw_scale(axes: Axes) -> None:
    """Draw a scale bar of a round length, at most a sixth of the panel (10 m in views of 60 to 120 m), bottom left."""
    from matplotlib.patheffects import withStroke

    inches = inches_of(axes)
    metres = np.diff([axes.get_xlim(), axes.get_ylim()])[:, 0]
    x, y = np.array([axes.get_xlim()[0], axes.get_ylim()[0]]) + 0.25 * metres / inches
    length = round_length(metres[0] / 6)
    options: Any = {"color": INK, "zorder": 8, "path_effects": [withStroke(linewidth=8, foreground="white")]}
    axes.plot([x, x + length], [y, y], linewidth=4, solid_capstyle="butt", **options)
    above = y + 0.08 * metres[1] / inches[1]
    axes.text(x + length / 2, above, f"{length:g} m", fontsize=12, ha="center", va="bottom", **options)


def color_bar(axes: Axes, dots: Any, label: str, position: np.ndarray, is_important: np.ndarray) -> Any:
    """Draw the colour bar of scattered dots into a corner of their panel (chosen by `legend_box`)."""
    box = legend_box(axes, position, is_important, (1.8, 0.66))
    bar: Any = axes.figure.colorbar(dots, cax=box.inset_axes((0.1, 0.7, 0.8, 0.18)), orientation="horizontal")
    bar.set_label(label, fontsize=10, color=INK, labelpad=1)
    bar.ax.tick_params(labelsize=10, labelcolor=INK, color=INK, length=2, pad=2)
    return bar


def legend_box(
    axes: Axes, position: np.ndarray, is_important: np.ndarray, inches: tuple[float, float], corner: str | None = None
) -> Axes:
    """Add an empty white box, with the given width and height in inches, in a corner of a panel.

    `corner` is one of `CORNERS`; None = the one where the box covers the fewest points. An important point counts as
    twenty.
    """
    panel = inches_of(axes)
    size = np.minimum(np.array(inches) / panel, 0.5)
    margin = 0.1 / panel
    low, high = np.array([axes.get_xlim(), axes.get_ylim()]).T
    fraction = (position[:, :2] - low) / (high - low)
    far = 1 - margin - size
    corners = np.array([(far[0], far[1]), (far[0], margin[1]), (margin[0], far[1])])
    is_covered = ((fraction >= corners[:, None]) & (fraction <= corners[:, None] + size)).all(axis=2)
    best = int(np.argmin(is_covered @ np.where(is_important, 20, 1)))
    x, y = corners[best if corner is None else CORNERS.index(corner)]
    box = axes.inset_axes((x, y, size[0], size[1]), zorder=7)
    box.set(xticks=[], yticks=[], facecolor="white")
    thin_frame(box)
    return box
