"""Animations: flow pictures of several pairs with one view and one colour scale, saved as `.gif` or `.mp4`."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from subprocess import CalledProcessError
from typing import Any, Iterable, Iterator, Sequence

import numpy as np

from cflow_torch.data.atomic import atomic_name
from cflow_torch.errors import import_optional
from cflow_torch.types import Array, CFlowError, FlowResult, point_rows
from cflow_torch.viz.bev import longest_flow, plot_flow, split_sweep
from cflow_torch.viz.style import Figure, checked_path
from cflow_torch.viz.wheel import wheel_image

_SHORTEST = 2  # hundredths of a second; viewers slow down a .gif with shorter frames


@dataclass(frozen=True)
class AnimatedPair:
    """One pair of an animation."""

    points: Array  # (N, 3+), metres, ego frame of sweep t
    result: FlowResult  # flow of these points; only the residual flow and the clusters are drawn
    is_ground: Array | None = None  # (N,) bool; None = no point is ground
    title: str | None = None  # one line above the picture


def flow_figures(
    frames: Sequence[AnimatedPair],
    *,
    point_cloud_range: Sequence[float] | None = None,
    max_flow: float | None = None,
    legend: str = "upper right",
    width: int = 1000,
) -> Iterator[Figure]:
    """Draw each pair with `plot_flow`, all with the same view, colours and legend, for `save_animation`.

    Args:
        frames: at least one pair, in order.
        point_cloud_range, legend: as for `plot_flow`; open sides end where the points of all frames end.
        max_flow: residual flow at the rim of the colour wheel, metres per sweep; None = the longest of all frames.
        width: of a picture, pixels, 200 ... 4000.
    """
    if not 200 <= width <= 4000:
        raise CFlowError(f"width={width}: give 200 ... 4000 pixels")
    corners = []
    longest = []
    for frame in frames:
        view, position, _, drawn = split_sweep(frame.points, frame.is_ground, point_cloud_range)
        corners.append(view)
        longest.append(longest_flow(point_rows("residual flow", frame.result.residual_flow, len(position))[drawn]))
    if not corners:
        raise CFlowError("no pair: give at least one AnimatedPair")
    low = np.min(corners, axis=0)[0]
    high = np.max(corners, axis=0)[1]
    for frame in frames:
        figure = plot_flow(
            frame.points,
            frame.result,
            is_ground=frame.is_ground,
            point_cloud_range=(*low, *high),
            max_flow=max(longest) if max_flow is None else max_flow,
            title=frame.title,
            legend=legend,
        )
        figure.set_dpi(width / figure.get_figwidth())
        yield figure


def save_animation(figures: Iterable[Figure], path: str | Path, *, frames_per_second: float = 5.0) -> Path:
    """Save figures as an animation that repeats. The file appears complete or not at all.

    Args:
        figures: at least one, all of one size in pixels (inches times dpi) on an opaque background. They are drawn one
            at a time, so a generator needs the memory of one figure.
        path: ends in .gif or .mp4. Its folder is created if it does not exist; an older file is replaced.
        frames_per_second: pictures per second. A .gif counts in hundredths of a second and shows at most 50.

    Returns:
        The path.

    Convention:
        A .gif has 256 colours, chosen from the first picture and the colour wheel. All pictures share them, so static
        parts do not flicker. A .mp4 is H.264, yuv420p; its sides are rounded down to even numbers.

    Raises:
        CFlowError: there is no figure, sizes differ, the ending or the rate is not allowed, or a package is missing.
        OSError: the file cannot be written. An error of a generator of figures is passed on.

    Cost: memory of one byte per pixel and picture for a .gif, and of one picture for a .mp4.
    """
    path = checked_path(path, ".gif", ".mp4")
    if not 0 < frames_per_second < np.inf:
        raise CFlowError(f"frames_per_second={frames_per_second}: give a positive number")
    write = _write_gif if path.suffix.lower() == ".gif" else _write_mp4
    with atomic_name(path) as temporary:
        write(temporary, _of_one_size(figures), frames_per_second)
    return path


def _of_one_size(figures: Iterable[Figure]) -> Iterator[Figure]:
    """Give each figure a canvas, check that all have one size in pixels, and yield them."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    first = None
    for number, figure in enumerate(figures):
        size = FigureCanvasAgg(figure).get_width_height()
        first = first or size
        if size != first:
            raise CFlowError(f"picture {number} has {size} pixels, the first one {first}: give one size")
        yield figure
    if first is None:
        raise CFlowError("no picture: an animation needs at least one figure")


def _write_gif(path: Path, figures: Iterator[Figure], frames_per_second: float) -> None:
    from PIL import Image

    def draw(figure: Figure) -> Image.Image:
        figure.canvas.draw()
        return Image.fromarray(np.asarray(figure.canvas.buffer_rgba())[..., :3])  # type: ignore[attr-defined]

    pictures = map(draw, figures)
    first = next(pictures)
    wheel = Image.fromarray(wheel_image(min(first.size)))
    sample = Image.new("RGB", (first.width, first.height + wheel.height), "white")
    sample.paste(first)
    sample.paste(wheel, (0, first.height), wheel)
    # Median cut, Pillow's default, drops the colours of small moving objects.
    palette = sample.quantize(256, method=Image.Quantize.MAXCOVERAGE, kmeans=1)
    frames = [picture.quantize(palette=palette, dither=Image.Dither.NONE) for picture in chain([first], pictures)]
    duration = 10 * max(_SHORTEST, round(100 / frames_per_second))  # milliseconds
    frames[0].save(path, format="GIF", save_all=True, append_images=frames[1:], duration=duration, loop=0)


def _write_mp4(path: Path, figures: Iterator[Figure], frames_per_second: float) -> None:
    from matplotlib import rc_context
    from matplotlib.animation import FFMpegWriter

    need = ".mp4 needs imageio-ffmpeg (extra video): pip install imageio-ffmpeg, or save a .gif"
    imageio_ffmpeg = import_optional("imageio_ffmpeg", need)
    first = next(figures)
    options = "-pix_fmt yuv420p -crf 18 -movflags +faststart -f mp4"
    rate: Any = frames_per_second  # matplotlib declares it as an int
    writer = FFMpegWriter(rate, "h264", extra_args=options.split())
    program = rc_context({"animation.ffmpeg_path": imageio_ffmpeg.get_ffmpeg_exe()})
    try:
        with program, writer.saving(first, str(path), first.dpi):
            for figure in chain([first], figures):
                writer.fig = figure
                writer.grab_frame()
    except CalledProcessError as error:
        raise OSError(f"ffmpeg did not write the video: {error.stderr}") from error
