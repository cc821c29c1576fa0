"""Executors: each is a process that holds one object and calls its methods, one call at a time, as futures."""

from __future__ import annotations

import multiprocessing
import os
import signal
from abc import ABC, abstractmethod
from concurrent.futures import BrokenExecutor, Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from threading import Thread
from typing import Any, Callable

from cflow_torch.errors import CFlowError
from cflow_torch.fleet.stop_signal import SIGNALS


class CannotStart(CFlowError):
    """The object of an executor could not be made, so no call can succeed."""


class Executor(ABC):
    """A process that holds one object. The first call starts it."""

    @abstractmethod
    def submit(self, method: str, *arguments: Any) -> Future[Any]:
        """Call a method of the object. Its errors are those of the future, or `CannotStart`, or a `BrokenExecutor`."""

    @abstractmethod
    def close(self) -> None:
        """Kill the process, even during a call. The next call starts another one."""

    def explain(self, error: BaseException) -> str:
        """Return in one line why a call failed."""
        return describe(error)


class ProcessExecutor(Executor):
    """A process of this machine. It ignores `SIGNALS` and ends when its parent does.

    Args:
        make: called in the process; returns the object.
        arguments: of `make`. They are pickled, like the arguments and results of calls.
    """

    def __init__(self, make: Callable[..., Any], *arguments: Any) -> None:
        self._make, self._arguments = make, arguments
        self._pool: ProcessPoolExecutor | None = None
        self._process: Any = None

    def submit(self, method: str, *arguments: Any) -> Future[Any]:
        try:
            if self._pool is None:
                spawn = multiprocessing.get_context("spawn")  # threads and CUDA do not survive a fork
                self._pool = ProcessPoolExecutor(1, spawn, _prepare, (self._make, self._arguments))
            future = self._pool.submit(_call, method, arguments)
            (self._process,) = self._pool._processes.values()  # only Python 3.14 has a public `kill_workers`
        except (BrokenExecutor, OSError) as error:  # the process has ended since the last call, or cannot start
            future = Future()
            future.set_exception(error)
        return future

    def close(self) -> None:
        if self._pool is not None:
            self._pool.shutdown(wait=False)
        if self._process is not None:
            self._process.kill()
            self._process.join()
        self._pool = self._process = None

    def explain(self, error: BaseException) -> str:
        if self._process is None or not isinstance(error, BrokenProcessPool):
            return describe(error)
        self._process.join(1.0)
        return _ending(self._process.exitcode)


# In the process of a `ProcessExecutor`: its object, and how to make it.
_held: Any = None
_make: Callable[[], Any] = dict


def _prepare(make: Callable[..., Any], arguments: tuple[Any, ...]) -> None:
    global _make
    _make = lambda: make(*arguments)  # noqa: E731
    for number in SIGNALS:
        signal.signal(number, signal.SIG_IGN)  # the parent receives them as well and says when to stop
    Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


def _call(method: str, arguments: tuple[Any, ...]) -> Any:
    global _held
    if _held is None:
        _held = make_object(_make)
    return getattr(_held, method)(*arguments)


def make_object(make: Callable[..., Any], *arguments: Any) -> Any:
    """Make the object of an executor; its errors become `CannotStart`."""
    try:
        return make(*arguments)
    except Exception as error:
        raise CannotStart(describe(error)) from error


def describe(error: BaseException) -> str:
    """Describe an error in one line; its class is named unless the text says enough."""
    text = " ".join(str(error).split()) or "no message"
    return text if isinstance(error, (CFlowError, OSError, BrokenExecutor)) else f"{type(error).__name__}: {text}"


def _ending(status: int | None) -> str:
    """Describe in words how a process with this exit status has ended."""
    if status is None or status >= 0:  # None: another thread has just read the status
        return f"exit status {status}"
    return f"signal {-status}, {signal.strsignal(-status)}" + " (out of memory?)" * (-status == signal.SIGKILL)
