"""Local and remote paths (by fsspec): open files for the readers, and check the names from data that become paths.

A path is a text ("/data/av2", "s3://bucket/av2"), a `pathlib.Path` or a `upath.UPath`. Readers use only the interface
of pathlib and the functions below.
"""

from __future__ import annotations

import errno
import gzip
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

from cflow_torch.errors import CFlowError

PathLike = Union[str, Path]
GZ = ".gz"
_SCHEME = re.compile(r"([A-Za-z][A-Za-z0-9+.-]+)://")
_BLOCK = 1 << 20  # bytes; smaller blocks need more requests, because metadata of HDF5 is scattered and arrays are long
_KEPT_BLOCKS = 32  # of each open file: 32 MiB
_COPIED = 8 << 20  # bytes per request while a file is copied
_POINTER = b"version https://git-lfs.github.com/spec/"  # first bytes of a file whose data git-lfs has not fetched
_NAME = re.compile(r"(?!\.|[A-Za-z]:)[^/\\]+")  # not hidden, no `..`, no drive, no separator of any system
_RULE = "a name has no / or \\, no control characters, no dot in front and no drive (C:)"
_SHOWN = 80  # characters of a name in a message
_KEPT_COPIES = 4  # files of `source_for_mmap`: two of the current Waymo segment, two of the previous one


def as_path(path: PathLike) -> Path:
    """Convert a text to a `pathlib.Path`, or to a `upath.UPath`, which has the same interface.

    "scheme://..." is a file system of fsspec; "file://..." and everything else is a path on this machine. Paths of
    pathlib and universal_pathlib (which may have storage options) stay unchanged. A missing package or a scheme that
    fsspec does not know is a `CFlowError`.
    """
    if not is_path_like(path) or path == "" or "\0" in str(path):
        raise CFlowError(f"{str(path)[:80]!r} is not a valid path: pass a string, a Path or 'scheme://...'")
    if not isinstance(path, str):
        return path
    match = _SCHEME.match(path)
    if match is None:
        return Path(path)
    scheme = match.group(1).lower()
    if scheme == "file":
        return Path(path[match.end() :])
    try:
        import fsspec
        from upath import UPath

        fsspec.get_filesystem_class(scheme)
    except (ImportError, ValueError) as error:  # the error names a missing package
        raise CFlowError(
            f"{path} cannot be opened: fsspec has no file system {scheme}:// ({error}). Is it spelled correctly? "
            "Remote paths need the extra remote (pip install universal_pathlib fsspec), and the package of their file "
            "system"
        ) from error
    found: Any = UPath(f"{scheme}://{path[match.end() :].rstrip('/')}")
    return found  # type: ignore[no-any-return]


def is_remote(path: Any) -> bool:
    """Test whether a path is on a file system of fsspec, which `open` and memory mapping do not support."""
    return hasattr(path, "storage_options") and not isinstance(path, (PosixPath, WindowsPath))


def is_path_like(value: Any) -> bool:
    """Test whether a setting is a path."""
    return isinstance(value, (str, Path)) or is_remote(value)


@contextmanager
def remote_errors(path: Path) -> Iterator[None]:
    """Turn every exception of a remote file system (no credentials, no connection, a timeout) into an OSError.

    It is a ConnectionError or has an `errno`, unlike an OSError of a library that finds a file damaged.
    """
    try:
        yield
    except CFlowError:
        raise
    except OSError as error:
        if is_remote(path) and error.errno is None:
            error.errno = errno.EIO
        raise
    except Exception as error:
        if not is_remote(path):
            raise
        raise ConnectionError(f"cannot reach {path} ({type(error).__name__}: {error})") from error


def exist(*paths: Path) -> bool:
    """Test whether all of these files or folders exist. Errors as in `remote_errors`."""
    with remote_errors(paths[0]):
        return all(path.exists() for path in paths)


def forget_listings(path: Any) -> None:
    """Drop the folder listings that fsspec caches, also for `is_file`: other processes may have written since."""
    if is_remote(path):
        path.fs.invalidate_cache()


