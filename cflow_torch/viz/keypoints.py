"""Picture of the key points of two sweeps and of their matches."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Optional, Tuple

import numpy as np

from cflow_torch.config import Config, make_config
from cflow_torch.types import Window
from cflow_torch.viz.bev import longest_flow
from cflow_torch.viz.occupancy import draw_occupancy, sweep_marks
from cflow_torch.viz.panel import MOVING
from cflow_torch.viz.stages import KeyPointMatches, keypoint_matches
from cflow_torch.viz.style import FAINT, INK, add_heading, add_panel, blank_figure, draw_wheel, name_axes, set_view
from cflow_torch.viz.wheel import flow_to_rgb

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_HALF_VIEW = np.array((5.0, 3.6))  # metres, half width and height of what is shown
_CELL = 4.0  # metres, in which matches are counted to find the place that is shown
_POINT_COLOR = "#ffb000"
_ALONG = 9  # places of a line that a legend may hide
_FADE = 0.72  # of the pixels behind the matches


def plot_keypoints(window: Window, config: Optional[Config] = None, *, title: Optional[str] = None) -> Figure:
    """Key points of a pair of sweeps and their matches, close up where most of them move.

    Args:
        window: sweeps.
        config: of the key-point method; None = the preset "keypoints", which leaves older sweeps out.
        title: one line above; None = how many key points and matches there are.

    Returns:
        Figure, 1600 pixels wide. Left: the pixels of both sweeps, the key points of t as dots. Right: a line from every
        matched key point of t to its match of t+1, in the colours of the wheel.

    Convention: metres, frame of t+1; a key point lies in the middle of its pixel.

    Raises:
        CFlowError: matplotlib is absent, another method, or bad input.
    """
    figure = blank_figure((16.0, 6.9), 100)
    if config is None:
        config, window = make_config("keypoints"), replace(window, pch=())
    found = keypoint_matches(window, config)
    start, end = match_lines(found)
    low, high = busiest(start, end)
    if title is None:
        title = f"{len(found.key_points)} key points at t, {len(found.source)} of them matched; shown is a part"
    add_heading(figure, 0.31, title)
    panels = [add_panel(figure, left, 0.9, 7.12, 5.1) for left in (0.64, 8.56)]
    points = _middle(found.key_points, found)
    for axes, fade, name in zip(panels, (0.0, _FADE), ("occupancy and key points", "matches")):
        draw_occupancy(axes, found.images, fade)
        set_view(axes, low, high, has_ticks=True)
        axes.set_title(name, fontsize=14, color=INK, pad=7)
        name_axes(axes, "x, m (forward)", "y, m (left)" if axes is panels[0] else "", 10)
    dot = (0.45 * 72 * panels[0].bbox.width / figure.dpi * found.images.pixel_size / (2 * _HALF_VIEW[0])) ** 2
    panels[0].plot(*points.T, "o", color=_POINT_COLOR, markersize=max(dot**0.5, 1.5), markeredgewidth=0, zorder=3)
    _draw_matches(panels[1], found, start, end, low, high)
    _draw_legend(figure)
    return figure


def match_lines(found: KeyPointMatches) -> Tuple[np.ndarray, np.ndarray]:
    """(M, 2) float64, metres, where each match starts (key point of t) and where it ends (key point of t+1)."""
    from_pixel = found.key_points[found.source]
    return _middle(from_pixel, found), _middle(from_pixel + found.shift, found)


def _middle(pixels: np.ndarray, found: KeyPointMatches) -> np.ndarray:
    """(K, 2) float64 (x, y), metres, of (K, 2) pixels (row, col)."""
    return found.images.lower + (pixels[:, ::-1] + 0.5) * found.images.pixel_size


def busiest(start: np.ndarray, end: np.ndarray) -> Tuple[np.ndarray, np.ndarray]:
    """Low and high corner of the view: round the cell whose matches go farthest in sum, or the ego vehicle.

    Convention: vectors are summed, so matches that agree count and those that cross do not.
    """
    flow = end - start
    middle = np.zeros(2)
    moves = np.linalg.norm(flow, axis=1) > MOVING
    if moves.any():
        _, cell = np.unique(np.floor(start[moves] / _CELL).astype(np.int64), axis=0, return_inverse=True)
        cell = cell.reshape(-1)  # NumPy 2.0 gives it another shape
        sums = np.hypot(*(np.bincount(cell, weights=values) for values in flow[moves].T))
        middle = np.median((start + end)[moves][cell == sums.argmax()] / 2, axis=0)
    return middle - _HALF_VIEW, middle + _HALF_VIEW


def _draw_matches(
    axes: Axes, found: KeyPointMatches, start: np.ndarray, end: np.ndarray, low: np.ndarray, high: np.ndarray
) -> None:
    from matplotlib.collections import LineCollection

    inside = ((start > low) & (start < high)).all(axis=1)
    start, end = start[inside], end[inside]
    flow = end - start
    max_flow = longest_flow(flow)
    color = flow_to_rgb(flow, max_flow) / 255
    moves = np.linalg.norm(flow, axis=1) > MOVING
    still = start[~moves]
    axes.plot(*still.T, "o", color=FAINT, markersize=2.5, markeredgewidth=0, zorder=3)
    lines = np.stack([start, end], axis=1)[moves]
    axes.add_collection(LineCollection(lines, colors=INK, linewidths=1.9, alpha=0.5, zorder=4))
    axes.add_collection(LineCollection(lines, colors=color[moves], linewidths=1.1, zorder=5))
    axes.scatter(end[moves, 0], end[moves, 1], s=14, c=color[moves], linewidths=0.6, edgecolors=INK, zorder=6)
    along = np.concatenate([start + part * flow for part in np.linspace(0, 1, _ALONG)])
    draw_wheel(axes, along, np.tile(moves, _ALONG), max_flow)


def _draw_legend(figure: Figure) -> None:
    """What the marks are, one line below the panels."""
    from matplotlib.lines import Line2D

    marks = sweep_marks()
    marks.append(Line2D([], [], marker="o", linestyle="", markersize=7, color=_POINT_COLOR, label="key point of t"))
    marks.append(Line2D([], [], linewidth=2.5, color="#00a0b0", label="match that moves, dot at t+1"))
    marks.append(Line2D([], [], marker="o", linestyle="", markersize=4, color=FAINT, label="match that stays"))
    figure.legend(handles=marks, loc="lower center", ncol=len(marks), frameon=False, fontsize=11, labelcolor=INK)
