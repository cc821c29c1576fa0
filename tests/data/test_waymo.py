"""Waymo, version 2: geometry by hand, round trips of a small recording, broken files, a real component."""

from __future__ import annotations

import math
import os
from pathlib import Path
from typing import Any, Sequence

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from scipy.spatial.transform import Rotation

from cflow_torch.data.boxes import Boxes as Tracks
from cflow_torch.data.boxes import flow_from_boxes
from cflow_torch.data.categories import CATEGORY_INDEX
from cflow_torch.data.log import FlowLabels, window
from cflow_torch.data.rigid_motion import transform_points
from cflow_torch.data.waymo.parquet import LIDAR, TIME, VEHICLE_POSE, Component, matrix_of
from cflow_torch.data.waymo.range_image import LaserCalibration, rotations_from_angles
from cflow_torch.data.waymo.reader import BOX_CATEGORY, WaymoLog, find_waymo_segments
from cflow_torch.simulator.recording import Boxes, UnitReturns
from cflow_torch.simulator.writers.waymo import BOX_TYPE, write_waymo_segment
from cflow_torch.types import CFlowError, Sweep

START = 1_550_083_467_346_370_000
TICK = 100_000_000


def transform(roll=0.0, pitch=0.0, yaw=0.0, x=0.0, y=0.0, z=0.0) -> np.ndarray:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = Rotation.from_euler("ZYX", [yaw, pitch, roll]).as_matrix(), (x, y, z)
    return T


