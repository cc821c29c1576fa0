"""PCD files: all types, files of other programs, truncated files."""

from __future__ import annotations

import sys
import warnings

import numpy as np
import pytest

from cflow_torch import CFlowError
from cflow_torch.data.arrays.cloud_file import read_cloud, read_columns, write_cloud
from cflow_torch.data.arrays.pcd import pcd_fields, pcd_viewpoint
from cflow_torch.types import CFlowWarning

DTYPES = ("f4", "f8", "i1", "i2", "i4", "i8", "u1", "u2", "u4", "u8")

pypcd4 = pytest.importorskip("pypcd4", reason="needs the extra clouds: pip install pypcd4")


@pytest.mark.parametrize("data", ("ascii", "binary", "binary_compressed"))
@pytest.mark.parametrize("rows", [0, 1, 40])
def test_every_type_comes_back(tmp_path, data, rows):
    """Of files of other programs."""
    rng, file = np.random.default_rng(0), tmp_path / "a.pcd"
    fields = {
        kind: rng.integers(np.iinfo(kind).min, np.iinfo(kind).max, rows, kind, True)
        if kind[0] in "iu"
        else rng.integers(-(2**20), 2**20, rows).astype(kind) / 1024  # exact in ten decimals
        for kind in DTYPES
    }
    kinds = [values.dtype for values in fields.values()]
    pypcd4.PointCloud.from_points(list(fields.values()), list(fields), kinds).save(file, pypcd4.Encoding(data))
    again = pcd_fields(file.read_bytes())
    assert list(again) == list(fields)
    for name, values in fields.items():
        assert again[name].dtype == values.dtype and np.array_equal(again[name], values), name


@pytest.mark.parametrize("data", ("ascii", "binary", "binary_compressed"))
def test_every_truncation_is_detected(tmp_path, data):
    file, values = tmp_path / "a.pcd", np.arange(20, dtype=np.float32)
    pypcd4.PointCloud.from_points([values] * 3, list("xyz"), [values.dtype] * 3).save(file, pypcd4.Encoding(data))
    whole = file.read_bytes()
    read_cloud(file)
    # The last line end of a text file, and the last digits of its last number, cannot be missed.
    for size in range(0, len(whole) - (15 if data == "ascii" else 0), 29):
        file.write_bytes(whole[:size])
        with pytest.raises(CFlowError, match=r"a\.pcd"):
            read_cloud(file)


@pytest.mark.parametrize("data", ("ascii", "binary"))
def test_a_cloud_without_width_and_height_has_the_number_of_its_points(data):
    rows = np.arange(9, dtype="<f4").reshape(3, 3)
    body = rows.tobytes() if data == "binary" else b"0 1 2\n3 4 5\n6 7 8\n"
    header = b"VERSION 0.7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nWIDTH 0\nHEIGHT 0\n"
    cloud = pcd_fields(header + f"VIEWPOINT 0 0 0 1 0 0 0\nPOINTS 3\nDATA {data}\n".encode() + body)
    assert np.array_equal(np.stack([cloud[axis] for axis in "xyz"], axis=1), rows)


def test_fields_of_a_text_that_are_characters_are_left_out_and_said(tmp_path):
    """PCL writes a byte as a character: also blanks, ends of lines, and NUL."""
    rows = [
        b"%d.5 %d -nan(ind) 7.000 %c %c" % (k, 2 * k, tag, k % 3) for k, tag in enumerate((16, 32, 10, 9, 0, 48, 255))
    ]
    header = (
        b"FIELDS x y z intensity tag line\nSIZE 4 4 4 2 1 1\nTYPE F F F U U U\nCOUNT 1 1 1 1 1 1\nWIDTH 7\nHEIGHT 1\n"
    )
    (tmp_path / "a.pcd").write_bytes(header + b"POINTS 7\nDATA ascii\n" + b"\n".join(rows))
    with pytest.warns(CFlowWarning, match="the fields tag, line of .pcd files hold characters"):
        cloud = pcd_fields((tmp_path / "a.pcd").read_bytes())
    assert list(cloud) == ["x", "y", "z", "intensity"] and cloud["x"].tolist() == [k + 0.5 for k in range(7)]
    assert cloud["intensity"].tolist() == [7] * 7 and np.isnan(cloud["z"]).all()
    for wrong in (rows[:-1], [*rows[:-1], b"a 1 2 3 4 5"]):
        (tmp_path / "a.pcd").write_bytes(header + b"POINTS 7\nDATA ascii\n" + b"\n".join(wrong))
        with pytest.raises(CFlowError, match="a.pcd"):
            read_cloud(tmp_path / "a.pcd")


def text_of(names: str, types: str, rows: list[str]) -> bytes:
    """A text with fields of types such as f4 and u1."""
    kinds = types.split()
    sizes, letters = ("".join(f" {kind[part]}" for kind in kinds).upper() for part in (1, 0))
    header = f"FIELDS {names}\nSIZE{sizes}\nTYPE{letters}\nWIDTH {len(rows)}\nHEIGHT 1\nDATA ascii\n"
    return "\n".join([header.strip(), *rows]).encode()


@pytest.mark.parametrize("names", ["tag x y z i", "x y z i j", "x y z i tag", "tag x y z line", "a b c d tag"])
def test_rows_with_too_few_words_are_an_error_if_fields_before_x_y_z_or_no_characters_may_be_missing(names):
    kinds = {"tag": "u1", "line": "u1"}
    rows = ["1 2 3 4 5", "1 2 3 4" if names != "x y z i tag" else "1 2 3", "1 2 3 4 5"]
    types = " ".join(kinds.get(name, "f4") for name in names.split())
    with pytest.raises(ValueError, match="fewer than 5 numbers|2 points"):
        pcd_fields(text_of(names, types, rows))


