"""Write files (local, or remote by fsspec) and local folders. Each takes its name only when it is complete."""

from __future__ import annotations

import io
import os
import re
import secrets
import shutil
import time
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, Iterator

from cflow_torch.data.paths import PathLike, as_path, forget_listings, is_remote, remote_errors, safe_name
from cflow_torch.errors import CFlowError

# Object stores, in which a put replaces the older file at once and nobody sees an incomplete one.
_ATOMIC_PUTS = {"s3", "s3a", "gs", "gcs", "az", "abfs", "abfss", "oss", "memory"}
_TEMPORARY = re.compile(r"\..+\.[0-9a-f]{8}\.tmp")
_ABANDONED = 3600.0  # seconds without a change after which we assume that no process writes a temporary file


@contextmanager
def atomic_file(path: PathLike) -> Iterator[Any]:
    """Open a binary file for writing. It takes its name only when everything is written; an older one stays until then.

    Missing folders are created. Local files have a temporary name in the same folder, `.NAME.<random>.tmp`, which a
    killed process leaves behind. Remote files stay in memory until the end.
    """
    path = as_path(path)
    if is_remote(path):
        content = io.BytesIO()
        yield content
        _put(path, content.getvalue())
    else:
        with atomic_name(path) as temporary, open(temporary, "xb") as file:
            yield file


@contextmanager
def atomic_name(path: Path) -> Iterator[Path]:
    """Yield a temporary name, for libraries that open a local file themselves. The file is then renamed to `path`."""
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(_temporary_name(path.name))
    try:
        yield temporary
        _sync(temporary)
        os.replace(temporary, path)
    except BaseException as error:
        with suppress(FileNotFoundError):
            os.unlink(temporary)
        if isinstance(error, OSError) and error.errno is not None and error.filename is None:
            error.filename = str(path)  # "No space left on device" does not say for which file
        raise


def write_text(path: PathLike, text: str) -> None:
    with atomic_file(path) as file:
        file.write(text.encode())


def _put(path: Any, content: bytes) -> None:
    with remote_errors(path):
        if path.protocol in _ATOMIC_PUTS:
            path.fs.pipe_file(path.path, content)
            return
        path.parent.mkdir(parents=True, exist_ok=True)
        temporary = path.parent / _temporary_name(path.name)
        try:
            path.fs.pipe_file(temporary.path, content)
            path.fs.mv(temporary.path, path.path)
        except BaseException:
            with suppress(Exception):
                temporary.unlink()
            raise


@contextmanager
def new_folder(root: PathLike, name: str, replace: bool = False) -> Iterator[Path]:
    """Create the folder `root/name`, which takes its name when the block ends. If the block raises, we remove it.

    An older folder stays until then if you `replace` it. Else it is a `CFlowError`, and so are a remote folder and a
    name that is not safe.
    """
    folder = as_path(root) / safe_name(name, "log_id")
    if is_remote(folder):
        raise CFlowError(f"{folder} is remote: write the folder on this machine and copy it there")
    if folder.exists() and not replace:
        raise CFlowError(f"{folder} exists already: remove it, or choose another root")
    new, older = (folder.with_name(_temporary_name(folder.name)) for _ in range(2))
    try:
        new.mkdir(parents=True)
        yield new
        for path in new.rglob("*"):
            if path.is_file():
                _sync(path)
        try:
            if replace and folder.exists():  # a folder cannot take the name of one that has files
                os.replace(folder, older)
            os.replace(new, folder)
        except BaseException:
            if older.exists() and not folder.exists():
                os.replace(older, folder)
            raise
        shutil.rmtree(older, ignore_errors=True)
    finally:
        shutil.rmtree(new, ignore_errors=True)


def remove_stale(folder: PathLike) -> None:
    """Remove the temporary files and folders that killed processes have left in a folder, which may be remote.

    They have not changed for an hour, because a process may still be writing to newer ones.
    """
    folder = as_path(folder)
    forget_listings(folder)
    with remote_errors(folder):
        left = [path for path in folder.iterdir() if _TEMPORARY.fullmatch(path.name)] if folder.is_dir() else []
        for path in filter(_is_abandoned, left):
            if path.is_dir():
                shutil.rmtree(path, ignore_errors=True)
            else:
                with suppress(FileNotFoundError):  # another process was quicker
                    path.unlink()


def _is_abandoned(path: Path) -> bool:
    """Test whether a temporary file, or a folder and all that is below it, has not changed for an hour."""
    with suppress(Exception):  # some remote file systems have no modification times
        paths = [path, *path.rglob("*")] if path.is_dir() else [path]
        return time.time() - max(each.stat().st_mtime for each in paths) > _ABANDONED
    return False


def ensure_writable(folder: PathLike) -> Path:
    """Create a folder, see `remove_stale`, and write a trial file, so that long work does not fail at its end."""
    folder = as_path(folder)
    try:
        remove_stale(folder)
        trial = folder / _temporary_name("trial")
        with atomic_file(trial) as file:
            file.write(b"\0")
        with suppress(OSError), remote_errors(folder):  # some stores do not allow deletion
            trial.unlink()
    except OSError as error:
        raise CFlowError(f"cannot write into {folder} ({error}): free some space, or pass output=FOLDER") from error
    return folder


def _sync(path: Path) -> None:
    """Wait until the contents of a file are on disk, so that a power cut after the rename leaves no empty file."""
    with open(path, "r+b") as file:
        os.fsync(file.fileno())


def _temporary_name(name: str) -> str:
    """Return a hidden name for an incomplete file or folder, which `remove_stale` recognises."""
    return f".{name}.{secrets.token_hex(4)}.tmp"
