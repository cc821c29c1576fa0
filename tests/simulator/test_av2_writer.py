"""The Argoverse 2 writer: what is on disk, read with pyarrow alone."""

from __future__ import annotations

import json
import os
from pathlib import Path

import numpy as np
import pytest
from pyarrow import feather

from cflow_torch.simulator import make_drive
from cflow_torch.simulator.writers import av2 as writers
from cflow_torch.simulator.writers.av2 import quaternions, write_av2_log
from cflow_torch.types import CFlowError

POSE = [(name, "double") for name in ("qw", "qx", "qy", "qz", "tx_m", "ty_m", "tz_m")]
SCHEMAS = {
    "sensors/lidar/*.feather": [
        *((axis, "halffloat") for axis in "xyz"),
        ("intensity", "uint8"),
        ("laser_number", "uint8"),
        ("offset_ns", "int32"),
    ],
    "city_SE3_egovehicle.feather": [("timestamp_ns", "int64"), *POSE],
    "calibration/egovehicle_SE3_sensor.feather": [("sensor_name", "string"), *POSE],
    "annotations.feather": [
        ("timestamp_ns", "int64"),
        ("track_uuid", "string"),
        ("category", "string"),
        *((name, "double") for name in ("length_m", "width_m", "height_m")),
        *POSE,
        ("num_interior_pts", "int64"),
    ],
    "flow_labels*.feather": [
        *((f"flow_t{axis}_m", "float") for axis in "xyz"),
        ("classes", "uint8"),
        ("dynamic", "bool"),
        ("is_ground_0", "bool"),
    ],
}


def schema(path):
    return [(field.name, str(field.type)) for field in feather.read_table(path).schema]


def columns(path, *names):
    table = feather.read_table(path)
    return np.stack([table[name].to_numpy() for name in names], -1)


def rotations(q):
    """Rotation matrices (M, 3, 3) of quaternions (M, 4), scalar first: the textbook formula."""
    w, x, y, z = q.T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.array(rows).transpose(2, 0, 1)


def read_poses(path):
    values = columns(path, "qw", "qx", "qy", "qz", "tx_m", "ty_m", "tz_m")
    poses = np.tile(np.eye(4), (len(values), 1, 1))
    poses[:, :3, :3], poses[:, :3, 3] = rotations(values[:, :4]), values[:, 4:]
    return poses


@pytest.fixture(scope="module")
def drive():
    return make_drive(seed=2, num_sweeps=3, profile="av2")


@pytest.fixture(scope="module")
def folder(drive, tmp_path_factory):
    return write_av2_log(drive, tmp_path_factory.mktemp("split") / "val")


def test_layout(drive, folder):
    stamps, name = drive.timestamps, drive.log_id
    assert folder.name == name
    assert {str(p.relative_to(folder)) for p in folder.rglob("*") if p.is_file()} == {
        *(f"sensors/lidar/{stamp}.feather" for stamp in stamps),
        *(f"flow_labels/{stamp}.feather" for stamp in stamps[:-1]),
        "city_SE3_egovehicle.feather",
        "calibration/egovehicle_SE3_sensor.feather",
        "annotations.feather",
        f"map/{name}_ground_height_surface____SYN.npy",
        f"map/{name}___img_Sim2_city.json",
        f"map/log_map_archive_{name}____SYN_city_00000.json",
    }
    assert os.listdir(folder.parent) == [name]  # no temporary folder stays


def test_schemas(drive, folder):
    for pattern, expected in SCHEMAS.items():
        pattern = pattern.replace("flow_labels*", "flow_labels/*")
        for path in folder.glob(pattern):
            extra = [("is_valid", "bool")] if "flow_labels" in pattern else []
            assert schema(path) == expected + extra, path


def test_schemas_are_those_of_a_real_log():
    data = Path(os.environ.get("CFLOW_DATA", Path(__file__).resolve().parents[3] / "shared" / "data"))
    logs = sorted(data.glob("av2-*/val/*"))
    if not logs:
        pytest.skip(f"no Argoverse 2 log below {data}; set CFLOW_DATA")
    for pattern, expected in SCHEMAS.items():
        paths = list(logs[0].glob(pattern))
        assert paths and all(schema(path) == expected for path in paths), pattern


def test_points_come_back_to_half_precision(drive, folder):
    for i, stamp in enumerate(drive.timestamps):
        path = folder / "sensors" / "lidar" / f"{stamp}.feather"
        points, written = drive.sweep(i).points, columns(path, "x", "y", "z")
        assert np.array_equal(written, points.astype(np.float16))
        assert (np.abs(written.astype(float) - points) <= 2.0**-11 * np.maximum(np.abs(points), 2.0**-14)).all()
        channels = drive.channels(i)
        for name in ("intensity", "laser_number", "offset_ns"):
            assert np.array_equal(feather.read_table(path)[name].to_numpy(), getattr(channels, name))


def test_poses_and_calibration_come_back(drive, folder):
    path = folder / "city_SE3_egovehicle.feather"
    assert np.abs(read_poses(path) - drive.poses).max() < 1e-12
    assert columns(path, "timestamp_ns")[:, 0].tolist() == list(drive.timestamps)
    path = folder / "calibration" / "egovehicle_SE3_sensor.feather"
    assert feather.read_table(path)["sensor_name"].to_pylist() == ["up_lidar", "down_lidar"]
    assert np.abs(read_poses(path) - np.stack(list(drive.calibration.values()))).max() < 1e-12
    assert read_poses(path)[1, 2, 2] == pytest.approx(-1)  # the lower unit hangs upside down


