"""Items from elsewhere that are written as they come, and whose error it was if one is raised on the way."""

from __future__ import annotations

from typing import Iterable, Iterator, Optional, TypeVar

T = TypeVar("T")


class Source(Iterator[T]):
    """Passes items on and keeps what their iterable itself raised, which a writer must not take for its own.

    Args:
        items: anything; taken one by one.
    """

    def __init__(self, items: Iterable[T]) -> None:
        self.items = iter(items)
        self.error: Optional[Exception] = None

    def __next__(self) -> T:
        try:
            return next(self.items)
        except StopIteration:
            raise
        except Exception as error:
            self.error = error
            raise
