"""Animations: every picture, its colours and its time are read back."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from matplotlib.figure import Figure
from PIL import Image

from cflow_torch.viz import flow_to_rgb, save_animation

NUM_HUES = 12
DIRECTIONS = np.stack([np.cos(a := np.arange(NUM_HUES) * 2 * np.pi / NUM_HUES), np.sin(a)], axis=-1)
HUES = flow_to_rgb(DIRECTIONS, 1.0)
RED, WALL = (255, 0, 0), (180, 187, 195)


def patch(color: tuple[int, ...], width: int = 200, height: int = 100, index: int = 0) -> Figure:
    """A white figure with a patch of 20 x 20 pixels of one colour, `index` patches from the left, above a wall."""
    figure = Figure(figsize=((width + 0.1) / 50, (height + 0.1) / 50), dpi=50, facecolor="white")
    image = np.full((height, width, 3), 255, np.uint8)
    image[10:30, 10 + 20 * index : 30 + 20 * index] = color
    image[-2:] = WALL
    figure.figimage(image, origin="upper")
    figure.text(0.1, 0.1, "street", color="black")
    return figure


def frames_of(path: Path) -> list[tuple[np.ndarray, int]]:
    """((H, W, 3) int, milliseconds) of each frame of a GIF."""
    frames = []
    with Image.open(path) as gif:
        assert gif.info["loop"] == 0, "for ever"
        for index in range(gif.n_frames):
            gif.seek(index)
            frames.append((np.asarray(gif.convert("RGB")).astype(int), gif.info["duration"]))
    return frames


def test_a_gif_has_every_picture_in_order_with_the_colours_of_the_wheel(tmp_path: Path) -> None:
    path = tmp_path / "new" / "hues.gif"
    figures = (patch(tuple(hue), 300, index=index) for index, hue in enumerate(HUES))
    assert save_animation(figures, path, frames_per_second=10) == path
    frames = frames_of(path)
    assert len(frames) == NUM_HUES and [file.name for file in path.parent.iterdir()] == ["hues.gif"]
    for index, (picture, duration) in enumerate(frames):
        assert duration == 100 and picture.shape == (100, 300, 3)
        left = 10 + 20 * index
        away = np.abs(picture[11:29, left + 1 : left + 19].mean(axis=(0, 1)) - HUES).max(axis=1)
        assert away.argmin() == index and away[index] < 32 < np.delete(away, index).min()
        assert np.delete(picture[:70], slice(left, left + 20), axis=1).min() > 252, "nothing is left of the one before"
        assert np.array_equal(picture[50:], frames[0][0][50:]), "static parts do not flicker"
    assert np.abs(frames[0][0][-2:] - WALL).max() < 12
    assert (frames[0][0][70:-2] < 100).any(), "the text is there"


@pytest.mark.parametrize(("width", "height"), [(200, 100), (201, 101)])
def test_a_video_has_every_picture(width: int, height: int, tmp_path: Path) -> None:
    ffmpeg = pytest.importorskip("imageio_ffmpeg")
    path = save_animation((patch(tuple(hue), width, height) for hue in HUES), tmp_path / "hues.mp4")
    reader = ffmpeg.read_frames(str(path))
    about = next(reader)
    assert about["codec"] == "h264" and about["pix_fmt"].startswith("yuv420p") and about["fps"] == 5
    assert about["size"] == (200, 100)
    frames = [np.frombuffer(f, np.uint8).reshape(100, 200, 3).astype(int) for f in reader]
    assert len(frames) == NUM_HUES
    for hue, frame in zip(HUES, frames):
        assert np.abs(frame[15:25, 15:25].mean(axis=(0, 1)) - hue).max() < 30
        assert frame[40:70].mean() > 250
