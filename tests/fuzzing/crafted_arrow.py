"""Tables of Arrow that are well formed outside and hostile inside."""

from __future__ import annotations

import datetime
import decimal
import io
import random
import struct
from typing import Any, Callable, Dict, List, Sequence

import pyarrow as pa
from hypothesis import strategies as st
from pyarrow import feather, parquet

WIDE = (0, 1, -1, 127, -(2**31), 2**31 - 1, 2**32, 10**12, -(2**63), 2**63 - 1)


def _buffers(kind: pa.DataType, rows: int, *parts: bytes) -> pa.Array:
    return pa.Array.from_buffers(kind, rows, [None, *(pa.py_buffer(part) for part in parts)])


_NUMBERS = (float("nan"), float("inf"), -1e308, 5e-324, 1e9, -0.0, None, 0.5)
# A hostile column of so many rows.
COLUMNS: Sequence[Callable[[random.Random, int], pa.Array]] = (
    *[lambda c, n: pa.array([c.choice(_NUMBERS) for _ in range(n)], c.choice((pa.float32(), pa.float64())))] * 5,
    lambda c, n: pa.nulls(n, c.choice((pa.null(), pa.float32(), pa.string(), pa.list_(pa.float32())))),
    lambda c, n: pa.array([c.choice(WIDE) for _ in range(n)], pa.int64()),
    lambda c, n: pa.array([c.choice((0, 1, 2**63, 2**64 - 1)) for _ in range(n)], pa.uint64()),
    lambda c, n: pa.array([c.choice((0, 1, 255)) for _ in range(n)], pa.uint8()),
    lambda c, n: _buffers(pa.float16(), n, bytes(c.randrange(256) for _ in range(2 * n))),
    lambda c, n: pa.array([c.random() < 0.5 for _ in range(n)]),
    lambda c, n: pa.array([c.choice(("", "a", "\0", "..", "x" * 300, "\u202e", None)) for _ in range(n)]),
    lambda c, n: pa.array([c.choice((b"", b"\xff\xfe", b"a")) for _ in range(n)]),
    lambda c, n: _buffers(pa.string(), n, struct.pack(f"<{n + 1}i", *range(n + 1)), b"\xff" * n),
    lambda c, n: pa.array(["ab"] * n, pa.large_string()),
    lambda c, n: pa.array([[0.5] * c.choice((0, 1, 3, 16))] * n, pa.list_(pa.float64())),
    lambda c, n: pa.array([[1, 2, c.choice((0, -1, 4, 2**31 - 1))]] * n, pa.list_(pa.int32(), 3)),
    lambda c, n: pa.array([[[["a"]]]] * n),
    lambda c, n: pa.array([{"x": 1.0, "y": {"z": "a"}}] * n),
    lambda c, n: pa.array([[("a", 1)]] * n, pa.map_(pa.string(), pa.int32())),
    lambda c, n: pa.array(["a"] * n).dictionary_encode(),
    lambda c, n: pa.array([1.5] * n).dictionary_encode(),
    lambda c, n: pa.array([decimal.Decimal("1.5")] * n, pa.decimal128(38, 10)),
    lambda c, n: pa.array([datetime.datetime(2020, 1, 1)] * n, pa.timestamp("ns")),
    lambda c, n: pa.array([datetime.timedelta(1)] * n),
    lambda c, n: pa.array([b"abcd"] * n, pa.binary(4)),
)


# None with wrong offsets: Arrow's writers step out of them, and the process dies. The bytes are changed instead.


