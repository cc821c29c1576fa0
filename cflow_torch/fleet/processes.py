"""Child processes that answer calls, and the signals that end a run."""

from __future__ import annotations

import multiprocessing
import os
import signal
import traceback
from contextlib import suppress
from typing import Any, Callable, Iterator

from cflow_torch.errors import CFlowError

SIGNALS = [getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)]  # end a run


class WorkerDied(CFlowError):
    """A worker process has ended before it answered, or must be replaced. The text says how, as in "with status 70"."""


class ChildProcess:
    """A child process that answers one call at a time. It ignores `SIGNALS` and ends when its parent does.

    Args:
        make: called in the child process; returns the generator function that answers calls. Its arguments are those
            of the call and, as the last one, a function that returns True after `stop`.
        arguments: of `make`. They are pickled, like the arguments and results of calls.
        timeout: seconds after which a process that has not answered is ended; None = no limit.
    """

    def __init__(self, make: Callable[..., Callable[..., Iterator[Any]]], *arguments: Any, timeout: Any = None) -> None:
        self._make, self._arguments, self._timeout = make, arguments, timeout
        self._process: Any = None
        self._pipe: Any = None

    def start(self) -> None:
        """Start a new process and wait until `make` has returned; `WorkerDied` if the process ends or cannot start.

        `CFlowError` and OSError of `make` are raised here. Any other error is a RuntimeError with the child's
        traceback.
        """
        self.close()
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
        list(self._answers())

    def call(self, *arguments: Any) -> Iterator[Any]:
        """Yield the answers to a call as they arrive; start a process if there is none. Errors as in `start`."""
        if self._process is None:
            self.start()
        with suppress(OSError):  # the process has died: `_answers` finds out how
            self._pipe.send(arguments)
        yield from self._answers()

    def stop(self) -> None:
        """Tell running and later calls to end soon. Another thread may be in `call`."""
        if self._process is not None:
            with suppress(OSError):
                self._pipe.send(None)

    def close(self) -> None:
        """Kill the process, even during a call."""
        process, self._process = self._process, None
        if process is not None:
            process.kill()
            process.join()
            self._pipe.close()

    def _answers(self) -> Iterator[Any]:
        process, has_ended = self._process, False
        while not has_ended:
            how = ""
            try:
                if self._pipe.poll(self._timeout):
                    answer, error, has_ended = self._pipe.recv()
                else:
                    how = f"after {self._timeout:g} s without an answer"
            except (EOFError, OSError):
                process.join()
                how = _how(process.exitcode)
            if how:
                self.close()
                raise WorkerDied(how)
            if error is not None:
                raise error
            if not has_ended:
                yield answer


def _serve(pipe: Any, make: Callable[..., Any], arguments: Any) -> None:
    """Make the function, then answer calls until the parent closes the pipe or ends."""
    for number in SIGNALS:
        signal.signal(number, signal.SIG_IGN)  # the parent receives them as well and says when to stop
    function, is_stopped = None, False

    def stop() -> bool:
        return is_stopped or pipe.poll()  # during a call the parent sends nothing but the stop

    with suppress(EOFError, OSError):
        while True:
            error: Exception | None = None
            try:
                if function is None:
                    function = make(*arguments)
                else:
                    for answer in function(*arguments, stop):
                        pipe.send((answer, None, False))
            except (CFlowError, OSError) as caught:
                error = caught
            except Exception:
                error = RuntimeError(traceback.format_exc())
            pipe.send((None, error, True))
            if function is None:
                return
            arguments = pipe.recv()
            while arguments is None:  # from `ChildProcess.stop`
                is_stopped, arguments = True, pipe.recv()


def _how(status: int | None) -> str:
    """Describe in words how a process with this exit status has ended."""
    if status is None or status >= 0:  # None: another thread has just read the status
        return f"with status {status}"
    return f"by signal {-status}, {signal.strsignal(-status)}" + " (out of memory?)" * (-status == signal.SIGKILL)


class StopSignal:
    """A context in which the first of `SIGNALS` only sets `received`, and the second one raises KeyboardInterrupt.

    Schedulers send SIGTERM some seconds before they kill (preemption, time limit). Python handles signals in the main
    thread only; in other threads this does nothing.
    """

    def __init__(self) -> None:
        self.received: int | None = None
        self._before: dict[int, Any] = {}

    def __enter__(self) -> StopSignal:
        with suppress(ValueError):  # in another thread
            for number in SIGNALS:
                if number == signal.SIGINT or signal.getsignal(number) is not signal.SIG_IGN:  # nohup ignores SIGHUP
                    self._before[number] = signal.signal(number, self._receive)
        return self

    def __exit__(self, *_: Any) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)

    def __call__(self) -> bool:
        return self.received is not None

    def _receive(self, number: int, _: Any) -> None:
        if self.received is not None:
            raise KeyboardInterrupt
        self.received = number
        name = signal.Signals(number).name
        with suppress(OSError):  # `print` is not safe here: the signal may interrupt another `print`
            os.write(2, f"\n{name}: finishing the frames that have begun; repeat the signal to end at once\n".encode())
