"""How far a run is: a bar on a terminal; elsewhere, in a log file say, a line now and then."""

from __future__ import annotations

import os
import sys
import time
from contextlib import contextmanager, suppress
from typing import Any, Callable, Iterable, Iterator, Optional, Sized

from tqdm import tqdm

EVERY = 30.0  # seconds between two lines
_BAR = "{desc}{percentage:3.0f}%|{bar}| {n_fmt}/{total_fmt} frames [{elapsed}<{remaining}, {rate_noinv_fmt}]"


class Progress:
    """Counts frames; a context manager.

    Args:
        total: frames in all, None = not known yet; may be set later.
        name: what is done to them, "" = nothing to say.
        clock: seconds from any start.

    Convention: on stderr. Frames per second are those of the last while, not of the whole run.
    """

    def __init__(
        self, total: Optional[int] = None, name: str = "", clock: Callable[[], float] = time.monotonic
    ) -> None:
        self.total, self.done, self._name, self._clock = total, 0, name, clock
        self._said_at, self._said_done = clock(), 0
        bar_format = _BAR.replace("{desc}", f"{name}: " if name else "")
        try:
            self._bar: Any = tqdm(total=total, unit=" frames", disable=None, smoothing=0.05, bar_format=bar_format)
        except OSError:  # it is drawn at once, and the terminal may be gone
            self._bar = tqdm(total=total, disable=True)

    def __enter__(self) -> Progress:
        return self

    def __exit__(self, *_: Any) -> None:
        if self.total is None:
            self.total = self.done
        self._bar.total = self.total
        with _unheard():
            self._bar.refresh()
            self._bar.close()

    def update(self, frames: int = 1) -> None:
        """So many frames more are done."""
        self.done += frames
        self._bar.total = self.total
        with _unheard():
            self._bar.update(frames)
        if self._bar.disable and self._clock() - self._said_at >= EVERY:
            self._say()

    def _say(self) -> None:
        now = self._clock()
        rate = (self.done - self._said_done) / (now - self._said_at)
        self._said_at, self._said_done = now, self.done
        of, left = "", ""
        if self.total is not None:
            of = f" of {self.total:,}"
            if rate > 0:
                left = f", {tqdm.format_interval(max(0, self.total - self.done) / rate)} left"
        prefix = f"{self._name}: " if self._name else ""
        say(f"{prefix}{self.done:,}{of} frames, {rate:.2f} frames/s{left}")


def say(text: str) -> None:
    """A line on stderr, above the bar; the work goes on even if nobody hears it."""
    with _unheard():
        tqdm.write(text, file=sys.stderr)
        sys.stderr.flush()


@contextmanager
def _unheard() -> Iterator[None]:
    """What is said on the way may be lost: a terminal that was closed, a full disk, a `tee` that Ctrl-C ended."""
    try:
        yield
    except OSError:
        with suppress(OSError):
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stderr.fileno())  # else the rest is tried again at the end


def frames(items: Iterable[Any], name: str = "") -> Iterator[Any]:
    """The items, a frame each, with progress."""
    with Progress(len(items) if isinstance(items, Sized) else None, name) as progress:
        for item in items:
            yield item
            progress.update()
