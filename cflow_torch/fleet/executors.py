"""Executors: each holds one object, such as a `Worker`, and calls its methods, one call at a time."""

from __future__ import annotations

import multiprocessing
import os
import signal
import traceback
from abc import ABC, abstractmethod
from concurrent.futures import BrokenExecutor
from threading import Lock, Thread
from typing import Any, Callable, Mapping

from cflow_torch.errors import CFlowError
from cflow_torch.fleet.stop_signal import SIGNALS


class Executor(ABC):
    """Holds one object. A call makes it if there is none yet, or if it was lost."""

    @abstractmethod
    def call(self, method: str, *arguments: Any) -> Any:
        """Call a method of the object. `BrokenExecutor` if the object is lost, `CFlowError` if it cannot be made."""

    @abstractmethod
    def close(self) -> None:
        """End the object, even during a call in another thread. There are no further calls."""


class InlineExecutor(Executor):
    """An object of this process. `make` returns the object."""

    def __init__(self, make: Callable[[], Any]) -> None:
        self._make = make
        self._held: Any = None

    def call(self, method: str, *arguments: Any) -> Any:
        if self._held is None:
            try:
                self._held = self._make()
            except Exception as error:
                raise CFlowError(describe_error(error)) from error
        try:
            return getattr(self._held, method)(*arguments)
        except BrokenExecutor:
            self.close()
            raise

    def close(self) -> None:
        if self._held is not None:
            self._held.close()
        self._held = None


class ProcessExecutor(Executor):
    """A process of this machine, which ignores `SIGNALS` and ends when its parent ends.

    Args:
        make: called in the process; returns the object. It is pickled, like the arguments and results of calls.
        timeouts: method -> seconds after which a call without an answer is hopeless; a method without an entry may take
            any time.
    """

    def __init__(self, make: Callable[[], Any], timeouts: Mapping[str, float] | None = None) -> None:
        self._make = make
        self._timeouts = dict(timeouts or {})
        self._lock = Lock()  # of the fields below, for `close` in another thread
        self._process: Any = None
        self._connection: Any = None
        self._is_closed = False

    def call(self, method: str, *arguments: Any) -> Any:
        timeout = self._timeouts.get(method)
        try:
            connection = self._connect()
            connection.send((method, arguments))
            if connection.poll(timeout):
                answer, error, trace = connection.recv()
            else:
                answer, error, trace = None, BrokenExecutor(f"no answer for {timeout:g} s"), ""
        except (EOFError, OSError) as reason:  # the process has ended, or cannot start
            raise BrokenExecutor(self._end() or describe_error(reason)) from None
        if isinstance(error, BrokenExecutor):
            self._end()
        if error is not None:
            raise error from RuntimeError(f"in a worker process:\n{trace}")
        return answer

    def close(self) -> None:
        with self._lock:
            self._is_closed = True
        self._end()

    def _connect(self) -> Any:
        """Return the connection to the process, which is started if there is none."""
        with self._lock:
            if self._is_closed:
                raise BrokenExecutor("closed")
            if self._process is None:
                context = multiprocessing.get_context("spawn")  # threads and CUDA do not survive a fork
                self._connection, theirs = context.Pipe()
                process = context.Process(target=_serve, args=(theirs, self._make))
                process.start()
                theirs.close()  # so that the end of the process ends the connection
                self._process = process
            return self._connection

    def _end(self) -> str:
        """End the process, if there is one, and say in words how it has ended."""
        with self._lock:
            process, self._process = self._process, None
        if process is None:
            return ""
        process.kill()
        process.join()
        return _ending(process.exitcode)


def _serve(connection: Any, make: Callable[[], Any]) -> None:
    """Answer calls in a process. The parent receives signals as well, and says when to stop."""
    for number in SIGNALS:
        signal.signal(number, signal.SIG_IGN)
    Thread(target=_end_with_parent, daemon=True).start()
    executor = InlineExecutor(make)
    try:
        while True:
            method, arguments = connection.recv()
            try:
                answer: Any = (executor.call(method, *arguments), None, "")
            except Exception as error:
                answer = (None, error, traceback.format_exc())
            connection.send(answer)
    except (EOFError, OSError):
        pass  # the parent has ended
    except BaseException:  # SystemExit of a library, or an answer that cannot be pickled
        traceback.print_exc()
    finally:
        os._exit(1)  # threads of the object may still run


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
    is_kill = -status == getattr(signal, "SIGKILL", None)  # Windows has no such signal
    return f"signal {-status}, {signal.strsignal(-status)}" + " (out of memory?)" * is_kill
