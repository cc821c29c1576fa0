"""NumPy's own files: plain arrays, never pickled objects."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from cflow_torch.data.file_errors import file_errors
from cflow_torch.data.paths import source_for_full_read


def read_npy(path: Path, hint: str) -> np.ndarray:
    """The array of a .npy file.

    Args:
        path: the file.
        hint: what to do about a file that cannot be read, for the message.

    Raises:
        CFlowError: no such file, none of this kind, truncated, or an array of objects.
    """
    with file_errors(path, hint):
        array = np.load(source_for_full_read(path), allow_pickle=False)
        if not isinstance(array, np.ndarray):
            raise ValueError("it is an archive, no .npy file")
        return array
