"""Read .npy files."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np

from cflow_torch.data.file_errors import file_errors
from cflow_torch.data.paths import read_bytes


def read_npy(path: Path, hint: str) -> np.ndarray:
    """Read the array of a .npy file; pickled objects are never loaded. Errors as in `file_errors`."""
    with file_errors(path, hint):
        content = read_bytes(path)
    return parse_npy(content, path, hint)


def parse_npy(content: bytes, path: Path, hint: str) -> np.ndarray:
    """Return the array in the content of a .npy file, see `read_npy`."""
    with file_errors(path, hint):
        array = np.load(io.BytesIO(content), allow_pickle=False)
        if not isinstance(array, np.ndarray):
            raise ValueError("it is an archive, not a .npy file")
        return array
