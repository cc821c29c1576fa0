"""The Argoverse 2 reader: the real log, small written logs, broken files, box truth, ground rules."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any, Sequence

import numpy as np
import pyarrow.feather as feather
import pytest
from public_evaluators import write_table
from scenes import pose

from cflow_torch.data.av2 import AV2Log, GroundRaster, read_ground_raster
from cflow_torch.data.boxes import Boxes, flow_from_boxes
from cflow_torch.data.catalog import find_sources
from cflow_torch.data.log import window
from cflow_torch.types import CFlowError, CFlowWarning

TIMES = (100, 200, 300)
POINTS = np.array([[1, 2, 3], [10, 0, 0.5], [-4, 0, 0]], dtype=np.float16)
YAW = math.radians(90)


def pose_columns(times: Sequence[int] = TIMES) -> dict[str, Any]:
    """Sweep k is at x = 1000 + k, rotated to the left by 90 degrees."""
    n = len(times)
    columns: dict[str, Any] = {name: np.zeros(n) for name in ("qw", "qx", "qy", "qz", "tx_m", "ty_m", "tz_m")}
    columns.update(qw=np.full(n, math.cos(YAW / 2)), qz=np.full(n, math.sin(YAW / 2)), tx_m=1000.0 + np.arange(n))
    return {"timestamp_ns": np.array(times, dtype=np.int64), **columns}


def box_columns(time: int, x: float, track: str = "a", category: str = "REGULAR_VEHICLE", inside: int = 1) -> dict:
    row: dict[str, Any] = dict.fromkeys(("qx", "qy", "qz", "ty_m"), 0.0)
    row.update(timestamp_ns=time, track_uuid=track, category=category, num_interior_pts=inside)
    row.update(length_m=4.0, width_m=2.0, height_m=1.5, qw=1.0, tx_m=x, tz_m=0.5)
    return row


def annotate(folder: Path, *rows: dict[str, Any]) -> None:
    write_table(folder / "annotations.feather", **{key: [row[key] for row in rows] for key in rows[0]})


def label_columns(rows: int = 3, **changes: Any) -> dict[str, Any]:
    columns: dict[str, Any] = {f"flow_t{axis}_m": np.arange(rows, dtype=np.float32) for axis in "xyz"}
    columns.update(classes=np.full(rows, 19, dtype=np.uint8), dynamic=np.ones(rows, dtype=bool))
    return {**columns, **changes}


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A log of three sweeps, without map and labels."""
    log = tmp_path / "val" / "some-log"
    for time in TIMES:
        write_table(log / "sensors" / "lidar" / f"{time}.feather", **dict(zip("xyz", POINTS.T)))
    write_table(log / "city_SE3_egovehicle.feather", **pose_columns())
    return log


def test_the_real_log_is_read(av2_folder: Path, data_root: Path, tmp_path: Path) -> None:
    assert av2_folder in find_sources("av2", data_root)
    log = AV2Log(av2_folder)
    assert (log.log_id, list(log.timestamps)) == (av2_folder.name, [315966265259836000, 315966265360032000])
    pair = window(log, 0)
    assert (pair.pc0.points.shape, pair.pc1.points.shape) == ((99_229, 3), (99_466, 3))
    assert (pair.pc0.points.dtype, pair.pc0.pose.dtype) == (np.float32, np.float64)
    T, npz = np.linalg.inv(pair.pc1.pose) @ pair.pc0.pose, np.load(av2_folder / "ego_motion.npz")["ego_motion"][0]
    np.testing.assert_allclose(T[:3, :3], npz[:3, :3], atol=1e-7)
    np.testing.assert_allclose(T[:3, 3], npz[:3, 3], atol=1e-3)  # the npz was made in float32: 0.8 mm
    # The stored mask was made with city coordinates in float32 (steps of 0.5 mm at 5 km). There one point, 0.4 mm from
    # the border of a raster cell, falls into the next cell.
    mask = feather.read_table(str(av2_folder / "flow_labels.feather"))["is_ground_0"].to_numpy()
    is_ground = pair.pc0.is_ground
    assert (mask.sum(), is_ground.sum(), (is_ground != mask).sum()) == (17_374, 17_373, 1)
    assert AV2Log(av2_folder, ground="bsfe").sweep(0).is_ground.sum() == 18_754
    assert AV2Log(av2_folder, ground=None).sweep(0).is_ground is None
    for entry in av2_folder.iterdir():  # without the stored labels, the boxes give them
        if entry.name != "flow_labels.feather":
            (tmp_path / entry.name).symlink_to(entry)
    made, stored = AV2Log(tmp_path).labels(0), log.labels(0)
    assert stored.is_valid.all() and log.labels(1) is None
    np.testing.assert_array_equal(made.category, stored.category)
    assert np.linalg.norm(made.flow - stored.flow, axis=1).max() < 1e-3  # the stored flow has the float32 ego motion
    ends = np.flatnonzero(~made.is_valid)
    assert len(ends) == 9  # boxes that hold no point at t+1; stored as ego motion, without a flag
    assert (stored.category[ends] > 0).all()


