"""Picture of the clusters of a sweep."""

from __future__ import annotations

from typing import TYPE_CHECKING, Optional, Sequence, Union

import numpy as np

from cflow_torch.types import Array, CFlowError, FlowResult, as_numpy
from cflow_torch.viz.bev import ground_rows, point_rows, view_of
from cflow_torch.viz.coloring import PALETTE, color_numbers
from cflow_torch.viz.legend import draw_scale, legend_box
from cflow_torch.viz.panel import dot_area, draw_ego, draw_ground, new_figure
from cflow_torch.viz.style import INK, STATIC

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_CAPTION = "colour: a cluster, neighbours in different colours   grey: in no cluster"


def plot_clusters(
    points: Array,
    result_or_cluster_id: Union[FlowResult, Array],
    *,
    is_ground: Optional[Array] = None,
    point_cloud_range: Optional[Sequence[float]] = None,
    title: Optional[str] = None,
) -> Figure:
    """Bird's-eye view of sweep t, its points coloured by cluster.

    Args:
        points: (N, 3+), metres, ego frame of sweep t.
        result_or_cluster_id: the `FlowResult` of these points, or their clusters (N,), integers, negative = none.
        is_ground: (N,) bool; ground is drawn very faintly. None = nothing is ground.
        point_cloud_range: (x0, y0, z0, x1, y1, z1), metres; what lies outside is not drawn. None = that of `Config`.
        title: one line above the picture.

    Returns:
        Figure, 1000 pixels wide at its own dpi, for `save_picture`.

    Convention: view as in `plot_flow`. A colour names no cluster: it only tells neighbours apart.

    Raises:
        CFlowError: matplotlib is absent, or an argument has the wrong shape or value.
    """
    position = point_rows("points", points, None)
    given = result_or_cluster_id
    cluster = as_numpy(given.cluster_id if isinstance(given, FlowResult) else given)
    if cluster.shape != (len(position),) or cluster.dtype.kind not in "iu":
        raise CFlowError(
            f"cluster_id has shape {cluster.shape} and type {cluster.dtype}: give ({len(position)},) integers, one "
            "per point, negative = in no cluster"
        )
    ground = ground_rows(is_ground, len(position))
    view, is_inside = view_of(position, point_cloud_range)

    floor, rest = position[is_inside & ground], is_inside & ~ground
    position, cluster = position[rest], cluster[rest].astype(np.int64)
    has_one = cluster >= 0
    names, number, size = np.unique(cluster[has_one], return_inverse=True, return_counts=True)
    color = color_numbers(position[has_one], number)

    figure, (axes,) = new_figure(("",), view, title, _CAPTION)
    draw_ground(axes, floor)
    alone, members = position[~has_one], position[has_one]
    axes.scatter(alone[:, 0], alone[:, 1], s=dot_area(axes), color=STATIC, linewidths=0, zorder=2)
    order = np.argsort(-size[number], kind="stable")  # small ones on top
    colors = np.array(PALETTE)[color[number[order]]] if len(names) else None
    axes.scatter(members[order, 0], members[order, 1], s=3 * dot_area(axes), c=colors, linewidths=0, zorder=3)
    draw_scale(axes)
    draw_ego(axes)
    _draw_sizes(axes, position, has_one, size)
    return figure


def _draw_sizes(axes: Axes, position: np.ndarray, has_one: np.ndarray, size: np.ndarray) -> None:
    """How many clusters of which size there are, as a small table in a corner."""
    box = legend_box(axes, position, has_one, (2.3, 1.5))
    bounds = (1, 10, 100, 1000, np.inf)
    words = ("under 10", "10 to 99", "100 to 999", "1000 or more")
    counts = [int(((size >= low) & (size < high)).sum()) for low, high in zip(bounds, bounds[1:])]
    lines = [("points in view", "clusters"), *((word, f"{count}") for word, count in zip(words, counts))]
    lines.append(("all", f"{len(size)}"))
    for i, (left, right) in enumerate(lines):
        y = 1 - (i + 0.75) / (len(lines) + 0.5)
        for x, text, side in ((0.06, left, "left"), (0.94, right, "right")):
            weight = "bold" if i == 0 else "normal"
            box.text(x, y, text, fontsize=11, color=INK, ha=side, va="center", weight=weight, transform=box.transAxes)
