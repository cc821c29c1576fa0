"""NumPy's own files (.npy, and .npz archives of them): plain arrays, never pickled objects."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import IO, Callable, Dict, Sequence, Tuple

import numpy as np
from numpy.lib import format as npy

from cflow_torch.data.file_errors import file_errors
from cflow_torch.data.paths import whole


@dataclass(frozen=True)
class Header:
    """What a file says of its array."""

    shape: Tuple[int, ...]
    dtype: np.dtype


def read_npy(path: Path, mend: str) -> np.ndarray:
    """The array of a .npy file.

    Args:
        path: the file.
        mend: what to do about a file that cannot be read, for the message.

    Raises:
        CFlowError: no such file, none of this kind, truncated, or an array of objects.
    """
    with file_errors(path, mend):
        array = np.load(whole(path), allow_pickle=False)
        if not isinstance(array, np.ndarray):
            raise ValueError("it is an archive, no .npy file")
        return array


def read_npz(path: Path, mend: str, choose: Callable[[Dict[str, Header]], Sequence[str]]) -> Dict[str, np.ndarray]:
    """Some arrays of a .npz file.

    Args:
        path: the archive.
        mend: what to do about a file that cannot be read, for the message.
        choose: ({name: header}) -> names of the arrays to read; others may be of any kind.

    Returns:
        Name -> array.

    Raises:
        CFlowError: as `read_npy`, and what `choose` raises.
    """
    with file_errors(path, mend), np.load(whole(path), allow_pickle=False) as arrays:
        headers = {}
        for name in arrays.zip.namelist():
            if name.endswith(".npy"):
                with arrays.zip.open(name) as member:
                    headers[name[: -len(".npy")]] = read_header(member)
        return {key: arrays[key] for key in choose(headers)}


def read_header(stream: IO[bytes]) -> Header:
    """What stands before the data of an array; the stream stands at the data afterwards.

    Raises:
        Exception: whatever NumPy raises for a damaged one.
    """
    version = npy.read_magic(stream)
    shape, _, dtype = (npy.read_array_header_1_0 if version == (1, 0) else npy.read_array_header_2_0)(stream)
    return Header(shape, dtype)
