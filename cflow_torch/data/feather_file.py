"""Feather files (Arrow IPC, version 2)."""

from __future__ import annotations

from typing import Any, Optional

import pyarrow as pa

from cflow_torch.data.arrow_file import TableFile
from cflow_torch.data.file_errors import file_errors
from cflow_torch.data.paths import read_bytes


class FeatherFile(TableFile):
    """A feather file, in memory.

    Args:
        file: where it is, a path; with `data` just its name in messages.
        data: its contents; None = they are read, all at once: a file that shrinks meanwhile does no harm.

    Raises:
        CFlowError: the file is missing, cannot be reached, or is damaged.
    """

    def __init__(self, file: Any, data: Optional[bytes] = None) -> None:
        with file_errors(file, "copy it from the data set"):
            source = read_bytes(file) if data is None else data
            super().__init__(
                file, pa.ipc.open_file(source, options=pa.ipc.IpcReadOptions(use_threads=False)).read_all()
            )
