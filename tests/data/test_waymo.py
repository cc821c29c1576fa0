"""Waymo, versions 2 and 1: geometry by hand, round trips of a small recording and a simulated drive, broken files."""

from __future__ import annotations

import math
import os
import struct
import zlib
from pathlib import Path
from typing import Any, Dict, List, Sequence

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from cflow_torch.data.boxes import Boxes as Tracks
from cflow_torch.data.boxes import flow_from_boxes
from cflow_torch.data.log import FlowLabels, window
from cflow_torch.data.waymo.range_image import LaserCalibration, range_image_points, rotations_from_angles
from cflow_torch.data.waymo.reader import BOX_CATEGORY, WaymoLog, find_waymo_segments
from cflow_torch.data.waymo.tfrecord import WaymoRecordLog
from cflow_torch.data.categories import CATEGORY_INDEX
from cflow_torch.simulator import make_drive
from cflow_torch.simulator.recording import UnitReturns
from cflow_torch.simulator.writers import waymo as waymo_writer
from cflow_torch.simulator.writers.av2 import Boxes
from cflow_torch.simulator.writers.waymo import BOX_TYPE, write_waymo_segment
from cflow_torch.types import CFlowError, Sweep

START = 1_550_083_467_346_370_000
TICK = 100_000_000


def transform(roll=0.0, pitch=0.0, yaw=0.0, x=0.0, y=0.0, z=0.0) -> np.ndarray:
    T = np.eye(4)
    cx, cy, cz, sx, sy, sz = (f(a) for f in (math.cos, math.sin) for a in (roll, pitch, yaw))
    Rx, Ry = np.array([[1, 0, 0], [0, cx, -sx], [0, sx, cx]]), np.array([[cy, 0, sy], [0, 1, 0], [-sy, 0, cy]])
    T[:3, :3] = np.array([[cz, -sz, 0], [sz, cz, 0], [0, 0, 1]]) @ Ry @ Rx
    T[:3, 3] = x, y, z
    return T


