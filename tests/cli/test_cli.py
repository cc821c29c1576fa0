"""The commands, run as a user runs them."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
import sys
from pathlib import Path

import cflow_torch.configs
import numpy as np
import pytest
import torch
from hydra import compose, initialize_config_module
from omegaconf import OmegaConf

from cflow_torch import CFlowError, CorrelationFlow, FlowResult, make_config, make_model
from cflow_torch.cli import run as command_run
from cflow_torch.cli.main import COMMANDS, main
from cflow_torch.config import PRESETS, Config
from cflow_torch.data.av2 import AV2Log
from cflow_torch.data.flow_file import read_flow, write_flow
from cflow_torch.data.log import window
from cflow_torch.simulator import make_drive
from cflow_torch.simulator.writers.av2 import write_av2_log

CONFIGS = Path(cflow_torch.configs.__file__).parent


@pytest.fixture(scope="module")
def log_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A small simulated log in Argoverse 2's format: three pairs."""
    return write_av2_log(make_drive(seed=3, num_sweeps=4), tmp_path_factory.mktemp("drive"))


@pytest.fixture(autouse=True)
def _same_argv(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "argv", list(sys.argv))


def run(*arguments: object) -> int:
    """Exit status of a command."""
    try:
        main([str(argument) for argument in arguments])
    except SystemExit as stop:
        return int(stop.code or 0)
    return 0


@pytest.mark.parametrize("file", sorted(CONFIGS.glob("model/*.yaml")), ids=lambda file: file.stem)
def test_every_model_yaml_is_its_preset(file: Path) -> None:
    settings = OmegaConf.to_container(OmegaConf.load(file))
    assert list(settings) == list(Config().as_dict()), "every tunable is listed, in order"
    assert Config(**settings) == make_config(file.stem)
    make_model(Config(**settings))


def test_every_preset_has_a_yaml() -> None:
    assert {file.stem for file in CONFIGS.glob("model/*.yaml")} == set(PRESETS)


@pytest.mark.parametrize("file", sorted(CONFIGS.glob("*.yaml")), ids=lambda file: file.stem)
def test_every_command_yaml_composes(file: Path) -> None:
    with initialize_config_module("cflow_torch.configs", version_base="1.3"):
        for data in (data.stem for data in CONFIGS.glob("data/*.yaml")):
            overrides = [] if file.stem == "hydra" else [f"data={data}"]
            cfg = compose(file.stem, overrides)
            assert file.stem == "hydra" or (file.stem in COMMANDS and cfg.data.label == data)


