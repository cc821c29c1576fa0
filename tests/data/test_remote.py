"""Places that fsspec reaches: every data set read as from a local folder; files written whole or not at all."""

from __future__ import annotations

import asyncio
import os
import pickle
import signal
import subprocess
import sys
import uuid
from dataclasses import replace
from pathlib import Path
from typing import Any, Callable, Iterator, Tuple

import numpy as np
import pytest
import scenes
from test_waymo import GridRecording, write_tfrecord
from tiny_recording import TinyRecording

from cflow_torch.data import atomic, paths
from cflow_torch.data.arrays.reader import ArraysLog
from cflow_torch.data.arrays.writer import write_array_log
from cflow_torch.data.atomic import atomic_file, atomic_folder, remove_stale
from cflow_torch.data.catalog import find_sources, open_log
from cflow_torch.data.flow_file import read_flow, write_flow
from cflow_torch.data.hdf5 import HDF5Log
from cflow_torch.data.hdf5.writer import write_hdf5_scene, write_index_files
from cflow_torch.data.paths import as_path, is_remote
from cflow_torch.data.waymo.tfrecord import WaymoRecordLog
from cflow_torch.estimate import make_model
from cflow_torch.simulator import make_drive
from cflow_torch.simulator.writers.aevascenes import write_aevascenes_sequence
from cflow_torch.simulator.writers.av2 import write_av2_log
from cflow_torch.simulator.writers.nuscenes import write_nuscenes
from cflow_torch.simulator.writers.truckscenes import write_truckscenes
from cflow_torch.simulator.writers.waymo import write_waymo_segment
from cflow_torch.types import CFlowError

WHY_SKIPPED = "universal_pathlib is not installed: pip install universal_pathlib fsspec"
DATA_SETS = ("av2", "hdf5", "nuscenes", "truckscenes", "waymo", "aevascenes", "arrays")


@pytest.fixture(scope="module")
def written(tmp_path_factory: Any) -> Callable[[str], Path]:
    """Data set -> local folder with one small log of it, made when it is first asked for."""
    pytest.importorskip("upath", reason=WHY_SKIPPED)
    folder, done = tmp_path_factory.mktemp("local"), set()

    def write(name: str) -> Path:
        root = folder / name
        if name in done:
            return root
        done.add(name)
        if name in ("nuscenes", "truckscenes"):
            names = ("LIDAR_TOP",) if name == "nuscenes" else ("LIDAR_LEFT", "LIDAR_RIGHT")
            recording = TinyRecording(names)
            (write_nuscenes if name == "nuscenes" else write_truckscenes)(recording, root)
        elif name == "waymo":
            write_waymo_segment(GridRecording(), root)
        else:
            drive = make_drive(seed=3, num_sweeps=3, profile="demo")
            if name == "av2":
                write_av2_log(drive, root)
            elif name == "aevascenes":
                write_aevascenes_sequence(drive, root)
            elif name == "arrays":
                write_array_log(drive, root, ".npz", "tum")
            else:
                write_hdf5_scene(drive, root / f"{drive.log_id}.h5")
                write_index_files(root)
        return root

    return write


@pytest.fixture(params=["memory", "file"])
def place(request: Any, tmp_path: Path) -> Iterator[Any]:
    """An empty folder of a file system of fsspec."""
    upath = pytest.importorskip("upath", reason=WHY_SKIPPED)
    name = f"{uuid.uuid4().hex}/deep"
    folder = upath.UPath(f"memory://{name}" if request.param == "memory" else f"file://{tmp_path}/{name}")
    yield folder
    paths._copy.cache_clear()
    if request.param == "memory" and folder.exists():
        folder.fs.rm(folder.path, recursive=True)


def folder_of(source: Any) -> Any:
    return source if is_remote(source) else source.root


def upload(source: Path, place: Any) -> Any:
    """Copies a local folder."""
    for file in source.rglob("*"):
        if file.is_file():
            target = place / file.relative_to(source).as_posix()
            target.parent.mkdir(parents=True, exist_ok=True)
            target.write_bytes(file.read_bytes())
    return place


