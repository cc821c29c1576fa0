"""Pictures of the clusters of a sweep."""

from __future__ import annotations

from typing import Any, Sequence

import numpy as np

from cflow_torch.types import Array, CFlowError, FlowResult, as_numpy
from cflow_torch.viz import style
from cflow_torch.viz.bev import split_sweep
from cflow_torch.viz.panel import dot_area, draw_ego, draw_ground, new_figure
from cflow_torch.viz.style import Axes, Figure

PALETTE = np.array(
    [(230, 25, 75), (60, 180, 75), (67, 99, 216), (245, 130, 49), (145, 30, 180),
     (0, 160, 176), (184, 134, 11), (240, 50, 230), (122, 75, 31), (107, 142, 35)], np.uint8
)  # fmt: skip
_CAPTION = "colour: a cluster, neighbours in different colours   grey: in no cluster"


def plot_clusters(
    points: Array,
    result_or_cluster_id: FlowResult | Array,
    *,
    is_ground: Array | None = None,
    point_cloud_range: Sequence[float] | None = None,
    title: str | None = None,
) -> Figure:
    """Draw sweep t from above, coloured by cluster.

    Args:
        result_or_cluster_id: the `FlowResult` of the points, or their clusters (N,), integers, negative = none.
        points, is_ground, point_cloud_range, title: as for `plot_flow`.

    Returns:
        Figure, 1000 pixels wide at its own dpi, for `save_picture`.

    Convention: view as in `plot_flow`. A colour does not identify a cluster; it only distinguishes neighbours.

    Raises:
        CFlowError: matplotlib is not installed, or an argument has the wrong shape or value.
    """
    view, position, is_floor, rest = split_sweep(points, is_ground, point_cloud_range)
    given = result_or_cluster_id
    cluster = as_numpy(given.cluster_id if isinstance(given, FlowResult) else given)
    if cluster.shape != (len(position),) or cluster.dtype.kind not in "iu":
        raise CFlowError(f"cluster_id has shape {cluster.shape}, {cluster.dtype}: give ({len(position)},) integers")

    floor = position[is_floor]
    position = position[rest]
    cluster = cluster[rest]
    has_cluster = cluster >= 0
    _, number, size = np.unique(cluster[has_cluster], return_inverse=True, return_counts=True)

    figure, (axes,) = new_figure(("",), view, title, _CAPTION)
    draw_ground(axes, floor)
    alone = position[~has_cluster]
    members = position[has_cluster]
    axes.scatter(alone[:, 0], alone[:, 1], s=dot_area(axes), color=style.STATIC, linewidths=0, zorder=2)
    order = np.argsort(-size[number], kind="stable")  # small ones on top
    color = cluster_colors(members, number, (0, 0, 0))[order] / 255
    axes.scatter(members[order, 0], members[order, 1], s=3 * dot_area(axes), c=color, linewidths=0, zorder=3)
    style.draw_scale(axes)
    draw_ego(axes)
    _draw_sizes(axes, position, has_cluster, size)
    return figure


def cluster_colors(position: np.ndarray, cluster_id: np.ndarray, no_cluster: Sequence[int]) -> np.ndarray:
    """Choose a colour for each cluster, so that neighbours differ: (N, 3) uint8 RGB.

    The largest cluster is coloured first. Each cluster gets the colour of `PALETTE` whose nearest cluster is farthest
    away, measured between bounding boxes in x and y. Ties: the colour that fewest clusters have. Positions (N, 2+) are
    finite metres. Points in no cluster have a negative id, (N,), and get the colour `no_cluster`, 0 ... 255.

    Cost: quadratic in the number of clusters, about 0.1 s for a thousand.
    """
    colors = np.tile(np.array(no_cluster, np.uint8), (len(cluster_id), 1))
    has_cluster = cluster_id >= 0
    _, group, size = np.unique(cluster_id[has_cluster], return_inverse=True, return_counts=True)
    low = np.full((len(size), 2), np.inf)
    high = np.full((len(size), 2), -np.inf)
    np.minimum.at(low, group, position[has_cluster, :2])
    np.maximum.at(high, group, position[has_cluster, :2])
    distance = np.full((len(size), len(PALETTE)), np.inf)  # from each cluster to the nearest cluster of each colour
    color_of = np.zeros(len(size), np.int64)
    uses = np.zeros(len(PALETTE), np.int64)
    for cluster in np.argsort(-size, kind="stable"):
        color = np.lexsort((uses, -distance[cluster]))[0]
        color_of[cluster] = color
        uses[color] += 1
        gap = np.maximum(low - high[cluster], low[cluster] - high).max(axis=1).clip(min=0)
        distance[:, color] = np.minimum(distance[:, color], gap)
    colors[has_cluster] = PALETTE[color_of[group]]
    return colors


def _draw_sizes(axes: Axes, position: np.ndarray, has_cluster: np.ndarray, size: np.ndarray) -> None:
    """Draw a small table in a corner: the number of clusters by size."""
    box = style.legend_box(axes, position, has_cluster, (2.3, 1.5))
    bounds = (1, 10, 100, 1000, np.inf)
    words = ("under 10", "10 to 99", "100 to 999", "1000 or more")
    counts, _ = np.histogram(size, bounds)
    columns = (("points in view", *words, "all"), ("clusters", *map(str, counts), str(len(size))))
    font: Any = {"fontsize": 11, "color": style.INK, "va": "center", "linespacing": 1.5, "transform": box.transAxes}
    for x, side, column in zip((0.06, 0.94), ("left", "right"), columns):
        box.text(x, 0.5, "\n".join(column), ha=side, **font)
