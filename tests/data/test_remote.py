"""Remote paths: every data set is read as from a local folder, and files are written completely or not at all."""

from __future__ import annotations

import asyncio
import os
import pickle
import shutil
import sys
import uuid
from dataclasses import replace
from pathlib import Path
from typing import Any, Callable, Iterator

import numpy as np
import pytest
from small_logs import SMALL_LOGS, write_small_log

from cflow_torch.data import paths
from cflow_torch.data.atomic import atomic_file, ensure_writable, new_folder, remove_stale
from cflow_torch.data.catalog import find_sources, open_log
from cflow_torch.data.log import window
from cflow_torch.data.paths import as_path, is_remote
from cflow_torch.types import CFlowError

upath = pytest.importorskip("upath", reason="needs the extra remote: pip install universal_pathlib fsspec")
fsspec = pytest.importorskip("fsspec")
LocalFileSystem = pytest.importorskip("fsspec.implementations.local").LocalFileSystem
pytestmark = pytest.mark.filterwarnings("ignore:UPath 'far' filesystem not explicitly implemented")
REMOTE = [name for name in SMALL_LOGS if name != "bags"]


class Unreachable(Exception):
    """Like the errors of the stores' own libraries, it is not an OSError."""


class FarFile(fsspec.spec.AbstractBufferedFile):
    """A file of `Far`, where every range is a request."""

    def _fetch_range(self, start: int, end: int) -> bytes:
        return bytes(self.fs.cat_file(self.path, start, end))


class Far(LocalFileSystem):
    """Local folders as a remote store whose requests are counted and can fail."""

    protocol, cachable, requests, error = "far", False, 0, None

    @classmethod
    def _strip_protocol(cls, path: Any) -> str:
        return "/" + str(path).replace("far://", "").strip("/")

    def _asked(self, name: str, *arguments: Any, **settings: Any) -> Any:
        Far.requests += 1
        if Far.error is not None:
            raise Far.error("the store is unreachable")
        return getattr(super(), name)(*arguments, **settings)

    def info(self, path: Any, **settings: Any) -> Any:
        return self._asked("info", path, **settings)

    def ls(self, path: Any, detail: bool = True, **settings: Any) -> Any:
        return self._asked("ls", path, detail, **settings)

    def cat_file(self, path: Any, start: Any = None, end: Any = None, **_: Any) -> bytes:
        path = self._asked("_strip_protocol", path)
        return Path(path).read_bytes()[start:end]

    def _open(self, path: Any, mode: str = "rb", block_size: Any = None, **settings: Any) -> FarFile:
        return FarFile(self, path, mode, block_size or "default", **settings)


fsspec.register_implementation("far", Far, clobber=True)


@pytest.fixture
def far(monkeypatch: Any) -> Iterator[Callable[[Path], Any]]:
    """Convert a local folder to a path of `Far`."""
    paths._copy.cache_clear()
    monkeypatch.setattr(Far, "error", None)
    yield lambda folder: upath.UPath(f"far://{folder}")
    paths._copy.cache_clear()


@pytest.fixture(scope="module")
def written(tmp_path_factory: Any) -> Callable[[str], Path]:
    """Data set -> local folder with one small log, written on the first call."""
    folder = tmp_path_factory.mktemp("local")
    return lambda name: folder / name if (folder / name).is_dir() else write_small_log(name, folder / name)


@pytest.fixture(params=["memory", "file"])
def remote(request: Any, tmp_path: Path) -> Iterator[Any]:
    """An empty folder of two file systems of fsspec: one has atomic puts, one needs a move."""
    name = f"{uuid.uuid4().hex}/deep"
    folder = upath.UPath(f"memory://{name}" if request.param == "memory" else f"file://{tmp_path}/{name}")
    yield folder
    if request.param == "memory" and folder.exists():
        folder.fs.rm(folder.path, recursive=True)


def assert_same_logs(one: Any, other: Any) -> None:
    assert one.log_id == other.log_id and list(one.timestamps) == list(other.timestamps)
    for index in range(len(one.timestamps)):
        a, b = one.sweep(index), other.sweep(index)
        assert len(a.points) and np.array_equal(a.points, b.points) and np.array_equal(a.pose, b.pose)
        assert a.timestamp_ns == b.timestamp_ns and (a.is_ground is None) == (b.is_ground is None)
        assert a.is_ground is None or np.array_equal(a.is_ground, b.is_ground)
        a, b = one.labels(index), other.labels(index)
        assert (a is None) == (b is None)
        assert a is None or all(np.array_equal(getattr(a, n), getattr(b, n)) for n in ("flow", "category", "is_valid"))


def names(folder: Any) -> tuple[str, ...]:
    return tuple(sorted(path.name for path in folder.iterdir())) if folder.is_dir() else ()


