"""The signals that end a run."""

from __future__ import annotations

import os
import signal
from contextlib import suppress
from typing import Any

SIGNALS = [getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)]  # end a run


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
