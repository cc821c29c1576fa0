"""One worker: batches, events, errors. Several workers: how their work is distributed, followed and repeated."""

from __future__ import annotations

import multiprocessing
import signal
import threading
import time
import warnings
from concurrent.futures import BrokenExecutor, ThreadPoolExecutor
from concurrent.futures import TimeoutError as NoAnswer
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, Callable, Iterator, Sequence

import numpy as np
import pytest
from small_fleet import CONFIG, PAIRS, flow_files, make_job, tree
from small_logs import make_small_drive

from cflow_torch import CFlowError, FlowResult, Window, make_config, make_model
from cflow_torch.data.av2 import AV2Log
from cflow_torch.data.log import LogWrapper
from cflow_torch.diagnosis.inspection import REPEATED
from cflow_torch.fleet import executors, parallel, work
from cflow_torch.fleet.executors import Executor, InlineExecutor, ProcessExecutor
from cflow_torch.fleet.job import Done, Event, Failed, Job, Noted, Opened, Part
from cflow_torch.fleet.parallel import run_parallel
from cflow_torch.fleet.run import Counters, _follow, format_missing, format_report
from cflow_torch.fleet.work import Worker


@pytest.fixture
def source(fleet: Path) -> Path:
    """The log of five pairs."""
    return sorted(fleet.iterdir())[1]


class FailingModel:
    """A method that raises `error()` for every batch that contains a frame with a time stamp of `bad`."""

    def __init__(self, bad: Sequence[int], error: Callable[[], Exception]) -> None:
        self.model = make_model(CONFIG, "cpu")
        self.config, self.bad, self._error = self.model.config, bad, error

    def __call__(self, windows: Sequence[Window], warns: bool) -> list[FlowResult]:
        warnings.simplefilter("always")  # as a reader that changes the filters in its thread
        if any(w.pc0.timestamp_ns in self.bad for w in windows):
            raise self._error()
        return self.model(windows, warns)


@pytest.mark.parametrize("error", [CFlowError("too odd"), MemoryError(), RuntimeError("CUDA: no memory"), KeyError(3)])
def test_a_bad_frame_does_not_spoil_its_batch(source, single, tmp_path, error):
    stamps = AV2Log(source).timestamps
    worker = Worker(make_job(tmp_path, batch=3), "cpu")
    worker._model = FailingModel([stamps[1], stamps[3]], lambda: error)
    events = list(worker.run(Part(source)))
    failed = [event for event in events if isinstance(event, Failed)]
    assert [event.name for event in failed] == [f"{source.name}/{stamps[i]}" for i in (1, 3)]
    assert all(type(error).__name__ in event.message or "too odd" in event.message for event in failed)
    assert [event.name for event in events if isinstance(event, Done)] == [
        f"{source.name}/{stamps[i]}" for i in (0, 2, 4)
    ]
    assert len(flow_files(tmp_path)) == 3 and flow_files(tmp_path).items() <= single.items()


def test_frames_without_an_active_point_fail_and_repeated_sweeps_are_noted(tmp_path):
    drive = make_small_drive(5, seed=1)

    class Odd(LogWrapper):
        """Its second sweep is in millimetres, its last one repeats the fourth."""

        poses = np.tile(np.eye(4), (5, 1, 1))
        trajectory = None

        def sweep(self, index: int) -> Any:
            sweep = self.log.sweep(min(index, 3))
            points = sweep.points * np.float32(1000 if index == 1 else 1)
            return replace(sweep, points=points, pose=np.eye(4), timestamp_ns=self.timestamps[index])

    class Opener(Worker):
        def _open(self, source: Any) -> Any:
            return Odd(drive)

    job = make_job(tmp_path, config=make_config("paper"), settings={}, batch=4)
    worker = Opener(job, "cpu")
    worker._model = FailingModel([], AssertionError)
    worker._model.model = make_model(job.config, "cpu")
    with warnings.catch_warnings(record=True) as shown:
        events = list(worker.run(Part("odd")))
    assert not shown, "what fails is told once, as a failure"
    (failed,) = [event for event in events if isinstance(event, Failed)]
    count = len(drive.sweep(1).points)
    names = [f"{drive.log_id}/{stamp}" for stamp in drive.timestamps]
    assert failed.name == names[1] and f"none of the {count} points of pc0 is active" in failed.message
    assert [event.name for event in events if isinstance(event, Done)] == [names[i] for i in (0, 2, 3)]
    notes = [(event.name, event.message) for event in events if isinstance(event, Noted)]
    assert notes[-1] == (names[3], REPEATED)
    assert any("the sensor moves" in text for _, text in notes), "the log is checked by the part of its first frame"


