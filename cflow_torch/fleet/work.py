"""A worker: it reads, computes and writes the frames of a `Part` of a log, all three at the same time."""

from __future__ import annotations

import time
from collections import deque
from concurrent.futures import BrokenExecutor, Executor, Future, ThreadPoolExecutor
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from functools import lru_cache, partial
from itertools import islice, takewhile
from pathlib import Path
from typing import Any, Callable, Generator, Iterable, Iterator

import pyarrow
import torch

from cflow_torch.data.atomic import remove_stale
from cflow_torch.data.catalog import open_log, source_name
from cflow_torch.data.flow_file import POINTS, write_flow
from cflow_torch.data.log import CachedLog, Log, window
from cflow_torch.data.log_check import find_problems
from cflow_torch.data.paths import as_path, safe_name
from cflow_torch.diagnosis.inspection import REPEATED, MotionWatch, inactive_problems, pair_problem
from cflow_torch.estimate import make_model
from cflow_torch.fleet.executors import describe_error
from cflow_torch.fleet.job import Done, Event, Failed, Job, Noted, Opened, Part, frame_name
from cflow_torch.fleet.manifest import checked_manifest, claim_log, complete_frames, frame_file
from cflow_torch.fleet.progress import show_warnings_as_lines
from cflow_torch.stages import stage_seconds
from cflow_torch.types import CFlowError, FlowResult, Window
from cflow_torch.windows.memory import keep_freed_memory

_AHEAD = 2  # batches that are read ahead, and that wait to be written


@dataclass
class _Frame:
    """A frame that a worker reads, computes and writes."""

    timestamp: int
    content: Window | FlowResult | Exception | None = None
    window: Window | None = None  # of the result
    points: Any = None  # of sweep t, if they are written
    problem: str = ""  # of the pair
    seconds: dict[str, float] = field(default_factory=dict)


