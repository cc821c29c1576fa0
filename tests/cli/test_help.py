"""What the command line says: help and its examples, wrong calls, completion, information, progress."""

from __future__ import annotations

import os
import re
import shlex
import shutil
import struct
import subprocess
import sys
from importlib import import_module, metadata
from pathlib import Path
from types import ModuleType
from typing import Any, Dict, List, Tuple

import pytest
import torch
from hydra import compose, initialize_config_module

import cflow_torch
from cflow_torch.cli import completion, info, settings
from cflow_torch.cli.arguments import for_hydra
from cflow_torch.cli.main import COMMANDS, HELP, main
from cflow_torch.fleet import progress
from cflow_torch.types import CFlowError

WITH_SETTINGS = [command for command in COMMANDS if settings.has_settings(command)]
MAIN = [sys.executable, "-m", "cflow_torch.cli.main"]
ANIMATION = ("first", "step", "count", "width", "frames_per_second", "max_flow")
ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(autouse=True)
def _same_argv(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "argv", list(sys.argv))


def run(*arguments: str) -> int:
    """Exit status of a command."""
    try:
        main(list(arguments))
    except SystemExit as stop:
        return int(stop.code or 0)
    return 0


# --- help


def examples(text: str) -> List[str]:
    """Commands of a help text, without what is said about them."""
    found = re.findall(r"^  (cflow .+?)(?:  .*)?$", text.partition("\nexamples:\n")[2], re.M)
    return [command for command in found if " ..." not in command]


def documented() -> List[Tuple[str, str]]:
    modules = {command: str(import_module(f"cflow_torch.cli.{command}").__doc__) for command in COMMANDS}
    return [(name, example) for name, text in {"cflow": HELP, **modules}.items() for example in examples(text)]


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_says_what_it_does_and_shows_how(command: str, capsys: pytest.CaptureFixture) -> None:
    assert run(command, "--help") == 0
    text = capsys.readouterr().out
    assert text.startswith(f"cflow {command}: {COMMANDS[command]}")
    shown = examples(text)
    assert 2 <= len(shown) <= 7
    assert all(example.startswith((f"cflow {command}", "cflow --")) for example in shown)
    assert max(len(line) for line in text.splitlines()) <= 120
    assert run("help", command) == 0
    assert capsys.readouterr().out == text


@pytest.mark.parametrize(("name", "example"), documented())
def test_every_setting_of_an_example_is_there(name: str, example: str) -> None:
    _, command, *rest = shlex.split(example)
    if command not in WITH_SETTINGS:
        return
    overrides = [word for word in rest if not word.startswith("-")]
    if "-m" in rest:  # the first value of each
        overrides = [re.sub(r"=([^\[(,]*),.*", r"=\1", word) for word in overrides]
    with initialize_config_module("cflow_torch.configs", version_base="1.3"):
        compose(command, overrides)


def test_the_version() -> None:
    done = subprocess.run([*MAIN, "--version"], capture_output=True, text=True, timeout=120)
    assert done.stdout == f"cflow_torch {cflow_torch.__version__}\n" and not done.returncode


