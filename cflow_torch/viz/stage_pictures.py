"""Pictures of the stages of the paper's methods: coarse to fine, the correlation of one cluster, key points."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from cflow_torch.config import Config, make_config
from cflow_torch.types import MOVING, Window, point_rows
from cflow_torch.viz import style
from cflow_torch.viz.bev import longest_flow, view_of
from cflow_torch.viz.panel import FLOW_CAPTION, draw_flow
from cflow_torch.viz.stages import (
    ClusterCorrelation,
    KeyPointMatches,
    Scale,
    choose_cluster,
    cluster_correlation,
    keypoint_matches,
    scales,
    sweep_marks,
)
from cflow_torch.viz.style import Axes, Figure
from cflow_torch.viz.wheel import flow_to_rgb

_MARGIN = 2.0  # metres around the object in the close-up
_SMALLEST = 4.0  # metres, least half side of the close-up
_COLORMAP = "viridis"
_PEAK = "#e6194b"
_LEAST_ASPECT = 0.35  # pixels of longer and thinner images are not square, or nothing would be visible
_MOST_LINES = 160  # lines of the surface along each axis, at most
_HALF_VIEW = np.array((5.0, 3.6))  # metres, half width and height of the view
_CELL = 4.0  # metres, side of the cells in which matches are added up to choose the view
_POINT_COLOR = "#ffb000"
_ALONG = 9  # points on each line of a match that a legend should not cover
_FADE = 0.72  # how far the pixels behind the matches fade to white, 0 ... 1


def plot_scales(window: Window, config: Config | None = None, *, cluster_id: int | None = None) -> Figure:
    """Draw coarse to fine: one column per pixel size, and one more.

    Args:
        window: sweeps.
        config: settings of a method of the paper; None = the preset "paper" with pixels of 0.4, 0.2 and 0.1 m, without
            older sweeps.
        cluster_id: as in `FlowResult`; None = the one where number of points times length of median flow is largest.

    Returns:
        Figure, 1600 pixels wide. The upper row is a close-up of one cluster: t+1, and t moved by the flow of coarser
        scales. Its extra column moves t by the whole flow. The lower row has the flow after each scale, in the colours
        of the wheel. Its extra column has the flow of a run with the finest pixels alone.

    Convention: metres, frame of t+1.

    Raises:
        CFlowError: matplotlib is not installed, there is no such cluster, the method does not process one scale after
            the other (presets default, offline and live), or the input is invalid.

    Source: the paper's multi-scale strategy and its figure.
    """
    if config is None:
        config = make_config("paper", pixel_sizes=(0.4, 0.2, 0.1))
        window = replace(window, pch=(), pcf=())
    found, result = scales(window, config)
    of_point = result.cluster_id.numpy()
    cluster_id = choose_cluster(of_point, found[-1].flow, cluster_id)
    shown = np.full(len(of_point), False) if cluster_id is None else of_point == cluster_id
    _, alone = scales(window, config.replace(pixel_sizes=config.pixel_sizes[-1:]))
    flows = [*(scale.flow for scale in found), alone.residual_flow.double().numpy()]
    figure, above, below, legends = _scale_panels(len(found) + 1)
    title = "coarse to fine: " + " → ".join(f"{size:g} m" for size in config.pixel_sizes)
    figure.suptitle(title if cluster_id is None else f"{title}; cluster {cluster_id}", fontsize=17, color=style.INK)
    position = point_rows("points", window.pc0.points) + result.pose_flow.numpy()
    _draw_close_up(above, position, found, shown)
    max_flow = _draw_flows(below, config, position, flows, result.is_valid.numpy())
    legends[0].legend(handles=sweep_marks(), loc="center", frameon=False, fontsize=11, labelcolor=style.INK)
    style.fill_wheel(legends[1], max_flow)
    figure.supxlabel(FLOW_CAPTION, fontsize=11, color=style.FAINT)
    return figure


def _scale_panels(count: int) -> tuple[Figure, list[Axes], list[Axes], list[Axes]]:
    """Create a figure with two rows of `count` panels, and an empty panel for a legend at the end of each row."""
    figure = style.blank_figure((16.0, 30.4 / (count + 0.5) + 1.9), 100, layout="constrained")
    panels = figure.subplots(2, count + 1, width_ratios=[1.0] * count + [0.45])
    for legend in panels[:, -1]:
        legend.axis("off")
    return figure, list(panels[0, :-1]), list(panels[1, :-1]), list(panels[:, -1])


def _name_panel(axes: Axes, name: str, count: int) -> None:
    """Write the name above one of `count` panels in a row; narrow panels have two lines for it."""
    width = 15.0 / count  # inches, about
    axes.set_title(name.replace(": ", ":\n", int(count > 4)), fontsize=min(12, 4.4 * width), color=style.INK, pad=6)


def _draw_close_up(panels: list[Axes], position: np.ndarray, found: list[Scale], shown: np.ndarray) -> None:
    """Draw a close-up of the points `shown`, (N,) bool: the input of each scale and, in the last panel, the result."""
    ends = np.concatenate([position, position + found[-1].flow])[np.tile(shown, 2), :2]
    ends = ends if len(ends) else np.zeros((1, 2))
    middle = (ends.min(axis=0) + ends.max(axis=0)) / 2
    half = max(float(np.ptp(ends, axis=0).max()) / 2 + _MARGIN, _SMALLEST)
    images = [scale.seen() for scale in found] + [found[-1].result()]
    moved = ["not moved"]
    for scale in found:
        flow = np.median(scale.flow[shown], axis=0) if shown.any() else 0.0
        moved.append(f"moved by {np.linalg.norm(flow):.2f} m")
    names = [f"{image.pixel_size:g} m pixels" for image in images[:-1]] + ["result"]
    for axes, image, name, words in zip(panels, images, names, moved):
        image.draw(axes)
        style.set_view(axes, middle - half, middle + half, has_ticks=True)
        _name_panel(axes, f"{name}: t {words}", len(panels))
        style.name_axes(axes, "x, m", "y, m" if axes is panels[0] else "")
        axes.tick_params(labelleft=axes is panels[0])


def _draw_flows(
    panels: list[Axes], config: Config, position: np.ndarray, flows: list[np.ndarray], is_valid: np.ndarray
) -> float:
    """Draw the flow after each scale, and of the finest scale alone; return the metres per sweep of full colour."""
    view, is_inside = view_of(position, config.point_cloud_range)
    keep = is_inside & is_valid
    max_flow = longest_flow(np.concatenate([flow[keep] for flow in flows]))
    names = [f"flow after {size:g} m" for size in config.pixel_sizes]
    names[-1] += ": the result"
    names.append(f"for comparison: {config.pixel_sizes[-1]:g} m alone")
    for axes, name, flow in zip(panels, names, flows):
        style.set_view(axes, *view)
        draw_flow(axes, position[keep], flow[keep], None, max_flow)
        _name_panel(axes, name, len(panels))
    return max_flow


def plot_correlation(window: Window, config: Config | None = None, *, cluster_id: int | None = None) -> Figure:
    """Draw the pixels of one cluster at t and t+1 and their normalised cross-correlation.

    Args:
        window: sweeps.
        config: a `DenseConfig` with `clustering="components"`; None = the preset "paper", without older sweeps.
        cluster_id: as in `FlowResult`; None = the one where number of points times length of median flow is largest.

    Returns:
        Figure, 1600 pixels wide: the cluster at t, at t+1, and both with t moved by the chosen shift, in metres, frame
        of t+1; the scores of all shifts as an image and as a surface, in pixels, with the chosen shift marked in both.

    Raises:
        CFlowError: matplotlib is not installed, there is no such cluster, or the method has no such map.

    Source: the paper's figures of one car and of its NCC map; Eq. norm_correlation, displacement_in_bev.
    """
    if config is None:
        config = make_config("paper")
        window = replace(window, pch=(), pcf=())
    found = cluster_correlation(window, config, cluster_id)
    images = found.images
    nothing = np.zeros_like(images.t)
    height, width = nothing.shape
    figure = style.blank_figure((16.0, 7.0), 100, layout="constrained")
    panels = figure.subplot_mosaic(
        [["t", "t1", "surface"], ["both", "map", "surface"]],
        width_ratios=(1, 1, 1.5),
        per_subplot_kw={"surface": {"projection": "3d"}},
    )
    figure.suptitle(_title(found, config), fontsize=17, color=style.INK)
    # A shift is shorter than the box, so with this margin pixels that leave the box do not wrap around.
    padded = np.pad(images.t, ((0, height), (0, width)))
    moved = np.roll(padded, tuple(found.shift), (0, 1))[:height, :width]
    template = "template: t moved by the coarser scales" if len(config.pixel_sizes) > 1 else "template: sweep t"
    aspect = "equal" if min(height, width) > _LEAST_ASPECT * max(height, width) else "auto"
    for name, title, t, t1 in (
        ("t", template, images.t, nothing),
        ("t1", "target: sweep t+1", nothing, images.t1),
        ("both", "t moved by the chosen shift, and t+1", moved, images.t1),
    ):
        replace(images, t=t, t1=t1).draw(panels[name], aspect=aspect)
        _name(panels[name], title, "x, m", "y, m")
    _draw_map(panels["map"], found, aspect)
    _draw_surface(panels["surface"], found)
    return figure


def _title(found: ClusterCorrelation, config: Config) -> str:
    size = found.images.pixel_size
    dy, dx = found.shift
    title = f"cluster {found.cluster_id}: moves by {_pair(dx, dy)} pixels of {size:g} m = "
    title += f"{_pair(dx * size, dy * size)} m, score {found.score:.2f}"
    others = ["coarser scales"] * (len(config.pixel_sizes) > 1) + ["older sweeps"] * (config.num_history > 0)
    return f"{title}; with {' and '.join(others)} {_pair(*found.flow[:2])} m" if others else title


def _name(axes: Axes, title: str, x: str, y: str) -> None:
    axes.set_title(title, fontsize=12, color=style.INK, pad=8)
    style.name_axes(axes, x, y)
    style.thin_ticks(axes)
    style.thin_frame(axes)


def _draw_map(axes: Axes, found: ClusterCorrelation, aspect: str) -> None:
    """Draw the scores as an image with its colour bar; shifts in pixels, those outside the search range in grey."""
    height, width = found.ncc.shape
    low_y = -(height // 2) - 0.5
    low_x = -(width // 2) - 0.5
    axes.set_facecolor("#d5d9de")
    extent = (low_x, low_x + width, low_y, low_y + height)
    options: Any = {"origin": "lower", "interpolation": "nearest", "aspect": aspect}
    image = axes.imshow(found.ncc, extent=extent, cmap=_COLORMAP, vmin=0, **options)
    dy, dx = found.shift
    axes.plot(0, 0, "+", color="white", markersize=9, markeredgewidth=1.2)
    axes.plot(dx, dy, "o", markersize=13, markeredgewidth=2.2, markerfacecolor="none", markeredgecolor=_PEAK)
    _name(axes, "score of every shift (+: no shift)", *_shift_names(found))
    bar: Any = axes.figure.colorbar(image, cax=axes.inset_axes((1.03, 0, 0.03, 1)))
    bar.ax.tick_params(labelsize=9, labelcolor=style.INK, color=style.INK, length=2)
    bar.outline.set_visible(False)


def _draw_surface(axes: Any, found: ClusterCorrelation) -> None:
    """Draw the scores as a surface into 3-D axes."""
    axes.patch.set_visible(False)  # the patch would cover the numbers next to it
    # With a margin of zeros, a map of a single row or column is a surface, too.
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
    axes.set_box_aspect((*np.maximum(stretch, 0.45), 0.6), zoom=0.8)
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


def plot_keypoints(window: Window, config: Config | None = None) -> Figure:
    """Draw a close-up of the key points of a pair of sweeps and their matches, where the matches move most.

    `config` is for the key-point method; None = the preset "keypoints", without older sweeps.

    Returns:
        Figure, 1600 pixels wide. Left: the pixels of both sweeps, and the key points of t as dots. Right: moving
        matches as lines from t to t+1, coloured as the wheel shows, and static ones as grey dots. The axes are metres,
        frame of t+1; a key point lies in the middle of its pixel.

    Raises:
        CFlowError: matplotlib is not installed, the config is of another method, or the input is invalid.
    """
    figure = style.blank_figure((16.0, 6.9), 100, layout="constrained")
    if config is None:
        config = make_config("keypoints")
        window = replace(window, pch=(), pcf=())
    found = keypoint_matches(window, config)
    low, high = _busiest_view(found.start, found.end)
    title = f"{len(found.key_points)} key points at t, {len(found.start)} of them matched; the view shows a part"
    figure.suptitle(title, fontsize=17, color=style.INK)
    panels = figure.subplots(1, 2)
    for axes, fade, name in zip(panels, (0.0, _FADE), ("occupancy and key points", "matches")):
        found.images.draw(axes, fade)
        style.set_view(axes, low, high, has_ticks=True)
        axes.set_title(name, fontsize=14, color=style.INK, pad=7)
        style.name_axes(axes, "x, m (forward)", "y, m (left)" if axes is panels[0] else "", 10)
    _draw_legend(figure)
    figure.draw_without_rendering()  # now, so that sizes in inches are right from here on
    pixel = 72 * style.inches_of(panels[0])[0] * found.images.pixel_size / (2 * _HALF_VIEW[0])  # typographic points
    dot = max(0.45 * pixel, 1.5)
    panels[0].plot(*found.key_points.T, "o", color=_POINT_COLOR, markersize=dot, markeredgewidth=0, zorder=3)
    _draw_matches(panels[1], found, low, high)
    return figure


def _busiest_view(start: np.ndarray, end: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the corners of the view around the cell with the largest sum of match vectors, or around the vehicle."""
    flow = end - start
    middle = np.zeros(2)
    moves = np.linalg.norm(flow, axis=1) >= MOVING
    if moves.any():
        _, cell = np.unique(np.floor(start[moves] / _CELL).astype(np.int64), axis=0, return_inverse=True)
        cell = cell.reshape(-1)  # NumPy 2.0 gives it another shape
        sums = np.hypot(*(np.bincount(cell, weights=values) for values in flow[moves].T))
        middle = np.median((start + end)[moves][cell == sums.argmax()] / 2, axis=0)
    return middle - _HALF_VIEW, middle + _HALF_VIEW


def _draw_matches(axes: Axes, found: KeyPointMatches, low: np.ndarray, high: np.ndarray) -> None:
    from matplotlib.collections import LineCollection

    inside = ((found.start > low) & (found.start < high)).all(axis=1)
    start = found.start[inside]
    end = found.end[inside]
    flow = end - start
    max_flow = longest_flow(flow)
    color = flow_to_rgb(flow, max_flow) / 255
    moves = np.linalg.norm(flow, axis=1) >= MOVING
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
    figure.legend(
        handles=marks, loc="outside lower center", ncol=len(marks), frameon=False, fontsize=11, labelcolor=style.INK
    )
