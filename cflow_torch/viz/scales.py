"""Picture of coarse to fine: the input of every scale, and the flow so far."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from cflow_torch.config import Config, make_config
from cflow_torch.types import FlowResult, Window, point_rows
from cflow_torch.viz import style
from cflow_torch.viz.bev import longest_flow, view_of
from cflow_torch.viz.panel import FLOW_CAPTION, draw_flow
from cflow_torch.viz.stages import Scale, choose_cluster, scales, sweep_marks
from cflow_torch.viz.style import Axes, Figure

_MARGIN = 2.0  # metres around the object in the close-up
_SMALLEST = 4.0  # metres, half a side of the close-up


def plot_scales(window: Window, config: Config | None = None, *, cluster_id: int | None = None) -> Figure:
    """Draw coarse to fine, one column per pixel size.

    Args:
        window: sweeps.
        config: of one of the paper's methods; None = the preset "paper" with pixels of 0.4, 0.2 and 0.1 m, without
            older sweeps.
        cluster_id: as in `FlowResult`; None = the cluster with the largest product of points and metres of flow.

    Returns:
        Figure, 1600 pixels wide. Above, close up on one cluster: sweep t moved by the flow of the coarser scales, and
        t+1; in the last column t moved by the whole flow. Below: the flow so far, in the colours of the wheel; in the
        last column the flow of the finest pixels alone.

    Convention: metres, frame of t+1.

    Raises:
        CFlowError: matplotlib is not installed, there is no such cluster, the method does not process one scale after
            the other (presets default and offline), or the input is invalid.

    Source: the paper's multi-scale strategy and its figure.
    """
    if config is None:
        config, window = make_config("paper", pixel_sizes=(0.4, 0.2, 0.1)), replace(window, pch=(), pcf=())
    found, result = scales(window, config)
    of_point = result.cluster_id.numpy()
    cluster_id = choose_cluster(of_point, found[-1].flow, cluster_id)
    shown = np.full(len(of_point), False) if cluster_id is None else of_point == cluster_id
    _, alone = scales(window, config.replace(pixel_sizes=config.pixel_sizes[-1:]))
    count = len(found) + 1
    left, gap, side = 0.8, 0.22, 1.75  # inches; `side` is for the legends
    width = (16.0 - left - gap * count - side) / count
    lines = 1 if count <= 4 else 2  # of the panels' names
    more = 0.2 * (lines - 1)  # inches
    below_y, above_y = 0.5, width + 1.2 + more
    figure = style.blank_figure((16.0, 2 * width + 2.3 + 2 * more), 100)
    above, below = (
        [style.add_panel(figure, left + i * (width + gap), bottom, width, width) for i in range(count)]
        for bottom in (above_y, below_y)
    )
    title = "coarse to fine: " + " → ".join(f"{size:g} m" for size in config.pixel_sizes)
    style.add_heading(figure, 0.32, title if cluster_id is None else f"{title}; cluster {cluster_id}")
    position = point_rows("points", window.pc0.points) + result.pose_flow.numpy()
    _draw_close_up(above, position, found, shown)
    max_flow = _draw_flows(below, config, position, found, result, alone)
    for axes in (*above, *below):
        name = axes.get_title().replace(": ", ":\n", lines - 1)
        axes.set_title(name, fontsize=min(12, 8 * width), color=style.INK, pad=6)

    marks = style.add_panel(figure, 16.0 - side, above_y, side, width)
    marks.legend(handles=sweep_marks(), loc="center left", frameon=False, fontsize=11, labelcolor=style.INK)
    wheel, high = style.WHEEL_INCHES
    box = style.add_panel(figure, 16.0 - wheel, below_y + (width - high) / 2, wheel, high)
    style.fill_wheel(box, max_flow)
    for axes in (marks, box):
        axes.axis("off")
    style.add_caption(figure, FLOW_CAPTION)
    return figure


def _square(position: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Low and high corner of a square around points and a margin."""
    ends = position[:, :2] if len(position) else np.zeros((1, 2))
    middle = (ends.min(axis=0) + ends.max(axis=0)) / 2
    half = max(float(np.ptp(ends, axis=0).max()) / 2 + _MARGIN, _SMALLEST)
    return middle - half, middle + half


def _draw_close_up(panels: list[Axes], position: np.ndarray, found: list[Scale], shown: np.ndarray) -> None:
    """Draw one object in the input of each scale, and in the last panel in the result. Args: shown: (N,) bool."""
    low, high = _square(np.concatenate([position[shown], (position + found[-1].flow)[shown]]))
    images = [scale.seen() for scale in found] + [found[-1].result()]
    moved = ["not moved"]
    for scale in found:
        flow = np.median(scale.flow[shown], axis=0) if shown.any() else 0.0
        moved.append(f"moved by {np.linalg.norm(flow):.2f} m")
    names = [f"{image.pixel_size:g} m pixels" for image in images[:-1]] + ["result"]
    for axes, image, name, words in zip(panels, images, names, moved):
        image.draw(axes)
        style.set_view(axes, low, high, has_ticks=True)
        axes.set_title(f"{name}: t {words}")
        style.name_axes(axes, "x, m", "y, m" if axes is panels[0] else "")
        axes.tick_params(labelleft=axes is panels[0])


def _draw_flows(
    panels: list[Axes],
    config: Config,
    position: np.ndarray,
    found: list[Scale],
    result: FlowResult,
    alone: FlowResult,
) -> float:
    """Draw the flow after each scale, and that of the finest alone; return the metres per sweep of full colour."""
    view, is_inside = view_of(position, config.point_cloud_range)
    keep = is_inside & result.is_valid.numpy()
    flows = [scale.flow[keep] for scale in found]
    flows.append(alone.residual_flow.numpy()[keep].astype(np.float64))
    max_flow = longest_flow(np.concatenate(flows))
    names = [f"flow after {size:g} m" for size in config.pixel_sizes]
    names[-1] += ": the result"
    names.append(f"for comparison: {config.pixel_sizes[-1]:g} m alone")
    for axes, name, flow in zip(panels, names, flows):
        style.set_view(axes, *view)
        draw_flow(axes, position[keep], flow, None, max_flow)
        axes.set_title(name)
    return max_flow