# --- wrong calls


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["fliw"], "unknown command 'fliw' (did you mean flow?): give one of demo, flow,"),
        (["xyzzy"], "unknown command 'xyzzy': give one of"),
        (["eval", "modle=paper"], "unknown setting 'modle' (did you mean model?): `cflow eval --cfg job`"),
        (["eval", "model.pixel_size=2"], "unknown setting 'model.pixel_size' (did you mean model.pixel_sizes?)"),
        (["flow", "num_history=2"], "(did you mean model.num_history?)"),
        (["eval", "model=papr"], "model=papr (did you mean paper?): give one of default, fast, keypoints, paper"),
        (["flow", "engine=slurm"], "engine=slurm: give one of local, ray"),
        (
            ["eval", "-m", "hydra/launcher=joblob", "data.seed=1,2"],
            "pip install hydra-joblib-launcher hydra-submitit-launcher",
        ),
        (["eval", "data.root"], "'data.root' is no setting: give NAME=VALUE"),
        (["eval", "model.pixel_sizes=[0.2"], "cannot read 'model.pixel_sizes=[0.2'"),
        (["eval", "data.seed=1,2"], "add -m to run each, or write 'data.seed=[1,2]'"),
        (["eval", "--colour"], "`cflow eval --help` has examples"),
        (["demo", "pair=99", "data.num_sweeps=2"], "pair=99: the drive has 1 pairs, give 0 ... 0"),
        (["info", "all"], "info takes no settings, got all"),
        (["completion"], "one of bash, zsh, fish, got nothing"),
        (["completion", "tcsh"], "one of bash, zsh, fish, got tcsh"),
        (["plot", "cluster=3"], "setting 'cluster' belongs to picture=correlation: give that as well"),
        (["eval", "output=outputs/\u00fc"], "the inner ones for Hydra: 'output=\"outputs/\u00fc\"'"),
        (["eval", "model.pixel_sizes=[\u00fc]"], "write 'NAME=[A,B]' for a list"),
        (["eval", "data=av2", "data.root=7"], "7"),
        (["plot", "log=1e5", "data.num_sweeps=2"], "log=1e5: there is no such log"),
        (["plot", "pair=1.5"], "pair=1.5: give a whole number"),
        (["plot", "pair=true"], "pair=True: give a whole number"),
        (["plot", "max_flow=abc", "data.num_sweeps=2", "pair=0"], "max_flow=abc: give a number or null"),
        (["plot", "picture=correlation", "cluster=abc", "pair=0"], "cluster=abc: give a whole number or null"),
        *((["plot", "picture=animation", f"{key}=abc"], f"{key}=abc: give a") for key in ANIMATION),
        (["demo", "pair=abc"], "pair=abc: give a whole number"),
        (["demo", "data.seed=abc"], "data.seed=abc: give a whole number"),
        (["eval", "data.first=abc"], "data.first=abc: give a whole number"),
        (["bench", "repeats=abc"], "repeats=abc: give a whole number"),
        (["bench", "batches=[0]"], "batches=[0]: give a list of whole numbers"),
        (["flow", "contents=7"], "contents=[7]: give some of"),
        (["flow", "model.pixel_sizes.x=1"], "'x' is no place in a list: give all of it, 'NAME=[A,B]'"),
        (["eval", "++model.point_cloud_range.y.x=1"], "'y' is no place in a list"),
        (["flow", "contents.7=x"], "Error merging override contents.7=x (list index out of range)"),
        (["eval", "~model.point_cloud_range.0"], "`cflow eval --help` has examples"),
    ],
)
def test_a_wrong_call_gets_one_line_that_says_what_to_do(
    arguments: List[str], message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("HYDRA_FULL_ERROR", raising=False)
    assert run(*arguments) == 2
    error = capsys.readouterr().err
    assert message in error and "Traceback" not in error and "HYDRA_FULL_ERROR" not in error
    if "--colour" not in arguments:
        assert error.startswith("error: ") and error.count("\n") == 1
    assert "HYDRA_FULL_ERROR" not in os.environ, "left as it was"


@pytest.mark.parametrize("value", ["outputs/\u00fc", "a b\u00fc", 'it\'s "\u00fc"'])
def test_the_quotes_that_are_advised_do_what_they_should(value: str, capsys: pytest.CaptureFixture) -> None:
    assert run("eval", f"output={value}") == 2
    advised = capsys.readouterr().err.partition("the inner ones for Hydra: ")[2]
    with initialize_config_module("cflow_torch.configs", version_base="1.3"):
        assert compose("eval", shlex.split(advised)).output == value


@pytest.mark.parametrize("name", ["10203656353524179475_7625_000_7645_000", "1e5", "2024_11_22", "-1.5", "true", "a_1"])
def test_names_are_text_whatever_they_look_like(name: str) -> None:
    with initialize_config_module("cflow_torch.configs", version_base="1.3"):
        cfg = compose("plot", for_hydra([f"log={name}", f"output={name}", "pair=1"]))
        assert (cfg.log, cfg.output, cfg.pair) == (name, name, 1)
        assert compose("plot", for_hydra(["log=null"])).log is None
    assert for_hydra(["-m", "log=1_0,b,2_0", "pair=1,2"]) == ['log="1_0",b,"2_0"', "pair=1,2", "-m"]


def test_settings_may_stand_before_and_behind_options(capsys: pytest.CaptureFixture) -> None:
    assert run("eval", "model=fast", "--cfg", "job", "data.seed=7") == 0
    text = capsys.readouterr().out
    assert "seed: 7" in text and "num_history: 2" in text


def bench_that_raises(error: BaseException, monkeypatch: pytest.MonkeyPatch) -> None:
    module = ModuleType("cflow_torch.cli.bench")

    def task(cfg: Any) -> None:
        raise error

    module.task = task  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "cflow_torch.cli.bench", module)


