"""What holds for every table of Arrow, in a feather or a parquet file: nothing is believed, and nothing is run.

Only columns that are asked for are unpacked, after their types and what they claim to hold have been looked at.
"""

from __future__ import annotations

from contextlib import contextmanager
from typing import Any, Iterator, List, Sequence

import pyarrow as pa

from cflow_torch.data.bounds import check_claim
from cflow_torch.types import CFlowError

MAX_ROWS = 1 << 20  # of a table that is gone through row by row; a log has some ten thousand boxes
MAX_TEXT_BYTES = 1 << 26  # of the names in a column; ten thousand boxes have some hundred kilobytes
_MAX_TEXT = 400  # characters of what a library says; a damaged name can be a million long


@contextmanager
def arrow_errors(file: Any) -> Iterator[None]:
    """Turns whatever a damaged file makes Arrow raise into a CFlowError."""
    try:
        yield
    except CFlowError:
        raise
    except Exception as error:  # Arrow's own, OSError, ValueError, KeyError, UnicodeDecodeError, MemoryError, ...
        raise CFlowError(
            f"cannot read {file}: {shortened(error)}; it may be truncated or damaged, copy it again"
        ) from error


def shortened(text: Any) -> str:
    """One line, not too long."""
    line = " ".join(str(text).split())
    return line if len(line) <= _MAX_TEXT else line[:_MAX_TEXT] + " ..."


def check_columns(file: Any, schema: pa.Schema, columns: Sequence[str]) -> None:
    """Refuse columns that are missing, doubled or of a type that no reader has use for.

    Raises:
        CFlowError: such a column.
    """
    names = schema.names
    missing = [name for name in columns if name not in names]
    if missing:
        raise CFlowError(f"{file} lacks the columns {missing}; it has {shortened(names)}")
    for name in columns:
        if names.count(name) > 1:
            raise CFlowError(f"{file} has {names.count(name)} columns {name}; keep one")
        kind = schema.field(name).type
        if not _is_plain(kind):
            raise CFlowError(
                f"{file}: column {name} is {shortened(kind)}; columns of numbers, bools or text are read, and lists"
            )


def _is_plain(kind: pa.DataType) -> bool:
    """Numbers, times, text, also by dictionary; lists of numbers."""
    if pa.types.is_dictionary(kind):
        kind = kind.value_type
    elif pa.types.is_list(kind) or pa.types.is_large_list(kind) or pa.types.is_fixed_size_list(kind):
        return bool(pa.types.is_primitive(kind.value_type))
    return bool(pa.types.is_primitive(kind) or pa.types.is_string(kind) or pa.types.is_large_string(kind))


def check_rows(file: Any, num_rows: int) -> None:
    """Refuse a table that takes too long to go through row by row.

    Raises:
        CFlowError: more than `MAX_ROWS` rows.
    """
    if num_rows > MAX_ROWS:
        raise CFlowError(f"{file} has {num_rows} rows; such a table has up to {MAX_ROWS}. Is the file damaged?")


def texts(column: pa.ChunkedArray, file: Any) -> List[str]:
    """Text of every row; rows of equal text share it where the file does.

    Raises:
        CFlowError: something else than text, a row without, or more than MAX_TEXT_BYTES.
    """
    kind = column.type.value_type if pa.types.is_dictionary(column.type) else column.type
    if not (pa.types.is_string(kind) or pa.types.is_large_string(kind)):
        raise CFlowError(f"{file}: a column of names must be text, got {column.type}")
    check_claim(file, "a column of names", column.nbytes, MAX_TEXT_BYTES)
    found: List[Any] = []
    with arrow_errors(file):
        for chunk in column.chunks:
            if pa.types.is_dictionary(column.type):
                words = chunk.dictionary.to_pylist()
                found += [None if at is None else words[at] for at in chunk.indices.to_pylist()]
            else:
                found += chunk.to_pylist()
    if None in found:
        raise CFlowError(f"{file}: {found.count(None)} rows have no name")
    return found
