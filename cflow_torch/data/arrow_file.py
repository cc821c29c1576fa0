"""Feather files (Arrow IPC, version 2), and their columns as NumPy arrays."""

from __future__ import annotations

from typing import Any, Sequence

import numpy as np
import pyarrow as pa

from cflow_torch.data.files import check_columns, file_errors
from cflow_torch.data.paths import read_bytes
from cflow_torch.types import CFlowError


class FeatherFile:
    """A feather file in memory: `table`, `names` of its columns, and `num_rows`. A damaged file is a `CFlowError`.

    If you pass the contents as `data`, `file` is only the name in messages. Otherwise the whole file is read at once,
    so it does no harm if the file shrinks later.
    """

    def __init__(self, file: Any, data: bytes | None = None) -> None:
        with file_errors(file, "copy it from the data set"):
            source = read_bytes(file) if data is None else data
            self.table = pa.ipc.open_file(source, options=pa.ipc.IpcReadOptions(use_threads=False)).read_all()
            self.table.validate(full=True)
        self.file = file
        self.names: list[str] = self.table.column_names
        self.num_rows: int = self.table.num_rows

    def floats(self, columns: Sequence[str], dtype: type = np.float64) -> np.ndarray:
        """Return K floating-point columns as (rows, K); another type or an empty entry is a `CFlowError`."""
        check_columns(self.file, self.names, columns)
        values = [self._column(name, "floating point", pa.types.is_floating).to_numpy() for name in columns]
        return np.stack(values, axis=1).astype(dtype, copy=False)

    def integers(self, column: str) -> np.ndarray:
        """Return an integer column as (rows,) int64."""
        return self._column(column, "integer", pa.types.is_integer).to_numpy().astype(np.int64)

    def bools(self, column: str) -> np.ndarray:
        """Return a column as (rows,) bool."""
        return self._column(column, "bool", pa.types.is_boolean).to_numpy().astype(bool)

    def texts(self, column: str) -> np.ndarray:
        """Return a text column, plain or dictionary-encoded, as (rows,) objects (str)."""
        return np.array([*self._column(column, "text", _is_text).to_pylist(), None], object)[:-1]

    def _column(self, column: str, kind: str, is_kind: Any) -> pa.ChunkedArray:
        check_columns(self.file, self.names, [column])
        values = self.table.column(column)
        if not is_kind(values.type):
            raise CFlowError(f"{self.file}: column {column} must be {kind}, got {values.type}")
        if values.null_count:
            raise CFlowError(f"{self.file} has {values.null_count} empty entries in {column}; copy it again")
        return values


def _is_text(kind: pa.DataType) -> bool:
    kind = kind.value_type if pa.types.is_dictionary(kind) else kind
    return bool(pa.types.is_string(kind) or pa.types.is_large_string(kind))
