"""Parquet files written number by number, so that each number can lie."""

from __future__ import annotations

import random
from typing import Any, Dict, List, Optional, Sequence, Tuple

import pyarrow as pa

Field = Tuple[int, str, Any]  # number, type (i32, i64, text, list:TYPE, struct), value
_CODES = {"i32": 5, "i64": 6, "text": 8, "list": 9, "struct": 12}
PLAIN, RLE, PREFIXED, RLE_DICTIONARY = 0, 3, 7, 8
CODECS = {"none": 0, "snappy": 1, "gzip": 2, "brotli": 4, "zstd": 6, "lz4": 7}
FLOAT, DOUBLE, BYTE_ARRAY = 4, 5, 6
LIES = (0, 1, 3, 4, 5, -1, -(2**31), 2**31 - 1, 10**12, 2**62, 2**63 - 1)


class Written(bytes):
    """A value that is written already."""


def varint(value: int) -> bytes:
    out = bytearray()
    value &= (1 << 64) - 1
    while value > 127:
        out.append(value & 127 | 128)
        value >>= 7
    return bytes([*out, value])


def _value(kind: str, value: Any) -> bytes:
    if isinstance(value, Written):
        return value
    if kind in ("i32", "i64"):
        return varint((value << 1) ^ (value >> 63))
    if kind == "text":
        return varint(len(value)) + value
    if kind == "struct":
        return structure(value)
    inner = kind.split(":", 1)[1]
    return bytes([0xF0 | _CODES[inner]]) + varint(len(value)) + b"".join(_value(inner, item) for item in value)


def structure(fields: Sequence[Field]) -> bytes:
    """Thrift's compact protocol."""
    out, last = b"", 0
    for number, kind, value in fields:
        out += bytes([(number - last) << 4 | _CODES[kind.split(":")[0]]]) + _value(kind, value)
        last = number
    return out + b"\0"


def page(
    content: bytes,
    num_values: int,
    codec: str = "none",
    encoding: int = PLAIN,
    dictionary: bool = False,
    claim: Optional[int] = None,
) -> bytes:
    """A page; `claim`: bytes that it says to unpack to."""
    packed = content if codec == "none" else pa.compress(content, codec=codec, asbytes=True)
    head: List[Field] = [(1, "i32", 2 if dictionary else 0), (2, "i32", len(content) if claim is None else claim)]
    inner: List[Field] = [(1, "i32", num_values), (2, "i32", encoding)]
    if not dictionary:
        inner += [(3, "i32", RLE), (4, "i32", RLE)]
    return structure([*head, (3, "i32", len(packed)), (7 if dictionary else 5, "struct", inner)]) + packed


def runs(index: int, count: int) -> bytes:
    """Content of a data page: `count` times the same entry of the dictionary."""
    return b"\x01" + varint(count << 1) + bytes([index])


def file(columns: Dict[str, Tuple[int, List[bytes], int]], num_rows: int, codec: str = "none", **lies: int) -> bytes:
    """A file of one row group.

    Args:
        columns: name -> physical type, pages (a dictionary first), number of values.
        num_rows: of the row group and the file.
        codec: of the pages.
        lies: other numbers for `rows`, `group_rows`, `packed`, `unpacked`, `values`, `offset`, `dictionary`,
            `parts` (of the path), `children` (of the schema), `coded` (the codec), `groups`,
            `histogram` (its entries).
    """
    body, chunks = b"PAR1", []
    for name, (kind, pages, num_values) in columns.items():
        start = len(body)
        body += b"".join(pages)
        with_dictionary = len(pages) > 1
        metadata: List[Field] = [
            (1, "i32", kind),
            (2, "list:i32", [PLAIN, RLE]),
            (3, "list:text", [name.encode()] * lies.get("parts", 1)),
            (4, "i32", lies.get("coded", CODECS[codec])),
            (5, "i64", lies.get("values", num_values)),
            (6, "i64", lies.get("unpacked", len(body) - start)),
            (7, "i64", lies.get("packed", len(body) - start)),
            (9, "i64", lies.get("offset", start + (len(pages[0]) if with_dictionary else 0))),
        ]
        if with_dictionary:
            metadata.append((11, "i64", lies.get("dictionary", start)))
        if "histogram" in lies:  # of the levels: one entry where there are no levels
            metadata.append((16, "struct", [(3, "list:i64", [num_values] * lies["histogram"])]))
        chunks.append([(2, "i64", start), (3, "struct", metadata)])
    schema: List[List[Field]] = [[(4, "text", b"schema"), (5, "i32", lies.get("children", len(columns)))]]
    schema += [[(1, "i32", kind), (3, "i32", 0), (4, "text", name.encode())] for name, (kind, _, _) in columns.items()]
    group: List[Field] = [
        (1, "list:struct", chunks),
        (2, "i64", len(body)),
        (3, "i64", lies.get("group_rows", num_rows)),
    ]
    footer = structure(
        [
            (1, "i32", 1),
            (2, "list:struct", schema),
            (3, "i64", lies.get("rows", num_rows)),
            (4, "list:struct", [Written(structure(group))] * lies.get("groups", 1)),
        ]
    )
    return body + footer + len(footer).to_bytes(4, "little") + b"PAR1"


def deep(depth: int) -> bytes:
    """A schema of groups within groups."""
    group = structure([(3, "i32", 0), (4, "text", b"g"), (5, "i32", 1)])
    leaf = structure([(1, "i32", DOUBLE), (3, "i32", 0), (4, "text", b"x")])
    schema = bytes([0xFC]) + varint(depth + 2) + group * (depth + 1) + leaf
    footer = b"\x15\x02\x19" + schema + b"\x16\x00\x19\x0c\x00"
    return b"PAR1" + footer + len(footer).to_bytes(4, "little") + b"PAR1"


def lying(chance: random.Random, names: Sequence[str]) -> bytes:
    """A file of three points whose numbers lie here and there."""
    codec = chance.choice(list(CODECS))
    keys = ["rows", "group_rows", "packed", "unpacked", "values", "offset", "dictionary"]
    keys += ["parts", "children", "coded", "histogram"]
    lies = {key: chance.choice(LIES) for key in chance.sample(keys, chance.choice((0, 1, 1, 2)))}
    lies.update({"histogram": chance.choice((0, 1, 2))} if "histogram" in lies else {})
    lies["parts"] = max(0, min(lies.get("parts", 1), 5))
    lies["groups"] = chance.choice((*[1] * 60, *[3] * 10, 2000))
    count = chance.choice((3, 3, 3, 0, 10**4, 2**31 - 1))
    columns = {}
    for name in names:
        kind, width = chance.choice(((FLOAT, 4), (DOUBLE, 8), (DOUBLE, 8)))
        claim = chance.choice((None, None, None, 0, 1, -1, 2**31 - 1))
        if chance.random() < 0.5:
            word = page(bytes(width), 1, codec, PLAIN, True, claim)
            pages = [word, page(runs(chance.choice((0, 0, 7)), count), count, codec, RLE_DICTIONARY)]
        else:
            pages = [page(bytes(3 * width), count, codec, chance.choice((PLAIN, PLAIN, RLE, 5, 9, 99)), claim=claim)]
        columns[name] = (kind, pages, count)
    return file(columns, count, codec, **lies)