def test_a_log_whose_frames_all_fail_leaves_no_files(source, tmp_path):
    stamps = AV2Log(source).timestamps
    worker = Worker(make_job(tmp_path), "cpu")
    model, worker._model = worker._model, FailingModel(stamps, lambda: ValueError("odd"))
    events = list(worker.run(Part(source)))
    assert [type(event) for event in events[-5:]] == [Failed] * 5 and not any(tmp_path.iterdir())
    worker._model = model
    assert isinstance(list(worker.run(Part(source)))[-1], Done) and len(flow_files(tmp_path)) == 5


def test_a_lost_gpu_ends_its_worker(source, tmp_path, monkeypatch):
    worker = Worker(make_job(tmp_path, batch=1), "cpu")
    worker._model = FailingModel(AV2Log(source).timestamps, lambda: RuntimeError("assert"))

    def refuse(*_: Any, **__: Any) -> Any:
        raise RuntimeError("device-side assert")

    monkeypatch.setattr("cflow_torch.fleet.work.torch.zeros", refuse)
    with pytest.raises(BrokenExecutor, match="can no longer be used: .*device-side assert"):
        list(worker.run(Part(source)))


# Several workers, which live in the thread of their caller


class Death(BaseException):
    """Ends a worker that lives in a thread."""


class HereExecutor(Executor):
    """A worker without a process. It breaks `failed_starts` times at its start, and when it reads a deadly frame:
    `deadly` maps "log/time stamp" to how many more workers it breaks."""

    def __init__(self, job: Job, deadly: dict[str, int] | None = None, failed_starts: int = 0) -> None:
        self.job, self.deadly, self.failed_starts = job, {} if deadly is None else deadly, failed_starts
        self.num_starts = 0
        self.worker: Any = None

    def start(self) -> Worker:
        self.num_starts += 1
        if self.num_starts <= self.failed_starts:
            raise BrokenExecutor("SIGKILL")
        worker = Worker(self.job, "cpu")
        worker._ahead = 0  # without read-ahead, so that the frames before the deadly one are on disk
        worker._read = self._read
        return worker

    def _read(self, log: Any, index: int) -> Any:
        frame = f"{log.log_id}/{log.timestamps[index]}"
        if self.deadly.get(frame, 0) > 0:
            self.deadly[frame] -= 1
            raise Death
        return Worker._read(self.worker, log, index)

    def call(self, method: str, *arguments: Any) -> Any:
        try:
            self.worker = self.worker or self.start()
            return getattr(self.worker, method)(*arguments)
        except Death:
            self.worker = None
            raise BrokenExecutor("SIGSEGV") from None

    def close(self) -> None:
        self.worker = None


def parts_of(sources: Sequence[Any]) -> list[Part]:
    return [Part(source) for source in sources]


def never() -> bool:
    return False


def count(events: Iterator[Event], parts: Sequence[Part]) -> Counters:
    counters = Counters(parts)
    for event in events:
        counters.add(event)
    return counters


AGAIN_DIED = (
    "its worker died again (SIGSEGV): "
    "give fewer engine.workers if memory is short, or a larger engine.timeout if a batch takes longer"
)
AGAIN = "a worker died (SIGSEGV): its frames are tried again, one by one"


def test_a_worker_keeps_the_memory_that_it_frees(tmp_path, monkeypatch):
    calls: list[Any] = []
    monkeypatch.setattr(work, "keep_freed_memory", lambda: calls.append(1))
    work.make_worker(make_job(tmp_path), "cpu").close()
    assert len(calls) == 1, "once per process, not per part or window"


