"""Read .npy files."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np

from cflow_torch.data.file_errors import file_errors
from cflow_torch.data.paths import read_bytes


def read_npy(path: Path, hint: str, content: bytes | None = None) -> np.ndarray:
    """Read the array of a .npy file, or of its `content`; pickled objects are never loaded. Errors: `file_errors`."""
    with file_errors(path, hint):
        array = np.load(io.BytesIO(read_bytes(path) if content is None else content), allow_pickle=False)
        if not isinstance(array, np.ndarray):
            raise ValueError("it is an archive, not a .npy file")
        return array
