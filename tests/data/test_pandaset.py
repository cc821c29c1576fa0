"""PandaSet: a recording written by pandas in the layout of the data set comes back; pickles are never executed."""

from __future__ import annotations

import base64
import gzip
import io
import json
import pickle
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tiny_recording import CAR_SIZE, NUM_ON_CAR, NUM_STATIC, TinyRecording

from cflow_torch import CFlowError
from cflow_torch.data.catalog import find_sources, open_log
from cflow_torch.data.pandaset import PandaSetLog
from cflow_torch.data.pickles import load_columns
from cflow_torch.transforms import to_quaternions

# Two points (x, y, d, label) by pandas 1.0.5 in protocol 4, the layout of the released files.
OLD_FRAME = (
    "H4sIAAAAAAAC/5VTUWsTQRDO5u5qrBZbsGhfij6o0YfDgg8KYktTBD08oe/l2Eu22eDdJezu2QQN6EOqhXnr+A/9Af4Dnd27QKJRcB9u5mbn"
    "m29mduaT/+2713AHtka86HEddodKhKeK5wLh6hE3/KXTL/HhZ5xiG4KkR0aE3UX/QWGEKnimw5wXvC+URrh+mA27795U/xW+fUIBbi8De2Is"
    "dJhyTXzrSSHOklfWRgB5DYK5bpn9ini7KPPRpILnZWYGXCk+Ib5Eie6w0EaVXUMQCJwjwhWicy6XGDVm2GEpfsFjbEcs8mcotyHomcnIlgjN"
    "t0/x4mt16wH7iHEcv/5Jx32ifYPpha2BjREYhWY9osl4KjIUdAd+YXsVl+cUQW7AzqpSFS/6ttZjKxfqk49iCLThylCa4GszHGHUtIoghbmY"
    "gsjlTXnL1iF35lU0o+Y5yl1oni5l//y37Bs2+86d6r1/7FeydVDJRi03D5Dc/uRgc47BAod8sYphs47YYLX8V8S7rp9ehysE77DUro+uzA15"
    "w3Zla0W9sxon78n71p9aV7f8rxhWY+QD/p+A9iJATBHWHod7T8K9aiY5PSnKdVhL7bRrpKysfe09z0p78wxaeV8ldEkr0UrLAQ1sQWqgs0FX"
    "uJGk92OWtbSZnMkjOZYfyOYtWWNn9SK/topSu4FLaHRpUe1qzJc2yYXhbldOiIcbQ9s4xTINfwFmhAxy7wMAAA=="
)


@pytest.fixture
def sequence(tmp_path: Path) -> Path:
    """Three sweeps of two LiDARs. The car has a cuboid for each of them, the parked one a cuboid for both."""
    pandas = pytest.importorskip("pandas", reason="writes the files")
    if int(pandas.__version__.partition(".")[0]) > 2:
        pytest.skip("the reader refuses what pandas 3 writes; the released files are of pandas 1")
    recording, folder = TinyRecording(num_sweeps=3), tmp_path / "pandaset" / "042"
    (folder / "lidar").mkdir(parents=True)
    (folder / "annotations" / "cuboids").mkdir(parents=True)
    count = NUM_STATIC + NUM_ON_CAR
    poses = []
    for index, stamp in enumerate(recording.timestamps):
        x, y, z = recording.world(index).T
        shots = [unit.offset_ns for unit in recording.units(index)]
        columns = {"x": x, "y": y, "z": z, "i": 0 * x, "t": (stamp + np.concatenate(shots)) * 1e-9}
        frame = pandas.DataFrame({**columns, "d": np.repeat([0, 1], count)})
        frame.to_pickle(folder / "lidar" / f"{index:02d}.pkl.gz")
        half = recording.pose_at(stamp)[:3, :3]
        w, qz = np.sqrt((1 + half[0, 0]) / 2), np.sign(half[1, 0]) * np.sqrt((1 - half[0, 0]) / 2)
        position = dict(zip("xyz", recording.poses[index][:3, 3]))
        poses.append({"position": position, "heading": {"w": w, "x": 0.0, "y": 0.0, "z": qz}})
        rows = []
        for track, sensor, pose, label in (
            ("a", 0, recording.car_at(stamp), "Car"),
            ("b", 1, recording.car_at(stamp), "Car"),
            ("c", -1, recording.parked(), "Semi-truck"),
        ):
            yaw = np.arctan2(pose[1, 0], pose[0, 0]) - np.pi / 2
            length, width, height = CAR_SIZE
            rows.append([track, label, yaw, *pose[:3, 3], width, length, height, False, None, sensor])
        names = ["uuid", "label", "yaw", *(f"position.{a}" for a in "xyz"), *(f"dimensions.{a}" for a in "xyz")]
        names += ["stationary", "attributes.rider_status", "cuboids.sensor_id"]
        pandas.DataFrame(rows, columns=names).to_pickle(folder / "annotations" / "cuboids" / f"{index:02d}.pkl.gz")
    (folder / "lidar" / "poses.json").write_text(json.dumps(poses))
    (folder / "lidar" / "timestamps.json").write_text(json.dumps([t * 1e-9 for t in recording.timestamps]))
    return folder


