"""Arrays out of npz files, strings included, without ever running what a pickle asks for."""

from __future__ import annotations

import pickle
import zipfile
import zlib
from pathlib import Path
from typing import Any, Optional, Tuple

import numpy as np
from numpy.lib import format as npy

from cflow_torch.data.paths import whole
from cflow_torch.types import CFlowError

_MISSING = "{} is missing; copy it from the data set"


class _Type:
    """Stands for NumPy's dtype in a pickle: keeps its name, does nothing."""

    def __init__(self, name: str = "", *_: Any) -> None:
        self.name = name

    def __setstate__(self, _: Any) -> None:
        """The rest of a dtype does not matter here."""


class _Array:
    """Stands for an ndarray in a pickle: keeps its shape and list of elements."""

    shape: Tuple[int, ...] = ()
    is_fortran = False
    elements: Any = None

    def __setstate__(self, state: Any) -> None:
        _, self.shape, _, self.is_fortran, self.elements = state


def _array(*_: Any) -> _Array:
    return _Array()


def _string(kind: Any, data: Any) -> str:
    """A NumPy string scalar."""
    if not isinstance(kind, _Type) or not str(kind.name).startswith("U") or not isinstance(data, bytes):
        raise pickle.UnpicklingError("a scalar that is no string")
    return data.decode("utf-32-le").rstrip("\0")


class _StringUnpickler(pickle.Unpickler):
    """Makes strings, numbers, tuples and lists; what NumPy needs around them is replaced by harmless stand-ins."""

    def find_class(self, module: str, name: str) -> Any:
        if module in ("numpy.core.multiarray", "numpy._core.multiarray"):
            if name == "_reconstruct":
                return _array
            if name == "scalar":
                return _string
        if module == "numpy" and name in ("ndarray", "dtype"):
            return _Type
        raise pickle.UnpicklingError(f"it asks for {module}.{name}")


def npz_contents(file: Path) -> Any:
    """`whole` of an archive of the data set."""
    try:
        return whole(file)
    except FileNotFoundError:
        raise CFlowError(_MISSING.format(file)) from None


def read_npz_member(file: Path, key: str, strings: bool = False, contents: Any = None) -> Optional[np.ndarray]:
    """One array of an npz file.

    Args:
        file: the archive.
        key: name of the array.
        strings: the array holds text, maybe as pickled Python strings (dtype object).
        contents: `npz_contents(file)`, where that was called already.

    Returns:
        The array; text as a NumPy string array of its stored shape. None where the archive has no such array.

    Raises:
        CFlowError: no such file, no npz, damaged, or an object array that holds anything but strings.
    """
    try:
        with zipfile.ZipFile(npz_contents(file) if contents is None else contents) as archive:
            if f"{key}.npy" not in archive.namelist():
                return None
            with archive.open(f"{key}.npy") as member:
                version = npy.read_magic(member)
                read_header = npy.read_array_header_1_0 if version == (1, 0) else npy.read_array_header_2_0
                shape, _, dtype = read_header(member)
                if dtype.hasobject and strings:
                    return _strings(_StringUnpickler(member).load(), shape)
            with archive.open(f"{key}.npy") as member:
                array = npy.read_array(member, allow_pickle=False)
    except FileNotFoundError:
        raise CFlowError(_MISSING.format(file)) from None
    except (
        *(OSError, EOFError, ValueError, TypeError, KeyError, IndexError, AttributeError, MemoryError, RecursionError),
        *(zipfile.BadZipFile, zlib.error, pickle.UnpicklingError, NotImplementedError),
    ) as error:
        raise CFlowError(
            f"cannot read {key} of {file}: {error}; it is damaged or no file of the data set, copy it again"
        ) from error
    if strings and array.dtype.kind != "U":
        raise CFlowError(f"{file}: {key} must hold strings, got {array.dtype}")
    return array


def _strings(pickled: Any, shape: Tuple[int, ...]) -> np.ndarray:
    if not isinstance(pickled, _Array) or pickled.shape != shape or not isinstance(pickled.elements, list):
        raise pickle.UnpicklingError("it holds no array of strings")
    strangers = [element for element in pickled.elements if type(element) is not str]
    if strangers or len(pickled.elements) != int(np.prod(shape)):
        raise pickle.UnpicklingError(f"it holds {len(pickled.elements)} elements, {len(strangers)} are no strings")
    return np.array(pickled.elements, dtype=str).reshape(shape, order="F" if pickled.is_fortran else "C")
