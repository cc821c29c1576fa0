"""Every data set by name: simulated, written in its own format, found, opened, scored through the command line."""

from __future__ import annotations

import inspect
import json
import warnings
from importlib import import_module
from pathlib import Path
from typing import Any, Dict

import cflow_torch.configs
import numpy as np
import pytest
import yaml

from cflow_torch.cli.main import main
from cflow_torch.cli.run import _NOT_THE_READERS
from cflow_torch.data import catalog
from cflow_torch.data.arrays.writer import write_array_log
from cflow_torch.data.catalog import DATA_SETS, find_sources, open_log
from cflow_torch.data.found_ground import GroundFoundLog
from cflow_torch.data.static_check import StaticWorldWarning
from cflow_torch.simulator import make_drive
from cflow_torch.simulator.benchmark import FORMATS
from cflow_torch.types import CFlowError

CONFIGS = Path(cflow_torch.configs.__file__).parent
OF_OPEN_LOG = {"find_ground", "odometry", "check"}


@pytest.fixture(scope="module")
def arrays(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A simulated drive as a folder of .npy files without ground masks."""
    folder = write_array_log(make_drive(seed=3, num_sweeps=3, profile="demo"), tmp_path_factory.mktemp("arrays"))
    for file in (folder / "ground").iterdir():
        file.unlink()
    (folder / "ground").rmdir()
    return folder


@pytest.mark.parametrize("name", DATA_SETS)
def test_every_data_set_has_a_config_whose_settings_its_reader_takes(name: str) -> None:
    settings: Dict[str, Any] = yaml.safe_load((CONFIGS / "data" / f"{name}.yaml").read_text())
    reader = getattr(import_module(f"cflow_torch.data.{DATA_SETS[name].module}"), DATA_SETS[name].log)
    ours = set(settings) - set(_NOT_THE_READERS)
    assert ours >= OF_OPEN_LOG
    parameters = inspect.signature(reader).parameters
    assert ours - OF_OPEN_LOG <= set(parameters)
    for key in ours - OF_OPEN_LOG:
        default = parameters[key].default
        assert settings[key] == (list(default) if isinstance(default, tuple) else default), f"{name}: {key}"


@pytest.mark.parametrize("profile", FORMATS)
@pytest.mark.slow
def test_a_simulated_drive_of_every_sensor_is_scored_from_its_own_format(profile: str, tmp_path: Path) -> None:
    main(
        [
            *("eval", "data=benchmark_sensors", f"data.profile={profile}", f"data.cache={tmp_path}", "model=paper"),
            *("data.num_drives=1", "data.num_sweeps=4", "data.first=1", f"output={tmp_path / 'out'}"),
        ]
    )
    record = json.loads((tmp_path / "out" / "results.json").read_text())
    assert record["num_pairs"] >= 2 and not record["failures"]
    moving, standing = record["results"]["three_way"]["epe_fd"], record["results"]["three_way"]["epe_bs"]
    assert moving < 0.9 and standing < 0.2, "most of what moves is found, and what stands still stays"


def test_ground_is_found_where_there_is_no_mask(arrays: Path) -> None:
    (source,) = find_sources("arrays", arrays)
    assert open_log("arrays", source).sweep(0).is_ground is None
    log = open_log("arrays", source, find_ground="grid")
    truth = make_drive(seed=3, num_sweeps=3, profile="demo").sweep(1)
    found = log.sweep(1).is_ground
    assert isinstance(log, GroundFoundLog) and found is not None and found.dtype == np.bool_
    assert (found & truth.is_ground).sum() / (found | truth.is_ground).sum() > 0.9
    assert log.labels(0) is None and log.eval_mask(0) is None and list(log.timestamps) == list(log.log.timestamps)


def test_a_mask_that_is_there_is_kept() -> None:
    drive = make_drive(seed=3, num_sweeps=2, profile="demo")
    np.testing.assert_array_equal(GroundFoundLog(drive).sweep(0).is_ground, drive.sweep(0).is_ground)


def test_the_command_line_takes_a_readers_settings(arrays: Path, tmp_path: Path) -> None:
    call = ["flow", "data=arrays", f"data.root={arrays}", "model=paper", "data.find_ground=grid"]
    main([*call, f"output={tmp_path / 'out'}"])
    assert len(list((tmp_path / "out").rglob("*.feather"))) == 2


def test_a_world_that_moves_is_warned_about(arrays: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (source,) = find_sources("arrays", arrays)
    calls = []
    monkeypatch.setattr(catalog, "check_log", calls.append)
    open_log("arrays", source)
    open_log("arrays", source, check=False)
    assert len(calls) == 1
    with warnings.catch_warnings():
        warnings.simplefilter("error", StaticWorldWarning)
        monkeypatch.undo()
        open_log("arrays", source)  # a good log: no warning


@pytest.mark.parametrize(
    "name, settings, complaint",
    [
        ("kitti", {}, "one of av2, hdf5"),
        ("arrays", {"clouds": "raw"}, "no setting clouds; it has poses"),
        ("arrays", {"find_ground": "magic"}, "find_ground='magic'"),
    ],
)
def test_wrong_calls(arrays: Path, name: str, settings: Dict[str, Any], complaint: str) -> None:
    with pytest.raises(CFlowError, match=complaint):
        open_log(name, arrays, **settings)


def test_nothing_of_the_format_there(tmp_path: Path) -> None:
    for name in DATA_SETS:
        with pytest.raises(CFlowError, match=r"no |none|there is"):
            find_sources(name, tmp_path)
