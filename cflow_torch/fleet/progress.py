"""How far a run is: a bar on a terminal; elsewhere, in a log file say, a line now and then."""

from __future__ import annotations

import os
import sys
from contextlib import contextmanager, suppress
from typing import Any, Iterable, Iterator, Optional, Sized

from tqdm import tqdm

EVERY = 30.0  # seconds between two lines
_BAR = "{desc}{percentage:3.0f}%|{bar}| {n_fmt}/{total_fmt} frames [{elapsed}<{remaining}, {rate_noinv_fmt}]"
_LINE = "{desc}{n_fmt} of {total_fmt} frames, {rate_noinv_fmt}, {remaining} left"


class Progress:
    """Counts frames; a context manager.

    Args:
        total: frames in all, None = not known yet; may be set later.
        name: what is done to them, "" = nothing to say.

    Convention: on stderr. Frames per second are those of the last while, not of the whole run.
    """

    def __init__(self, total: Optional[int] = None, name: str = "") -> None:
        self.total, self.done = total, 0
        settings = {"total": total, "unit": " frames", "smoothing": 0.05, "desc": f"{name}: " if name else ""}
        try:
            if sys.stderr.isatty():
                self._bar: Any = tqdm(bar_format=_BAR, **settings)
            else:  # a short run says nothing
                self._bar = tqdm(
                    file=_Lines(), bar_format=_LINE, mininterval=EVERY, miniters=1, delay=EVERY, **settings
                )
        except OSError:  # it is drawn at once, and the terminal may be gone
            self._bar = tqdm(disable=True)

    def __enter__(self) -> Progress:
        return self

    def __exit__(self, *_: Any) -> None:
        self._bar.total = self.done if self.total is None else self.total
        with _unheard():
            self._bar.close()

    def update(self, frames: int = 1) -> None:
        """So many frames more are done."""
        self.done += frames
        self._bar.total = self.total
        with _unheard():
            self._bar.update(frames)


class _Lines:
    """What a bar writes, a line each time."""

    def write(self, text: str) -> None:
        if text.strip():
            sys.stderr.write(text.strip() + "\n")

    def flush(self) -> None:
        sys.stderr.flush()


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
