"""Point clouds in the PLY format: the properties of the element `vertex`, as text or binary.

No library reads all that we need. meshio 5.3.5 does not know `float64`, `short` and `ushort` in binary files (PDAL
writes them), reads `uchar` as signed, and does not notice missing points. The licence of plyfile is the GPL.
"""

from __future__ import annotations

import io
import re
import warnings
from itertools import takewhile
from typing import Mapping

import numpy as np

_CODES = ("i1", "u1", "i2", "u2", "i4", "u4", "f4", "f8")
_NAMES = dict(zip(_CODES, ("char", "uchar", "short", "ushort", "int", "uint", "float", "double")))
_TYPES = {name: code for code in _CODES for name in (_NAMES[code], np.dtype(code).name)}  # "char" and "int8"
_ORDERS = {"ascii": "=", "binary_little_endian": "<", "binary_big_endian": ">"}
_LONGEST_HEADER = 65536  # bytes


def ply_fields(content: bytes) -> dict[str, np.ndarray]:
    """Read the vertices of a `.ply` file: property -> (N,) array of the stated type.

    The first element must be `vertex`. Faces are not read. A file that is damaged or not a `.ply` file may raise any
    exception, which the caller reports. Source: G. Turk, "The PLY Polygon File Format".
    """
    header = re.match(rb"ply\s(.*?)\nend_header\s*?\n", content[:_LONGEST_HEADER], re.DOTALL)
    if header is None:
        raise ValueError("it has no complete header")
    lines = [line.split() for line in header[1].decode("ascii").splitlines()]
    lines = [words for words in lines if words and words[0] not in ("comment", "obj_info")]
    (_, order, _), (_, element, count) = lines[:2]
    if element != "vertex":
        raise ValueError(f"its first element is {element}, not vertex")
    properties = takewhile(lambda words: words[0] == "property", lines[2:])
    kind = np.dtype([(name, _ORDERS[order] + _TYPES[code]) for _, code, name in properties])
    body = content[header.end() :]
    if order == "ascii":
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # NumPy warns if there are no points
            warnings.simplefilter("error", DeprecationWarning)  # NumPy warns if 256 is stored in a byte
            table = np.loadtxt(io.BytesIO(body), kind, max_rows=int(count), ndmin=1)
    else:
        table = np.frombuffer(body, kind, int(count))
    if len(table) < int(count):
        raise ValueError(f"it has {len(table)} of {count} vertices")
    return {name: table[name].astype(kind[name].newbyteorder("=")) for name in kind.names or ()}


def ply_bytes(fields: Mapping[str, np.ndarray]) -> bytes:
    """Return a binary `.ply` file of vertices; property -> (N,) float32, float64 or integers of up to 32 bits."""
    kinds = {name: values.dtype.str[1:] for name, values in fields.items()}
    properties = "".join(f"property {_NAMES[kind]} {name}\n" for name, kind in kinds.items())
    little = np.dtype([(name, "<" + kind) for name, kind in kinds.items()])
    table = np.rec.fromarrays(list(fields.values()), dtype=little)
    header = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(table)}\n{properties}end_header\n"
    return header.encode("ascii") + table.tobytes()