def test_fields_behind_a_character_that_is_a_blank_are_left_out():
    with pytest.warns(CFlowWarning, match="fields tag, t of .pcd files hold characters, or follow them"):
        cloud = pcd_fields(text_of("x y z i tag t", "f4 f4 f4 f4 u1 f8", ["1 2 3 4 5 6", "1 2 3 4  6", "1 2 3 4 5 6"]))
    assert {name: values.tolist() for name, values in cloud.items()} == dict(
        zip("xyzi", ([1] * 3, [2] * 3, [3] * 3, [4] * 3))
    )


@pytest.mark.parametrize(
    ("kind", "words", "name"),
    [
        ("u4", ("-1", "-2"), "uint32"),
        ("u1", ("300", "301"), "uint8"),
        ("i2", ("nan", "inf"), "int16"),
        ("u8", ("1.5", "2.5"), "uint64"),
    ],
)
def test_numbers_that_a_type_does_not_have_are_said_once(kind, words, name, recwarn):
    warnings.simplefilter("default")
    for word in words:
        assert "t" not in pcd_fields(text_of("x y z t", f"f4 f4 f4 {kind}", ["1 2 3 4", f"1 2 3 {word}"]))
    (warning,) = recwarn
    assert f"the field t of .pcd files has numbers that are not {name}, so we leave it out" in str(warning.message)


def test_words_are_an_error_in_fields_of_several_bytes():
    with pytest.raises(ValueError, match="not a number"):
        pcd_fields(text_of("x y z t", "f4 f4 f4 u2", ["1 2 3 a"]))


@pytest.mark.parametrize("kind", ["i8", "u8"])
def test_long_integers_of_texts_with_comments_and_decimals_are_exact(kind):
    rows = ["1 2 3 1700000000123456789", "1 2 3 1700000000123456791.000"]
    text = text_of("x y z t", f"f4 f4 f4 {kind}", rows).replace(b"\n1 2", b"\n# of a filter\n1 2")
    assert pcd_fields(text)["t"].tolist() == [1700000000123456789, 1700000000123456791]


def test_padding_and_vector_fields_are_left_out(tmp_path):
    rows = np.zeros(2, [("x", "<f4"), ("pad", "V4"), ("normal", "<f4", 3), ("t", "<u8")])
    rows["x"], rows["normal"], rows["t"] = (1.5, np.nan), 7, (3, 2**60 + 1)
    header = b"VERSION 0.7\nFIELDS x _ normal t\nSIZE 4 1 4 8\nTYPE F U F U\nCOUNT 1 4 3 1\nWIDTH 2\nHEIGHT 1\n"
    (tmp_path / "a.pcd").write_bytes(header + b"VIEWPOINT 0 0 0 1 0 0 0\nPOINTS 2\nDATA binary\n" + rows.tobytes())
    cloud = pcd_fields((tmp_path / "a.pcd").read_bytes())
    assert list(cloud) == ["x", "t"] and cloud["t"].tolist() == [3, 2**60 + 1]
    assert np.array_equal(cloud["x"], rows["x"], equal_nan=True)


HEADER = (
    "# .PCD v.7\nVERSION .7\nFIELDS x y z _ i i _\nSIZE 4 4 4 1 2 2 2\nTYPE F F F U U U U\nCOUNT 1 1 1 3 1 1 0\n"
    "WIDTH 20\nHEIGHT 1\nVIEWPOINT 1 2 3 1 0 0 0\nPOINTS 20\nDATA binary\n"
)


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("", ""),
        ("\n", "\r\n"),
        ("VERSION .7\nFIELDS", "VERSION .5\nCOLUMNS"),
        ("POINTS 20\n", ""),
        ("HEIGHT 1\n", ""),
        ("VIEWPOINT 1 2 3 1 0 0 0\n", ""),
        ("WIDTH 20\nHEIGHT 1", "WIDTH 5\nHEIGHT 4"),
        ("TYPE F F F U U U U", "type f f f u u u u"),
        ("# .PCD v.7", "\ufeff# von Hand: Stra\u00dfe \u6771\u4eac"),
        ("DATA", "# stamp 3.5\nDATA"),
    ],
)
@pytest.mark.parametrize("encoding", ["utf-8", "utf-16-le"])
def test_headers_of_other_programs_are_read(tmp_path, old, new, encoding):
    """Repeated fields, padding with and without values, missing lines, comments of any encoding."""
    table = np.zeros(20, [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("pad", "V3"), ("i", "<u2"), ("j", "<u2")])
    rng = np.random.default_rng(0)
    for name in "xyzij":
        table[name] = rng.integers(0, 2**15, 20)
    comment = "# \u00fc\n".encode(encoding)
    file = tmp_path / "a.pcd"
    file.write_bytes(comment + HEADER.replace(old, new, 1 if len(old) > 1 else -1).encode() + table.tobytes())
    assert np.array_equal(read_cloud(file), np.stack([table[axis] for axis in "xyz"], 1))
    columns = read_columns(file)
    assert list(columns) == ["i", "i_2"]
    assert np.array_equal(columns["i"], table["i"]) and np.array_equal(columns["i_2"], table["j"])
    assert (pcd_viewpoint(file.read_bytes()) is None) == old.startswith("VIEWPOINT")


def test_without_pypcd4_the_message_names_it(tmp_path, monkeypatch):
    write_cloud(tmp_path / "a.pcd", np.zeros((2, 3), np.float32))
    monkeypatch.setitem(sys.modules, "pypcd4", None)
    with pytest.raises(CFlowError, match=r"pip install pypcd4"):
        pcd_fields((tmp_path / "a.pcd").read_bytes())