def test_a_fault_of_ours_asks_for_a_report(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture) -> None:
    bench_that_raises(KeyError("of ours"), monkeypatch)
    assert run("bench") == 1
    error = capsys.readouterr().err
    assert "KeyError: 'of ours'" in error and "`cflow info`" in error
    assert "hydra" not in error.replace("test_help", "").lower(), "no frames of Hydra"
    monkeypatch.setenv("HYDRA_FULL_ERROR", "1")
    with pytest.raises(KeyError):
        main(["bench"])


def test_ctrl_c_is_one_line(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture) -> None:
    bench_that_raises(KeyboardInterrupt(), monkeypatch)
    assert run("bench") == 130
    assert capsys.readouterr().err == "stopped by Ctrl-C\n"


def test_a_place_that_cannot_be_used_is_no_fault_of_ours(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    monkeypatch.delenv("HYDRA_FULL_ERROR", raising=False)
    bench_that_raises(PermissionError(13, "Permission denied", "there"), monkeypatch)
    assert run("bench") == 2
    error = capsys.readouterr().err
    assert error.startswith("error: there: Permission denied; give places") and error.count("\n") == 1
    bench_that_raises(OSError("without a file"), monkeypatch)
    assert run("bench") == 1
    assert "this is a fault of cflow" in capsys.readouterr().err


def test_a_task_that_ends_in_another_process_has_said_why(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    import hydra

    # A launcher such as joblib's runs the tasks elsewhere, and raises here what they raised.
    monkeypatch.setattr(hydra, "main", lambda **settings: lambda task: lambda: sys.exit(2))
    assert run("bench") == 2
    assert capsys.readouterr().err == ""


@pytest.mark.skipif(sys.platform == "win32", reason="needs a POSIX shell")
@pytest.mark.parametrize("arguments", ["--help >&-", "eval --cfg job >&-", "--help 2>&-"])
def test_output_may_be_closed(arguments: str) -> None:
    command = f"{shlex.join(MAIN)} {arguments}"
    done = subprocess.run(["bash", "-c", command], capture_output=True, text=True, timeout=120)
    assert (done.stderr, done.returncode) == ("", 0)


@pytest.mark.skipif(sys.platform == "win32", reason="needs a POSIX shell")
def test_settings_that_nobody_reads_end_quietly() -> None:
    command = f"{shlex.join(MAIN)} eval --cfg job | true; echo status ${{PIPESTATUS[0]}}"
    done = subprocess.run(["bash", "-c", command], capture_output=True, text=True, timeout=120)
    assert (done.stderr, done.stdout) == ("", "status 141\n")


# --- completion


@pytest.mark.parametrize("command", WITH_SETTINGS)
def test_every_setting_that_is_offered_exists(command: str) -> None:
    with initialize_config_module("cflow_torch.configs", version_base="1.3"):
        cfg = compose(command)
        offered = completion.candidates(command)
        groups = settings.groups(command)
        for group, names in groups.items():
            for name in names:
                assert f"{group}={name}" in offered
        for key in [*cfg, *(f"model.{key}" for key in cfg.model), *(f"data.{key}" for key in cfg.data)]:
            assert key in groups or any(word.startswith((f"{key}=", f"{key}.")) for word in offered), key


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ("cflow ", {*COMMANDS, "--help", "--version"}),
        ("cflow ev", {"eval"}),
        ("cflow eval mod", {"model=", "model."}),
        ("cflow eval model=p", {"paper"}),
        ("cflow eval data=av2 data.ro", {"data.root="}),
        ("cflow eval -m experiment=sc", {"scales"}),
        ("cflow flow shard.", {"shard.index=", "shard.count="}),
        ("cflow flow engine=", {"local", "ray"}),
        ("cflow flow resume=", {"true", "false"}),
        ("cflow eval --c", {"--cfg"}),
        ("cflow completion ", {*completion.SHELLS, "--help"}),
        ("cflow view data.root=here/a", {"here/alpha"}),
        ("cflow view data.root=", {"here", "cflow.bash"}),
        ("cflow plot output=", {"here", "cflow.bash"}),
        ("cflow plot picture=", set(settings.choices("picture"))),
        ("cflow eval model=fast", {"fast"}),
        ("cflow fly ", set()),
    ],
)
@pytest.mark.skipif(sys.platform == "win32", reason="needs bash")
def test_bash_completes(line: str, expected: set, tmp_path: Path) -> None:
    (tmp_path / "cflow.bash").write_text(completion.script("bash"))
    (tmp_path / "here").mkdir()
    (tmp_path / "here" / "alpha").touch()
    shell = f"source ./cflow.bash; complete -p cflow >&2; COMP_LINE={shlex.quote(line)}; COMP_POINT=${{#COMP_LINE}}; "
    shell += "_cflow 2>/dev/null; printf '%s\\n' \"${COMPREPLY[@]}\""
    done = subprocess.run(["bash", "-c", shell], cwd=tmp_path, capture_output=True, text=True, timeout=60)
    assert done.stderr == "complete -F _cflow cflow\n" and not done.returncode
    assert set(done.stdout.split()) == expected


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ("cflow ev", {"eval"}),
        ("cflow view data.root=here/a", {"data.root=here/alpha"}),
        ("cflow view data.root=", {"data.root=here/", "data.root=cflow.fish"}),
        ("cflow plot picture=", {f"picture={name}" for name in settings.choices("picture")}),
        ("cflow eval model=fast", {"model=fast"}),
    ],
)
@pytest.mark.skipif(shutil.which("fish") is None, reason="no fish here")
def test_fish_completes(line: str, expected: set, tmp_path: Path) -> None:
    (tmp_path / "cflow.fish").write_text(completion.script("fish"))
    (tmp_path / "here").mkdir()
    (tmp_path / "here" / "alpha").touch()
    shell = f"source ./cflow.fish; complete -C {shlex.quote(line)}"
    done = subprocess.run(["fish", "-c", shell], cwd=tmp_path, capture_output=True, text=True, timeout=60)
    assert (done.stderr, done.returncode) == ("", 0)
    assert {word.partition("\t")[0] for word in done.stdout.splitlines()} == expected