class Worker:
    """Computes parts of logs, and keeps the last log open. A device that cannot be used is a `CFlowError`."""

    def __init__(self, job: Job, device: str) -> None:
        try:
            torch.zeros(1, device=device)  # fails now, not at every frame
        except (RuntimeError, AssertionError) as error:
            reason = describe_error(error)
            raise CFlowError(f"device={device} cannot be used ({reason}): give auto, cpu, cuda or cuda:1") from error
        self._job, self._device, self._ahead = job, device, _AHEAD
        self._model: Any = make_model(job.config, device)
        self._source: Any = None
        self._log: Any = None
        self._reader, self._writer = ThreadPoolExecutor(1), ThreadPoolExecutor(1)
        self._events: Iterator[Event] = iter(())  # of the part that `begin` has begun
        self._is_stopped = False

    def begin(self, part: Part, is_stopped: bool) -> Event | None:
        """Begin a part, and return its first event. Cost: opens the log; odometry takes 0.2 s per sweep."""
        self._events = self.run(part)
        return self.next_event(is_stopped)

    def next_event(self, is_stopped: bool) -> Event | None:
        """Return the next event of the part; None after the last one."""
        self._is_stopped = is_stopped
        return next(self._events, None)

    def run(self, part: Part) -> Iterator[Event]:
        """Do the frames of a part that are not complete. `BrokenExecutor` if the GPU can no longer be used.

        After a stop, we write computed frames and begin no others.

        Yields:
            `Opened` once, then `Done` and `Failed` in the order of the log, and `Noted`. If something other than a
            frame fails, all frames without a result fail, or the log if it is not open.
        """
        source = source_name(part.source)
        left = {source}  # what has no result: the log until it is open, then its frames
        try:
            log = self._open(part.source)
            folder = as_path(self._job.output) / safe_name(log.log_id, "the log")
            stamps = part.stamps(log)
            complete = set() if self._job.redo else complete_frames(folder)
            todo = {i: stamp for i, stamp in stamps.items() if stamp not in complete}
            manifest: Any = checked_manifest(folder, log, self._job.identity) if todo or complete else None
            remove_stale(folder)
            names = [frame_name(log, stamp) for stamp in todo.values()]
            yield Opened(source, len(stamps), tuple(names))
            left = set(names)
            checks = bool(self._job.settings.get("check", True))
            if checks and 0 in todo:
                with suppress(Exception):  # if a sweep cannot be read, its frames fail below
                    for text in find_problems(log):
                        yield Noted(log.log_id, text)
            claim = lru_cache(partial(claim_log, folder, manifest))  # once, before the first frame
            for frame in self._pass(log, partial(self._write, folder, claim, MotionWatch()), todo):
                name = frame_name(log, frame.timestamp)
                left.discard(name)
                if checks and frame.problem:
                    yield Noted(name, frame.problem)
                if isinstance(frame.content, Exception):
                    yield Failed(name, describe_error(frame.content))
                else:
                    yield Done(name, frame.seconds)
        except BrokenExecutor:
            raise
        except Exception as error:
            for name in sorted(left):
                yield Failed(name, describe_error(error))

    def close(self) -> None:
        """Close the log. We do not wait for reads and writes that hang."""
        self._reader.shutdown(wait=False)
        self._writer.shutdown(wait=False)
        if self._log is not None:
            self._log.close()

    def _open(self, source: Any) -> Log:
        if self._log is None or self._source != source:
            before, self._log = self._log, None
            if before is not None:
                before.close()
            log = open_log(self._job.reader, source, **{**self._job.settings, "check": False})
            self._source, self._log = source, CachedLog(log, self._job.config.num_sweeps)
        return self._log  # type: ignore[no-any-return]

    def _pass(self, log: Log, write: Callable[[_Frame], _Frame], todo: Iterable[int]) -> Iterator[_Frame]:
        """Pass frames through the reading thread, this thread and the writing thread."""
        size, ahead = self._job.batch, self._ahead * self._job.batch
        begun = takewhile(lambda _: not self._is_stopped, todo)
        frames = (future.result() for future in run_ahead(self._reader, partial(self._read, log), begun, ahead))
        batches = takewhile(lambda _: not self._is_stopped, iter(lambda: list(islice(frames, size)), []))
        computed = (frame for batch in batches for frame in self._compute(batch))
        for future in run_ahead(self._writer, write, computed, ahead):
            yield future.result()

    def _read(self, log: Log, index: int) -> _Frame:
        frame = _Frame(int(log.timestamps[index]))
        with _stage(frame, "read"):
            frame.content = sweeps = window(log, index, self._job.config.num_history, self._job.config.num_future)
            frame.problem = pair_problem(sweeps.pc0, sweeps.pc1)
            # De-skewed sweeps that repeat each other differ.
            if not frame.problem and log.unmoved is not log and log.repeats(index + 1):
                frame.problem = REPEATED
        return frame

    def _compute(self, frames: list[_Frame]) -> list[_Frame]:
        """Turn windows into results, as a batch. If that fails, compute them one by one, so that only bad ones fail."""
        good = [frame for frame in frames if isinstance(frame.content, Window)]
        sweeps: Any = [frame.content for frame in good]
        start, results = time.perf_counter(), None
        try:
            with stage_seconds() as stages:
                results = self._model(sweeps, warns=False) if sweeps else []
            problems = inactive_problems(sweeps, results, self._job.config)
        except Exception as error:
            if len(good) == 1:
                good[0].content = error.with_traceback(None)
                self._check_device()
        if results is None:
            # We retry here, not in the except block, where the traceback still keeps the batch in the GPU's memory.
            for frame in good if len(good) > 1 else []:
                self._compute([frame])
            return frames
        seconds = {"compute": time.perf_counter() - start, **{f"compute/{name}": s for name, s in stages.items()}}
        for frame, given, result, problem in zip(good, sweeps, results, problems):
            if POINTS in self._job.contents:
                frame.points = given.pc0.points
            frame.window = given
            frame.content = CFlowError(problem) if problem else result
            frame.seconds.update({name: value / len(good) for name, value in seconds.items()})
        return frames

    def _check_device(self) -> None:
        """Raise `BrokenExecutor` if CUDA refuses all further work, as it does after an error inside a kernel."""
        try:
            torch.zeros(1, device=self._device).item()
        except RuntimeError as error:
            raise BrokenExecutor(f"{self._device} can no longer be used: {describe_error(error)}") from error

    def _write(self, folder: Path, claim: Callable[[], None], watch: MotionWatch, frame: _Frame) -> _Frame:
        if isinstance(frame.content, FlowResult):
            result, frame.content = frame.content, None
            window, frame.window = frame.window, None
            if window is not None and not frame.problem:
                frame.problem = watch(window, result)
            file = frame_file(folder, frame.timestamp)
            with _stage(frame, "write"):
                claim()
                write_flow(file, result, self._job.contents, frame.points)
            frame.points = None
        return frame


def make_worker(job: Job, device: str, memory: float | None = None) -> Worker:
    """Make the worker of this process.

    On a CPU, it uses one thread, because other workers use the other cores. `memory` limits its address space, bytes.
    The process keeps the memory that it frees, for the next window.
    """
    if memory is not None:
        import resource  # not available on Windows

        resource.setrlimit(resource.RLIMIT_AS, (int(memory), int(memory)))
    if device == "cpu":
        torch.set_num_threads(1)
        pyarrow.set_cpu_count(1)
    keep_freed_memory()
    show_warnings_as_lines()
    return Worker(job, device)


def run_ahead(
    executor: Executor, function: Callable[[Any], Any], items: Iterable[Any], count: int
) -> Generator[Future[Any], None, None]:
    """Call a function with each item in other threads, `count` items ahead, and yield the futures in order."""
    waiting: deque[Future[Any]] = deque()
    try:
        for item in items:
            waiting.append(executor.submit(function, item))
            while waiting and (len(waiting) > count or waiting[0].done()):
                yield waiting.popleft()
        while waiting:
            yield waiting.popleft()
    finally:
        for future in waiting:
            future.cancel()


@contextmanager
def _stage(frame: _Frame, name: str) -> Iterator[None]:
    """Time a block as a stage of a frame. An error in the block becomes the frame's content."""
    start = time.perf_counter()
    try:
        yield
    except Exception as error:
        frame.content = error
    frame.seconds[name] = time.perf_counter() - start


def open_quickly(job: Job, source: Any) -> Log:
    """Open a log for its name and times, without what takes long."""
    return open_log(job.reader, source, **{**job.settings, "check": False, "odometry": False, "read_as": None})
