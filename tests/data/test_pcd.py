"""PCD files: what is written is read, streams made by hand are understood, broken files are one clear error."""

from __future__ import annotations

import struct
import tempfile
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from cflow_torch import CFlowError
from cflow_torch.data.arrays.lzf import compress, decompress
from cflow_torch.data.arrays.pcd import read_pcd, write_pcd

DATA = ("ascii", "binary", "binary_compressed")
DTYPES = ("f4", "f8", "i1", "i2", "i4", "i8", "u1", "u2", "u4", "u8")


@st.composite
def clouds(draw):
    rows = draw(st.integers(0, 40))
    fields = {}
    for k in range(draw(st.integers(1, 5))):
        dtype = np.dtype(draw(st.sampled_from(DTYPES)))
        shape = (rows,) if draw(st.booleans()) else (rows, draw(st.integers(2, 3)))
        fields[f"field{k}"] = draw(hnp.arrays(dtype, shape))
    return fields


@settings(max_examples=60, deadline=None)
@given(clouds(), st.sampled_from(DATA))
def test_round_trip_keeps_every_bit(fields, data):
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "cloud.pcd"
        write_pcd(file, fields, data)
        again = read_pcd(file)
    assert list(again) == list(fields)
    for name, values in fields.items():
        assert again[name].dtype == values.dtype and again[name].shape == values.shape, name
        assert np.array_equal(again[name], values, equal_nan=values.dtype.kind == "f"), name


