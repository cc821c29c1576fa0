"""Pictures one after the other: `.gif` (pillow, which matplotlib brings) and `.mp4` (extra `video`)."""

from __future__ import annotations

import shutil
import tempfile
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any, Iterable, Iterator, Union

import numpy as np

from cflow_torch.data.atomic import atomic_file
from cflow_torch.types import CFlowError
from cflow_torch.viz.source import Source
from cflow_torch.viz.wheel import wheel_image

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_FASTEST_GIF = 50.0  # frames per second; viewers show shorter frames slowly
_WHEEL_SIDE = 64  # pixels; enough for every hue to count when the colours are chosen
_EXACT = 16  # the most frequent colours of the first picture, white among them, are kept as they are
_AT_ONCE = 16384  # colours whose nearest one is looked up together


def save_animation(figures: Iterable[Figure], path: Union[str, Path], *, frames_per_second: float = 5.0) -> Path:
    """Writes figures as an animation that begins anew at its end. The file appears complete or not at all.

    Args:
        figures: at least one, each of the same size in pixels (size in inches times dpi); drawn one at a time, so a
            generator needs the memory of one.
        path: ends in .gif or .mp4; its folder exists. An older file is replaced.
        frames_per_second: pictures per second, at most 50 in a .gif. A .gif counts in hundredths of a second.

    Returns:
        The path.

    Convention:
        A .gif has 256 colours: the most frequent ones of the first picture, and those that cover it and the wheel best.
        They are the same for all pictures, so that what stands still does not flicker.
        A .mp4 is H.264, yuv420p; an odd side gets one more white pixel.

    Raises:
        CFlowError: no figure, figures of several sizes, another ending, no such folder, a rate that cannot be, a
            folder that cannot be written to, or a missing package. What a generator of figures raises stays as it is.

    Cost: a .gif keeps one byte per pixel and picture until the end, a .mp4 nothing.
    """
    path = Path(path)
    ending = path.suffix.lower()
    if ending not in (".gif", ".mp4"):
        raise CFlowError(f"{path} does not end in .gif or .mp4: animations are written as one of these")
    if not path.parent.is_dir():
        raise CFlowError(f"the folder {path.parent} does not exist: make it first")
    fastest = _FASTEST_GIF if ending == ".gif" else np.inf
    if not 0 < frames_per_second <= fastest or frames_per_second == np.inf:
        limit = f" up to {fastest:g}" if ending == ".gif" else ""
        raise CFlowError(f"frames_per_second={frames_per_second}: give a positive number{limit}")
    write = _write_gif if ending == ".gif" else _write_mp4
    pictures = Source(_pictures(figures))
    try:
        with atomic_file(path) as file:
            write(file, pictures, frames_per_second)
    except OSError as error:
        if error is pictures.error:
            raise
        raise CFlowError(f"cannot write {path}: {error}") from error
    return path


