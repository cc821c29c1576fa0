"""Picture of the key points of two sweeps and of their matches."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from cflow_torch.config import Config, make_config
from cflow_torch.types import Window
from cflow_torch.viz import style
from cflow_torch.viz.bev import longest_flow
from cflow_torch.viz.panel import MOVING
from cflow_torch.viz.stages import KeyPointMatches, keypoint_matches, sweep_marks
from cflow_torch.viz.style import Axes, Figure
from cflow_torch.viz.wheel import flow_to_rgb

_HALF_VIEW = np.array((5.0, 3.6))  # metres, half width and height of the view
_CELL = 4.0  # metres, side of the cells in which matches are added up to choose the view
_POINT_COLOR = "#ffb000"
_ALONG = 9  # points of a line that a legend should not cover
_FADE = 0.72  # of the pixels behind the matches


def plot_keypoints(window: Window, config: Config | None = None) -> Figure:
    """Draw a close-up of the key points of a pair of sweeps and their matches, where the matches move most.

    The config is of the key-point method; None = the preset "keypoints", without older sweeps.

    Returns:
        Figure, 1600 pixels wide. Left: the pixels of both sweeps, and the key points of t as dots. Right: moving
        matches as lines from t to t+1, coloured as the wheel shows, and static ones as grey dots. The axes are metres,
        frame of t+1; a key point lies in the middle of its pixel.

    Raises:
        CFlowError: matplotlib is not installed, the config is of another method, or the input is invalid.
    """
    figure = style.blank_figure((16.0, 6.9), 100)
    if config is None:
        config, window = make_config("keypoints"), replace(window, pch=(), pcf=())
    found = keypoint_matches(window, config)
    low, high = _busiest_view(found.start, found.end)
    title = f"{len(found.key_points)} key points at t, {len(found.start)} of them matched; the view shows a part"
    style.add_heading(figure, 0.31, title)
    panels = [style.add_panel(figure, left, 0.9, 7.12, 5.1) for left in (0.64, 8.56)]
    for axes, fade, name in zip(panels, (0.0, _FADE), ("occupancy and key points", "matches")):
        found.images.draw(axes, fade)
        style.set_view(axes, low, high, has_ticks=True)
        axes.set_title(name, fontsize=14, color=style.INK, pad=7)
        style.name_axes(axes, "x, m (forward)", "y, m (left)" if axes is panels[0] else "", 10)
    pixel = 72 * 7.12 * found.images.pixel_size / (2 * _HALF_VIEW[0])  # in typographic points
    dot = max(0.45 * pixel, 1.5)
    panels[0].plot(*found.key_points.T, "o", color=_POINT_COLOR, markersize=dot, markeredgewidth=0, zorder=3)
    _draw_matches(panels[1], found, low, high)
    _draw_legend(figure)
    return figure


def _busiest_view(start: np.ndarray, end: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the corners of the view around the cell with the largest sum of match vectors, or around the vehicle."""
    flow = end - start
    middle = np.zeros(2)
    moves = np.linalg.norm(flow, axis=1) > MOVING
    if moves.any():
        _, cell = np.unique(np.floor(start[moves] / _CELL).astype(np.int64), axis=0, return_inverse=True)
        cell = cell.reshape(-1)  # NumPy 2.0 gives it another shape
        sums = np.hypot(*(np.bincount(cell, weights=values) for values in flow[moves].T))
        middle = np.median((start + end)[moves][cell == sums.argmax()] / 2, axis=0)
    return middle - _HALF_VIEW, middle + _HALF_VIEW


def _draw_matches(axes: Axes, found: KeyPointMatches, low: np.ndarray, high: np.ndarray) -> None:
    from matplotlib.collections import LineCollection

    inside = ((found.start > low) & (found.start < high)).all(axis=1)
    start, end = found.start[inside], found.end[inside]
    flow = end - start
    max_flow = longest_flow(flow)
    color = flow_to_rgb(flow, max_flow) / 255
    moves = np.linalg.norm(flow, axis=1) > MOVING
    axes.plot(*start[~moves].T, "o", color=style.FAINT, markersize=2.5, markeredgewidth=0, zorder=3)
    lines = np.stack([start, end], axis=1)[moves]
    axes.add_collection(LineCollection(lines, colors=style.INK, linewidths=1.9, alpha=0.5, zorder=4))
    axes.add_collection(LineCollection(lines, colors=color[moves], linewidths=1.1, zorder=5))
    axes.scatter(end[moves, 0], end[moves, 1], s=14, c=color[moves], linewidths=0.6, edgecolors=style.INK, zorder=6)
    along = np.concatenate([start + share * flow for share in np.linspace(0, 1, _ALONG)])
    style.draw_wheel(axes, along, np.tile(moves, _ALONG), max_flow)


def _draw_legend(figure: Figure) -> None:
    """Explain the marks, one line below the panels."""
    from matplotlib.lines import Line2D

    marks = sweep_marks()
    marks.append(Line2D([], [], marker="o", linestyle="", markersize=7, color=_POINT_COLOR, label="key point of t"))
    marks.append(Line2D([], [], linewidth=2.5, color="#00a0b0", label="moving match, dot at t+1"))
    marks.append(Line2D([], [], marker="o", linestyle="", markersize=4, color=style.FAINT, label="static match"))
    figure.legend(handles=marks, loc="lower center", ncol=len(marks), frameon=False, fontsize=11, labelcolor=style.INK)