def test_stored_labels_take_precedence_over_boxes(folder: Path) -> None:
    annotate(folder, box_columns(100, 10.0), box_columns(200, 10.0), box_columns(300, 13.0))
    write_table(folder / "flow_labels.feather", **label_columns(flow_tx_m=np.zeros(3, dtype=np.float32)))
    first, second = (AV2Log(folder).labels(index) for index in (0, 1))
    assert not first.flow[:, 0].any() and first.flow[2, 2] == 2 and first.is_valid.all()
    np.testing.assert_allclose(second.flow[1], [3, 0, 0], atol=1e-6)  # the one file is of the first pair
    valid = np.array([True, False, True])
    write_table(folder / "flow_labels" / "100.feather", **label_columns(is_valid=valid))
    log = AV2Log(folder)
    labels = log.labels(0)
    np.testing.assert_array_equal(labels.flow[:, 0], [0, 1, 2])
    np.testing.assert_array_equal(labels.is_valid, valid)
    assert (labels.flow.dtype, labels.category.dtype, labels.is_valid.dtype) == (np.float32, np.uint8, np.bool_)
    assert log.labels(1) is None and log.labels(2) is None  # the folder has no file for this pair; no pair


def test_boxes_become_flow(folder: Path) -> None:
    annotate(folder, box_columns(100, 10.0), box_columns(200, 12.0), box_columns(200, -4.0, "b", "DOG"))
    log = AV2Log(folder)
    labels = log.labels(0)
    assert labels is not None
    np.testing.assert_array_equal(labels.category, [0, 19, 0])
    # The ego moves 1 m along city x, which is its right: -y. So the world moves by +y; the box moves as annotated.
    np.testing.assert_allclose(labels.flow, [[0, 1, 0], [2, 0, 0], [0, 1, 0]], atol=1e-6)
    assert labels.is_valid.all()
    assert log.labels(1) is None  # sweep 300 lies after the last annotation
    annotate(folder, box_columns(100, 10.0), box_columns(200, 12.0, inside=0), box_columns(300, 12.0, "b"))
    labels = AV2Log(folder).labels(0)  # a track whose box becomes empty
    assert labels.is_valid.tolist() == [True, False, True] and labels.category[1] == 19


def test_bad_logs_are_refused(folder: Path, tmp_path: Path) -> None:
    with pytest.raises(CFlowError, match="has no folder sensors/lidar"):
        AV2Log(tmp_path)
    for ask in (AV2Log(folder).sweep, AV2Log(folder).labels):
        for index in (3, -1):
            with pytest.raises(CFlowError, match=f"sweeps 0 ... 2, you asked for {index}"):
                ask(index)
    with pytest.raises(CFlowError, match="ground rules are"):
        AV2Log(folder, ground="patchwork")
    for time in TIMES[1:]:
        (folder / "sensors" / "lidar" / f"{time}.feather").unlink()
    with pytest.raises(CFlowError, match="has 1 sweeps"):
        AV2Log(folder)


SWEEP, POSES, LABELS = "sensors/lidar/100.feather", "city_SE3_egovehicle.feather", "flow_labels/100.feather"


@pytest.mark.parametrize(
    ("file", "columns", "message"),
    [
        (POSES, {**pose_columns(), "qw": np.full(3, 0.9)}, "the pose of 100 is not a rigid motion"),
        (POSES, {**pose_columns(), "timestamp_ns": np.array(TIMES, dtype=np.float64)}, "timestamp_ns has dtype"),
        (POSES, {key: value for key, value in pose_columns().items() if key != "qz"}, r"lacks the columns \['qz'\]"),
        (SWEEP, {"x": [1.0, None], "y": [1.0, 2.0], "z": [1.0, 2.0]}, "1 empty entries in x"),
        (LABELS, label_columns(rows=2), "2 rows but sweep 100 has 3 points"),
        (LABELS, label_columns(classes=np.array([0, 31, 0], dtype=np.uint8)), "classes are 0 ... 30"),
        (LABELS, label_columns(is_valid=np.ones(3)), "is_valid has dtype float64"),
    ],
)
def test_bad_columns_are_refused(folder: Path, file: str, columns: dict[str, Any], message: str) -> None:
    write_table(folder / file, **columns)
    with pytest.raises(CFlowError, match=message) as error:
        log = AV2Log(folder)
        log.sweep(0), log.labels(0)
    assert file in str(error.value)


