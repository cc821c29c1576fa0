"""A bird's-eye picture of a map (`plot_map`)."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from cflow_torch.types import Array, as_numpy
from cflow_torch.viz import style
from cflow_torch.viz.bev import point_rows
from cflow_torch.viz.panel import dot_area

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_SIDE, _GAP, _HEAD, _FOOT = 9.6, 0.2, 0.5, 0.42  # inches: longest side of the panel, and the space around it
_OUTLIERS = 0.2  # per cent of the points on each side that the view may leave out
_HEIGHTS = (2, 98)  # per cent of the points, ends of the colours


def plot_map(points: Array, title: str | None = None) -> Figure:
    """Draw the points of a map from above, coloured by height; higher points are darker and cover lower ones.

    Args:
        points: (N, 3+), metres, in the world, for example of `static_map`.
        title: one line above the picture.

    Returns:
        Figure for `save_picture`, at most 1000 pixels wide.

    Convention:
        x points right, y up, with equal scales. The view leaves out the outermost 0.2 % of the points on each side.

    Raises:
        CFlowError: matplotlib is not installed, or the points have another shape.

    Cost: linear in the points; about a second for a million.
    """
    position = point_rows("points", as_numpy(points))
    position = position[np.isfinite(position).all(axis=1)]
    shown = position if len(position) else np.zeros((1, 3))
    low, high = np.percentile(shown[:, :2], (_OUTLIERS, 100 - _OUTLIERS), axis=0) + np.array([[-1.0], [1.0]])
    extent = np.maximum(high - low, (high - low).max() / 3)  # a road gets empty space along its sides
    low, high = (low + high - extent) / 2, (low + high + extent) / 2
    width, height = _SIDE * extent / extent.max()
    figure = style.blank_figure((width + 2 * _GAP, height + _HEAD + _FOOT), 100)
    axes = style.add_panel(figure, _GAP, _FOOT, width, height)
    style.set_view(axes, low, high)
    order = np.argsort(position[:, 2], kind="stable")
    x, y, z = position[order].T
    lowest, highest = np.percentile(shown[:, 2], _HEIGHTS)
    dots = axes.scatter(x, y, s=dot_area(axes), c=z, cmap="viridis_r", vmin=lowest, vmax=highest, linewidths=0)
    style.draw_scale(axes)
    bar = style.color_bar(axes, dots, "height, m", position, np.zeros(len(position), bool))
    bar.ax.locator_params(nbins=4)
    if title:
        style.add_heading(figure, _HEAD / 2, title)
    style.add_caption(figure, f"{len(position)} points from above")
    return figure
