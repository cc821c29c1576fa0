"""Feather files (Arrow IPC, version 2), opened with care."""

from __future__ import annotations

from typing import Any, List, Optional, Sequence

import pyarrow as pa

from cflow_torch.data.arrow_file import arrow_errors, check_columns
from cflow_torch.data.bounds import MAX_ARRAY_BYTES
from cflow_torch.data.feather_claims import check_feather_claims
from cflow_torch.data.paths import read_bytes
from cflow_torch.types import CFlowError


class FeatherFile:
    """A feather file, open.

    Args:
        file: where it is, a path; with `data` just its name in messages.
        data: its contents; None = they are read, all at once: a file that shrinks meanwhile does no harm.

    Attributes:
        names: of the columns.
        num_rows: rows.

    Raises:
        OSError: there is no such file, it is a pipe or a device, or it cannot be reached.
        CFlowError: it is damaged, or claims more than `bounds.MAX_ARRAY_BYTES`.
    """

    def __init__(self, file: Any, data: Optional[bytes] = None) -> None:
        if data is None:
            data = read_bytes(file, MAX_ARRAY_BYTES)
        self.file, self._data = file, data
        self.num_rows = check_feather_claims(file, data)
        with arrow_errors(file):
            self.schema: pa.Schema = pa.ipc.open_file(data).schema
            self.names: List[str] = self.schema.names

    def read(self, columns: Sequence[str]) -> pa.Table:
        """Some columns (one at least), in the order of the file, valid in every offset.

        Raises:
            CFlowError: a column is missing, occurs twice or is nested, or the file is damaged.
        """
        check_columns(self.file, self.schema, columns)
        with arrow_errors(self.file):
            fields = sorted({self.names.index(name) for name in columns})
            options = pa.ipc.IpcReadOptions(included_fields=fields, use_threads=False)
            table = pa.ipc.open_file(self._data, options=options).read_all()
            table.validate(full=True)
        if table.num_rows != self.num_rows:
            raise CFlowError(f"{self.file} has {table.num_rows} rows and claims {self.num_rows}; copy it again")
        return table
