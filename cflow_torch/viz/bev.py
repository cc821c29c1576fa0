"""Bird's-eye pictures of a flow (`plot_flow`) and of a map (`plot_map`); `save_picture` writes them."""

from __future__ import annotations

from pathlib import Path
from typing import Sequence

import numpy as np

from cflow_torch.config import DenseConfig
from cflow_torch.data.atomic import atomic_name
from cflow_torch.types import Array, CFlowError, FlowResult, as_numpy, point_rows
from cflow_torch.viz import style
from cflow_torch.viz.panel import dot_area, draw_error, draw_flow, draw_ground, has_flow, new_figure
from cflow_torch.viz.style import Figure

_OUTLIERS = 0.2  # per cent of the points on each side that the view may leave out
_HEIGHTS = (2, 98)  # percentiles of height, ends of the colour map


def plot_flow(
    points: Array,
    result_or_residual: FlowResult | Array,
    *,
    is_ground: Array | None = None,
    point_cloud_range: Sequence[float] | None = None,
    max_flow: float | None = None,
    title: str | None = None,
    truth: Array | None = None,
    legend: str | None = None,
) -> Figure:
    """Draw sweep t from above, with the motion of its objects until t+1.

    Args:
        points: (N, 3+), metres, ego frame of sweep t.
        result_or_residual: the `FlowResult` of these points, or their residual flow (N, 3), metres per sweep.
        is_ground: (N,) bool; ground is drawn very faintly. None = no point is ground.
        point_cloud_range: (x0, y0, z0, x1, y1, z1), metres; points outside are not drawn. None = that of `DenseConfig`.
        max_flow: residual flow at the rim of the colour wheel, metres per sweep; None = the longest one drawn, rounded
            up to 0.1 m.
        title: one line above the picture.
        truth: (N, 3) true RESIDUAL flow (total flow minus `pose_flow`), metres per sweep, NaN where unknown. Adds a
            panel with the truth and one with the error of every point whose truth is known.
        legend: corner of the colour wheel, "upper right", "lower right" or "upper left"; None = where it covers least.

    Returns:
        Figure, 1000 pixels wide at its own dpi (1792 with truth), for `save_picture`. It does not touch pyplot's state.

    Convention:
        x (forward) points right, y (left) up, with equal scales; a long thin view gets empty space along its sides. A
        point of a `FlowResult` moves by `FlowResult.is_moving`, and one of an array if its flow is at least 0.05 m. An
        arrow starts at the median position of a cluster's moving points and is `panel.ARROW_STEPS` times their median
        flow long. Without clusters, moving points near each other form one.

    Raises:
        CFlowError: matplotlib is not installed, or an argument has the wrong shape or value.

    Cost: linear in the points; about a second for 100,000.
    """
    view, position, is_floor, rest = split_sweep(points, is_ground, point_cloud_range)
    given = result_or_residual
    flow = given.residual_flow if isinstance(given, FlowResult) else given
    residual = point_rows("residual flow", flow, len(position))[rest]
    cluster = as_numpy(given.cluster_id)[rest] if isinstance(given, FlowResult) else None
    moves = as_numpy(given.is_moving)[rest] if isinstance(given, FlowResult) else has_flow(residual)
    true_flow = None if truth is None else point_rows("truth", truth, len(position))[rest]
    if legend is not None and legend not in style.CORNERS:
        raise CFlowError(f"legend={legend!r}: give None or one of {', '.join(style.CORNERS)}")

    floor = position[is_floor]
    position = position[rest]
    if max_flow is None:
        max_flow = longest_flow(residual if true_flow is None else np.concatenate([residual, true_flow]))

    names = ("",) if true_flow is None else ("estimate", "ground truth", "error")
    figure, panels = new_figure(names, view, title)
    for axes in panels[:2]:
        draw_ground(axes, floor)
    draw_flow(panels[0], position, residual, cluster, max_flow, moves)
    style.draw_scale(panels[0])
    style.draw_wheel(panels[0], position, moves, max_flow, legend)
    if true_flow is not None:
        draw_flow(panels[1], position, true_flow, None, max_flow)
        draw_error(panels[2], position, residual, true_flow)
    return figure