def test_sweeps_without_poses_are_left_out_or_the_log_has_none(folder: Path) -> None:
    late = (200 + 10**9, 300 + 10**9)
    for time, other in zip(TIMES[1:], late):
        (folder / "sensors" / "lidar" / f"{time}.feather").rename(folder / "sensors" / "lidar" / f"{other}.feather")
    write_table(folder / POSES, **pose_columns(late))
    with pytest.warns(CFlowWarning, match="1 of 3 sweeps have no pose in .* left out: 1 before the first pose"):
        log = AV2Log(folder)
    assert log.timestamps == list(late)

    (folder / POSES).unlink()
    write_table(folder / LABELS, **label_columns())
    with pytest.warns(CFlowWarning, match=r"egovehicle.feather is missing, so it has no poses. .*data.odometry=true"):
        log = AV2Log(folder)
    sweep = log.sweep(0)
    assert len(log) == 3 and sweep.pose is None and sweep.is_ground is None and len(sweep.points) == 3
    assert log.labels(0) is not None  # stored flow needs no poses


def test_boxes_have_a_margin_and_the_last_one_wins() -> None:
    points = np.array([[2.05, 0, 0], [0, 1.05, 0], [0, 0, 0.8], [1.9, 0, 0]])
    boxes0 = Boxes(
        track_id=["ends", "stays"],
        category=np.array([4, 17], np.uint8),
        size=np.array([[4.0, 2.0, 1.5], [0.4, 0.4, 1.5]]),
        pose=np.stack([np.eye(4), pose(1.9, 0, 0)]),
    )
    boxes1 = Boxes(["stays"], np.array([17], np.uint8), boxes0.size[1:], pose(2.4, 0, 0)[None])
    labels = flow_from_boxes(points, boxes0, boxes1, np.eye(4))
    # 10 cm more per side in length and width, none in height; the last box wins, but an ended track stays invalid
    np.testing.assert_array_equal(labels.category, [17, 4, 0, 17])
    np.testing.assert_array_equal(labels.is_valid, [False, False, True, False])
    np.testing.assert_allclose(labels.flow[[0, 3], 0], 0.5, atol=1e-6)


def test_ground_rules_differ_in_threshold_and_rounding() -> None:
    # half a metre per cell: cell (0, 0) holds x 100 ... 100.5, y 50 ... 50.5
    flat = GroundRaster(np.array([[0.0, np.nan], [0.0, 30.0]]), np.eye(2), np.array([-100.0, -50.0]), 2.0)
    z = np.array([0.3, 0.3 + 1e-9, 0.0, -0.3, -20.0, 0.4])
    points = np.column_stack([np.full(6, 100.2), np.full(6, 50.2), z])
    np.testing.assert_array_equal(flat.is_ground(points), [True, False, True, True, True, False])
    np.testing.assert_array_equal(flat.is_ground(points, "bsfe"), [True] * 6)
    # Unknown height; outside; not a number; cell 0.6, 0.6, which one rule truncates and the other rounds.
    others = np.array([[100.6, 50.1, -5.0], [500, 50, -5.0], [np.nan, 50, 0], [100.3, 50.3, 9.0]])
    np.testing.assert_array_equal(flat.is_ground(others), [False, False, False, False])
    np.testing.assert_array_equal(flat.is_ground(others, "bsfe"), [False, False, False, True])


