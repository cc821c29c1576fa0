"""Long arrays piece by piece."""

from __future__ import annotations

from typing import Iterator

import torch

# Elements of a piece. On a CPU what is computed from a piece stays in the cache, and no large temporary array is asked
# of the system, whose fresh pages cost more than the arithmetic. 2^14 ... 2^18 were tried on a window of six sweeps
# with five scales and on a pair with one (stage times of the dense method). A GPU wants few launches.
CHUNK_ON_CPU = 1 << 17
CHUNK_ON_GPU = 1 << 26


def chunks(start: int, stop: int, device: torch.device, width: int = 1) -> Iterator[slice]:
    """start ... stop in pieces of the size that suits the device; the last one may be shorter.

    Args:
        width: how many elements are computed from each.
    """
    size = max(1, (CHUNK_ON_CPU if device.type == "cpu" else CHUNK_ON_GPU) // width)
    return (slice(first, min(first + size, stop)) for first in range(start, stop, size))
