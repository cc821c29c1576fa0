"""LZF, the byte compression in HDF5 chunks: runs of plain bytes and references to earlier output."""

from __future__ import annotations

from cflow_torch.types import CFlowError

_LONGEST_RUN = 32  # plain bytes after one control byte


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
