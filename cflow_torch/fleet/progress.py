"""How far a run is: a bar on a terminal; elsewhere, in a log file say, a line now and then."""

from __future__ import annotations

import os
import sys
from contextlib import suppress
from typing import Any, Iterable, Iterator, Sized

from tqdm import tqdm

EVERY = 30.0  # seconds between two lines
_BAR = "{desc}{percentage:3.0f}%|{bar}| {n_fmt}/{total_fmt} frames [{elapsed}<{remaining}, {rate_noinv_fmt}]"
_LINE = "{desc}{n_fmt} of {total_fmt} frames, {rate_noinv_fmt}, {remaining} left"


class _Stderr:
    """What is said may be lost: a terminal that was closed, a full disk, a `tee` that Ctrl-C ended."""

    def write(self, text: str) -> None:
        try:
            sys.stderr.write(text)
            sys.stderr.flush()
        except OSError:
            with suppress(OSError):
                os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stderr.fileno())  # else the rest is tried at the end

    def flush(self) -> None:
        """It is flushed."""

    def __getattr__(self, name: str) -> Any:
        return getattr(sys.stderr, name)


class _Lines(_Stderr):
    """What a bar writes, a line each time."""

    def write(self, text: str) -> None:
        if text.strip():
            super().write(text.strip() + "\n")


_STDERR = _Stderr()


class Progress(tqdm):  # type: ignore[type-arg]
    """Counts frames; a context manager, as every bar of tqdm.

    Args:
        total: frames in all, None = not known yet; may be set later.
        name: what is done to them, "" = nothing to say.

    Convention: on stderr. Frames per second are those of the last while, not of the whole run.
    """

    def __init__(self, total: int | None = None, name: str = "") -> None:
        settings = {"total": total, "unit": " frames", "smoothing": 0.05, "desc": f"{name}: " if name else ""}
        if sys.stderr.isatty():
            super().__init__(file=_STDERR, bar_format=_BAR, **settings)
        else:  # a short run says nothing
            super().__init__(file=_Lines(), bar_format=_LINE, mininterval=EVERY, miniters=1, delay=EVERY, **settings)


def log_line(text: str) -> None:
    """A line on stderr, above the bar; the work goes on even if nobody hears it."""
    tqdm.write(text, file=_STDERR)


def frames(items: Iterable[Any], name: str = "") -> Iterator[Any]:
    """The items, a frame each, with progress."""
    with Progress(len(items) if isinstance(items, Sized) else None, name) as progress:
        for item in items:
            yield item
            progress.update()
