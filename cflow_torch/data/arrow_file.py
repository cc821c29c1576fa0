"""Feather files (Arrow IPC, version 2), and their columns as NumPy arrays."""

from __future__ import annotations

from typing import Any, Sequence

import numpy as np
import pyarrow as pa

from cflow_torch.data.file_errors import check_columns, file_errors
from cflow_torch.data.paths import read_bytes
from cflow_torch.types import CFlowError, check_array

# Kind of the wanted dtype -> kinds of columns that we convert to it, and their name in messages.
_KINDS = {"f": ("f", "floats"), "i": ("iu", "integers"), "b": ("b", "bool")}


class FeatherFile:
    """A feather file in memory: `table`, `names` of its columns, and `num_rows`. A damaged file is a `CFlowError`.

    If you pass the contents as `data`, `file` is only the name in messages. Otherwise we read the whole file at once,
    so a file that shrinks later does no harm.
    """

    def __init__(self, file: Any, data: bytes | None = None) -> None:
        with file_errors(file, "copy it from the data set"):
            source = read_bytes(file) if data is None else data
            self.table = pa.ipc.open_file(source, options=pa.ipc.IpcReadOptions(use_threads=False)).read_all()
            self.table.validate(full=True)
        self.file = file
        self.names: list[str] = self.table.column_names
        self.num_rows: int = self.table.num_rows

    def read(self, columns: Sequence[str]) -> pa.Table:
        """Return some columns, in the given order; a column that is missing or occurs twice is a `CFlowError`."""
        check_columns(self.file, self.names, columns)
        return self.table.select(list(columns))

    def matrix(self, columns: Sequence[str], dtype: Any = np.float64) -> np.ndarray:
        """Return K columns as (rows, K) of `dtype`, a floating-point type, np.int64 or bool.

        A column of another kind, or with an empty entry, is a `CFlowError`.
        """
        kinds, wanted = _KINDS[np.dtype(dtype).kind]
        arrays = []
        for name, values in zip(columns, self.read(columns).columns):
            if values.null_count:
                raise CFlowError(f"{self.file} has {values.null_count} empty entries in {name}; copy it again")
            arrays.append(values.to_numpy())
            check_array(arrays[-1], f"{self.file}: column {name}", (self.num_rows,), kinds, f"a column of {wanted}")
        return np.stack(arrays, axis=1).astype(dtype, copy=False)

    def vector(self, column: str, dtype: Any = np.float64) -> np.ndarray:
        """Return one column as (rows,). Dtypes and errors are those of `matrix`."""
        return self.matrix([column], dtype)[:, 0]