def moved(T: np.ndarray, points: np.ndarray) -> np.ndarray:
    return points @ T[:3, :3].T + T[:3, 3]


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

    def units(self, index: int) -> List[UnitReturns]:
        units = []
        for number, name in enumerate(self.table):
            rng = np.random.default_rng([index, number])
            height, width, E = len(self.table[name]), self.width[name], self.mount[name]
            ring, column = (
                a.reshape(-1) for a in np.meshgrid(np.arange(height)[::-1], np.arange(width), indexing="ij")
            )
            kept = np.sort(rng.choice(height * width, height * width * 3 // 4, replace=False))
            ring, column = ring[kept], column[kept]
            azimuth = math.pi - 2 * math.pi * (column + 0.5) / width - math.atan2(E[1, 0], E[0, 0])
            flat = np.cos(self.table[name][ring])
            rays = np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(self.table[name][ring])], -1)
            points = rng.uniform(1, 75, (len(kept), 1)) * rays
            offset = (column - width // 2) * (TICK // width)
            if name == "TOP":
                seen_from = np.stack([self.ego(0.1 * index + 1e-9 * o) for o in offset])
                to_frame = np.linalg.inv(self.poses[index] @ E) @ seen_from @ E
                points = np.einsum("nij,nj->ni", to_frame[:, :3, :3], points) + to_frame[:, :3, 3]
            units.append(
                UnitReturns(
                    name,
                    E,
                    points.astype(np.float32),
                    ring.astype(np.int32),
                    column.astype(np.int32),
                    offset,
                    rng.integers(0, 256, len(kept)).astype(np.uint8),
                    np.zeros(len(kept), np.float32),
                    height,
                    width,
                )  # fmt: skip
            )
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
        points = np.concatenate([moved(unit.T_ego_sensor, unit.points.astype(float)) for unit in self.units(index)])
        return Sweep(points.astype(np.float32), None, self.poses[index], self.timestamps[index])

    def labels(self, index: int) -> FlowLabels:
        return labels_of(self, index, self.sweep(index).points)


def upright(poses: np.ndarray) -> np.ndarray:
    """Box poses that keep heading only, as the format does."""
    kept = [transform(yaw=math.atan2(pose[1, 0], pose[0, 0])) for pose in poses]
    for flat, pose in zip(kept, poses):
        flat[:3, 3] = pose[:3, 3]
    return np.reshape(kept, (-1, 4, 4))


def labels_of(log: Any, index: int, points: np.ndarray) -> FlowLabels:
    """Truth of given points by a recording's own boxes, as far as the format keeps them."""
    tracks = []
    for boxes in (log.boxes(index), log.boxes(index + 1)):
        category = [BOX_CATEGORY[BOX_TYPE[name]] for name in boxes.category]
        poses = upright(boxes.pose)
        tracks.append(Tracks(boxes.track_id, np.array(category, np.uint8), boxes.size, poses))
    T_ego1_ego0 = np.linalg.inv(log.poses[index + 1]) @ log.poses[index]
    return flow_from_boxes(points, tracks[0], tracks[1], T_ego1_ego0)


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


# ---------------------------------------------------------------------------------------------- geometry


def test_pixels_by_hand() -> None:
    """Four columns look to 135, 45, -45 and -135 degrees of the vehicle, whatever the laser's yaw; row 0 is above."""
    calibration = LaserCalibration(transform(yaw=math.pi / 2, x=1, y=2, z=3), np.array([0.0, math.pi / 6]))
    image = np.full((2, 4, 4), -1.0, np.float32)
    image[0, 1, 0], image[1, 3, 0], image[1, 0, 0] = 2.0, 4.0, 0.0
    points, pixels = range_image_points(image, calibration)
    assert pixels.tolist() == [1, 7]  # range 0 is no return either
    half = math.sqrt(0.5)
    expected = [[1 + math.sqrt(3) * half, 2 + math.sqrt(3) * half, 4], [1 - 4 * half, 2 - 4 * half, 3]]
    np.testing.assert_allclose(points, expected, atol=1e-14)
    assert points.dtype == np.float64


def test_even_beams_by_hand() -> None:
    calibration = LaserCalibration(np.eye(4), None, math.radians(-90), math.radians(30))
    np.testing.assert_allclose(np.degrees(calibration.row_inclinations(4)), [15, -15, -45, -75], atol=1e-12)
    np.testing.assert_allclose(np.degrees(calibration.column_azimuths(4)), [135, 45, -45, -135], atol=1e-12)


def test_pixel_pose_by_hand() -> None:
    """Rolled by 90 degrees (y to z), then turned by 90 (x to y): x to y, y to z, z to x."""
    calibration = LaserCalibration(np.eye(4), np.array([0.0, 0.1]))
    image = np.full((2, 4, 4), -1.0, np.float32)
    image[1, 2] = (math.sqrt(2), 0, 0, -1)  # the point (1, -1, 0)
    poses = np.zeros((2, 4, 6), np.float32)
    poses[1, 2] = (math.pi / 2, 0, math.pi / 2, 100, 0, 0)
    points, _ = range_image_points(image, calibration, poses, transform(yaw=math.pi, x=90))
    # In the world (100 + 0, 1, -1); the frame stands at x = 90 and looks back.
    np.testing.assert_allclose(points, [[-10, -1, -1]], atol=1e-6)
    angles = np.array([[0.1, -0.2, 3.0], [-3.0, 1.5, -0.7]])
    np.testing.assert_allclose(rotations_from_angles(angles), [transform(*a)[:3, :3] for a in angles], atol=1e-15)


def test_shapes_that_do_not_fit() -> None:
    calibration = LaserCalibration(np.eye(4), np.zeros(3))
    with pytest.raises(CFlowError, match="2 rows needs 2"):
        range_image_points(np.ones((2, 4, 4)), calibration)
    with pytest.raises(CFlowError, match="shape"):
        range_image_points(np.ones((3, 4)), calibration)
    with pytest.raises(CFlowError, match="pixel poses"):
        range_image_points(np.ones((3, 4, 4)), calibration, np.ones((3, 4, 4)), np.eye(4))


# ---------------------------------------------------------------------------------------------- round trips


@pytest.mark.parametrize("reader", ["parquet", "tfrecord"])
def test_a_recording_comes_back(recording: GridRecording, segment: Path, tmp_path: Path, reader: str) -> None:
    log = WaymoLog(segment)
    if reader == "tfrecord":
        log = WaymoRecordLog(write_tfrecord(segment, tmp_path / f"{recording.log_id}.tfrecord"))
    assert (log.log_id, tuple(log.timestamps), len(log)) == (recording.log_id, recording.timestamps, 4)
    for index in range(4):
        sweep, true = log.sweep(index), recording.sweep(index)
        assert sweep.points.dtype == np.float32 and sweep.is_ground is None
        # TOP's poses are float32: steps of 6e-5 m at 700 m, 2e-7 rad at 75 m. The other laser: ranges and points.
        top = len(recording.units(index)[0].points)
        assert np.abs(sweep.points[:top] - true.points[:top]).max() < 5e-5
        assert np.abs(sweep.points[top:] - true.points[top:]).max() < 1.2e-5
        assert np.array_equal(sweep.pose, true.pose) and sweep.pose.dtype == np.float64
        assert sweep.timestamp_ns == true.timestamp_ns
    for index in range(3):
        labels, true = log.labels(index), labels_of(recording, index, log.sweep(index).points)
        assert np.array_equal(labels.category, true.category) and np.array_equal(labels.is_valid, true.is_valid)
        assert np.abs(labels.flow - true.flow).max() < 1e-6
        assert {0, CATEGORY_INDEX["REGULAR_VEHICLE"], CATEGORY_INDEX["BICYCLIST"]} <= set(labels.category.tolist())
        exact = recording.labels(index)
        assert np.abs(labels.flow - exact.flow).max() < 1e-4 and np.array_equal(labels.category, exact.category)
    assert not log.labels(0).is_valid.all() and log.labels(1).is_valid.all()  # the pedestrian's track ends
    assert log.labels(3) is None
    assert len(window(log, 2, num_history=2).pch) == 2


def test_far_from_the_origin_points_are_good_to_a_millimetre(tmp_path: Path) -> None:
    """Waymo's world coordinates are about 10 km; float32 has steps of 1 mm there, and pixel poses are float32."""
    recording = GridRecording(origin=(11_000.0, -9_000.0, 50.0))
    log = WaymoLog(write_waymo_segment(recording, tmp_path))
    assert np.abs(log.sweep(1).points - recording.sweep(1).points).max() < 1e-3


def nearest(tree_points: np.ndarray, points: np.ndarray) -> np.ndarray:
    from scipy.spatial import cKDTree

    distance, row = cKDTree(tree_points).query(points)
    assert len(np.unique(row)) == len(tree_points) == len(points)
    assert distance.max() < 1e-4
    return row


def test_a_simulated_drive_comes_back(tmp_path: Path) -> None:
    drive = make_drive(seed=4, num_sweeps=3, profile="waymo")
    log = WaymoLog(write_waymo_segment(drive, tmp_path))
    for index in range(3):
        sweep, true = log.sweep(index), drive.sweep(index)
        nearest(true.points, sweep.points)
        assert np.array_equal(sweep.pose, true.pose) and sweep.timestamp_ns == true.timestamp_ns
    row, labels = nearest(drive.sweep(1).points, log.sweep(1).points), log.labels(1)
    # The same boxes, without their roll and pitch, give the same truth but for points within 0.1 mm of a face.
    from_boxes = labels_of(drive, 1, drive.sweep(1).points)
    same = labels.category == from_boxes.category[row]
    assert same.mean() > 0.9999
    assert np.abs(labels.flow - from_boxes.flow[row])[same].max() < 1e-4
    assert (labels.is_valid == from_boxes.is_valid[row])[same].all()
    # Ground below a box, and objects seen before or after the time stamp, have another truth in the world.
    close = np.abs(labels.flow - drive.labels(1).flow[row]).max(1) < 0.02
    assert close.mean() > 0.97


# ---------------------------------------------------------------------------------------------- variants of files


def test_second_returns_zones_and_lasers(recording: GridRecording, segment: Path) -> None:
    first = WaymoLog(segment)

    def change(table: pa.Table) -> pa.Table:
        column = "[LiDARComponent].range_image_return"
        images = [
            np.array(v, np.float32).reshape(s)
            for v, s in zip(*(table[f"{column}1.{n}"].to_pylist() for n in ("values", "shape")))
        ]
        seconds = [np.where((image[..., :1] > 0) & (np.arange(4) == 0), image + 1, -1) for image in images]
        for image in images:
            image[image[..., 0] > 40, 3] = 1
        flat = pa.array([image.reshape(-1) for image in images], pa.list_(pa.float32()))
        table = with_column(table, f"{column}1.values", flat)
        flat = pa.array([image.reshape(-1) for image in seconds], pa.list_(pa.float32()))
        return with_column(table, f"{column}2.values", flat)

    rewrite(segment, change)
    log, both = WaymoLog(segment), WaymoLog(segment, both_returns=True)
    points = log.sweep(1).points
    assert np.array_equal(points, first.sweep(1).points)
    ranges = np.concatenate([np.linalg.norm(unit.points, axis=1) for unit in recording.units(1)])
    sure = np.abs(ranges - 40) > 2  # the car moves while TOP turns: its ranges differ a little from those at the frame
    assert np.array_equal(log.labels(1).is_valid[sure], ranges[sure] < 40)
    top = len(recording.units(1)[0].points)
    all_points = both.sweep(1).points
    assert len(all_points) == 2 * len(points)
    np.testing.assert_array_equal(all_points[:top], points[:top])
    # A metre further along the ray.
    apart = np.linalg.norm(all_points[top : 2 * top].astype(float) - points[:top], axis=1)
    np.testing.assert_allclose(apart, 1, atol=1e-4)
    assert np.array_equal(WaymoLog(segment, lasers=("SIDE_LEFT",)).sweep(1).points, points[top:])
    for lasers in ((), ("ROOF",), ("REAR",)):
        with pytest.raises(CFlowError, match="lasers"):
            WaymoLog(segment, lasers=lasers)


def test_what_released_files_vary_in(segment: Path) -> None:
    """float32 transforms, unsorted rows in one row group, an extra column, null inclinations, null speeds."""
    before = WaymoLog(segment)
    sweep, labels = before.sweep(1), before.labels(1)

    def shuffled(table: pa.Table) -> pa.Table:
        order = np.random.default_rng(0).permutation(table.num_rows)
        return table.take(pa.array(order)).append_column("index", pa.array([f"row-{i}" for i in order]))

    for tag in ("lidar", "lidar_pose", "vehicle_pose", "lidar_box", "lidar_calibration"):
        rewrite(component(segment, tag), shuffled)
    log = WaymoLog(segment)
    assert np.array_equal(log.sweep(1).points, sweep.points) and np.array_equal(log.labels(1).flow, labels.flow)
    name = "[VehiclePoseComponent].world_from_vehicle.transform"
    narrow = pa.list_(pa.float32())
    rewrite(
        component(segment, "vehicle_pose"),
        lambda table: with_column(table, name, pa.array(table[name].to_pylist(), narrow)),
    )
    narrow_pose = WaymoLog(segment).sweep(1).pose
    assert narrow_pose.dtype == np.float64 and 0 < np.abs(narrow_pose - sweep.pose).max() < 1e-4
    calibration = pq.ParquetFile(component(segment, "lidar_calibration")).read().to_pylist()
    values = {row["key.laser_name"]: row["[LiDARCalibrationComponent].beam_inclination.values"] for row in calibration}
    assert values[3] is None and len(values[1]) == 7
    boxes = pq.ParquetFile(component(segment, "lidar_box")).read()
    assert boxes["[LiDARBoxComponent].acceleration.x"].null_count == boxes.num_rows


def test_a_segment_without_boxes_has_no_truth(segment: Path) -> None:
    rewrite(component(segment, "lidar_box"), lambda table: table.slice(0, 0))
    assert WaymoLog(segment).labels(0) is None
    component(segment, "lidar_box").unlink()
    assert WaymoLog(segment).labels(0) is None


def test_a_laser_may_be_empty_and_boxes_may_be_unknown(recording: GridRecording, segment: Path) -> None:
    name = "[LiDARComponent].range_image_return1"

    def emptied(table: pa.Table) -> pa.Table:
        for part, kind in (("values", pa.float32()), ("shape", pa.int32())):
            cells = zip(table["key.laser_name"].to_pylist(), table[f"{name}.{part}"].to_pylist())
            column = pa.array([None if laser == 3 else cell for laser, cell in cells], pa.list_(kind))
            table = with_column(table, f"{name}.{part}", column)
        return table

    rewrite(segment, emptied)
    kind = "[LiDARBoxComponent].type"
    rewrite(component(segment, "lidar_box"), lambda t: with_column(t, kind, pa.array([0] * t.num_rows, pa.int8())))
    log = WaymoLog(segment)
    assert len(log.sweep(0).points) == len(recording.units(0)[0].points)
    labels = log.labels(0)
    assert labels.is_valid.all() and not labels.category.any()  # boxes of unknown type are background


def test_sweeps_are_read_when_asked_for(segment: Path) -> None:
    log = WaymoLog(segment)
    log.sweep(0)
    component(segment, "lidar_pose").write_bytes(b"broken")
    log.sweep(0)  # remembered
    with pytest.raises(CFlowError, match="cannot read .*lidar_pose"):
        log.sweep(1)


def test_finding_segments(recording: GridRecording, segment: Path, tmp_path: Path) -> None:
    other = write_waymo_segment(GridRecording(log_id="other"), tmp_path / "validation")
    split = segment.parent.parent
    assert find_waymo_segments(tmp_path) == sorted([segment, other])
    for root in (split, split / "lidar", segment):
        assert find_waymo_segments(root) == [segment]
    (tmp_path / "empty").mkdir()
    assert find_waymo_segments(tmp_path / "empty") == []
    with pytest.raises(CFlowError, match="neither a file nor a folder"):
        find_waymo_segments(tmp_path / "nowhere")


# ---------------------------------------------------------------------------------------------- broken segments


def cut(file: Path) -> None:
    file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])


