"""Point clouds in the PLY format: the properties of the element `vertex`, as text or binary.

No library reads all that we need. meshio 5.3.5 does not know `float64`, `short` and `ushort` in binary files (PDAL
writes them), reads `uchar` as signed, and does not notice missing points. The licence of plyfile is the GPL.
"""

from __future__ import annotations

import re
from typing import Mapping, NamedTuple, Sequence

import numpy as np

from cflow_torch.data.arrays.cloud_text import numbers_of, with_plain_nan
from cflow_torch.data.column_names import distinct_names

_CODES = ("i1", "u1", "i2", "u2", "i4", "u4", "f4", "f8")
_NAMES = dict(zip(_CODES, ("char", "uchar", "short", "ushort", "int", "uint", "float", "double")))
_TYPES = {name: code for code in _CODES for name in (_NAMES[code], np.dtype(code).name)}  # "char" and "int8"
_TYPES["bool"] = "u1"  # of no standard, but written
_ORDERS = {"ascii": "=", "binary_little_endian": "<", "binary_big_endian": ">"}
_LONGEST_HEADER = 65536  # bytes
_HEADER = re.compile(rb"ply\s(.*?)(?<=[\r\n])end_header[ \t]*(?:\r\n|\r|\n)", re.DOTALL)


class _Property(NamedTuple):
    name: str
    kind: str  # NumPy's code of a value
    length_kind: str | None = None  # of a list, the code of its length


class _Element(NamedTuple):
    name: str
    num_rows: int
    properties: list[_Property]

    @property
    def has_lists(self) -> bool:
        return any(one.length_kind for one in self.properties)

    @property
    def scalars(self) -> np.dtype:  # type: ignore[type-arg]
        """Type of a vertex without its lists."""
        scalars = [one for one in self.properties if one.length_kind is None]
        names = distinct_names([one.name for one in scalars])
        return np.dtype([(name, one.kind) for name, one in zip(names, scalars)])


def ply_fields(content: bytes) -> dict[str, np.ndarray]:
    """Read the vertices of a `.ply` file: property -> (N,) array of the stated type.

    Other elements, and properties that are lists, are not read. A file that is damaged or not a `.ply` file may raise
    any exception, which the caller reports. Source: G. Turk, "The PLY Polygon File Format".
    """
    order, elements, body = _parsed(content)
    names = [element.name for element in elements]
    if "vertex" not in names:
        raise ValueError(f"it has the elements {names}, no vertex")
    before, vertex = elements[: names.index("vertex")], elements[names.index("vertex")]
    table = (_text_table if order == "ascii" else _binary_table)(body, before, vertex)
    if len(table) < vertex.num_rows:
        raise ValueError(f"it has {len(table)} of {vertex.num_rows} vertices")
    return {name: table[name].astype(table.dtype[name].newbyteorder("=")) for name in table.dtype.names or ()}


def _parsed(content: bytes) -> tuple[str, list[_Element], bytes]:
    """Return the format, the elements and the bytes after the header."""
    header = _HEADER.match(content[:_LONGEST_HEADER])
    if header is None:
        raise ValueError("it has no complete header")
    lines = [line.split() for line in header[1].decode("latin-1").splitlines()]  # comments may have any encoding
    lines = [words for words in lines if words and words[0] not in ("comment", "obj_info")]
    form, elements = lines[0][1], []
    order = _ORDERS[form]
    for words in lines[1:]:
        if words[0] == "element":
            elements.append(_Element(words[1], int(words[2]), []))
        elif words[1] == "list":
            kinds = [order + _TYPES[word] for word in words[2:4]]
            elements[-1].properties.append(_Property(" ".join(words[4:]), kinds[1], kinds[0]))
        else:
            elements[-1].properties.append(_Property(" ".join(words[2:]), order + _TYPES[words[1]]))
    return form, elements, content[header.end() :]


def _text_table(body: bytes, before: Sequence[_Element], vertex: _Element) -> np.ndarray:
    lines = [line.split() for line in with_plain_nan(body).splitlines() if line.strip()]
    first = sum(element.num_rows for element in before)
    rows: Sequence[Sequence[bytes]] = lines[first : first + vertex.num_rows]
    names = vertex.scalars.names or ()
    if vertex.has_lists:
        rows = [_without_lists(words, vertex) for words in rows]
    elif any(len(words) != len(names) for words in rows):
        raise ValueError(f"a vertex has not {len(names)} numbers")
    table = np.zeros(len(rows), vertex.scalars)
    for k, name in enumerate(names):
        table[name] = numbers_of([words[k] for words in rows], vertex.scalars[name])
    return table


def _without_lists(words: Sequence[bytes], vertex: _Element) -> list[bytes]:
    """Return the words of a vertex that are not in lists; if there are more or fewer, that is a ValueError."""
    kept, position = [], 0
    for one in vertex.properties:
        if position >= len(words):
            raise ValueError(f"a vertex has only {len(words)} numbers")
        if one.length_kind is None:
            kept.append(words[position])
        position += 1 if one.length_kind is None else 1 + int(words[position])
    if position != len(words):
        raise ValueError(f"a vertex has {len(words)} numbers, not {position}")
    return kept


def _binary_table(body: bytes, before: Sequence[_Element], vertex: _Element) -> np.ndarray:
    start = 0
    for element in before:
        start = _skip(body, element, start)[1]
    if not vertex.has_lists:
        return np.frombuffer(body, vertex.scalars, vertex.num_rows, start)
    offsets, _ = _skip(body, vertex, start)
    scalars, octets = vertex.scalars, np.frombuffer(body, np.uint8)
    table = np.zeros(vertex.num_rows, scalars)
    for name, column in zip(scalars.names or (), offsets.T):
        kind = scalars[name]
        table[name] = octets[column[:, None] + np.arange(kind.itemsize)].view(kind)[:, 0]
    return table


def _skip(body: bytes, element: _Element, start: int) -> tuple[np.ndarray, int]:
    """Return the offsets of the scalars of each row, (N, S) if the element has lists, and the end of the element."""
    if not element.has_lists:
        return np.zeros((0, 0), np.int64), start + element.num_rows * element.scalars.itemsize
    steps = [(np.dtype(one.kind).itemsize, one.length_kind and np.dtype(one.length_kind)) for one in element.properties]
    offsets = []
    for _ in range(element.num_rows):
        for size, length in steps:
            if length:
                start += length.itemsize + size * int(np.frombuffer(body, length, 1, start)[0])
            else:
                offsets.append(start)
                start += size
    if start > len(body):
        raise ValueError(f"it ends within the element {element.name}")
    return np.array(offsets, np.int64).reshape(element.num_rows, -1), start


def ply_bytes(fields: Mapping[str, np.ndarray]) -> bytes:
    """Return a binary `.ply` file of vertices; property -> (N,) float32, float64 or integers of up to 32 bits."""
    kinds = {name: values.dtype.str[1:] for name, values in fields.items()}
    properties = "".join(f"property {_NAMES[kind]} {name}\n" for name, kind in kinds.items())
    little = np.dtype([(name, "<" + kind) for name, kind in kinds.items()])
    table = np.rec.fromarrays(list(fields.values()), dtype=little)
    header = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(table)}\n{properties}end_header\n"
    return header.encode("ascii") + table.tobytes()