def assert_same_logs(one: Any, other: Any) -> None:
    assert one.log_id == other.log_id and list(one.timestamps) == list(other.timestamps)
    for index in range(len(one.timestamps)):
        a, b = one.sweep(index), other.sweep(index)
        assert len(a.points) and np.array_equal(a.points, b.points) and a.points.dtype == b.points.dtype
        assert np.array_equal(a.pose, b.pose) and a.timestamp_ns == b.timestamp_ns
        assert (a.is_ground is None) == (b.is_ground is None)
        assert a.is_ground is None or np.array_equal(a.is_ground, b.is_ground)
        a, b = one.labels(index), other.labels(index)
        assert (a is None) == (b is None)
        if a is not None:
            assert all(np.array_equal(getattr(a, n), getattr(b, n)) for n in ("flow", "category", "is_valid"))


# ---------------------------------------------------------------------------------------------- names


def test_what_is_no_address_is_a_local_name(tmp_path):
    for text in ("data/av2", str(tmp_path), "C:\\data", "a:b", "./x://y"):
        assert as_path(text) == Path(text) and not is_remote(as_path(text))
    assert as_path(f"file://{tmp_path}") == tmp_path and not is_remote(tmp_path)
    assert as_path(tmp_path) is tmp_path


def test_addresses(tmp_path):
    upath = pytest.importorskip("upath", reason=WHY_SKIPPED)
    path = as_path("memory://bucket/val/")
    assert path == upath.UPath("memory://bucket/val") and path.name == "val" and is_remote(path)
    assert pickle.loads(pickle.dumps(path)) == path and as_path(path) is path
    assert not is_remote(upath.UPath(str(tmp_path)))  # a path of this machine all the same
    for scheme in ("nosuch", "s33"):
        with pytest.raises(CFlowError, match=f"no file system {scheme}://"):
            as_path(f"{scheme}://bucket/val")


def test_missing_packages_are_named(monkeypatch):
    pytest.importorskip("upath", reason=WHY_SKIPPED)
    monkeypatch.setitem(sys.modules, "adlfs", None)
    with pytest.raises(CFlowError, match="adlfs"):
        as_path("abfs://bucket/val")
    monkeypatch.setitem(sys.modules, "upath", None)
    with pytest.raises(CFlowError, match=r"pip install universal_pathlib"):
        as_path("s3://bucket/val")


# ---------------------------------------------------------------------------------------------- reading


@pytest.mark.parametrize("name", DATA_SETS)
def test_every_data_set_is_read_as_from_a_local_folder(written, place, name):
    local = written(name)
    (expected,) = find_sources(name, local)
    root = upload(local, place)
    (source,) = pickle.loads(pickle.dumps(find_sources(name, root)))
    assert is_remote(folder_of(source))
    assert_same_logs(open_log(name, source), open_log(name, expected))
    if root.protocol == "memory":
        (again,) = find_sources(name, f"memory:/{root.path}/")
        assert again == source


@pytest.mark.parametrize("suffix", [".npy", ".bin", ".pcd", ".ply", ".feather", ".parquet"])
def test_every_kind_of_cloud(place, tmp_path, suffix):
    local = write_array_log(TinyRecording(log_id="00"), tmp_path / "local" / "sequences", suffix, "kitti")
    (tmp_path / "local" / "poses").mkdir()
    (local / "poses.txt").rename(tmp_path / "local" / "poses" / "00.txt")  # where KITTI has them
    (local / "calib.txt").write_text("Tr: 0 -1 0 0 0 0 -1 0.5 1 0 0 0.25\n")
    root = upload(tmp_path / "local", place) / "sequences"
    (source,) = find_sources("arrays", root)
    expected = ArraysLog(local)
    assert expected.poses is not None
    assert_same_logs(ArraysLog(source), expected)
    assert_same_logs(ArraysLog(source, poses=place / "poses" / "00.txt", times="times.txt"), expected)


def test_records_of_waymo(written, place, tmp_path, monkeypatch):
    (segment,) = find_sources("waymo", written("waymo"))
    (tmp_path / "local").mkdir()
    local = write_tfrecord(segment, tmp_path / "local" / "a.tfrecord")
    for head in (paths._BLOCK, 100):  # the time lies among the bytes that are read first, and not
        monkeypatch.setattr("cflow_torch.data.waymo.tfrecord._HEAD", head)
        log = WaymoRecordLog(upload(tmp_path / "local", place) / "a.tfrecord")
        assert_same_logs(log, WaymoRecordLog(local))
    with pytest.raises(CFlowError, match="b.tfrecord is missing"):
        WaymoRecordLog(place / "b.tfrecord")


