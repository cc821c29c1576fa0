"""Limit torch to one thread. More threads do not speed a window up, and slow it down when other processes run."""

from __future__ import annotations

from contextlib import contextmanager
from typing import Iterator

import torch


@contextmanager
def one_thread() -> Iterator[None]:
    """Use one thread of torch in this block, then as many as before. It is also a decorator.

    Convention: torch keeps one setting per Python thread. A Python thread that uses torch for the first time in the
    meantime starts with one thread, too.
    """
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)
