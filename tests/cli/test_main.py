"""The command line itself: help, wrong calls, faults, closed outputs, completion, information."""

from __future__ import annotations

import os
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path
from types import ModuleType
from typing import Any, Callable

import hydra
import pytest

import cflow_torch
from cflow_torch.cli import completion, info
from cflow_torch.cli.choices import CONFIGS
from cflow_torch.cli.main import COMMANDS

Cflow = Callable[..., int]
MAIN = [sys.executable, "-m", "cflow_torch.cli.main"]
needs_posix = pytest.mark.skipif(sys.platform == "win32", reason="needs a POSIX shell")


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_says_what_it_does_and_shows_how(
    command: str, cflow: Cflow, capsys: pytest.CaptureFixture
) -> None:
    assert cflow(command, "--help") == 0
    text = capsys.readouterr().out
    assert text.startswith(f"cflow {command}: {COMMANDS[command]}") and f"\nexamples:\n  cflow {command}" in text
    if (CONFIGS / f"{command}.yaml").exists():
        assert "\n  output: outputs/" in text and "\n  model=default|fast|offline|paper|keypoints\n" in text
    assert cflow("help", command) == 0
    assert capsys.readouterr().out == text


def test_version_and_help_come_without_torch(cflow: Cflow, capsys: pytest.CaptureFixture) -> None:
    code = "import sys\nfrom cflow_torch.cli.main import main\nmain(['--version'])\nmain(['--help'])\n"
    code += "print([name for name in ('torch', 'numpy', 'hydra') if name in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120)
    lines = done.stdout.splitlines()
    assert lines[0] == f"cflow_torch {cflow_torch.__version__}" and lines[-1] == "[]", done.stderr
    assert all(f"  {command}" in done.stdout for command in COMMANDS)
    assert cflow() == 0 and capsys.readouterr().out.splitlines() == lines[1:-1]


# ---------------------------------------------------------------- wrong calls


@pytest.mark.parametrize(
    ("call", "message"),
    [
        ("fliw", "unknown command 'fliw' (did you mean flow?): give one of demo, flow,"),
        ("eval modle=paper", "unknown setting 'modle' (did you mean model?): `cflow eval --cfg job`"),
        ("flow num_history=2", "(did you mean model.num_history?)"),
        ("eval model=papr", "model=papr (did you mean paper?): give one of default, fast, keypoints, offline, paper"),
        ("eval -m hydra/launcher=joblob data.seed=1,2", "pip install hydra-joblib-launcher hydra-submitit-launcher"),
        ("eval model.pixel_sizes=[0.2", "cannot read 'model.pixel_sizes=[0.2'"),
        ("eval model.densify=nearest", "densify is a setting of method keypoints, not of verified"),
        ("eval model.method=dense", "is a setting of method verified"),
        ("eval model.num_history=-1", "num_history=-1: give a whole number of at least 0"),
        ("bench repeats=0", "repeats=0: give a whole number of at least 1"),
        ("bench batches=[0]", "batches=[0]: give whole numbers of at least 1"),
        ("eval data.step=0", "data.step=0: give a whole number of at least 1"),
        ("eval definition=mine data.num_sweeps=2", "mine"),
        ("demo pair=99 data.num_sweeps=2", "has pairs 0 to 0"),
        ("plot cluster=3", "setting 'cluster' belongs to picture=correlation: give that as well"),
        ("plot log=1e5 data.num_sweeps=2", "log=1e5: there is no such log"),
        ("plot pair=1.5", "pair=1.5: Value '1.5' of type 'float' could not be converted to Integer"),
        ("plot picture=animation width=abc", "width=abc: Value 'abc'"),
        ("flow data=av2", "where is the data? give data.root=PATH"),
        ("flow fast", "fast: there is no such file or folder; settings are NAME=VALUE"),
        ("flow data=av2 data.root=/no/such/folder", "/no/such/folder"),
        ("flow contents=[confidence] model=paper", "confidence is there with model=default and model=fast only"),
        ("completion", "one of bash, zsh, fish, got nothing"),
        ("clean standing=true", "setting 'standing' is now 'remove_stopped'"),
    ],
)
def test_a_wrong_call_gets_one_line_that_says_what_to_do(
    call: str, message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, cflow: Cflow, capsys: Any
) -> None:
    monkeypatch.chdir(tmp_path)
    assert cflow(*shlex.split(call)) == 2
    error = capsys.readouterr().err
    assert error.startswith("error: ") and error.count("\n") == 1 and message in error
    assert not list(tmp_path.rglob("*results.json")) + list(tmp_path.glob("outputs/flow/**/*.feather"))


def bench_that_raises(error: BaseException, monkeypatch: pytest.MonkeyPatch) -> None:
    module = ModuleType("cflow_torch.cli.bench")

    def task(cfg: Any) -> None:
        raise error

    module.task = task  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "cflow_torch.cli.bench", module)