def test_the_memory_of_workers_on_a_gpu_is_not_limited(tmp_path):
    with pytest.raises(CFlowError, match="engine.memory is for workers on a CPU"):
        parallel.local_executors(make_job(tmp_path), ["cuda:0"], memory=8e9).__enter__()


def test_when_a_worker_dies_each_of_its_frames_is_tried_by_itself(fleet, single, tmp_path):
    sources = sorted(fleet.iterdir())
    names = [f"{sources[1].name}/{stamp}" for stamp in AV2Log(sources[1]).timestamps]
    parts, deadly = parts_of(sources), {names[3]: 1000, names[1]: 1}
    executors = [HereExecutor(make_job(tmp_path, batch=1, redo=True), deadly) for _ in range(2)]
    counters = count(run_parallel(executors, parts, never), parts)
    assert deadly == {names[3]: 999, names[1]: 0}, "the part dies on its frame 1, then frame 3 by itself"
    assert counters.failures == [(names[3], AGAIN_DIED)]
    assert (counters.total, counters.num_waiting) == (PAIRS, 0)
    assert counters.times_noted(AGAIN) == 1
    assert tree(tmp_path) == {name: content for name, content in single.items() if name != f"{names[3]}.feather"}
    assert all(executor.worker is None for executor in executors), "they are closed"


def test_frames_that_all_kill_are_all_reported(fleet, single, tmp_path):
    sources = sorted(fleet.iterdir())[:2]
    parts = parts_of(sources)
    frames = [f"{sources[1].name}/{stamp}" for stamp in AV2Log(sources[1]).timestamps[:-1]]
    executor = HereExecutor(make_job(tmp_path), dict.fromkeys(frames, 1000))
    counters = count(run_parallel([executor], parts, never), parts)
    assert executor.num_starts == 1 + len(frames), "for the part, then for each frame"
    assert sorted(name for name, _ in counters.failures) == frames
    found = flow_files(tmp_path)
    assert len(found) == 3 and not counters.is_complete and found.items() <= single.items()


def test_a_log_that_cannot_be_opened_alive_is_left(source, tmp_path):
    class Deadly(HereExecutor):
        def call(self, method: str, *arguments: Any) -> Any:
            raise BrokenExecutor("SIGSEGV")

    died, failed = run_parallel([Deadly(make_job(tmp_path))], parts_of([source]), never)
    assert died == Noted(source.name, AGAIN)
    assert failed == Failed(source.name, AGAIN_DIED)


def test_workers_that_die_at_their_start_are_started_twice_for_each_log(fleet, tmp_path):
    parts, job = parts_of(sorted(fleet.iterdir())), make_job(tmp_path)
    executor = HereExecutor(job, failed_starts=1000)
    counters = count(run_parallel([executor], parts, never), parts)
    assert executor.num_starts == 2 * len(parts) and [name for name, _ in counters.failures] == sorted(
        source.name for source in fleet.iterdir()
    )
    assert count(run_parallel([HereExecutor(job, failed_starts=1)], parts, never), parts).is_complete


def test_a_frame_fails_only_after_its_worker_died_on_it_alone(source, tmp_path):
    """The log opens at the second start only, and then a frame ends its worker once."""
    parts = parts_of([source])
    deadly = {f"{source.name}/{AV2Log(source).timestamps[1]}": 1}
    executor = HereExecutor(make_job(tmp_path, batch=1), deadly, failed_starts=1)
    counters = count(run_parallel([executor], parts, never), parts)
    assert counters.is_complete and len(flow_files(tmp_path)) == counters.total == 5


def test_a_worker_that_cannot_start_ends_the_run(fleet, tmp_path):
    class Gone(HereExecutor):
        def start(self) -> Worker:
            return InlineExecutor(lambda: Worker(self.job, "nowhere")).call("run")

    parts = parts_of(sorted(fleet.iterdir()))
    with pytest.raises(CFlowError, match="nowhere"):
        list(run_parallel([Gone(make_job(tmp_path)), HereExecutor(make_job(tmp_path))], parts, never))


