"""Thrift's compact protocol, read as far as parquet needs it: what lies in known fields of the right type."""

from __future__ import annotations

from typing import Any, Dict

I32, I64, TEXT = 5, 6, 8
_STRUCT = 12
_FIXED = {3: 1, 7: 8}  # bytes of an entry of these types: byte, double
_MAX_DEPTH = 16  # parquet's own structures go seven deep


class Compact:
    """Reader of one message.

    Args:
        data: bytes that begin with a structure.

    Attributes:
        at: where the reader stands.
    """

    def __init__(self, data: bytes) -> None:
        self._data, self.at = data, 0

    def structure(self, wanted: Dict[int, Any], depth: int = 0) -> Dict[int, Any]:
        """Fields of a structure.

        Args:
            wanted: field number -> I32, I64, TEXT, the `wanted` of a structure, or [that] for a list of structures.
            depth: of the nesting so far.

        Returns:
            Field number -> int, bytes, structure, list. As in Thrift, fields of another type are passed over, and of
            a field that occurs twice the last one counts.

        Raises:
            IndexError: the data end too early.
            ValueError: they are no such message.
        """
        if depth > _MAX_DEPTH:
            raise ValueError("structures are nested too deep")
        fields: Dict[int, Any] = {}
        data, number = self._data, 0
        while True:
            head = data[self.at]
            self.at += 1
            if head == 0:
                return fields
            kind, step = head & 15, head >> 4
            number = number + step if step else self._integer(32)
            want = wanted.get(number)
            if want is None:
                self._skip(kind, depth)
            elif kind in (I32, I64) and want == kind:
                fields[number] = self._integer(32 if kind == I32 else 64)
            elif kind == TEXT == want:
                fields[number] = self._text()
            elif kind == _STRUCT and isinstance(want, dict):
                fields[number] = {**fields.get(number, {}), **self.structure(want, depth + 1)}
            elif kind == 9 and isinstance(want, list):
                count, of = self._list_head()
                if of != _STRUCT:
                    raise ValueError("a list holds something else than structures")
                fields[number] = [self.structure(want[0], depth + 1) for _ in range(count)]
            else:
                self._skip(kind, depth)

    def _varint(self) -> int:
        value = shift = 0
        while shift < 70:
            byte = self._data[self.at]
            self.at += 1
            value |= (byte & 127) << shift
            if byte < 128:
                return value
            shift += 7
        raise ValueError("a number has no end")

    def _integer(self, bits: int) -> int:
        value = self._varint() & ((1 << bits) - 1)
        return (value >> 1) ^ -(value & 1)

    def _text(self) -> bytes:
        length = self._varint()
        start = self.at
        self.at += length
        if self.at > len(self._data):
            raise IndexError("a text is cut")
        return self._data[start : self.at]

    def _list_head(self) -> Any:
        head = self._data[self.at]
        self.at += 1
        count = head >> 4
        if count == 15:
            count = self._varint()
        if count > len(self._data) - self.at:
            raise IndexError("a list is longer than the data")
        return count, head & 15

    def _skip(self, kind: int, depth: int, in_list: bool = False) -> None:
        if kind in (4, I32, I64):
            self._varint()
        elif kind == TEXT:
            self._text()
        elif kind in (1, 2):
            self.at += 1 if in_list else 0
        elif kind in _FIXED:
            self.at += _FIXED[kind]
        elif kind == _STRUCT:
            self.structure({}, depth + 1)
        elif kind in (9, 10) and depth <= _MAX_DEPTH:
            count, of = self._list_head()
            for _ in range(count):
                self._skip(of, depth + 1, in_list=True)
        else:
            raise ValueError(f"a field has type {kind}")
        if self.at > len(self._data):
            raise IndexError("a field is cut")
