"""Names of places, on this machine or wherever fsspec reaches, and how the readers open what is there.

A place is text ("/data/av2", "s3://bucket/av2"), a `pathlib.Path` or a `upath.UPath`. The readers use nothing of it but
pathlib's interface and the functions below.
"""

from __future__ import annotations

import errno
import io
import mmap
import re
import shutil
import stat
import tempfile
from contextlib import contextmanager
from functools import lru_cache
from pathlib import Path, PosixPath, WindowsPath
from typing import Any, Iterator, Union

import pyarrow as pa

from cflow_torch.types import CFlowError

PathLike = Union[str, Path]
_SCHEME = re.compile(r"([A-Za-z][A-Za-z0-9+.-]+)://")
_BLOCK = 1 << 20  # bytes; smaller ones make more requests: HDF5's metadata is scattered, its data are long reads
_KEPT_BLOCKS = 32  # of each open file: 32 MiB
_COPIED = 8 << 20  # bytes per request while a file is copied
_POINTER = b"version https://git-lfs.github.com/spec/"  # what git leaves in place of a file that is not fetched
_KEPT_COPIES = 4  # files of `source_for_mmap`: two of a Waymo segment that is read, two of the one before


def as_path(place: PathLike) -> Path:
    """The path that a text names.

    Args:
        place: "scheme://..." for what fsspec reaches, else a name on this machine; "file://..." is one too. Paths of
            pathlib and of universal_pathlib (with storage options of their own, say) stay as they are.

    Returns:
        A `pathlib.Path`, or a `upath.UPath`, which has the same interface.

    Raises:
        CFlowError: it is no name; the extra `remote` is missing, or the package of the scheme's file system, or fsspec
            does not know the scheme.
    """
    if not is_path_like(place) or place == "" or "\0" in str(place):
        raise CFlowError(f'{str(place)[:80]!r} is no place: give a name, "scheme://..." or a path')
    if not isinstance(place, str):
        return place
    match = _SCHEME.match(place)
    if match is None:
        return Path(place)
    scheme = match.group(1).lower()
    if scheme == "file":
        return Path(place[match.end() :])
    try:
        import fsspec
        from upath import UPath
    except ImportError:
        raise CFlowError(f"{place} is not on this machine, which needs: pip install universal_pathlib fsspec") from None
    try:
        fsspec.get_filesystem_class(scheme)
    except (ImportError, ValueError) as error:  # it names the package
        raise CFlowError(f"fsspec has no file system {scheme}:// ({error}): {place}; is it written right?") from error
    path: Any = UPath(f"{scheme}://{place[match.end() :].rstrip('/')}")
    return path  # type: ignore[no-any-return]


def is_remote(place: Any) -> bool:
    """Whether a path is one of fsspec's, which `open` and memory mapping know nothing of."""
    return hasattr(place, "storage_options") and not isinstance(place, (PosixPath, WindowsPath))


def is_path_like(value: Any) -> bool:
    """Whether a setting names a place."""
    return isinstance(value, (str, Path)) or is_remote(value)


@contextmanager
def remote_errors(path: Path) -> Iterator[None]:
    """Turns whatever the far side's own library raises (no credentials, no connection, a timeout) into an OSError."""
    try:
        yield
    except (CFlowError, OSError):
        raise
    except Exception as error:
        if not is_remote(path):
            raise
        raise OSError(f"cannot reach {path} ({type(error).__name__}: {error})") from error


def forget_listings(path: Any) -> None:
    """Look anew at what others may have written: fsspec remembers the listings of folders, for `is_file` too."""
    if is_remote(path):
        path.fs.invalidate_cache()


def read_bytes(path: Path) -> bytes:
    """All of a file, in one request if it is remote.

    Args:
        path: of a regular file. Reading a device or a pipe, which an unpacked archive can hold, would never end.

    Raises:
        OSError: as for a local file, and if the far side cannot be reached.
    """
    if not is_remote(path):
        _check(path)
        return path.read_bytes()
    remote: Any = path
    with remote_errors(path):
        return bytes(remote.fs.cat_file(remote.path))  # pathlib's own way asks for the size first


def source_for_full_read(path: Path) -> Any:
    """What to give a library that reads all of a file: its name, or what is in it if it is remote.

    Raises:
        OSError: a remote file cannot be read, there is none on this machine, or it is a device or a pipe.
    """
    if is_remote(path):
        return io.BytesIO(read_bytes(path))
    return _check(path)


def source_for_random_access(path: Path) -> Any:
    """What to give a library that reads parts of a large file: its name, or an open binary file if it is remote.

    Cost: one request per block of 1 MiB in which wanted bytes lie; the last 32 of each file are kept.

    Raises:
        OSError: a remote file cannot be opened; later, that it cannot be read.
    """
    if not is_remote(path):
        return _check(path)
    return _open(path, cache_type="blockcache", block_size=_BLOCK, cache_options={"maxblocks": _KEPT_BLOCKS})


def source_for_mmap(path: Path) -> Any:
    """What to give pyarrow to read a large file again and again: its name, or a copy on this machine if it is remote.

    The last four copies stay in nameless files of the folder for temporary files (TMPDIR), which vanish with the
    process however it ends.

    Raises:
        OSError: a remote file cannot be read, or there is no room for the copy.
    """
    return pa.BufferReader(_copy(path)) if is_remote(path) else _check(path)


@lru_cache(maxsize=_KEPT_COPIES)
def _copy(path: Path) -> pa.Buffer:
    with tempfile.TemporaryFile() as file, _open(path, cache_type="none") as stream:
        with remote_errors(path):
            shutil.copyfileobj(stream, file, _COPIED)
        file.flush()
        return pa.py_buffer(mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ))


def _open(path: Any, **settings: Any) -> Any:
    with remote_errors(path):
        return path.fs.open(path.path, "rb", **settings)


def _check(path: Path) -> str:
    """Name of a file on this machine, which must be one, with data in it."""
    mode = path.stat().st_mode
    if not stat.S_ISREG(mode) and not stat.S_ISDIR(mode):
        raise OSError(errno.EINVAL, "is a device or a pipe, no file", str(path))
    if stat.S_ISREG(mode):
        with open(path, "rb") as file:
            if file.read(len(_POINTER)) == _POINTER:
                raise CFlowError(f"{path} is a git-lfs pointer, not the data: run git lfs pull there, or download it")
    return str(path)