def test_plain_strings_are_local_paths(tmp_path):
    for text in ("data/av2", str(tmp_path), "C:\\data", "a:b", "./x://y"):
        assert as_path(text) == Path(text) and not is_remote(as_path(text))
    assert as_path(f"file://{tmp_path}") == tmp_path and not is_remote(tmp_path)
    assert as_path(tmp_path) is tmp_path
    for wrong in ("", "a\0b", 5, None):
        with pytest.raises(CFlowError, match="is not a valid path"):
            as_path(wrong)


def test_urls_are_remote_paths(tmp_path, monkeypatch):
    path = as_path("memory://bucket/val/")
    assert path == upath.UPath("memory://bucket/val") and path.name == "val" and is_remote(path)
    assert pickle.loads(pickle.dumps(path)) == path and as_path(path) is path
    assert not is_remote(upath.UPath(str(tmp_path)))  # it is a local path, too
    with pytest.raises(CFlowError, match="no file system s33://"):
        as_path("s33://bucket/val")
    monkeypatch.setitem(sys.modules, "adlfs", None)
    with pytest.raises(CFlowError, match="adlfs"):
        as_path("abfs://bucket/val")
    monkeypatch.setitem(sys.modules, "upath", None)
    with pytest.raises(CFlowError, match=r"pip install universal_pathlib"):
        as_path("s3://bucket/val")


