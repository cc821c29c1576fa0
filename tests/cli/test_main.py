"""The command line itself: help, wrong calls, bugs, pipes, information."""

from __future__ import annotations

import os
import shlex
import subprocess
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import hydra
import pytest

import cflow_torch
from cflow_torch.cli.commands import COMMANDS, WITH_SETTINGS

MAIN = [sys.executable, "-m", "cflow_torch.cli.main"]
needs_posix = pytest.mark.skipif(sys.platform == "win32", reason="needs a POSIX shell")


@pytest.mark.parametrize("command", COMMANDS)
def test_help_explains_a_command_with_examples_and_settings(command, cflow, capsys):
    assert cflow(command, "--help") == 0
    text = capsys.readouterr().out
    assert (
        text.startswith(f"cflow {command}: {COMMANDS[command].SUMMARY}") and f"\nexamples:\n  cflow {command}" in text
    )
    if command in WITH_SETTINGS:
        assert "\n  output: outputs/" in text and "\n  model=default|offline|live|paper|keypoints|" in text
    assert cflow("help", command) == 0
    assert capsys.readouterr().out == text


# Mistakes that are found without torch, then the others.
CHEAP = (
    ("fliw", "unknown command 'fliw' (did you mean flow?): give one of demo, check, flow,"),
    ("eval modle=paper", "unknown setting 'modle' (did you mean model=paper?): `cflow eval --cfg job`"),
    ("flow num_history=2", "(did you mean model.num_history?)"),
    (
        "eval model=papr",
        "model=papr (did you mean paper?): give one of default, keypoints, live, offline, paper, paper_keypoints",
    ),
    (
        "eval model.densify=nearest",
        "setting 'model.densify' belongs to model=keypoints or model=paper_keypoints: give that as well",
    ),
    ("flow range=51.2", "unknown setting 'range' (did you mean model.point_cloud_range?)"),
    ("flow preset=live", "unknown setting 'preset' (did you mean model=live?)"),
    ("flow model.pixel_sizes=0.2", "give a list of numbers: side s of a BEV pixel"),
    ("eval -m model.num_history=0,-1", "num_history=-1: give a whole number of at least 0"),
    ("eval model.num_history=0,1", "for a run with each of them (a sweep), add -m"),
    ("eval model=null", "model=null: give one of default, keypoints, live,"),
    ("eval model.num_history=-1", "num_history=-1: give a whole number of at least 0"),
    ("plot cluster=3", "setting 'cluster' belongs to picture=correlation or picture=scales: give that as well"),
    ("flow data=av2", "the data is missing: give data.root=PATH"),
    ("plot data=av2 data.root=null", "the data is missing: give data.root=PATH"),
    ("flow data.root=[]", "the data is missing: give data.root=PATH"),
    ("flow shard=null", "shard=None: give its settings, shard.NAME=VALUE"),
    ("flow paper", "paper: there is no such file or folder; settings are NAME=VALUE"),
    ("flow data=av2 data.root=/no/such/folder", "/no/such/folder"),
    ("info --full", "info takes nothing, got --full"),
    ("eval -m model=default,papr", "model=papr (did you mean paper?)"),
    ("eval model.num_history=1.5", "num_history=1.5: give a whole number of at least 0"),
    ("eval --bogus", "unknown option '--bogus'"),
    ("eval -m hydra/launcher=joblib data.seed=1,2", "pip install hydra-joblib-launcher hydra-submitit-launcher"),
    ("eval model.pixel_sizes=[0.2", "cannot read 'model.pixel_sizes=[0.2'"),
    ("eval model.method=dense", "is a setting of method verified"),
    ("eval data.step=0", "data.step=0: give a whole number of at least 1"),
    ("flow data.first=6", "data.first is for cflow eval, cflow view and cflow plot picture=animation: leave it out"),
    ("plot data.first=1", "data.first is for cflow eval, cflow view and cflow plot picture=animation"),
    (
        "plot picture=correlation deskew=true",
        "setting 'deskew' belongs to picture=clusters or picture=flow: give that as well",
    ),
    ("eval overwrite=maybe", "overwrite='maybe': give True or False"),
    ("bench batches=[0]", "batches=0: give a whole number of at least 1"),
    ("plot picture=animation width=abc", "width='abc': give a whole number of at least 1"),
    ("plot truth=maybe", "truth='maybe': give one of True, False, 'auto'"),
    ("view format=pdf", "format='pdf': give one of 'html', 'rerun'"),
    ("flow shard.index=one shard.count=3", "shard.index='one': give a whole number of at least 0"),
    ("stream count=1", "count=1: give a whole number of at least 2"),
    ("flow engine.workers=0", "engine.workers=0: give a whole number of at least 1"),
    ("flow engine.memory=true", "engine.memory=True: give a number above 0"),
    ("eval +model.thorough=1", "unknown setting thorough: the fields are method"),
)
OTHERS = (
    ("submit version=1 masks=none data.num_sweeps=2", "none"),
    ("eval definition=mine data.num_sweeps=2", "mine"),
    ("demo pair=99 data.num_sweeps=2", "has pairs 0 to 0"),
    ("plot log=1e5 data.num_sweeps=2", "log=1e5: there is no such log"),
    ("flow contents=[confidence] model=paper", "only model=default, offline and live have a confidence"),
)


