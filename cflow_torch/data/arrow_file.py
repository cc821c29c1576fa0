"""Feather files (Arrow IPC, version 2), and columns of Arrow tables as NumPy arrays and texts."""

from __future__ import annotations

from typing import Any, Sequence

import numpy as np
import pyarrow as pa

from cflow_torch.data.files import file_errors, shortened
from cflow_torch.data.paths import read_bytes
from cflow_torch.types import CFlowError


def check_columns(file: Any, names: Sequence[str], columns: Sequence[str], hint: str = "copy it again") -> None:
    """Refuse columns that are asked for and missing, or there several times.

    Raises:
        CFlowError: such a column; `hint` says what to do.
    """
    missing = [name for name in columns if name not in names]
    if missing:
        raise CFlowError(f"{file} lacks the columns {missing}; it has {shortened(names)}; {hint}")
    doubled = [name for name in columns if names.count(name) > 1]
    if doubled:
        raise CFlowError(f"{file} has several columns {doubled}; keep one")


class FeatherFile:
    """A feather file, in memory.

    Args:
        file: where it is, a path; with `data` just its name in messages.
        data: its contents; None = they are read, all at once: a file that shrinks meanwhile does no harm.

    Attributes:
        names, num_rows: of the columns, of the table.

    Raises:
        CFlowError: the file is missing, cannot be reached, or is damaged.
    """

    def __init__(self, file: Any, data: bytes | None = None) -> None:
        with file_errors(file, "copy it from the data set"):
            source = read_bytes(file) if data is None else data
            self._table = pa.ipc.open_file(source, options=pa.ipc.IpcReadOptions(use_threads=False)).read_all()
            self._table.validate(full=True)
        self.file = file
        self.names: list[str] = self._table.column_names
        self.num_rows: int = self._table.num_rows

    def read(self, columns: Sequence[str]) -> pa.Table:
        """Some columns, in the order that is asked for.

        Raises:
            CFlowError: a column is missing or occurs twice.
        """
        check_columns(self.file, self.names, columns)
        return self._table.select(list(columns))


def float_columns(table: pa.Table, columns: Sequence[str], file: Any, dtype: type = np.float64) -> np.ndarray:
    """(rows, K) numbers of K floating-point columns.

    Raises:
        CFlowError: a column of another type, or with empty entries.
    """
    values = np.empty((table.num_rows, len(columns)), dtype)
    for number, name in enumerate(columns):
        values[:, number] = _column(table, name, file, "floating point", pa.types.is_floating).to_numpy()
    return values


def integer_column(table: pa.Table, column: str, file: Any) -> np.ndarray:
    """(rows,) int64 numbers of an integer column.

    Raises:
        CFlowError: another type, or empty entries.
    """
    return _column(table, column, file, "integer", pa.types.is_integer).to_numpy().astype(np.int64)


def bool_column(table: pa.Table, column: str, file: Any) -> np.ndarray:
    """(rows,) bool.

    Raises:
        CFlowError: another type, or empty entries.
    """
    return _column(table, column, file, "bool", pa.types.is_boolean).to_numpy().astype(bool)


def text_column(table: pa.Table, column: str, file: Any) -> list[str]:
    """Text of every row, also of a dictionary.

    Raises:
        CFlowError: another type, or empty entries.
    """
    found: list[str] = _column(table, column, file, "text", _is_text).to_pylist()
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
