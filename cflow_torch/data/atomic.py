"""Files and folders that appear whole or not at all, here and on whatever fsspec reaches."""

from __future__ import annotations

import os
import re
import secrets
import shutil
import socket
import tempfile
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO, Any, Collection, Iterator

from cflow_torch.data.paths import PathLike, as_path, forget_listings, is_remote, remote_errors
from cflow_torch.types import CFlowError

# Where a put takes the place of what was there at once, and is seen by nobody before it is complete.
_WHOLE_PUTS = {"s3", "s3a", "gs", "gcs", "az", "abfs", "abfss", "oss", "memory"}
_TEMPORARY = re.compile(r"\.(?P<target>.+)\.(?P<host>[A-Za-z0-9_-]+)-(?P<process>\d+)-[0-9a-f]{8}\.tmp")


@contextmanager
def atomic_file(path: PathLike) -> Iterator[Any]:
    """Open a binary file for writing that takes its name only when everything is written.

    Args:
        path: final name; its folder is made if absent.

    Yields:
        The open file. If the block raises, nothing is left of it, and an older file stays.

    Convention:
        - On this machine: a temporary name in the same folder, `.NAME.<host>-<process>-<random>.tmp`, then a rename;
          contents and name are on disk when the block is done. Only a killed process leaves the temporary file behind,
          see `remove_stale`.
        - Elsewhere: a temporary file here, which is put when the block ends: in an object store under its name, on
          other file systems under a temporary name, then moved.

    Raises:
        OSError: as for any file; also if the far side cannot be reached.
    """
    path = as_path(path)
    if is_remote(path):
        with _put_file(path) as file:
            yield file
    else:
        with atomic_name(path) as temporary, open(temporary, "xb") as file:
            yield file


@contextmanager
def atomic_name(path: Path) -> Iterator[Path]:
    """As `atomic_file` on this machine, for libraries that open a file themselves.

    Yields:
        The temporary name, under which there is no file yet.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(temporary_name(path.name))
    try:
        yield temporary
        with open(temporary, "r+b") as written:
            os.fsync(written.fileno())
        os.replace(temporary, path)
    except BaseException as error:
        with suppress(FileNotFoundError):
            os.unlink(temporary)
        if isinstance(error, OSError) and error.errno is not None and error.filename is None:
            error.filename = str(path)  # "no space left" of what?
        raise
    sync_folder(path.parent)


@contextmanager
def _put_file(path: Any) -> Iterator[IO[bytes]]:
    with tempfile.TemporaryDirectory() as folder:
        made = os.path.join(folder, "made")
        with open(made, "w+b") as file:
            yield file
        with remote_errors(path):
            if path.protocol in _WHOLE_PUTS:
                path.fs.put_file(made, path.path)
                return
            path.parent.mkdir(parents=True, exist_ok=True)
            temporary = path.parent / temporary_name(path.name)
            try:
                path.fs.put_file(made, temporary.path)
                path.fs.mv(temporary.path, path.path)
            except BaseException:
                with suppress(Exception):
                    temporary.unlink()
                raise


@contextmanager
def atomic_folder(folder: PathLike) -> Iterator[Path]:
    """A folder to fill that takes its name only when the block ends, in place of an older one of that name.

    Args:
        folder: final name, on this machine; the folder above is made if absent.

    Yields:
        An empty folder under a temporary name beside it. If the block raises, it is removed and the older one stays;
        else all files in it are on disk before it takes its name.

    Raises:
        CFlowError: the folder would be remote.
    """
    folder = as_path(folder)
    if is_remote(folder):
        raise CFlowError(f"{folder}: folders are written whole on this machine only; write one here and copy it there")
    scratch = folder.with_name(temporary_name(folder.name))
    new, old = scratch / "new", scratch / "old"
    try:
        new.mkdir(parents=True)
        yield new
        for place in (new, *new.rglob("*")):
            sync_folder(place)  # files likewise
        if folder.exists():
            os.replace(folder, old)
        os.replace(new, folder)
        sync_folder(folder.parent)
    finally:
        _remove(scratch, folder)


def remove_stale(folder: PathLike, targets: Collection[str] | None = None) -> list[str]:
    """Remove what writers that were killed have left in a folder.

    Args:
        folder: where the files are; what lies in folders below is not looked at.
        targets: names of files or folders that only the caller writes from now on: their temporary ones are removed
            whoever made them. None = those of any name that a process of this host made which lives no more.

    Returns:
        Sorted names of what was removed; empty if the folder does not exist.

    Convention: a folder that was killed while it took the place of an older one gets the older one back. Hosts are told
        apart by name, so two containers of one name must not share a folder without `targets`.

    Raises:
        OSError: the folder cannot be listed, or a file in it not be removed.
    """
    folder, removed = as_path(folder), []
    forget_listings(folder)
    with remote_errors(folder):
        for path in list(folder.iterdir()) if folder.is_dir() else []:
            match = _TEMPORARY.fullmatch(path.name)
            if match is None:
                continue
            if targets is None:
                is_stale = match["host"] == _host() and not _lives(int(match["process"]))
            else:
                is_stale = match["target"] in targets
            if is_stale:
                _remove(path, folder / match["target"])
                removed.append(path.name)
    return sorted(removed)


def _remove(path: Path, target: Path) -> None:
    """Remove a temporary file or folder; the older folder that it was to replace comes back if nothing did."""
    if not path.is_dir():
        with suppress(FileNotFoundError):
            path.unlink()
        return
    if (path / "old").is_dir() and not target.exists():
        os.replace(path / "old", target)
    shutil.rmtree(path)


def ensure_writable(folder: PathLike) -> Path:
    """A folder to write into after long work: tried now, and rid of what killed writers have left there.

    Args:
        folder: made if absent.

    Returns:
        Its path.

    Raises:
        CFlowError: it cannot be made, or not be written to.
    """
    folder = as_path(folder)
    try:
        remove_stale(folder)
        trial = folder / temporary_name("trial")
        with atomic_file(trial) as file:
            file.write(b"\0")
        with suppress(OSError), remote_errors(folder):  # some stores let nobody delete
            trial.unlink()
    except OSError as error:
        raise CFlowError(f"cannot write into {folder} ({error}): make room there, or give output=FOLDER") from error
    return folder


def sync_folder(folder: Path) -> None:
    """Makes the names in a folder, or what is in a file, durable where the system allows to wait for it."""
    with suppress(OSError):  # some network file systems refuse
        descriptor = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)


def temporary_name(name: str) -> str:
    """A name beside `name` for what is not complete yet, which `remove_stale` knows."""
    return f".{name}.{_host()}-{os.getpid()}-{secrets.token_hex(4)}.tmp"


def _host() -> str:
    """Name of this machine; without dots, so that it can be told from the file's name before it."""
    return re.sub(r"[^A-Za-z0-9_-]", "_", socket.gethostname()) or "_"


def _lives(process: int) -> bool:
    """Whether a process of this host is there; where that cannot be asked, it may be."""
    if os.name != "posix":
        return True
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except (PermissionError, OverflowError):
        pass
    return True