def read_bytes(path: Path) -> bytes:
    """Read a file, in one request if it is remote, and decompress it if it is called `.gz`.

    A missing file, a device, a pipe and an unreachable file system raise an OSError, a git-lfs pointer a `CFlowError`.
    """
    if not is_remote(path):
        check_file(path)
        content = path.read_bytes()
    else:
        remote: Any = path
        with remote_errors(path):
            content = bytes(remote.fs.cat_file(remote.path))  # pathlib's interface would ask for the size first
    return gzip.decompress(content) if path.suffix.lower() == GZ else content


def read_start(path: Path, count: int) -> bytes:
    """Read at most `count` bytes from the start of a file; errors as in `read_bytes`."""
    if is_remote(path):
        return read_bytes(path)[:count]
    check_file(path)
    with gzip.open(path) if path.suffix.lower() == GZ else open(path, "rb") as file:
        return file.read(count)


def suffix_of(path: Path) -> str:
    """Return the suffix of a file's format, without `.gz`, in lower case."""
    return (path.with_suffix("") if path.suffix.lower() == GZ else path).suffix.lower()


def stem_of(path: Path) -> str:
    """Return the name of a file without its suffixes."""
    return (path.with_suffix("") if path.suffix.lower() == GZ else path).stem


def source_for_random_access(path: Path) -> Any:
    """Return a large file for a library that reads parts of it: its name, or an open file if it is remote.

    Cost: one request per block of 1 MiB that holds wanted bytes; the last 32 blocks of each file are kept.
    """
    if not is_remote(path):
        return check_file(path)
    return _open(path, cache_type="blockcache", block_size=_BLOCK, cache_options={"maxblocks": _KEPT_BLOCKS})


def source_for_mmap(path: Path) -> Any:
    """Return a large file for pyarrow to read repeatedly: its name, or a local copy if it is remote.

    The last four copies are unnamed files in TMPDIR, which vanish with the process, even if it is killed.
    """
    return pa.BufferReader(_copy(path)) if is_remote(path) else check_file(path)


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


def check_file(path: Path) -> str:
    """Return the name of a local file, which must be a regular file or a folder, and not a git-lfs pointer."""
    mode = path.stat().st_mode
    if not stat.S_ISREG(mode) and not stat.S_ISDIR(mode):
        raise OSError(f"{path} is a device or a pipe, not a file")  # reading it might never end
    if stat.S_ISREG(mode):
        with open(path, "rb") as file:
            if file.read(len(_POINTER)) == _POINTER:
                raise CFlowError(f"{path} is a git-lfs pointer, not the data: run git lfs pull there, or download it")
    return str(path)


def is_safe_name(name: Any) -> bool:
    """Test whether a value from data can name one file or folder that stays in its folder."""
    return isinstance(name, str) and name.isprintable() and _NAME.fullmatch(name) is not None


def safe_name(name: Any, what: str) -> str:
    """Return a name from data, or raise a `CFlowError` that begins with `what` if it is not a safe name."""
    if not is_safe_name(name):
        shown = ascii(name)[: _SHOWN + 2] if isinstance(name, str) else f"a {type(name).__name__}"
        raise CFlowError(f"{what} {shown} cannot be used as a file or folder name: {_RULE}; rename it in the data")
    return str(name)


def path_inside(folder: Path, relative: Any, what: str) -> Path:
    """Return the path of a file below a folder. `relative` is the text in the data that names the file.

    If `relative` is empty or absolute, or contains an unsafe name such as `..`, we raise a `CFlowError` that begins
    with `what`. Symbolic links may lead out of the folder, because users link data sets.
    """
    names = relative.split("/") if isinstance(relative, str) else [""]
    named = [name for name in names if name not in ("", ".")]
    if not names[0] or not named or not all(map(is_safe_name, named)):
        shown = ascii(relative)[:_SHOWN]
        raise CFlowError(f"{what} {shown} is not read: it must name a file below {folder}; {_RULE}")
    return folder.joinpath(*named)


def is_timestamp(name: str) -> bool:
    """Test whether a name is a time stamp: digits 0 to 9 that an int64 can hold."""
    return name.isascii() and name.isdigit() and len(name) < 20 and int(name) < 1 << 63