@pytest.mark.parametrize("shell", completion.SHELLS)
def test_the_script_is_printed_and_has_no_fault(shell: str, tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    assert run("completion", shell) == 0
    text = capsys.readouterr().out
    assert "data=av2" in text and "model.pixel_sizes=" in text and "CASES" not in text and "COMMANDS" not in text
    (tmp_path / "script").write_text(text)
    try:
        done = subprocess.run([shell, "-n", str(tmp_path / "script")], capture_output=True, text=True, timeout=60)
    except FileNotFoundError:
        pytest.skip(f"no {shell} here")
    assert (done.returncode, done.stderr) == (0, "")


# --- information


def test_information_names_every_package_that_is_asked_for(capsys: pytest.CaptureFixture) -> None:
    assert run("info") == 0
    text = capsys.readouterr().out
    assert text.startswith(f"cflow_torch {cflow_torch.__version__}")
    assert f"torch {torch.__version__}, built for CUDA {torch.version.cuda}" in text
    for line in metadata.requires("cflow_torch") or []:
        name = re.split(r"[^\w.-]", line, maxsplit=1)[0].lower().replace("_", "-")
        if "extra" not in line or not re.search("extra == ['\"](test|dev|notebooks)", line):
            assert re.search(rf"^  {re.escape(name)} (\d|not installed)", text, re.M), name
    assert "CANNOT" not in text


def test_information_of_a_checkout_has_the_commit() -> None:
    if not (ROOT / ".git").exists():
        pytest.skip("no checkout")
    commit = subprocess.run(["git", "rev-parse", "HEAD"], cwd=ROOT, capture_output=True, text=True)
    if commit.returncode:
        pytest.skip("git does not answer")
    given = re.match(r" \(commit ([0-9a-f]+)", info._commit(ROOT))
    assert given and commit.stdout.startswith(given[1])
    assert info._commit(ROOT / "tests") == ""


def test_a_package_that_does_not_load_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "tqdm", None)
    assert re.match(r"tqdm [\d.]+ CANNOT BE IMPORTED: ModuleNotFoundError", info._state("tqdm"))
    assert info._state("no-such-thing") == "no-such-thing not installed"


