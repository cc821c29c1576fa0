"""Ctrl-C, SIGTERM and SIGHUP: finish what is in hand, then end; at the second signal, end at once."""

from __future__ import annotations

import os
import signal
import threading
from contextlib import suppress
from typing import Any, Dict, Optional

SIGNALS = [signal.SIGINT, signal.SIGTERM]
if hasattr(signal, "SIGHUP"):  # the terminal is gone
    SIGNALS.append(signal.SIGHUP)


class StopSignal:
    """While it is open, the first signal only sets `received`; the second raises KeyboardInterrupt.

    Schedulers send SIGTERM some seconds before they kill (preemption, time limit). Outside the main thread, where
    Python cannot catch signals, it does nothing.
    """

    def __init__(self) -> None:
        self.received: Optional[int] = None
        self._before: Dict[int, Any] = {}

    def __enter__(self) -> StopSignal:
        if threading.current_thread() is threading.main_thread():
            for number in SIGNALS:
                if number == signal.SIGINT or signal.getsignal(number) is not signal.SIG_IGN:  # nohup stays nohup
                    self._before[number] = signal.signal(number, self._receive)
        return self

    def __exit__(self, *_: Any) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)

    def __call__(self) -> bool:
        """Whether to stop."""
        return self.received is not None

    def _receive(self, number: int, _: Any) -> None:
        if self.received is not None:
            raise KeyboardInterrupt
        self.received = number
        name = signal.Signals(number).name
        # Not print: the signal may have come in the middle of one. Nobody may read it any more (`| head`).
        with suppress(OSError):
            os.write(2, f"\n{name}: finishing the frames in hand; once more to end at once\n".encode())
