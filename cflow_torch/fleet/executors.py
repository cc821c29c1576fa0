"""Executors: each holds one object, such as a `Worker`, and calls its methods, one call at a time, as futures."""

from __future__ import annotations

import multiprocessing
import os
import signal
from abc import ABC, abstractmethod
from concurrent.futures import BrokenExecutor, Future, ProcessPoolExecutor
from threading import Thread
from typing import Any, Callable, Sequence

from cflow_torch.errors import CFlowError
from cflow_torch.fleet.stop_signal import SIGNALS


class CannotStart(CFlowError):
    """The object of an executor could not be made, so no call can succeed."""


class Holder:
    """Makes an object at the first call and keeps it."""

    held: Any = None

    def call(self, make: Callable[[], Any], method: str, arguments: Sequence[Any]) -> Any:
        """Call a method of the object that `make` returns. Errors of `make` become `CannotStart`."""
        if self.held is None:
            try:
                self.held = make()
            except Exception as error:
                raise CannotStart(describe_error(error)) from error
        return getattr(self.held, method)(*arguments)


class Executor(ABC):
    """Holds one object. A call makes it if there is none yet, or if it was lost or closed."""

    timeout: float | None = None  # seconds after which a call without an answer is hopeless

    @abstractmethod
    def submit(self, method: str, *arguments: Any) -> Future[Any]:
        """Call a method of the object. Errors of the future: `BrokenExecutor` if the object is lost, `CannotStart`, and
        those of the method."""

    @abstractmethod
    def close(self) -> str:
        """End the object, even during a call. Return in words how its process has ended, "" if there is none."""


class InlineExecutor(Executor):
    """An object of this process. A call returns when it is done. `make` returns the object."""

    def __init__(self, make: Callable[[], Any]) -> None:
        self._make = make
        self._holder = Holder()

    def submit(self, method: str, *arguments: Any) -> Future[Any]:
        answer: Future[Any] = Future()
        try:
            answer.set_result(self._holder.call(self._make, method, arguments))
        except Exception as error:
            answer.set_exception(error)
        return answer

    def close(self) -> str:
        if self._holder.held is not None:
            self._holder.held.close()
        self._holder = Holder()
        return ""


class ProcessExecutor(Executor):
    """A process of this machine, which ignores `SIGNALS` and ends when its parent ends.

    Args:
        make: called in the process; returns the object. It is pickled, like the arguments and results of calls.
        timeout: see `Executor`.
    """

    def __init__(self, make: Callable[[], Any], timeout: float | None = None) -> None:
        self._make = make
        self._pool: Any = None
        self.timeout = timeout

    def submit(self, method: str, *arguments: Any) -> Future[Any]:
        how = ""
        for _ in range(2):
            if self._pool is None:
                context = multiprocessing.get_context("spawn")  # threads and CUDA do not survive a fork
                self._pool = ProcessPoolExecutor(1, context, _begin)
            try:
                return self._pool.submit(_call, self._make, method, arguments)  # type: ignore[no-any-return]
            except (BrokenExecutor, OSError) as error:  # the process has ended since the last call, or cannot start
                how = describe_error(error)
                self.close()
        answer: Future[Any] = Future()
        answer.set_exception(BrokenExecutor(how))
        return answer

    def close(self) -> str:
        if self._pool is None:
            return ""
        pool, self._pool = self._pool, None
        processes = list((pool._processes or {}).values())  # Python 3.14 has kill_workers instead
        pool.shutdown(wait=False)
        for process in processes:
            process.kill()
            process.join()
        return "".join(_ending(process.exitcode) for process in processes)


_holder = Holder()  # of a process that `ProcessExecutor` has started


def _call(make: Callable[[], Any], method: str, arguments: Sequence[Any]) -> Any:
    return _holder.call(make, method, arguments)


def _begin() -> None:
    """Begin a process: the parent receives signals as well, and says when to stop."""
    for number in SIGNALS:
        signal.signal(number, signal.SIG_IGN)
    Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    parent: Any = multiprocessing.parent_process()
    parent.join()
    os._exit(1)


def describe_error(error: BaseException) -> str:
    """Describe an error in one line; its class is named unless the text says enough."""
    text = " ".join(str(error).split()) or "no message"
    return text if isinstance(error, (CFlowError, OSError, BrokenExecutor)) else f"{type(error).__name__}: {text}"


def _ending(status: int | None) -> str:
    """Describe in words how a process with this exit status has ended."""
    if status is None or status >= 0:  # None: another thread has just read the status
        return f"exit status {status}"
    return f"signal {-status}, {signal.strsignal(-status)}" + " (out of memory?)" * (-status == signal.SIGKILL)
