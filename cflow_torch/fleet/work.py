"""One worker: reads, computes and writes the frames of a unit, the three at the same time."""

from __future__ import annotations

import time
from collections import deque
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Callable, Iterator, Sequence

import torch

from cflow_torch.data.atomic import remove_stale
from cflow_torch.data.catalog import open_log
from cflow_torch.data.flow_file import write_flow
from cflow_torch.data.log import CachedLog, Log, window
from cflow_torch.data.log_check import check_log
from cflow_torch.data.names import safe_name
from cflow_torch.data.paths import as_path
from cflow_torch.estimate import make_model
from cflow_torch.fleet.job import Done, Event, Failed, Job, Opened, Unit
from cflow_torch.fleet.manifest import claim_log, complete_frames, frame_file
from cflow_torch.stages import FlowModel, stage_seconds
from cflow_torch.types import CFlowError, FlowResult, Window

# Batches that are read ahead, and that wait to be written: enough to even out, little enough for flat memory.
_AHEAD = 2


class DeviceLost(CFlowError):
    """The GPU cannot be used any more by this process."""


@dataclass
class _Frame:
    """A frame on its way through a worker."""

    timestamp: int
    content: Window | FlowResult | Exception | None = None
    seconds: dict[str, float] = field(default_factory=dict)