def test_demo_leaves_everything(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    assert run("demo", f"output={tmp_path}", f"data.cache={tmp_path}/log", "data.num_sweeps=3", "pair=1") == 0
    (log,) = (AV2Log(folder) for folder in (tmp_path / "log").glob("*/*/*"))
    assert sorted(int(f.stem) for f in (tmp_path / log.log_id).iterdir()) == list(log.timestamps[:-1])
    scores = json.loads((tmp_path / "results.json").read_text())
    assert scores["results"]["num_frames"] == 2 and scores["versions"]["cflow_torch"]
    assert 0 < scores["results"]["three_way"]["epe_fd"] < 2
    assert Config(**OmegaConf.load(tmp_path / "config.yaml").model) == make_config("default")
    assert (tmp_path / "flow.png").read_bytes().startswith(b"\x89PNG")
    printed = capsys.readouterr().out
    assert "flow.png" in printed and "CAR" in printed
    assert not list(tmp_path.rglob(".*")), "no temporary file is left"


def test_flow_files_hold_the_method_s_result(log_folder: Path, tmp_path: Path) -> None:
    assert run("flow", "data=av2", f"data.root={log_folder}", f"output={tmp_path}", "model=paper") == 0
    log = AV2Log(log_folder)
    for index in range(3):
        (expected,) = CorrelationFlow.from_preset("paper")([window(log, index)])
        stored = read_flow(tmp_path / log.log_id / f"{log.timestamps[index]}.feather")
        for name, values in expected.numpy().items():
            np.testing.assert_array_equal(stored.numpy()[name], values, err_msg=name)


def test_flow_goes_on_with_its_folder_and_refuses_another_run_s(
    log_folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    call = ("flow", "data=av2", f"data.root={log_folder}", f"output={tmp_path}", "model=paper", "engine.workers=1")
    assert run(*call) == 0
    assert run(*call) == 0
    assert re.search(r"complete before +3\n", capsys.readouterr().out)
    assert run(*call, "model.connectivity=4") == 2
    assert "overwrite=true" in capsys.readouterr().err
    assert run(*call, "model.connectivity=4", "overwrite=true") == 0


def test_a_bad_frame_is_reported_and_the_rest_goes_on(
    log_folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    broken = tmp_path / "log"
    shutil.copytree(log_folder, broken)
    sweeps = sorted((broken / "sensors" / "lidar").iterdir())
    sweeps[3].write_bytes(sweeps[3].read_bytes()[:1000])
    out = tmp_path / "out"
    assert run("flow", "data=av2", f"data.root={broken}", f"output={out}", "model=paper") == 1
    error = capsys.readouterr().err
    assert f"missing:\n  log/{sweeps[2].stem}" in error and sweeps[3].name in error
    assert sorted(f.stem for f in (out / "log").glob("*.feather")) == [s.stem for s in sweeps[:2]]


def test_a_bad_log_is_reported_and_the_rest_goes_on(
    log_folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    root = tmp_path / "root"
    shutil.copytree(log_folder, root / "good")
    shutil.copytree(log_folder, root / "no-poses")
    (root / "no-poses" / "city_SE3_egovehicle.feather").unlink()
    assert run("eval", "data=av2", f"data.root={root}", f"output={tmp_path / 'out'}", "model=paper") == 1
    assert "no-poses" in capsys.readouterr().err
    assert json.loads((tmp_path / "out" / "results.json").read_text())["results"]["num_frames"] == 3


def test_a_failure_ends_a_run_and_leaves_a_sweep_going(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(SystemExit, match="1"):
        command_run.finish([("a", "bad")])
    monkeypatch.setattr(command_run, "is_sweep", lambda: True)
    command_run.finish([])
    with pytest.raises(command_run.UnfinishedJob, match="1"):
        command_run.finish([("a", "bad")])


@pytest.mark.parametrize("command", ["demo", "eval", "bench"])
def test_an_output_that_cannot_be_made_is_named(
    command: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    monkeypatch.delenv("HYDRA_FULL_ERROR", raising=False)
    (tmp_path / "file").touch()
    quick = ["reference=false", "opencv=false", "hdbscan=false", "repeats=1", "batches=[1]", "num_threads=1"]
    call = [f"output={tmp_path}/file/below", f"data.cache={tmp_path}/cache", "data.num_sweeps=2", "model=paper"]
    pair = {"demo": ["pair=0"], "eval": [], "bench": quick}[command]
    assert run(command, *call, *pair) == 2
    error = capsys.readouterr().err
    assert f"error: cannot write into {tmp_path}/file/below" in error and "give output=FOLDER" in error
    assert "Traceback" not in error


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["flow", "data=av2"], "data.root"),
        (["flow", "data=av2", "data.root=/no/such/folder"], "/no/such/folder"),
        (["flow", "model.pixel_sizes=[0.1,0.2]"], "pixel_sizes"),
        (["flow", "model.method=keypoints"], "one pair of sweeps"),
        (["eval", "definition=mine"], "mine"),
        (["fly"], "fly"),
    ],
)
def test_a_wrong_call_says_how_to_mend_it(
    arguments: list, message: str, tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    extra = [f"output={tmp_path}"] if arguments != ["fly"] else []
    assert run(*arguments, *extra) == 2
    captured = capsys.readouterr()
    assert message in captured.err and "Traceback" not in captured.err
    assert not list(tmp_path.rglob("*.feather")), "nothing was written"


def test_help(capsys: pytest.CaptureFixture) -> None:
    assert run() == run("--help") == 0
    overview = capsys.readouterr().out
    for command in COMMANDS:
        assert command in overview
        assert run(command, "--help") == 0
        assert len(capsys.readouterr().out) > 50


def test_info(capsys: pytest.CaptureFixture) -> None:
    assert run("info") == 0
    assert f"torch {torch.__version__}" in capsys.readouterr().out


def test_a_foreign_file_is_no_flow_file(tmp_path: Path) -> None:
    zeros = torch.zeros(5, 3)
    cluster, score, valid = torch.full((5,), -1), torch.zeros(5), torch.zeros(5, dtype=torch.bool)
    write_flow(tmp_path / "a.feather", FlowResult(zeros, zeros, zeros, cluster, score, valid))
    assert torch.equal(read_flow(tmp_path / "a.feather").cluster_id, cluster)
    whole = (tmp_path / "a.feather").read_bytes()
    (tmp_path / "b.feather").write_bytes(whole[: len(whole) // 2])
    (tmp_path / "c.feather").write_bytes(b"")
    for name in ("b", "c", "missing"):
        with pytest.raises(CFlowError, match=f"{name}.feather"):
            read_flow(tmp_path / f"{name}.feather")


@pytest.mark.skipif(sys.platform == "win32", reason="needs a POSIX shell")
def test_output_that_nobody_reads_ends_quietly() -> None:
    command = f"{sys.executable} -m cflow_torch.cli.main --help | true; echo status ${{PIPESTATUS[0]}}"
    done = subprocess.run(["bash", "-c", command], capture_output=True, text=True, timeout=120)
    assert (done.stderr, done.stdout) == ("", "status 141\n")