@settings(max_examples=100, deadline=None)
@given(st.one_of(st.binary(max_size=2000), st.text("ab", max_size=2000).map(str.encode)))
def test_lzf_round_trip(data):
    stream = compress(data)
    assert len(stream) <= -(-len(data) * 33 // 32)
    assert decompress(stream, len(data)) == data


def test_lzf_by_hand():
    # "abc" plain, 5 bytes from 3 back (reaching into themselves), "d" plain, 10 bytes from 1 back (long form).
    stream = bytes([2, *b"abc", (5 - 2) << 5, 3 - 1, 0, *b"d", 7 << 5, 10 - 9, 1 - 1])
    assert decompress(stream, 19) == b"abc" + b"abcab" + b"d" + b"d" * 10
    # A distance above 256 uses the low bits of the control byte.
    filler = bytes(range(256)) + b"xyz"
    runs = b"".join(bytes([len(filler[i : i + 32]) - 1]) + filler[i : i + 32] for i in range(0, len(filler), 32))
    assert decompress(runs + bytes([(4 - 2) << 5 | 1, 259 - 1 - 256]), 263) == filler + filler[:4]


def test_lzf_compresses_and_reaches_its_limits():
    far = bytes(np.random.default_rng(0).integers(0, 256, 8192 - 300, dtype=np.uint8))
    data = far + bytes(3000) + far[:300]
    stream = compress(data)
    assert decompress(stream, len(data)) == data
    assert len(compress(bytes(26400))) < 320


@pytest.mark.parametrize("stream", [b"\x05abc", b"\x20", b"\xe0\x00", b"\x20\x00", b"\x00a\x20\x05"])
def test_lzf_broken_streams(stream):
    with pytest.raises(CFlowError):
        decompress(stream, 6)


def test_a_compressed_file_made_by_hand(tmp_path):
    """Two points, three float32 fields, one field after the other: x = (1, 2), y = (0, 0), z = (0, 0)."""
    plain = struct.pack("<6f", 1, 2, 0, 0, 0, 0)
    # 6 plain bytes of x, then the rest: 00 40 of the second x, one zero, and 15 zeros from one back.
    stream = bytes([8, *plain[:8], 0, 7 << 5, 15 - 9, 0])
    header = (
        b"# .PCD v0.7\nVERSION 0.7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nWIDTH 1\nHEIGHT 2\n"
        b"VIEWPOINT 0 0 0 1 0 0 0\nPOINTS 2\nDATA binary_compressed\n"
    )
    (tmp_path / "a.pcd").write_bytes(header + struct.pack("<II", len(stream), 24) + stream)
    cloud = read_pcd(tmp_path / "a.pcd")
    assert cloud["x"].tolist() == [1, 2] and cloud["y"].tolist() == [0, 0] and cloud["z"].tolist() == [0, 0]


def test_old_and_odd_headers(tmp_path):
    """No COUNT, COLUMNS for FIELDS, padding, Windows line ends, no POINTS."""
    text = "VERSION .5\r\nCOLUMNS x _ y\r\nSIZE 4 1 2\r\nTYPE F U I\r\nCOUNT 1 3 1\r\nWIDTH 2\r\nHEIGHT 1\r\nDATA "
    (tmp_path / "a.pcd").write_bytes((text + "ascii\r\n1.5 0 0 0 -3\r\nnan 9 9 9 4\r\n").encode())
    packed = np.dtype([("x", "<f4"), ("pad", "V3"), ("y", "<i2")])
    rows = np.zeros(2, packed)
    rows["x"], rows["y"] = (1.5, np.nan), (-3, 4)
    (tmp_path / "b.pcd").write_bytes((text + "binary\r\n").encode() + rows.tobytes() + b"\0\0")
    for name in "ab":
        cloud = read_pcd(tmp_path / f"{name}.pcd")
        assert list(cloud) == ["x", "y"] and cloud["y"].dtype == np.int16 and cloud["y"].tolist() == [-3, 4]
        assert np.array_equal(cloud["x"], np.array([1.5, np.nan], np.float32), equal_nan=True)


HEADER = {
    "VERSION": "0.7",
    "FIELDS": "x y z",
    "SIZE": "4 4 4",
    "TYPE": "F F F",
    "COUNT": "1 1 1",
    "WIDTH": "2",
    "HEIGHT": "1",
    "POINTS": "2",
    "DATA": "binary",
}


@pytest.mark.parametrize(
    ("changed", "complaint"),
    [
        ({"SIZE": "4 4"}, "SIZE has 2"),
        ({"SIZE": "4 4 3"}, "SIZE 3"),
        ({"TYPE": "F F D"}, "TYPE D"),
        ({"TYPE": "F F F", "SIZE": "4 4 2"}, "SIZE 2"),
        ({"COUNT": "1 1 0"}, "COUNT 0"),
        ({"POINTS": "3"}, "WIDTH times HEIGHT is 2"),
        ({"WIDTH": "3", "POINTS": "3"}, "need 36 bytes, found 24"),
        ({"WIDTH": "1", "POINTS": "1"}, "does not fit"),
        ({"WIDTH": "-2"}, "WIDTH must be a whole number"),
        ({"WIDTH": None, "POINTS": None}, "neither WIDTH nor POINTS"),
        ({"FIELDS": "x y x"}, "twice"),
        ({"FIELDS": None}, "FIELDS"),
        ({"DATA": "zip"}, "DATA zip"),
        ({"DATA": None}, "no complete DATA line"),
        ({"DATA": "ascii"}, "values"),
        ({"DATA": "binary_compressed"}, "compressed data hold"),
    ],
)
def test_inconsistent_files(tmp_path, changed, complaint):
    header = {key: value for key, value in {**HEADER, **changed}.items() if value is not None}
    text = "".join(f"{key} {value}\n" for key, value in header.items())
    file = tmp_path / "a.pcd"
    file.write_bytes(text.encode() + struct.pack("<6f", 1, 2, 3, 4, 5, 6))
    with pytest.raises(CFlowError, match=complaint) as raised:
        read_pcd(file)
    assert "a.pcd" in str(raised.value)


@pytest.mark.parametrize("data", DATA)
def test_every_truncation_is_noticed(tmp_path, data):
    file = tmp_path / "a.pcd"
    write_pcd(file, {"x": np.arange(20, dtype=np.float32), "t": np.arange(20, dtype=np.uint64)}, data)
    whole = file.read_bytes()
    # The last line end of a text file, and the last digits of its last number, cannot be missed.
    for size in range(0, len(whole) - (4 if data == "ascii" else 0), 7):
        file.write_bytes(whole[:size])
        with pytest.raises(CFlowError, match="a.pcd"):
            read_pcd(file)


def test_ascii_numbers_must_fit(tmp_path):
    for kind, word in (("U", "256"), ("U", "-1"), ("I", "1.5"), ("I", "abc")):
        text = f"FIELDS a\nSIZE 1\nTYPE {kind}\nWIDTH 1\nDATA ascii\n{word}\n"
        (tmp_path / "a.pcd").write_text(text)
        with pytest.raises(CFlowError, match="field a"):
            read_pcd(tmp_path / "a.pcd")


@pytest.mark.parametrize("content", [b"", b"\x89PNG\r\n" + bytes(100), b"ply\nformat ascii 1.0\n", bytes(100_000)])
def test_foreign_files(tmp_path, content):
    (tmp_path / "a.pcd").write_bytes(content)
    with pytest.raises(CFlowError, match="a.pcd"):
        read_pcd(tmp_path / "a.pcd")
    with pytest.raises(CFlowError, match="missing.pcd"):
        read_pcd(tmp_path / "missing.pcd")


@pytest.mark.parametrize(
    ("fields", "complaint"),
    [
        ({}, "one length"),
        ({"x": np.zeros(2, np.float32), "y": np.zeros(3, np.float32)}, "one length"),
        ({"a b": np.zeros(2, np.float32)}, "field name"),
        ({"x": np.zeros(2, np.float16)}, "float16"),
        ({"x": np.zeros((2, 2, 2), np.float32)}, "shape"),
    ],
)
def test_what_cannot_be_written(tmp_path, fields, complaint):
    with pytest.raises(CFlowError, match=complaint):
        write_pcd(tmp_path / "a.pcd", fields)
    assert not list(tmp_path.iterdir()), "nothing half-written"
    with pytest.raises(CFlowError, match="data='zip'"):
        write_pcd(tmp_path / "a.pcd", {"x": np.zeros(2, np.float32)}, "zip")
