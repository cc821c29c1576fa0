"""A path is enough; your own reader by configuration only."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from small_logs import SMALL_LOGS, write_small_log

from cflow_torch.cli.commands import Flow
from cflow_torch.cli.words import hydra_overrides, split
from cflow_torch.data.catalog import DATA_SETS, recognise
from cflow_torch.data.flow_file import read_flow
from cflow_torch.types import CFlowError

NEAR = "model.point_cloud_range=[-20,-20,-inf,20,20,inf]"


@pytest.mark.parametrize("name", SMALL_LOGS)
def test_a_path_is_enough(name, tmp_path, cflow, capsys):
    root = write_small_log(name, tmp_path / "data")
    model = ("model=paper", "model.pixel_sizes=[0.4]", NEAR)
    call = ("flow", root, f"output={tmp_path / 'out'}", *model, "engine.workers=1", "data.check=false")
    assert cflow(*call) == 0
    assert f"{root}: data={name}\n" in capsys.readouterr().out
    files = list((tmp_path / "out").glob("*/*.feather"))
    assert files and all(read_flow(file).is_valid.any() for file in files)
    if name == "av2":  # the same run, whatever the format
        assert cflow(call[0], f"data={name}", f"data.root={root}", *call[2:]) == 0
        assert f"complete before  {len(files)}" in capsys.readouterr().out.replace("  complete", "complete")


def test_a_call_without_a_path_says_that_it_simulates(cflow, capsys):
    assert cflow("flow", "dry_run=true", "data.num_sweeps=2") == 0
    assert "so we simulate a drive: data=synthetic\n" in capsys.readouterr().out


def test_an_unknown_or_ambiguous_format_is_an_error(tmp_path):
    (tmp_path / "empty").mkdir()
    for place, message in (("absent", "no such file or folder"), ("empty", "it has no files")):
        with pytest.raises(CFlowError, match=message):
            recognise(tmp_path / place)
    (tmp_path / "both" / "a" / "sensors" / "lidar").mkdir(parents=True)
    (tmp_path / "both" / "b" / "lidar").mkdir(parents=True)
    (tmp_path / "both" / "b" / "lidar" / "x.parquet").touch()
    with pytest.raises(CFlowError, match="several formats fit, av2 and waymo"):
        recognise(tmp_path / "both")
    assert recognise(tmp_path / "both" / "b" / "lidar") == recognise(tmp_path / "both" / "b") == "waymo"
    (tmp_path / "both" / "x.h5").touch()
    assert recognise(tmp_path / "both") == recognise(tmp_path / "both" / "x.h5") == "hdf5", "what lies nearest"
    assert {name for name, one in DATA_SETS.items() if not one.marks} <= {"arrays", "kiss_icp"}


def test_a_path_by_itself_is_the_data_root():
    words = ["-m", "/a b/c", "model=paper,default", "--config-dir", "conf", "-p", "model"]
    call = split(words)
    assert call == (["model=paper,default"], ["/a b/c"], ["-m", "--config-dir", "conf", "-p", "model"])
    assert hydra_overrides(Flow, call) == ["model=paper,default", 'data.root="/a b/c"']
    call = split(["/a/date=2024-01-05", "./date=2024", "model=paper"])
    assert hydra_overrides(Flow, call)[1] == 'data.root=["/a/date=2024-01-05","./date=2024"]'


def test_a_name_with_an_equals_sign_that_exists_is_a_path(tmp_path, monkeypatch):
    (tmp_path / "date=2024").mkdir()
    monkeypatch.chdir(tmp_path)
    call = split(["date=2024", "date=2025", "date=*"])
    assert call.paths == ["date=2024"] and call.settings == ["date=2025", "date=*"]
    assert split(["d*"]).paths == ["date=2024"], "a pattern in quotes"


READER = """
import numpy as np
from cflow_torch.data.log import FlowLabels, Log
from cflow_torch.types import Sweep