def plot_map(points: Array, title: str | None = None) -> Figure:
    """Draw the points of a map from above, coloured by height; higher points are darker and cover lower ones.

    The points are (N, 3+) metres in the world, for example of `static_map`. The figure, for `save_picture`, is 1000
    pixels wide; x points right, y up, with equal scales. The title is one line above the picture. The view leaves out
    the outermost 0.2 % of the points on each side.

    Raises:
        CFlowError: matplotlib is not installed, or the points have another shape.

    Cost: linear in the points; about a second for a million.
    """
    position = point_rows("points", points)
    position = position[np.isfinite(position).all(axis=1)]
    shown = position if len(position) else np.zeros((1, 3))
    view = np.percentile(shown, (_OUTLIERS, 100 - _OUTLIERS), axis=0) + np.array([[-1.0], [1.0]])
    figure, (axes,) = new_figure(("",), view, title, f"{len(position):,} points from above", has_rings=False)
    x, y, z = position[np.argsort(position[:, 2], kind="stable")].T
    lowest, highest = np.percentile(shown[:, 2], _HEIGHTS)
    dots = axes.scatter(x, y, s=dot_area(axes), c=z, cmap="viridis_r", vmin=lowest, vmax=highest, linewidths=0)
    style.draw_scale(axes)
    bar = style.color_bar(axes, dots, "height, m", position, np.zeros(len(position), bool))
    bar.ax.locator_params(nbins=4)
    return figure


def save_picture(figure: Figure, path: str | Path) -> Path:
    """Save a figure of a `plot_...` function as .png, and return the path.

    The file appears complete or not at all. An older one is replaced, and missing folders are created. Another ending
    is a `CFlowError`. A file that cannot be written is an `OSError`.
    """
    path = style.checked_path(path, ".png")
    with atomic_name(path) as temporary:
        figure.savefig(temporary, format="png", dpi=figure.dpi)
    return path


def split_sweep(
    points: Array, is_ground: Array | None, point_cloud_range: Sequence[float] | None
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return the view as in `view_of`, (N, 3) float64 positions, and (N,) bool: ground and other points in view."""
    position = point_rows("points", points)
    ground = np.zeros(len(position), bool) if is_ground is None else as_numpy(is_ground).astype(bool)
    if ground.shape != (len(position),):
        raise CFlowError(f"is_ground has shape {ground.shape}: give ({len(position)},), one entry per point")
    view, is_inside = view_of(position, point_cloud_range)
    return view, position, is_inside & ground, is_inside & ~ground


def view_of(position: np.ndarray, point_cloud_range: Sequence[float] | None) -> tuple[np.ndarray, np.ndarray]:
    """Return the view, (2, 3) low and high corner in metres, and the (N,) bool mask of points inside the range."""
    default = DenseConfig().point_cloud_range
    bounds = np.asarray(default if point_cloud_range is None else point_cloud_range, np.float64)
    if bounds.shape != (6,) or not (bounds[:3] < bounds[3:]).all():
        raise CFlowError(
            f"point_cloud_range={point_cloud_range}: give (x0, y0, z0, x1, y1, z1), metres, low ends below high ones"
        )
    low = bounds[:3]
    high = bounds[3:]
    is_inside = np.isfinite(position).all(axis=1) & ((position >= low) & (position <= high)).all(axis=1)
    if not np.isfinite(bounds[[0, 1, 3, 4]]).all():  # an open side ends where the points end
        seen = position[is_inside] if is_inside.any() else np.zeros((1, 3))
        low = np.where(np.isfinite(low), low, np.minimum(seen.min(axis=0) - 1, high - 1))
        high = np.where(np.isfinite(high), high, np.maximum(seen.max(axis=0) + 1, low + 1))
    return np.stack([low, high]), is_inside


def longest_flow(flow: np.ndarray) -> float:
    """Return the length in x and y of the longest flow, rounded up to 0.1 m, at least 0.1 m."""
    length = np.hypot(flow[:, 0], flow[:, 1])
    return max(float(np.ceil(length[np.isfinite(length)].max(initial=0) * 10 - 1e-3)) / 10, 0.1)
