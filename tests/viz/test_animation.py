"""Animations: read back picture by picture, their colours and times, and what is left when one cannot be written."""

from __future__ import annotations

import gc
import sys
import weakref
from pathlib import Path
from typing import Iterator, Tuple

import numpy as np
import pytest

from cflow_torch import CFlowError
from cflow_torch.data import atomic
from cflow_torch.viz import flow_to_rgb, save_animation

pytest.importorskip("matplotlib")
from matplotlib.figure import Figure  # noqa: E402
from PIL import Image  # noqa: E402

NUM_HUES = 12
DIRECTIONS = np.stack([np.cos(a := np.arange(NUM_HUES) * 2 * np.pi / NUM_HUES), np.sin(a)], axis=-1)
HUES = flow_to_rgb(DIRECTIONS, 1.0)
WALL = (180, 187, 195)


def patch(color: Tuple[int, int, int], width: int = 200, height: int = 100, place: int = 0) -> Figure:
    """A white figure with a patch of 20 x 20 pixels of one colour, `place` patches from the left, above a wall."""
    figure = Figure(figsize=((width + 0.1) / 50, (height + 0.1) / 50), dpi=50, facecolor="white")
    image = np.full((height, width, 3), 255, np.uint8)
    image[10:30, 10 + 20 * place : 30 + 20 * place] = color
    image[-2:] = WALL
    figure.figimage(image, origin="upper")
    return figure


def frames_of(path: Path) -> Iterator[Tuple[np.ndarray, int]]:
    """((H, W, 3) uint8, milliseconds) of each frame of a GIF."""
    with Image.open(path) as gif:
        for index in range(gif.n_frames):
            gif.seek(index)
            yield np.asarray(gif.convert("RGB")), gif.info["duration"]


def test_a_gif_has_every_picture_in_order_with_the_colours_of_the_wheel(tmp_path: Path) -> None:
    path = tmp_path / "hues.gif"
    assert save_animation((patch(tuple(hue)) for hue in HUES), path) == path
    frames = list(frames_of(path))
    assert len(frames) == NUM_HUES
    for hue, (picture, duration) in zip(HUES, frames):
        assert duration == 200
        assert picture.shape == (100, 200, 3)
        assert np.abs(picture[11:29, 11:29].astype(int) - hue).max() <= 24  # neighbours on the wheel are farther apart
        assert (picture[40:-2] == 255).all(), "white stays white"
    with Image.open(path) as gif:
        assert gif.info["loop"] == 0, "for ever"


def test_what_moves_leaves_no_trace_and_what_stands_still_does_not_flicker(tmp_path: Path) -> None:
    def street() -> Iterator[Figure]:
        for place in range(4):
            figure = patch((255, 0, 0), place=place)
            figure.text(0.1, 0.1, "street", color="black")
            yield figure

    save_animation(street(), tmp_path / "a.gif", frames_per_second=10)
    pictures = [picture.astype(int) for picture, _ in frames_of(tmp_path / "a.gif")]
    for place, picture in enumerate(pictures):
        is_red = (picture[20, :, 0] > 200) & (picture[20, :, 1] < 60)
        assert np.flatnonzero(is_red).tolist() == list(range(10 + 20 * place, 30 + 20 * place))
        assert np.array_equal(picture[50:], pictures[0][50:])
    assert (pictures[0][-2:] == WALL).all(), "what is frequent, in its own colour"
    assert (pictures[0][50:-2] < 100).any(), "the text is there"
    assert np.median(pictures[0]) == 255, "and white is white"


def test_equal_pictures_keep_their_time(tmp_path: Path) -> None:
    save_animation([patch((255, 0, 0)), patch((255, 0, 0)), patch((0, 0, 255))], tmp_path / "a.gif")
    assert sum(duration for _, duration in frames_of(tmp_path / "a.gif")) == 600


@pytest.mark.parametrize(("rate", "duration"), [(3, 330), (50, 20), (0.5, 2000)])
def test_rates_are_rounded_to_what_a_gif_can_say(rate: float, duration: int, tmp_path: Path) -> None:
    save_animation([patch((255, 0, 0)), patch((0, 0, 255))], tmp_path / "a.gif", frames_per_second=rate)
    assert [d for _, d in frames_of(tmp_path / "a.gif")] == [duration, duration]


