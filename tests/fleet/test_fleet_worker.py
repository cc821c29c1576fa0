"""One worker: batches, events, errors. Several workers: how their work is distributed, followed and repeated."""

from __future__ import annotations

import threading
import time
from dataclasses import replace
from pathlib import Path
from typing import Any, Callable, Iterator, Sequence

import numpy as np
import pytest
from small_fleet import CONFIG, PAIRS, flow_files, make_job, tree

from cflow_torch import CFlowError, FlowResult, Window, make_config, make_model
from cflow_torch.data.av2 import AV2Log
from cflow_torch.data.log import LogWrapper
from cflow_torch.fleet import dispatch as dispatching
from cflow_torch.fleet.dispatch import WorkerDied, dispatch
from cflow_torch.fleet.job import Done, Event, Failed, Job, Noted, Opened, Shard, Unit
from cflow_torch.fleet.machine import Layout
from cflow_torch.fleet.processes import ChildProcess
from cflow_torch.fleet.run import Counters, format_missing, format_report
from cflow_torch.fleet.work import Worker
from cflow_torch.simulator import make_drive


@pytest.fixture
def source(fleet: Path) -> Path:
    """The log of five pairs."""
    return sorted(fleet.iterdir())[1]


class FailingModel:
    """A method that raises `error()` for every batch that contains a frame with a time stamp of `bad`."""

    def __init__(self, bad: Sequence[int], error: Callable[[], Exception]) -> None:
        self.model = make_model(CONFIG, "cpu")
        self.config, self.bad, self._error = self.model.config, bad, error

    def __call__(self, windows: Sequence[Window]) -> list[FlowResult]:
        if any(w.pc0.timestamp_ns in self.bad for w in windows):
            raise self._error()
        return self.model(windows)


@pytest.mark.parametrize("error", [CFlowError("too odd"), MemoryError(), RuntimeError("CUDA: no memory"), KeyError(3)])
def test_a_bad_frame_does_not_spoil_its_batch(source, single, tmp_path, error):
    stamps = AV2Log(source).timestamps
    worker = Worker(make_job(tmp_path, batch=3), "cpu")
    worker._model = FailingModel([stamps[1], stamps[3]], lambda: error)
    events = list(worker.run(Unit(0, source)))
    failed = [event for event in events if isinstance(event, Failed)]
    assert [event.timestamp for event in failed] == [stamps[1], stamps[3]]
    assert all(type(error).__name__ in event.message or "too odd" in event.message for event in failed)
    assert [event.timestamp for event in events if isinstance(event, Done)] == [stamps[i] for i in (0, 2, 4)]
    assert len(flow_files(tmp_path)) == 3 and flow_files(tmp_path).items() <= single.items()


def test_frames_without_an_active_point_fail_and_repeated_sweeps_are_noted(tmp_path):
    drive = make_drive(seed=1, num_sweeps=5, profile="demo")

    class Odd(LogWrapper):
        """Its second sweep is in millimetres, its last one repeats the fourth."""

        def sweep(self, index: int) -> Any:
            sweep = self.log.sweep(min(index, 3))
            points = sweep.points * np.float32(1000 if index == 1 else 1)
            return replace(sweep, points=points, pose=np.eye(4), timestamp_ns=self.timestamps[index])

    class Opener(Worker):
        def _open(self, source: Any) -> Any:
            return Odd(drive)

    job = make_job(tmp_path, config=make_config("paper"), settings={}, batch=4)
    events = list(Opener(job, "cpu").run(Unit(0, "odd")))
    (failed,) = [event for event in events if isinstance(event, Failed)]
    assert failed.timestamp == drive.timestamps[1] and "none of the 26523 points of pc0 is active" in failed.message
    assert [event.timestamp for event in events if isinstance(event, Done)] == [drive.timestamps[i] for i in (0, 2, 3)]
    notes = [(event.name, event.message) for event in events if isinstance(event, Noted)]
    assert notes[-1] == (f"{drive.log_id}/{drive.timestamps[3]}", "the next sweep has the same points")
    assert any("the sensor moves" in text for _, text in notes), "the log is checked by the unit of its first frame"


def test_a_lost_gpu_ends_its_worker(source, tmp_path, monkeypatch):
    worker = Worker(make_job(tmp_path, batch=1), "cpu")
    worker._model = FailingModel(AV2Log(source).timestamps, lambda: RuntimeError("assert"))

    def refuse(*_: Any, **__: Any) -> Any:
        raise RuntimeError("device-side assert")

    monkeypatch.setattr("cflow_torch.fleet.work.torch.zeros", refuse)
    with pytest.raises(CFlowError, match="can no longer be used: .*device-side assert"):
        list(worker.run(Unit(0, source)))


# Several workers: the dispatcher, with threads in place of processes


class Death(BaseException):
    """Ends a worker that lives in a thread."""


