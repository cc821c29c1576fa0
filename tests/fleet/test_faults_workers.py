"""Workers that die in every way, again and again: no other log is lost, the run ends, and says what it could not do."""

from __future__ import annotations

import os
import resource
import shutil
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import Any, Dict, List, Optional

import pytest
from small_fleet import PAIRS, flow, tree, write_fleet

from cflow_torch import CFlowError, make_config
from cflow_torch.data.av2 import AV2Log
from cflow_torch.fleet import local, local_worker
from cflow_torch.fleet.deaths import Deaths
from cflow_torch.fleet.job import Done, Failed, Job, Unit, split
from cflow_torch.fleet.line import Line
from cflow_torch.fleet.local import run_local
from cflow_torch.fleet.machine import Layout
from cflow_torch.fleet.stop import SIGNALS, StopSignal
from cflow_torch.fleet.tally import Tally
from cflow_torch.fleet.work import Worker

HOW = "CFLOW_TEST_HOW"  # workers die: a name of `DEATHS`
WHERE = "CFLOW_TEST_WHERE"  # on the log of this name
TWO = Layout(("cpu", "cpu"), 1, 2)
REAL_SERVE = local_worker.serve


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


def make_job(output: Path, **settings: Any) -> Job:
    config = make_config("paper", pixel_sizes=(0.4,))
    return Job(config, "0" * 64, "av2", {}, str(output), **{"batch": 2, "check": False, **settings})


# Who is to blame


def test_a_unit_that_kills_worker_after_worker_is_left() -> None:
    deaths, unit = Deaths(2), Unit(3, "log")
    given_up: List[Optional[int]] = []
    again: Optional[Unit] = unit
    died = 0
    while again is not None:
        died += 1
        frame = next(stamp for stamp in range(1000) if stamp not in again.skip)
        failed, again = deaths.blame(again, "log", [frame], set(), "by SIGKILL")
        given_up += [one.timestamp for one in failed]
    assert died == 10 and given_up == [0, 1, 2, 3, 4, None]
    assert failed[-1].message == "10 workers died on this part of the log, by SIGKILL: the rest of it is left"
    failed, again = deaths.blame(Unit(4, "other"), "other", [7], set(), "by SIGKILL")
    assert not failed and again is not None and again.careful == {7}, "another unit has its own count"


def test_a_unit_that_cannot_be_begun_is_left_after_two() -> None:
    deaths, unit = Deaths(2), Unit(3, "log")
    assert deaths.blame(unit, "log", [], set(), "") == ([], unit)
    ((failed,), again) = deaths.blame(unit, "log", [], set(), "by SIGSEGV")
    assert again is None and failed == Failed(3, "log", "2 workers died on it, by SIGSEGV")


# Ends


def test_a_line_waits_for_its_calls_but_not_after_ctrl_c() -> None:
    gate, seen = threading.Event(), []
    with Line() as line:
        outcomes = [line.submit(seen.append, number) for number in range(3)]
        wrong = line.submit(int, "x")
    assert seen == [0, 1, 2] and all(outcome.done() for outcome in outcomes)
    with pytest.raises(ValueError, match="invalid literal"):
        wrong.result()
    start = time.monotonic()
    with pytest.raises(KeyboardInterrupt), Line() as line:
        line.submit(gate.wait, 60)
        raise KeyboardInterrupt
    assert time.monotonic() - start < 30
    gate.set()


@pytest.mark.skipif(not hasattr(signal, "SIGHUP"), reason="no SIGHUP on this system")
def test_a_terminal_that_is_closed_stops_a_run_but_not_under_nohup() -> None:
    before = signal.signal(signal.SIGHUP, signal.SIG_DFL)  # the tests themselves may run under nohup
    try:
        with StopSignal() as stop:
            os.kill(os.getpid(), signal.SIGHUP)
            assert stop() and stop.exit_status == 129
        signal.signal(signal.SIGHUP, signal.SIG_IGN)
        with StopSignal() as stop:
            os.kill(os.getpid(), signal.SIGHUP)
            assert not stop()
    finally:
        signal.signal(signal.SIGHUP, before)
    assert signal.SIGHUP in SIGNALS


