"""One thread of torch: threads inside a window gain nothing, and cost much as soon as something else runs."""

from __future__ import annotations

from contextlib import contextmanager
from typing import Iterator

import torch


@contextmanager
def one_thread() -> Iterator[None]:
    """One thread of torch while the block lasts, then as many as before; also a decorator of functions.

    Convention: torch keeps a number per thread of Python. One that uses torch for the first time meanwhile starts with
    one as well.
    """
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)
