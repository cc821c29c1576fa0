"""Files that appear whole or not at all."""

from __future__ import annotations

import os
from contextlib import contextmanager
from pathlib import Path
from typing import Iterator

from cflow_torch.data.atomic import atomic_name
from cflow_torch.types import CFlowError


@contextmanager
def whole_file(path: Path, *endings: str) -> Iterator[Path]:
    """A file that takes its name when the block ends; if the block raises, an older file of that name stays.

    Args:
        path: final name; its folder is made if absent.
        endings: one of them is the path's.

    Yields:
        The temporary name to write to.

    Raises:
        CFlowError: another ending.
        OSError: the file cannot be written.
    """
    if path.suffix.lower() not in endings:
        raise CFlowError(f"{path} does not end in {' or '.join(endings)}: give a file that does")
    with atomic_name(path) as temporary:
        yield temporary
        with open(temporary, "rb+") as file:
            os.fsync(file.fileno())
