"""A function for child processes, in a file of its own because they import the file, and torch takes seconds."""

from __future__ import annotations

from typing import Any, Callable, Iterator


def make_countdown(count: int) -> Callable[..., Iterator[Any]]:
    def countdown(number: int, stop: Callable[[], bool]) -> Iterator[Any]:
        yield from (number / k for k in range(count, 0, -1))
        yield 1 / number and stop()

    return countdown
