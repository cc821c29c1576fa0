"""PCD files: all types, files of other programs, truncated files."""

from __future__ import annotations

import sys

import numpy as np
import pytest

from cflow_torch import CFlowError
from cflow_torch.data.arrays.cloud_file import pcd_fields, read_cloud, write_cloud

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


def test_padding_and_vector_fields_are_left_out(tmp_path):
    rows = np.zeros(2, [("x", "<f4"), ("pad", "V4"), ("normal", "<f4", 3), ("t", "<u8")])
    rows["x"], rows["normal"], rows["t"] = (1.5, np.nan), 7, (3, 2**60 + 1)
    header = b"VERSION 0.7\nFIELDS x _ normal t\nSIZE 4 1 4 8\nTYPE F U F U\nCOUNT 1 4 3 1\nWIDTH 2\nHEIGHT 1\n"
    (tmp_path / "a.pcd").write_bytes(header + b"VIEWPOINT 0 0 0 1 0 0 0\nPOINTS 2\nDATA binary\n" + rows.tobytes())
    cloud = pcd_fields((tmp_path / "a.pcd").read_bytes())
    assert list(cloud) == ["x", "t"] and cloud["t"].tolist() == [3, 2**60 + 1]
    assert np.array_equal(cloud["x"], rows["x"], equal_nan=True)


def test_without_pypcd4_the_message_names_it(tmp_path, monkeypatch):
    write_cloud(tmp_path / "a.pcd", np.zeros((2, 3), np.float32))
    monkeypatch.setitem(sys.modules, "pypcd4", None)
    with pytest.raises(CFlowError, match=r"pip install pypcd4"):
        pcd_fields((tmp_path / "a.pcd").read_bytes())
