"""What all pictures share: colours of lines and texts, and an empty figure."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Tuple

import numpy as np

from cflow_torch.types import CFlowError

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

INK, FAINT, STATIC, GROUND, FRAME = "#20262e", "#5b6570", "#b4bbc3", "#eff1f3", "#c9ced4"
_TITLE = 7.2  # characters of a heading per inch


def blank_figure(inches: Tuple[float, float], dpi: int) -> Figure:
    """An empty white figure of that size; no pyplot state is touched.

    Raises:
        CFlowError: matplotlib is absent.
    """
    try:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure
    except ImportError as error:
        raise CFlowError("pictures need matplotlib: pip install matplotlib") from error
    figure = Figure(figsize=inches, dpi=dpi, facecolor="white")
    FigureCanvasAgg(figure)
    return figure


def write(figure: Figure, height: float, title: str) -> None:
    """The heading. Args: height: of its middle, as a fraction of the figure. Names of logs are no formulas."""
    size = 17 * min(1, _TITLE * figure.get_figwidth() / max(len(title), 1))
    figure.text(0.5, height, title, fontsize=size, color=INK, ha="center", va="center", parse_math=False)


def round_length(most: float) -> float:
    """The longest of ... 1, 2, 5, 10, 20, 50 ... that is no longer than `most`, > 0."""
    power = 10.0 ** math.floor(math.log10(most))
    return max(power * digit for digit in (1, 2, 5) if power * digit <= most * (1 + 1e-9))


def inches_of(axes: Axes) -> np.ndarray:
    """(2,) width and height of a panel."""
    return np.array([axes.bbox.width, axes.bbox.height]) / axes.figure.dpi