def test_an_error_of_a_single_worker_costs_its_unit_only(
    fleet: Path, single: Dict[str, bytes], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """There is no memory for another thread, say."""
    first, second = sorted(fleet.iterdir())
    run = Worker._pass

    def pass_(self: Worker, unit: Unit, *rest: Any) -> Any:
        if unit.source == first:
            raise RuntimeError("can't start new thread")
        return run(self, unit, *rest)

    monkeypatch.setattr(Worker, "_pass", pass_)
    assert flow(fleet, tmp_path) == 1
    assert {name for name in single if name not in tree(tmp_path)} == {
        name for name in single if name.startswith(first.name) and "manifest" not in name
    }
    monkeypatch.undo()
    assert flow(fleet, tmp_path) == 0 and tree(tmp_path) == single


# Deaths


def _no_memory() -> None:
    size = int(Path("/proc/self/statm").read_text().split()[0]) * 4096
    resource.setrlimit(resource.RLIMIT_AS, (size, size))


DEATHS = {
    "SIGKILL": lambda: os.kill(os.getpid(), signal.SIGKILL),
    "SIGSEGV": lambda: os.kill(os.getpid(), signal.SIGSEGV),
    "SIGABRT": os.abort,
    "status 3": lambda: os._exit(3),
    "SystemExit": lambda: sys.exit("out"),
    "no memory": _no_memory,
}


def deadly_serve(*arguments: Any) -> None:
    """A worker process that dies whenever it reads a frame of one log, or before it can begin."""
    if os.environ[WHERE] == "at once":
        DEATHS[os.environ[HOW]]()
    read = Worker._read_one

    def deadly_read(self: Worker, log: Any, index: int) -> Any:
        if log.log_id == os.environ[WHERE]:
            time.sleep(0.3)  # so that what was said before is heard
            DEATHS[os.environ[HOW]]()
        return read(self, log, index)

    Worker._read_one = deadly_read  # type: ignore[method-assign]
    REAL_SERVE(*arguments)


def do(job: Job, units: List[Unit], layout: Layout = TWO, **settings: Any) -> Tally:
    tally = Tally(units)
    for event in run_local(job, units, layout, lambda: False, **settings):
        tally.add(event)
    return tally


@pytest.mark.slow
@pytest.mark.parametrize("how", DEATHS)
def test_a_log_that_always_kills_its_worker_takes_no_other_with_it(
    fleet: Path, single: Dict[str, bytes], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, how: str
) -> None:
    deadly, other = sorted(fleet.iterdir())
    monkeypatch.setattr(local, "serve", deadly_serve)
    monkeypatch.setenv(HOW, how)
    monkeypatch.setenv(WHERE, deadly.name)
    units = split([Unit(0, deadly), Unit(1, other)], 1)
    tally = do(make_job(tmp_path), units, timeout=30)
    assert not tally.is_complete and not tally.num_unopened
    assert {name.split("/")[0] for name, _ in tally.failures} == {deadly.name}
    wanted = {name: content for name, content in single.items() if name.startswith(other.name)}
    found = tree(tmp_path)
    frames = [name for name in wanted if name.endswith(".feather")]
    assert frames and all(found[name] == wanted[name] for name in frames)
    assert all(single[name] == content for name, content in found.items() if name.endswith(".feather"))
    monkeypatch.undo()
    tally = do(make_job(tmp_path), units)
    assert tally.is_complete
    assert {n: c for n, c in tree(tmp_path).items() if n.endswith(".feather")}.items() <= single.items()


@pytest.mark.slow
def test_a_long_log_that_always_kills_does_not_take_for_ever(
    tmp_path: Path, fleet: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Twelve frames, each of which kills two workers, would take 24 of them."""
    from cflow_torch.simulator import make_drive
    from cflow_torch.simulator.writers.av2 import write_av2_log

    deadly = write_av2_log(make_drive(seed=9, num_sweeps=13, profile="demo"), tmp_path / "root")
    monkeypatch.setattr(local, "serve", deadly_serve)
    monkeypatch.setenv(HOW, "SIGKILL")
    monkeypatch.setenv(WHERE, deadly.name)
    hired: List[str] = []
    hire = local._Crew._hire
    monkeypatch.setattr(local._Crew, "_hire", lambda self, device: (hired.append(device), hire(self, device))[1])
    other = sorted(fleet.iterdir())[0]
    tally = do(make_job(tmp_path / "out"), split([Unit(0, deadly), Unit(1, other)], 1))
    assert len(hired) <= 12 and tally.computed == 2
    assert "10 workers died on this part of the log" in tally.failures[-1][1]


@pytest.mark.slow
def test_workers_that_die_before_they_begin_blame_no_log(
    fleet: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(local, "serve", deadly_serve)
    monkeypatch.setenv(HOW, "SIGKILL")
    monkeypatch.setenv(WHERE, "at once")
    units = split([Unit(number, source) for number, source in enumerate(sorted(fleet.iterdir()))], 1)
    with pytest.raises(CFlowError, match="died before they could begin, the last one by SIGKILL .*engine.workers"):
        do(make_job(tmp_path), units)


def test_no_process_can_be_started(fleet: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: Any) -> None:
        raise BlockingIOError(11, "Resource temporarily unavailable")

    monkeypatch.setattr("multiprocessing.context.SpawnProcess._Popen", staticmethod(refuse))
    with pytest.raises(CFlowError, match="no worker process can be started.*engine.workers"):
        do(make_job(tmp_path), [Unit(0, sorted(fleet.iterdir())[0])])


def pausing_serve(*arguments: Any) -> None:
    """A worker process that takes two seconds to read a frame."""
    read = Worker._read_one

    def slow_read(self: Worker, log: Any, index: int) -> Any:
        time.sleep(2)
        return read(self, log, index)

    Worker._read_one = slow_read  # type: ignore[method-assign]
    REAL_SERVE(*arguments)


@pytest.mark.slow
def test_a_parent_that_was_stopped_kills_nobody_for_being_silent(
    fleet: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Ctrl-Z, an hour, fg."""
    monkeypatch.setattr(local, "serve", pausing_serve)
    units = split([Unit(number, source) for number, source in enumerate(sorted(fleet.iterdir()))], 1)
    tally, killed, stepped = Tally(units), [], []
    monkeypatch.setattr(local._Crew, "_mourn", lambda self, hand: killed.append(hand) or iter(()))
    real, offset = time.monotonic, [0.0]
    monkeypatch.setattr(local.time, "monotonic", lambda: real() + offset[0])
    for event in run_local(make_job(tmp_path, batch=1), units, TWO, lambda: False, timeout=60):
        tally.add(event)
        if isinstance(event, Done) and not stepped:
            stepped.append(event)
            offset[0] = 3600.0
    assert tally.is_complete and not killed


# A real process


# Imported by every Python that starts, workers too. A mount whose server is gone: to open this one file never ends,
# and not in Python, which would hear of a signal meanwhile, but in a library.
STUCK = """
import os
look, stuck = os.stat, os.environ["STUCK_FILE"]
def stat(path, *more, **named):
    if isinstance(path, os.PathLike) and os.fspath(path) == stuck:
        import pyarrow
        pyarrow.OSFile(os.environ["STUCK_PIPE"])
    return look(path, *more, **named)
os.stat = stat
"""


def start(root: Path, output: Path, *more: str, **environment: str) -> subprocess.Popen:
    arguments = ["data=av2", f"data.root={root}", f"output={output}", "model=paper", "model.pixel_sizes=[0.4]", *more]
    command = [sys.executable, "-m", "cflow_torch.cli.main", "flow", *arguments, "data.check=false"]
    around = {**os.environ, **environment}
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=around)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["SIGINT", "SIGTERM", "SIGHUP"])
@pytest.mark.parametrize("workers", [1, 2])
def test_a_second_signal_ends_a_run_whose_reading_hangs(
    fleet: Path, single: Dict[str, bytes], tmp_path: Path, name: str, workers: int
) -> None:
    root, out = tmp_path / "root", tmp_path / "out"
    shutil.copytree(fleet, root)
    log = AV2Log(sorted(root.iterdir())[1])
    file, pipe = log.folder / "sensors" / "lidar" / f"{log.timestamps[1]}.feather", tmp_path / "pipe"
    (tmp_path / "site").mkdir()
    (tmp_path / "site" / "sitecustomize.py").write_text(STUCK)
    os.mkfifo(pipe)  # nobody writes into it: to open it takes for ever
    path = os.pathsep.join([str(tmp_path / "site"), *filter(None, [os.environ.get("PYTHONPATH")])])
    stuck = {"PYTHONPATH": path, "STUCK_FILE": str(file), "STUCK_PIPE": str(pipe)}
    process = start(root, out, f"engine.workers={workers}", "engine.batch=1", **stuck)
    deadline = time.monotonic() + 120
    while len(list(out.glob("*/*.feather"))) < 2 and time.monotonic() < deadline:
        time.sleep(0.1)
    time.sleep(1)
    for _ in range(2):
        process.send_signal(signal.Signals[name])
        time.sleep(2)
    printed, told = process.communicate(timeout=30)
    assert process.returncode == 128 + signal.Signals[name], told
    assert f"interrupted by {name}" in printed and "not done" in told and "Traceback" not in told
    assert {n: c for n, c in tree(out).items() if "/." not in n}.items() <= single.items()
    assert flow(root, out) == 0
    assert tree(out) == single and len(list(out.glob("*/*.feather"))) == PAIRS