@pytest.mark.parametrize("tag", ["lidar", "lidar_calibration", "lidar_pose", "vehicle_pose", "lidar_box"])
@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (cut, "truncated"),
        (lambda file: file.write_bytes(b""), "cannot read"),
        (lambda file: file.write_text("PAR1, said the file, but it was a poem" * 9), "cannot read"),
        (lambda file: pq.write_table(pa.table({"a": [1]}), file), "lacks the columns"),
        (lambda file: rewrite(file, lambda t: with_column(t, "key.segment_context_name", pa.array(["b"] * len(t)))),
         "holds segment b"),
    ],
    ids=["truncated", "empty", "foreign", "other table", "mislabelled"],
)  # fmt: skip
def test_damaged_component(segment: Path, tag: str, damage: Any, message: str) -> None:
    damage(component(segment, tag))
    with pytest.raises(CFlowError, match=message) as error:
        WaymoLog(segment).labels(0)
    assert f"{tag}{os.sep}{segment.name}" in str(error.value)


@pytest.mark.parametrize("tag", ["lidar", "lidar_calibration", "lidar_pose", "vehicle_pose"])
def test_missing_component(segment: Path, tag: str) -> None:
    component(segment, tag).unlink()
    with pytest.raises(CFlowError, match=f"{tag}.*is missing; download component {tag}"):
        WaymoLog(segment).sweep(0)


