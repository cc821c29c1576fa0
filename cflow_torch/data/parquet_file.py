"""Parquet files."""

from __future__ import annotations

from typing import Any

import pyarrow.parquet as pq

from cflow_torch.data.arrow_file import TableFile
from cflow_torch.data.file_errors import file_errors


class ParquetFile(TableFile):
    """A parquet file, in memory; a context manager.

    Args:
        file: where it is, a path, also for messages.
        source: what to open: its name, or an open file, or a pyarrow.NativeFile.

    Raises:
        CFlowError: the file is missing, cannot be reached, or is damaged.
    """

    def __init__(self, file: Any, source: Any) -> None:
        with file_errors(file):
            super().__init__(file, pq.ParquetFile(source).read(use_threads=False))

    def __enter__(self) -> ParquetFile:
        return self

    def __exit__(self, *_: Any) -> None:
        """Nothing is left open."""
