"""Calls that a thread of their own does one after the other."""

from __future__ import annotations

import queue
import threading
from typing import Any, Callable, List, Optional, Tuple


class Outcome:
    """What a call gave, or will give."""

    def __init__(self) -> None:
        self._is_there = threading.Event()
        self._value: Any = None
        self._error: Optional[BaseException] = None

    def done(self) -> bool:
        """Whether it is there."""
        return self._is_there.is_set()

    def result(self) -> Any:
        """Wait for it, and give it; raises what the call raised."""
        self._is_there.wait()
        if self._error is not None:
            raise self._error
        return self._value

    def find(self, function: Callable[..., Any], arguments: Tuple[Any, ...]) -> None:
        """Call, and keep what comes of it."""
        try:
            self._value = function(*arguments)
        except BaseException as error:  # whatever it is, who waits must hear of it
            self._error = error
        self._is_there.set()


class Line:
    """A thread; a context manager whose end waits for the calls that were given.

    Unlike an executor of `concurrent.futures`, it does not wait if its block is left by Ctrl-C, nor does the process
    when it ends: a call may be in the hands of a file system that hangs.
    """

    def __init__(self) -> None:
        self._calls: queue.Queue[Any] = queue.Queue()
        self._thread = threading.Thread(target=self._work, daemon=True)

    def __enter__(self) -> Line:
        self._thread.start()
        return self

    def __exit__(self, kind: Any, *_: Any) -> None:
        self._calls.put(None)
        if kind is None or not issubclass(kind, KeyboardInterrupt):
            self._thread.join()

    def submit(self, function: Callable[..., Any], *arguments: Any) -> Outcome:
        """Call later."""
        outcome = Outcome()
        self._calls.put((outcome, function, arguments))
        return outcome

    def _work(self) -> None:
        while True:
            call: Optional[List[Any]] = self._calls.get()
            if call is None:
                return
            outcome, function, arguments = call
            outcome.find(function, arguments)
            del call, outcome, function, arguments  # else the last frames stay until the next call