def test_scenes_are_read_in_blocks_and_their_index_beside_them(written, place, monkeypatch):
    (local,) = find_sources("hdf5", written("hdf5"))
    (source,) = find_sources("hdf5", upload(written("hdf5"), place))
    monkeypatch.setattr(paths, "_BLOCK", 1000)
    for kept in (1, 3):
        monkeypatch.setattr(paths, "_KEPT_BLOCKS", kept)
        assert_same_logs(HDF5Log(source), HDF5Log(local))
    assert HDF5Log(source).eval_frames() == HDF5Log(local).eval_frames() != []


def test_a_scene_may_be_open_when_python_ends(written):
    (source,) = find_sources("hdf5", written("hdf5"))
    code = """
import sys
from upath import UPath
from cflow_torch.data import paths
from cflow_torch.data.hdf5 import HDF5Log
real = paths._RemoteFile._fetch
paths._RemoteFile._fetch = lambda self, start, end: real(self, start, end)  # a name that Python clears in the end
log = HDF5Log(UPath("file://" + sys.argv[1]))
print(len(log.sweep(0).points))
"""
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    run = subprocess.run(
        [sys.executable, "-c", code, str(source)], stdout=subprocess.PIPE, env=environment, check=False
    )
    assert run.returncode == 0 and int(run.stdout) > 0


def test_a_remote_file_is_a_file(place):
    data = bytes(range(256)) * 50
    place.mkdir(parents=True, exist_ok=True)
    (place / "a").write_bytes(data)
    for block in (0, 1, 7, 256, 100_000):
        file = paths._RemoteFile(place / "a", block)
        for at, count in ((0, 5), (3, 700), (12_790, 100), (12_800, 1), (20_000, 1), (255, 2), (0, 12_800)):
            assert file.seek(at) == at and file.read(count) == data[at : at + count]
        assert file.seek(-4, os.SEEK_END) == 12_796 and file.tell() == 12_796 and file.read() == data[-4:]


class Unreachable(Exception):
    """As the errors of the stores' own libraries: no OSError."""


@pytest.mark.parametrize("error", [FileNotFoundError, PermissionError, Unreachable, asyncio.TimeoutError])
@pytest.mark.parametrize("name", DATA_SETS)
def test_errors_of_the_far_side_are_one_frames(written, name, error, monkeypatch):
    memory = pytest.importorskip("fsspec.implementations.memory", reason=WHY_SKIPPED).MemoryFileSystem
    monkeypatch.setattr(paths, "_BLOCK", 1000)
    monkeypatch.setattr(paths, "_KEPT_BLOCKS", 1)
    paths._copy.cache_clear()
    root = upload(written(name), as_path(f"memory://{uuid.uuid4().hex}"))
    (source,) = find_sources(name, root)
    log = open_log(name, source, check=False)
    expected = log.sweep(0).points

    def fail(*args: Any, **kwargs: Any) -> Any:
        raise error("the far side is away")

    with monkeypatch.context() as broken:
        for method in ("cat_file", "open", "_open", "info", "ls", "exists", "isfile", "isdir"):
            broken.setattr(memory, method, fail)
        paths._copy.cache_clear()
        for read in (log.sweep, log.labels):
            if (name, read) != ("arrays", log.labels):
                with pytest.raises((CFlowError, OSError)):
                    read(1)
        with pytest.raises((CFlowError, OSError)):
            find_sources(name, root)
        with pytest.raises((CFlowError, OSError)):
            open_log(name, source if is_remote(source) else replace(source, tables=None))
    assert np.array_equal(log.sweep(0).points, expected)  # it is back


# ---------------------------------------------------------------------------------------------- writing


@pytest.fixture(scope="module")
def result() -> Any:
    window = scenes.scene(0)
    return make_model(scenes.config())([window])[0]


def names(folder: Any) -> Tuple[str, ...]:
    return tuple(sorted(path.name for path in folder.iterdir())) if folder.is_dir() else ()