def test_a_map_gives_ground_masks(folder: Path) -> None:
    maps = folder / "map"
    maps.mkdir()
    assert read_ground_raster(maps) is None
    np.save(maps / "x_ground_height_surface____PIT.npy", np.zeros((40, 40), dtype=np.float16))
    with pytest.raises(CFlowError, match="found 1 and 0"):
        AV2Log(folder)
    sim2 = maps / "x___img_Sim2_city.json"
    sim2.write_text(json.dumps({"R": [1, 0, 0, 1], "t": [-990, 10], "s": 1.0}))
    sweep = AV2Log(folder).sweep(0)
    np.testing.assert_array_equal(sweep.is_ground, [False, False, True])  # z = 3, 0.5, 0
    np.testing.assert_array_equal(AV2Log(folder, ground="bsfe").sweep(0).is_ground, [False, False, True])
    sim2.write_text(json.dumps({"R": [1, 0, 0, 1], "t": [float("nan"), 10], "s": 1.0}))
    with pytest.raises(CFlowError, match="img_Sim2_city.json: its numbers must be finite"):
        AV2Log(folder)
    sim2.write_text("{}")
    with pytest.raises(CFlowError, match="cannot read .*img_Sim2_city.json.*copy the map folder again"):
        AV2Log(folder)
    np.save(maps / "x_ground_height_surface____PIT.npy", np.zeros(40))
    with pytest.raises(CFlowError, match="ground_height_surface"):
        AV2Log(folder)


def write_calibration(folder: Path) -> None:
    """Two cameras, one of which looks ahead and the other to the left."""
    names = ["ring_front_center", "ring_side_left"]
    columns = {"sensor_name": names, "fx_px": [1700.0, 1600.0], "fy_px": [1710.0, 1610.0], "cx_px": [770.0, 1020.0]}
    columns.update(cy_px=[1010.0, 760.0], k1=[-0.2, -0.2], width_px=[1550, 2048], height_px=[2048, 1550])
    write_table(folder / "calibration" / "intrinsics.feather", **columns)
    rotations = np.array([[0.5, -0.5, 0.5, -0.5], [0.7, -0.7, 0.1, -0.1]])
    mount: dict[str, Any] = dict(zip(("qw", "qx", "qy", "qz"), rotations.T))
    mount.update(tx_m=[1.6, 1.3], ty_m=[0.0, 0.3], tz_m=[1.4, 1.4])
    write_table(folder / "calibration" / "egovehicle_SE3_sensor.feather", sensor_name=names, **mount)


def check_cameras(log: AV2Log, index: int, points: np.ndarray) -> None:
    """Compare the pixels of points with those of av2-api, which reads the same files."""
    pytest.importorskip("av2", reason="needs av2: scripts/evaluators.txt")
    from av2.geometry.camera.pinhole_camera import PinholeCamera
    from av2.utils.io import read_city_SE3_ego

    poses = read_city_SE3_ego(log.folder)
    for camera in log.cameras(index):
        theirs = PinholeCamera.from_feather(log.folder, camera.name)
        pose_of_image = poses[int(camera.image)]
        pixels, in_camera, _ = theirs.project_ego_to_img_motion_compensated(
            points, pose_of_image, poses[log.timestamps[index]]
        )
        assert camera.size == (theirs.width_px, theirs.height_px)
        positions = camera.see(points)
        np.testing.assert_allclose(positions, in_camera[:, :3], atol=1e-6)
        is_ahead = positions[:, 2] > 0.5
        np.testing.assert_allclose(camera.project(positions)[is_ahead], pixels[is_ahead], atol=1e-3)
        assert np.isnan(camera.project(positions)[positions[:, 2] < 0]).all()


def test_cameras_of_the_real_log_project_as_those_of_the_api(av2_folder: Path) -> None:
    log = AV2Log(av2_folder)
    assert len(log.cameras(0)) == 9 and {camera.seconds for camera in log.cameras(0)} == {0.0}
    check_cameras(log, 0, log.sweep(0).points.astype(np.float64)[::500])


def test_each_camera_has_the_pose_of_its_own_image(folder: Path) -> None:
    """The vehicle turns and drives while images are taken, 40 and 30 ns after and before the sweep."""
    assert AV2Log(folder).cameras(0) == []
    times = (100, 170, 200, 240, 300)
    columns = pose_columns(times)
    yaw = np.linspace(0, 1, 5)
    columns.update(qw=np.cos(yaw / 2), qz=np.sin(yaw / 2))
    write_table(folder / "city_SE3_egovehicle.feather", **columns)
    write_calibration(folder)
    for name, stamps in {"ring_front_center": (100, 240), "ring_side_left": (170, 300)}.items():
        (folder / "sensors" / "cameras" / name).mkdir(parents=True)
        for stamp in stamps:
            (folder / "sensors" / "cameras" / name / f"{stamp}.jpg").touch()
    log = AV2Log(folder)
    front, left = log.cameras(1)
    assert (front.image, front.seconds) == ("240", pytest.approx(40e-9)) and left.image == "170"
    check_cameras(log, 1, np.random.default_rng(0).uniform(-30, 30, (200, 3)))