def test_flow_labels_come_back_row_by_row(drive, folder):
    for i, stamp in enumerate(drive.timestamps[:-1]):
        path, labels = folder / "flow_labels" / f"{stamp}.feather", drive.labels(i)
        table = feather.read_table(path)
        assert np.array_equal(columns(path, "flow_tx_m", "flow_ty_m", "flow_tz_m"), labels.flow)
        assert np.array_equal(table["classes"].to_numpy(), labels.category)
        assert np.array_equal(table["is_valid"].to_numpy(), labels.is_valid)
        assert np.array_equal(table["is_ground_0"].to_numpy(), drive.sweep(i).is_ground)
        points = drive.sweep(i).points.astype(float)
        T = np.linalg.inv(drive.poses[i + 1]) @ drive.poses[i]
        residual = labels.flow + points - points @ T[:3, :3].T - T[:3, 3]
        dynamic = table["dynamic"].to_numpy()
        assert np.array_equal(dynamic, np.linalg.norm(residual, axis=1) >= 0.05)
        assert 1000 < dynamic.sum() < 0.5 * len(dynamic)


def test_annotations_explain_the_flow(drive, folder):
    """Truth rebuilt from the written boxes and poses alone equals the written flow of the points of each track."""
    path = folder / "annotations.feather"
    table, poses = feather.read_table(path), read_poses(path)
    stamps, tracks = table["timestamp_ns"].to_numpy(), np.array(table["track_uuid"].to_pylist())
    labels, body = drive.labels(0), drive._body_of(drive.returns(0))
    points, checked = drive.sweep(0).points.astype(float), 0
    for number, track in enumerate(drive.track_ids):
        rows = body == number
        if not rows.any() or drive.scene.bodies[number].category is None:
            continue
        box0, box1 = (poses[(stamps == stamp) & (tracks == track)] for stamp in drive.timestamps[:2])
        motion = box1[0] @ np.linalg.inv(box0[0])
        flow = points[rows] @ motion[:3, :3].T + motion[:3, 3] - points[rows]
        assert np.abs(flow - labels.flow[rows]).max() < 1e-5
        checked += 1
    assert checked > 20
    assert table["num_interior_pts"].to_numpy()[stamps == drive.timestamps[0]].sum() == (labels.category > 0).sum()


def test_raster_finds_the_ground(drive, folder):
    """Argoverse 2's rule: pixel = trunc(s (R xy + t)), ground where |z - h| <= 0.3 m or below."""
    sim2 = json.loads((folder / "map" / f"{drive.log_id}___img_Sim2_city.json").read_text())
    raster = np.load(folder / "map" / f"{drive.log_id}_ground_height_surface____SYN.npy")
    assert raster.dtype == np.float16 and raster.ndim == 2
    sweep = drive.sweep(0)
    city = sweep.points.astype(float) @ drive.poses[0, :3, :3].T + drive.poses[0, :3, 3]
    pixel = (sim2["s"] * (city[:, :2] @ np.reshape(sim2["R"], (2, 2)).T + sim2["t"])).astype(np.int64)
    height = raster[pixel[:, 1], pixel[:, 0]].astype(float)
    found = city[:, 2] - height <= 0.3
    assert found[sweep.is_ground].all()
    # The rule also takes the foot of every object: nothing that stands clear of the ground.
    true_height = drive.scene.ground.height(city[:, 0].copy(), city[:, 1].copy())
    clear = city[:, 2] > true_height + 0.3 + drive.scene.ground.kerb + 0.02
    assert clear.sum() > 30_000 and not found[clear].any()
    archive = json.loads(next((folder / "map").glob("log_map_archive_*.json")).read_text())
    assert set(archive) == {"pedestrian_crossings", "lane_segments", "drivable_areas"}


def test_an_existing_log_is_only_replaced_on_request(tmp_path):
    old, new = (make_drive(seed=1, num_sweeps=n, profile="demo") for n in (1, 2))
    folder = write_av2_log(old, tmp_path)
    with pytest.raises(CFlowError, match="overwrite=True"):
        write_av2_log(new, tmp_path)
    assert len(list((folder / "sensors" / "lidar").iterdir())) == 1
    assert write_av2_log(new, tmp_path, overwrite=True) == folder
    assert len(list((folder / "sensors" / "lidar").iterdir())) == 2
    assert os.listdir(tmp_path) == [folder.name]


def test_a_failed_write_leaves_the_old_log_and_no_rubbish(tmp_path, monkeypatch):
    log = make_drive(seed=1, num_sweeps=1, profile="demo")
    folder = write_av2_log(log, tmp_path)
    before = (folder / "annotations.feather").read_bytes()

    def full(*_):
        raise OSError("disk full")

    monkeypatch.setattr(writers, "_write_map", full)
    with pytest.raises(OSError, match="disk full"):
        write_av2_log(log, tmp_path, overwrite=True)
    assert os.listdir(tmp_path) == [folder.name] and (folder / "annotations.feather").read_bytes() == before


def test_a_log_without_annotations_is_refused(tmp_path):
    class Bare:
        log_id, timestamps = "bare", (0,)

    with pytest.raises(CFlowError, match="calibration, channels, boxes, ground_raster"):
        write_av2_log(Bare(), tmp_path)
    log = make_drive(seed=1, num_sweeps=1, profile="demo")
    log.log_id = "../elsewhere"
    with pytest.raises(CFlowError, match="folder name"):
        write_av2_log(log, tmp_path)


def test_quaternions_of_any_rotation():
    rng = np.random.default_rng(0)
    q = rng.normal(size=(200, 4))
    q[:4] = np.eye(4)  # half turns about each axis are where naive formulas divide by zero
    q /= np.linalg.norm(q, axis=1, keepdims=True)
    found = quaternions(rotations(q))
    assert (found[:, 0] >= 0).all()
    assert np.abs(rotations(found) - rotations(q)).max() < 1e-14
