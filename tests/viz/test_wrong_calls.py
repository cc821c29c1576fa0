"""Writers of pictures: a wrong call is one clear error, and after a failure the file is as it was."""

from __future__ import annotations

import sys
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Callable

import numpy as np
import pytest
from matplotlib.figure import Figure
from toy_street import Street, result_of

from cflow_torch import CFlowError, FlowResult
from cflow_torch.data.log import FlowLabels, window
from cflow_torch.viz import (
    flow_figures,
    flow_to_rgb,
    page,
    plot_flow,
    record_log,
    save_animation,
    save_page,
    save_picture,
    show,
)

ONE, OTHER = Figure(figsize=(2, 1), dpi=50), Figure(figsize=(2.2, 1), dpi=50)
SHORT = FlowResult(*[values[:7] for values in result_of()._given().values()])
WINDOW = window(Street(), 0)
OTHER_LABELS = FlowLabels(np.zeros((7, 3), np.float32), np.zeros(7, np.uint8), np.ones(7, bool))


def failing(value: Any) -> Any:
    yield value
    raise CFlowError("a bad sweep")


def plot(**changed: Any) -> Figure:
    return plot_flow(**{"points": np.zeros((5, 3)), "result_or_residual": np.zeros((5, 3)), **changed})


CALLS: dict[str, list[tuple[Callable[[Path], Any], str]]] = {
    "k3d": [
        (lambda folder: save_page(Street(), [], folder / "a.htm"), "does not end in .html"),
        (lambda folder: save_page(Street(), [], folder / "a.html"), "there is no pair to show"),
        (lambda folder: save_page(Street(), [], folder / "a.html", voxel=0), "voxel=0"),
        (lambda folder: show([WINDOW] * 2, [result_of()]), "2 windows, 1 results, 2 labels"),
        (lambda folder: show(WINDOW, result_of(), labels=OTHER_LABELS), "labels has shape .7, 3.: give .51"),
        (lambda folder: show(WINDOW, result_of(), tracks={}), "tracks lack id, sweep, .* `cflow_torch.track`"),
    ],
    "rerun": [
        (lambda folder: record_log(Street(), [], folder / "a.bag"), "does not end in .rrd"),
        (lambda folder: record_log(Street(), [(0, result_of())], folder / "a.rrd", max_flow=0), "max_flow=0"),
        (lambda folder: record_log(Street(), [], folder / "a.rrd"), "no pair to record"),
        (lambda folder: record_log(Street(), failing((0, result_of())), folder / "a.rrd"), "a bad sweep"),
        (
            lambda folder: record_log(Street(), [(0, SHORT)], folder / "a.rrd"),
            "pair 0: the flow has 7 rows, its sweep 51 points",
        ),
    ],
    "imageio_ffmpeg": [
        (lambda folder: save_animation([ONE, OTHER], folder / "a.mp4"), "picture 1 has .110, 50. pixels, the first"),
        (lambda folder: save_animation(failing(ONE), folder / "a.mp4"), "a bad sweep"),
    ],
    "matplotlib": [
        (lambda folder: save_animation([ONE, OTHER], folder / "a.gif"), "picture 1 has .110, 50. pixels, the first"),
        (lambda folder: save_animation(failing(ONE), folder / "a.gif"), "a bad sweep"),
        (lambda folder: save_animation([ONE], folder / "a.avi"), "does not end in .gif or .mp4"),
        (lambda folder: save_animation([ONE], folder / "a.gif", frames_per_second=np.nan), "frames_per_second=nan"),
        (lambda folder: save_animation([], folder / "a.gif"), "at least one"),
        (lambda folder: save_picture(ONE, folder / "a.pdf"), r"does not end in \.png"),
        (lambda folder: plot(points=np.zeros((5, 2))), "points has shape"),
        (lambda folder: plot(result_or_residual=np.zeros((4, 3))), "residual flow has shape"),
        (lambda folder: plot(result_or_residual=result_of()), "residual flow has shape .51, 3.: give .5, 3."),
        (lambda folder: plot(points=WINDOW.pc0), "points is Sweep: give an array .N, 3., such as sweep.points"),
        (lambda folder: next(flow_figures([])), "no pair: give at least one AnimatedPair"),
        (lambda folder: flow_to_rgb(np.zeros((5, 1))), "flow has shape .5, 1.: give .* x and y first"),
        (lambda folder: plot(max_flow=-1.0), "max_flow"),
        (lambda folder: plot(legend="middle"), "upper right"),
        (lambda folder: plot(point_cloud_range=(0, 0, 1, 1)), "point_cloud_range"),
    ],
}


@pytest.mark.parametrize("package", CALLS)
def test_a_wrong_call_says_how_to_fix_it_and_changes_no_file(package: str, tmp_path: Path) -> None:
    if find_spec(package) is None:
        pytest.skip(f"needs {package}")
    files = [tmp_path / f"a.{ending}" for ending in ("html", "rrd", "mp4", "gif")]
    for file in files:
        file.write_bytes(b"as it was")
    for call, message in CALLS[package]:
        with pytest.raises(CFlowError, match=message):
            call(tmp_path)
    assert sorted(tmp_path.iterdir()) == sorted(files), "no temporary file is left"
    assert {file.read_bytes() for file in files} == {b"as it was"}


def test_a_missing_package_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(page, "find_spec", lambda name: None)
    for package in ("rerun", "imageio_ffmpeg"):
        monkeypatch.setitem(sys.modules, package, None)
    for call, fix in (
        (lambda: save_page(Street(), [], tmp_path / "a.html"), "pip install 'k3d>=3.2'"),
        (lambda: record_log(Street(), [], tmp_path / "a.rrd"), "pip install 'rerun-sdk>=0.23'"),
        (lambda: save_animation([ONE], tmp_path / "a.mp4"), "pip install imageio-ffmpeg"),
    ):
        with pytest.raises(CFlowError, match=fix):
            call()
    assert not list(tmp_path.iterdir())
