"""Picture of the correlation of one cluster: template, target, and the score of every shift."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any, List, Optional, Tuple

import numpy as np

from cflow_torch.config import Config, make_config
from cflow_torch.types import Window
from cflow_torch.viz.occupancy import add_metres, occupancy_rgb, thin
from cflow_torch.viz.stages import ClusterCorrelation, cluster_correlation
from cflow_torch.viz.style import INK, blank_figure, write

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_COLORMAP = "viridis"
_PEAK = "#e6194b"
_MOST_LINES = 160  # of the surface, a side
_THIN = 6.0  # a box that is so many times as long as wide


def plot_correlation(
    window: Window, config: Optional[Config] = None, *, cluster_id: Optional[int] = None, title: Optional[str] = None
) -> Figure:
    """How one cluster's motion is found: its pixels at t and t+1, and their normalised cross-correlation.

    Args:
        window: sweeps.
        config: of the dense method, without `proof`; None = the preset "paper", which leaves older sweeps out.
        cluster_id: as in `FlowResult`; None = the most conspicuous mover, see `stages.cluster_correlation`.
        title: one line above; None = which cluster and what was found.

    Returns:
        Figure, 1600 pixels wide: the cluster at t, at t+1, both with t moved by the shift that the method takes, the
        map of scores as an image and as a surface, that shift marked in both. Axes in pixels below and to the left,
        in metres above and to the right.

    Raises:
        CFlowError: matplotlib is absent, the method has no such map (key points, `proof`, HDBSCAN), no such cluster.

    Source: the paper's figures of one car and of its NCC map; Eq. norm_correlation, displacement_in_bev.
    """
    if config is None:
        config, window = make_config("paper"), replace(window, pch=())
    found = cluster_correlation(window, config, cluster_id)
    figure, places = _lay_out(found.images.t.shape)
    size = found.images.pixel_size
    dy, dx = found.shift
    has_coarser = len(config.pixel_sizes) > 1
    if title is None:
        title = (
            f"cluster {found.cluster_id}: moves by {_pair(dx, dy)} pixels of {size:g} m = "
            f"{_pair(dx * size, dy * size)} m{' beyond the coarser scales' * has_coarser}, score {found.score:.2f}"
        )
        if np.abs(found.flow[:2] - found.shift[::-1] * size).max() > 1e-6:  # pooled with what older sweeps say
            title += f"; with older sweeps {_pair(*found.flow[:2])} m"
        if has_coarser:
            title += f"; in all {_pair(*found.total[:2])} m"
    write(figure, 1 - 0.35 / figure.get_figheight(), title)
    nothing = np.zeros_like(found.images.t)
    moved = _moved(found.images.t, found.shift)
    for place, name, t, t1 in zip(
        places,
        (
            "template: t moved by the coarser scales" if has_coarser else "template: sweep t",
            "target: sweep t+1",
            "t moved by the shift taken, and t+1",
        ),
        (found.images.t, nothing, moved),
        (nothing, found.images.t1, found.images.t1),
    ):
        _draw_pixels(figure.add_axes(place), name, found, occupancy_rgb(t, t1))
    _draw_map(figure.add_axes(places[3]), figure.add_axes(places[4]), found)
    _draw_surface(figure.add_axes(places[5], projection="3d"), found)
    return figure


def _lay_out(shape: Tuple[int, int]) -> Tuple[Figure, List[Tuple[float, float, float, float]]]:
    """The figure, and (left, bottom, width, height) as fractions of it: four images, colour bar, surface."""
    width, left, right = 3.35, 0.7, 5.25
    height = float(np.clip(width * shape[0] / shape[1], 1.2, 3.35))
    lower, upper = 0.65, 0.65 + height + 1.5
    total = np.array((16.0, max(upper + height + 1.35, 6.4)))
    lower, upper = np.array((lower, upper)) + (total[1] - (upper + height + 1.35)) / 2
    inches = [(left, upper, width, height), (right, upper, width, height), (left, lower, width, height)]
    inches += [(right, lower, width, height), (right + width + 0.75, lower, 0.13, height)]
    inches.append((9.6, 0.2, 6.1, total[1] - 0.9))
    wide, high = total
    return blank_figure((wide, high), 100), [(x / wide, y / high, w / wide, h / high) for x, y, w, h in inches]


def _moved(template: np.ndarray, shift: np.ndarray) -> np.ndarray:
    """(H, W) bool, the template moved by whole pixels; what leaves the box is not drawn."""
    row, col = np.nonzero(template)
    row, col = row + int(np.rint(shift[0])), col + int(np.rint(shift[1]))
    inside = (row >= 0) & (row < template.shape[0]) & (col >= 0) & (col < template.shape[1])
    image = np.zeros_like(template)
    image[row[inside], col[inside]] = True
    return image


def _aspect(found: ClusterCorrelation) -> Any:
    """Of the images: square pixels, unless the box is so long and thin that nothing could be seen."""
    height, width = found.images.t.shape
    return "equal" if max(height, width) < _THIN * min(height, width) else "auto"


def _draw_pixels(axes: Axes, name: str, found: ClusterCorrelation, image: np.ndarray) -> None:
    height, width = found.images.t.shape
    axes.imshow(image, extent=(0, width, 0, height), origin="lower", interpolation="nearest", aspect=_aspect(found))
    axes.set_title(name, fontsize=12, color=INK, pad=33)
    axes.set_xlabel("pixel", fontsize=9, color=INK, labelpad=2)
    axes.set_ylabel("pixel", fontsize=9, color=INK, labelpad=2)
    thin(axes, integer=True)
    add_metres(axes, tuple(found.images.lower), found.images.pixel_size, ("x, m", "y, m"))


def _draw_map(axes: Axes, beside: Axes, found: ClusterCorrelation) -> None:
    """The map as an image, shifts in pixels, what was not searched in grey; and its colours."""
    height, width = found.ncc.shape
    low_y, low_x = -(height // 2) - 0.5, -(width // 2) - 0.5
    axes.set_facecolor("#d5d9de")
    image = axes.imshow(
        found.ncc,
        extent=(low_x, low_x + width, low_y, low_y + height),
        origin="lower",
        interpolation="nearest",
        cmap=_COLORMAP,
        vmin=0,
        aspect=_aspect(found),
    )
    dy, dx = found.shift
    axes.plot(0, 0, "+", color="white", markersize=9, markeredgewidth=1.2)
    axes.plot(dx, dy, "o", markersize=13, markeredgewidth=2.2, markerfacecolor="none", markeredgecolor=_PEAK)
    axes.set_title("score of every shift (+: no shift)", fontsize=12, color=INK, pad=33)
    axes.set_xlabel("shift in x, pixels", fontsize=9, color=INK, labelpad=2)
    axes.set_ylabel("shift in y, pixels", fontsize=9, color=INK, labelpad=2)
    thin(axes, integer=True)
    add_metres(axes, (0.0, 0.0), found.images.pixel_size, ("m", "m"))
    bar = axes.figure.colorbar(image, cax=beside)
    bar.ax.tick_params(labelsize=9, labelcolor=INK, color=INK, length=2)
    outline: Any = bar.outline  # whose type is known wrongly
    outline.set_visible(False)


def _draw_surface(axes: Any, found: ClusterCorrelation) -> None:
    """The same map as a surface. Args: axes: three-dimensional."""
    from matplotlib.ticker import MaxNLocator

    axes.patch.set_visible(False)  # it would hide the numbers beside it
    height, width = found.ncc.shape
    y, x = np.arange(height) - height // 2, np.arange(width) - width // 2
    scores = np.where(np.isfinite(found.ncc), found.ncc, 0.0)
    down, right = (-(-n // _MOST_LINES) for n in scores.shape)  # of each block the highest: no peak is lost
    scores = np.pad(scores, ((0, -height % down), (0, -width % right)))
    scores = scores.reshape(len(scores) // down, down, -1, right).max(axis=(1, 3))
    y, x = y[::down] + (down - 1) / 2, x[::right] + (right - 1) / 2
    if min(scores.shape) == 1:  # a line is no surface: put what is beyond it round it
        y, x, scores = _widened(y, down), _widened(x, right), np.pad(scores, 1)
    axes.plot_surface(*np.meshgrid(x, y), scores, cmap=_COLORMAP, rstride=1, cstride=1, linewidth=0, vmin=0)
    dy, dx = found.shift
    top = max(float(scores.max()), found.score, 0.1)
    axes.plot([dx, dx], [dy, dy], [found.score, 1.12 * top], color=_PEAK, linewidth=1.6, zorder=10)
    axes.plot([dx], [dy], [1.12 * top], "o", color=_PEAK, markersize=7, zorder=10)
    size = found.images.pixel_size
    axes.text(dx, dy, 1.18 * top, f"{_pair(dx * size, dy * size)} m", fontsize=12, color=_PEAK, ha="center")
    stretch = np.array([width, height]) / max(width, height)
    axes.set_box_aspect((*np.maximum(stretch, 0.45), 0.6), zoom=0.9)
    axes.set_zlim(0, 1.15 * top)
    axes.view_init(elev=32, azim=-62)
    axes.set_xlabel(f"shift in x, pixels of {size:g} m", fontsize=10, color=INK, labelpad=8)
    axes.set_ylabel(f"shift in y, pixels of {size:g} m", fontsize=10, color=INK, labelpad=8)
    axes.set_zlabel("score (NCC)", fontsize=10, color=INK, labelpad=4)
    axes.tick_params(labelsize=9, labelcolor=INK)
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_locator(MaxNLocator(5, integer=True))


def _widened(places: np.ndarray, step: int) -> np.ndarray:
    """One more place at each end."""
    return np.concatenate([places[:1] - step, places, places[-1:] + step])


def _pair(x: float, y: float) -> str:
    """Signed, to three digits."""
    return "({}, {})".format(*(f"{value:+.3g}" if abs(value) > 1e-9 else "0" for value in (x, y)))