def filled(column: Any, value: Any, kind: Any = None) -> Any:
    """A change that gives a column, by name or number, the same value in every row."""

    def change(table: pa.Table) -> pa.Table:
        name = table.column_names[column] if isinstance(column, int) else column
        return with_column(table, name, pa.array([value] * table.num_rows, kind))

    return change


@pytest.mark.parametrize(
    ("tag", "change", "message"),
    [
        ("lidar", lambda t: t.slice(0, 2), "1 frames"),
        ("lidar", lambda t: pa.concat_tables([t, t]), "two rows of the same frame"),
        ("lidar", lambda t: t.slice(0, t.num_rows - 1), "no row for frame"),
        ("lidar_pose", lambda t: t.slice(0, 3), "no row for frame"),
        ("vehicle_pose", lambda t: t.slice(0, 3), "no pose for frame"),
        ("lidar_calibration", lambda t: t.slice(0, 1), r"lasers \[3\] are missing"),
        ("lidar_box", filled("[LiDARBoxComponent].type", 9), "box types"),
        ("lidar_box", filled("key.laser_object_id", "a"), "named twice"),
        ("lidar_box", filled("[LiDARBoxComponent].box.size.x", None, pa.float64()), "holes"),
        ("lidar_box", filled("[LiDARBoxComponent].box.heading", np.nan), "not finite"),
        ("vehicle_pose", filled(2, [2.0] * 16), "not rigid"),
        ("vehicle_pose", filled(2, [2.0] * 9), "16 numbers"),
        ("lidar", filled(4, [2, 2, 4]), "range image of shape"),
        ("lidar_pose", filled(4, [7, 60, 9]), "range image of shape"),
    ],
)  # fmt: skip
def test_contradictory_component(segment: Path, tag: str, change: Any, message: str) -> None:
    rewrite(component(segment, tag), change)
    with pytest.raises(CFlowError, match=message) as error:
        log = WaymoLog(segment)
        log.labels(2)
        log.sweep(3)
    assert f"{tag}{os.sep}{segment.name}" in str(error.value)