def test_pipes_are_refused(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(OSError, match="device or a pipe"):
        paths.read_bytes(tmp_path / "pipe")


@pytest.mark.parametrize("name", REMOTE)
def test_every_data_set_is_read_from_remote_as_from_local(written, far, name):
    (expected,) = find_sources(name, written(name))
    (source,) = pickle.loads(pickle.dumps(find_sources(name, far(written(name)))))
    assert is_remote(source if is_remote(source) else source.root)
    assert_same_logs(open_log(name, source, check=False), open_log(name, expected, check=False))


def test_large_files_are_read_in_cached_blocks(far, tmp_path, monkeypatch):
    data = np.random.default_rng(0).bytes(100_000)
    (tmp_path / "a").write_bytes(data)
    monkeypatch.setattr(paths, "_BLOCK", 10_000)
    file, before = paths.source_for_random_access(far(tmp_path / "a")), Far.requests
    for at, count in ((5, 10), (9_000, 999), (90_000, 5_000), (95_000, 10_000), (3, 2)):
        assert file.seek(at) == at and file.read(count) == data[at : at + count]
    assert Far.requests - before == 2, "blocks 0 and 9"
    copies = {paths.source_for_mmap(far(tmp_path / "a")).read() for _ in range(3)}
    assert copies == {data}
    before = Far.requests
    assert paths.source_for_mmap(far(tmp_path / "a")).read() == data and Far.requests == before


@pytest.mark.parametrize(
    ("name", "error"),
    [
        *((name, Unreachable) for name in REMOTE),
        *(("av2", error) for error in (FileNotFoundError, asyncio.TimeoutError)),
        *(
            pytest.param(name, error, marks=pytest.mark.slow)
            for name in REMOTE
            for error in (FileNotFoundError, asyncio.TimeoutError)
            if name != "av2"
        ),
    ],
)
def test_a_remote_error_costs_one_call(written, far, name, error, monkeypatch):
    monkeypatch.setattr(paths, "_BLOCK", 20_000)
    monkeypatch.setattr(paths, "_KEPT_BLOCKS", 1)
    root = far(written(name))
    (source,) = find_sources(name, root)
    log = open_log(name, source, check=False)
    expected = log.sweep(0).points
    paths._copy.cache_clear()
    monkeypatch.setattr(Far, "error", error)
    closed = source if is_remote(source) else replace(source, tables=None)
    for read in (lambda: log.sweep(1), lambda: find_sources(name, root), lambda: open_log(name, closed)):
        with pytest.raises((CFlowError, OSError)):
            read()
    monkeypatch.setattr(Far, "error", None)
    assert np.array_equal(log.sweep(0).points, expected)  # the store is back


@pytest.mark.parametrize(
    ("name", "error"),
    [
        *(("av2", error) for error in (Unreachable, OSError, PermissionError, ConnectionError, TimeoutError)),
        *(("hdf5", error) for error in (ConnectionError, TimeoutError)),
    ],
)
def test_a_window_is_not_shorter_because_of_a_lost_connection(written, far, name, error, monkeypatch):
    monkeypatch.setattr(paths, "_BLOCK", 20_000)
    monkeypatch.setattr(paths, "_KEPT_BLOCKS", 1)
    log = open_log(name, find_sources(name, far(written(name)))[0], check=False)
    count, sweep = len(log.timestamps), log.sweep

    def lost(index: int) -> Any:
        monkeypatch.setattr(Far, "error", error if index == count - 3 else None)
        return sweep(index)

    monkeypatch.setattr(log, "sweep", lost)
    with pytest.raises(CFlowError, match="the store is unreachable"):
        window(log, count - 2, 1)


@pytest.mark.parametrize("error", [Unreachable, KeyboardInterrupt])
def test_a_file_appears_complete_when_its_block_ends(remote, error):
    with atomic_file(remote / "deep" / "a") as file:
        file.write(b"old")
    assert (remote / "deep" / "a").read_bytes() == b"old"
    for name in ("a", "b"):
        with pytest.raises(error), atomic_file(remote / "deep" / name) as file:
            file.write(b"new")
            file.flush()
            assert names(remote / "deep") == ("a",)
            raise error
    assert (remote / "deep" / "a").read_bytes() == b"old" and names(remote / "deep") == ("a",)
    with atomic_file(remote / "deep" / "a") as file:
        file.write(b"new")
    assert (remote / "deep" / "a").read_bytes() == b"new" and names(remote / "deep") == ("a",)


@pytest.mark.parametrize("method", ["pipe_file", "mv"])
def test_a_failed_put_leaves_the_old_file(remote, method, monkeypatch):
    with atomic_file(remote / "a") as file:
        file.write(b"old" * 100)

    def fail(*_: Any, **__: Any) -> None:
        raise Unreachable("the store is unreachable")

    monkeypatch.setattr(type(remote.fs), method, fail)
    if method == "mv" and remote.protocol == "memory":
        return  # this store needs no move
    with pytest.raises(OSError, match="store is unreachable"), atomic_file(remote / "a") as file:
        file.write(b"new" * 100)
    assert (remote / "a").read_bytes() == b"old" * 100 and names(remote) == ("a",)


def test_folders_are_local(remote):
    assert ensure_writable(remote / "out") == remote / "out" and names(remote / "out") == ()
    with pytest.raises(CFlowError, match="write the folder on this machine"), new_folder(remote, "log"):
        pass


def test_a_folder_appears_complete_when_its_block_ends(tmp_path, monkeypatch):
    with pytest.raises(KeyboardInterrupt), new_folder(tmp_path, "log") as folder:
        raise KeyboardInterrupt
    assert names(tmp_path) == ()
    with new_folder(tmp_path, "log") as folder:
        (folder / "deep").mkdir()
        (folder / "deep" / "a").write_bytes(b"new")
        assert not (tmp_path / "log").exists()
    assert (tmp_path / "log" / "deep" / "a").read_bytes() == b"new" and names(tmp_path) == ("log",)
    with pytest.raises(CFlowError, match="exists already"), new_folder(tmp_path, "log"):
        pass
    with pytest.raises(OSError), new_folder(tmp_path, "other"):
        (tmp_path / "other").mkdir()
        (tmp_path / "other" / "b").write_bytes(b"of another process")
    assert names(tmp_path / "other") == ("b",)
    shutil.rmtree(tmp_path / "other")
    with pytest.raises(KeyboardInterrupt), new_folder(tmp_path, "log", replace=True):
        raise KeyboardInterrupt
    assert (tmp_path / "log" / "deep" / "a").read_bytes() == b"new"
    replace_file = os.replace

    def interrupted(source, target):
        if Path(target).name == "log":  # the new folder, and then the older one
            monkeypatch.setattr(os, "replace", replace_file)
            raise KeyboardInterrupt
        replace_file(source, target)

    monkeypatch.setattr(os, "replace", interrupted)
    with pytest.raises(KeyboardInterrupt), new_folder(tmp_path, "log", replace=True):
        pass
    assert (tmp_path / "log" / "deep" / "a").read_bytes() == b"new" and names(tmp_path) == ("log",)
    with new_folder(tmp_path, "log", replace=True):
        pass
    assert names(tmp_path) == ("log",) and names(tmp_path / "log") == ()


def test_a_file_has_the_usual_mode_and_is_synced(tmp_path, monkeypatch):
    synced, real = [], os.fsync
    monkeypatch.setattr(os, "fsync", lambda at: (synced.append(os.fstat(at).st_ino), real(at)))
    with atomic_file(tmp_path / "a" / "b") as file:
        file.write(b"x")
    assert synced == [(tmp_path / "a" / "b").stat().st_ino]
    (tmp_path / "plain").write_bytes(b"x")
    assert (tmp_path / "a" / "b").stat().st_mode == (tmp_path / "plain").stat().st_mode


def test_leftovers_of_a_killed_process_are_removed_when_they_are_old(tmp_path):
    left = [".1.feather.0123abcd.tmp", ".log.0123abcd.tmp"]
    (tmp_path / left[0]).write_bytes(b"half"), (tmp_path / left[1]).mkdir()
    (tmp_path / ".1.feather.tmp").write_bytes(b"")  # not ours
    remove_stale(tmp_path)
    assert len(names(tmp_path)) == 3, "a process may still write them"
    (tmp_path / left[1] / "points").mkdir()
    for name in left:
        os.utime(tmp_path / name, (0, 0))
    remove_stale(tmp_path)
    assert names(tmp_path) == (".1.feather.tmp", left[1]), "a process writes into a folder of the log"
    os.utime(tmp_path / left[1] / "points", (0, 0))
    remove_stale(tmp_path)
    assert names(tmp_path) == (".1.feather.tmp",)
    remove_stale(tmp_path / "absent")
