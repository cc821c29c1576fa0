"""Flow pictures of several pairs that can follow one another: one view, one colour scale, one place for the legend."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Iterator, Sequence

import numpy as np

from cflow_torch.types import Array, CFlowError, FlowResult
from cflow_torch.viz.bev import longest_flow, plot_flow, point_rows, split_sweep

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@dataclass(frozen=True)
class Frame:
    """One pair.

    Args:
        points: (N, 3+), metres, ego frame of sweep t.
        result: flow of these points; only residual flow and clusters are drawn.
        is_ground: (N,) bool; None = nothing is ground.
        title: one line above.
    """

    points: Array
    result: FlowResult
    is_ground: Array | None = None
    title: str | None = None


def flow_figures(
    frames: Sequence[Frame],
    *,
    point_cloud_range: Sequence[float] | None = None,
    max_flow: float | None = None,
    legend: str = "upper right",
    width: int = 1000,
) -> Iterator[Figure]:
    """A picture as `plot_flow` makes it for each of several pairs, for `save_animation`.

    Args:
        frames: at least one pair, in order.
        point_cloud_range: as for `plot_flow`; sides that are open end where the points of all frames end.
        max_flow: residual flow at the rim of the colour wheel, metres per sweep; None = the longest of all frames.
        legend: corner of the colour wheel, see `plot_flow`.
        width: of a picture, pixels, 200 ... 4000.

    Yields:
        Figures of one size, one at a time.

    Raises:
        CFlowError: another width, or as `plot_flow`.
    """
    if not 200 <= width <= 4000:
        raise CFlowError(f"width={width}: give 200 ... 4000 pixels")
    corners, longest = [], []
    for frame in frames:
        view, position, _, drawn = split_sweep(frame.points, frame.is_ground, point_cloud_range)
        corners.append(view)
        longest.append(longest_flow(point_rows("residual flow", frame.result.residual_flow, len(position))[drawn]))
    low, high = np.min(corners, axis=0)[0], np.max(corners, axis=0)[1]
    heights = (-np.inf, np.inf) if point_cloud_range is None else (point_cloud_range[2], point_cloud_range[5])
    for frame in frames:
        figure = plot_flow(
            frame.points,
            frame.result,
            is_ground=frame.is_ground,
            point_cloud_range=(*low, heights[0], *high, heights[1]),
            max_flow=max(longest) if max_flow is None else max_flow,
            title=frame.title,
            legend=legend,
        )
        figure.set_dpi(width / figure.get_figwidth())
        yield figure