def test_an_error_outside_of_frames_fails_only_the_frames_of_its_part(fleet, single, tmp_path, monkeypatch):
    """For example if there is no memory for another thread."""
    first, *others = sorted(fleet.iterdir())
    real = Worker._pass

    def pass_(self: Worker, log: Any, *rest: Any) -> Any:
        if log.log_id == first.name:
            raise RuntimeError("can't start new thread")
        return real(self, log, *rest)

    monkeypatch.setattr(Worker, "_pass", pass_)
    executors = [HereExecutor(make_job(tmp_path)) for _ in range(2)]
    events = run_parallel(executors, parts_of([first, *others]), never)
    failed = [(e.name, e.message) for e in events if isinstance(e, Failed)]
    lost = [f"{first.name}/{stamp}" for stamp in AV2Log(first).timestamps[:-1]]
    assert failed == [(name, "RuntimeError: can't start new thread") for name in lost]
    assert len(flow_files(tmp_path)) == PAIRS - 3 and flow_files(tmp_path).items() <= single.items()


class SilentExecutor(HereExecutor):
    """Its calls are not answered before it is closed."""

    def __init__(self, job: Job) -> None:
        super().__init__(job)
        self.is_closed = threading.Event()

    def call(self, method: str, *arguments: Any) -> Any:
        self.is_closed.wait()
        raise BrokenExecutor("closed")

    def close(self) -> None:
        self.is_closed.set()


def test_a_stop_does_not_wait_for_a_worker_that_hangs(source, tmp_path, monkeypatch):
    monkeypatch.setattr(parallel, "_GRACE_S", 0.3)
    start = time.monotonic()
    stop = lambda: time.monotonic() > start + 0.3  # noqa: E731
    executor = SilentExecutor(make_job(tmp_path))
    assert not list(run_parallel([executor], parts_of([source]), stop))
    assert time.monotonic() - start < 20 and executor.is_closed.is_set()


# The objects of processes are made by texts, because a process that imports this file imports torch, too.


def test_a_process_passes_answers_and_errors():
    executor = ProcessExecutor(partial(eval, "[3, 2, 1]"))
    try:
        assert executor.call("pop") == 1
        assert executor.call("index", 3) == 0, "the same object"
        with pytest.raises(ValueError, match="not in list") as caught:
            executor.call("remove", 7)
        assert "in a worker process" in str(caught.value.__cause__)
    finally:
        executor.close()
    with pytest.raises(BrokenExecutor, match="closed"):
        executor.call("pop")
    executor = ProcessExecutor(partial(eval, "1 / 0"))
    with pytest.raises(CFlowError, match="ZeroDivisionError"):
        executor.call("pop")
    executor.close()


def test_a_process_that_ends_is_replaced_and_says_how_it_ended():
    executor = ProcessExecutor(partial(eval, "__import__('os')"))
    try:
        first = executor.call("getpid")
        with pytest.raises(BrokenExecutor, match="^exit status 3$"):
            executor.call("_exit", 3)
        second = executor.call("getpid")
        with pytest.raises(BrokenExecutor, match="signal 9, Killed"):
            executor.call("kill", second, signal.SIGKILL)
        assert len({first, second, executor.call("getpid")}) == 3
    finally:
        executor.close()


def test_a_process_whose_library_exits_or_loses_its_gpu_ends():
    leaver = ProcessExecutor(partial(eval, "__import__('sys')"))
    with pytest.raises(BrokenExecutor, match="^exit status 1$"):
        leaver.call("exit", "out")
    loser = ProcessExecutor(partial(eval, "(_ for _ in ())"))
    with pytest.raises(BrokenExecutor, match="no GPU"):
        loser.call("throw", BrokenExecutor("no GPU"))
    assert not multiprocessing.active_children()


def test_a_silent_process_is_ended_and_replaced():
    executor = ProcessExecutor(partial(eval, "__import__('os')"), {"kill": 0.3})  # to start takes longer
    try:
        first = executor.call("getpid")
        with pytest.raises(BrokenExecutor, match="no answer for 0.3 s"):
            executor.call("kill", first, signal.SIGSTOP)
        assert executor.call("getpid") != first
    finally:
        executor.close()


