"""Layers of a bird's-eye panel: ground, static points, moving points, arrows, errors, the ego vehicle."""

from __future__ import annotations

from typing import Any, Sequence

import numpy as np
import torch

from cflow_torch.ops.indices import flat_nonzero
from cflow_torch.ops.labeling import connected_components
from cflow_torch.types import MOVING
from cflow_torch.viz import style
from cflow_torch.viz.style import Axes, Figure
from cflow_torch.viz.wheel import flow_to_rgb

MIN_ERROR, MAX_ERROR = 0.05, 0.35  # metres, ends of the viewers' error colours; a smaller error is drawn as 0
ARROW_STEPS = 5  # length of an arrow, sweeps
MIN_ARROW_POINTS = 8  # a cluster with fewer moving points gets no arrow
OBJECT_PIXEL = 0.5  # metres; without clusters, moving points in touching pixels are one object
_MAX_PIXELS = 2048  # pixels on a side, at most; larger scenes get larger pixels
FLOW_CAPTION = (
    f"grey: static   colour: moves (at least {MOVING:g} m per sweep, and probably)   "
    f"arrow: motion over {ARROW_STEPS} sweeps"
)
EGO_OUTLINE = ((2.4, 0.0), (-1.9, 1.15), (-1.0, 0.0), (-1.9, -1.15))  # metres
_RING, _MOST_RINGS = 10.0, 20  # metres between two rings; a view with more rings gets wider steps
_HIGHEST = 2.0  # largest ratio of a panel's height to its width; it is at least as high as two colour wheels

_SLOW_RIM, _FAST_RIM = np.array((0.62, 0.66, 0.70)), np.array((0.10, 0.12, 0.15))
_SLATE = (80 / 255, 90 / 255, 110 / 255)  # background of errors: black (none) and white (large) are visible on it


def new_figure(
    names: Sequence[str], view: np.ndarray, title: str | None, caption: str = FLOW_CAPTION, has_rings: bool = True
) -> tuple[Figure, list[Axes]]:
    """Create a figure with one framed panel per name, in a row, and range rings around the ego vehicle.

    The name "" makes a panel without a heading. The view is (2, 2+) float64, metres: its low and its high corner. A
    view that is too long and thin for a panel gets empty space along its long sides. The caption is one line below the
    panels. It explains the colours; we append the distance of the rings.
    """
    gap = 0.2  # inches
    foot = 0.42
    full, dpi = (10.0, 100) if len(names) == 1 else (16.0, 112)
    width = full / len(names) - gap * (1 + 1 / len(names))
    view, extent = _fitted(view, width)
    height = float(width * extent[1] / extent[0])
    head = (0.5 if title else 0) + (0.42 if any(names) else 0) or gap
    figure = style.blank_figure((full, height + head + foot), dpi)
    farthest = float(np.abs(view).max())
    step = max(_RING, style.round_length(farthest / (0.4 * _MOST_RINGS)))  # rounding down takes off up to 3/5
    panels = []
    for i, name in enumerate(names):
        axes = style.add_panel(figure, gap + i * (width + gap), foot, width, height)
        style.set_view(axes, *view)
        if has_rings:
            _draw_rings(axes, step, farthest)
        if name:
            axes.set_title(name, fontsize=14, color=style.INK, pad=7)
        panels.append(axes)
    if title:
        style.add_heading(figure, 0.3, title)
    style.add_caption(figure, f"{caption}   rings: every {step:g} m" if has_rings else caption)
    return figure, panels


def _fitted(view: np.ndarray, width: float) -> tuple[np.ndarray, np.ndarray]:
    """Enlarge a view that is too long and thin for a panel of `width` inches: the view, and its extent, (2,) metres."""
    extent = view[1, :2] - view[0, :2]
    wanted = np.maximum(extent, (extent[1] / _HIGHEST, extent[0] * 2 * style.WHEEL_INCHES[1] / width))
    return view[:, :2] + np.array([[-0.5], [0.5]]) * (wanted - extent), wanted


def _draw_rings(axes: Axes, step: float, farthest: float) -> None:
    """Draw range rings every `step` metres."""
    from matplotlib.patches import Circle

    for radius in np.arange(step, farthest + 1e-9, step).tolist():
        axes.add_patch(Circle((0, 0), radius, fill=False, color=style.FRAME, alpha=0.45, linewidth=0.8, zorder=0.5))


def draw_ground(axes: Axes, position: np.ndarray) -> None:
    """Draw the ground points, very faintly."""
    axes.scatter(position[:, 0], position[:, 1], s=dot_area(axes), color=style.GROUND, linewidths=0, zorder=1)


def has_flow(flow: np.ndarray) -> np.ndarray:
    """(N,) bool: the flow, (N, 3) metres per sweep, is at least `MOVING`; False for NaN."""
    return np.linalg.norm(flow, axis=1) >= MOVING


