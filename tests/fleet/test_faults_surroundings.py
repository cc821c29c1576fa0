"""Clocks that jump, closed outputs, odd names and rights: the work goes on, or one line says why not."""

from __future__ import annotations

import os
import shutil
import stat
import subprocess
import sys
import time
from pathlib import Path
from typing import Any, Dict, List, Tuple

import pytest
from small_fleet import PAIRS, flow, report, tree, write_fleet

from cflow_torch.cli import main as command_line
from cflow_torch.fleet import progress
from cflow_torch.fleet.progress import Progress, say

LEAP = "CFLOW_TEST_LEAP"
# A clock that jumps with every look at it, and back; in every process that Python starts.
SITE = """
import os, time
if os.environ.get("CFLOW_TEST_LEAP"):
    real, looks = time.time, []
    def jumping():
        looks.append(0)
        return real() + float(os.environ["CFLOW_TEST_LEAP"]) * (len(looks) % 3 - 1)
    time.time = jumping
"""


@pytest.fixture(scope="module")
def fleet(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Logs of 2 and 3 pairs."""
    return write_fleet(tmp_path_factory.mktemp("fleet"))


@pytest.fixture(scope="module")
def single(fleet: Path, tmp_path_factory: pytest.TempPathFactory) -> Dict[str, bytes]:
    """What an undisturbed run leaves."""
    output = tmp_path_factory.mktemp("single")
    assert flow(fleet, output, "engine.batch=1") == 0
    return tree(output)


def flow_process(
    root: Path, output: Path, *more: str, stdout: Any = subprocess.PIPE, **environ: str
) -> Tuple[int, str]:
    """Status and errors of `cflow flow` in a process of its own."""
    settings = ["data=av2", f"data.root={root}", f"output={output}", "model=paper", "model.pixel_sizes=[0.4]"]
    command = [sys.executable, "-m", "cflow_torch.cli.main", "flow", *settings, "data.check=false", *more]
    done = subprocess.run(
        command, env={**os.environ, "OMP_NUM_THREADS": "1", **environ}, stdout=stdout, stderr=subprocess.PIPE
    )
    return done.returncode, done.stderr.decode(errors="replace")


# Clocks


@pytest.mark.parametrize("leap", [-365.0, pytest.param(1.0, marks=pytest.mark.slow)])
def test_the_clock_on_the_wall_does_not_matter(
    fleet: Path, single: Dict[str, bytes], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, leap: float
) -> None:
    real, looks = time.time, []
    monkeypatch.setattr(time, "time", lambda: looks.append(0) or real() + (len(looks) % 3 - 1) * leap * 86400)
    assert flow(fleet, tmp_path) == 0
    assert tree(tmp_path) == single and 0 < report(tmp_path)["seconds"] < 600
    for number, file in enumerate(sorted(tmp_path.rglob("*.*"))):  # files of tomorrow, and of 1970
        os.utime(file, (0, 0) if number % 2 else (real() + 86400, real() + 86400))
    next(tmp_path.glob("*/*.feather")).unlink()
    assert flow(fleet, tmp_path) == 0
    assert report(tmp_path)["frames"]["complete_before"] == PAIRS - 1 and tree(tmp_path) == single


@pytest.mark.slow
@pytest.mark.parametrize("engine", ["local", "ray"])
def test_the_clock_on_the_wall_does_not_matter_to_workers(
    fleet: Path, single: Dict[str, bytes], tmp_path: Path, engine: str
) -> None:
    if engine == "ray":
        pytest.importorskip("ray.data", reason="needs the extra ray")
    (tmp_path / "site").mkdir()
    (tmp_path / "site" / "sitecustomize.py").write_text(SITE)
    path = os.pathsep.join([str(tmp_path / "site"), os.environ.get("PYTHONPATH", "")])
    more = (f"engine={engine}", "engine.workers=2")
    status, told = flow_process(fleet, tmp_path / "out", *more, PYTHONPATH=path, **{LEAP: "86400"})
    assert status == 0, told
    assert tree(tmp_path / "out") == single


# What is printed


class Gone:
    """A terminal that was closed."""

    def write(self, text: str) -> int:
        raise OSError(5, "Input/output error")

    def flush(self) -> None:
        raise OSError(5, "Input/output error")

    def isatty(self) -> bool:
        return True

    def fileno(self) -> int:
        raise OSError(5, "Input/output error")


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")  # tqdm's, of a bar that never was
def test_work_goes_on_if_nobody_hears(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(progress, "EVERY", -1.0)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "stderr", Gone())
        say("a frame failed")
        with Progress(3) as bar:
            bar.update(2)
            bar._bar.disable = True
            bar.update(1)
    assert bar.done == 3


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no /dev/full on this system")
def test_an_output_that_is_full_is_one_line(
    fleet: Path,
    single: Dict[str, bytes],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture,
) -> None:
    with monkeypatch.context() as patch, open("/dev/full", "w") as full:
        patch.setattr(sys, "stdout", full)
        assert flow(fleet, tmp_path) == 1
    told = capsys.readouterr().err
    assert told.count("\n") == 1 and "error: [Errno 28]" in told
    assert tree(tmp_path) == single


@pytest.mark.slow
def test_a_reader_that_left_ends_a_command_without_a_word(
    fleet: Path, single: Dict[str, bytes], tmp_path: Path
) -> None:
    ours, theirs = os.pipe()
    os.close(ours)
    status, told = flow_process(fleet, tmp_path, "engine.workers=1", stdout=theirs)
    os.close(theirs)
    assert (status, told) == (141, "")
    assert tree(tmp_path) == single


def test_a_pipe_that_is_not_our_output_is_an_error(
    fleet: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture
) -> None:
    """A program that a reader talks to has died, say."""

    def broken(*_: Any) -> None:
        raise BrokenPipeError(32, "Broken pipe")

    monkeypatch.setattr("cflow_torch.cli.flow.find_logs", broken)
    assert flow(fleet, tmp_path) == (1 if hasattr(__import__("select"), "poll") else 141)
    assert "Broken pipe" in capfd.readouterr().err
    assert command_line._is_unread() is False


# Names and rights


def test_names_in_other_letters(fleet: Path, single: Dict[str, bytes], tmp_path: Path) -> None:
    root, out = tmp_path / "Straße 東京", tmp_path / "Ausgänge"
    source = sorted(fleet.iterdir())[0]
    shutil.copytree(source, root / "lög ☃")
    assert flow(root, out) == 0
    frames = {name for name in tree(out) if name.endswith(".feather")}
    assert frames and all(tree(out)[n] == single[f"{source.name}/{Path(n).name}"] for n in frames)
    assert "東京" in (out / "config.yaml").read_text(encoding="utf-8")


@pytest.mark.slow
@pytest.mark.parametrize("more", [{}, {"PYTHONCOERCECLOCALE": "0", "PYTHONUTF8": "0"}], ids=["C", "ASCII"])
def test_no_locale(fleet: Path, single: Dict[str, bytes], tmp_path: Path, more: Dict[str, str]) -> None:
    root = tmp_path / "root"
    shutil.copytree(fleet, root)
    first, second = sorted(root.iterdir())
    second.rename(root / "lög")
    status, told = flow_process(root, tmp_path / "out", "engine.workers=1", LC_ALL="C", **more)
    done = {name.split("/")[0] for name in tree(tmp_path / "out") if name.endswith(".feather")}
    assert first.name in done and "Traceback" not in told
    assert (status, len(done)) in ([(0, 2)] if not more else [(0, 2), (1, 1)]), told


@pytest.mark.slow
@pytest.mark.skipif(os.name != "posix", reason="names are bytes on POSIX only")
def test_a_name_that_is_no_text_costs_its_log_only(
    fleet: Path, single: Dict[str, bytes], tmp_path: Path, capfd: pytest.CaptureFixture
) -> None:
    root = tmp_path / "root"
    shutil.copytree(fleet, root)
    try:
        os.rename(os.fsencode(sorted(root.iterdir())[1]), os.fsencode(root) + b"/log-\xff")
    except OSError:
        pytest.skip("this file system takes text only")
    assert flow(root, tmp_path / "out") == 1
    told = capfd.readouterr().err
    assert "failed: log-" in told and "Traceback" not in told
    assert report(tmp_path / "out")["frames"]["failed_logs"] == 1
    assert tree(tmp_path / "out").items() <= single.items()


@pytest.mark.slow
def test_names_that_are_too_long_are_told(fleet: Path, tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    assert flow(fleet, tmp_path / ("long" * 70)) == 2
    assert "File name too long" in capsys.readouterr().err
    deep = tmp_path.joinpath(*["deep" * 50] * 25)
    assert flow(fleet, deep) == 2
    assert "File name too long" in capsys.readouterr().err


@pytest.mark.slow
@pytest.mark.skipif(os.name != "posix", reason="no umask")
def test_files_have_the_rights_of_the_umask(fleet: Path, tmp_path: Path) -> None:
    before = os.umask(0o027)
    try:
        assert flow(fleet, tmp_path / "out") == 0
    finally:
        os.umask(before)
    modes: Dict[bool, List[int]] = {True: [], False: []}
    for path in (tmp_path / "out").rglob("*"):
        modes[path.is_dir()].append(stat.S_IMODE(path.stat().st_mode))
    assert set(modes[True]) == {0o750} and set(modes[False]) == {0o640}


@pytest.mark.skipif(not hasattr(os, "geteuid") or os.geteuid() != 0, reason="only root can become nobody")
@pytest.mark.slow
def test_a_folder_of_somebody_else(fleet: Path, tmp_path: Path) -> None:
    """Rights do not bind root, so a child becomes nobody."""
    out = tmp_path / "out"
    out.mkdir(mode=0o755)
    code = (
        "import os, sys; os.setgid(65534); os.setuid(65534)\n"
        "from cflow_torch.data.atomic import ready_folder\n"
        "from cflow_torch.types import CFlowError\n"
        "try: ready_folder(sys.argv[1])\n"
        "except CFlowError as error: print(error)\n"
    )
    for folder in [*tmp_path.parents, tmp_path]:
        if folder.owner() == "root" and str(folder).startswith(str(tmp_path.parents[1])):
            folder.chmod(0o755)
    done = subprocess.run([sys.executable, "-c", code, str(out)], capture_output=True, text=True)
    if "PermissionError" in done.stderr or "ModuleNotFoundError" in done.stderr:
        pytest.skip("nobody cannot read the package here")
    assert f"cannot write into {out}" in done.stdout and "Permission denied" in done.stdout, done
