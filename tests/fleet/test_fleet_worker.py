"""One worker: batches, events, errors; and how the work of several is handed out, followed and done again."""

from __future__ import annotations

import time
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any, Callable, Iterator, Sequence

import pytest
from small_fleet import CONFIG, PAIRS, flow_files, make_job, tree

from cflow_torch import CFlowError, FlowResult, Window, make_model
from cflow_torch.data.av2 import AV2Log
from cflow_torch.fleet import dispatch as dispatching
from cflow_torch.fleet.dispatch import WorkerDied, dispatch
from cflow_torch.fleet.job import Done, Event, Failed, Job, Opened, Shard, Unit
from cflow_torch.fleet.local import run_local
from cflow_torch.fleet.machine import Layout
from cflow_torch.fleet.report import Counters, format_missing, format_report
from cflow_torch.fleet.work import Worker
from cflow_torch.fleet.worker_process import WorkerProcess


@pytest.fixture
def source(fleet: Path) -> Path:
    """The log of five pairs."""
    return sorted(fleet.iterdir())[1]


class Stumbling:
    """A method that cannot do some frames, and no batch with one of them.

    Args:
        bad: time stamps of the frames.
        error: what it raises.
    """

    def __init__(self, bad: Sequence[int], error: Callable[[], Exception]) -> None:
        self.model = make_model(CONFIG, "cpu")
        self.config, self.bad, self._error = self.model.config, bad, error

    def __call__(self, windows: Sequence[Window]) -> list[FlowResult]:
        if any(w.pc0.timestamp_ns in self.bad for w in windows):
            raise self._error()
        return self.model(windows)


# One worker


@pytest.mark.parametrize("error", [CFlowError("too odd"), MemoryError(), RuntimeError("CUDA: no memory"), KeyError(3)])
def test_a_bad_frame_spoils_no_other_of_its_batch(
    source: Path, single: dict[str, bytes], tmp_path: Path, error: Exception
) -> None:
    stamps = AV2Log(source).timestamps
    model = Stumbling([stamps[1], stamps[3]], lambda: error)
    events = list(Worker(make_job(tmp_path, batch=3), "cpu", model=model).run(Unit(0, source)))
    failed = [event for event in events if isinstance(event, Failed)]
    assert [event.timestamp for event in failed] == [stamps[1], stamps[3]]
    assert all(type(error).__name__ in event.message or "too odd" in event.message for event in failed)
    assert [event.timestamp for event in events if isinstance(event, Done)] == [stamps[i] for i in (0, 2, 4)]
    assert len(flow_files(tmp_path)) == 3 and flow_files(tmp_path).items() <= single.items()


def test_a_batch_that_failed_is_let_go_before_its_frames_are_tried_alone(source: Path, tmp_path: Path) -> None:
    """A traceback holds what the failed batch had taken from the GPU."""
    import weakref

    class Big:
        pass

    alive: list[bool] = []

    class Hungry(Stumbling):
        taken: Any = None

        def __call__(self, windows: Sequence[Window]) -> list[FlowResult]:
            if len(windows) > 1:
                big = Big()
                self.taken = weakref.ref(big)
                raise RuntimeError("CUDA: out of memory")
            alive.append(self.taken is not None and self.taken() is not None)
            return self.model(windows)

    list(Worker(make_job(tmp_path), "cpu", model=Hungry([], MemoryError)).run(Unit(0, source)))
    assert alive == [False] * 5


