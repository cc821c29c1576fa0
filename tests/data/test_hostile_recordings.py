"""Hostile Waymo records and AevaScenes archives: refused with one clear error, quickly, without much memory."""

from __future__ import annotations

import pickle
import struct
import time
import tracemalloc
import zipfile
import zlib
from pathlib import Path
from typing import Any, Callable

import numpy as np
import pytest
from fuzzing.crafted_clouds import npy_of
from fuzzing.crafted_recordings import NAMES, Frames, field, image, names_npz, numbers, object_npy
from tiny_recording import TinyRecording

from cflow_torch import CFlowError
from cflow_torch.data.aevascenes.npz_strings import read_npz_member
from cflow_torch.data.truckscenes.reader import TruckScenesLog, find_truckscenes_scenes
from cflow_torch.data.waymo.range_image import LaserCalibration, range_image_points
from cflow_torch.data.waymo.tfrecord import WaymoRecordLog
from cflow_torch.simulator.writers.truckscenes import write_truckscenes

MIB = 1 << 20


def refused(read: Callable[[], Any], match: str, most: int = 16 * MIB, seconds: float = 2.0) -> None:
    """The reader refuses with such a message, within a time and an amount of memory."""
    tracemalloc.start()
    begin = time.process_time()
    try:
        with pytest.raises(CFlowError, match=match):
            read()
        assert tracemalloc.get_traced_memory()[1] < most
    finally:
        tracemalloc.stop()
    assert time.process_time() - begin < 2 * seconds  # tracemalloc slows everything down


# ---------------------------------------------------------------------------------------------- Waymo, tfrecord


def record(frame: bytes) -> bytes:
    return struct.pack("<Q", len(frame)) + bytes(4) + frame + bytes(4)


def frame(time_us: Any = 1_500_000_000_000_000, returns: Any = None, label: bytes = b"", flow: bytes = b"") -> bytes:
    """One laser with one image, maybe one label."""
    pose = numbers(np.eye(4).ravel())
    mount = field(1, 2) + field(3, -0.1) + field(4, 0.1) + field(5, pose)
    packed = image(np.full((2, 3, 4), 5.0)) if returns is None else returns
    laser = field(5, field(1, 2) + field(2, field(2, packed) + (field(5, flow) if flow else b"")))
    message = field(1, field(3, mount)) + field(2, time_us) + field(3, pose) + laser
    return record(message + (field(6, label) if label else b""))


def log_of(file: Path, *frames: bytes, **settings: Any) -> WaymoRecordLog:
    file.write_bytes(b"".join(frames) + frame(1_600_000_000_000_000))
    return WaymoRecordLog(file, **settings)


def test_the_frame_is_a_good_one(tmp_path: Path) -> None:
    log = log_of(tmp_path / "a.tfrecord", frame())
    assert len(log.sweep(0).points) == 6 and log.labels(0).is_valid.all()


@pytest.mark.parametrize("time_us", [1 << 53, 1 << 63, 1 << 600, b"x", 1.5])
def test_times_of_frames(tmp_path: Path, time_us: Any) -> None:
    refused(lambda: log_of(tmp_path / "a.tfrecord", frame(time_us)), "no tfrecord of Waymo frames")


def test_a_number_without_end(tmp_path: Path) -> None:
    endless = field(2, 5)[:1] + b"\xff" * (4 * MIB)
    refused(lambda: log_of(tmp_path / "a.tfrecord", record(endless)), "64 bits", 32 * MIB)


def test_small_records_are_not_read_again_and_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from cflow_torch.data.waymo import tfrecord

    (tmp_path / "a.tfrecord").write_bytes(b"".join(record(field(2, 10**15 + i)) for i in range(5000)))
    read = []

    def counted(path: Path) -> Any:
        file = open(path, "rb", buffering=0)  # noqa: SIM115
        whole = file.read

        class Counting:
            seek, tell = file.seek, file.tell
            __enter__, __exit__ = (lambda self: self), (lambda self, *_: file.close())

            def read(self, size: int = -1) -> bytes:
                read.append(size)
                return whole(size)

        return Counting()

    monkeypatch.setattr(tfrecord, "parts", counted)
    assert len(WaymoRecordLog(tmp_path / "a.tfrecord")) == 5000
    assert sum(read) < 2 * (tmp_path / "a.tfrecord").stat().st_size + (1 << 17)


def test_an_image_that_unpacks_to_much(tmp_path: Path) -> None:
    packing = zlib.compressobj()
    bomb = b"".join(packing.compress(bytes(MIB)) for _ in range(100)) + packing.flush()
    assert len(bomb) < MIB
    log = log_of(tmp_path / "a.tfrecord", frame(returns=bomb))
    refused(lambda: log.sweep(0), "unpacks to more than", 140 * MIB)  # zlib doubles its output


