"""What the columns of a parquet file claim to hold, summed up before Arrow unpacks anything.

The footer lists row groups and their column chunks. A chunk is a row of pages; each begins with a header that claims
how many bytes it unpacks to and how many values it has. Arrow believes both, whatever the sums in the footer say. (The
footer is read here, not asked of pyarrow: its metadata objects end the process where a chunk's statistics are odd.)
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any, List, Sequence, Tuple

from cflow_torch.data.bounds import check_claim
from cflow_torch.data.thrift import I32, I64, TEXT, Compact
from cflow_torch.types import CFlowError

MAX_PAGES = 1 << 16  # of the columns that are read; a page holds about 1 MiB
MAX_LIST = 1024  # row groups, and entries of the schema, whose nesting Arrow follows by recursion
_MAX_FOOTER = 1 << 23  # bytes; a thousand row groups of twenty columns take 3 million
_FIRST_LOOK, _MAX_HEADER = 256, 1 << 16  # bytes of a page's header: 20 to 100, and two values of its statistics
_PREFIXED = 7  # DELTA_BYTE_ARRAY: texts that repeat the beginning of the one before, so that they cost nothing
_BYTE_ARRAY = 6
_WIDTH = {0: 1, 1: 4, 2: 8, 3: 12, 4: 4, 5: 8, _BYTE_ARRAY: 4}  # bytes of a physical type; texts: of their number
_WORD, _ROW = 16, 12  # bytes in memory: the entry of a dictionary, a point
_META = {1: I32, 5: I64, 7: I64, 9: I64, 11: I64}
_FOOTER = {2: [{1: I32, 2: I32, 4: TEXT, 5: I32}], 4: [{1: [{3: _META}], 3: I64}]}
_DATA, _DICTIONARY, _DATA2 = 5, 7, 8
_PAGE = {2: I32, 3: I32, _DATA: {1: I32, 2: I32}, _DICTIONARY: {1: I32, 2: I32}, _DATA2: {1: I32, 4: I32}}


@dataclass(frozen=True)
class Leaf:
    """A column of numbers or texts: names from the root, physical type, bytes of a value."""

    path: str
    kind: int
    width: int

    @property
    def is_text(self) -> bool:
        """Texts, or bytes, of any length."""
        return self.kind == _BYTE_ARRAY


@dataclass(frozen=True)
class Chunk:
    """A leaf column in one row group: bytes of the file, values."""

    start: int
    end: int
    num_values: int


@dataclass(frozen=True)
class Footer:
    """Leaf columns; rows and chunks of each row group."""

    leaves: Sequence[Leaf]
    group_rows: Sequence[int]
    chunks: Sequence[Sequence[Chunk]]


def read_footer(file: Any, source: Any) -> Footer:
    """The footer of an open file.

    Args:
        file: name, for messages.
        source: a pyarrow.NativeFile.

    Raises:
        CFlowError: no parquet file, or one of more than MAX_LIST row groups or columns.
    """
    try:
        size = source.size()
        source.seek(max(size - 8, 0))
        end = source.read(8)
        length = int.from_bytes(end[:4], "little")
        if len(end) < 8 or end[4:] != b"PAR1" or length > min(size - 8, _MAX_FOOTER):
            raise ValueError("no parquet file")
        source.seek(size - 8 - length)
        return _parsed(source.read(length))
    except (IndexError, ValueError, KeyError) as error:
        raise CFlowError(
            f"cannot read {file} as parquet: its footer is damaged ({error}); it may be truncated, copy it again"
        ) from error


@lru_cache(8)  # of segments that are read again and again; the bytes themselves are the key
def _parsed(data: bytes) -> Footer:
    fields = Compact(data).structure(_FOOTER)
    elements, groups = fields[2], fields[4]
    if max(len(elements), len(groups)) > MAX_LIST:
        raise ValueError(f"{len(elements)} schema entries, {len(groups)} row groups; up to {MAX_LIST} are read")
    leaves: List[Leaf] = []
    open_groups: List[List[Any]] = []  # name, children to come
    for number, element in enumerate(elements):
        while open_groups and not open_groups[-1][1]:
            open_groups.pop()
        if open_groups:
            open_groups[-1][1] -= 1
        name = element[4].decode("utf-8")
        if element.get(5, 0) > 0 or number == 0:
            open_groups.append([name, element.get(5, 0)])
        else:
            kind = element[1]
            path = ".".join([*(parent for parent, _ in open_groups[1:]), name])
            leaves.append(Leaf(path, kind, _WIDTH.get(kind) or max(element.get(2, 0), 1)))
    chunks = [[_chunk(chunk[3]) for chunk in group[1]] for group in groups]
    rows = [group[3] for group in groups]
    if min(rows, default=0) < 0 or any(len(row) != len(leaves) for row in chunks):
        raise ValueError("a row group has a negative number of rows, or another number of columns than the schema")
    return Footer(leaves, rows, chunks)


def _chunk(fields: Any) -> Chunk:
    start = fields[9]
    if 0 < fields.get(11, 0) < start:
        start = fields[11]
    if start < 0 or fields[7] < 0 or fields[5] < 0:
        raise ValueError("a column has a negative size")
    return Chunk(start, start + fields[7], fields[5])


def check_parquet_claims(
    file: Any, source: Any, footer: Footer, columns: Sequence[str], groups: Sequence[int], limit: int
) -> None:
    """Refuse columns that would take too much memory.

    Args:
        file: name, for messages.
        source: the open file, a pyarrow.NativeFile.
        footer: of it.
        columns: names of those that are to be read, with all that is nested in them.
        groups: numbers of the row groups.
        limit: bytes that a leaf column may have in all of these.

    Raises:
        CFlowError: a column claims more, or its pages are damaged.
    """
    rows = sum(footer.group_rows[group] for group in groups)
    check_claim(file, f"its {rows} rows", _ROW * rows)
    num_pages = 0
    for number, leaf in enumerate(footer.leaves):
        if not any(leaf.path == name or leaf.path.startswith(name + ".") for name in columns):
            continue
        total = 0
        for group in groups:
            try:
                size, more = _pages(source, footer.chunks[group][number], leaf, MAX_PAGES - num_pages)
            except (IndexError, ValueError, KeyError, OSError) as error:
                raise CFlowError(
                    f"cannot read {file}: column {leaf.path} is damaged ({error}); copy it again"
                ) from error
            num_pages, total = num_pages + more, total + size
            check_claim(file, f"column {leaf.path}", total, limit)


def _pages(source: Any, chunk: Chunk, leaf: Leaf, max_pages: int) -> Tuple[int, int]:
    """Bytes that a column chunk takes in memory, and how many pages it has."""
    at, size, num_values, count = chunk.start, 0, 0, 0
    while num_values < chunk.num_values and at < chunk.end:
        head, length = _header(source, at)
        values = 0
        for kind, encoding in ((_DATA, 2), (_DICTIONARY, 2), (_DATA2, 4)):
            if kind in head:
                here = head[kind][1]
                if here < 0 or (leaf.is_text and head[kind].get(encoding) == _PREFIXED):
                    raise ValueError("a page has a negative size, or an encoding that is not read (DELTA_BYTE_ARRAY)")
                size += _WORD * here if kind == _DICTIONARY else 0
                values = max(values, 0 if kind == _DICTIONARY else here)
        if head[2] < 0 or head[3] < 0:
            raise ValueError("a page has a negative size")
        count += 1
        if count > max_pages:
            raise ValueError(f"more than {MAX_PAGES} pages")
        num_values, size, at = num_values + values, size + head[2], at + length + head[3]
    values = max(num_values, chunk.num_values) * leaf.width
    return size + values if leaf.is_text else max(size, values), count  # pages of numbers become the values


def _header(source: Any, at: int) -> Tuple[Any, int]:
    """Fields of the page header at an offset, and its length."""
    room = _FIRST_LOOK
    while True:
        source.seek(at)
        data = source.read(room)
        reader = Compact(data)
        try:
            return reader.structure(_PAGE), reader.at
        except IndexError:
            if len(data) < room or room >= _MAX_HEADER:
                raise
            room *= 16
