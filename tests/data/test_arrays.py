"""Folders of point clouds: every suffix, every pose format, and files that do not fit."""

from __future__ import annotations

import gzip
import hashlib
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
import scenes
from pyarrow import feather, parquet
from scipy.spatial.transform import Rotation

from cflow_torch import CFlowError, Sweep
from cflow_torch.data.arrays import poses_text
from cflow_torch.data.arrays.cloud_file import SUFFIXES, copy_rows, read_cloud, read_columns, write_cloud
from cflow_torch.data.arrays.folder import find_array_logs
from cflow_torch.data.arrays.ply import ply_bytes, ply_fields
from cflow_torch.data.arrays.reader import ArraysLog
from cflow_torch.data.arrays.writer import write_array_log
from cflow_torch.data.folders import natural_key
from cflow_torch.data.log import Log
from cflow_torch.data.trajectory import Trajectory, fit_to_sweeps
from cflow_torch.types import CFlowWarning

STAMP = 1_700_000_000_123_456_789


class SmallLog(Log):
    """Three sweeps of 40 points with full poses (yaw, pitch, roll)."""

    log_id = "small"

    def __init__(self, poses=True, times=True, ground=True) -> None:
        rng = np.random.default_rng(3)
        self.timestamps = [STAMP + k * 100_000_000 for k in range(3)]
        self.poses = np.stack([scenes.pose(3.0 * k, -k, 0.0) for k in range(3)])
        self.poses[:, :3, :3] = Rotation.from_euler("ZXY", [(0.3 * k, 0.1, 0.2 * k) for k in range(3)]).as_matrix()
        self.sweeps = []
        for pose, time in zip(self.poses, self.timestamps):
            points, is_ground = rng.normal(0, 30, (40, 3)).astype(np.float32), rng.random(40) < 0.4
            given = (is_ground if ground else None, pose if poses else None, time if times else None)
            self.sweeps.append(Sweep(points, *given))

    def sweep(self, index: int) -> Sweep:
        return self.sweeps[index]


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """The small log on disk, .npy clouds with KITTI poses."""
    return write_array_log(SmallLog(), tmp_path)


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_clouds_come_back_from_every_suffix(tmp_path, suffix):
    small = SmallLog()
    log = ArraysLog(write_array_log(small, tmp_path, suffix))
    for index in range(3):
        stored, read = small.sweep(index), log.sweep(index)
        assert read.points.dtype == np.float32 and np.array_equal(read.points, stored.points), "float32, every bit"
        assert np.array_equal(read.is_ground, stored.is_ground) and log.labels(index) is None
    file, points = tmp_path / f"a{suffix}", np.random.default_rng(0).normal(0, 50, (30, 3))
    points[3] = np.nan
    write_cloud(file, points)
    expected = points.astype(np.float32) if suffix == ".bin" else points
    assert read_cloud(file).dtype == expected.dtype and np.array_equal(read_cloud(file), expected, equal_nan=True)
    whole = file.read_bytes()
    write_cloud(file, points[:0])
    assert read_cloud(file).shape == (0, 3)
    for content in (whole[: len(whole) // 2 + 1], whole[:5], b"\x00\xff not a cloud"):
        file.write_bytes(content)
        with pytest.raises(CFlowError, match=f"a{suffix}"):
            read_cloud(file)
    with pytest.raises(CFlowError, match="missing"):
        read_cloud(tmp_path / f"missing{suffix}")


def lines(numbers, mark=" ", ending="\n"):
    return "".join(mark.join(f"{number:.6f}" for number in row) + ending for row in numbers)


TEXTS = {
    ".csv": lambda table: "x,y,z,t\n" + lines(table, ","),
    ".CSV": lambda table: '"Points_m_XYZ:0","Points_m_XYZ:1","Points_m_XYZ:2","t"\n' + lines(table, ","),
    "_.csv": lambda table: "t;Z;Y;X\n" + lines(table[:, ::-1], ";").replace(".", ","),
    "_t.csv": lambda table: "class,x,y,z,t\n,,,,\n"
    + "".join("car," + row for row in lines(table, ",").splitlines(True)),
    ".txt": lambda table: lines(table),
    "_3.txt": lambda table: "  " + lines(table[:, :3], "   ", "  \r\n  ").rstrip(),
    "_6.txt": lambda table: "# from a scanner\n" + lines(np.column_stack([table, table[:, :2]])),
    "_c.txt": lambda table: f"//X Y Z t\n{len(table)}\n" + lines(table),
    "_e.csv": lambda table: "x,y,z,t,\n" + lines(table, ",", ",\n"),
    "_g.csv": lambda table: "x,y,z,class,t\n"
    + "".join(f"{row.rpartition(',')[0]},a car,{row.rpartition(',')[2]}" for row in lines(table, ",").splitlines(True)),
    "_f.csv": lambda table: "t,z,y,x\n" + lines(table[:, ::-1], ",", ",\n"),
    ".pts": lambda table: f"{len(table)}\n" + lines(table),
    ".asc": lambda table: "# X Y Z t\n" + lines(table),
    ".xyz": lambda table: "//x\ty\tz\tt\n" + lines(table, "\t"),
}


@pytest.mark.parametrize("suffix", TEXTS)
def test_clouds_are_read_from_texts(tmp_path, suffix):
    tables = np.random.default_rng(0).normal(0, 30, (3, 40, 4)).round(6)
    np.savetxt(tmp_path / "poses.txt", np.tile(np.eye(4)[:3].ravel(), (3, 1)))
    (tmp_path / "a.txt").write_text("a note")
    for number, table in enumerate(tables):
        (tmp_path / f"{number:06d}{suffix}").write_bytes(TEXTS[suffix](table).encode())
    log = ArraysLog(tmp_path)
    assert len(log) == 3 and len(log.poses) == 3
    has_empty_row = suffix == "_t.csv"
    assert np.array_equal(log.sweep(1).points[has_empty_row:], tables[1, :, :3].astype(np.float32))
    if suffix in (".csv", ".CSV", "_.csv", "_c.txt", "_e.csv", "_f.csv", ".asc", ".xyz"):
        assert np.array_equal(log.columns(1)["t"], tables[1, :, 3])


PROPERTIES = "".join(f"property float {axis}\n" for axis in "xyz")
HEADERS = {
    ".pcd": "VERSION 0.7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nWIDTH 6\nHEIGHT 1\nDATA ascii\n",
    ".ply": f"ply\nformat ascii 1.0\nelement vertex 6\n{PROPERTIES}end_header\n",
    ".xyz": "",
    ".csv": "x,y,z\n",
}


@pytest.mark.parametrize("nan", ["-nan(ind)", "nan(snan)", "1.#QNAN", "-1.#IND", "-nan"])
@pytest.mark.parametrize("suffix", HEADERS)
def test_missing_returns_in_texts_of_windows_are_nan(tmp_path, suffix, nan):
    rows = [f"{k}.5 2 3" for k in range(5)]
    rows.insert(1, f"{nan} {nan} {nan}")
    text = HEADERS[suffix] + "\n".join(rows) + "\n"
    (tmp_path / f"a{suffix}").write_text(text.replace(" ", ",") if suffix == ".csv" else text)
    points = read_cloud(tmp_path / f"a{suffix}")
    assert np.isnan(points[1]).all() and points[[0, 2, 5], 0].tolist() == [0.5, 1.5, 4.5]


def test_texts_that_are_no_clouds_stay_tables(tmp_path):
    """Two trajectories have names of one pattern, too."""
    t = np.arange(60.0)
    for number in range(2):
        np.savetxt(tmp_path / f"run{number}.txt", np.column_stack([t, t, 0 * t, 0 * t, 0 * t, 0 * t, 0 * t, 0 * t + 1]))
        np.savetxt(tmp_path / f"short{number}.csv", np.zeros((10, 3)), delimiter=",")
    assert find_array_logs(tmp_path) == []


@pytest.mark.parametrize("suffix", [*SUFFIXES, ".csv"])
def test_clouds_may_be_compressed(tmp_path, suffix):
    log = ArraysLog(write_array_log(SmallLog(times=False), tmp_path, ".npy" if suffix == ".csv" else suffix))
    for index, file in enumerate(log.files):
        content = file.read_bytes()
        if suffix == ".csv":
            content = TEXTS[".csv"](np.pad(log.sweep(index).points, ((0, 0), (0, 1)))).encode()
        file.with_name(f"{file.stem}{suffix}.gz").write_bytes(gzip.compress(content))
        file.unlink()
    again = ArraysLog(log.folder)
    assert np.allclose(again.sweep(1).points, SmallLog().sweep(1).points, atol=1e-6)
    assert np.array_equal(again.sweep(1).is_ground, SmallLog().sweep(1).is_ground)
    again.files[1].write_bytes(again.files[1].read_bytes()[:40])
    with pytest.raises(CFlowError, match=again.files[1].name):
        again.sweep(1)


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_other_columns_come_back_from_every_suffix(tmp_path, suffix):
    rng, file = np.random.default_rng(0), tmp_path / f"a{suffix}"
    points = rng.normal(size=(20, 3)).astype(np.float32)
    columns = {
        "intensity": rng.integers(0, 256, 20).astype(np.uint8),
        "half": rng.random(20).astype(np.float16),
        "time": rng.random(20),
        "stamp": STAMP + np.arange(20) * 512,  # float64 keeps multiples of 256 at this size
        "is_strongest": rng.random(20) < 0.5,
    }
    write_cloud(file, points, columns)
    width = 3 + len(columns)
    assert np.array_equal(read_cloud(file, width), points)
    found = read_columns(file, width)
    if suffix == ".bin":
        for values, stored in zip(columns.values(), found.values()):
            assert np.array_equal(stored, values.astype(np.float32))
        return
    assert list(found) == list(columns)
    for name, values in columns.items():
        assert np.array_equal(found[name], values), name
    wider = {".ply": {"half", "stamp", "is_strongest"}, ".pcd": {"half", "is_strongest"}, ".parquet": {"half"}}
    assert all(found[name].dtype == columns[name].dtype for name in set(columns) - wider.get(suffix, set()))
    with pytest.raises(CFlowError, match="column time has shape"):
        write_cloud(file, points, {"time": np.zeros(19)})


def test_columns_without_a_name_stay_in_a_plain_array(tmp_path):
    table = np.random.default_rng(0).normal(size=(20, 5)).astype(np.float32)
    np.save(tmp_path / "a.npy", table)
    (tmp_path / "a.bin").write_bytes(table.tobytes())
    np.savez(tmp_path / "a.npz", points=table, ring=np.arange(20), about=np.array([{}]), corners=np.zeros((4, 3)))
    for suffix, more in ((".npy", []), (".bin", []), (".npz", ["ring"])):
        columns = read_columns(tmp_path / f"a{suffix}", 5)
        assert sorted(columns) == sorted(["column_3", "column_4", *more])
        assert np.array_equal(columns["column_4"], table[:, 4])
        write_cloud(tmp_path / f"b{suffix}", table[:, :3], columns)
        assert sorted(read_columns(tmp_path / f"b{suffix}", 5)) == sorted(columns)
    assert np.array_equal(np.load(tmp_path / "b.npy"), table)
    assert (tmp_path / "b.bin").read_bytes() == table.tobytes()
    write_cloud(tmp_path / "b.ply", table[:, :3], {"laser number": np.arange(20)})
    assert list(read_columns(tmp_path / "b.ply")) == ["laser_number"]


def write_tum(file: Path, stamps: Any, poses: np.ndarray) -> None:
    numbers = np.column_stack([poses[:, :3, 3], Rotation.from_matrix(poses[:, :3, :3]).as_quat()])
    lines = [f"{ns // 10**9}.{ns % 10**9:09d} " + " ".join(map(repr, row)) for ns, row in zip(stamps, numbers.tolist())]
    file.write_text("\n".join(lines))


@pytest.mark.parametrize("poses", ["kitti", "tum", "npy", None])
def test_poses_and_times_come_back_from_every_format(tmp_path, poses):
    small = SmallLog()
    folder = write_array_log(small, tmp_path)
    if poses == "tum":
        write_tum(folder / "poses.txt", small.timestamps, small.poses)
    elif poses != "kitti":
        (folder / "poses.txt").unlink()
    if poses == "npy":
        np.save(folder / "poses.npy", small.poses)
    log = ArraysLog(folder)
    assert log.log_id == "small" and len(log) == 3
    assert list(log.timestamps) == small.timestamps == [log.sweep(k).timestamp_ns for k in range(3)], "nanoseconds"
    assert (log.poses is None) == (poses is None)
    if poses:  # 17 digits keep every bit of a matrix
        assert np.abs(log.poses - small.poses).max() <= (1e-14 if poses == "tum" else 0)
    (folder / "times.txt").unlink()
    assert list(ArraysLog(folder).timestamps) == (small.timestamps if poses == "tum" else [0, 1, 2])


def test_missing_poses_times_and_masks_are_not_written(tmp_path, folder):
    bare = write_array_log(SmallLog(poses=False, times=False, ground=False), tmp_path / "a")
    assert [path.name for path in bare.iterdir()] == ["points"]
    log = ArraysLog(bare)
    assert list(log.timestamps) == [0, 1, 2] and log.sweep(1).timestamp_ns is None and log.sweep(1).is_ground is None
    with pytest.raises(CFlowError, match="exists already"):
        write_array_log(SmallLog(), tmp_path)
    partly = SmallLog()
    partly.sweeps[1] = Sweep(partly.sweeps[1].points)
    with pytest.raises(CFlowError, match="no pose of sweep 1"):
        write_array_log(partly, tmp_path / "b")


def test_columns_are_found_by_name_or_position(tmp_path):
    rng = np.random.default_rng(0)
    points = rng.normal(size=(20, 3)).astype(np.float32)
    x, y, z = points.T
    structured = np.zeros(20, [("intensity", "u1"), ("z", "f4"), ("x", "f4"), ("y", "f4")])
    structured["x"], structured["y"], structured["z"] = x, y, z
    np.save(tmp_path / "structured.npy", structured)
    np.save(tmp_path / "wide.npy", np.asfortranarray(np.concatenate([points, points], 1)))
    np.save(tmp_path / "swapped.npy", points.astype(">f4"))
    np.savez(tmp_path / "axes.npz", x=x, y=y, z=z, ring=np.zeros(20, int))
    np.savez(tmp_path / "one.npz", cloud=points, ring=np.zeros(20, int))
    np.savez(tmp_path / "named.npz", other=np.zeros((9, 4)), lidar=points)
    feather.write_feather(pa.table({"i": [0.5] * 20, "y": y, "x": x, "z": z}), str(tmp_path / "named.feather"))
    parquet.write_table(pa.table({"east": x, "north": y, "up": z, "i": y}), str(tmp_path / "first.parquet"))
    (tmp_path / "nuscenes.bin").write_bytes(np.concatenate([points, points[:, :2]], 1).tobytes())
    for file in sorted(tmp_path.iterdir()):
        assert np.array_equal(read_cloud(file, 5), points), file.name


def test_a_column_that_counts_the_rows_is_no_coordinate(tmp_path):
    """As pandas writes it; the check called such points centimetres. Names may begin alike: lidar_x, lidar_y, ..."""
    points = np.random.default_rng(0).normal(size=(30, 3)).astype(np.float32)
    counted = np.column_stack([np.arange(30), points])
    np.savetxt(tmp_path / "plain.csv", counted, "%.9g", delimiter=",")
    (tmp_path / "pandas.csv").write_text(",0,1,2\n" + (tmp_path / "plain.csv").read_text())
    np.savetxt(tmp_path / "from_1.xyz", counted + (1, 0, 0, 0), "%.9g")
    np.save(tmp_path / "plain.npy", counted)
    columns = {"index": counted[:, 0], **{f"lidar_{axis}": points[:, k] for k, axis in enumerate("xyz")}}
    feather.write_feather(pa.table(columns), str(tmp_path / "named.feather"))
    feather.write_feather(pa.table(dict(zip("abcd", columns.values()))), str(tmp_path / "other.feather"))
    normals = {f"normal_{axis}": points[:, 0] for axis in "xyz"}
    feather.write_feather(pa.table({**normals, **columns}), str(tmp_path / "normals.feather"))
    for file in sorted(tmp_path.iterdir()):
        assert np.array_equal(read_cloud(file).astype(np.float32), points), file.name
    np.save(tmp_path / "xyz.npy", counted[:, :3])
    assert np.array_equal(read_cloud(tmp_path / "xyz.npy"), counted[:, :3]), "three columns are x, y, z"


@pytest.mark.parametrize("kind", ["i2", "i4", "i8"])
def test_integers_are_millimetres_or_centimetres_and_keep_their_digits(tmp_path, kind):
    points = np.array([[12345, -20000, 300], [1, 2, 3], [32767, 0, -32768]], kind)
    np.save(tmp_path / "a.npy", points)
    read = read_cloud(tmp_path / "a.npy")
    assert read.dtype == (np.float32 if kind == "i2" else np.float64) and np.array_equal(read, points)


def test_organised_arrays_have_a_row_per_point(tmp_path):
    points = np.arange(96, dtype=np.float32).reshape(4, 8, 3) + 1
    np.save(tmp_path / "a.npy", points)
    fields = np.zeros((4, 8), [(name, "f4") for name in "xyz"])
    for axis, name in enumerate("xyz"):
        fields[name] = points[..., axis]
    np.save(tmp_path / "b.npy", fields)
    for name in ("a.npy", "b.npy"):
        assert np.array_equal(read_cloud(tmp_path / name), points.reshape(-1, 3))
        copy_rows(tmp_path / name, tmp_path / "few.npy", np.arange(32) < 5)
        assert np.array_equal(read_cloud(tmp_path / "few.npy"), points.reshape(-1, 3)[:5])
    image = np.arange(4 * 64 * 1024, dtype=np.float32).reshape(64, 1024, 4)
    np.save(tmp_path / "channels.npy", np.moveaxis(image, 2, 0))
    assert np.array_equal(read_cloud(tmp_path / "channels.npy"), image.reshape(-1, 4)[:, :3])
    np.savez(tmp_path / "organised.npz", pcl=image[..., :3], ring=image[..., 3], pose=np.eye(4))
    assert np.array_equal(read_cloud(tmp_path / "organised.npz"), image.reshape(-1, 4)[:, :3])
    assert np.array_equal(read_columns(tmp_path / "organised.npz")["ring"], image[..., 3].ravel())
    np.save(tmp_path / "turned.npy", points.reshape(-1, 3).repeat(9, axis=0).T)
    assert np.array_equal(read_cloud(tmp_path / "turned.npy"), points.reshape(-1, 3).repeat(9, axis=0))


def test_clouds_of_two_sensors_in_one_folder_need_a_choice(tmp_path):
    for k, name in enumerate(("front_0", "front_1", "rear_0", "rear_1")):
        np.save(tmp_path / f"{name}.npy", np.full((3, 3), k + 1.0))
    with pytest.raises(CFlowError, match=r"rear_\*\.npy: choose one, such as data\.suffix='front_\*\.npy'"):
        ArraysLog(tmp_path)
    assert [sweep.points[0, 0] for sweep in ArraysLog(tmp_path, suffix="rear_*.npy")] == [3, 4]
    np.save(tmp_path / "front_2.npy", np.full((3, 3), 9.0))
    with pytest.raises(CFlowError, match=r"rear_\*\.npy: choose one, such as data\.suffix='front_\*\.npy'"):
        ArraysLog(tmp_path)


@pytest.mark.parametrize("names", [("os0_{:03d}", "os1_{:03d}"), ("lidar0_17{:08d}00", "lidar1_17{:08d}30")])
def test_sensors_may_differ_by_a_digit(tmp_path, names):
    for name in names:
        for number in range(3):
            np.save(tmp_path / f"{name.format(number)}.npy", np.ones((4, 3)))
    with pytest.raises(CFlowError, match=r"several kinds of clouds, \w+0_\*.npy, \w+1_\*.npy: choose one"):
        ArraysLog(tmp_path)
    assert len(ArraysLog(tmp_path, suffix=names[1].split("_")[0] + "_*.npy")) == 3


def test_some_clouds_of_a_folder_may_be_compressed(tmp_path):
    for number in range(3):
        np.save(tmp_path / f"{number}.npy", np.full((4, 3), number + 1.0))
    for numbers in ([1], [0, 2]):  # one cloud, then all of them
        for number in numbers:
            (tmp_path / f"{number}.npy.gz").write_bytes(gzip.compress((tmp_path / f"{number}.npy").read_bytes()))
        with pytest.raises(CFlowError, match="has several files of one name"):
            ArraysLog(tmp_path)
    for name in ("0.npy.gz", "1.npy", "2.npy.gz"):
        (tmp_path / name).unlink()
    for suffix in (None, "npy", ".npy.gz"):
        assert [sweep.points[0, 0] for sweep in ArraysLog(tmp_path, suffix=suffix)] == [1, 2, 3]


def test_numbers_that_count_tell_no_sensors(tmp_path):
    for name in ("drive1_a", "20240105T12_00", "20240105T13_00", "scan1", "scan10_x2"):
        (tmp_path / name).mkdir()
        for number in range(3):
            np.save(tmp_path / name / f"{name}{number}.npy", np.ones((4, 3)))
        assert len(ArraysLog(tmp_path / name)) == 3


def test_files_with_other_contents_are_refused(tmp_path):
    np.save(tmp_path / "flat.npy", np.zeros(9))
    np.save(tmp_path / "depth.npy", np.ones((64, 900)))
    np.save(tmp_path / "pickle.npy", np.array([{}, 1], dtype=object), allow_pickle=True)
    np.savez(tmp_path / "two.npz", a=np.zeros((3, 3)), b=np.zeros((3, 3)))
    np.savez(tmp_path / "ragged.npz", x=np.zeros(3), y=np.zeros(2), z=np.zeros(3))
    feather.write_feather(pa.table({"x": [1.0], "y": [1.0]}), str(tmp_path / "narrow.feather"))
    parquet.write_table(pa.table({"x": [1.0, None], "y": [1.0, 1], "z": [1.0, 1]}), str(tmp_path / "holes.parquet"))
    (tmp_path / "flat.ply").write_bytes(ply_bytes(dict.fromkeys("xy", np.zeros(3, np.float32))))
    (tmp_path / "cloud.las").write_bytes(b"LASF")
    for file in sorted(tmp_path.iterdir()):
        with pytest.raises(CFlowError, match=file.name):
            read_cloud(file)


@pytest.mark.parametrize("order", "<>")
def test_ply_reads_every_number_type(tmp_path, order):
    # PDAL, Open3D, CloudCompare, pyntcloud
    names = ("char", "uint8", "int16", "ushort", "int", "uint", "float32", "float64", "bool")
    codes = ("i1", "u1", "i2", "u2", "i4", "u4", "f4", "f8", "u1")
    kinds = [(f"p{k}", order + code) for k, code in enumerate(codes)]
    rows = np.frombuffer(np.random.default_rng(0).bytes(9 * 27), kinds)
    properties = "".join(f"property {name} {kind[0]}\n" for name, kind in zip(names, kinds))
    word = "little" if order == "<" else "big"
    header = f"ply\nformat binary_{word}_endian 1.0\nelement vertex 9\n{properties}element face 1\nend_header\n"
    (tmp_path / "a.ply").write_bytes(header.encode() + rows.tobytes() + b"faces")
    read = ply_fields((tmp_path / "a.ply").read_bytes())
    for again in (read, ply_fields(ply_bytes(read))):
        assert list(again) == list(rows.dtype.names)
        for name, values in again.items():
            assert values.dtype == rows.dtype[name].newbyteorder("=") and np.array_equal(values, rows[name], True)


def test_ply_reads_text(tmp_path):
    text = (
        "ply\nformat ascii 1.0\ncomment by hand\nobj_info nothing\nelement vertex 2\nproperty float32 x\n"
        "property double y\nproperty uint8 red\nelement face 1\nproperty list uchar int vertex_indices\nend_header\n"
        "1.5 -2 255\n0 1e-3 7\n3 0 1 1\n"
    )
    file = tmp_path / "a.ply"
    file.write_text(text)
    cloud = ply_fields(file.read_bytes())
    assert cloud["x"].tolist() == [1.5, 0] and cloud["y"].tolist() == [-2, 1e-3] and cloud["red"].tolist() == [255, 7]
    for old, new in (
        ("1.5 -2 255", "1.5 -2 256"),
        ("1.5 -2 255", "1.5 -2 25.5"),
        ("1.5 -2 255", "1.5 -2 nan"),
        ("1.5 -2 255", "1.5 -2"),
        ("1.5 -2 255\n0 1e-3 7", "1.5 -2\n0 1e-3"),
        ("float32 x", "list uchar int x"),
        ("element vertex 2", "element points 2"),
        ("end_header", ""),
        ("double y", "double x"),
    ):
        file.write_text(text.replace(old, new, 1))
        with pytest.raises(CFlowError, match=r"a\.ply"):
            read_cloud(file)


def test_a_ply_text_may_have_no_points_and_numbers_beyond_float32():
    head = "ply\nformat ascii 1.0\nelement vertex {}\nproperty float x\nproperty int y\nend_header\n{}"
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert ply_fields(head.format(0, "").encode())["x"].shape == (0,)
        far = ply_fields(head.format(1, "1e300 -2147483648\n").encode())
    assert far["x"].tolist() == [np.inf] and far["y"].tolist() == [-(2**31)]


def test_ply_files_of_other_programs_are_read(tmp_path):
    """Lists of vertices, elements before them, any line ends and names, comments of any encoding, repeated names."""
    points = np.random.default_rng(0).normal(size=(5, 3)).astype("<f4")
    axes = "property float X\nproperty float Y\nproperty float Z\n"
    more = "property uchar scalar_GPS time\nproperty list uchar short views\nproperty uchar a\nproperty uchar a\n"
    camera = "element camera 2\nproperty list uint float view\nproperty float at\n"
    head = f"comment Stra\xdfe\ncomment end_header\n{camera}element vertex 5\n{axes}{more}"
    tail = "element face 1\nproperty list uchar int vertex_indices\nend_header\n"
    rows, numbers = [], []
    for k, point in enumerate(points):
        ending = np.array([1, 2, 3, 4][:k], "<i2")
        rows.append(point.tobytes() + bytes([k, k]) + ending.tobytes() + bytes([7, 8 + k]))
        numbers.append(" ".join(map(repr, [*point.tolist(), k, k, *ending.tolist(), 7, 8 + k])))
    before = b"\1\0\0\0" + bytes(4) + bytes(4) + bytes(4) + bytes(4)  # a list of one value, then an empty one
    binary = (
        f"ply\nformat binary_little_endian 1.0\n{head}{tail}".encode("latin-1") + before + b"".join(rows) + b"faces"
    )
    text = f"ply\nformat ascii 1.0\n{head}{tail}1 0 0\n0 0\n\n" + "\n\n".join(numbers) + "\n3 0 1 2"
    contents = [binary, *(text.replace("\n", end).encode("latin-1") for end in ("\n", "\r\n", "\r"))]
    for content in contents:
        (tmp_path / "a.ply").write_bytes(content)
        assert np.array_equal(read_cloud(tmp_path / "a.ply"), points)
        columns = {name: values.tolist() for name, values in read_columns(tmp_path / "a.ply").items()}
        assert columns == {"scalar_GPS time": [0, 1, 2, 3, 4], "a": [7] * 5, "a_2": [8, 9, 10, 11, 12]}
    for size in range(len(binary) - len(b"faces")):
        (tmp_path / "a.ply").write_bytes(binary[:size])
        with pytest.raises(CFlowError, match=r"a\.ply"):
            read_cloud(tmp_path / "a.ply")


def test_names_are_sorted_naturally_and_read_as_times(tmp_path):
    names = ["10", "9", "a2", "a10", "a1b", "a1", "007", "7"]
    assert sorted(names, key=natural_key) == ["007", "7", "9", "10", "a1", "a1b", "a2", "a10"]
    for place, factor in (("ns", 1), ("us", 1000)):
        (tmp_path / place).mkdir()
        for k in range(2):
            np.save(tmp_path / place / f"{(1_700_000_000_000_000_000 + k * 10**8) // factor}.npy", np.zeros((4, 3)))
        log = ArraysLog(tmp_path / place)
        assert log.sweep(1).timestamp_ns == log.timestamps[1] == 1_700_000_000_100_000_000
    stamps = [-1_500_000_001, 0, 5, STAMP]
    poses_text.write_times(tmp_path / "t.txt", stamps)
    assert poses_text.read_times(tmp_path / "t.txt").tolist() == stamps
    (tmp_path / "m.txt").write_text("# 16 numbers, commas\n\n1, 0, 0, 5, 0,1,0,6, 0,0,1,7, 0,0,0,1\n")
    assert poses_text.read_poses(tmp_path / "m.txt").poses[0, :3, 3].tolist() == [5, 6, 7]


def test_poses_of_another_rate_are_interpolated(tmp_path):
    """An arc of constant speed and yaw rate is reproduced between the poses of a 50 Hz trajectory."""
    folder = write_array_log(SmallLog(), tmp_path)

    def on_arc(s: float) -> np.ndarray:
        return scenes.pose(20 * np.sin(0.5 * s), 20 * (1 - np.cos(0.5 * s)), 0.5 * s)

    seconds = np.arange(-1, 14) * 0.02
    truth = np.stack([on_arc(s) for s in seconds])
    write_tum(folder / "poses.txt", [STAMP + 7_000_000 + round(s * 1e9) for s in seconds], truth)
    for k, pose in enumerate(ArraysLog(folder).poses):
        assert np.abs(pose - on_arc(0.1 * k - 0.007)).max() < 1e-12
    poses_text.write_times(folder / "times.txt", [time + 10**12 for time in SmallLog().timestamps])
    with pytest.raises(CFlowError, match="clocks differ by about 999.973 s"):
        ArraysLog(folder)
    gap = Trajectory(truth[:2], np.array([0, 2 * 10**9]), False, "x")
    assert np.array_equal(fit_to_sweeps(gap, [0, 2 * 10**9])[0], gap.poses), "a pose at its time is kept"
    assert fit_to_sweeps(gap, [0, 10**9, 2 * 10**9 + 10**6, 2 * 10**9 + 10**7])[1].tolist() == [1, 0, 1, 0]


def test_kitti_camera_poses_become_lidar_poses(tmp_path, folder):
    """Camera poses and Tr give the LiDAR's motion: inv(Tr) P Tr."""
    camera_T_lidar = np.array([[0, -1, 0, 0.1], [0, 0, -1, -0.2], [1, 0, 0, -0.3], [0, 0, 0, 1.0]])
    lidar = np.stack([scenes.pose(k, 0.1 * k, 0.05 * k) for k in range(3)])
    poses_text.write_kitti_poses(folder / "poses.txt", camera_T_lidar @ lidar @ np.linalg.inv(camera_T_lidar))
    row = " ".join(f"{v:.12e}" for v in camera_T_lidar[:3].ravel())
    (folder / "calib.txt").write_text(f"P0: 1 0 0 0 0 1 0 0 0 0 1 0\nTr: {row}\n")
    assert np.abs(ArraysLog(folder).poses - lidar).max() < 1e-12
    assert np.abs(ArraysLog(folder, calibration=None).poses[1] - lidar[1]).max() > 0.5
    kitti = (folder / "calib.txt").read_text()
    (folder / "calib.txt").write_text("fx 700\nP0: 1 0 0 0 0 1 0 0 0 0 1 0\n")
    with pytest.warns(CFlowWarning, match="calib.txt has no Tr, so we take the poses for those of the LiDAR"):
        assert np.array_equal(ArraysLog(folder).poses, ArraysLog(folder, calibration=None).poses)
    mount = scenes.pose(1.3, 0.2, 0.4, 1.6)
    for of in ("ego", "sensor"):
        given, plain = (
            ArraysLog(folder, ego_T_lidar=mount, poses_of=of, calibration=one).poses for one in ("auto", None)
        )
        assert np.array_equal(given, plain), "what you say of the poses holds"
    (folder / "calib.txt").write_text(kitti)
    tree = tmp_path / "kitti" / "sequences" / "00"  # dataset/sequences/00/velodyne and dataset/poses/00.txt
    tree.mkdir(parents=True)
    (folder / "points").rename(tree / "velodyne")
    (folder / "calib.txt").rename(tree / "calib.txt")
    (tmp_path / "kitti" / "poses").mkdir()
    (folder / "poses.txt").rename(tmp_path / "kitti" / "poses" / "00.txt")
    assert find_array_logs(tmp_path / "kitti") == [tree]
    assert np.abs(ArraysLog(tree).poses - lidar).max() < 1e-12


def test_points_and_poses_of_a_lidar_are_transformed_to_the_ego_frame(folder):
    ego_T_lidar, plain = scenes.pose(1.3, 0.2, 0.4, 1.6), ArraysLog(folder)
    ego, lidar = (ArraysLog(folder, ego_T_lidar=ego_T_lidar, poses_of=of) for of in ("ego", "lidar"))
    assert np.array_equal(ego.poses, plain.poses) and np.abs(lidar.poses @ ego_T_lidar - plain.poses).max() < 1e-12
    here, there = (np.concatenate([log.sweep(2).points, np.ones((40, 1))], 1) for log in (plain, lidar))
    assert np.abs(here @ plain.poses[2].T - there @ lidar.poses[2].T).max() < 1e-4, "the world stays"
    assert np.abs(here @ ego_T_lidar.T - there).max() < 1e-4


@pytest.mark.parametrize(
    ("file", "content", "settings", "complaint"),
    [
        ("poses.txt", "1 0 0 0 0 1 0 0 0 0 1 0\n", {}, "1 poses for 3 sweeps"),
        ("poses.txt", "1 2 3\n", {}, "numbers per line"),
        ("poses.txt", "2 0 0 0 0 1 0 0 0 0 1 0\n" * 3, {}, "not rigid"),
        ("poses.txt", "0 0 0 0 0 0 0 2\n", {}, "pose 0 is not a rigid motion"),
        ("poses.txt", "0 0 0 0 0 0 0 1\n0 1 0 0 0 0 0 1\n", {}, "ascend"),
        ("times.txt", "1700000000123456789\n" * 3, {}, "ascend"),
        ("poses.npy", np.eye(4), {}, "several"),
        ("poses.npy", np.eye(4), {"poses": "poses.npy"}, "1 poses for 3 sweeps"),
        ("poses.npy", np.eye(3), {"poses": "poses.npy"}, "shape"),
        ("points/a.ply", np.ones((1, 3)), {}, "several kinds of clouds"),
        ("", None, {"poses": "gone.txt"}, "does not exist"),
        ("", None, {"ego_T_lidar": np.ones((4, 4))}, "ego_T_lidar"),
        ("", None, {"poses_of": "camera"}, "poses_of"),
    ],
)
def test_a_log_whose_files_do_not_fit_is_refused(folder, file, content, settings, complaint):
    if isinstance(content, str):
        (folder / file).write_text(content)
    elif file.endswith(".npy"):
        np.save(folder / file, content)
    elif file:
        write_cloud(folder / file, content)
        write_cloud(folder / "points" / "b.ply", content)
    with pytest.raises(CFlowError, match=complaint):
        ArraysLog(folder, **settings)


def test_a_sweep_whose_mask_does_not_fit_is_refused(folder):
    log = ArraysLog(folder)
    for mask in (np.zeros(39, bool), np.zeros(40), np.full(40, 2)):
        np.save(folder / "ground" / "000001.npy", mask)
        with pytest.raises(CFlowError, match=r"000001\.npy"):
            log.sweep(1)
    (folder / "ground" / "000001.npy").unlink()
    with pytest.raises(CFlowError, match="data.ground=null"):
        log.sweep(1)
    assert ArraysLog(folder, ground=None).sweep(1).is_ground is None
    for index in (-1, 3):
        with pytest.raises(CFlowError, match="sweeps 0"):
            log.sweep(index)


def test_clouds_in_a_folder_of_any_name_are_found_next_to_their_poses(tmp_path: Path) -> None:
    scans = tmp_path / "drive" / "ouster_scans"
    scans.mkdir(parents=True)
    for index in range(3):
        np.save(scans / f"{index}.npy", np.ones((4, 3), np.float32))
    np.save(tmp_path / "drive" / "poses.npy", np.tile(np.eye(4), (3, 1, 1)))
    (folder,) = find_array_logs(tmp_path)
    log = ArraysLog(folder)
    assert log.log_id == "drive" and log.poses is not None and len(log) == 3


def test_names_without_order_are_told(tmp_path) -> None:
    """nuPlan's clouds are called as their tokens."""
    for number in range(4):
        np.save(tmp_path / f"{hashlib.sha256(bytes([number])).hexdigest()[:16]}.npy", np.ones((30, 3)))
    with pytest.raises(CFlowError, match="have no order: number them by their times"):
        ArraysLog(tmp_path)


def test_angles_of_points_do_not_make_a_table_of_poses(tmp_path) -> None:
    """Livox Viewer writes x, y, z and their radius, theta and phi."""
    names = "Timestamp,X,Y,Z,Reflectivity,Tag,Ori_radius,Ori_theta,Ori_phi"
    for number in range(3):
        rows = [f"{1700000000000000000 + k + 10**8 * number},{k},{number},1,20,0,9,8,7" for k in range(30)]
        (tmp_path / f"frame_{number}.csv").write_text("\n".join([names, *rows]))
    assert find_array_logs(tmp_path) == [tmp_path]
    assert ArraysLog(tmp_path).sweep(1).points[:, 1].tolist() == [1] * 30
