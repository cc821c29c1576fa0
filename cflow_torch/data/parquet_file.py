"""Parquet files, opened with care."""

from __future__ import annotations

from typing import Any, Iterator, List, Optional, Sequence

import pyarrow as pa
import pyarrow.parquet as pq

from cflow_torch.data.arrow_file import arrow_errors, check_columns
from cflow_torch.data.bounds import MAX_ARRAY_BYTES
from cflow_torch.data.parquet_claims import MAX_LIST, check_parquet_claims, read_footer
from cflow_torch.data.paths import is_remote
from cflow_torch.types import CFlowError

MAX_STREAMED_BYTES = 3 * MAX_ARRAY_BYTES  # of a column of one row group that is gone through a few rows at a time
_BUFFER = 1 << 20  # bytes read at once


class ParquetFile:
    """A parquet file, open; a context manager.

    Args:
        file: where it is, a path, also for messages.
        source: what to open: its name, or an open file, or a pyarrow.NativeFile.

    Attributes:
        names: of the columns.
        group_rows: rows of each row group.

    Convention: columns of text come as dictionaries: a long text in many rows is held once. The file is read, not
    mapped into memory: one that shrinks meanwhile gives an error, not a SIGBUS.

    Raises:
        OSError: there is no such file, or it cannot be reached.
        CFlowError: it is damaged.
    """

    def __init__(self, file: Any, source: Any) -> None:
        self.file = file
        if not is_remote(file) and file.exists() and not file.is_file():
            raise OSError(f"{file} is no file")
        if isinstance(source, str):
            source = pa.OSFile(source)
        elif not isinstance(source, pa.NativeFile):
            source = pa.PythonFile(source, mode="r")
        self._source = source
        with arrow_errors(file):
            self._footer = read_footer(file, source)
            self._parquet = pq.ParquetFile(
                source,
                read_dictionary=[leaf.path for leaf in self._footer.leaves if leaf.is_text],
                thrift_container_size_limit=MAX_LIST,
                buffer_size=_BUFFER,
                pre_buffer=False,
            )
            self.schema: pa.Schema = self._parquet.schema_arrow
            self.names: List[str] = self.schema.names
        self.group_rows: Sequence[int] = self._footer.group_rows

    def __enter__(self) -> ParquetFile:
        return self

    def __exit__(self, *_: Any) -> None:
        self._source.close()

    def read(self, columns: Sequence[str]) -> pa.Table:
        """Some columns, valid in every offset.

        Raises:
            CFlowError: a column is missing, occurs twice or is nested, claims more than `bounds.MAX_ARRAY_BYTES`, or
                the file is damaged.
        """
        with arrow_errors(self.file):
            self._check(columns, None, MAX_ARRAY_BYTES)
            table = self._parquet.read(columns=list(columns))
            table.validate(full=True)
            self._check_names(table, columns)
        if table.num_rows != sum(self.group_rows):
            raise CFlowError(f"{self.file} has {table.num_rows} rows and claims {sum(self.group_rows)}; copy it again")
        return table

    def batches(self, group: int, columns: Sequence[str], num_rows: int) -> Iterator[pa.RecordBatch]:
        """Some columns of a row group, `num_rows` rows at a time, valid in every offset.

        Raises:
            CFlowError: as `read`; a column may have up to MAX_STREAMED_BYTES.
        """
        with arrow_errors(self.file):
            self._check(columns, [group], MAX_STREAMED_BYTES)
            for batch in self._parquet.iter_batches(num_rows, row_groups=[group], columns=list(columns)):
                batch.validate(full=True)
                self._check_names(batch, columns)
                yield batch

    def _check(self, columns: Sequence[str], groups: Optional[Sequence[int]], limit: int) -> None:
        check_columns(self.file, self.schema, columns)
        chosen = range(len(self.group_rows)) if groups is None else groups
        check_parquet_claims(self.file, self._source, self._footer, columns, chosen, limit)

    def _check_names(self, table: Any, columns: Sequence[str]) -> None:
        if sorted(table.schema.names) != sorted(set(columns)):
            raise CFlowError(f"{self.file}: the columns {list(columns)} are mixed with nested ones; write them anew")
