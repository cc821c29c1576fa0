"""Feather files (Arrow IPC, version 2)."""

from __future__ import annotations

from typing import Any, List, Optional, Sequence

import pyarrow as pa

from cflow_torch.data.arrow_file import check_columns
from cflow_torch.data.file_errors import file_errors
from cflow_torch.data.paths import read_bytes


class FeatherFile:
    """A feather file, in memory.

    Args:
        file: where it is, a path; with `data` just its name in messages.
        data: its contents; None = they are read, all at once: a file that shrinks meanwhile does no harm.

    Attributes:
        schema, names, num_rows: of the table, its columns, its rows.

    Raises:
        CFlowError: the file is missing, cannot be reached, or is damaged.
    """

    def __init__(self, file: Any, data: Optional[bytes] = None) -> None:
        with file_errors(file, "copy it from the data set"):
            source = read_bytes(file) if data is None else data
            self._table = pa.ipc.open_file(source, options=pa.ipc.IpcReadOptions(use_threads=False)).read_all()
            self._table.validate(full=True)
        self.file = file
        self.schema: pa.Schema = self._table.schema
        self.names: List[str] = self._table.column_names
        self.num_rows: int = self._table.num_rows

    def read(self, columns: Sequence[str]) -> pa.Table:
        """Some columns, in the order that is asked for.

        Raises:
            CFlowError: a column is missing or occurs twice.
        """
        check_columns(self.file, self.names, columns)
        return self._table.select(list(columns))
