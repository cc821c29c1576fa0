"""Hostile clouds, poses, masks and rasters: every one is refused with one clear error, and costs little."""

from __future__ import annotations

import contextlib
import io
import os
import struct
import time
import tracemalloc
import zipfile
from functools import partial
from pathlib import Path
from typing import Any, Callable

import numpy as np
import pytest

from cflow_torch import CFlowError
from cflow_torch.data import npy_file
from cflow_torch.data.aevascenes.npz_strings import read_npz_member
from cflow_torch.data.arrays.cloud_file import read_cloud, write_cloud
from cflow_torch.data.arrays.pcd import pcd_fields, read_pcd
from cflow_torch.data.arrays.ply import read_ply
from cflow_torch.data.arrays.poses_text import read_calibration, read_poses, read_times, to_nanoseconds
from cflow_torch.data.arrays.reader import ArraysLog
from cflow_torch.data.boxes import Boxes
from cflow_torch.data.ground import read_ground_raster
from cflow_torch.data.nuscenes.reader import read_pcd_bin
from cflow_torch.data.waymo.tfrecord import WaymoRecordLog

MIB = 1 << 20


def cheaply(read: Callable[[], Any], most: int = 16 * MIB) -> None:
    """The reader refuses, and asks for no more memory than that on the way."""
    tracemalloc.start()
    try:
        with pytest.raises(CFlowError):
            read()
        assert tracemalloc.get_traced_memory()[1] < most
    finally:
        tracemalloc.stop()


def pcd(data: str, body: bytes, points: str = "4", count: str = "1 1 1", fields: str = "x y z") -> bytes:
    letters = " ".join("F" for _ in fields.split())
    header = f"FIELDS {fields}\nSIZE {letters.replace('F', '4')}\nTYPE {letters}\nCOUNT {count}\nWIDTH {points}\n"
    return header.encode() + f"HEIGHT 1\nDATA {data}\n".encode() + body


def npy(descr: str, shape: str, body: bytes = bytes(48)) -> bytes:
    text = f"{{'descr': {descr}, 'fortran_order': False, 'shape': {shape}, }}\n".encode()
    return b"\x93NUMPY\1\0" + struct.pack("<H", len(text)) + text + body


# ---------------------------------------------------------------------------------------------- claims


@pytest.mark.parametrize("data", ["ascii", "binary", "binary_compressed"])
@pytest.mark.parametrize(
    ("points", "count"), [("999999999999", "1 1 1"), ("4", "1 4294967296 1"), ("0", "9" * 12 + " 1 1")]
)
def test_pcd_claims(data: str, points: str, count: str) -> None:
    stream = struct.pack("<II", 8, 2**32 - 1) + bytes(8)
    cheaply(lambda: pcd_fields(pcd(data, stream, points, count), "a.pcd"))


@pytest.mark.parametrize("points", ["999999999999", "9" * 30, "9" * 5000, "-1"])
@pytest.mark.parametrize("kind", ["ascii", "binary_little_endian", "binary_big_endian"])
def test_ply_claims(tmp_path: Path, kind: str, points: str) -> None:
    head = f"ply\nformat {kind} 1.0\nelement vertex {points}\nproperty float x\nproperty float y\nproperty float z\n"
    (tmp_path / "a.ply").write_bytes(f"{head}end_header\n".encode() + bytes(48))
    cheaply(lambda: read_ply(tmp_path / "a.ply"))


DESCRS = [
    *("'|O'", "'<c16'", "'|V0'", "'<U0'", "'<M8[ns]'", "[]", "[()]", "'f4,f4,O'", "[('x', '|O')]", "1", "''"),
    *("'(1000000000,)f4'", "[('x', '<f4', (1000000000,)), ('y', '<f4'), ('z', '<f4')]", "'<U100000000'"),
    *("(" * 90 + ")" * 90, "[" * 3000, "-" * 9000 + "1", "[('a', " * 70 + "'<f4'" + ")]" * 70, "{}['x']", "[[[[1]]]]"),
]
SHAPES = ["(1000000000000, 3)", "(-4, 3)", "(4294967296, 4294967296)", "(-1, -1)", "(9, 1000000000000)", "(4.0, 3)"]