def draw_flow(
    axes: Axes,
    position: np.ndarray,
    flow: np.ndarray,
    cluster: np.ndarray | None,
    max_flow: float,
    moves: np.ndarray | None = None,
) -> None:
    """Draw static points in grey, moving points in colour, one arrow per moving cluster, and the ego vehicle.

    Positions (N, 3) are in metres, residual flow (N, 3) in metres per sweep; NaN is drawn as static. `cluster` is (N,),
    -1 = none. If it is None, moving points near each other form groups. Flow of `max_flow` has full colour. `moves` is
    (N,) bool, True for moving points; None = all with a flow of at least `MOVING`.
    """
    moves = has_flow(flow) if moves is None else moves
    dot = dot_area(axes)
    static = position[~moves]
    axes.scatter(static[:, 0], static[:, 1], s=dot, color=style.STATIC, linewidths=0, zorder=2)
    position = position[moves]
    flow = flow[moves]
    # A dark rim makes yellow visible on white. The rim of slow, pale points is lighter, so that fast ones stand out.
    speed = np.minimum(np.hypot(flow[:, 0], flow[:, 1]) / max_flow, 1)
    rim = _SLOW_RIM + (_FAST_RIM - _SLOW_RIM) * np.sqrt(speed)[:, None]
    order = np.argsort(speed, kind="stable")
    x, y = position[order, 0], position[order, 1]
    axes.scatter(x, y, s=9 * dot, c=rim[order], linewidths=0, zorder=3)
    axes.scatter(x, y, s=4 * dot, c=flow_to_rgb(flow[order], max_flow) / 255, linewidths=0, zorder=4)

    group = _objects(position) if cluster is None else cluster[moves]
    _, middle, count = group_medians(group, np.concatenate([position[:, :2], flow[:, :2]], axis=1))
    length: Any = {"angles": "xy", "scale_units": "xy", "scale": 1 / ARROW_STEPS, "minlength": 0.5}
    shape: Any = {"units": "width", "width": 0.0047, "headwidth": 3.6, "headlength": 4.5, "headaxislength": 4}
    colors: Any = {"color": style.INK, "edgecolor": "white", "linewidth": 0.7}
    axes.quiver(*middle[count >= MIN_ARROW_POINTS].T, zorder=6, **length, **shape, **colors)
    draw_ego(axes)


def draw_error(axes: Axes, position: np.ndarray, flow: np.ndarray, truth: np.ndarray) -> None:
    """Draw the error of every point whose truth is known (not NaN), from black (no error) to white."""
    error = np.linalg.norm(flow - truth, axis=1)
    is_known = np.isfinite(error)
    position = position[is_known]
    error = error[is_known]
    error[error < MIN_ERROR] = 0
    order = np.argsort(error, kind="stable")  # the largest on top
    position = position[order]
    error = error[order]
    size = dot_area(axes) * np.where(error > 0, 4, 1)
    axes.set_facecolor(_SLATE)
    x, y = position[:, 0], position[:, 1]
    dots = axes.scatter(x, y, s=size, c=error, cmap="hot", vmin=0, vmax=MAX_ERROR, linewidths=0, zorder=2)
    bar = style.color_bar(axes, dots, f"error, m (white ≥ {MAX_ERROR:g})", position, error > 0)
    bar.set_ticks([0, 0.1, 0.2, 0.3], labels=["0", "0.1", "0.2", "0.3"])
    draw_ego(axes, "white", _SLATE)


def group_medians(group: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the number of each group, (G,), the medians of its values, (G, C), and its count of rows, (G,).

    `group` is the number of the group of each row, (N,), negative = in no group; `values` are (N, C). Groups are in
    ascending order. The median of an even number of values is the upper one of the middle two.
    """
    values = values[group >= 0]
    group = group[group >= 0]
    number, start, count = np.unique(np.sort(group), return_index=True, return_counts=True)
    columns = [column[np.lexsort((column, group))][start + count // 2] for column in values.T]
    return number, np.stack(columns, axis=1), count


def _objects(position: np.ndarray) -> np.ndarray:
    """(N,) int64, object of each moving point: points in touching pixels belong together."""
    if not len(position):
        return np.zeros(0, np.int64)
    corner = position[:, :2] - position[:, :2].min(axis=0)
    side = max(OBJECT_PIXEL, float(corner.max()) / _MAX_PIXELS)
    column, row = np.floor(corner / side).astype(np.int64).T
    occupancy = torch.zeros(1, int(row.max()) + 1, int(column.max()) + 1, dtype=torch.bool)
    occupancy[0, row, column] = True
    object_at = torch.zeros(occupancy.shape, dtype=torch.int64)
    object_at[occupancy] = connected_components(occupancy, flat_nonzero(occupancy))
    return object_at[0, row, column].numpy()


def draw_ego(axes: Axes, color: str = style.INK, halo: Any = "white") -> None:
    """Draw the ego vehicle at the origin: an arrow head of a car's length that points to +x."""
    from matplotlib.patheffects import withStroke

    (left, right), (bottom, top) = axes.get_xlim(), axes.get_ylim()
    if not (left <= 0 <= right and bottom <= 0 <= top):
        return
    effects = [withStroke(linewidth=3, foreground=halo)]
    axes.fill(*zip(*EGO_OUTLINE), color=color, linewidth=0, zorder=9, path_effects=effects)
    # The name is behind the vehicle, where it covers no lane, unless the view ends there.
    x, side = (-2.3, "right") if left < -0.1 * (right - left) else (2.8, "left")
    size = 12 if style.inches_of(axes)[0] > 4 else 9
    axes.text(x, 0, "ego", fontsize=size, color=color, ha=side, va="center_baseline", zorder=9, path_effects=effects)


def dot_area(axes: Axes) -> float:
    """Return the area of the dot of a static point, about 0.2 m wide, in square typographic points, at least 0.5."""
    points_per_metre = 72 * style.inches_of(axes)[0] / float(np.diff(axes.get_xlim())[0])
    return max((0.2 * points_per_metre) ** 2, 0.5)