class ThreadProcess:
    """A worker that lives in the thread of its caller. It dies `failed_starts` times at its start, and when it reads a
    deadly frame: `deadly` maps "log/time stamp" to how many more workers die on it."""

    def __init__(self, job: Job, deadly: dict[str, int] | None = None, failed_starts: int = 0) -> None:
        self.job, self.deadly, self.failed_starts = job, {} if deadly is None else deadly, failed_starts
        self.num_starts = 0
        self.is_closed = threading.Event()

    def start(self) -> None:
        self.num_starts += 1
        if self.num_starts <= self.failed_starts:
            raise WorkerDied("by SIGKILL")
        self.worker, self.is_stopped = Worker(self.job, "cpu"), False
        self.worker._ahead = 0  # without read-ahead, so that the frames before the deadly one are on disk
        self.worker._read = self._read  # type: ignore[method-assign]

    def _read(self, log: Any, index: int) -> Any:
        frame = f"{log.log_id}/{log.timestamps[index]}"
        if self.deadly.get(frame, 0) > 0:
            self.deadly[frame] -= 1
            raise Death
        return Worker._read(self.worker, log, index)

    def call(self, unit: Unit) -> Any:
        try:
            yield from self.worker.run(unit, lambda: self.is_stopped)
        except Death:
            raise WorkerDied("by SIGSEGV") from None

    def stop(self) -> None:
        self.is_stopped = True

    def close(self) -> None:
        self.is_closed.set()


def units_of(sources: Sequence[Any]) -> list[Unit]:
    return [Unit(number, source) for number, source in enumerate(sources)]


def count(events: Iterator[Event], units: Sequence[Unit]) -> Counters:
    counters = Counters(units)
    for event in events:
        counters.add(event)
    return counters


def test_after_a_death_the_unit_is_repeated_then_each_frame_by_itself(fleet, single, tmp_path):
    sources = sorted(fleet.iterdir())
    names = [f"{sources[1].name}/{stamp}" for stamp in AV2Log(sources[1]).timestamps]
    units, deadly = units_of(sources), {names[3]: 1000, names[1]: 1}
    processes = [ThreadProcess(make_job(tmp_path, batch=1, redo=True), deadly) for _ in range(2)]
    counters = count(dispatch(processes, units, lambda: False, retries=1), units)
    assert 1000 - deadly[names[3]] == 3, "once with the unit, then twice by itself"
    assert counters.failures == [(names[3], "2 workers died on it, the last one by SIGSEGV")]
    assert (counters.total, counters.waiting) == (PAIRS, {})
    assert counters.times_noted("a worker died by SIGSEGV; another one goes on with the frames that are missing") == 4
    left = {name: content for name, content in single.items() if not name.startswith("runs/")}
    assert tree(tmp_path) == {name: content for name, content in left.items() if name != f"{names[3]}.feather"}
    assert all(process.is_closed.is_set() for process in processes)


def test_a_unit_that_kills_ten_workers_is_left(fleet, single, tmp_path):
    sources = sorted(fleet.iterdir())[:2]
    units = units_of(sources)
    deadly = {f"{sources[1].name}/{stamp}": 1000 for stamp in AV2Log(sources[1]).timestamps}
    process = ThreadProcess(make_job(tmp_path), deadly)
    counters = count(dispatch([process], units, lambda: False, retries=1), units)
    assert process.num_starts == 11
    message = "10 workers died on this part of the log, the last one by SIGSEGV: the rest is left"
    assert counters.failures[-1] == (sources[1].name, message)
    found = flow_files(tmp_path)
    assert len(found) == 3 and not counters.is_complete and found.items() <= single.items()


def test_a_log_that_cannot_be_opened_alive_is_left(source, tmp_path):
    class Deadly(ThreadProcess):
        def call(self, unit: Unit) -> Any:
            raise WorkerDied("by SIGABRT")

    died, again, failed = dispatch([Deadly(make_job(tmp_path))], units_of([source]), lambda: False, retries=1)
    text = "a worker died by SIGABRT; another one goes on with the frames that are missing"
    assert died == again == Noted(0, source.name, text)
    assert failed == Failed(0, source.name, "2 workers died on it, the last one by SIGABRT")


def test_workers_that_die_at_their_start_are_started_three_times(source, tmp_path):
    units, job = units_of([source]), make_job(tmp_path)
    with pytest.raises(CFlowError, match="3 workers in a row died at their start, the last one by SIGKILL"):
        list(dispatch([ThreadProcess(job, failed_starts=3)], units, lambda: False, 1))
    assert count(dispatch([ThreadProcess(job, failed_starts=2)], units, lambda: False, 1), units).is_complete


