"""The .npz file of one LiDAR and frame: arrays of numbers, and class names that may be stored as pickled strings."""

from __future__ import annotations

import io
import math
from pathlib import Path

import numpy as np
from numpy.lib import format as npy

from cflow_torch.data.files import file_errors
from cflow_torch.data.paths import read_bytes
from cflow_torch.data.pickles import NUMPY_ARRAYS, Placeholder, array_of, load_plain
from cflow_torch.types import CFlowError

_HINT = "copy it from the data set"


class Cloud:
    """One .npz file in memory; arrays are unpacked when you ask for them.

    A missing or damaged file, or an array of another type or shape, is a `CFlowError`.
    """

    def __init__(self, file: Path) -> None:
        self.file = file
        with file_errors(file, _HINT):
            self._arrays = np.load(io.BytesIO(read_bytes(file)), allow_pickle=False)
            self._keys = list(self._arrays.files)

    def numbers(self, key: str, columns: int) -> np.ndarray:
        """Return an array as (N, columns) float32."""
        if key not in self._keys:
            raise CFlowError(f"{self.file} has no array {key}; it has {self._keys[:20]}")
        with file_errors(f"{self.file}: {key}", _HINT):
            array = self._arrays[key]
        if (
            not np.issubdtype(array.dtype, np.floating)
            or array.size % columns
            or array.shape[1:] not in ((), (columns,))
        ):
            raise CFlowError(f"{self.file}: {key} must be (N, {columns}) floats, got {array.shape} {array.dtype}")
        return array.reshape(-1, columns).astype(np.float32, copy=False)

    def seconds(self, key: str, rows: int) -> np.ndarray | None:
        """Return an array of integer nanoseconds as (rows,) float64 seconds; None if there is no such array."""
        if key not in self._keys:
            return None
        with file_errors(f"{self.file}: {key}", _HINT):
            array = self._arrays[key]
        if not np.issubdtype(array.dtype, np.integer) or array.shape not in ((rows,), (rows, 1)):
            raise CFlowError(f"{self.file}: {key} must be ({rows}, 1) integers, got {array.shape} {array.dtype}")
        return array.reshape(rows) * 1e-9

    def names(self, key: str) -> list[str] | None:
        """Return the texts of an array of any shape, executing nothing; None if there is no such array."""
        if key not in self._keys:
            return None
        with file_errors(f"{self.file}: {key}", _HINT):
            with self._arrays.zip.open(f"{key}.npy") as member:
                is_first = npy.read_magic(member) == (1, 0)
                shape, _, dtype = (npy.read_array_header_1_0 if is_first else npy.read_array_header_2_0)(member)
                stored = array_of(load_plain(member, NUMPY_ARRAYS)) if dtype.hasobject else self._arrays[key]
            texts = [_text(text) if isinstance(text, Placeholder) else text for text in stored.ravel().tolist()]
            if {type(text) for text in texts} - {str} or len(texts) != math.prod(shape):
                raise ValueError(f"it must hold {math.prod(shape)} strings")
            return texts


def _text(scalar: Placeholder) -> str:
    """Decode a NumPy string scalar."""
    data: bytes = scalar.parts[1]
    return data.decode("utf-32-le").rstrip("\0")