@pytest.mark.parametrize("spooled", [64 << 20, 100])
def test_flow_files(place, result, tmp_path, monkeypatch, spooled):
    monkeypatch.setattr(atomic, "_SPOOLED", spooled)
    write_flow(tmp_path / "a.feather", result)
    write_flow(place / "log" / "1.feather", result)
    write_flow(place / "log" / "1.feather", result)  # in place of the first
    assert (place / "log" / "1.feather").read_bytes() == (tmp_path / "a.feather").read_bytes()
    assert names(place / "log") == ("1.feather",)
    scenes.assert_same(read_flow(place / "log" / "1.feather"), read_flow(tmp_path / "a.feather"))
    (place / "log" / "2.feather").write_bytes(b"half")
    for name in ("2.feather", "3.feather"):
        with pytest.raises(CFlowError, match="no flow file"):
            read_flow(place / "log" / name)


@pytest.mark.parametrize("error", [Unreachable, KeyboardInterrupt, OSError])
def test_a_block_that_fails_leaves_the_old_file(place, error):
    with atomic_file(place / "a") as file:
        file.write(b"old")
    with pytest.raises(error), atomic_file(place / "a") as file:
        file.write(b"new")
        file.flush()
        raise error
    with pytest.raises(error), atomic_file(place / "b") as file:
        file.write(b"new")
        raise error
    assert (place / "a").read_bytes() == b"old" and names(place) == ("a",)


@pytest.mark.parametrize("method", ["pipe_file", "put_file", "mv"])
def test_a_put_that_fails_leaves_the_old_file(place, method, monkeypatch):
    monkeypatch.setattr(atomic, "_SPOOLED", 10 if method == "put_file" else 1000)
    with atomic_file(place / "a") as file:
        file.write(b"old" * 100)

    def fail(*args: Any, **kwargs: Any) -> None:
        raise Unreachable("the far side is away")

    monkeypatch.setattr(type(place.fs), method, fail)
    if method == "mv" and place.protocol == "memory":
        return  # a store that needs no move
    with pytest.raises(OSError, match="far side is away"), atomic_file(place / "a") as file:
        file.write(b"new" * 100)
    assert (place / "a").read_bytes() == b"old" * 100 and names(place) == ("a",)


def test_folders_are_made_whole_here_only(place):
    with pytest.raises(CFlowError, match="write one here"), atomic_folder(place / "log"):
        pass


@pytest.fixture
def s3(monkeypatch: Any) -> Iterator[Any]:
    """A bucket of a server on this machine that speaks S3."""
    upath = pytest.importorskip("upath", reason=WHY_SKIPPED)
    pytest.importorskip("s3fs", reason="s3fs is not installed")
    moto = pytest.importorskip("moto.server", reason="moto[server] is not installed")
    server = moto.ThreadedMotoServer(ip_address="127.0.0.1", port=0, verbose=False)
    server.start()
    url = "http://{}:{}".format(*server.get_host_and_port())
    monkeypatch.setenv("AWS_DEFAULT_REGION", "us-east-1")
    bucket = upath.UPath("s3://bucket", endpoint_url=url, key="a", secret="b")
    bucket.fs.mkdir("bucket")
    yield bucket
    server.stop()


@pytest.mark.slow
def test_a_real_object_store(s3, written, result, tmp_path, av2_folder, kitti_file):
    for name, folder in (
        *((name, written(name)) for name in DATA_SETS),
        ("av2", av2_folder),
        ("hdf5", kitti_file.parent),
    ):
        root = upload(folder, s3 / uuid.uuid4().hex / folder.name)
        paths.forget_listings(root)
        (source,) = pickle.loads(pickle.dumps(find_sources(name, root)))
        (expected,) = find_sources(name, folder)
        assert is_remote(folder_of(source))
        assert_same_logs(open_log(name, source, check=False), open_log(name, expected, check=False))
    write_flow(tmp_path / "1.feather", result)
    write_flow(s3 / "out" / "1.feather", result)
    assert (s3 / "out" / "1.feather").read_bytes() == (tmp_path / "1.feather").read_bytes()
    with pytest.raises(KeyboardInterrupt), atomic_file(s3 / "out" / "2.feather") as file:
        file.write(b"half")
        raise KeyboardInterrupt
    assert names(s3 / "out") == ("1.feather",)
    with pytest.raises(CFlowError, match="no flow file"):
        read_flow(s3 / "out" / "2.feather")