def test_no_such_sweep_and_no_such_place(segment: Path, tmp_path: Path) -> None:
    for ask in (WaymoLog(segment).sweep, WaymoLog(segment).labels):
        with pytest.raises(CFlowError, match="0 ... 3"):
            ask(4)
    with pytest.raises(CFlowError, match="folder lidar"):
        WaymoLog(component(segment, "stats"))
    with pytest.raises(CFlowError, match="missing"):
        WaymoLog(tmp_path / "lidar" / "nothing.parquet")


# ---------------------------------------------------------------------------------------------- the writer

KEY = [("key.segment_context_name", "string"), ("key.frame_timestamp_micros", "int64")]
NUMBERS, SHAPE, MATRIX = (
    "list<element: float>",
    "fixed_size_list<element: int32>[3]",
    "fixed_size_list<element: double>[16]",
)
IMAGE = [("values", NUMBERS), ("shape", SHAPE)]
OFFICIAL: Dict[str, Any] = {
    "lidar": [*KEY, ("key.laser_name", "int8"),
              *((f"[LiDARComponent].range_image_return{k}.{part}", kind) for k in (1, 2) for part, kind in IMAGE)],
    "lidar_calibration": [
        KEY[0], ("key.laser_name", "int8"), ("[LiDARCalibrationComponent].extrinsic.transform", MATRIX),
        ("[LiDARCalibrationComponent].beam_inclination.min", "double"),
        ("[LiDARCalibrationComponent].beam_inclination.max", "double"),
        ("[LiDARCalibrationComponent].beam_inclination.values", "list<element: double>")],
    "lidar_pose": [*KEY, ("key.laser_name", "int8"),
                   *((f"[LiDARPoseComponent].range_image_return1.{part}", kind) for part, kind in IMAGE)],
    "vehicle_pose": [*KEY, ("[VehiclePoseComponent].world_from_vehicle.transform", MATRIX)],
    "lidar_box": [
        *KEY, ("key.laser_object_id", "string"),
        *((f"[LiDARBoxComponent].box.{part}.{axis}", "double") for part in ("center", "size") for axis in "xyz"),
        ("[LiDARBoxComponent].box.heading", "double"), ("[LiDARBoxComponent].type", "int8"),
        ("[LiDARBoxComponent].num_lidar_points_in_box", "int64"),
        ("[LiDARBoxComponent].num_top_lidar_points_in_box", "int64"),
        *((f"[LiDARBoxComponent].{part}.{axis}", "double") for part in ("speed", "acceleration") for axis in "xyz"),
        ("[LiDARBoxComponent].difficulty_level.detection", "int8"),
        ("[LiDARBoxComponent].difficulty_level.tracking", "int8")],
    "stats": [
        *KEY, *((f"[StatsComponent].{name}", "string") for name in ("time_of_day", "location", "weather")),
        *((f"[StatsComponent].{sensor}_object_counts.{part}", f"list<element: {kind}>")
          for sensor in ("lidar", "camera") for part, kind in (("types", "int8"), ("counts", "int32")))],
}  # fmt: skip