def test_an_image_of_a_million_fields(tmp_path: Path) -> None:
    log = log_of(tmp_path / "a.tfrecord", frame(returns=zlib.compress(b"\x08\0" * (8 * MIB))))
    refused(lambda: log.sweep(0), "more than 65536 fields", 64 * MIB)


@pytest.mark.parametrize("shape", [(0, 10**12, 4), (10**12, 0, 4), (2, 3, 1 << 64), (24,), (3, 2, 2, 2), (2, 4, 3)])
def test_shapes_of_images(tmp_path: Path, shape: Any) -> None:
    values = np.full((0 if 0 in shape else 24,), 5.0)
    log = log_of(tmp_path / "a.tfrecord", frame(returns=image(values, shape)))
    refused(lambda: log.sweep(0), "frame 0 cannot be read")


def test_images_without_pixels() -> None:
    with pytest.raises(CFlowError, match="no pixels"):
        range_image_points(np.zeros((0, 10**12, 4)), LaserCalibration(np.eye(4)))


def test_stored_flow_of_another_shape_and_class(tmp_path: Path) -> None:
    log = log_of(tmp_path / "a.tfrecord", frame(flow=image(np.zeros((3, 2, 4)))), stored_flow=True)
    refused(lambda: log.labels(0), "over one of")
    kinds = np.zeros((2, 3, 4))
    kinds[..., 3] = [[-1, 0, 4], [2e9, np.nan, 1e30]]
    log = log_of(tmp_path / "a.tfrecord", frame(flow=image(kinds)), stored_flow=True)
    labels = log.labels(0)
    assert labels.is_valid.tolist() == [False, True, True, True, False, True]
    assert (labels.category > 0).tolist() == [False, False, True, False, False, False]


@pytest.mark.parametrize("name", [10**12, 1 << 31, b"\xff"])
def test_names_of_boxes(tmp_path: Path, name: Any) -> None:
    """bytes(10**12) would be a terabyte of zeros."""
    label = field(1, b"".join(field(n, 1.0) for n in range(1, 8))) + field(3, 1) + field(4, name)
    log = log_of(tmp_path / "a.tfrecord", frame(label=label))
    refused(lambda: log.sweep(0), "frame 0 cannot be read")


def test_boxes_that_are_not_finite(tmp_path: Path) -> None:
    label = field(1, field(1, float("nan")) + field(7, float("inf"))) + field(3, 1) + field(4, b"a")
    log = log_of(tmp_path / "a.tfrecord", frame(label=label))
    with np.errstate(invalid="ignore"):
        refused(lambda: log.sweep(0), "not finite")


def test_what_the_fuzzer_starts_from_is_read(tmp_path: Path) -> None:
    (tmp_path / "a.tfrecord").write_bytes(Frames().build())
    assert len(WaymoRecordLog(tmp_path / "a.tfrecord").sweep(1).points) == 12


# ---------------------------------------------------------------------------------------------- AevaScenes, pickles


def names_of(folder: Path, pickled: bytes, shape: Any = (4, 1)) -> Any:
    (folder / "a.npz").write_bytes(names_npz(object_npy(pickled, shape)))
    return read_npz_member(folder / "a.npz", "semantic_labels", strings=True)


def wrapped(elements: bytes, count: int) -> bytes:
    """A pickled array of dtype object: before its elements, they themselves, after them."""
    whole = pickle.dumps(np.array([["\x01"]], dtype=object), protocol=3)
    at = whole.index(b"X\1\0\0\0\x01")
    shape = whole.replace(b"K\x01K\x01\x86", b"J" + struct.pack("<i", count) + b"K\x01\x86")
    at += len(shape) - len(whole)
    end = shape.index(b"t", at)  # APPEND follows the only element
    return shape[:at] + b"(" + elements + b"e" + shape[end:]


def test_names_in_a_pickle_made_by_hand(tmp_path: Path) -> None:
    assert names_of(tmp_path, wrapped(b"X\3\0\0\0carq\x63h\x63h\x63", 3), (3, 1)).tolist() == [["car"]] * 3


@pytest.mark.parametrize(
    "instruction",
    [
        *(b"r\xff\xff\xff\x7f", b"r\0\0\0\x10", b"p999999999\n"),  # remember by a number: room for as many
        *(code + struct.pack("<Q", 1 << 40) for code in (b"\x8d", b"\x8e", b"\x96")),
        *(b"X\xff\xff\xff\x7f", b"B\xff\xff\xff\x7f", b"\x8b\xff\xff\xff\x7f", b"I" + b"9" * 1000000 + b"\n"),
        *(b"}", b"2", b"\x81", b"\x82\x01", b"Pid\n", b"Q", b"\x97", b"\x8f", b"ios\nsystem\n", b"L1L\n"),
        b"(cos\nsystem\no",
    ],
)
def test_instructions_that_no_strings_need(tmp_path: Path, instruction: bytes) -> None:
    match = "has the instruction|ends early|not found"
    refused(lambda: names_of(tmp_path, b"\x80\x03" + instruction + pickle.dumps(NAMES, protocol=3)[2:]), match)