@pytest.mark.parametrize("content", [*(npy(d, "(4, 3)") for d in DESCRS), *(npy("'<f4'", s) for s in SHAPES)])
def test_npy_claims(tmp_path: Path, content: bytes) -> None:
    """As a cloud, alone and in an archive, as poses, as a ground mask, and as a raster."""
    for name in ("a.npy", "poses.npy", "ground/0.npy", "m/l_ground_height_surface____X.npy"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_bytes(content)
    (tmp_path / "m" / "l___img_Sim2_city.json").write_text('{"R": [1, 0, 0, 1], "t": [0, 0], "s": 1}')
    for name in ("points/0.npy", "points/1.npy"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        write_cloud(tmp_path / name, np.zeros((4, 3)))
    with zipfile.ZipFile(tmp_path / "a.npz", "w") as archive:
        archive.writestr("points.npy", content)
    for name in ("a.npy", "a.npz"):
        cheaply(lambda name=name: read_cloud(tmp_path / name))
    cheaply(lambda: read_poses(tmp_path / "poses.npy"))
    cheaply(lambda: ArraysLog(tmp_path, poses=None).sweep(0))
    cheaply(lambda: read_ground_raster(tmp_path / "m"))


@pytest.mark.parametrize("kind", ["<M8[s]", "<U3"])
def test_axes_of_other_types(tmp_path: Path, kind: str) -> None:
    np.savez(tmp_path / "a.npz", x=np.zeros(3), y=np.zeros(3).astype(kind), z=np.zeros(3))
    with pytest.raises(CFlowError, match=r"a\.npz.*(numbers|text are read)"):
        read_cloud(tmp_path / "a.npz")


@pytest.mark.parametrize("suffix", [".npy", ".npz", ".bin", ".pcd", ".ply", ".txt", ".pcd.bin", ".tfrecord"])
@pytest.mark.parametrize("kind", ["pipe", "folder"])
def test_what_is_no_file(tmp_path: Path, suffix: str, kind: str) -> None:
    """Opening a pipe would wait for ever."""
    file = tmp_path / f"a{suffix}"
    if kind == "folder":
        file.mkdir()
    else:
        os.mkfifo(file)
    readers = {
        ".txt": [read_poses, read_times],
        ".npy": [read_cloud, read_poses],
        ".pcd.bin": [read_pcd_bin],
        ".tfrecord": [WaymoRecordLog],
        ".pcd": [read_cloud, read_pcd],
        ".ply": [read_cloud, read_ply],
    }
    for read in readers.get(suffix, [read_cloud]):
        with pytest.raises(CFlowError, match=f"a{suffix}"):
            read(file)
    with pytest.raises(CFlowError, match=f"a{suffix}"):
        read_npz_member(file, "xyz")


# ---------------------------------------------------------------------------------------------- bombs


def bomb(file: Path, num_bytes: int, claim: str, method: int = zipfile.ZIP_DEFLATED) -> Path:
    """An archive of some kilobytes with an array of zeros."""
    with zipfile.ZipFile(file, "w", method) as archive, archive.open("points.npy", "w") as member:
        member.write(npy("'|u1'", claim, b""))
        for _ in range(num_bytes // MIB):
            member.write(bytes(MIB))
    return file


def test_an_archive_that_unpacks_to_more_than_is_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(npy_file, "check_claim", partial(npy_file.check_claim, limit=16 * MIB))
    file = bomb(tmp_path / "a.npz", 64 * MIB, f"({16 * MIB}, 4)")
    assert file.stat().st_size < MIB // 10
    cheaply(lambda: read_cloud(file), MIB)
    whole = bytearray(file.read_bytes())  # now with a size in its table that is not true
    entry = whole.find(b"PK\1\2")
    whole[entry + 24 : entry + 28] = struct.pack("<I", 4096)
    file.write_bytes(whole)
    cheaply(lambda: read_cloud(file), MIB)


def test_a_header_that_unpacks_to_much(tmp_path: Path) -> None:
    """NumPy reads a header whole, of up to 4 GiB, before it finds that it is too long."""
    with zipfile.ZipFile(tmp_path / "a.npz", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("points.npy", b"\x93NUMPY\2\0" + struct.pack("<I", 2**32 - 1) + b" " * (32 * MIB))
    cheaply(lambda: read_cloud(tmp_path / "a.npz"), MIB)
    cheaply(lambda: read_npz_member(tmp_path / "a.npz", "points"), MIB)


def test_only_the_cloud_of_an_archive_is_unpacked(tmp_path: Path) -> None:
    """Members may share the same packed bytes, so that an archive unpacks to any multiple of its size."""
    file = bomb(tmp_path / "a.npz", 64 * MIB, f"({64 * MIB},)")
    with zipfile.ZipFile(file, "a") as archive:
        content = io.BytesIO()
        np.save(content, np.ones((4, 3)))
        archive.writestr("lidar.npy", content.getvalue())
        archive.writestr("names.npy", npy("'|O'", "(1,)", b"no pickle"))
    tracemalloc.start()
    assert read_cloud(file).shape == (4, 3)
    assert tracemalloc.get_traced_memory()[1] < MIB
    tracemalloc.stop()


@pytest.mark.parametrize("method", [zipfile.ZIP_LZMA, zipfile.ZIP_BZIP2])
def test_methods_that_numpy_does_not_write(tmp_path: Path, method: int) -> None:
    with pytest.raises(CFlowError, match="NumPy stores or deflates"):
        read_cloud(bomb(tmp_path / "a.npz", MIB, f"({MIB // 4}, 4)", method))


@pytest.mark.parametrize("wounds", ["9" * 10**6, "x" * 10**6])
def test_one_long_word_does_not_pad_the_others(tmp_path: Path, wounds: str) -> None:
    """As an array of text, each of a million numbers would take as many bytes as the longest."""
    words = f"{wounds} " + "1 " * 299_999
    (tmp_path / "a.pcd").write_bytes(pcd("ascii", words.encode(), "100000"))
    head = (
        "ply\nformat ascii 1.0\nelement vertex 100000\nproperty int x\nproperty float y\nproperty float z\nend_header\n"
    )
    (tmp_path / "a.ply").write_bytes(head.encode() + words.encode())
    tracemalloc.start()
    if wounds[0] == "x":
        with pytest.raises(CFlowError, match="x"):
            read_pcd(tmp_path / "a.pcd")
    else:
        assert np.isinf(read_pcd(tmp_path / "a.pcd")["x"][0])
    with pytest.raises(CFlowError, match=r"a\.ply"):
        read_ply(tmp_path / "a.ply")
    assert tracemalloc.get_traced_memory()[1] < 64 * MIB
    tracemalloc.stop()


# ---------------------------------------------------------------------------------------------- texts


@pytest.mark.parametrize(
    "word", ["1e30", "-1e30", "9223372036", "4611686019", "1e308", "0e999999999999999999999", "1" * 401]
)
def test_times_that_64_bits_do_not_hold(tmp_path: Path, word: str) -> None:
    (tmp_path / "times.txt").write_text(f"{word}\n1\n")
    with pytest.raises(CFlowError, match=r"time|times\.txt"):
        read_times(tmp_path / "times.txt")
    (tmp_path / "poses.txt").write_text(f"{word} 0 0 0 0 0 0 1\n")
    with pytest.raises(CFlowError, match=r"time|poses\.txt"):
        read_poses(tmp_path / "poses.txt")
    assert to_nanoseconds("4611686018.427387903") == 2**62 - 1


def test_lines_without_a_word(tmp_path: Path) -> None:
    (tmp_path / "a.txt").write_text(" , \nTr: 1 0 0 0 0 1 0 0 0 0 1 0\n,,\n")
    assert np.array_equal(read_calibration(tmp_path / "a.txt"), np.eye(4))
    (tmp_path / "a.txt").write_text(",\n,\n")
    with pytest.raises(CFlowError, match="is empty"):
        read_calibration(tmp_path / "a.txt")


@pytest.mark.parametrize("stem", ["²" * 16, "٣" * 16, "9" * 19, "1" * 200])
def test_names_that_are_no_times(tmp_path: Path, stem: str) -> None:
    for name in (stem, stem[:-1] + "1"):
        write_cloud(tmp_path / f"{name}.npy", np.zeros((4, 3)))
    write_cloud(tmp_path / f"{stem[:-1]}0.npy", np.zeros((4, 3)))
    log = ArraysLog(tmp_path)
    assert log.sweep(0).timestamp_ns is None and log.timestamps[1] == 1


# ---------------------------------------------------------------------------------------------- time


def seconds(read: Callable[[], Any]) -> float:
    begin = time.process_time()
    with contextlib.suppress(CFlowError):
        read()
    return time.process_time() - begin


def lzf_of(size: int) -> bytes:
    """References that reach into themselves, as short as they can be."""
    return b"\0\0" + b"\x20\0" * (size // 2)


def pcd_of(size: int, data: str) -> bytes:
    if data == "ascii":
        return pcd(data, b"1 " * (3 * (size // 6)), str(size // 6))
    points = size // 8
    stream = lzf_of(8 * points)
    return pcd(data, struct.pack("<II", len(stream), 12 * points + 1) + stream, str(points))


def many_fields(size: int) -> bytes:
    names = " ".join(f"f{i}" for i in range(size // 32))
    return pcd("binary", b"", "0", " ".join("1" for _ in names.split()), names)


TEXTS = {
    "poses of one digit": lambda size: b"1 " * (size // 2),
    "one long word": lambda size: b"9" * size,
    "one word a line": lambda size: b"1\n" * (size // 2),
    "empty lines": lambda size: b"\n" * size,
    "TUM": lambda size: b"".join(b"%d 0 0 0 0 0 0 1\n" % i for i in range(size // 20)),
}


@pytest.mark.parametrize("kind", ["ascii", "binary_compressed", "fields", "ply", *TEXTS])
def test_twice_the_bytes_take_twice_the_time(tmp_path: Path, kind: str) -> None:
    def time_of(size: int) -> float:
        if kind in TEXTS:
            (tmp_path / "a.txt").write_bytes(TEXTS[kind](size))
            return min(seconds(lambda: (read_poses(tmp_path / "a.txt"))) for _ in range(2))
        if kind == "ply":
            head = f"ply\nformat ascii 1.0\nelement vertex {size // 6}\n"
            head += "property float x\nproperty float y\nproperty int z\nend_header\n"
            (tmp_path / "a.ply").write_bytes(head.encode() + b"1 " * (size // 2))
            return min(seconds(lambda: read_ply(tmp_path / "a.ply")) for _ in range(2))
        content = many_fields(size // 4) if kind == "fields" else pcd_of(size, kind)
        return min(seconds(lambda: pcd_fields(content, "a.pcd")) for _ in range(2))

    small, large = time_of(100_000), time_of(400_000)
    assert large < 8 * small + 0.02  # four times the bytes; quadratic would be sixteen


def test_many_boxes_of_one_name() -> None:
    count = 20_000
    names = [str(i % (count // 2)) for i in range(count)]
    begin = time.process_time()
    with pytest.raises(CFlowError, match="named twice"):
        Boxes(names, np.zeros(count, np.uint8), np.ones((count, 3)), np.tile(np.eye(4), (count, 1, 1)))
    assert time.process_time() - begin < 1
    with pytest.raises(CFlowError, match="not finite"):
        Boxes(["a"], np.zeros(1, np.uint8), np.full((1, 3), np.nan), np.eye(4)[None])
