"""What a feather file claims to hold, summed up before Arrow unpacks anything.

Arrow's IPC file: "ARROW1", batches, a footer that lists them, its length, "ARROW1". A batch is a FlatBuffers message
that lists buffers, and then these; a compressed buffer begins with the size that it claims to have unpacked, which
Arrow believes and asks the system for.
"""

from __future__ import annotations

import struct
from typing import Any, Iterator, Tuple

from cflow_torch.data.bounds import check_claim
from cflow_torch.types import CFlowError

_MAGIC = b"ARROW1"
_OLD_COMPRESSION = b"ARROW:experimental_compression"  # Arrow 0.17 said so in the metadata of a batch
_DICTIONARY, _BATCH = 2, 3  # kinds of message
_ROW = 12  # bytes of a point; columns of runs or of nothing have none in the file, but each row has some in memory
_MAX_METADATA = 1 << 22  # bytes of all batches' lists of buffers; 500 for 65,536 rows are usual


def check_feather_claims(file: Any, data: bytes) -> int:
    """Refuse a file that would take too much memory.

    Args:
        file: name, for messages.
        data: contents of the file.

    Returns:
        Number of rows.

    Raises:
        CFlowError: no feather file, or its columns together are larger than `bounds.MAX_ARRAY_BYTES`.
    """
    if data[:4] == b"FEA1":
        raise CFlowError(
            f"cannot read {file}: it is of feather's version 1, whose reader trusts every number in it; "
            f"write it anew: pyarrow.feather.write_feather(pyarrow.feather.read_table(old), new)"
        )
    try:
        rows, num_bytes = _claims(data)
    except (struct.error, IndexError) as error:
        raise CFlowError(
            f"cannot read {file}: no feather file ({error}); it may be truncated, copy it again"
        ) from error
    check_claim(file, f"its {rows} rows", rows * _ROW if rows >= 0 else -1)
    check_claim(file, "the sum of its columns", num_bytes)
    return rows


def _claims(data: bytes) -> Tuple[int, int]:
    """Rows, and bytes of all buffers when unpacked; -1 for a negative claim."""
    if not data.startswith(_MAGIC) or not data.endswith(_MAGIC):
        raise IndexError(f"it does not begin and end with {_MAGIC.decode()}")
    size = _number(data, "<i", len(data) - len(_MAGIC) - 4)
    start = len(data) - len(_MAGIC) - 4 - size
    if not 0 < size <= start:
        raise IndexError("its footer is longer than the file")
    footer = _Table(data, start + _number(data, "<I", start))
    rows = num_bytes = covered = metadata = 0
    for field in (2, 3):  # dictionaries, batches
        for block in footer.entries(field, 24):
            offset, length = _number(data, "<q", block), _number(data, "<i", block + 8)
            kind, message = _message(data, offset, length)
            if kind not in (_DICTIONARY, _BATCH):
                raise IndexError("its footer lists a message that is no batch")
            body = message.scalar(3, "<q")
            covered, metadata = covered + length + body, metadata + length
            if body < 0 or covered > len(data):
                raise IndexError("its batches are longer than the file")
            if metadata > _MAX_METADATA:  # which takes about a second
                raise IndexError(f"its lists of buffers have more than {_MAX_METADATA} bytes")
            batch = message.table(2)
            if kind == _DICTIONARY:
                batch = batch.table(1)
            here = batch.scalar(0, "<q")
            if here < 0:
                return -1, -1
            rows += here if field == 3 else 0
            num_bytes += _bytes_of(batch, offset + length, body, data[offset : offset + length])
    return rows, num_bytes


def _message(data: bytes, offset: int, length: int) -> Tuple[int, _Table]:
    """Kind and contents of the message at an offset."""
    if offset < 0 or length < 8 or offset + length > len(data):
        raise IndexError("a batch lies outside of the file")
    start = offset + (8 if _number(data, "<i", offset) == -1 else 4)  # older files have no such mark
    message = _Table(data, start + _number(data, "<I", start))
    return message.scalar(1, "<B"), message


def _bytes_of(batch: _Table, start: int, size: int, metadata: bytes) -> int:
    """Bytes of a batch's buffers when unpacked, each of which must lie in its body."""
    for entry in batch.entries(1, 16):
        length, nulls = _number(batch.data, "<q", entry), _number(batch.data, "<q", entry + 8)
        if length < 0 or not -1 <= nulls <= length:
            raise IndexError(f"a column has {length} entries, {nulls} of them empty")
    compressed = batch.has(3) or _OLD_COMPRESSION in metadata
    total = 0
    for entry in batch.entries(2, 16):
        offset, length = _number(batch.data, "<q", entry), _number(batch.data, "<q", entry + 8)
        if offset < 0 or length < 0 or offset + length > size:  # Arrow does not see where the sum overflows
            raise IndexError("a buffer lies outside of its batch")
        if compressed and length >= 8:
            unpacked = _number(batch.data, "<q", start + offset)
            if unpacked < -1:
                raise IndexError(f"a buffer claims {unpacked} bytes")
            length = length if unpacked == -1 else unpacked  # -1: this one is stored as it is
        total += length
    return total


def _number(data: bytes, form: str, at: int) -> int:
    if not 0 <= at <= len(data):
        raise IndexError("an offset points out of the file")
    number: int = struct.unpack_from(form, data, at)[0]
    return number


class _Table:
    """A FlatBuffers table: its fields are found by number through a table of offsets.

    Args:
        data: what it lies in.
        at: where.
    """

    def __init__(self, data: bytes, at: int) -> None:
        self.data, self._at = data, at
        self._offsets = at - _number(data, "<i", at)
        self._num_fields = (_number(data, "<H", self._offsets) - 4) // 2

    def _field(self, number: int) -> int:
        """Where it lies; 0 if it is absent."""
        offset = _number(self.data, "<H", self._offsets + 4 + 2 * number) if number < self._num_fields else 0
        return self._at + offset if offset else 0

    def has(self, number: int) -> bool:
        return self._field(number) > 0

    def scalar(self, number: int, form: str) -> int:
        at = self._field(number)
        return _number(self.data, form, at) if at else 0

    def table(self, number: int) -> _Table:
        at = self._field(number)
        if not at:
            raise IndexError("a batch is empty")
        return _Table(self.data, at + _number(self.data, "<I", at))

    def entries(self, number: int, size: int) -> Iterator[int]:
        """Where the entries of a vector of structures lie."""
        at = self._field(number)
        if not at:
            return iter(())
        start = at + _number(self.data, "<I", at)
        count = _number(self.data, "<I", start)
        if start + 4 + count * size > len(self.data):
            raise IndexError("a list is longer than the file")
        return iter(range(start + 4, start + 4 + count * size, size))