class SlowWorker:
    """A worker that takes a second to open a log, and never computes a frame."""

    def __init__(self, *_: Any) -> None: ...

    def begin(self, part: Part, is_stopped: bool) -> Opened:
        time.sleep(1)
        return Opened("log", 1, ("log/0",))

    def next_event(self, is_stopped: bool) -> None:
        time.sleep(60)


def test_a_log_may_take_long_to_open(tmp_path, monkeypatch):
    monkeypatch.setattr(parallel, "make_worker", SlowWorker)
    with parallel.local_executors(make_job(tmp_path), ("cpu", "cpu"), timeout=0.5) as (first, _):
        assert first.call("begin", Part("log"), False) == Opened("log", 1, ("log/0",))
        with pytest.raises(BrokenExecutor, match="no answer for 0.5 s"):
            first.call("next_event", False)


def test_a_killed_process_is_described_where_there_is_no_sigkill(monkeypatch):
    assert executors._ending(-9).endswith("(out of memory?)")
    monkeypatch.delattr(signal, "SIGKILL")  # as on Windows, where `kill` gives this status
    assert executors._ending(-signal.SIGTERM) == "signal 15, Terminated"


def test_a_close_ends_a_call_of_another_thread():
    executor = ProcessExecutor(partial(eval, "__import__('time')"))
    with ThreadPoolExecutor(1) as thread:
        assert thread.submit(executor.call, "perf_counter").result(60) > 0
        call = thread.submit(executor.call, "sleep", 600)
        with pytest.raises(NoAnswer):
            call.result(0.2)
        executor.close()
        with pytest.raises(BrokenExecutor):
            call.result(60)


def test_the_report_lists_what_is_missing():
    counters = Counters(parts_of(["a", "b", "c"]))
    names = tuple(f"a/{stamp}" for stamp in range(40))
    events = [Opened("a", 40, names[10:]), Done("a/10", {"read": 2.0}), Failed("a/11", "odd")]
    for event in [*events, Failed("b", "no log"), *(Noted(name, "odd") for name in "cca")]:
        counters.add(event)
    assert counters.times_noted("odd") == 3 and counters.num_waiting == 28
    about = {"engine": "local", "shard": {"index": 0, "count": 1}, "devices": ["cpu"]}
    report = {**counters.report(4.0, "SIGTERM"), **about}
    assert report["status"] == "interrupted" and report["stopped_by"] == "SIGTERM"
    assert list(report["frames"].values()) == [40, 10, 1, 1, 1, 28, 1]
    assert report["notes"] == [["c", "odd", 2], ["a", "odd", 1]] and "warnings" in format_report(report)
    missing = format_missing(report).splitlines()
    assert missing[:3] == ["  a/11: odd", "  b: no log", "  a/12: not done"]
    assert missing[-2:] == ["  and 10 more, all of them in the report", "  1 logs or parts of logs: not begun"]
    assert "interrupted by SIGTERM" in format_report(report)


def test_failures_of_one_cause_are_shown_three_times_and_listed_once(capsys):
    parts = parts_of(["a"])
    counters = Counters(parts)
    names = tuple(f"a/{stamp}" for stamp in range(9))
    failures = [Failed(name, f"none of the {500 + k} points is active, x -1.5e-{k} m") for k, name in enumerate(names)]
    _follow(iter([Opened("a", 9, names), Failed("a", "no log"), *failures]), counters, 1)
    shown = capsys.readouterr().err.splitlines()
    assert [line.split(":")[1] for line in shown] == [" a", " a/0", " a/1", " a/2"]
    report = counters.report(1.0, "")
    assert len(report["failures"]) == 10
    assert format_missing(report).splitlines()[1] == f"  a/0 (and 8 more, to a/8): {failures[0].message}"


def test_a_stop_lets_started_frames_finish(fleet, tmp_path):
    parts, job = parts_of(sorted(fleet.iterdir())), make_job(tmp_path, batch=1)
    executors = [HereExecutor(job), HereExecutor(job)]
    counters = count(run_parallel(executors, parts, lambda: any(tmp_path.rglob("*.feather"))), parts)
    assert 0 < len(flow_files(tmp_path)) < PAIRS
    assert counters.num_waiting + len(flow_files(tmp_path)) == counters.total