@pytest.mark.parametrize("error", [KeyError("of ours"), OSError("of ours")])
def test_a_fault_of_ours_asks_for_a_report(
    error: Exception, monkeypatch: pytest.MonkeyPatch, cflow: Cflow, capsys: pytest.CaptureFixture
) -> None:
    bench_that_raises(error, monkeypatch)
    assert cflow("bench") == 1
    told = capsys.readouterr().err
    assert f"{type(error).__name__}: " in told and "of ours" in told and "`cflow info`" in told
    assert os.path.dirname(hydra.__file__) not in told, "no frames of Hydra"


def test_what_is_no_fault_of_ours_is_one_line(
    monkeypatch: pytest.MonkeyPatch, cflow: Cflow, capsys: pytest.CaptureFixture
) -> None:
    bench_that_raises(KeyboardInterrupt(), monkeypatch)
    assert cflow("bench") == 130 and capsys.readouterr().err == "stopped by Ctrl-C\n"
    bench_that_raises(PermissionError(13, "Permission denied", "there"), monkeypatch)
    assert cflow("bench") == 2
    error = capsys.readouterr().err
    assert error.startswith("error: there: Permission denied; give places") and error.count("\n") == 1
    # A launcher such as joblib's runs the tasks elsewhere, and raises here what they raised.
    monkeypatch.setattr(hydra, "main", lambda **settings: lambda task: lambda: sys.exit(2))
    assert cflow("bench") == 2 and capsys.readouterr().err == ""


@needs_posix
@pytest.mark.parametrize(
    ("arguments", "printed"),
    [
        ("--help >&-", "0"),
        ("--help 2>&-", "0"),
        ("--help | true", "141 0"),
        pytest.param("eval --cfg job | true", "141 0", marks=pytest.mark.slow),  # Hydra prints
        ("--version > /dev/full", "1"),
    ],
)
def test_output_may_be_closed_unread_or_full(arguments: str, printed: str) -> None:
    command = f'{shlex.join(MAIN)} {arguments}; echo "status ${{PIPESTATUS[*]}}" >&2'
    if "/dev/full" in arguments and not Path("/dev/full").exists():
        pytest.skip("no /dev/full on this system")
    done = subprocess.run(["bash", "-c", command], capture_output=True, text=True, timeout=120)
    told, status = done.stderr.split("status ")
    assert status == f"{printed}\n" and ("Errno 28" in told and told.count("\n") == 1 if printed == "1" else not told)


# ---------------------------------------------------------------- completion


LINES: dict[str, list[str]] = {
    "cflow ": [*COMMANDS, "--help", "--version"],
    "cflow eval mod": ["model=", "model."],
    "cflow eval model=p": ["paper"],
    "cflow eval data=av2 data.ro": ["data.root="],
    "cflow eval -m experiment=sc": ["scales"],
    "cflow flow shard.": ["shard.index=", "shard.count="],
    "cflow view data.root=here/a": ["here/alpha"],
    "cflow view data.root=": ["here/"],
    "cflow plot picture=": [file.stem for file in CONFIGS.glob("picture/*.yaml")],
}


@needs_posix
def test_bash_completes(tmp_path: Path, cflow: Cflow, capsys: pytest.CaptureFixture) -> None:
    assert cflow("completion", "bash") == 0
    (tmp_path / "here").mkdir()
    (tmp_path / "here" / "alpha").touch()
    shell = capsys.readouterr().out
    shell += 'ask() { COMP_LINE="$1"; COMP_POINT=${#1}; shift; COMP_WORDS=("$@"); COMP_CWORD=$(($# - 1)); _cflow\n'
    shell += 'echo "${COMPREPLY[*]}"; }\n'
    for line in LINES:
        shell += f"ask {shlex.quote(line)} {' '.join(shlex.quote(word) for word in line.split(' '))}\n"
    done = subprocess.run(["bash", "-c", shell], cwd=tmp_path, capture_output=True, text=True, timeout=60)
    assert not done.stderr and not done.returncode
    for (line, expected), offered in zip(LINES.items(), done.stdout.splitlines()):
        assert set(offered.split()) == set(expected), line


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_the_script_has_no_fault(shell: str, tmp_path: Path) -> None:
    text = completion.script(shell)
    assert "data=av2" in text and "model.pixel_sizes=" in text and "CASES" not in text and "COMMANDS" not in text
    if shutil.which(shell) is None:
        pytest.skip(f"no {shell} here")
    (tmp_path / "script").write_text(text)
    done = subprocess.run([shell, "-n", str(tmp_path / "script")], capture_output=True, text=True, timeout=60)
    assert (done.returncode, done.stderr) == (0, "")


# ---------------------------------------------------------------- information


def test_information_names_every_package_that_is_asked_for(
    monkeypatch: pytest.MonkeyPatch, cflow: Cflow, capsys: pytest.CaptureFixture
) -> None:
    imported: list[str] = []
    monkeypatch.setattr(info, "import_module", imported.append)  # loading all of them takes long
    assert cflow("info") == 0
    text = capsys.readouterr().out
    assert text.startswith(f"cflow_torch {cflow_torch.__version__} in ") and "\nPython version: " in text
    assert {"torch", "hydra", "yaml", "h5py"} <= set(imported)
    for name in ("torch", "pyyaml", "h5py", "hydra-submitit-launcher"):
        assert re.search(rf"^{name} (\d|not installed)", text, re.M), name