# --- progress


class Clock:
    now = 0.0

    def __call__(self) -> float:
        return self.now


def lines_of(total: Any, seconds: List[float], capsys: pytest.CaptureFixture, **about: str) -> List[str]:
    clock = Clock()
    with progress.Progress(total, clock=clock, **about) as bar:
        for taken in seconds:
            clock.now += taken
            bar.update()
    return capsys.readouterr().err.splitlines()


def test_without_a_terminal_a_line_now_and_then(capsys: pytest.CaptureFixture) -> None:
    lines = lines_of(200, [0.5] * 100, capsys)
    assert lines == ["60 of 200 frames, 2.00 frames/s, 01:10 left"]
    slower = lines_of(2000, [0.5] * 60 + [5.0] * 6, capsys, name="log-a")
    assert slower[0].startswith("log-a: 60 of 2,000 frames, 2.00 frames/s")
    assert slower[1] == "log-a: 66 of 2,000 frames, 0.20 frames/s, 2:41:10 left", "the rate of the last while"
    assert lines_of(None, [31.0, 1.0], capsys) == ["1 frames, 0.03 frames/s"]


def test_short_runs_say_nothing(capsys: pytest.CaptureFixture) -> None:
    assert lines_of(5, [1.0] * 5, capsys) == []
    assert list(progress.frames("abc")) == ["a", "b", "c"]
    assert capsys.readouterr().err == ""


@pytest.mark.skipif(sys.platform == "win32", reason="needs a pseudo terminal")
@pytest.mark.parametrize("total", ["8", "None"])
def test_on_a_terminal_a_bar(total: str) -> None:
    import fcntl
    import pty
    import termios

    code = f"from cflow_torch.fleet.progress import Progress\nwith Progress({total}, 'x') as b: b.update(3)"
    ours, theirs = pty.openpty()
    fcntl.ioctl(theirs, termios.TIOCSWINSZ, struct.pack("4H", 24, 100, 0, 0))
    done = subprocess.run([sys.executable, "-c", code], stderr=theirs, timeout=120)
    os.close(theirs)
    shown = os.read(ours, 65536).decode()
    os.close(ours)
    assert not done.returncode
    assert "frames/s" in shown and ("3/8 frames" in shown if total == "8" else "3/3 frames" in shown)


def test_nothing_else_is_offered_than_there_is() -> None:
    known: Dict[str, Any] = settings.settings("flow")
    assert settings.near("model.conectivity", known) == " (did you mean model.connectivity?)"
    assert settings.near("zzzz", known) == ""
    with pytest.raises(CFlowError):
        completion.task(["bash", "zsh"])