class GridRecording:
    """Four sweeps of a laser that turns while the car drives a bend, and of one without motion; random ranges.

    Shots are listed row by row of the range image, the highest first: the order in which the reader gives them.
    """

    def __init__(self, origin: Sequence[float] = (700.0, -600.0, 30.0), log_id: str = "123_456_000_476_000") -> None:
        self.log_id, self.origin = log_id, origin
        self.timestamps = tuple(START + i * TICK for i in range(4))
        self.poses = np.stack([self.ego(0.1 * i) for i in range(4)])
        self.table = {"TOP": np.radians([-17.0, -9.5, -4.0, -1.7, -0.3, 0.6, 2.4])}
        self.table["SIDE_LEFT"] = np.radians(np.linspace(-85.0, 25.0, 12))
        self.mount = {
            "TOP": transform(0.01, -0.02, 2.5, 1.43, 0.0, 2.18),
            "SIDE_LEFT": transform(yaw=1.6, x=3, y=1, z=1),
        }
        self.width = {"TOP": 90, "SIDE_LEFT": 60}

    def ego(self, seconds: float) -> np.ndarray:
        x, y, z = self.origin
        return transform(0.01 * seconds, 0.02, 1.0 + 0.3 * seconds, x + 12 * seconds, y + 4 * seconds**2, z)

    def elevations(self, unit: str) -> np.ndarray:
        return self.table[unit]

    def units(self, index: int) -> list[UnitReturns]:
        units = []
        for number, name in enumerate(self.table):
            rng = np.random.default_rng([index, number])
            height, width, E = len(self.table[name]), self.width[name], self.mount[name]
            kept = np.sort(rng.choice(height * width, height * width * 3 // 4, replace=False))
            ring, column = height - 1 - kept // width, kept % width
            azimuth = math.pi - 2 * math.pi * (column + 0.5) / width - math.atan2(E[1, 0], E[0, 0])
            flat = np.cos(self.table[name][ring])
            rays = np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(self.table[name][ring])], -1)
            points = rng.uniform(1, 75, (len(kept), 1)) * rays
            offset = (column - width // 2) * (TICK // width)
            if name == "TOP":
                seen_from = np.stack([self.ego(0.1 * index + 1e-9 * o) for o in offset])
                to_frame = np.linalg.inv(self.poses[index] @ E) @ seen_from @ E
                points = np.einsum("nij,nj->ni", to_frame[:, :3, :3], points) + to_frame[:, :3, 3]
            other = (rng.integers(0, 256, len(kept)).astype(np.uint8), np.zeros(len(kept), np.float32), height, width)
            ring, column = ring.astype(np.int32), column.astype(np.int32)
            units.append(UnitReturns(name, E, points.astype(np.float32), ring, column, offset, *other))
        return units

    def boxes(self, index: int) -> Boxes:
        """A car and a bicycle all the time, a pedestrian at first only."""
        poses = [transform(yaw=3.1 + 0.05 * index, x=20 + 2 * index, y=3, z=1), transform(yaw=1, x=-15, y=index, z=1)]
        names, sizes = ["REGULAR_VEHICLE", "BICYCLIST"], [[30.0, 20, 4], [20.0, 10, 4]]
        if index == 0:
            names, sizes, poses = [*names, "PEDESTRIAN"], [*sizes, [9.0, 9, 9]], [*poses, transform(y=-20)]
        tracks = tuple(f"track-{name}" for name in names)
        return Boxes(tracks, tuple(names), np.array(sizes), np.stack(poses), np.full(len(names), 5))

    def sweep(self, index: int) -> Sweep:
        points = np.concatenate([transform_points(unit.points, unit.T_ego_sensor) for unit in self.units(index)])
        return Sweep(points.astype(np.float32), None, self.poses[index], self.timestamps[index])

    def labels(self, index: int) -> FlowLabels:
        return labels_of(self, index, self.sweep(index).points)


def labels_of(log: Any, index: int, points: np.ndarray) -> FlowLabels:
    """Truth of given points by a recording's own boxes, with the categories that the format keeps."""
    tracks = []
    for boxes in (log.boxes(index), log.boxes(index + 1)):
        category = [CATEGORY_INDEX[BOX_CATEGORY[BOX_TYPE[name]]] for name in boxes.category]
        tracks.append(Tracks(boxes.track_id, np.array(category, np.uint8), boxes.size, boxes.pose))
    return flow_from_boxes(points, *tracks, np.linalg.inv(log.poses[index + 1]) @ log.poses[index])


@pytest.fixture
def recording() -> GridRecording:
    return GridRecording()


@pytest.fixture
def segment(recording: GridRecording, tmp_path: Path) -> Path:
    return write_waymo_segment(recording, tmp_path / "training")


def component(segment: Path, tag: str) -> Path:
    return segment.parent.parent / tag / segment.name


def rewrite(file: Path, change: Any) -> None:
    """Passes the table of a file through `change`."""
    pq.write_table(change(pq.ParquetFile(file).read()), file)


def with_column(table: pa.Table, name: str, values: Any) -> pa.Table:
    return table.set_column(table.column_names.index(name), name, values)


def test_rows_columns_and_angles_by_hand() -> None:
    """Of a laser without a table of inclinations; the columns go round from behind the vehicle by its left."""
    even = LaserCalibration(np.eye(4), None, math.radians(-90), math.radians(30))
    np.testing.assert_allclose(np.degrees(even.row_inclinations(4)), [15, -15, -45, -75], atol=1e-12)
    np.testing.assert_allclose(np.degrees(even.column_azimuths(4)), [135, 45, -45, -135], atol=1e-12)
    angles = np.array([[0.1, -0.2, 3.0], [-3.0, 1.5, -0.7]])
    np.testing.assert_allclose(rotations_from_angles(angles), [transform(*a)[:3, :3] for a in angles], atol=1e-15)


@pytest.mark.parametrize("origin", [(700.0, -600.0, 30.0), (11_000.0, -9_000.0, 50.0)])
def test_a_recording_comes_back(origin: Sequence[float], tmp_path: Path) -> None:
    """Waymo's world coordinates are about 10 km; float32 has steps of 1 mm there, and pixel poses are float32."""
    recording = GridRecording(origin)
    log = WaymoLog(write_waymo_segment(recording, tmp_path))
    assert (log.log_id, tuple(log.timestamps), len(log)) == (recording.log_id, recording.timestamps, 4)
    for index in range(4):
        sweep, true = log.sweep(index), recording.sweep(index)
        assert sweep.points.dtype == np.float32 and sweep.is_ground is None
        top = len(recording.units(index)[0].points)
        assert np.abs(sweep.points[:top] - true.points[:top]).max() < (5e-5 if abs(origin[0]) < 1000 else 1e-3)
        assert np.abs(sweep.points[top:] - true.points[top:]).max() < 1.2e-5  # no pixel poses: ranges and points
        assert np.array_equal(sweep.pose, true.pose) and sweep.timestamp_ns == true.timestamp_ns
    for index in range(3):
        labels, true = log.labels(index), labels_of(recording, index, log.sweep(index).points)
        assert np.array_equal(labels.category, true.category) and np.array_equal(labels.is_valid, true.is_valid)
        assert np.abs(labels.flow - true.flow).max() < 1e-6
        assert {0, CATEGORY_INDEX["REGULAR_VEHICLE"], CATEGORY_INDEX["BICYCLIST"]} <= set(labels.category.tolist())
    assert not log.labels(0).is_valid.all() and log.labels(1).is_valid.all()  # the pedestrian's track ends
    assert log.labels(3) is None and len(window(log, 2, num_history=2).pch) == 2


def test_second_returns_zones_and_lasers(recording: GridRecording, segment: Path) -> None:
    points, top = WaymoLog(segment).sweep(1).points, len(recording.units(1)[0].points)

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
    ranges = np.concatenate([np.linalg.norm(unit.points, axis=1) for unit in recording.units(1)])
    sure = np.abs(ranges - 40) > 2  # the car moves while TOP turns: its ranges differ a little from those at the frame
    assert np.array_equal(log.labels(1).is_valid[sure], ranges[sure] < 40)
    assert len(both) == 2 * len(points) and np.array_equal(both[:top], points[:top])
    apart = np.linalg.norm(both[top : 2 * top].astype(float) - points[:top], axis=1)  # further along the ray
    np.testing.assert_allclose(apart, 1, atol=1e-4)
    assert np.array_equal(WaymoLog(segment, lasers=("SIDE_LEFT",)).sweep(1).points, points[top:])
    for lasers in ((), ("ROOF",), ("REAR",)):
        with pytest.raises(CFlowError, match="lasers"):
            WaymoLog(segment, lasers=lasers)


def test_what_released_files_vary_in(recording: GridRecording, segment: Path) -> None:
    """Unsorted rows in one row group, an extra column, boxes of unknown type."""
    before = WaymoLog(segment)
    sweep, labels = before.sweep(1), before.labels(1)

    def shuffled(table: pa.Table) -> pa.Table:
        order = np.random.default_rng(0).permutation(table.num_rows)
        return table.take(pa.array(order)).append_column("index", pa.array([f"row-{i}" for i in order]))

    for tag in ("lidar", "lidar_pose", "vehicle_pose", "lidar_box", "lidar_calibration"):
        rewrite(component(segment, tag), shuffled)
    log = WaymoLog(segment)
    assert np.array_equal(log.sweep(1).points, sweep.points) and np.array_equal(log.labels(1).flow, labels.flow)
    rewrite(component(segment, "lidar_box"), filled("[LiDARBoxComponent].type", 0, pa.int8()))
    labels = WaymoLog(segment).labels(0)
    assert labels.is_valid.all() and not labels.category.any()  # such boxes are background


@pytest.mark.parametrize("tag", ["lidar", "lidar_calibration", "lidar_pose", "vehicle_pose", "lidar_box"])
def test_damaged_component(segment: Path, tag: str) -> None:
    file, opened = component(segment, tag), WaymoLog(segment)
    whole = file.read_bytes()
    for damage, message in (
        (lambda: file.write_bytes(whole[: len(whole) // 2]), "cannot read .*truncated"),
        (lambda: file.write_bytes(b""), "cannot read"),
        (lambda: pq.write_table(pa.table({"a": [1]}), file), "lacks the columns"),
        (file.unlink, f"is missing; download component {tag}"),
    ):
        damage()
        if tag == "lidar_box" and not file.exists():
            assert WaymoLog(segment).labels(0) is None  # the testing split has none
            continue
        with pytest.raises(CFlowError, match=message) as error:
            WaymoLog(segment).labels(0)
        assert f"{tag}{os.sep}{segment.name}" in str(error.value)
        if tag == "lidar_pose":  # sweeps are read when they are asked for
            with pytest.raises(CFlowError, match=message):
                opened.sweep(1)
        file.write_bytes(whole)


def filled(column: Any, value: Any, kind: Any = None) -> Any:
    """A change that gives a column, by name or number, the same value in every row."""

    def change(table: pa.Table) -> pa.Table:
        name = table.column_names[column] if isinstance(column, int) else column
        return with_column(table, name, pa.array([value] * table.num_rows, kind))

    return change


@pytest.mark.parametrize(
    ("tag", "change", "message"),
    [
        ("lidar", lambda t: t.slice(0, 2), "1 sweeps"),
        ("lidar", lambda t: t.slice(0, t.num_rows - 1), "no row for frame"),
        ("vehicle_pose", lambda t: t.slice(0, 3), "no pose for frame"),
        ("lidar_calibration", lambda t: t.slice(0, 1), r"lasers \[3\] are missing"),
        ("lidar_box", filled("[LiDARBoxComponent].type", 9), "categories .* unknown"),
        ("lidar_box", filled("key.laser_object_id", "a"), "only one box per sweep"),
        ("lidar_box", filled("[LiDARBoxComponent].box.size.x", None, pa.float64()), "not finite"),
        ("vehicle_pose", filled(2, [2.0] * 16), "not rigid"),
        ("lidar", filled(4, [2, 2, 4]), "cannot reshape"),
        ("lidar_pose", filled(4, [7, 60, 9]), "a range image must be"),
    ],
)  # fmt: skip
def test_contradictory_component(segment: Path, tag: str, change: Any, message: str) -> None:
    rewrite(component(segment, tag), change)
    with pytest.raises(CFlowError, match=message) as error:
        log = WaymoLog(segment)
        log.labels(2)
        log.sweep(3)
    assert f"{tag}{os.sep}{segment.name}" in str(error.value)


def test_a_real_component(data_root: Path, tmp_path: Path) -> None:
    """Its transforms are float32, which only the official classes' test data are."""
    files = list((data_root / "real-files" / "waymo").glob("vehicle_pose_*.parquet"))
    if not files:
        pytest.skip(f"no real component in {data_root}/real-files/waymo")
    name = files[0].name.replace("vehicle_pose_", "")
    (tmp_path / "vehicle_pose").mkdir()
    (tmp_path / "vehicle_pose" / name).write_bytes(files[0].read_bytes())
    rows = Component(tmp_path / "lidar" / name, "vehicle_pose").rows((TIME, VEHICLE_POSE))
    poses = [matrix_of(row[VEHICLE_POSE], "pose") for row in rows]
    assert poses and all(abs(np.linalg.det(pose[:3, :3]) - 1) < 1e-5 for pose in poses)
    assert all(1.4e15 < row[TIME] < 1.7e15 for row in rows)


def test_real_frames_of_version_1_are_refused(data_root: Path) -> None:
    file = data_root / "real-files" / "waymo" / "val.tfrecord"
    if not file.is_file():
        pytest.skip(f"no frame of version 1 at {file}")
    for place in (file, file.parent):
        with pytest.raises(CFlowError, match="version 1.*download the parquet files"):
            find_waymo_segments(place)
