"""`cflow plot` draws every picture and `cflow view` shows a drive; a failure is reported and leaves no file."""

from __future__ import annotations

import re
import sys
from importlib.util import find_spec
from pathlib import Path
from typing import Callable

import command_line
import numpy as np
import pytest
from matplotlib.image import imread
from PIL import Image
from small_logs import make_small_drive

from cflow_torch import CFlowError
from cflow_torch.cli import plot as plot_command
from cflow_torch.cli import view as view_command
from cflow_torch.cli.stored_flow import method_of_flow
from cflow_torch.data.av2 import AV2Log
from cflow_torch.data.log import window
from cflow_torch.fleet.changes import nearest_preset
from cflow_torch.simulator.writers.av2 import write_av2_log
from cflow_torch.viz import page

NAME = "10203656353524179475_7625_000_7645_000"  # to Hydra, a number
SMALL = "model.point_cloud_range=[-20,-20,-inf,20,20,inf]"


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of one small simulated log: three pairs."""
    folder = tmp_path_factory.mktemp("drives")
    write_av2_log(make_small_drive(num_sweeps=4), folder).rename(folder / NAME)
    return folder


@pytest.fixture
def cflow(monkeypatch: pytest.MonkeyPatch, drive: Path, tmp_path: Path) -> Callable[..., int]:
    """A call of a command on that log, which writes to `out` and gives its exit status."""
    monkeypatch.chdir(tmp_path)
    given = ("data=av2", f"data.root={drive}", "data.check=false", f"output={tmp_path / 'out'}")
    return lambda command, *arguments: command_line.cflow(command, *given, *arguments)


@pytest.mark.parametrize("picture", ["flow", "clusters", "keypoints", "correlation", "scales"])
def test_every_picture(picture, cflow, tmp_path, capsys):
    model = ("model=paper",) if picture in ("flow", "clusters") else ()  # the others choose their own
    assert cflow("plot", f"picture={picture}", "pair=1", f"log={NAME}", *model, SMALL) == 0
    (file,) = (tmp_path / "out").iterdir()
    assert file.name == f"{picture}.png" and imread(str(file)).shape[1] in (1000, 1600, 1792)
    printed = capsys.readouterr().out
    assert f"log {NAME}, pair 1" in printed and f"picture: {file}" in printed


def test_truth_is_residual_and_only_where_it_is_known(cflow, drive, monkeypatch, capsys):
    seen = []

    def spy(*arguments: object, **settings: object) -> None:
        seen.append(settings["truth"])
        assert str(settings["title"]).endswith("preset paper"), "the picture names its method"
        raise CFlowError("seen")

    monkeypatch.setattr(plot_command, "plot_flow", spy)
    for truth in ("auto", "false"):
        assert cflow("plot", "pair=1", "model=paper", SMALL, f"truth={truth}") == 2
    assert seen[1] is None
    log = AV2Log(drive / NAME)
    labels, sweeps = log.labels(1), window(log, 1)
    transform = np.linalg.inv(sweeps.pc1.pose) @ sweeps.pc0.pose
    points = sweeps.pc0.points.astype(float)
    pose_flow = points @ transform[:3, :3].T + transform[:3, 3] - points
    expected = np.where(labels.is_valid[:, None], labels.flow - pose_flow, np.nan)
    assert np.allclose(seen[0], expected, atol=1e-4, equal_nan=True) and np.nanmax(np.abs(expected)) > 0.3
    monkeypatch.setattr(AV2Log, "labels", lambda self, index: None)
    assert cflow("plot", "pair=1", "model=paper", SMALL, "truth=true") == 2 and "truth=true" in capsys.readouterr().err


def test_an_animation_has_a_picture_for_every_pair(cflow, tmp_path, capsys):
    assert cflow("plot", "picture=animation", "model=paper", "width=300", "data.first=1", SMALL) == 0
    assert "2 pairs from 1 to 2" in capsys.readouterr().out
    with Image.open(tmp_path / "out" / "animation.gif") as gif:
        assert gif.n_frames == 2 and gif.size[0] == 300


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["pair=3"], "pair=3"),
        (["truth=perhaps"], "truth='perhaps'"),
        (["picture=keypoints", "model=paper"], "model=keypoints"),
        (["picture=correlation", "cluster=100000"], "cluster=100000"),
        (["picture=animation", "data.first=9"], "data.first=9"),
        (["picture=animation", "legend=middle", "count=1", "model=paper"], "legend"),
    ],
)
def test_a_picture_that_cannot_be_drawn_is_reported(arguments, message, cflow, tmp_path, capsys):
    assert cflow("plot", "pair=0", SMALL, *arguments) == 2
    error = capsys.readouterr().err
    assert message in error and "Traceback" not in error
    assert not [file for file in tmp_path.rglob("*") if file.is_file()]


def test_missing_matplotlib_is_reported_before_the_work(cflow, monkeypatch, capsys):
    for name in ("matplotlib", "matplotlib.figure", "matplotlib.backends.backend_agg"):
        monkeypatch.setitem(sys.modules, name, None)
    monkeypatch.setattr(plot_command, "find_log", lambda cfg: pytest.fail("work"))
    assert cflow("plot") == 2 and "pip install matplotlib" in capsys.readouterr().err


@pytest.fixture(scope="module")
def stored_flow(drive: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The flow of the log without its second pair."""
    folder = tmp_path_factory.mktemp("stored") / "flow"
    data = ("data=av2", f"data.root={drive}", "data.check=false", f"output={folder}")
    assert command_line.cflow("flow", *data, "model=paper", "engine.workers=1", SMALL) == 0
    sorted((folder / NAME).iterdir())[1].unlink()
    return folder


@pytest.mark.parametrize(("form", "package", "ending"), [("html", "k3d", "html"), ("rerun", "rerun", "rrd")])
def test_a_view_of_estimated_and_of_stored_flow(form, package, ending, stored_flow, cflow, tmp_path, capsys):
    pytest.importorskip(package)
    view = ("view", f"format={form}")
    assert cflow(*view, "model=paper", "data.step=2", "count=5", SMALL) == 0
    file = tmp_path / "out" / f"{NAME}.{ending}"
    assert f"{file}: 2 pairs" in capsys.readouterr().out and file.stat().st_size > 1e5
    file.unlink()
    assert cflow(*view, f"flow={stored_flow}", "device=no_such_device") == 1, "nothing is estimated"
    printed = capsys.readouterr()
    assert f"{file}: 2 pairs" in printed.out and "1 failed" in printed.err and file.is_file()
    assert nearest_preset(method_of_flow(stored_flow, NAME)) == "paper" and method_of_flow(tmp_path, NAME) is None
    if form == "html":
        assert '"preset":"paper"' in re.sub(r"\s", "", file.read_text(encoding="utf-8")), "the page names the method"
    assert cflow(*view, "flow=nowhere") == 2 and "flow=nowhere is not a folder" in capsys.readouterr().err


def test_a_view_that_cannot_be_made_is_reported_before_the_work(cflow, monkeypatch, capsys):
    monkeypatch.setattr(view_command, "open_logs", lambda cfg: pytest.fail("work"))
    assert cflow("view", "format=pdf") == 2 and "format='pdf': give one of 'html', 'rerun'" in capsys.readouterr().err
    if find_spec("k3d"):
        assert cflow("view", "voxel=0") == 2 and "voxel=0: give a number above 0" in capsys.readouterr().err
    monkeypatch.setattr(page, "find_spec", lambda name: None)
    assert cflow("view") == 2 and "pip install 'k3d>=3.2'" in capsys.readouterr().err