def test_schemas_are_the_official_ones(segment: Path) -> None:
    split = segment.parent.parent
    assert sorted(p.name for p in split.iterdir()) == sorted(OFFICIAL)
    for tag, columns in OFFICIAL.items():
        schema = pq.ParquetFile(component(segment, tag)).schema_arrow
        assert [(field.name, str(field.type).replace("item:", "element:")) for field in schema] == columns, tag
    assert pq.ParquetFile(segment).metadata.num_row_groups == 4


def test_speeds_are_over_ground_in_the_world(recording: GridRecording, segment: Path) -> None:
    rows = pq.ParquetFile(component(segment, "lidar_box")).read().to_pylist()
    car = [row for row in rows if row["key.laser_object_id"] == "track-REGULAR_VEHICLE"]
    assert [row["[LiDARBoxComponent].type"] for row in car] == [1] * 4
    centres = [moved(recording.poses[i], recording.boxes(i).pose[0, :3, 3]) for i in range(4)]
    speed = [car[1][f"[LiDARBoxComponent].speed.{axis}"] for axis in "xyz"]
    np.testing.assert_allclose(speed, (centres[2] - centres[0]) / 0.2, atol=1e-9)
    lonely = [row for row in rows if row["key.laser_object_id"] == "track-PEDESTRIAN"]
    assert len(lonely) == 1 and lonely[0]["[LiDARBoxComponent].speed.x"] is None


def test_an_existing_segment_is_only_replaced_on_request(segment: Path, tmp_path: Path) -> None:
    split = segment.parent.parent
    with pytest.raises(CFlowError, match="overwrite=True"):
        write_waymo_segment(GridRecording(), split)
    old = WaymoLog(segment).sweep(0).pose
    assert write_waymo_segment(GridRecording(origin=(1, 2, 3)), split, overwrite=True) == segment
    assert not np.array_equal(WaymoLog(segment).sweep(0).pose, old)
    assert sorted(p.name for p in split.iterdir()) == sorted(OFFICIAL)


@pytest.mark.parametrize("stage", ["write", "move"])
def test_a_failed_write_changes_nothing(segment: Path, monkeypatch: Any, stage: str) -> None:
    split = segment.parent.parent
    before = {tag: component(segment, tag).read_bytes() for tag in OFFICIAL}
    if stage == "write":
        monkeypatch.setattr(waymo_writer, "_add_speeds", lambda *_: (_ for _ in ()).throw(OSError("disk full")))
    else:
        real, calls = os.replace, []

        def fail_late(source: Any, target: Any) -> None:
            calls.append(source)
            if len(calls) == 10:  # six moved away, three moved in
                raise OSError("disk full")
            real(source, target)

        monkeypatch.setattr(waymo_writer.os, "replace", fail_late)
    with pytest.raises(OSError, match="disk full"):
        write_waymo_segment(GridRecording(origin=(1, 2, 3)), split, overwrite=True)
    assert sorted(p.name for p in split.iterdir()) == sorted(OFFICIAL)
    assert {tag: component(segment, tag).read_bytes() for tag in OFFICIAL} == before
    if stage == "write":
        with pytest.raises(OSError, match="disk full"):
            write_waymo_segment(GridRecording(log_id="new"), split)
        assert not list(split.rglob("*new*"))


