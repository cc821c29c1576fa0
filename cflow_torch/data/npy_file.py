"""NumPy's own files (.npy, and .npz archives of them): plain arrays, whose claims are checked before memory is used."""

from __future__ import annotations

import math
import os
import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any, Callable, Dict, Sequence, Tuple

import numpy as np
from numpy.lib import format as npy

from cflow_torch.data.bounds import check_claim
from cflow_torch.data.paths import whole
from cflow_torch.types import CFlowError

_PLAIN = "biufUS"  # kinds of numbers and of text; neither objects (pickles) nor dates, complex numbers, raw bytes
_LONGEST_HEADER = 10000  # bytes; NumPy's own limit
_CHUNK = 1 << 18  # bytes read at once: zipfile makes copies of what it gives
_METHODS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)  # what NumPy writes


@dataclass(frozen=True)
class Header:
    """What a file says of its array."""

    shape: Tuple[int, ...]
    dtype: np.dtype
    is_fortran: bool


def read_npy(path: Path, mend: str) -> np.ndarray:
    """The array of a .npy file.

    Args:
        path: the file.
        mend: what to do about a file that cannot be read, for the message.

    Returns:
        An array of numbers or text, or a structured array of such; new memory.

    Raises:
        CFlowError: no such file, none of this kind, truncated, another dtype, or too large (see `check_claim`).
    """
    try:
        with open_whole(path) as stream:
            size = stream.seek(0, os.SEEK_END)
            stream.seek(0)
            return read_array(stream, size, path, "its array")
    except CFlowError:
        raise
    except Exception as error:  # a damaged file makes NumPy raise nearly anything
        raise CFlowError(f"{path} cannot be read ({_said(error)}); {mend}") from error


def read_npz(path: Path, mend: str, choose: Callable[[Dict[str, Header]], Sequence[str]]) -> Dict[str, np.ndarray]:
    """Some arrays of a .npz file.

    Args:
        path: the archive.
        mend: what to do about a file that cannot be read, for the message.
        choose: ({name: header}) -> names of the arrays to read; others may be of any kind.

    Returns:
        Name -> array, as `read_npy` gives it.

    Raises:
        CFlowError: as `read_npy`, and what `choose` raises.
    """
    try:
        with open_whole(path) as stream, zipfile.ZipFile(stream) as archive:
            members = {name[: -len(".npy")]: name for name in archive.namelist() if name.endswith(".npy")}
            headers = {}
            for key, name in members.items():
                with open_member(archive, name, path) as member:
                    headers[key] = read_header(member)
            arrays = {}
            for key in choose(headers):
                with open_member(archive, members[key], path) as member:
                    arrays[key] = read_array(member, archive.getinfo(members[key]).file_size, path, key)
            return arrays
    except CFlowError:
        raise
    except Exception as error:  # a damaged file makes zipfile and NumPy raise nearly anything
        raise CFlowError(f"{path} cannot be read ({_said(error)}); {mend}") from error


def open_whole(path: Path) -> IO[bytes]:
    """A file that is read from its beginning to its end."""
    source = whole(path)
    return open(source, "rb") if isinstance(source, str) else source  # type: ignore[no-any-return]


def open_member(archive: zipfile.ZipFile, name: str, file: Any) -> IO[bytes]:
    """A member of an archive; never more bytes of it come out than the archive says.

    Raises:
        CFlowError: it is packed in a way that NumPy does not use, or claims too much.
        Exception: whatever zipfile raises for a damaged archive.
    """
    info = archive.getinfo(name)
    if info.compress_type not in _METHODS:
        raise CFlowError(f"{file}: {name} is packed with method {info.compress_type}; NumPy stores or deflates")
    check_claim(file, name, info.file_size)
    return archive.open(info)


def read_header(stream: IO[bytes]) -> Header:
    """What stands before the data of an array.

    Raises:
        Exception: whatever NumPy raises for a damaged one.
    """
    is_short = npy.read_magic(stream) == (1, 0)
    start, digits = stream.tell(), 2 if is_short else 4
    length = int.from_bytes(stream.read(digits), "little")
    if length > _LONGEST_HEADER:  # NumPy would read, and unpack, all of it before it says so
        raise ValueError(f"a header of {length} bytes")
    stream.seek(start)
    shape, is_fortran, dtype = (npy.read_array_header_1_0 if is_short else npy.read_array_header_2_0)(stream)
    return Header(shape, dtype, is_fortran)


def read_array(stream: IO[bytes], size: int, file: Any, what: str) -> np.ndarray:
    """The array in a stream.

    Args:
        stream: stands at its beginning and can seek.
        size: number of bytes that are in it, at most.
        file, what: for the messages.

    Raises:
        CFlowError: it claims more than there is or than is read at once, or its dtype is not plain.
        Exception: whatever NumPy raises for a damaged one.
    """
    header = read_header(stream)
    dtype = header.dtype
    if not _is_plain(dtype):
        raise CFlowError(f"{file}: {what} has dtype {str(dtype)[:80]}; only arrays of numbers and text are read")
    if min(header.shape, default=0) < 0:
        raise CFlowError(f"{file}: {what} claims the shape {header.shape}; is the file damaged? Copy it again")
    claim = math.prod(header.shape) * dtype.itemsize
    check_claim(file, what, claim)
    there = size - stream.tell()
    if claim > there:
        raise CFlowError(f"{file}: {what} claims {claim} bytes, {there} are there; it is truncated, copy it again")
    data = np.empty(claim, np.uint8)
    view = memoryview(data)  # type: ignore[arg-type]
    got = sum(stream.readinto(view[at : at + _CHUNK]) for at in range(0, claim, _CHUNK))  # type: ignore[attr-defined]
    if got != claim:
        raise CFlowError(f"{file}: {what} has {got} of {claim} bytes; it is truncated, copy it again")
    stream.read(1)  # a member of an archive is compared with its checksum at its end
    return data.view(dtype).reshape(header.shape, order="F" if header.is_fortran else "C")


def _is_plain(dtype: np.dtype) -> bool:
    """Numbers or text, also in fields; what takes no room could be claimed any number of times."""
    if dtype.names is not None:
        return bool(dtype.names) and all(_is_plain(dtype[name].base) for name in dtype.names)
    return dtype.kind in _PLAIN and dtype.itemsize > 0 and dtype.subdtype is None


def _said(error: Exception) -> str:
    """What an error says, or its kind where it says nothing."""
    return str(error)[:200] or type(error).__name__