def test_a_worker_that_cannot_start_leaves_its_work_to_the_others(fleet, tmp_path, capsys):
    class Gone(ThreadProcess):
        def start(self) -> None:
            Worker(self.job, "nowhere")

    units = units_of(sorted(fleet.iterdir()))
    processes = [Gone(make_job(tmp_path)), ThreadProcess(make_job(tmp_path))]
    assert count(dispatch(processes, units, lambda: False, 1), units).is_complete
    assert "nowhere" in capsys.readouterr().err
    with pytest.raises(CFlowError, match="nowhere"):
        list(dispatch(processes[:1], units, lambda: False, 1))


def test_an_error_outside_of_frames_fails_only_its_unit(fleet, single, tmp_path, monkeypatch):
    """For example if there is no memory for another thread."""
    first, *others = sorted(fleet.iterdir())
    real = Worker._pass

    def pass_(self: Worker, log: Any, *rest: Any) -> Any:
        if log.log_id == first.name:
            raise RuntimeError("can't start new thread")
        return real(self, log, *rest)

    monkeypatch.setattr(Worker, "_pass", pass_)
    processes = [ThreadProcess(make_job(tmp_path)) for _ in range(2)]
    events = dispatch(processes, units_of([first, *others]), lambda: False, 1)
    failed = [(e.name, e.message) for e in events if isinstance(e, Failed)]
    assert failed == [(first.name, "RuntimeError: can't start new thread")]
    assert len(flow_files(tmp_path)) == PAIRS - 3 and flow_files(tmp_path).items() <= single.items()


def test_a_stop_does_not_wait_for_a_worker_that_hangs(source, tmp_path, monkeypatch):
    class Hanging(ThreadProcess):
        def call(self, unit: Unit) -> Any:
            self.is_closed.wait()
            raise WorkerDied("by SIGKILL")

    monkeypatch.setattr(dispatching, "_GRACE_S", 1.0)
    start = time.monotonic()
    stop = lambda: time.monotonic() > start + 1  # noqa: E731
    assert not list(dispatch([Hanging(make_job(tmp_path))], units_of([source]), stop, 1))
    assert time.monotonic() - start < 20


def test_a_child_process_passes_answers_and_errors():
    # As a text, because a child process that imports this file imports torch, too.
    countdown = "lambda number, stop: (number / k if k else 1 / number and stop() for k in (3, 2, 1, 0))"
    process = ChildProcess(eval, countdown, timeout=60)
    try:
        assert list(process.call(6)) == [2.0, 3.0, 6.0, False]
        with pytest.raises(RuntimeError, match="ZeroDivisionError"):
            list(process.call(0))
        process._process.kill()
        with pytest.raises(WorkerDied, match="by signal 9, Killed"):
            list(process.call(6))
        assert next(process.call(3)) == 1.0, "another process"
        process.stop()
    finally:
        process.close()
    died = "__import__('cflow_torch.fleet.processes', fromlist=['']).WorkerDied('because it lost its GPU')"
    with pytest.raises(WorkerDied, match="because it lost its GPU"):
        list(ChildProcess(eval, f"lambda stop: (_ for _ in ()).throw({died})", timeout=60).call())


def test_the_report_lists_what_is_missing():
    units = units_of(["a", "b", "c"])
    counters = Counters(units)
    stamps = tuple(range(40))
    events = [Opened(0, "a", stamps, stamps[10:]), Done(0, 10, {"read": 2.0}), Failed(0, "a/11", "odd", 11)]
    for event in [*events, Failed(1, "b", "no log"), *(Noted(2, name, "odd") for name in "cca")]:
        counters.add(event)
    assert counters.times_noted("odd") == 3 and len(counters.waiting) == 28
    report = counters.report(4.0, Layout(("cpu",), 1), Shard(), "local", "SIGTERM")
    assert report["status"] == "interrupted" and report["stopped_by"] == "SIGTERM"
    assert list(report["frames"].values()) == [40, 10, 1, 1, 1, 28, 1]
    assert report["notes"] == [["c", "odd", 2], ["a", "odd", 1]] and "warnings" in format_report(report)
    missing = format_missing(report).splitlines()
    assert missing[:3] == ["  a/11: odd", "  b: no log", "  a/12: not done"]
    assert missing[-2:] == ["  and 10 more, all of them in the report", "  1 logs or parts of logs: not begun"]
    assert "interrupted by SIGTERM" in format_report(report) and "  read" not in format_report(report)
    assert "  read" in format_report(report, verbose=True)


def test_a_stop_lets_started_frames_finish(fleet, tmp_path):
    units, job = units_of(sorted(fleet.iterdir())), make_job(tmp_path, batch=1)
    processes = [ThreadProcess(job), ThreadProcess(job)]
    counters = count(dispatch(processes, units, lambda: any(tmp_path.rglob("*.feather")), 1), units)
    assert 0 < len(flow_files(tmp_path)) < PAIRS
    assert len(counters.waiting) + len(flow_files(tmp_path)) == counters.total
