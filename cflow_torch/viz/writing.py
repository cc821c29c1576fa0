"""Files that appear whole or not at all, and whose error it is if one is raised while they are written."""

from __future__ import annotations

import os
from contextlib import contextmanager
from pathlib import Path
from typing import Iterable, Iterator, Optional, TypeVar

from cflow_torch.data.atomic import atomic_name
from cflow_torch.types import CFlowError

T = TypeVar("T")


class Source(Iterator[T]):
    """Passes items on and keeps what their iterable itself raised, which is no error of writing.

    Args:
        items: anything; taken one by one.
    """

    def __init__(self, items: Iterable[T]) -> None:
        self.items = iter(items)
        self.error: Optional[BaseException] = None

    def __next__(self) -> T:
        try:
            return next(self.items)
        except Exception as error:
            self.error = error
            raise


@contextmanager
def whole_file(path: Path, *endings: str, source: Optional[Source] = None) -> Iterator[Path]:
    """A file that takes its name when the block ends; if the block raises, an older file of that name stays.

    Args:
        path: final name; its folder is made if absent.
        endings: one of them is the path's.
        source: what is read while the file is written; what it raises stays as it is.

    Yields:
        The temporary name to write to.

    Raises:
        CFlowError: another ending, or the file cannot be written.
    """
    if path.suffix.lower() not in endings:
        raise CFlowError(f"{path} does not end in {' or '.join(endings)}: give a file that does")
    try:
        with atomic_name(path) as temporary:
            yield temporary
            with open(temporary, "rb+") as file:
                os.fsync(file.fileno())
    except OSError as error:
        if source is not None and error is source.error:
            raise
        raise CFlowError(f"cannot write {path}: {error}") from error
