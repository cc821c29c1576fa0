"""Waymo, version 2: known geometry, variants of files, broken files, a real component."""

from __future__ import annotations

import math
import os
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from scipy.spatial.transform import Rotation
from writers.waymo import write_waymo_segment

from cflow_torch.data.catalog import find_sources
from cflow_torch.data.waymo.range_image import LaserCalibration, range_image_points
from cflow_torch.data.waymo.reader import LIDAR, TIME, TRACK, VEHICLE_POSE, Component, WaymoLog, matrix_of
from cflow_torch.simulator.drive import Drive, make_drive
from cflow_torch.simulator.profiles import PROFILES
from cflow_torch.transforms import rotations_of
from cflow_torch.types import CFlowError


@pytest.fixture(scope="module")
def drive() -> Drive:
    """Two small LiDARs that rotate while the vehicle moves."""
    units = tuple(replace(unit, num_columns=200) for unit in PROFILES["waymo"].units[:2])
    scene = make_drive(seed=1, num_sweeps=4, profile="demo").scene
    return Drive(scene, replace(PROFILES["waymo"], units=units), 1, 4, "123_456_000_476_000")


@pytest.fixture(scope="module")
def written(drive: Drive, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_waymo_segment(drive, tmp_path_factory.mktemp("waymo") / "training").parents[2]


@pytest.fixture
def segment(written: Path, tmp_path: Path) -> Path:
    """A copy of the segment, to be changed."""
    shutil.copytree(written, tmp_path / "copy")
    return next(tmp_path.glob("copy/training/lidar/*.parquet"))


def component(segment: Path, tag: str) -> Path:
    return segment.parent.parent / tag / segment.name


def rewrite(file: Path, change: Any) -> None:
    """Replace the table of a file by `change(table)`."""
    pq.write_table(change(pq.ParquetFile(file).read()), file)


def with_column(table: pa.Table, name: str, values: Any) -> pa.Table:
    return table.set_column(table.column_names.index(name), name, values)


def test_rows_columns_and_angles_are_those_of_the_format() -> None:
    """A laser without a table of inclinations; columns go from behind the vehicle via its left."""
    even = LaserCalibration(np.eye(4), None, math.radians(-90), math.radians(30))
    np.testing.assert_allclose(np.degrees(even.row_inclinations(4)), [15, -15, -45, -75], atol=1e-12)
    np.testing.assert_allclose(np.degrees(even.column_azimuths(4)), [135, 45, -45, -135], atol=1e-12)
    angles = np.array([[0.1, -0.2, 3.0], [-3.0, 1.5, -0.7]])
    expected = Rotation.from_euler("ZYX", angles[:, ::-1]).as_matrix()
    np.testing.assert_allclose(rotations_of(angles.T), expected, atol=1e-15)


def test_world_coordinates_of_kilometres_keep_millimetres() -> None:
    """In float32, world coordinates would have steps of 1 mm."""
    image, poses, T = np.full((2, 4, 4), 30.0), np.zeros((2, 4, 6), np.float32), np.eye(4)
    poses[..., 3:] = T[:3, 3] = 11_000, -9_000, 50
    laser = LaserCalibration(np.eye(4), None, -0.3, 0.1)
    (plain, _), (far, _) = range_image_points(image, laser, T), range_image_points(image, laser, T, poses)
    assert np.abs(far - plain).max() < 1e-9 and len(far) == 8


def test_second_returns_zones_and_lasers_can_be_chosen(drive: Drive, segment: Path) -> None:
    points, units = WaymoLog(segment).sweep(1).points, drive.units(1)
    top, second = len(WaymoLog(segment, lasers=("TOP",)).sweep(1).points), units[1].name

    def change(table: pa.Table) -> pa.Table:
        images = [np.array(v, np.float32).reshape(-1, 4) for v in table[f"{LIDAR}1.values"].to_pylist()]
        seconds = [np.where((image[:, :1] > 0) & (np.arange(4) == 0), image + 1, -1) for image in images]
        for image in images:
            image[image[:, 0] > 40, 3] = 1
        for number, of_return in ((1, images), (2, seconds)):
            flat = pa.array([image.reshape(-1) for image in of_return], pa.list_(pa.float32()))
            table = with_column(table, f"{LIDAR}{number}.values", flat)
        return table

    rewrite(segment, change)
    log, both = WaymoLog(segment), WaymoLog(segment, both_returns=True).sweep(1).points
    assert np.array_equal(log.sweep(1).points, points)
    parts = zip((points[:top], points[top:]), units)
    ranges = np.concatenate([np.linalg.norm(part - unit.T_ego_sensor[:3, 3], axis=1) for part, unit in parts])
    sure = np.abs(ranges - 40) > 2  # the vehicle moves while TOP rotates, so ranges differ a little
    assert np.array_equal(log.labels(1).is_valid[sure], ranges[sure] < 40)
    assert len(both) == 2 * len(points) and np.array_equal(both[:top], points[:top])
    apart = np.linalg.norm(both[top : 2 * top].astype(float) - points[:top], axis=1)  # further along the ray
    np.testing.assert_allclose(apart, 1, atol=1e-4)
    assert np.array_equal(WaymoLog(segment, lasers=(second,)).sweep(1).points, points[top:])
    for lasers in ((), ("ROOF",), ("REAR",)):
        with pytest.raises(CFlowError, match="lasers"):
            WaymoLog(segment, lasers=lasers)


def test_order_and_optional_parts_do_not_matter(segment: Path) -> None:
    """Unsorted rows in one row group, an extra column, boxes of unknown type."""
    before = WaymoLog(segment)
    sweep, labels = before.sweep(1), before.labels(1)

    def shuffled(table: pa.Table) -> pa.Table:
        order = np.random.default_rng(0).permutation(table.num_rows)
        if TRACK in table.column_names:  # the order of a frame's boxes decides which of two overlapping boxes counts
            order = np.argsort(-table[TIME].to_numpy(), kind="stable")
        return table.take(pa.array(order)).append_column("index", pa.array([f"row-{i}" for i in order]))

    for tag in ("lidar", "lidar_pose", "vehicle_pose", "lidar_box", "lidar_calibration"):
        rewrite(component(segment, tag), shuffled)
    log = WaymoLog(segment)
    assert np.array_equal(log.sweep(1).points, sweep.points) and np.array_equal(log.labels(1).flow, labels.flow)
    rewrite(component(segment, "lidar_box"), filled("[LiDARBoxComponent].type", 0, pa.int8()))
    labels = WaymoLog(segment).labels(0)
    assert labels.is_valid.all() and not labels.category.any()  # such boxes are background
    component(segment, "lidar_box").unlink()
    assert WaymoLog(segment).labels(0) is None  # the testing split has none


def filled(column: Any, value: Any, kind: Any = None) -> Any:
    """Return a change that sets a column, by name or index, to one value."""

    def change(table: pa.Table) -> pa.Table:
        name = table.column_names[column] if isinstance(column, int) else column
        return with_column(table, name, pa.array([value] * table.num_rows, kind))

    return change


@pytest.mark.parametrize(
    ("tag", "change", "message"),
    [
        ("lidar_pose", lambda t: t.select([0]), "lacks the columns"),
        ("lidar", lambda t: t.slice(0, 2), "1 sweeps"),
        ("lidar", lambda t: t.slice(0, t.num_rows - 1), "no row for frame"),
        ("vehicle_pose", lambda t: t.slice(0, 3), "no row with key.frame_timestamp_micros"),
        ("lidar_calibration", lambda t: t.slice(0, 1), "no row with key.laser_name 2"),
        ("lidar_box", filled("key.laser_object_id", "a"), "only one box per sweep"),
        ("lidar_box", filled("[LiDARBoxComponent].box.size.x", None, pa.float64()), "not finite"),
        ("vehicle_pose", filled(2, [2.0] * 16), "not rigid"),
        ("lidar", filled(4, [2, 2, 4]), "cannot reshape"),
        ("lidar_pose", filled(4, [7, 60, 9]), "a range image must be"),
    ],
)  # fmt: skip
def test_an_inconsistent_component_is_refused(segment: Path, tag: str, change: Any, message: str) -> None:
    rewrite(component(segment, tag), change)
    with pytest.raises(CFlowError, match=message) as error:
        log = WaymoLog(segment)
        log.labels(2)
        log.sweep(3)
    assert f"{tag}{os.sep}{segment.name}" in str(error.value)


def test_a_real_component_is_read(data_root: Path, tmp_path: Path) -> None:
    """Its transforms are float32."""
    files = list((data_root / "real-files" / "waymo").glob("vehicle_pose_*.parquet"))
    if not files:
        pytest.skip(f"no real component in {data_root}/real-files/waymo")
    name = files[0].name.replace("vehicle_pose_", "")
    (tmp_path / "vehicle_pose").mkdir()
    (tmp_path / "vehicle_pose" / name).write_bytes(files[0].read_bytes())
    rows = Component(tmp_path / "lidar" / name, "vehicle_pose").rows((TIME, VEHICLE_POSE))
    poses = [matrix_of(values, "pose") for _, values in rows]
    assert poses and all(abs(np.linalg.det(pose[:3, :3]) - 1) < 1e-5 for pose in poses)
    assert all(1.4e15 < time < 1.7e15 for time, _ in rows)


def test_real_frames_of_version_1_are_refused(data_root: Path) -> None:
    file = data_root / "real-files" / "waymo" / "val.tfrecord"
    if not file.is_file():
        pytest.skip(f"no frame of version 1 at {file}")
    for place in (file, file.parent):
        with pytest.raises(CFlowError, match="version 1.*download the parquet files"):
            find_sources("waymo", place)
