"""Process long arrays in chunks."""

from __future__ import annotations

from typing import Iterator

import torch

# Elements of a chunk. On a CPU the results of a chunk stay in the cache, and we need no large temporary arrays, whose
# fresh pages cost more than the arithmetic. We timed the dense method with 2^14 ... 2^18 on a window of six sweeps at
# five scales and on a pair at one. On a GPU few launches matter more.
CHUNK_ON_CPU = 1 << 17
CHUNK_ON_GPU = 1 << 26


def chunks(start: int, stop: int, device: torch.device, width: int = 1) -> Iterator[slice]:
    """Split start ... stop into chunks that suit the device. The last one may be shorter.

    Args:
        width: number of elements that the caller computes from each one.
    """
    size = max(1, (CHUNK_ON_CPU if device.type == "cpu" else CHUNK_ON_GPU) // width)
    return (slice(first, min(first + size, stop)) for first in range(start, stop, size))