def test_a_gpu_that_is_lost_ends_its_worker(source: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    model = Stumbling(AV2Log(source).timestamps, lambda: RuntimeError("assert"))
    worker = Worker(make_job(tmp_path, batch=1), "cpu", model=model)

    def refuse(*_: Any, **__: Any) -> Any:
        raise RuntimeError("device-side assert")

    monkeypatch.setattr("cflow_torch.fleet.work.torch.zeros", refuse)
    with pytest.raises(CFlowError, match="cannot be used any more: .*device-side assert"):
        list(worker.run(Unit(0, source)))


def test_an_error_outside_of_frames_costs_the_unit_only(
    fleet: Path, single: dict[str, bytes], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """There is no memory for another thread, say."""
    first, *others = sorted(fleet.iterdir())
    real = Worker._pass

    def pass_(self: Worker, log: Any, *rest: Any) -> Any:
        if log.log_id == first.name:
            raise RuntimeError("can't start new thread")
        return real(self, log, *rest)

    monkeypatch.setattr(Worker, "_pass", pass_)
    units = [Unit(n, folder) for n, folder in enumerate([first, *others])]
    events = dispatch([Thread(make_job(tmp_path)) for _ in range(2)], units, lambda: False, 1)
    failed = [(e.name, e.message) for e in events if isinstance(e, Failed)]
    assert failed == [(first.name, "RuntimeError: can't start new thread")]
    assert len(flow_files(tmp_path)) == PAIRS - 3 and flow_files(tmp_path).items() <= single.items()


# Several workers: the dispatcher, with threads in place of processes


class Death(BaseException):
    """Ends a worker that lives in a thread."""


class Thread:
    """A handle whose worker lives in a thread, and dies when it reads a frame that `deadly` says.

    Args:
        job: the run.
        deadly: "log/time stamp" -> how many workers more die on it.
        stillborn: so many workers die before they begin.
    """

    def __init__(self, job: Job, deadly: dict[str, int] | None = None, stillborn: int = 0) -> None:
        self.job, self.deadly, self.stillborn = job, {} if deadly is None else deadly, stillborn
        self.started = 0
        self.is_closed = False
        self._process: Any = None
        self._thread = ThreadPoolExecutor(1)

    def begin(self) -> Future:
        self.started += 1
        return self._thread.submit(self._begin)

    def _begin(self) -> None:
        if self.started <= self.stillborn:
            raise WorkerDied("by SIGKILL")
        self._process = WorkerProcess(self.job, "cpu")
        self._process._ahead = 0

    def step(self, unit: Unit, stop: bool) -> Future:
        return self._thread.submit(self._step, unit, stop)

    def _step(self, unit: Unit, stop: bool) -> Any:
        """As the real one, but without read-ahead, so that frames before the deadly one are on disk."""
        worker, deadly = self._process, self.deadly
        read = Worker._read_one

        def deadly_read(log: Any, index: int) -> Any:
            frame = f"{log.log_id}/{log.timestamps[index]}"
            if deadly.get(frame, 0) > 0:
                deadly[frame] -= 1
                raise Death
            return read(worker, log, index)

        worker._read_one = deadly_read
        try:
            return self._process.step(unit, stop)
        except Death:
            raise WorkerDied("by SIGSEGV") from None

    def result(self, call: Future) -> Any:
        return call.result()

    def close(self) -> None:
        self.is_closed = True


def follow(events: Iterator[Event], units: Sequence[Unit]) -> Counters:
    """What happened, counted."""
    counters = Counters(units)
    for event in events:
        counters.add(event)
    return counters


def test_a_unit_is_done_again_then_its_frames_one_by_one(fleet: Path, single: dict[str, bytes], tmp_path: Path) -> None:
    sources = sorted(fleet.iterdir())
    names = [f"{sources[1].name}/{stamp}" for stamp in AV2Log(sources[1]).timestamps]
    units = [Unit(n, source) for n, source in enumerate(sources)]
    deadly = {names[3]: 1000, names[1]: 1}
    handles = [Thread(make_job(tmp_path, batch=1, redo=True), deadly) for _ in range(2)]
    counters = follow(dispatch(handles, units, lambda: False, retries=1), units)
    assert 1000 - deadly[names[3]] == 3, "the unit's second worker, then twice by itself"
    assert counters.failures == [(names[3], "2 workers died on it, the last one by SIGSEGV")]
    assert (counters.total, counters.waiting) == (PAIRS, [])
    found = tree(tmp_path)
    found.pop("manifest.json", None)
    wanted = {name: content for name, content in single.items() if name not in ("manifest.json", f"{names[3]}.feather")}
    assert found == wanted
    assert all(handle.is_closed for handle in handles)


def test_a_unit_that_kills_worker_after_worker_is_left(fleet: Path, single: dict[str, bytes], tmp_path: Path) -> None:
    sources = sorted(fleet.iterdir())
    units = [Unit(n, source) for n, source in enumerate(sources[:2])]
    deadly = {f"{sources[1].name}/{stamp}": 1000 for stamp in AV2Log(sources[1]).timestamps}
    handle = Thread(make_job(tmp_path), deadly)
    counters = follow(dispatch([handle], units, lambda: False, retries=1), units)
    assert handle.started == 10
    assert counters.failures[-1] == (
        sources[1].name,
        "10 workers died on this part of the log, the last one by SIGSEGV: the rest of it is left",
    )
    found = flow_files(tmp_path)
    assert len(found) == 3 and not counters.is_complete and found.items() <= single.items()


def test_a_log_that_kills_whoever_opens_it_is_left(source: Path, tmp_path: Path, monkeypatch) -> None:
    class Deadly(Thread):
        def _step(self, unit: Unit, stop: bool) -> Any:
            raise WorkerDied("by SIGABRT")

    handle = Deadly(make_job(tmp_path))
    events = list(dispatch([handle], [Unit(0, source)], lambda: False, retries=1))
    assert events == [Failed(0, source.name, "2 workers died on it, the last one by SIGABRT")]


def test_workers_that_die_before_they_begin_blame_no_log(source: Path, tmp_path: Path, capsys) -> None:
    units = [Unit(0, source)]
    with pytest.raises(CFlowError, match="3 workers .* died before they could begin, the last one by SIGKILL"):
        list(dispatch([Thread(make_job(tmp_path), stillborn=99)], units, lambda: False, 1))
    counters = follow(dispatch([Thread(make_job(tmp_path), stillborn=2)], units, lambda: False, 1), units)
    assert counters.is_complete


def test_a_worker_that_cannot_begin_leaves_the_work_to_the_others(fleet: Path, tmp_path: Path, capsys) -> None:
    class Gone(Thread):
        def _begin(self) -> None:
            Worker(self.job, "nowhere")

    units = [Unit(n, source) for n, source in enumerate(sorted(fleet.iterdir()))]
    handles = [Gone(make_job(tmp_path)), Thread(make_job(tmp_path))]
    assert follow(dispatch(handles, units, lambda: False, 1), units).is_complete
    assert "nowhere" in capsys.readouterr().err
    with pytest.raises(CFlowError, match="nowhere"):
        list(dispatch(handles[:1], units, lambda: False, 1))


def test_a_stop_lets_the_frames_in_hand_be_finished(fleet: Path, tmp_path: Path) -> None:
    units = [Unit(n, source) for n, source in enumerate(sorted(fleet.iterdir()))]
    job = make_job(tmp_path, batch=1)
    counters = follow(dispatch([Thread(job), Thread(job)], units, lambda: any(tmp_path.rglob("*.feather")), 1), units)
    assert 0 < len(flow_files(tmp_path)) < PAIRS
    assert len(counters.waiting) + len(flow_files(tmp_path)) == counters.total


def test_a_stop_does_not_wait_for_a_worker_that_hangs(source: Path, tmp_path: Path, monkeypatch) -> None:
    class Hanging(Thread):
        def step(self, unit: Unit, stop: bool) -> Future:
            return Future()

    monkeypatch.setattr(dispatching, "_GRACE_S", 1.0)
    start = time.monotonic()
    assert not list(dispatch([Hanging(make_job(tmp_path))], [Unit(0, source)], lambda: time.monotonic() > start + 1, 1))
    assert time.monotonic() - start < 20


# Counters and the report


def test_a_report_of_trouble_lists_what_is_missing() -> None:
    units = [Unit(0, "a"), Unit(1, "b"), Unit(2, "c")]
    counters = Counters(units)
    stamps = tuple(range(40))
    assert counters.add(Opened(0, "a", stamps, stamps[10:])) == 10
    assert counters.add(Done(0, 10, {"read": 2.0})) == 1
    assert counters.add(Failed(0, "a/11", "odd", 11)) == 1
    assert counters.add(Failed(1, "b", "no log")) == 0
    assert counters.add(Opened(0, "a", stamps[12:], stamps[13:])) == 1, "12 was written before its worker died"
    assert counters.add(Opened(0, "a", (20,), (20,))) == 0, "by itself"
    told = counters.report(4.0, Layout(("cpu",), 1), Shard(), "local", "SIGTERM")
    assert told["status"] == "interrupted" and told["stopped_by"] == "SIGTERM"
    assert list(told["frames"].values()) == [40, 10, 2, 1, 1, 27, 1]
    missing = format_missing(told).splitlines()
    assert missing[:3] == ["  a/11: odd", "  b: no log", "  a/13: not done"]
    assert missing[-2:] == ["  and 9 more, all of them in the report", "  1 logs or parts of logs: not begun"]
    assert "interrupted by SIGTERM" in format_report(told)


def test_settings_of_the_engine_are_checked(source: Path, tmp_path: Path) -> None:
    job, units = replace(make_job(tmp_path)), [Unit(0, source)]
    for settings in ({"timeout": 0}, {"timeout": "long"}, {"memory": -1}, {"memory": True}):
        with pytest.raises(CFlowError, match=f"engine.{next(iter(settings))}=.*above 0"):
            list(run_local(job, units, Layout(("cpu",), 1), lambda: False, **settings))