def test_figures_are_drawn_one_at_a_time(tmp_path: Path) -> None:
    alive = []

    def figures() -> Iterator[Figure]:
        for place in range(5):
            assert sum(seen() is not None for seen in alive) <= 1
            figure = patch((255, 0, 0), place=place)
            alive.append(weakref.ref(figure))
            yield figure
            figure = None
            gc.collect()

    save_animation(figures(), tmp_path / "a.gif")
    assert len(alive) == 5


@pytest.mark.parametrize("ending", [".gif", ".mp4"])
def test_a_picture_of_another_size_leaves_nothing(ending: str, tmp_path: Path) -> None:
    if ending == ".mp4":
        pytest.importorskip("imageio_ffmpeg")
    old = tmp_path / f"old{ending}"
    old.write_bytes(b"as it was")
    figures = [patch((255, 0, 0)), patch((255, 0, 0), width=220)]
    with pytest.raises(CFlowError, match="picture 1 is 220 x 100 pixels, the first one 200 x 100"):
        save_animation(figures, old)
    assert old.read_bytes() == b"as it was"
    assert [path.name for path in tmp_path.iterdir()] == [old.name]


@pytest.mark.parametrize(
    ("name", "rate", "message"),
    [
        ("a.avi", 5, "does not end in .gif or .mp4"),
        ("missing/a.gif", 5, "does not exist"),
        ("a.gif", 0, "frames_per_second=0"),
        ("a.gif", 60, "up to 50"),
        ("a.gif", float("nan"), "frames_per_second=nan"),
        ("a.mp4", float("inf"), "frames_per_second=inf"),
    ],
)
def test_a_wrong_call_says_how_to_mend_it(name: str, rate: float, message: str, tmp_path: Path) -> None:
    with pytest.raises(CFlowError, match=message):
        save_animation([patch((255, 0, 0))], tmp_path / name, frames_per_second=rate)
    assert not list(tmp_path.iterdir())


def test_no_picture_and_no_figure(tmp_path: Path) -> None:
    with pytest.raises(CFlowError, match="at least one"):
        save_animation([], tmp_path / "a.gif")
    with pytest.raises(CFlowError, match="picture 0 is a str"):
        save_animation(["a.png"], tmp_path / "a.gif")
    assert not list(tmp_path.iterdir())


def test_a_video_without_its_extra_says_what_to_install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    with pytest.raises(CFlowError, match="pip install imageio-ffmpeg"):
        save_animation([patch((255, 0, 0))], tmp_path / "a.mp4")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("error", [OSError("disk read"), RuntimeError("out of memory")])
@pytest.mark.parametrize("name", ["a.gif", "a.mp4"])
def test_what_a_generator_raises_keeps_its_name(name: str, error: Exception, tmp_path: Path) -> None:
    if name == "a.mp4":
        pytest.importorskip("imageio_ffmpeg")

    def figures() -> Iterator[Figure]:
        yield patch((255, 0, 0))
        raise error

    with pytest.raises(type(error)) as caught:
        save_animation(figures(), tmp_path / name)
    assert caught.value is error
    assert not list(tmp_path.iterdir())


def test_a_disk_that_is_full_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*paths: object) -> None:
        raise OSError("disk full")

    monkeypatch.setattr(atomic.os, "replace", full)
    with pytest.raises(CFlowError, match="cannot write .*a.gif: disk full"):
        save_animation([patch((255, 0, 0))], tmp_path / "a.gif")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(("width", "height"), [(200, 100), (201, 101)])
def test_a_video_has_every_picture(width: int, height: int, tmp_path: Path) -> None:
    ffmpeg = pytest.importorskip("imageio_ffmpeg")
    path = save_animation((patch(tuple(hue), width, height) for hue in HUES), tmp_path / "hues.mp4")
    reader = ffmpeg.read_frames(str(path))
    about = next(reader)
    assert about["codec"] == "h264" and about["pix_fmt"].startswith("yuv420p") and about["fps"] == 5
    assert about["size"] == (width + width % 2, height + height % 2)
    frames = [np.frombuffer(f, np.uint8).reshape(about["size"][1], about["size"][0], 3).astype(int) for f in reader]
    assert len(frames) == NUM_HUES
    for hue, frame in zip(HUES, frames):
        assert np.abs(frame[15:25, 15:25].mean(axis=(0, 1)) - hue).max() < 30
        assert frame[60:-4].mean() > 250
