"""Picture of the correlation of one cluster: template, target, and the score of every shift."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from cflow_torch.config import Config, make_config
from cflow_torch.types import Window
from cflow_torch.viz import style
from cflow_torch.viz.stages import ClusterCorrelation, cluster_correlation
from cflow_torch.viz.style import Axes, Figure

_COLORMAP = "viridis"
_PEAK = "#e6194b"
_MOST_LINES = 160  # of the surface, a side


def plot_correlation(window: Window, config: Config | None = None, *, cluster_id: int | None = None) -> Figure:
    """Draw the pixels of one cluster at t and t+1 and their normalised cross-correlation.

    Args:
        window: sweeps.
        config: a `DenseConfig` with `clustering="components"`; None = the preset "paper", without older sweeps.
        cluster_id: as in `FlowResult`; None = the cluster with the largest product of points and metres of flow.

    Returns:
        Figure, 1600 pixels wide: the cluster at t, at t+1, and both with t moved by the chosen shift, in metres, frame
        of t+1; the scores of all shifts as an image and as a surface, in pixels, with the chosen shift marked in both.

    Raises:
        CFlowError: matplotlib is not installed, there is no such cluster, or the method has no such map.

    Source: the paper's figures of one car and of its NCC map; Eq. norm_correlation, displacement_in_bev.
    """
    if config is None:
        config, window = make_config("paper"), replace(window, pch=(), pcf=())
    found = cluster_correlation(window, config, cluster_id)
    figure, panels = _lay_out(found.images.t.shape)
    style.add_heading(figure, 0.35, _title(found, config))
    images, nothing = found.images, np.zeros_like(found.images.t)
    height, width = nothing.shape
    # A shift is shorter than the box, so with this margin pixels that leave the box do not wrap around.
    padded = np.pad(images.t, ((0, height), (0, width)))
    moved = np.roll(padded, tuple(found.shift), (0, 1))[:height, :width]
    names = (
        "template: t moved by the coarser scales" if len(config.pixel_sizes) > 1 else "template: sweep t",
        "target: sweep t+1",
        "t moved by the chosen shift, and t+1",
    )
    for axes, name, t, t1 in zip(panels, names, (images.t, nothing, moved), (nothing, images.t1, images.t1)):
        replace(images, t=t, t1=t1).draw(axes, aspect="auto")
        _name(axes, name, "x, m", "y, m")
    _draw_map(panels[3], panels[4], found)
    _draw_surface(panels[5], found)
    return figure


def _title(found: ClusterCorrelation, config: Config) -> str:
    size = found.images.pixel_size
    dy, dx = found.shift
    title = f"cluster {found.cluster_id}: moves by {_pair(dx, dy)} pixels of {size:g} m = "
    title += f"{_pair(dx * size, dy * size)} m, score {found.score:.2f}"
    others = ["coarser scales"] * (len(config.pixel_sizes) > 1) + ["older sweeps"] * (config.num_history > 0)
    return f"{title}; with {' and '.join(others)} {_pair(*found.flow[:2])} m" if others else title


def _lay_out(shape: tuple[int, int]) -> tuple[Figure, list[Any]]:
    """Create the figure and its axes: four images, colour bar, surface."""
    left, right = 0.7, 5.25
    # Pixels are square, unless the box is so long and thin that nothing would be visible.
    height, width = np.maximum(3.35 * np.array(shape) / max(shape), 1.2)
    total = max(2 * height + 2.9, 6.4)
    lower = 0.65 + (total - 2 * height - 2.9) / 2
    upper = lower + height + 1.2
    figure = style.blank_figure((16.0, total), 100)
    corners = [(left, upper), (right, upper), (left, lower), (right, lower)]
    panels = [style.add_panel(figure, x, y, width, height) for x, y in corners]
    panels.append(style.add_panel(figure, right + width + 0.2, lower, 0.13, height))
    panels.append(style.add_panel(figure, 9.6, 0.2, 6.1, total - 0.9, projection="3d"))
    return figure, panels


def _name(axes: Axes, title: str, x: str, y: str) -> None:
    axes.set_title(title, fontsize=12, color=style.INK, pad=8)
    style.name_axes(axes, x, y)
    style.thin_ticks(axes)
    style.thin_frame(axes)


def _draw_map(axes: Axes, colors: Axes, found: ClusterCorrelation) -> None:
    """Draw the scores as an image with its colour bar; shifts in pixels, those outside the search range in grey."""
    height, width = found.ncc.shape
    low_y, low_x = -(height // 2) - 0.5, -(width // 2) - 0.5
    axes.set_facecolor("#d5d9de")
    extent = (low_x, low_x + width, low_y, low_y + height)
    options: Any = {"origin": "lower", "interpolation": "nearest", "aspect": "auto"}
    image = axes.imshow(found.ncc, extent=extent, cmap=_COLORMAP, vmin=0, **options)
    dy, dx = found.shift
    axes.plot(0, 0, "+", color="white", markersize=9, markeredgewidth=1.2)
    axes.plot(dx, dy, "o", markersize=13, markeredgewidth=2.2, markerfacecolor="none", markeredgecolor=_PEAK)
    _name(axes, "score of every shift (+: no shift)", *_shift_names(found))
    bar: Any = axes.figure.colorbar(image, cax=colors)
    bar.ax.tick_params(labelsize=9, labelcolor=style.INK, color=style.INK, length=2)
    bar.outline.set_visible(False)


def _draw_surface(axes: Any, found: ClusterCorrelation) -> None:
    """Draw the scores as a surface. Args: axes: three-dimensional."""
    axes.patch.set_visible(False)  # it would cover the numbers next to it
    # A margin of zeros makes a surface of a map that has a single row or column.
    scores = np.pad(np.nan_to_num(found.ncc), 1)
    y, x = (np.arange(n) - 1 - (n - 2) // 2 for n in scores.shape)
    axes.plot_surface(
        *np.meshgrid(x, y), scores, cmap=_COLORMAP, linewidth=0, vmin=0, rcount=_MOST_LINES, ccount=_MOST_LINES
    )
    dy, dx = found.shift
    top = max(float(scores.max()), found.score, 0.1)
    axes.plot([dx, dx], [dy, dy], [found.score, 1.12 * top], color=_PEAK, linewidth=1.6, zorder=10)
    axes.plot([dx], [dy], [1.12 * top], "o", color=_PEAK, markersize=7, zorder=10)
    size = found.images.pixel_size
    axes.text(dx, dy, 1.18 * top, f"{_pair(dx * size, dy * size)} m", fontsize=12, color=_PEAK, ha="center")
    stretch = np.array(found.ncc.shape[::-1]) / max(found.ncc.shape)
    axes.set_box_aspect((*np.maximum(stretch, 0.45), 0.6), zoom=0.9)
    axes.set_zlim(0, 1.15 * top)
    axes.view_init(elev=32, azim=-62)
    names = (*_shift_names(found), "score (NCC)")
    for axis, name in zip((axes.xaxis, axes.yaxis, axes.zaxis), names):
        axis.set_label_text(name, fontsize=10, color=style.INK)
        axis.labelpad = 8
    axes.locator_params(axis="both", nbins=5)
    axes.tick_params(labelsize=9, labelcolor=style.INK)


def _shift_names(found: ClusterCorrelation) -> list[str]:
    return [f"shift in {axis}, pixels of {found.images.pixel_size:g} m" for axis in "xy"]


def _pair(x: float, y: float) -> str:
    """Two numbers with their signs, to three digits."""
    return "({}, {})".format(*(f"{value:+.3g}" if abs(value) > 1e-9 else "0" for value in (x, y)))