def test_recordings_that_do_not_fit(tmp_path: Path) -> None:
    for off in ("../up", "", ".hidden", "a/b"):
        with pytest.raises(CFlowError, match="file name"):
            write_waymo_segment(GridRecording(log_id=off), tmp_path)
    units = GridRecording().units
    for name, width in (("TOP", 45), ("SIDE_LEFT", 30)):  # half as many columns as the shots have
        recording = GridRecording()
        columns = {**recording.width, name: width}
        recording.units = lambda i, n=columns: [UnitReturns(**{**vars(u), "num_columns": n[u.name]}) for u in units(i)]
        with pytest.raises(CFlowError, match=f"sweep 0 .*{name}: .*off the rays"):
            write_waymo_segment(recording, tmp_path)
    with pytest.raises(CFlowError, match="SIDE_LEFT: .*share a pixel"):
        write_waymo_segment(recording, tmp_path, max_shift=100)
    with pytest.raises(CFlowError, match="is_rolling"):
        write_waymo_segment(GridRecording(), tmp_path, is_rolling=False)
    recording = GridRecording()
    recording.timestamps = tuple(START + i for i in range(4))
    with pytest.raises(CFlowError, match="microsecond"):
        write_waymo_segment(recording, tmp_path)
    recording = GridRecording()
    recording.units = lambda i: [UnitReturns(**{**vars(u), "name": u.name.replace("SIDE", "ROOF")}) for u in units(i)]
    recording.elevations = lambda name: GridRecording().table[name.replace("ROOF", "SIDE")]
    with pytest.raises(CFlowError, match="ROOF_LEFT"):
        write_waymo_segment(recording, tmp_path)
    assert not list(tmp_path.iterdir())


# ---------------------------------------------------------------------------------------------- version 1


def varint(value: int) -> bytes:
    out = b""
    while value > 0x7F:
        out, value = out + bytes([value & 0x7F | 0x80]), value >> 7
    return out + bytes([value])


def field(number: int, value: Any) -> bytes:
    """One protobuf field: an integer as varint, a float as double, bytes with their length."""
    if isinstance(value, int):
        return varint(number << 3) + varint(value)
    if isinstance(value, float):
        return varint(number << 3 | 1) + struct.pack("<d", value)
    return varint(number << 3 | 2) + varint(len(value)) + value


def transform_message(values: Sequence[float]) -> bytes:
    return b"".join(field(1, float(v)) for v in values)


def matrix(values: np.ndarray) -> bytes:
    shape = b"".join(field(1, n) for n in values.shape)
    return zlib.compress(field(1, values.astype("<f4").tobytes()) + field(2, shape))


def write_tfrecord(segment: Path, file: Path, flow: Any = None) -> Path:
    """The frames of a version 2 segment as version 1 records (checksums 0); `flow(image)` fills the flow field."""
    tables = {tag: pq.ParquetFile(component(segment, tag)).read().to_pylist() for tag in OFFICIAL}
    calibrations = b""
    for row in tables["lidar_calibration"]:
        prefix = "[LiDARCalibrationComponent]."
        low, high, values = (row[f"{prefix}beam_inclination.{n}"] for n in ("min", "max", "values"))
        beams = b"".join(field(2, v) for v in values or [])
        extrinsic = transform_message(row[f"{prefix}extrinsic.transform"])
        parts = field(1, row["key.laser_name"]) + beams + field(3, low) + field(4, high) + field(5, extrinsic)
        calibrations += field(3, parts)
    content = b""
    for pose in tables["vehicle_pose"]:
        time = pose["key.frame_timestamp_micros"]
        frame = field(1, field(1, segment.stem.encode()) + calibrations) + field(2, time)
        frame += field(3, transform_message(pose["[VehiclePoseComponent].world_from_vehicle.transform"]))
        frame += field(4, b"a camera image" * 100)
        for row in (row for row in tables["lidar"] if row["key.frame_timestamp_micros"] == time):
            image = field(2, matrix(returns := image_of(row, "[LiDARComponent].range_image_return1")))
            for poses in tables["lidar_pose"]:
                if poses["key.frame_timestamp_micros"] == time and row["key.laser_name"] == 1:
                    image += field(4, matrix(image_of(poses, "[LiDARPoseComponent].range_image_return1")))
            if flow is not None:
                image += field(5, matrix(flow(returns)))
            frame += field(5, field(1, row["key.laser_name"]) + field(2, image))
        for row in (row for row in tables["lidar_box"] if row["key.frame_timestamp_micros"] == time):
            keys = ("center.x", "center.y", "center.z", "size.y", "size.x", "size.z", "heading")
            box = b"".join(field(n + 1, row[f"[LiDARBoxComponent].box.{key}"]) for n, key in enumerate(keys))
            label = field(1, box) + field(3, row["[LiDARBoxComponent].type"])
            frame += field(6, label + field(4, row["key.laser_object_id"].encode()))
        content += struct.pack("<Q", len(frame)) + bytes(4) + frame + bytes(4)
    file.write_bytes(content)
    return file