def test_a_recording_comes_back(sequence: Path) -> None:
    recording = TinyRecording(num_sweeps=3)
    assert find_sources("pandaset", sequence.parents[1]) == [sequence] == find_sources("pandaset", sequence)
    log = open_log("pandaset", sequence, check=False)
    assert log.log_id == "042" and np.allclose(log.timestamps, recording.timestamps, rtol=0, atol=300)
    sweep = log.sweep(1)
    assert np.allclose(sweep.pose, recording.poses[1], atol=1e-9) and sweep.points.dtype == np.float32
    world = sweep.points @ sweep.pose[:3, :3].T + sweep.pose[:3, 3]
    assert np.allclose(world, recording.world(1), atol=1e-4)
    offsets = np.concatenate([unit.offset_ns for unit in recording.units(1)]) * 1e-9
    assert np.allclose(sweep.point_times, offsets, atol=1e-6)
    columns = log.columns(1)
    assert list(columns) == ["i", "t", "d"] and np.array_equal(np.bincount(columns["d"]), [NUM_STATIC + NUM_ON_CAR] * 2)


def test_cuboids_become_flow(sequence: Path) -> None:
    recording, log = TinyRecording(num_sweeps=3), PandaSetLog(sequence)
    labels, points = log.labels(1), log.sweep(1).points
    assert labels is not None and labels.is_valid.all() and log.labels(2) is None
    stamps, poses = recording.timestamps, recording.poses
    moved = recording.car_at(stamps[2]) @ np.linalg.inv(recording.car_at(stamps[1]))
    # Shots up to 99 ms later miss the front of the cuboid, so we judge those inside.
    local = np.c_[recording.world(1), np.ones(len(points))] @ np.linalg.inv(recording.car_at(stamps[1])).T
    inside = (np.abs(local[:, :3]) <= CAR_SIZE / 2 + [0.1, 0.1, 0]).all(1)
    assert inside[:40].any() and inside[40:].any(), "both LiDARs hit the car"
    for rows, motion, category in ((inside, moved, 19), (~inside, np.eye(4), 0)):
        T = np.linalg.inv(poses[2]) @ motion @ poses[1]
        expected = points @ T[:3, :3].T + T[:3, 3] - points
        assert np.allclose(labels.flow[rows], expected[rows], atol=1e-4)
        assert (labels.category[rows] == category).all()


def test_classes_of_points_are_ground_and_categories(sequence: Path) -> None:
    import pandas

    before = PandaSetLog(sequence)
    assert before.sweep(1).is_ground is None
    boxed = before.labels(1).category > 0
    classes = np.where(boxed, 13, 41)
    classes[np.flatnonzero(~boxed)[:4]] = 7, 11, 13, 4  # road, sidewalk, a car without a cuboid, a reflection
    classes[np.flatnonzero(boxed)[0]] = 41  # a wall inside a cuboid
    folder = sequence / "annotations" / "semseg"
    folder.mkdir()
    names = {"4": "Reflection", "7": "Road", "11": "Sidewalk", "13": "Car", "41": "Building"}
    (folder / "classes.json").write_text(json.dumps(names))
    for index in range(3):
        pandas.DataFrame({"class": classes}).to_pickle(folder / f"{index:02d}.pkl.gz")
    labels = PandaSetLog(sequence).labels(1)
    assert np.array_equal(np.flatnonzero(PandaSetLog(sequence).sweep(1).is_ground), np.flatnonzero(~boxed)[:2])
    assert np.array_equal(labels.category, np.where(classes == 13, 19, 0))
    unknown = [*np.flatnonzero(~boxed)[2:4], np.flatnonzero(boxed)[0]]
    assert np.array_equal(np.flatnonzero(~labels.is_valid), np.sort(unknown))
    pandas.DataFrame({"class": classes[:5]}).to_pickle(folder / "01.pkl.gz")
    with pytest.raises(CFlowError, match="01.pkl.gz has 5 classes for"):
        PandaSetLog(sequence).sweep(1)


