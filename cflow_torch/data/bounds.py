"""How much of memory a file may ask for."""

from __future__ import annotations

from typing import Any

from cflow_torch.types import CFlowError

MAX_ARRAY_BYTES = 1 << 30  # of one array or column: 89 million points; a sweep of the densest sensor has 2 million


def check_claim(file: Any, what: str, num_bytes: int, limit: int = MAX_ARRAY_BYTES) -> None:
    """Refuse what a file claims to hold before memory is asked for.

    A few damaged or hostile bytes can claim 10^12 points, or unpack to a thousand times their size. Every reader asks
    here, with the size that the file claims, before it makes or unpacks an array.

    Args:
        file: name of the file, for the message.
        what: name of the array, column or member.
        num_bytes: what it would take in memory.
        limit: what it may take.

    Raises:
        CFlowError: it is negative or above the limit.
    """
    if not 0 <= num_bytes <= limit:
        raise CFlowError(
            f"{file}: {what} claims {num_bytes} bytes; up to {limit} are read at once. "
            "Is the file damaged? Copy or write it anew; one with that much data is split into sweeps"
        )
