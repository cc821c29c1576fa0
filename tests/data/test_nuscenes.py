"""nuScenes: boxes between samples, the own vehicle, broken files, a real sweep."""

from __future__ import annotations

import json
import shutil
import warnings
from pathlib import Path
from typing import Any, Callable

import numpy as np
import pytest
from tiny_recording import TinyRecording, rigid, turn_z
from writers.nuscenes import write_nuscenes

from cflow_torch.data.arrays.cloud_file import read_cloud
from cflow_torch.data.boxes import category_indices
from cflow_torch.data.categories import CATEGORY_INDEX
from cflow_torch.data.nuscenes.reader import Footprint, NuScenesLog, find_nuscenes_scenes
from cflow_torch.data.nuscenes.tables import Annotations, Tracks
from cflow_torch.transforms import poses_from_quaternions, to_quaternions, transform_points
from cflow_torch.types import CFlowError, CFlowWarning

VERSION = "v1.0-mini"
CAR = CATEGORY_INDEX["REGULAR_VEHICLE"]


def open_log(folder: Path, **settings: Any) -> NuScenesLog:
    (source,) = find_nuscenes_scenes(folder)
    return NuScenesLog(source, **settings)


def edit(folder: Path, table: str, change: Callable[[list[dict[str, Any]]], Any]) -> Path:
    file = folder / VERSION / f"{table}.json"
    rows = json.loads(file.read_text())
    rows = change(rows) or rows
    file.write_text(json.dumps(rows))
    return file


@pytest.fixture
def tiny(tmp_path):
    """Six sweeps, all of them samples."""
    return write_nuscenes(TinyRecording(("LIDAR_TOP",)), tmp_path / "data", key_frame_interval=0.1)


def tracks_of(*boxes: Any) -> Tracks:
    """Boxes (sample, track, x, yaw, length) at samples 0, 1, 2, 3 of 0.5 s."""
    rotation = [[np.cos(yaw / 2), 0, 0, np.sin(yaw / 2)] for _, _, _, yaw, _ in boxes]
    pose = poses_from_quaternions([[x, 0, 0] for _, _, x, _, _ in boxes], rotation, str)
    size = np.array([[length, 2.0, 1.0] for *_, length in boxes]).reshape(-1, 3)
    times = np.array([box[0] * 500_000 for box in boxes], np.int64)
    names = [box[1] for box in boxes]
    return Tracks(np.arange(4) * 500_000, Annotations(times, names, ["vehicle.car"] * len(names), size, pose))


def test_a_box_moves_turns_and_grows_between_samples():
    found, is_known = tracks_of((0, "a", 10.0, 3.0, 4.0), (1, "a", 20.0, -3.0, 5.0)).at(100_000)
    yaw = 3.0 + 0.2 * (2 * np.pi - 6.0)  # the shorter arc, through pi
    np.testing.assert_allclose(found.pose[0, :3, 0], [np.cos(yaw), np.sin(yaw), 0], atol=1e-12)
    np.testing.assert_allclose(found.pose[0, :3, 3], [12, 0, 0], atol=1e-12)
    assert is_known.all() and found.size[0, 0] == pytest.approx(4.2)


def test_an_object_that_one_sample_lacks_is_a_guess():
    tracks = tracks_of((0, "a", 0.0, 0, 4), (1, "a", 5.0, 0, 4), (2, "b", 1.0, 0, 4), (3, "b", 3.0, 0, 4))
    found, is_known = tracks.at(750_000)
    assert found.track == ["a", "b"] and not is_known.any()
    np.testing.assert_allclose(found.pose[:, 0, 3], [7.5, 0.0])  # each continues its motion of the other interval
    alone, _ = tracks_of((1, "a", 5.0, 0, 4), (2, "b", 1.0, 0, 4)).at(750_000)
    np.testing.assert_allclose(alone.pose[:, 0, 3], [5.0, 1.0])  # their motion is unknown
    assert tracks.at(500_000)[0].track == ["a"] and tracks.at(500_000)[1].all()
    assert not tracks.at(-1)[0].track and not tracks.at(1_500_001)[0].track and not tracks_of().at(0)[0].track