def test_a_name_of_a_type_that_takes_for_ever_to_write(tmp_path: Path) -> None:
    """A tuple of twice the same tuple, sixty times: 2^60 words, if anyone asks what it says."""
    nested = b"Nq\0" + b"h\0h\0\x86q\0" * 60
    scalar = b"cnumpy.core.multiarray\nscalar\ncnumpy\ndtype\nh\0\x85RC\4a\0\0\0\x86R"
    refused(lambda: names_of(tmp_path, b"\x80\x03" + nested + scalar + b"."), "scalar that is no string")


def test_one_long_name_asked_for_often(tmp_path: Path) -> None:
    """A pickle of 120 kB whose array would take 40 GB."""
    elements = b"X" + struct.pack("<I", 100_000) + b"x" * 100_000 + b"q\x63" + b"h\x63" * 99_999
    refused(lambda: names_of(tmp_path, wrapped(elements, 100_000), (100_000, 1)), "semantic_labels claims 4000")


def test_a_long_scalar_asked_for_often(tmp_path: Path) -> None:
    scalar = b"cnumpy.core.multiarray\nscalar\nq\x60cnumpy\ndtype\nX\2\0\0\0U9\x85Rq\x61"
    scalar += b"B" + struct.pack("<I", 400_000) + b"a\0\0\0" * 100_000 + b"q\x62"
    elements = scalar + b"h\x60h\x61h\x62\x86R" * 1000
    refused(lambda: names_of(tmp_path, wrapped(elements, 1000), (1000, 1)), "a long one")


@pytest.mark.parametrize(("instruction", "match"), [(b"]", "more than 262144 instructions"), (b"(", "claims")])
def test_a_pickle_that_unpacks_to_much(tmp_path: Path, instruction: bytes, match: str) -> None:
    """Empty lists take one byte in the file and some sixty in memory; marks are quick to look at, and eight bytes."""
    size = 65 * MIB if instruction == b"(" else 300_000
    with zipfile.ZipFile(tmp_path / "a.npz", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("semantic_labels.npy", object_npy(b"\x80\x03" + instruction * size + b"."))
    assert (tmp_path / "a.npz").stat().st_size < MIB // 8
    refused(lambda: read_npz_member(tmp_path / "a.npz", "semantic_labels", strings=True), match, seconds=5)


def test_pickles_of_every_length_are_the_same_strings(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    for size in (0, 1, 5, 999, 1000, 1001, 3500):
        texts = ["".join(rng.choice(list("aß€😀"), rng.integers(0, 90))) for _ in range(size // 2 + 1)]
        array = np.array([texts[i % len(texts)] for i in range(size)], dtype=object)[:, None]
        for protocol in (3, 4, 5):
            found = names_of(tmp_path, pickle.dumps(array, protocol=protocol), array.shape)
            assert found.shape == array.shape and found.ravel().tolist() == array.ravel().tolist()


def test_a_member_that_claims_more_than_there_is(tmp_path: Path) -> None:
    table = npy_of(np.zeros((4, 3), np.float32)).replace(b"(4, 3), ", b"(4444444444, 3), ")
    (tmp_path / "a.npz").write_bytes(names_npz(npy_of(NAMES.astype(str)), xyz=table))
    refused(lambda: read_npz_member(tmp_path / "a.npz", "xyz"), "claims")


# ---------------------------------------------------------------------------------------------- TruckScenes


@pytest.mark.parametrize("kind", ["F 8", "U 8"])
def test_times_of_shots(tmp_path: Path, kind: str) -> None:
    """Floats, and a time of which the distance to that of the sweep is -2^63, which is its own magnitude in 64 bits."""
    folder = write_truckscenes(TinyRecording(("LIDAR_LEFT",), num_sweeps=3), tmp_path)
    log = TruckScenesLog(find_truckscenes_scenes(folder)[0])
    chain = log._lidars["LIDAR_LEFT"]
    letter, size = kind.split()
    stamp = struct.pack("<d", 1.0) if letter == "F" else struct.pack("<Q", (1 << 63) + int(chain.times[1]))
    head = f"FIELDS x y z timestamp\nSIZE 4 4 4 {size}\nTYPE F F F {letter}\nCOUNT 1 1 1 1\n"
    head += "WIDTH 2\nHEIGHT 1\nDATA binary\n"
    (folder / chain.files[1]).write_bytes(head.encode() + (struct.pack("<3f", 9, 9, 9) + stamp) * 2)
    refused(lambda: log.sweep(1), "timestamp has dtype" if letter == "F" else "off the sweep's")