# ---------------------------------------------------------------------------------------------- stale files

WRITER = """
import sys, time
from cflow_torch.data.atomic import atomic_file, atomic_folder
with atomic_file(sys.argv[1]) as file, atomic_folder(sys.argv[2]) as folder:
    file.write(b"half"); file.flush(); (folder / "a").write_bytes(b"half")
    print("ready", flush=True)
    time.sleep(60)
"""


@pytest.fixture
def killed(tmp_path: Path) -> Iterator[Callable[[], None]]:
    """A process in the middle of writing `1.feather` and the folder `log`; call it to kill it."""
    arguments = [sys.executable, "-c", WRITER, str(tmp_path / "1.feather"), str(tmp_path / "log")]
    process = subprocess.Popen(
        arguments, stdout=subprocess.PIPE, env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    )

    def kill() -> None:
        process.send_signal(signal.SIGKILL)
        process.wait()

    assert process.stdout is not None and process.stdout.readline().strip() == b"ready"
    yield kill
    kill()
    process.stdout.close()


@pytest.mark.skipif(os.name != "posix", reason="processes are asked about as POSIX has it")
def test_what_a_killed_process_leaves_is_removed(tmp_path, killed):
    with atomic_file(tmp_path / "2.feather") as file:
        file.write(b"whole")
    left = [name for name in names(tmp_path) if name != "2.feather"]
    assert len(left) == 2 and all(name.endswith(".tmp") for name in left)
    others = (
        ".1.feather.elsewhere-1-0123abcd.tmp",
        ".1.feather.tmp",
        "notes.tmp",
        ".hidden",
        ".1.feather-0123abcd.tmp",
    )
    for name in others:
        (tmp_path / name).write_bytes(b"")
    assert remove_stale(tmp_path) == []  # it lives
    killed()
    assert remove_stale(tmp_path) == left
    assert names(tmp_path) == tuple(sorted(("2.feather", *others)))
    assert remove_stale(tmp_path / "absent") == []


def test_what_is_mine_now_is_removed_whoever_made_it(tmp_path, killed):
    (tmp_path / ".1.feather.elsewhere-1-0123abcd.tmp").write_bytes(b"")
    (tmp_path / ".11.feather.elsewhere-1-0123abcd.tmp").write_bytes(b"")
    killed()
    assert len(remove_stale(tmp_path, {"1.feather", "3.feather"})) == 2
    assert names(tmp_path)[0] == ".11.feather.elsewhere-1-0123abcd.tmp" and len(names(tmp_path)) == 2
    assert len(remove_stale(tmp_path, ["log"])) == 1


def test_stale_files_of_a_remote_folder(place):
    place.mkdir(parents=True, exist_ok=True)
    for name in (".1.feather.elsewhere-1-0123abcd.tmp", "1.feather"):
        (place / name).write_bytes(b"")
    assert len(remove_stale(place, ["1.feather"])) == 1 and names(place) == ("1.feather",)
    assert remove_stale(place / "absent", ["1.feather"]) == []


def test_a_folder_that_was_being_replaced_comes_back(tmp_path):
    old = tmp_path / ".log.elsewhere-1-0123abcd.tmp" / "old"
    old.mkdir(parents=True)
    (old / "a").write_bytes(b"old")
    assert len(remove_stale(tmp_path, ["log"])) == 1
    assert names(tmp_path) == ("log",) and (tmp_path / "log" / "a").read_bytes() == b"old"


def test_a_local_file_has_the_usual_rights_and_is_synced_with_its_folders(tmp_path, monkeypatch):
    synced, real = [], os.fsync

    def fsync(descriptor: int) -> None:
        synced.append(os.fstat(descriptor).st_ino)
        real(descriptor)

    monkeypatch.setattr(os, "fsync", fsync)
    with atomic_file(tmp_path / "a" / "b" / "c") as file:
        file.write(b"x")
    file = tmp_path / "a" / "b" / "c"
    assert synced == [p.stat().st_ino for p in (tmp_path, tmp_path / "a", file, tmp_path / "a" / "b")]
    (tmp_path / "plain").write_bytes(b"x")
    assert file.stat().st_mode == (tmp_path / "plain").stat().st_mode
