"""What all pictures share: colours of lines and texts, and an empty figure."""

from __future__ import annotations

from typing import TYPE_CHECKING, Tuple

import numpy as np

from cflow_torch.types import CFlowError

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

INK, FAINT, STATIC, GROUND, FRAME = "#20262e", "#5b6570", "#b4bbc3", "#eff1f3", "#c9ced4"


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


def inches_of(axes: Axes) -> np.ndarray:
    """(2,) width and height of a panel."""
    return np.array([axes.bbox.width, axes.bbox.height]) / axes.figure.dpi