def hostile_table(chance: random.Random, table: pa.Table, rows: Sequence[int] = (0, 1, 4, 4, 4, 5)) -> pa.Table:
    """A good table with columns replaced, dropped, doubled, renamed."""
    columns, names = [column.combine_chunks() for column in table.columns], list(table.column_names)
    columns = [column.chunk(0) if isinstance(column, pa.ChunkedArray) else column for column in columns]
    fields = list(table.schema)
    for _ in range(chance.choice((1, 1, 1, 2, 5))):
        at, deed = chance.randrange(len(columns)), chance.randrange(12)
        if deed < 8:
            columns[at] = chance.choice(COLUMNS)(chance, len(columns[at]))
            fields[at] = pa.field(names[at], columns[at].type)
        elif deed == 8 and len(columns) > 1:
            del columns[at], names[at], fields[at]
        elif deed == 9:
            columns.append(columns[at])
            names.append(names[at])
            fields.append(fields[at])
        elif deed == 10:
            names[at] = chance.choice(("", "\0", "../x", "x" * 5000, "x.list.element", names[0]))
            fields[at] = fields[at].with_name(names[at])
        else:
            name = chance.choice(("arrow.py_extension_type", "pandas.period", "arrow.json", "nobody.knows", ""))
            fields[at] = fields[at].with_metadata({"ARROW:extension:name": name, "ARROW:extension:metadata": b"{"})
    size = chance.choice(rows)
    if size < len(columns[0]):
        columns = [column.slice(0, size) for column in columns]
    metadata = {chance.choice(("pandas", "huggingface", "ARROW:schema")): chance.choice(("", "{", "[]", "\0" * 50))}
    return pa.Table.from_arrays(columns, schema=pa.schema(fields, metadata=metadata))


def feather_bytes(chance: random.Random, table: pa.Table) -> bytes:
    """Written in one of the ways that there are, numbers of it replaced now and then."""
    sink = io.BytesIO()
    way = chance.randrange(8)
    if way == 0:
        with pa.ipc.new_stream(sink, table.schema) as writer:
            writer.write_table(table)
    elif way == 1:
        options = pa.ipc.IpcWriteOptions(metadata_version=pa.ipc.MetadataVersion.V4, use_legacy_format=True)
        with pa.ipc.new_file(sink, table.schema, options=options) as writer:
            writer.write_table(table, max_chunksize=chance.choice((1, 4)))
    else:
        compression = chance.choice(("uncompressed", "lz4", "zstd"))
        feather.write_feather(table, sink, compression=compression, chunksize=chance.choice((1, 2, 65536)))
    data = bytearray(sink.getvalue())
    if chance.random() < 0.6:  # rows and sizes are 8 bytes long, offsets of texts and indices of dictionaries 4
        for _ in range(chance.choice((1, 1, 3))):
            width, form = chance.choice(((8, "<q"), (8, "<q"), (4, "<i")))
            small = [at for at in range(0, len(data) - 8, 4) if data[at] < 129 and not any(data[at + 1 : at + width])]
            if small:
                at, value = chance.choice(small), chance.choice(WIDE)
                data[at : at + width] = struct.pack(form, value if width == 8 else value % 2**32 - 2**31)
    return bytes(data)


def parquet_bytes(chance: random.Random, table: pa.Table) -> bytes:
    """Written with one of the codecs, encodings and versions."""
    sink = io.BytesIO()
    options: Dict[str, Any] = {
        "compression": chance.choice(("none", "snappy", "gzip", "zstd", "lz4", "brotli")),
        "use_dictionary": chance.random() < 0.5,
        "data_page_version": chance.choice(("1.0", "2.0")),
        "row_group_size": chance.choice((1, 4, 100)),
        "store_schema": chance.random() < 0.7,
    }
    parquet.write_table(table, sink, **options)
    return sink.getvalue()


def crafted(make: Callable[[random.Random], bytes]) -> st.SearchStrategy[bytes]:
    """Files made with one number; a table that Arrow itself does not write is made anew."""

    def file(seed: int) -> bytes:
        chance = random.Random(seed)
        for _ in range(20):
            try:
                return make(chance)
            except (pa.ArrowException, ValueError, TypeError):
                continue
        return b""

    return st.integers(0, 2**64 - 1).map(file)


def one_of_several(prefixed: List[Callable[[random.Random], bytes]]) -> st.SearchStrategy[bytes]:
    """Files of several kinds; the first byte says which."""

    def make(chance: random.Random) -> bytes:
        number = chance.randrange(len(prefixed))
        return bytes([number]) + prefixed[number](chance)

    return crafted(make)
