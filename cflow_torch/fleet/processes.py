"""Child processes that answer calls. A process that has died is started again."""

from __future__ import annotations

import multiprocessing
import signal
import traceback
from contextlib import suppress
from typing import Any, Callable

from cflow_torch.types import CFlowError

SIGNALS = [getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)]  # end a run


class WorkerDied(Exception):
    """A worker process has ended before it answered. The text says how, for example "with status 70"."""


class ChildProcess:
    """A child process that answers one call at a time. Its methods block.

    Args:
        make: called in the child process; returns the function that answers the calls.
        arguments: of `make`. They are pickled, like all that a call takes and returns.
        timeout: seconds after which a process that has not answered is ended; None = no limit.

    Convention: the child process ignores `SIGNALS` and ends when its parent does.
    """

    def __init__(self, make: Callable[..., Callable[..., Any]], *arguments: Any, timeout: float | None = None) -> None:
        self._make, self._arguments, self._timeout = make, arguments, timeout
        self._process: Any = None
        self._pipe: Any = None

    def start(self) -> None:
        """Start the process and wait until `make` has returned.

        Raises:
            WorkerDied: the process has ended, or cannot be started.
            CFlowError, OSError: raised by `make`. Any other error is a RuntimeError with the child's traceback.
        """
        context = multiprocessing.get_context("spawn")  # threads and CUDA do not survive a fork
        self._pipe, pipe = context.Pipe()
        self._process = context.Process(target=_serve, args=(pipe, self._make, self._arguments), daemon=True)
        try:
            self._process.start()
        except OSError as error:
            self._process = None
            raise WorkerDied(f"at its start ({error})") from error
        finally:
            pipe.close()
        self._answer()

    def call(self, *arguments: Any) -> Any:
        """Return the answer to a call. If there is no process, one is started first.

        Raises:
            WorkerDied, CFlowError, OSError, RuntimeError: as `start`, also from the call.
        """
        if self._process is None:
            self.start()
        with suppress(OSError):  # the process has died: `_answer` finds out how
            self._pipe.send(arguments)
        return self._answer()

    def close(self) -> None:
        """Kill the process, whatever it does."""
        process, self._process = self._process, None
        if process is not None:
            process.kill()
            process.join()
            self._pipe.close()

    def _answer(self) -> Any:
        process = self._process
        try:
            is_there = self._pipe.poll(self._timeout)
            answer, error = self._pipe.recv() if is_there else (None, None)
            how = "" if is_there else f"after {self._timeout:g} s without an answer"
        except (EOFError, OSError):
            process.join()
            how = _how(process.exitcode)
        if how:
            self.close()
            raise WorkerDied(how)
        if error is not None:
            raise error
        return answer


def _serve(pipe: Any, make: Callable[..., Any], arguments: tuple[Any, ...]) -> None:
    """Answer calls until the parent closes the pipe or ends."""
    for number in SIGNALS:
        signal.signal(number, signal.SIG_IGN)  # the parent receives them as well and says when to stop
    with suppress(EOFError, OSError):
        answer, error = _attempt(make, arguments)
        pipe.send((None, error))
        while answer is not None:
            pipe.send(_attempt(answer, pipe.recv()))


def _attempt(function: Callable[..., Any], arguments: tuple[Any, ...]) -> tuple[Any, Exception | None]:
    """(what a function returns, what it raises)."""
    try:
        return function(*arguments), None
    except (CFlowError, OSError) as error:
        return None, error
    except Exception:
        return None, RuntimeError(traceback.format_exc())


def _how(status: int | None) -> str:
    """How a process with this exit status has ended."""
    if status is None or status >= 0:  # None: another thread has just received it
        return f"with status {status}"
    return f"by signal {-status}, {signal.strsignal(-status)}" + " (out of memory?)" * (-status == signal.SIGKILL)
