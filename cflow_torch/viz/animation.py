"""Pictures one after the other: `.gif` (Pillow, which matplotlib brings) and `.mp4` (extra `video`)."""

from __future__ import annotations

from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Iterable, Iterator

import numpy as np

from cflow_torch.data.atomic import atomic_name
from cflow_torch.types import CFlowError
from cflow_torch.viz.wheel import wheel_image

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from PIL.Image import Image as Picture

_SHORTEST = 2  # hundredths of a second; viewers show shorter frames of a .gif slowly
_WHEEL_SIDE = 200  # pixels


def save_animation(figures: Iterable[Figure], path: str | Path, *, frames_per_second: float = 5.0) -> Path:
    """Writes figures as an animation that begins anew at its end. The file appears complete or not at all.

    Args:
        figures: at least one, each of the same size in pixels (size in inches times dpi) on an opaque background;
            drawn one at a time, so a generator needs the memory of one.
        path: ends in .gif or .mp4; its folder is made if absent. An older file is replaced.
        frames_per_second: pictures per second. A .gif counts in hundredths of a second and shows at most 50.

    Returns:
        The path.

    Convention:
        A .gif has 256 colours, which cover the first picture and the wheel. They are the same for all pictures, so that
        what stands still does not flicker.
        A .mp4 is H.264, yuv420p; an odd side gets one more white pixel.

    Raises:
        CFlowError: no figure, figures of several sizes, another ending, a rate that cannot be, or a missing package.
        OSError: the file cannot be written. What a generator of figures raises stays as it is, too.

    Cost: a .gif keeps one byte per pixel and picture until the end, a .mp4 nothing.
    """
    path = Path(path)
    if not 0 < frames_per_second < np.inf:
        raise CFlowError(f"frames_per_second={frames_per_second}: give a positive number")
    if path.suffix.lower() not in (".gif", ".mp4"):
        raise CFlowError(f"{path} does not end in .gif or .mp4: give a file that does")
    write = _write_gif if path.suffix.lower() == ".gif" else _write_mp4
    with atomic_name(path) as temporary:
        write(temporary, _pictures(figures), frames_per_second)
    return path


def _pictures(figures: Iterable[Figure]) -> Iterator[Picture]:
    """RGB images."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from PIL import Image

    size = None
    for number, figure in enumerate(figures):
        canvas = FigureCanvasAgg(figure)
        canvas.draw()
        picture = Image.fromarray(np.asarray(canvas.buffer_rgba())[..., :3])
        size = size or picture.size
        if picture.size != size:
            raise CFlowError(f"picture {number} has {picture.size} pixels, the first one {size}: give one size")
        yield picture
    if size is None:
        raise CFlowError("no picture: an animation needs at least one figure")


def _write_gif(path: Path, pictures: Iterator[Picture], frames_per_second: float) -> None:
    from PIL import Image

    palette, frames = None, []
    for picture in pictures:
        palette = palette or _palette(picture)
        frames.append(picture.quantize(palette=palette, dither=Image.Dither.NONE))
    duration = 10 * max(_SHORTEST, round(100 / frames_per_second))  # milliseconds
    frames[0].save(
        path,
        format="GIF",
        save_all=True,
        append_images=frames[1:],
        duration=duration,
        loop=0,
        optimize=True,
        disposal=1,
    )


def _palette(picture: Picture) -> Picture:
    """An image with 256 colours for all pictures: those of the first one and of the wheel, for any flow to come."""
    from PIL import Image

    wheel = Image.fromarray(wheel_image(_WHEEL_SIDE))
    sample = Image.new("RGB", (max(picture.width, _WHEEL_SIDE), picture.height + _WHEEL_SIDE), "white")
    sample.paste(picture, (0, 0))
    sample.paste(wheel, (0, picture.height), wheel)
    # Median cut counts pixels and would drop the few of a small mover. A round of k-means moves each colour into the
    # middle of those that it stands for.
    return sample.quantize(256, method=Image.Quantize.MAXCOVERAGE, kmeans=1)


def _write_mp4(path: Path, pictures: Iterator[Picture], frames_per_second: float) -> None:
    try:
        import imageio_ffmpeg
    except ImportError as error:
        raise CFlowError(".mp4 needs imageio-ffmpeg: pip install imageio-ffmpeg, or save a .gif") from error

    first = next(pictures)
    even = "pad=ceil(iw/2)*2:ceil(ih/2)*2:color=white"  # yuv420p holds colours of two by two pixels
    writer = imageio_ffmpeg.write_frames(
        str(path),
        first.size,
        fps=frames_per_second,
        codec="libx264",
        pix_fmt_out="yuv420p",
        quality=None,
        macro_block_size=1,
        ffmpeg_log_level="error",
        output_params=["-vf", even, "-crf", "18", "-movflags", "+faststart", "-f", "mp4"],
    )
    try:
        writer.send(None)
        for picture in chain([first], pictures):
            writer.send(picture.tobytes())
    finally:
        writer.close()