def image_of(row: Dict[str, Any], column: str) -> np.ndarray:
    return np.array(row[f"{column}.values"], np.float32).reshape(row[f"{column}.shape"])


def test_stored_flow(recording: GridRecording, segment: Path, tmp_path: Path) -> None:
    def flow(image: np.ndarray) -> np.ndarray:
        kind = np.where(image[..., 0] > 50, -1, np.where(image[..., 0] > 20, 4, 0))
        return np.stack([kind * 1.5, kind * 0.0 + 1, kind * 0.0, kind], -1)

    log = WaymoRecordLog(write_tfrecord(segment, tmp_path / "a.tfrecord", flow), stored_flow=True)
    labels, points = log.labels(0), log.sweep(0).points.astype(float)
    assert set(np.unique(labels.category)) == {0, CATEGORY_INDEX["BICYCLIST"]}
    kind = np.where(labels.is_valid, np.where(labels.category > 0, 4, 0), -1)
    assert {-1, 0, 4} == set(kind.tolist())
    velocity = np.where(kind[:, None] < 0, 0, np.stack([kind * 1.5, kind * 0.0 + 1, kind * 0.0], -1))
    T = np.linalg.inv(recording.poses[1]) @ recording.poses[0]
    np.testing.assert_allclose(labels.flow, moved(T, points + 0.1 * velocity) - points, atol=1e-5)
    assert log.labels(3) is None
    plain = WaymoRecordLog(write_tfrecord(segment, tmp_path / "b.tfrecord"), lasers=("TOP",), stored_flow=True)
    assert not plain.labels(0).is_valid.any()  # the field is empty in plain records


def test_broken_records(segment: Path, tmp_path: Path) -> None:
    file = write_tfrecord(segment, tmp_path / "a.tfrecord")
    whole = file.read_bytes()
    for content in (whole[:-100], b"", b"no tfrecord at all, but a text that is longer than a header", whole[12:]):
        file.write_bytes(content)
        with pytest.raises(CFlowError, match="a.tfrecord"):
            WaymoRecordLog(file)
    file.write_bytes(whole)
    log = WaymoRecordLog(file)
    file.write_bytes(whole.replace(b"x\x9c", b"x\x00"))  # every zlib stream
    with pytest.raises(CFlowError, match="frame 0 cannot be read"):
        log.sweep(0)
    with pytest.raises(CFlowError, match="0 ... 3"):
        log.sweep(-1)
    with pytest.raises(CFlowError, match="missing"):
        WaymoRecordLog(tmp_path / "b.tfrecord")


# ---------------------------------------------------------------------------------------------- the official package


def test_the_official_package_reads_the_same_points(recording: GridRecording, segment: Path) -> None:
    v2 = pytest.importorskip("waymo_open_dataset.v2", reason="the official package waymo-open-dataset is not installed")
    from waymo_open_dataset.v2.perception.utils import lidar_utils

    time = recording.timestamps[1] // 1000
    rows: Dict[str, List[Dict[str, Any]]] = {}
    for tag in OFFICIAL:
        rows[tag] = pq.ParquetFile(component(segment, tag)).read().to_pylist()
        rows[tag] = [row for row in rows[tag] if row.get("key.frame_timestamp_micros", time) == time]
    pose = v2.VehiclePoseComponent.from_dict(rows["vehicle_pose"][0])
    pixel_pose = v2.LiDARPoseComponent.from_dict(rows["lidar_pose"][0])
    points = []
    for row in rows["lidar"]:
        calibration = [r for r in rows["lidar_calibration"] if r["key.laser_name"] == row["key.laser_name"]][0]
        is_top = row["key.laser_name"] == 1
        cloud = lidar_utils.convert_range_image_to_point_cloud(
            v2.LiDARComponent.from_dict(row).range_image_return1,
            v2.LiDARCalibrationComponent.from_dict(calibration),
            pixel_pose.range_image_return1 if is_top else None,
            pose if is_top else None,
        )
        points.append(np.asarray(cloud))
    # TensorFlow computes in float32, world coordinates included.
    assert np.abs(np.concatenate(points) - WaymoLog(segment).sweep(1).points).max() < 2e-3
    box = v2.LiDARBoxComponent.from_dict(rows["lidar_box"][0])
    assert box.box.size.x == 30 and box.key.laser_object_id == "track-REGULAR_VEHICLE"
