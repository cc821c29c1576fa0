"""The progress of a run: a bar on a terminal; elsewhere, for example in a log file, a line every 30 seconds."""

from __future__ import annotations

import sys
import warnings
from contextlib import suppress
from typing import Any, Iterable

from tqdm import tqdm

EVERY = 30.0  # seconds between two lines
_BAR = "{desc}{percentage:3.0f}%|{bar}| {n_fmt}/{total_fmt} frames [{elapsed}<{remaining}, {rate_noinv_fmt}]"
_LINE = "{desc}{n_fmt} of {total_fmt} frames, {rate_noinv_fmt}, {remaining} left"


class _Stderr:
    """Standard error; if it is gone (a closed terminal), the run goes on, and the text is lost.

    Unless it is a terminal, each text of a bar is a line of its own.
    """

    def write(self, text: str) -> None:
        if not sys.stderr.isatty():
            text = text.strip() and text.strip() + "\n"
        with suppress(OSError):
            sys.stderr.write(text)
            sys.stderr.flush()

    def flush(self) -> None:
        pass

    def __getattr__(self, name: str) -> Any:
        return getattr(sys.stderr, name)


_STDERR = _Stderr()  # one object: `log_line` clears only bars of the same file


class Progress(tqdm):  # type: ignore[type-arg]
    """Counts frames and shows the count on stderr. It is a context manager and iterates over frames, as any tqdm bar.

    The `total` is None while it is not known, and may be set later. The `name` is shown before the count.
    """

    def __init__(self, frames: Iterable[Any] | None = None, name: str = "", total: int | None = None) -> None:
        form: dict[str, Any] = {"bar_format": _BAR}
        if not sys.stderr.isatty():  # a short run prints nothing
            form = {"bar_format": _LINE, "mininterval": EVERY, "miniters": 1, "delay": EVERY}
        desc = f"{name}: " if name else ""
        super().__init__(frames, desc, total, file=_STDERR, unit=" frames", smoothing=0.05, **form)


def log_line(text: str) -> None:
    """Print a line on stderr, on a terminal above the bar."""
    if sys.stderr.isatty():
        tqdm.write(text, file=_STDERR)
    else:
        _STDERR.write(f"{text}\n")


def show_warnings_as_lines() -> None:
    """From now on, show each warning once, as a line without the path of a source file."""
    shown: set[str] = set()

    def show(message: Warning | str, *_: Any, **__: Any) -> None:
        if str(message) not in shown:
            shown.add(str(message))
            log_line(f"warning: {message}")

    warnings.showwarning = show