def test_points_of_a_half_known_object_are_not_valid(tmp_path):
    recording = TinyRecording(("LIDAR_TOP",))
    on_car = recording.is_on_car()
    for interval, gone, index in ((0.2, 2, 3), (0.3, 1, 1)):  # guessed in one of the two sweeps, and in both
        folder = write_nuscenes(recording, tmp_path / str(gone), key_frame_interval=interval)
        assert open_log(folder, own_vehicle=None).labels(index).is_valid.all()
        lost = [row["token"] for row in json.loads((folder / VERSION / "sample.json").read_text())][:gone]
        edit(folder, "sample_annotation", lambda rows, lost=lost: [r for r in rows if r["sample_token"] not in lost])
        labels = open_log(folder, own_vehicle=None).labels(index)
        assert ((labels.category == CAR) <= ~labels.is_valid).all() and (labels.category[on_car] == CAR).any()
    for table in ("sample_annotation", "instance", "category"):
        edit(folder, table, lambda rows: rows.clear())
    log = open_log(folder)
    assert all(log.labels(index) is None for index in range(len(log))) and len(log.sweep(0).points) == 40


def test_every_second_sweep_keeps_the_samples(tmp_path):
    recording = TinyRecording(("LIDAR_TOP",), num_sweeps=8, interval_ns=50_000_000)
    folder = write_nuscenes(recording, tmp_path, key_frame_interval=0.15)  # samples 0, 3, 6, 7
    stamps = [stamp // 1000 * 1000 for stamp in recording.timestamps]
    assert list(open_log(folder).timestamps) == stamps
    thinned = open_log(folder, sweep_step=2, own_vehicle=None)
    assert list(thinned.timestamps) == [stamps[i] for i in (0, 2, 3, 5, 6, 7)]
    points = thinned.sweep(0).points.astype(float)[~recording.is_on_car()]
    expected = transform_points(points, np.linalg.inv(recording.poses[2]) @ recording.poses[0]) - points
    np.testing.assert_allclose(thinned.labels(0).flow[~recording.is_on_car()], expected, atol=1e-5)
    with pytest.raises(CFlowError, match="sweep_step=0"):
        open_log(folder, sweep_step=0)


def test_own_vehicle_and_missing_returns_are_removed(tiny):
    file = min((tiny / "samples" / "LIDAR_TOP").iterdir())
    edit(tiny, "calibrated_sensor", lambda rows: rows[0].update(translation=[0.9, 0, 1.8], rotation=[1, 0, 0, 0]))
    rows = np.zeros((6, 5), "<f4")
    # Bonnet, boot, next to the car, in front of it, no return, not a number.
    rows[:, :3] = [[1, 0.5, -1], [-1.9, 0, -1], [0, 0.9, -1], [2.5, 0, -1], [0, 0, 0], [np.nan, 1, 1]]
    rows.tofile(file)
    kept = open_log(tiny).sweep(0).points
    np.testing.assert_allclose(kept, [[0.9, 0.9, 0.8], [3.4, 0, 0.8]], atol=1e-6)
    assert len(open_log(tiny, own_vehicle=None).sweep(0).points) == 4
    assert len(open_log(tiny, own_vehicle=Footprint(-5, 5, 5)).labels(0).flow) == 0
    with pytest.raises(CFlowError, match=r"no LiDAR \['THIRD'\]; it has \['LIDAR_TOP'\]"):
        open_log(tiny, lidars=["THIRD"])


def test_scenes_of_a_version_share_their_tables(tiny, tmp_path):
    second = write_nuscenes(TinyRecording(("LIDAR_TOP",), num_sweeps=4, log_id="second"), tmp_path / "data")
    assert [source.name for source in find_nuscenes_scenes(tmp_path)] == ["second", "tiny"]
    for file in (second / VERSION).iterdir():  # two scenes of one version, as in the real data set
        if file.stem not in ("visibility", "attribute"):
            edit(tiny, file.stem, lambda rows, file=file: rows + json.loads(file.read_text()))
    for kind in ("samples", "sweeps"):
        shutil.copytree(second / kind, tiny / kind, dirs_exist_ok=True)
    for root in (tiny, tiny / VERSION):
        sources = find_nuscenes_scenes(root)
        assert [(source.root, source.version, source.name) for source in sources] == [
            (tiny, VERSION, name) for name in ("second", "tiny")
        ]
    first = NuScenesLog(sources[1])
    for file in (tiny / VERSION).iterdir():
        file.unlink()
    log = NuScenesLog(sources[0])
    assert (first.log_id, len(first), log.log_id, len(log)) == ("tiny", 6, "second", 4)


@pytest.mark.parametrize(
    ("table", "change", "complaint"),
    [
        ("sample_data", {"ego_pose_token": "x"}, "cannot read .*tiny .KeyError: 'x'"),
        ("sample_data", {"timestamp": 1_533_279_682_100_000}, "sample_data.json has two rows .*one time"),
        ("sample_data", {"timestamp": "noon"}, "cannot read .*tiny"),
        ("sample_data", lambda rows: {"token": "a"}, "cannot read .*sample_data.json .*KeyError"),
        ("sample_data", lambda rows: [1, 2], "cannot read .*sample_data.json .*not a list of rows"),
        ("sample_data", lambda rows: rows[:1], "has 1 sweeps"),
        ("ego_pose", {"rotation": [0.9, 0, 0, 0]}, "ego_pose.json: .* is not a rigid motion"),
        ("ego_pose", {"translation": [1, 2, float("nan")]}, "ego_pose.json: .* is not a rigid motion"),
        ("sample_annotation", {"size": ["a", 1, 1]}, "cannot read .*tiny"),
        ("sensor", {"modality": "camera"}, "has no LiDAR"),
    ],
)
def test_inconsistent_tables_are_refused(tiny, table, change, complaint):
    edit(tiny, table, (lambda rows: rows[0].update(change)) if isinstance(change, dict) else change)
    with pytest.raises(CFlowError, match=complaint):
        open_log(tiny)


def test_boxes_of_unknown_categories_have_none(tiny):
    """As those of Lyft Level 5, whose tables have the form of nuScenes'."""
    known = open_log(tiny).labels(0)
    edit(tiny, "category", lambda rows: [{**row, "name": "spaceship"} for row in rows])
    with pytest.warns(CFlowWarning, match="do not know the category spaceship of .* as background"):
        labels = open_log(tiny).labels(0)
    assert known.category.any() and not labels.category.any() and np.array_equal(labels.flow, known.flow)


def test_an_unknown_category_is_said_once(recwarn):
    warnings.simplefilter("default")
    for names in (["ufo"], ["car", "ufo", "kite"], ["kite"]):
        category_indices(names, {"car": "REGULAR_VEHICLE"})
    assert [str(each.message).split()[6] for each in recwarn] == ["ufo", "kite"]


def test_two_scenes_of_one_name_are_an_error(tiny):
    edit(tiny, "scene", lambda rows: rows + rows[:1])
    with pytest.raises(CFlowError, match="scenes but 1 names"):
        find_nuscenes_scenes(tiny)


def test_a_missing_sweep_is_named(tiny):
    min((tiny / "samples" / "LIDAR_TOP").iterdir()).unlink()
    with pytest.raises(CFlowError, match=r"\.bin is missing; copy"):
        open_log(tiny).sweep(0)


def test_a_bad_sweep_costs_no_other(tiny):
    file = min((tiny / "samples" / "LIDAR_TOP").iterdir())
    whole, log = file.read_bytes(), open_log(tiny)
    kitti = np.random.default_rng(0).uniform(-50, 50, (100, 4)).astype("<f4").tobytes()  # four columns: 1600 bytes
    for content, complaint in [(whole[:-1], "multiple of"), (b"", "is empty"), (kitti, "not a ring index")]:
        file.write_bytes(content)
        with pytest.raises(CFlowError, match=f"{file.name}.*{complaint}"):
            log.sweep(0)
    assert len(log.sweep(1).points) == 40


def test_a_real_sweep_is_read(data_root: Path, tmp_path: Path) -> None:
    folder = data_root / "real-files" / "nuscenes"
    if not folder.is_dir():
        pytest.skip(f"no real sweep at {folder}")
    (file,) = folder.iterdir()
    points = read_cloud(file, bin_columns=5)
    assert points.shape == (34_688, 3) and points.dtype == np.float32
    elevation = np.degrees(np.arctan2(points[:, 2], np.hypot(points[:, 0], points[:, 1])))
    far = np.linalg.norm(points, axis=1) > 2.5
    assert -31 < elevation[far].min() < -29 and 10 < elevation[far].max() < 11  # HDL-32E
    # A quarter of the points lies on the vehicle itself. Only these are removed: the next return is 3 m away.
    recording = TinyRecording(("LIDAR_TOP",))
    recording.mounts["LIDAR_TOP"] = rigid(turn_z(-np.pi / 2), (0.943713, 0.0, 1.84023))  # as in the data set
    data = write_nuscenes(recording, tmp_path / "data", key_frame_interval=0.1)
    min((data / "samples" / "LIDAR_TOP").iterdir()).write_bytes(file.read_bytes())
    kept = open_log(data).sweep(0).points
    assert len(kept) == 34_688 - 8_526
    assert np.linalg.norm(kept - [0.943713, 0.0, 1.84023], axis=1).min() > 3
    assert len(open_log(data, own_vehicle=None).sweep(0).points) == 34_688


def test_a_scene_with_key_frames_only_names_the_setting(tmp_path):
    folder = write_nuscenes(TinyRecording(("LIDAR_TOP",), num_sweeps=11), tmp_path / "data", key_frame_interval=0.5)
    complete = open_log(folder, sweep_step=5)
    points = [sweep.points for sweep in complete]
    (folder / "sweeps").rename(tmp_path / "elsewhere")
    with pytest.raises(CFlowError, match=r"only its key frames .* data\.sweep_step=5"):
        open_log(folder)
    log = open_log(folder, sweep_step=5)
    assert len(log) == 3 and all(map(np.array_equal, points, [sweep.points for sweep in log]))
    (folder / "samples").rename(tmp_path / "other")
    with pytest.raises(CFlowError, match="its files are not in"):
        open_log(folder)


def test_cameras_have_the_pose_of_their_nearest_image(tiny):
    """A camera takes images 30 ms after each sweep. The vehicle drives and turns in between."""
    assert open_log(tiny).cameras(0) == []
    recording = TinyRecording(("LIDAR_TOP",))
    T_ego_camera = rigid(turn_z(0.2) @ np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]]), [1.5, 0.1, 1.6])
    matrix = np.array([[1260.0, 0, 816], [0, 1270, 491], [0, 0, 1]])
    stamps = [stamp + 30_000_000 for stamp in recording.timestamps]

    def row_of(pose):
        return {"translation": pose[:3, 3].tolist(), "rotation": to_quaternions(pose[None, :3, :3])[0].tolist()}

    mount = {"token": "m", "sensor_token": "c", **row_of(T_ego_camera), "camera_intrinsic": matrix.tolist()}
    edit(tiny, "sensor", lambda rows: [*rows, {"token": "c", "channel": "CAM_FRONT", "modality": "camera"}])
    edit(tiny, "calibrated_sensor", lambda rows: [*rows, mount])
    poses = [{"token": f"p{k}", "timestamp": 0, **row_of(recording.pose_at(t))} for k, t in enumerate(stamps)]
    edit(tiny, "ego_pose", lambda rows: [*rows, *poses])
    samples = [row["token"] for row in json.loads((tiny / VERSION / "sample.json").read_text())]
    same = {"calibrated_sensor_token": "m", "is_key_frame": True, "width": 1600, "height": 900}
    images = [
        {"sample_token": sample, "ego_pose_token": f"p{k}", "timestamp": t // 1000, "filename": f"x/a__{k}.jpg", **same}
        for k, (sample, t) in enumerate(zip(samples, stamps))
    ]
    edit(tiny, "sample_data", lambda rows: [*rows, *images])
    log = open_log(tiny)
    (camera,) = log.cameras(2)
    assert (camera.name, camera.image, camera.size) == ("CAM_FRONT", "a__2", (1600, 900))
    assert camera.seconds == pytest.approx(0.03)
    sweep = log.sweep(2)
    in_world = transform_points(sweep.points, sweep.pose)
    x, y, z = transform_points(in_world, np.linalg.inv(recording.pose_at(stamps[2]) @ T_ego_camera)).T
    np.testing.assert_allclose(camera.see(sweep.points), np.stack([x, y, z], 1), atol=1e-6)
    pixels = np.stack([1260 * x / z + 816, 1270 * y / z + 491], 1)
    ahead = z > 1
    np.testing.assert_allclose(camera.project(camera.see(sweep.points))[ahead], pixels[ahead], atol=1e-3)