def _pictures(figures: Iterable[Figure]) -> Iterator[np.ndarray]:
    """(H, W, 3) uint8 each, on white."""
    try:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure as FigureClass
    except ImportError as error:
        raise CFlowError("pictures need matplotlib: pip install matplotlib") from error

    size = None
    for number, figure in enumerate(figures):
        if not isinstance(figure, FigureClass):
            raise CFlowError(f"picture {number} is a {type(figure).__name__}: give matplotlib Figures")
        canvas = FigureCanvasAgg(figure)
        canvas.draw()
        rgba = np.asarray(canvas.buffer_rgba())
        height, width = rgba.shape[:2]
        size = size or (width, height)
        if (width, height) != size:
            raise CFlowError(
                f"picture {number} is {width} x {height} pixels, the first one {size[0]} x {size[1]}: "
                "give figures of one size (inches times dpi)"
            )
        alpha = rgba[..., 3:].astype(np.uint16)
        yield ((rgba[..., :3] * alpha + 255 * (255 - alpha) + 127) // 255).astype(np.uint8)
    if size is None:
        raise CFlowError("no picture: an animation needs at least one figure")


def _write_gif(file: IO[bytes], pictures: Iterator[np.ndarray], frames_per_second: float) -> None:
    from PIL import Image

    first = next(pictures)
    palette = _palette(first)

    def frames() -> Iterator[Any]:
        for picture in _then(first, pictures):
            frame = Image.fromarray(_nearest(picture, palette))
            frame.putpalette(palette.ravel().tolist())
            yield frame

    rest = frames()
    duration = 10 * max(2, round(100 / frames_per_second))  # milliseconds
    next(rest).save(
        file, format="GIF", save_all=True, append_images=rest, duration=duration, loop=0, optimize=True, disposal=1
    )


def _palette(picture: np.ndarray) -> np.ndarray:
    """(256, 3) uint8, at most: covers the picture and the whole wheel, since later pictures may show any flow."""
    from PIL import Image

    wheel = Image.fromarray(wheel_image(_WHEEL_SIDE))
    height, width = picture.shape[:2]
    sample = Image.new("RGB", (max(width, _WHEEL_SIDE), height + _WHEEL_SIDE), "white")
    sample.paste(Image.fromarray(picture), (0, 0))
    sample.paste(wheel, (0, height), wheel)
    # Median cut counts pixels and would drop the few of a small mover.
    covering = sample.quantize(256 - _EXACT, method=Image.Quantize.MAXCOVERAGE).getpalette() or []
    codes, counts = np.unique(_codes(picture), return_counts=True)
    frequent = _colors(codes[np.argsort(-counts, kind="stable")[:_EXACT]])
    return np.concatenate([frequent, np.array(covering[: 3 * (256 - _EXACT)], np.uint8).reshape(-1, 3)])


def _nearest(picture: np.ndarray, palette: np.ndarray) -> np.ndarray:
    """(H, W) uint8, row of the nearest palette colour; pillow's own search takes neighbours of an exact match."""
    codes, place = np.unique(_codes(picture), return_inverse=True)
    table = palette.astype(np.float32)
    rows = np.empty(len(codes), np.uint8)
    for start in range(0, len(codes), _AT_ONCE):
        colors = _colors(codes[start : start + _AT_ONCE]).astype(np.float32)
        rows[start : start + _AT_ONCE] = ((table**2).sum(axis=1) - 2 * colors @ table.T).argmin(axis=1)
    return rows[place].reshape(picture.shape[:2])


def _codes(picture: np.ndarray) -> np.ndarray:
    """(H * W,) int32, one number per colour."""
    return picture.reshape(-1, 3).astype(np.int32) @ np.array([1 << 16, 1 << 8, 1], np.int32)


def _colors(codes: np.ndarray) -> np.ndarray:
    """(K, 3) uint8 of such numbers."""
    return np.stack([codes >> 16, codes >> 8 & 255, codes & 255], axis=1).astype(np.uint8)


def _write_mp4(file: IO[bytes], pictures: Iterator[np.ndarray], frames_per_second: float) -> None:
    try:
        import imageio_ffmpeg
    except ImportError as error:
        raise CFlowError(".mp4 needs imageio-ffmpeg: pip install imageio-ffmpeg, or save a .gif") from error

    first = _even(next(pictures))
    with tempfile.TemporaryDirectory() as folder:  # ffmpeg wants a name, and goes back in the file at its end
        video = Path(folder) / "video.mp4"
        settings = ["-crf", "18", "-movflags", "+faststart"]
        writer = imageio_ffmpeg.write_frames(
            str(video),
            (first.shape[1], first.shape[0]),
            fps=frames_per_second,
            codec="libx264",
            pix_fmt_out="yuv420p",
            quality=None,
            macro_block_size=2,
            ffmpeg_log_level="error",
            output_params=settings,
        )
        try:
            try:
                writer.send(None)
            except RuntimeError as error:  # no ffmpeg for this machine
                raise CFlowError(f"no ffmpeg ({error}): name one in IMAGEIO_FFMPEG_EXE, or save a .gif") from error
            for picture in _then(first, map(_even, pictures)):
                writer.send(np.ascontiguousarray(picture))
        finally:
            writer.close()
        if not video.is_file() or not video.stat().st_size:
            raise CFlowError("ffmpeg wrote nothing: name another one in IMAGEIO_FFMPEG_EXE, or save a .gif")
        with open(video, "rb") as whole:
            shutil.copyfileobj(whole, file)


def _then(first: np.ndarray, rest: Iterable[np.ndarray]) -> Iterator[np.ndarray]:
    yield first
    yield from rest


def _even(picture: np.ndarray) -> np.ndarray:
    """With a white row or column more where a side is odd."""
    height, width = picture.shape[:2]
    return np.pad(picture, ((0, height % 2), (0, width % 2), (0, 0)), constant_values=255)