@pytest.mark.parametrize(("call", "message"), OTHERS)
def test_a_wrong_call_is_one_line_with_a_hint(call, message, tmp_path, monkeypatch, cflow, capsys):
    monkeypatch.chdir(tmp_path)
    assert cflow(*shlex.split(call)) == 2
    error = capsys.readouterr().err
    assert error.startswith("error: ") and error.count("\n") == 1 and message in error
    assert_nothing_was_computed(tmp_path)


def assert_nothing_was_computed(folder: Path) -> None:
    assert not list(folder.rglob("*results.json")) + list(folder.glob("outputs/flow/**/*.feather"))


def test_help_comes_without_torch_and_hydra_and_wrong_calls_without_torch(tmp_path, cflow, capsys):
    """Wrong names and values are told without Hydra, which takes most of a second."""
    first = [(c, message) for c, message in CHEAP if "=" in c and ("give a" in message or "did you mean" in message)]
    then = [wrong for wrong in CHEAP if wrong not in first]
    assert len(first) > 10
    code = f"""
import sys
from cflow_torch.cli.main import main
for call in ("--version", "--help", "eval --help", "help clean", "settings", "settings data", "info"):
    main(call.split())
heavy = {{"torch", "numpy", "kornia", "pyarrow"}}
from command_line import cflow
for call in {[call for call, _ in first]}:
    assert cflow(*call.split()) == 2, call
    assert not {{*heavy, "hydra", "omegaconf"}} & set(sys.modules), call
for call in {[call for call, _ in then]}:
    assert cflow(*call.split()) == 2, call
    assert not heavy & set(sys.modules), (call, heavy & set(sys.modules))
"""
    path = {"env": {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}, "cwd": tmp_path}
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120, **path)
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith(f"cflow_torch {cflow_torch.__version__}\n")
    assert_nothing_was_computed(tmp_path)
    errors = done.stderr.splitlines()
    assert len(errors) == len(CHEAP), "one line each"
    for error, (call, message) in zip(errors, [*first, *then]):
        assert error.startswith("error: ") and message in error, call
    assert cflow() == 0
    text = capsys.readouterr().out
    assert all(f"  {command}" in text for command in COMMANDS)


def bench_that_raises(error: BaseException, monkeypatch: pytest.MonkeyPatch) -> None:
    module = ModuleType("cflow_torch.cli.bench")

    def task(cfg: Any) -> None:
        raise error

    module.task = task  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "cflow_torch.cli.bench", module)


@pytest.mark.parametrize("error", [KeyError("ours"), OSError("ours")])
def test_a_bug_asks_for_a_report(error, monkeypatch, cflow, capsys):
    bench_that_raises(error, monkeypatch)
    assert cflow("bench") == 1
    error_text = capsys.readouterr().err
    assert f"{type(error).__name__}: " in error_text and "ours" in error_text and "`cflow info`" in error_text
    assert os.path.dirname(hydra.__file__) not in error_text, "no frames of Hydra"


def test_ctrl_c_and_a_refused_file_are_one_line(monkeypatch, cflow, capsys):
    bench_that_raises(KeyboardInterrupt(), monkeypatch)
    assert cflow("bench") == 130 and capsys.readouterr().err == "stopped by Ctrl-C\n"
    bench_that_raises(PermissionError(13, "Permission denied", "there"), monkeypatch)
    assert cflow("bench") == 2
    error = capsys.readouterr().err
    assert error.startswith("error: there: Permission denied; check data.root=") and error.count("\n") == 1
    # A launcher such as joblib's runs tasks in other processes and raises their errors here.
    monkeypatch.setattr(hydra, "main", lambda **settings: lambda task: lambda: sys.exit(2))
    assert cflow("bench") == 2 and capsys.readouterr().err == ""


@needs_posix
# What the first call prints is ours, and what the second one prints is Hydra's.
@pytest.mark.parametrize("arguments", ["--help", pytest.param("eval --cfg job", marks=pytest.mark.slow)])
def test_a_reader_that_leaves_ends_a_command_quietly(arguments):
    command = f"{shlex.join(MAIN)} {arguments} | true; echo ${{PIPESTATUS[*]}}"
    done = subprocess.run(["bash", "-c", command], capture_output=True, text=True, timeout=120)
    assert (done.stdout, done.stderr) == ("141 0\n", "")


def test_info_lists_every_required_package(cflow, capsys):
    assert cflow("info") == 0
    *lines, missing = capsys.readouterr().out.splitlines()
    assert lines[0].startswith(f"cflow_torch {cflow_torch.__version__} in ") and missing.startswith("not installed: ")
    for name in ("torch", "PyYAML", "h5py", "hydra-submitit-launcher"):
        assert any(line.startswith(f"{name} ") for line in lines) != (name in missing.split(": ")[1].split(", ")), name
    assert any(line.startswith("Python 3") for line in lines) and any(line.startswith("processor ") for line in lines)
