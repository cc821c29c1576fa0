"""Timed runs that can be compared: in turn, rested, on the same number of threads."""

from __future__ import annotations

import statistics
import time
from contextlib import contextmanager
from typing import Any, Callable, Iterator, List, Sequence

import torch

from cflow_torch.fleet import machine

# Rest between two timed runs: worker threads of the library that ran before spin for some milliseconds after their
# last job, and would take the cores from the other one. (A product of large matrices in the OpenCV loop, whose BLAS
# threads spin longer than this, doubled the time of the fast path.)
_REST_SECONDS = 0.02


def alternate(runs: Sequence[Callable[[], Any]], repeats: int) -> List[List[float]]:
    """Seconds of each of `repeats` runs, taken in turn after two rounds that do not count.

    Every timed run follows an untimed one of the same kind (a A b B a A b B ...): frames come one after the other, and
    right after the rest threads are asleep and memory belongs to the other.
    """
    times: List[List[float]] = [[] for _ in runs]
    for repeat in range(-2, repeats):
        for run, seconds in zip(runs, times):
            time.sleep(_REST_SECONDS)
            run()
            start = time.perf_counter()
            run()
            if repeat >= 0:
                seconds.append(time.perf_counter() - start)
    return times


def median_ratio(ours: Sequence[float], theirs: Sequence[float]) -> float:
    """Theirs over ours, the median over neighbouring runs: a slow spell of the machine hits both. Above 1: we win."""
    return statistics.median(b / a for a, b in zip(ours, theirs))


def synchronise(tensor: torch.Tensor) -> None:
    """Wait until the tensor is computed."""
    if tensor.is_cuda:
        torch.cuda.synchronize(tensor.device)


@contextmanager
def threads(number: int) -> Iterator[None]:
    """The same number of threads for torch and OpenCV; as before afterwards."""
    import cv2

    before = cv2.getNumThreads()
    try:
        with machine.threads(number):
            cv2.setNumThreads(number)
            yield
    finally:
        cv2.setNumThreads(before)