class Worker:
    """Holds the method and the log in hand.

    Args:
        job: the run.
        device: where to compute.
        model: stands in for the method (tests).

    Raises:
        CFlowError: there is no such device, or it cannot be used.
    """

    def __init__(self, job: Job, device: str, model: FlowModel | None = None) -> None:
        try:
            torch.zeros(1, device=device)  # now, rather than frame by frame
        except (RuntimeError, AssertionError) as error:
            raise CFlowError(f"no worker can begin on {device}: {describe(error)}") from error
        self._job, self._device, self._ahead = job, device, _AHEAD
        self._model: FlowModel = make_model(job.config, device) if model is None else model
        self._log: tuple[Any, Log | None] = (None, None)
        self._reader, self._writer = ThreadPoolExecutor(1), ThreadPoolExecutor(1)

    def run(self, unit: Unit, stop: Callable[[], bool] = lambda: False) -> Iterator[Event]:
        """Do a unit's frames that are not complete.

        Args:
            unit: what to do.
            stop: asked before each batch; from True on, what is computed is written and nothing new is begun.

        Yields:
            What happens: `Opened` once, then `Done` and `Failed`, in the order of the log.

        Raises:
            DeviceLost: the GPU cannot be used any more.
        """
        try:
            log = self._open(unit.source)
            folder = as_path(self._job.output) / safe_name(log.log_id, "the log")
            stamps = {i: int(log.timestamps[i]) for i in unit.frames(len(log.timestamps) - 1)}
            if unit.only is not None:
                stamps = {i: stamp for i, stamp in stamps.items() if stamp in unit.only}
            complete = set() if self._job.redo else complete_frames(folder)
            todo = {i: stamp for i, stamp in stamps.items() if stamp not in complete}
            if todo or complete:
                claim_log(folder, log, self._job.identity)
            remove_stale(folder, {frame_file(folder, stamp).name for stamp in todo.values()})
        except Exception as error:
            yield Failed(unit.number, source_name(unit.source), describe(error))
            return
        yield Opened(unit.number, log.log_id, tuple(stamps.values()), tuple(todo.values()))
        if todo and self._job.settings.get("check", True) and unit.first == 0:
            with suppress(Exception):  # a sweep that cannot be read is reported when its turn comes
                check_log(log)
        for frame in self._pass(log, folder, list(todo), stop):
            if isinstance(frame.content, Exception):
                name = f"{log.log_id}/{frame.timestamp}"
                yield Failed(unit.number, name, describe(frame.content), frame.timestamp)
            else:
                yield Done(unit.number, frame.timestamp, frame.seconds)

    def close(self) -> None:
        """Let go of the log in hand. Calls that hang in a file system are not waited for."""
        self._reader.shutdown(wait=False)
        self._writer.shutdown(wait=False)
        self._close_log()

    def _close_log(self) -> None:
        log, self._log = self._log[1], (None, None)
        if log is not None:
            log.close()

    def _open(self, source: Any) -> Log:
        if self._log[1] is None or self._log[0] != source:
            self._close_log()
            log = open_log(self._job.reader, source, **{**self._job.settings, "check": False})
            self._log = (source, CachedLog(log, self._job.config.num_sweeps))
        return self._log[1]  # type: ignore[return-value]

    def _pass(self, log: Log, folder: Path, todo: Sequence[int], stop: Callable[[], bool]) -> Iterator[_Frame]:
        """Frames through the reading thread, this thread and the writing thread."""
        size = self._job.batch
        batches = iter([todo[i : i + size] for i in range(0, len(todo), size)])
        reading: deque[Future[list[_Frame]]] = deque()
        writing: deque[Future[_Frame]] = deque()
        while True:
            while len(reading) <= self._ahead and not stop():
                batch = next(batches, None)
                if batch is None:
                    break
                reading.append(self._reader.submit(self._read, log, batch))
            if reading and not stop():
                frames = reading.popleft().result()
                self._compute(frames)
                writing.extend(self._writer.submit(self._write, folder, frame) for frame in frames)
            elif not writing:
                break
            # Only so many results are held; at the end, or to stop, all are waited for.
            most = self._ahead * size if reading and not stop() else 0
            while writing and (len(writing) > most or writing[0].done()):
                yield writing.popleft().result()

    def _read(self, log: Log, batch: Sequence[int]) -> list[_Frame]:
        return [self._read_one(log, index) for index in batch]

    def _read_one(self, log: Log, index: int) -> _Frame:
        frame = _Frame(int(log.timestamps[index]))
        with _stage(frame, "read"):
            frame.content = window(log, index, self._job.config.num_history, self._job.config.num_future)
        return frame

    def _compute(self, frames: list[_Frame]) -> None:
        """Windows to results, together; if that fails, each by itself, so that one bad frame spoils no other."""
        good = [frame for frame in frames if isinstance(frame.content, Window)]
        if not good:
            return
        start, results = time.perf_counter(), None
        try:
            with stage_seconds() as stages:
                results = self._model([frame.content for frame in good])  # type: ignore[misc]
        except Exception as error:
            if len(good) == 1:
                good[0].content = error.with_traceback(None)
                self._check_device()
        if results is None:
            # Only here, where the error is forgotten: its traceback holds all that the batch had in the GPU's memory.
            for frame in good if len(good) > 1 else []:
                self._compute([frame])
            return
        seconds = {"compute": time.perf_counter() - start, **{f"compute/{name}": s for name, s in stages.items()}}
        for frame, result in zip(good, results):
            frame.content = result
            frame.seconds.update({name: value / len(good) for name, value in seconds.items()})

    def _check_device(self) -> None:
        """After an error of a kernel, CUDA refuses all that follows in the same process: only a new one can go on."""
        try:
            torch.zeros(1, device=self._device).item()
        except RuntimeError as error:
            raise DeviceLost(f"{self._device} cannot be used any more: {describe(error)}") from error

    def _write(self, folder: Path, frame: _Frame) -> _Frame:
        if isinstance(frame.content, FlowResult):
            result, frame.content = frame.content, None
            file = frame_file(folder, frame.timestamp)
            with _stage(frame, "write"):
                write_flow(file, result, self._job.contents)
        return frame


@contextmanager
def _stage(frame: _Frame, name: str) -> Iterator[None]:
    """Times a block as a stage of a frame; what it raises becomes the frame's content."""
    start = time.perf_counter()
    try:
        yield
    except Exception as error:
        frame.content = error
    frame.seconds[name] = time.perf_counter() - start


def describe(error: BaseException) -> str:
    """An error in one line; those that are not the package's own or the system's, with their kind."""
    text = " ".join(str(error).split()) or "no message"
    return text if isinstance(error, (CFlowError, OSError)) else f"{type(error).__name__}: {text}"


def source_name(source: Any) -> str:
    """What messages call a log that could not be opened."""
    return str(getattr(source, "scene", None) or getattr(source, "stem", None) or source)
