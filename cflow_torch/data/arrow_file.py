"""Columns of Arrow tables as NumPy arrays and texts."""

from __future__ import annotations

from typing import Any, List, Sequence

import numpy as np
import pyarrow as pa

from cflow_torch.data.file_errors import shortened
from cflow_torch.types import CFlowError


def check_columns(file: Any, names: Sequence[str], columns: Sequence[str], mend: str = "copy it again") -> None:
    """Refuse columns that are asked for and missing, or there several times.

    Raises:
        CFlowError: such a column; `mend` says what to do.
    """
    missing = [name for name in columns if name not in names]
    if missing:
        raise CFlowError(f"{file} lacks the columns {missing}; it has {shortened(names)}; {mend}")
    doubled = [name for name in columns if names.count(name) > 1]
    if doubled:
        raise CFlowError(f"{file} has several columns {doubled}; keep one")


def floats(table: pa.Table, columns: Sequence[str], file: Any, dtype: type = np.float64) -> np.ndarray:
    """(rows, K) numbers of K floating-point columns.

    Raises:
        CFlowError: a column of another type, or with empty entries.
    """
    values = np.empty((table.num_rows, len(columns)), dtype)
    for number, name in enumerate(columns):
        values[:, number] = _column(table, name, file, "floating point", pa.types.is_floating).to_numpy()
    return values


def integers(table: pa.Table, column: str, file: Any) -> np.ndarray:
    """(rows,) int64 numbers of an integer column.

    Raises:
        CFlowError: another type, or empty entries.
    """
    return _column(table, column, file, "integer", pa.types.is_integer).to_numpy().astype(np.int64)


def bools(table: pa.Table, column: str, file: Any) -> np.ndarray:
    """(rows,) bool.

    Raises:
        CFlowError: another type, or empty entries.
    """
    return _column(table, column, file, "bool", pa.types.is_boolean).to_numpy().astype(bool)


def texts(table: pa.Table, column: str, file: Any) -> List[str]:
    """Text of every row, also of a dictionary.

    Raises:
        CFlowError: another type, or empty entries.
    """
    found: List[str] = _column(table, column, file, "text", _is_text).to_pylist()
    return found


def _column(table: pa.Table, column: str, file: Any, kind: str, is_kind: Any) -> pa.ChunkedArray:
    values = table.column(column)
    if not is_kind(values.type):
        raise CFlowError(f"{file}: column {column} must be {kind}, got {values.type}")
    if values.null_count:
        raise CFlowError(f"{file} has {values.null_count} empty entries in {column}; copy it again")
    return values


def _is_text(kind: pa.DataType) -> bool:
    kind = kind.value_type if pa.types.is_dictionary(kind) else kind
    return bool(pa.types.is_string(kind) or pa.types.is_large_string(kind))