def test_data_frames_of_old_pandas_are_read() -> None:
    columns = load_columns(io.BytesIO(gzip.decompress(base64.b64decode(OLD_FRAME))))
    expected = {"x": [1.0, 3.0], "y": [2.0, 4.0], "d": [0, 1], "label": ["Car", "Bus"]}
    assert {name: values.tolist() for name, values in columns.items()} == expected


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (pickle.dumps(["no frame"]), "cannot read"),
        (pickle.dumps(Path("a")), "never executed"),
        (b"", "cannot read"),
    ],
)
def test_other_pickles_are_refused(content: bytes, message: str, sequence: Path) -> None:
    for file in ("lidar/01.pkl.gz", "annotations/cuboids/01.pkl.gz"):
        whole = (sequence / file).read_bytes()
        (sequence / file).write_bytes(gzip.compress(content))
        log: Any = PandaSetLog(sequence)
        with pytest.raises(CFlowError, match=message) as error:
            log.sweep(1), log.labels(0)
        assert str(sequence / file) in str(error.value)
        (sequence / file).write_bytes(whole)


def test_files_without_compression_are_read(sequence: Path) -> None:
    before = [PandaSetLog(sequence).sweep(k).points for k in range(3)]
    flow = PandaSetLog(sequence).labels(0).flow
    for file in list(sequence.rglob("*.pkl.gz")):
        file.with_suffix("").write_bytes(gzip.decompress(file.read_bytes()))
        file.unlink()
    log = PandaSetLog(sequence)
    assert all(np.array_equal(log.sweep(k).points, points) for k, points in enumerate(before))
    assert np.array_equal(log.labels(0).flow, flow)


def test_a_missing_sweep_costs_only_its_pairs(sequence: Path) -> None:
    before = PandaSetLog(sequence).sweep(2)
    (sequence / "lidar" / "01.pkl.gz").rename(sequence / "lidar" / "03.pkl.gz")
    with pytest.raises(CFlowError, match="has 3 sweeps, 3 poses and 3 time stamps"):
        PandaSetLog(sequence)
    (sequence / "lidar" / "03.pkl.gz").unlink()
    log = PandaSetLog(sequence)
    assert len(log) == 3 and np.array_equal(log.sweep(2).points, before.points)
    assert np.array_equal(log.sweep(2).pose, before.pose)
    with pytest.raises(CFlowError, match=r"01.pkl.gz is missing"):
        log.sweep(1)


def test_cameras_have_the_poses_of_their_images(sequence: Path) -> None:
    """The camera is 1 m above the vehicle, looks ahead, and takes its image 20 ms after the sweep."""
    assert PandaSetLog(sequence).cameras(0) == []
    recording = TinyRecording(num_sweeps=3)
    folder = sequence / "camera" / "front_camera"
    folder.mkdir(parents=True)
    T_ego_camera = np.array([[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 1.0], [0, 0, 0, 1]])
    stamps = [stamp + 20_000_000 for stamp in recording.timestamps]
    poses = [recording.pose_at(stamp) @ T_ego_camera for stamp in stamps]
    rows = [
        {"position": dict(zip("xyz", pose[:3, 3])), "heading": dict(zip("wxyz", to_quaternions(pose[None, :3, :3])[0]))}
        for pose in poses
    ]
    (folder / "poses.json").write_text(json.dumps(rows))
    (folder / "timestamps.json").write_text(json.dumps([stamp * 1e-9 for stamp in stamps]))
    (folder / "intrinsics.json").write_text(json.dumps({"fx": 1900.0, "fy": 1910.0, "cx": 960.0, "cy": 540.0}))
    log = PandaSetLog(sequence)
    (camera,) = log.cameras(1)
    assert (camera.name, camera.image, camera.size) == ("front_camera", "01", (1920, 1080))
    assert camera.seconds == pytest.approx(0.02, abs=1e-6)
    sweep = log.sweep(1)
    x, y, z = np.linalg.inv(poses[1])[:3] @ np.column_stack([recording.world(1), np.ones(len(sweep.points))]).T
    np.testing.assert_allclose(camera.see(sweep.points), np.stack([x, y, z], 1), atol=1e-4)
    ahead = z > 1
    pixels = np.stack([1900 * x / z + 960, 1910 * y / z + 540], 1)
    np.testing.assert_allclose(camera.project(camera.see(sweep.points))[ahead], pixels[ahead], rtol=1e-4, atol=0.05)
    (folder / "poses.json").write_text(json.dumps(rows[:2]))
    with pytest.raises(CFlowError, match="2 poses and 3 times of images for 3 sweeps"):
        PandaSetLog(sequence).cameras(0)