class Mine(Log):
    def __init__(self, folder, speed):
        self.log_id, self.timestamps, self.speed = "mine", range(0, 300_000_000, 100_000_000), speed
        self.points = np.load(f"{folder}/car.npy")

    def sweep(self, index):
        moved = self.points + np.float32([0.1 * self.speed * index, 0, 0])
        return Sweep(moved, np.zeros(len(moved), bool), np.eye(4), self.timestamps[index])

    def labels(self, index):
        flow = np.zeros_like(self.points) + np.float32([0.1 * self.speed, 0, 0])
        return FlowLabels(flow, np.full(len(flow), 19, np.uint8), np.ones(len(flow), bool))

def several(folder, speed):
    logs = [Mine(folder, speed), Mine(folder, -speed)]
    logs[1].log_id = "back"
    return logs
"""


@pytest.fixture
def mine(tmp_path: Path) -> Path:
    """A user's folder with a reader, a data set that names it, and a file that it reads."""
    (tmp_path / "my" / "data").mkdir(parents=True)
    (tmp_path / "my" / "reader_of_mine.py").write_text(READER)
    text = f"_target_: reader_of_mine.several\nfolder: {tmp_path}\nspeed: 10.0\n"
    (tmp_path / "my" / "data" / "mine.yaml").write_text(text)
    car = 0.1 * np.stack(np.meshgrid(range(45), range(18), range(15)), -1).reshape(-1, 3) + 5.05
    np.save(tmp_path / "car.npy", car.astype(np.float32))
    return tmp_path


def test_your_own_reader_by_configuration_only(mine, cflow, capsys):
    pytest.importorskip("matplotlib")
    own = ("--config-dir", mine / "my", "data=mine", "data.speed=5", "model=paper", NEAR)
    assert cflow("check", *own) in (0, 1)
    assert re.search("^mine .*^back ", capsys.readouterr().out, re.MULTILINE | re.DOTALL)
    # A limit of its memory gives the worker a process of its own, which must find the reader, too.
    assert cflow("flow", *own, f"output={mine / 'flow'}", "engine.workers=1", "engine.memory=2e10") == 0
    for log, speed in (("mine", 0.5), ("back", -0.5)):
        assert np.allclose(read_flow(mine / "flow" / log / "0.feather").residual_flow[:, 0], speed)
    assert cflow("eval", *own, f"output={mine / 'eval'}", "data.step=2") == 2
    assert "use +data.step=2" in capsys.readouterr().err
    assert cflow("eval", *own, "modle=paper") == 2
    assert "(did you mean model=paper?)" in capsys.readouterr().err
    assert cflow("eval", *own, f"output={mine / 'eval'}", "+data.step=0") == 2
    assert "data.step=0: give a whole number of at least 1" in capsys.readouterr().err
    assert cflow("eval", *own, f"output={mine / 'eval'}", "+data.step=2") == 0
    record: Any = json.loads((mine / "eval" / "results.json").read_text())
    assert record["num_pairs"] == 2 and record["results"]["three_way"]["epe_fd"] < 1e-6
    assert record["data"]["label"] == "mine" and record["config"]["data"]["speed"] == 5
    assert cflow("plot", *own, f"output={mine / 'plot'}", "log=back") == 0
    assert (mine / "plot" / "flow.png").exists()
    assert cflow("plot", *own, f"output={mine / 'plot'}", "deskew=true") == 2
    assert "no times of points" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("_target_: reader_of_mine.Absent\n", "Absent"),
        (
            "_target_: reader_of_mine.several\nfolder: /no/such\nspeed: 1\n",
            "reader_of_mine.several fails: FileNotFoundError",
        ),
        ("_target_: builtins.list\n", "builtins.list returned no log"),
    ],
)
def test_a_broken_reader_is_one_line(text, message, mine, cflow, capsys):
    (mine / "my" / "data" / "mine.yaml").write_text(text)
    assert cflow("eval", "--config-dir", mine / "my", "data=mine", f"output={mine / 'out'}") == 2
    error = capsys.readouterr().err
    assert error.splitlines()[-1].startswith("error: ") and message in error
