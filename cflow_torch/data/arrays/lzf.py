"""LZF, the byte compression in `.pcd` files and HDF5 chunks: runs of plain bytes and references to earlier output."""

from __future__ import annotations

from typing import List

import numpy as np

from cflow_torch.types import CFlowError

_LONGEST_RUN = 32  # plain bytes after one control byte
_SHORTEST_MATCH = 3
_LONGEST_MATCH = 264  # 2 + 7 + 255
_FARTHEST_MATCH = 8192  # 13 bits


def decompress(data: bytes, size: int) -> bytes:
    """Undo LZF.

    Args:
        data: the whole stream.
        size: number of bytes that must come out.

    Returns:
        `size` bytes.

    Convention:
        A control byte c < 32 is followed by c + 1 plain bytes. Any other is a reference: length (c >> 5) + 2, where
        7 in the upper bits adds one more byte to the length; the low 5 bits and one byte are distance - 1. A reference
        may reach into what it writes (then it repeats).

    Raises:
        CFlowError: the stream ends early, refers to before its start, or gives another number of bytes.

    Cost: one Python step per run or reference.
    """
    out = bytearray()
    at, end = 0, len(data)
    try:
        while at < end and len(out) <= size:
            control = data[at]
            at += 1
            if control < _LONGEST_RUN:
                out += data[at : at + control + 1]
                at += control + 1
                continue
            length = control >> 5
            if length == 7:
                length += data[at]
                at += 1
            length += 2
            distance = ((control & 31) << 8) + data[at] + 1
            at += 1
            start = len(out) - distance
            if start < 0:
                raise CFlowError("a reference reaches before the start; the data are damaged")
            repeats = -(-length // distance)
            out += (out[start : start + length] * repeats)[:length]
    except IndexError:
        raise CFlowError("the stream ends in the middle; the data are truncated") from None
    if at > end or len(out) != size:
        raise CFlowError(f"the stream holds {len(out)} bytes, expected {size}; the data are truncated or damaged")
    return bytes(out)


def compress(data: bytes) -> bytes:
    """LZF stream of some bytes; the longest match with the last place of the same three bytes.

    Args:
        data: any bytes.

    Returns:
        At most 33/32 of the size of `data`, rounded up; empty for no bytes.

    Cost: one sort of the bytes' positions and one Python step per reference.
    """
    out: List[bytes] = []
    plain = 0  # first byte that is not written yet
    previous = _previous_places(data)
    candidates = np.flatnonzero(previous >= 0).tolist()
    for at in candidates:
        if at < plain:
            continue
        start = int(previous[at])
        length = _match_length(data, start, at)
        out += _runs(data[plain:at])
        out.append(_reference(at - start, length))
        plain = at + length
    out += _runs(data[plain:])
    return b"".join(out)


def _previous_places(data: bytes) -> np.ndarray:
    """(len(data),) the last earlier place of the three bytes at each place; -1 = none within reach."""
    previous = np.full(len(data), -1, np.int64)
    if len(data) < _SHORTEST_MATCH:
        return previous
    values = np.frombuffer(data, np.uint8).astype(np.int64)
    triple = (values[:-2] << 16) | (values[1:-1] << 8) | values[2:]
    order = np.argsort(triple, kind="stable")
    earlier, later = order[:-1], order[1:]
    usable = (triple[earlier] == triple[later]) & (later - earlier <= _FARTHEST_MATCH)
    previous[later[usable]] = earlier[usable]
    return previous


def _match_length(data: bytes, start: int, at: int) -> int:
    """How many bytes agree from two places on, at most `_LONGEST_MATCH`."""
    length = min(_LONGEST_MATCH, len(data) - at)
    difference = int.from_bytes(data[start : start + length], "little") ^ int.from_bytes(
        data[at : at + length], "little"
    )
    lowest = difference & -difference  # the lowest bit set lies in the first byte that differs
    return length if difference == 0 else (lowest.bit_length() - 1) // 8


def _runs(data: bytes) -> List[bytes]:
    pieces = [data[i : i + _LONGEST_RUN] for i in range(0, len(data), _LONGEST_RUN)]
    return [bytes([len(piece) - 1]) + piece for piece in pieces]


def _reference(distance: int, length: int) -> bytes:
    high, low = divmod(distance - 1, 256)
    if length < 9:
        return bytes([(length - 2) << 5 | high, low])
    return bytes([7 << 5 | high, length - 9, low])
