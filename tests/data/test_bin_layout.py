"""Files without a header: numbers per point and their type are recognised, in any order of points."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from cflow_torch import CFlowError
from cflow_torch.data.arrays.bin_layout import BinLayout, find_bin_layout
from cflow_torch.data.arrays.cloud_file import copy_rows, read_cloud
from cflow_torch.data.arrays.reader import ArraysLog
from cflow_torch.data.log_check import find_problems
from cflow_torch.types import CFlowWarning


def street(columns: int, kind: str = "<f4", count: int = 2400, shuffled: bool = False) -> np.ndarray:
    """Points of a scan, x, y, z, intensity, ring, time and two more columns."""
    rng = np.random.default_rng(0)
    angle, distance = np.linspace(0, 2 * np.pi, count), np.exp(rng.uniform(1, 4, count))
    xyz = [distance * np.cos(angle), distance * np.sin(angle), rng.uniform(-2, 1, count)]
    more = [rng.integers(0, 256, count), np.arange(count) % 32, angle / 63, rng.normal(size=count), rng.random(count)]
    table = np.stack([*xyz, *more], axis=1)[:, :columns].astype(kind)
    return rng.permutation(table) if shuffled else table


@pytest.mark.parametrize("shuffled", [False, True])
@pytest.mark.parametrize("kind", ["<f4", "<f8"])
@pytest.mark.parametrize("columns", [3, 4, 5, 6, 8])
def test_the_layout_is_recognised(tmp_path, columns: int, kind: str, shuffled: bool) -> None:
    table = street(columns, kind, shuffled=shuffled)
    assert find_bin_layout(table.tobytes()) == BinLayout(columns, kind)
    assert find_bin_layout((table * 1000).tobytes()).columns == columns, "millimetres"
    few_digits = (np.round(table * 64) / 64).astype(kind)
    assert find_bin_layout(few_digits.tobytes()) == BinLayout(columns, kind)
    assert find_bin_layout(table.astype("f4").astype(kind).tobytes()) == BinLayout(columns, kind)
    (tmp_path / "a.bin").write_bytes(table.tobytes())
    found = read_cloud(tmp_path / "a.bin")
    assert found.dtype == np.dtype(kind).newbyteorder("=") and np.array_equal(found, table[:, :3])
    assert np.array_equal(read_cloud(tmp_path / "a.bin", columns), table[:, :3])
    assert find_bin_layout(few_digits.tobytes(), columns) == BinLayout(columns, kind)


def test_missing_returns_and_reflectances_of_zero_change_nothing() -> None:
    for columns in (3, 4, 5):
        table = street(columns)
        table[::2] = 0
        table[:, 3:] *= np.arange(len(table))[:, None] % 5 == 0
        assert find_bin_layout(table.tobytes()).columns == columns
        for missing in (np.nan, np.inf):
            table[::2] = missing
            assert find_bin_layout(table.tobytes()).columns == columns


def test_with_given_columns_only_positions_tell_the_type() -> None:
    table = street(5, "<f8")
    table[:, 4] = 1.7e9 + np.arange(len(table)) * 1e-5
    assert find_bin_layout(table.tobytes(), 5) == BinLayout(5, "<f8")
    with pytest.raises(CFlowError, match=r"4 numbers per point are no coordinates.*numpy\.save"):
        find_bin_layout((street(4) * 1000).astype(np.int32).tobytes(), 4)


def test_near_points_of_one_reflectance_do_not_look_like_float64() -> None:
    table = street(4)
    table[:, :3] = np.clip(np.random.default_rng(0).normal(0, 6, (len(table), 3)), -20, 20)
    table[:, 3] = 1
    assert find_bin_layout(table.tobytes()) == BinLayout(4, "<f4")


def packed() -> bytes:
    kinds = [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("i", "u1"), ("t", "<u4"), ("ring", "u1")]
    table = np.zeros(2400, kinds)
    for axis, values in zip("xyz", street(3).T):
        table[axis] = values
    table["i"], table["t"] = np.arange(2400) % 256, np.arange(2400) * 40_000
    return table.tobytes()


def test_records_of_several_types_are_read_by_their_first_three_numbers(tmp_path) -> None:
    (tmp_path / "a.bin").write_bytes(packed())
    assert find_bin_layout(packed()) == BinLayout(3, "<f4", 6)
    assert np.array_equal(read_cloud(tmp_path / "a.bin"), street(3))
    assert BinLayout(3, "<f4", 6).fits(packed()) and not BinLayout(3, "<f4", 6).fits(street(4).tobytes()[: 18 * 1600])
    (tmp_path / "b.bin").write_bytes(packed()[18:])
    with pytest.warns(CFlowWarning, match="3 float32 and 6 other bytes per point"):
        assert len(ArraysLog(tmp_path).sweep(1).points) == 2399


@pytest.mark.parametrize("content", [packed()[:-3], street(4).tobytes()[:-4], b"a text " * 9000])
def test_other_files_are_refused_and_the_setting_is_named(tmp_path, content: bytes) -> None:
    (tmp_path / "a.bin").write_bytes(content)
    with pytest.raises(CFlowError, match=r"a\.bin.*bin_columns"):
        read_cloud(tmp_path / "a.bin")


def test_a_folder_has_one_layout_which_is_said(tmp_path, recwarn: Any) -> None:
    for columns in (4, 5):
        (tmp_path / str(columns)).mkdir()
        for k in range(2):
            (tmp_path / str(columns) / f"{k}.bin").write_bytes(street(columns)[k:].tobytes())
    assert len(ArraysLog(tmp_path / "4").sweep(1).points) == 2399
    assert not [each for each in recwarn.list if issubclass(each.category, CFlowWarning)]
    with pytest.warns(CFlowWarning, match="log 5: its .bin files look like 5 float32 per point"):
        log = ArraysLog(tmp_path / "5")
    assert np.array_equal(log.sweep(1).points, street(5)[1:, :3]) and log.notes
    assert len(ArraysLog(tmp_path / "5", bin_columns=5).sweep(0).points) == 2400
    with pytest.raises(CFlowError, match="does not look like 7 float32 per point, but like 5 .*data.bin_columns=5"):
        ArraysLog(tmp_path / "5", bin_columns=7)
    (tmp_path / "4" / "1.bin").write_bytes(street(4).tobytes()[:-4])
    with pytest.raises(CFlowError, match="not a multiple"):
        ArraysLog(tmp_path / "4", bin_columns=4).sweep(1)


def test_a_log_may_mix_numbers_of_columns(tmp_path) -> None:
    """A file whose size fits the layout of the log by chance is still recognised."""
    tables = [street(4), street(4), street(5), street(5)]
    for number, table in enumerate(tables):
        table.tofile(tmp_path / f"{number}.bin")
    for sweep, table in zip(ArraysLog(tmp_path), tables):
        assert np.array_equal(sweep.points, table[:, :3])


@pytest.mark.parametrize("columns", [None, 4])
def test_a_file_may_hold_all_x_first(tmp_path, columns: int | None) -> None:
    """Oxford RobotCar. Read with the wrong order, its points would be random, and everything would stand still."""
    table = street(4)
    (tmp_path / "a.bin").write_bytes(table.T.tobytes())
    layout = find_bin_layout(table.T.tobytes(), columns)
    assert layout == BinLayout(4, is_planar=True) and layout.fits(table.T.tobytes())
    assert np.array_equal(read_cloud(tmp_path / "a.bin", columns), table[:, :3])
    is_kept = np.arange(len(table)) % 3 > 0
    (tmp_path / "b.bin").write_bytes(b"")
    copy_rows(tmp_path / "a.bin", tmp_path / "b.bin", is_kept)
    assert np.array_equal(read_cloud(tmp_path / "b.bin"), table[is_kept, :3])
    with pytest.raises(CFlowError, match="does not look like 5 float32 per point, but like 4 .*all x first"):
        find_bin_layout(table.T.tobytes(), 5)
    assert find_bin_layout(table[np.argsort(table[:, 0])].tobytes()) == BinLayout(4)


def test_all_files_with_all_x_first_have_one_number_of_columns() -> None:
    """Half a column may differ from the other half, so twice as many columns explain more."""
    table = street(4)
    table[:1200, :2] *= 0.2
    content = table.T.tobytes()
    assert find_bin_layout(content) == find_bin_layout(content, 4) == BinLayout(4, is_planar=True)
    assert find_bin_layout(table[:, :3].T.tobytes()) == BinLayout(3, is_planar=True)


def test_records_of_many_numbers_are_read_and_the_columns_of_x_y_z_are_told(tmp_path) -> None:
    """DriveStudio's Waymo: origin of the laser, x, y, z, and others."""
    rng = np.random.default_rng(0)
    distance, angle, z = rng.uniform((2, -np.pi, -1.75), (30, np.pi, -1.7), (12_000, 3)).T
    x, y = distance * np.cos(angle), distance * np.sin(angle)
    z[:2400], x[:2400] = rng.uniform(-1.7, 3, 2400), 20  # a wall
    zeros = np.zeros(len(x))
    columns = [zeros + 1.4, zeros, zeros + 2.2, x, y, z, *[zeros] * 4, *rng.random((3, len(x))), zeros + 1]
    table = np.stack(columns, axis=1).astype("f4")
    assert find_bin_layout(table.tobytes()) == find_bin_layout(table.tobytes(), 14) == BinLayout(14)
    for k in range(2):
        table.tofile(tmp_path / f"{k}.bin")
    texts = find_problems(ArraysLog(tmp_path))
    assert any("x, y and z seem to be in columns 4, 5 and 6" in text for text in texts)
    assert not any("are the files complete" in text or "repeats" in text for text in texts)


def test_files_of_cloudcompare_are_told(tmp_path) -> None:
    with pytest.raises(CFlowError, match="CloudCompare's own format.*save it there as .ply"):
        find_bin_layout(b"CCB2" + street(4).tobytes())
