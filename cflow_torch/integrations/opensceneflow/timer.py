"""The stop watch that the harness expects of every model."""

from __future__ import annotations

from typing import Any


class SilentTimer:
    """Stands in for `dztimer.Timing` where that is not installed: takes every call, measures and prints nothing."""

    def __getitem__(self, key: int) -> SilentTimer:
        """Any step, however deep."""
        return self

    def start(self, name: str = "") -> None:
        """Nothing."""

    def stop(self) -> None:
        """Nothing."""

    def print(self, *args: Any, **kwargs: Any) -> None:
        """Nothing."""


def make_timer() -> Any:
    """`dztimer.Timing()` if it can be imported, a `SilentTimer` otherwise."""
    try:
        import dztimer
    except ImportError:
        return SilentTimer()
    return dztimer.Timing()
