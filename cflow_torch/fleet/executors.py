"""Executors: each is a process that holds one object and calls its methods, one call at a time, as futures."""

from __future__ import annotations

import multiprocessing
import signal
import traceback
from abc import ABC, abstractmethod
from concurrent.futures import BrokenExecutor, Future, ThreadPoolExecutor
from contextlib import suppress
from threading import Lock
from typing import Any, Callable

from cflow_torch.errors import CFlowError
from cflow_torch.fleet.stop_signal import SIGNALS


class CannotStart(CFlowError):
    """The object of an executor could not be made, so no call can succeed."""


class Executor(ABC):
    """A process that holds one object. A call starts it if it has not begun, has ended or was closed."""

    @abstractmethod
    def submit(self, method: str, *arguments: Any) -> Future[Any]:
        """Call a method of the object. Errors of the future: `BrokenExecutor` if the process has ended, `CannotStart`,
        and those of the method."""

    @abstractmethod
    def close(self) -> None:
        """Kill the process, even during a call."""


class ProcessExecutor(Executor):
    """A process of this machine. It ignores `SIGNALS`. When its parent ends, it ends after its call.

    `CFlowError` and OSError arrive as they are, any other error as a RuntimeError with the traceback of the process.

    Args:
        make: called in the process; returns the object.
        arguments: of `make`. They are pickled, like the arguments and results of calls.
    """

    def __init__(self, make: Callable[..., Any], *arguments: Any) -> None:
        self._make = (make, arguments)
        self._caller = ThreadPoolExecutor(1)  # waits for the answers
        self._lock = Lock()
        self._process: Any = None
        self._pipe: Any = None

    def submit(self, method: str, *arguments: Any) -> Future[Any]:
        return self._caller.submit(self._call, method, arguments)

    def close(self) -> None:
        with self._lock:
            process, self._process = self._process, None
        if process is not None:
            process.kill()
            process.join()

    def _call(self, method: str, arguments: tuple[Any, ...]) -> Any:
        with self._lock:
            if self._process is None:
                self._start()
            process, pipe = self._process, self._pipe
        try:
            pipe.send((method, arguments))
            answer, error = pipe.recv()
        except (EOFError, OSError):
            process.join()
            how = _ending(process.exitcode)
            self.close()
            raise BrokenExecutor(how) from None
        if error is not None:
            raise error
        return answer

    def _start(self) -> None:
        context = multiprocessing.get_context("spawn")  # threads and CUDA do not survive a fork
        self._pipe, pipe = context.Pipe()
        process = context.Process(target=_serve, args=(pipe, *self._make), daemon=True)
        try:
            process.start()
        except OSError as error:
            raise BrokenExecutor(f"it could not start: {describe_error(error)}") from error
        finally:
            pipe.close()
        self._process = process


def _serve(pipe: Any, make: Callable[..., Any], make_arguments: tuple[Any, ...]) -> None:
    """Make the object at the first call, and answer calls until the parent ends."""
    for number in SIGNALS:
        signal.signal(number, signal.SIG_IGN)  # the parent receives them as well and says when to stop
    held: Any = None
    with suppress(EOFError, OSError):
        while True:
            method, arguments = pipe.recv()
            answer: Any = None
            error: Exception | None = None
            try:
                if held is None:
                    held = make_object(make, *make_arguments)
                answer = getattr(held, method)(*arguments)
            except (CFlowError, OSError, BrokenExecutor) as caught:
                error = caught
            except Exception:
                error = RuntimeError(traceback.format_exc())
            pipe.send((answer, error))


def make_object(make: Callable[..., Any], *arguments: Any) -> Any:
    """Make the object of an executor; its errors become `CannotStart`."""
    try:
        return make(*arguments)
    except Exception as error:
        raise CannotStart(describe_error(error)) from error


def describe_error(error: BaseException) -> str:
    """Describe an error in one line; its class is named unless the text says enough."""
    text = " ".join(str(error).split()) or "no message"
    return text if isinstance(error, (CFlowError, OSError, BrokenExecutor)) else f"{type(error).__name__}: {text}"


def _ending(status: int | None) -> str:
    """Describe in words how a process with this exit status has ended."""
    if status is None or status >= 0:  # None: another thread has just read the status
        return f"exit status {status}"
    return f"signal {-status}, {signal.strsignal(-status)}" + " (out of memory?)" * (-status == signal.SIGKILL)