@pytest.mark.slow
def test_a_closed_terminal_loses_nothing(fleet: Path, single: Dict[str, bytes], tmp_path: Path) -> None:
    """The window of a run is closed: it hears SIGHUP, and nothing can be printed any more."""
    import pty

    ours, theirs = pty.openpty()
    command = [sys.executable, "-m", "cflow_torch.cli.main", "flow", "data=av2", f"data.root={fleet}"]
    settings = [f"output={tmp_path}", "model=paper", "model.pixel_sizes=[0.4]", "data.check=false", "engine.workers=1"]
    process = subprocess.Popen(
        ["setsid", "--ctty", *command, *settings], stdin=theirs, stdout=theirs, stderr=theirs, close_fds=True
    )
    os.close(theirs)
    deadline = time.monotonic() + 120
    while not list(tmp_path.glob("*/*.feather")) and time.monotonic() < deadline:
        time.sleep(0.01)
    os.close(ours)
    assert process.wait(60) in (0, 1, 129, -signal.SIGHUP), "the last one, if the work was over"
    assert {n: c for n, c in tree(tmp_path).items() if "/." not in n}.items() <= single.items()
    assert (tmp_path / "reports" / "shard-0-of-1.json").exists()
    assert flow(fleet, tmp_path) == 0
    assert tree(tmp_path) == single
