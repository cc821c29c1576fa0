"""nuScenes: simulator -> files -> reader, boxes between samples, broken files, and the official devkit where it is."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any, Callable, Dict, List

import numpy as np
import pytest
from scipy.spatial.transform import Rotation, Slerp
from tiny_recording import CAR_SIZE, TRACKS, TinyRecording

from cflow_torch.data.boxes import Boxes, flow_from_boxes, points_in_box
from cflow_torch.data.log import window
from cflow_torch.data.nuscenes.reader import Footprint, NuScenesLog, find_nuscenes_scenes, read_pcd_bin
from cflow_torch.data.nuscenes.tables import Annotations, SceneSource
from cflow_torch.data.nuscenes.tracks import Tracks
from cflow_torch.data.categories import CATEGORY_INDEX, meta_class
from cflow_torch.simulator import make_drive
from cflow_torch.simulator.writers import nuscenes as nuscenes_writer
from cflow_torch.simulator.writers.nuscenes import write_nuscenes
from cflow_torch.types import CFlowError

VERSION = "v1.0-mini"
NAMES = {"BICYCLIST": "BICYCLE", "TRUCK_CAB": "TRUCK"}  # what the format's own categories come back as


def open_log(folder: Path, **settings: Any) -> NuScenesLog:
    (source,) = find_nuscenes_scenes(folder)
    return NuScenesLog(source, **settings)


def exact_boxes(recording: Any, index: int) -> Boxes:
    """The recording's own boxes, with the categories that the format has."""
    boxes = recording.boxes(index)
    category = [CATEGORY_INDEX[NAMES.get(name, name)] for name in boxes.category]
    return Boxes(boxes.track_id, np.array(category, np.uint8), boxes.size, boxes.pose)


def box_in_world(recording: Any, index: int, track: str) -> np.ndarray:
    boxes = recording.boxes(index)
    return recording.poses[index] @ boxes.pose[list(boxes.track_id).index(track)]


def edit(folder: Path, table: str, change: Callable[[List[Dict[str, Any]]], Any]) -> Path:
    file = folder / VERSION / f"{table}.json"
    rows = json.loads(file.read_text())
    rows = change(rows) or rows
    file.write_text(json.dumps(rows))
    return file


@pytest.fixture(scope="module")
def drive():
    return make_drive(seed=2, num_sweeps=11, profile="demo")


@pytest.fixture(scope="module")
def folder(drive, tmp_path_factory):
    return write_nuscenes(drive, tmp_path_factory.mktemp("nuscenes"))


@pytest.fixture
def tiny(tmp_path):
    """Six sweeps, all of them samples."""
    return write_nuscenes(TinyRecording(("LIDAR_TOP",)), tmp_path / "data", key_frame_interval=0.1)


# ---------------------------------------------------------------------------------------------- round trip


@pytest.mark.parametrize("profile", ["nuscenes", "av2"])
def test_points_and_poses_come_back(profile, tmp_path):
    """One LiDAR that was de-skewed, and two. Points differ by the float32 rounding of one rotation: 2e-5 m at 200 m."""
    drive = make_drive(seed=1, num_sweeps=3, profile=profile)
    log = open_log(write_nuscenes(drive, tmp_path), own_vehicle=None)
    assert log.log_id == drive.log_id and len(log) == 3
    assert list(log.timestamps) == [stamp // 1000 for stamp in drive.timestamps]
    for index, stamp in enumerate(drive.timestamps):
        sweep, true = log.sweep(index), drive.sweep(index)
        assert sweep.points.dtype == np.float32 and sweep.pose.dtype == np.float64 and sweep.is_ground is None
        assert sweep.points.shape == true.points.shape
        assert np.abs(sweep.points - true.points).max() < 5e-5
        assert np.abs(sweep.pose - drive.poses[index]).max() < 1e-12
        assert sweep.timestamp_ns == stamp
    assert len(window(log, 1, 4).pch) == 1


def test_what_is_stored(drive, folder):
    """float32 x, y, z, intensity, ring in the frame of the LiDAR; samples and sweeps in their folders."""
    assert sorted(os.listdir(folder)) == ["maps", "samples", "sweeps", VERSION]
    samples, sweeps = ([*(folder / kind / "LIDAR_TOP").iterdir()] for kind in ("samples", "sweeps"))
    assert (len(samples), len(sweeps)) == (3, 8)
    (unit,) = drive.units(0)
    rows = np.fromfile(min(samples), "<f4").reshape(-1, 5)
    assert np.array_equal(rows[:, :3], unit.points)
    assert np.array_equal(rows[:, 3], unit.intensity) and np.array_equal(rows[:, 4], unit.ring)
    assert rows[:, 4].min() == 0 and rows[:, 4].max() == 31
    lowest, highest = (rows[rows[:, 4] == ring] for ring in (0, 31))
    assert lowest[:, 2].max() < 0 < highest[:, 2].min()


def test_what_the_tables_say(tmp_path):
    """Orders that a reader of one's own would forgive: width before length, scalar first, the sample that follows."""
    recording = TinyRecording(("LIDAR_TOP",))
    folder = write_nuscenes(recording, tmp_path, key_frame_interval=0.2)  # samples 0, 2, 4, 5
    tables = {file.stem: json.loads(file.read_text()) for file in (folder / VERSION).iterdir()}
    assert len(tables) == 13 and (folder / tables["map"][0]["filename"]).is_file()
    box = tables["sample_annotation"][0]
    assert box["size"] == [CAR_SIZE[1], CAR_SIZE[0], CAR_SIZE[2]]
    np.testing.assert_allclose(box["rotation"], [np.cos(0.6), 0, 0, np.sin(0.6)], atol=1e-12)
    np.testing.assert_allclose(box["translation"], recording.car_at(recording.timestamps[0])[:3, 3], atol=1e-9)
    order = {row["token"]: number for number, row in enumerate(tables["sample"])}
    assert [order[row["sample_token"]] for row in tables["sample_data"]] == [0, 1, 1, 2, 2, 3]
    assert [row["is_key_frame"] for row in tables["sample_data"]] == [True, False, True, False, True, True]
    assert all((folder / row["filename"]).is_file() for row in tables["sample_data"])
    scene = tables["scene"][0]
    assert (order[scene["first_sample_token"]], order[scene["last_sample_token"]]) == (0, 3)
    assert [row["nbr_annotations"] for row in tables["instance"]] == [4, 4]


def test_labels_at_samples_are_exact(drive, tmp_path):
    log = open_log(write_nuscenes(drive, tmp_path, key_frame_interval=0.1))
    for index in (0, 6, 9):
        labels, points = log.labels(index), log.sweep(index).points
        T = np.linalg.inv(drive.poses[index + 1]) @ drive.poses[index]
        exact = flow_from_boxes(points, exact_boxes(drive, index), exact_boxes(drive, index + 1), T)
        assert np.abs(labels.flow - exact.flow).max() < 1e-5
        assert np.array_equal(labels.category, exact.category) and np.array_equal(labels.is_valid, exact.is_valid)
        assert len(np.unique(labels.category)) > 3
    assert log.labels(10) is None


def test_labels_agree_with_what_each_ray_hit(drive, folder):
    """Boxes at 2 Hz against the simulator's own truth of every point; boxes also hold the wall beside a pedestrian."""
    log = open_log(folder, own_vehicle=None)
    for index in (0, 3, 9):
        labels, true = log.labels(index), drive.labels(index)
        on_object = (true.category > 0) & true.is_valid
        same = meta_class(labels.category[on_object]) == meta_class(true.category[on_object])
        assert on_object.sum() > 2000 and same.mean() > 0.995
        assert labels.is_valid[on_object].mean() > 0.99


def test_labels_between_samples(drive, folder):
    """Boxes as scipy interpolates them, and as near to where they are as their acceleration allows."""
    log = open_log(folder)
    index, keys = 3, (0, 5)
    labels, points = log.labels(index), log.sweep(index).points
    ends = [exact_boxes(drive, key) for key in keys]
    world = [drive.poses[key] @ boxes.pose for key, boxes in zip(keys, ends)]
    both = [track for track in ends[0].track_id if track in ends[1].track_id]
    rows = [[list(boxes.track_id).index(track) for track in both] for boxes in ends]
    between, exact = [], []
    for now in (index, index + 1):
        pose = np.tile(np.eye(4), (len(both), 1, 1))
        for k, (a, b) in enumerate(zip(*rows)):
            turn = Slerp([0, 5], Rotation.from_matrix([world[0][a, :3, :3], world[1][b, :3, :3]]))
            pose[k, :3, :3] = turn(now).as_matrix()
            pose[k, :3, 3] = world[0][a, :3, 3] + now / 5 * (world[1][b, :3, 3] - world[0][a, :3, 3])
        inverse = np.linalg.inv(drive.poses[now])
        between.append(Boxes(both, ends[0].category[rows[0]], ends[0].size[rows[0]], inverse @ pose))
        exact.append(exact_boxes(drive, now))
    T = np.linalg.inv(drive.poses[index + 1]) @ drive.poses[index]
    expected = flow_from_boxes(points, *between, T)
    same = labels.category == expected.category
    assert same.mean() > 0.9999 and np.abs(labels.flow - expected.flow)[same].max() < 1e-5
    # Right at both ends of 0.5 s, a point of acceleration a is between them at most a 0.5 s / 2 too fast or slow; the
    # flow is as much off in 0.1 s. Twice that: interpolation makes the corners of a turning box accelerate as well.
    moving = 0
    for k, (track, row) in enumerate(zip(both, rows[0])):
        corners = np.array([[x, y, 0, 1] for x in (-1, 1) for y in (-1, 1)]) * [*ends[0].size[row] / 2, 1]
        ways = np.stack([box_in_world(drive, now, track) @ corners.T for now in range(6)])[:, :3]
        acceleration = np.linalg.norm(np.diff(ways, 2, axis=0), axis=1).max() / 0.1**2
        motion = [
            boxes[1].pose[at[1]] @ np.linalg.inv(boxes[0].pose[at[0]])
            for boxes, at in ((between, (k, k)), (exact, [list(e.track_id).index(track) for e in exact]))
        ]
        inside = points[points_in_box(points, between[0].size[k], between[0].pose[k])].astype(float)
        off = np.linalg.norm(inside @ (motion[0] - motion[1])[:3, :3].T + (motion[0] - motion[1])[:3, 3], axis=1)
        assert (off < 2 * acceleration * 0.5 / 2 * 0.1 + 1e-6).all(), track
        moving += bool(len(inside) and np.linalg.norm(ways[1] - ways[0], axis=0).max() > 0.1)
    assert moving > 3


# ---------------------------------------------------------------------------------------------- boxes in time


def tracks_of(*boxes: Any) -> Tracks:
    """Boxes (sample, track, x, yaw, length) at samples 0, 1, 2, 3 of 0.5 s."""
    pose = np.array([[x, 0, 0, np.cos(yaw / 2), 0, 0, np.sin(yaw / 2)] for _, _, x, yaw, _ in boxes]).reshape(-1, 7)
    size = np.array([[length, 2.0, 1.0] for *_, length in boxes]).reshape(-1, 3)
    times = np.array([box[0] * 500_000 for box in boxes], np.int64)
    names = [box[1] for box in boxes]
    return Tracks(np.arange(4) * 500_000, Annotations(times, names, ["vehicle.car"] * len(names), size, pose))


def test_a_box_moves_turns_and_grows_between_samples():
    found = tracks_of((0, "a", 10.0, 3.0, 4.0), (1, "a", 20.0, -3.0, 5.0)).at(100_000)
    yaw = 3.0 + 0.2 * (2 * np.pi - 6.0)  # the shorter way, through pi
    np.testing.assert_allclose(found.pose[0, :3, 0], [np.cos(yaw), np.sin(yaw), 0], atol=1e-12)
    np.testing.assert_allclose(found.pose[0, :3, 3], [12, 0, 0], atol=1e-12)
    assert found.is_known.all() and found.size[0, 0] == pytest.approx(4.2)


def test_an_object_that_one_sample_lacks_is_a_guess():
    tracks = tracks_of((0, "a", 0.0, 0, 4), (1, "a", 5.0, 0, 4), (2, "b", 1.0, 0, 4), (3, "b", 3.0, 0, 4))
    found = tracks.at(750_000)
    assert found.track == ("a", "b") and not found.is_known.any()
    np.testing.assert_allclose(found.pose[:, 0, 3], [7.5, 0.0])  # each goes on as on its other side
    alone = tracks_of((1, "a", 5.0, 0, 4), (2, "b", 1.0, 0, 4)).at(750_000)
    np.testing.assert_allclose(alone.pose[:, 0, 3], [5.0, 1.0])  # nothing tells how they move
    assert tracks.at(500_000).track == ("a",) and tracks.at(500_000).is_known.all()


def test_no_boxes_outside_the_samples():
    tracks = tracks_of((0, "a", 0.0, 0, 4), (1, "a", 5.0, 0, 4))
    assert tracks.at(-1) is None and tracks.at(1_500_001) is None and tracks_of().at(0) is None
    assert tracks.at(1_200_000).track == ()
    with pytest.raises(CFlowError, match="instance a twice"):
        tracks_of((0, "a", 0.0, 0, 4), (0, "a", 5.0, 0, 4))


def test_points_of_a_half_known_object_are_not_valid(tmp_path):
    recording = TinyRecording(("LIDAR_TOP",))
    folder = write_nuscenes(recording, tmp_path, key_frame_interval=0.2)  # samples 0, 2, 4, 5
    on_car = recording.is_on_car()
    log = open_log(folder, own_vehicle=None)
    car = CATEGORY_INDEX["REGULAR_VEHICLE"]
    before = log.labels(1)
    assert before.is_valid.all() and (before.category[on_car] == car).any()
    samples = json.loads((folder / VERSION / "sample.json").read_text())
    stays = [row["token"] for row in samples if row["timestamp"] > recording.timestamps[2] // 1000]
    edit(folder, "sample_annotation", lambda rows: [row for row in rows if row["sample_token"] in stays])
    log = open_log(folder, own_vehicle=None)
    labels = log.labels(3)  # sweep 3 lies between sample 2, which lost its boxes, and sample 4
    assert ((labels.category == car) <= ~labels.is_valid).all() and (labels.category[on_car] == car).any()
    assert log.labels(4).is_valid.all()
    folder = write_nuscenes(recording, tmp_path / "sparse", key_frame_interval=0.3)  # samples 0, 3, 5
    first = json.loads((folder / VERSION / "sample.json").read_text())[0]["token"]
    edit(folder, "sample_annotation", lambda rows: [row for row in rows if row["sample_token"] != first])
    labels = open_log(folder, own_vehicle=None).labels(1)  # both sweeps lie between: two guesses make no truth
    assert ((labels.category == car) <= ~labels.is_valid).all() and (labels.category[on_car] == car).any()


def test_a_scene_without_annotations_has_no_labels(tiny):
    for table in ("sample_annotation", "instance", "category"):
        edit(tiny, table, lambda rows: rows.clear())
    log = open_log(tiny)
    assert all(log.labels(index) is None for index in range(len(log)))
    assert len(log.sweep(0).points) == 40


# ---------------------------------------------------------------------------------------------- choices


def test_every_second_sweep_keeps_the_samples(tmp_path):
    recording = TinyRecording(("LIDAR_TOP",), num_sweeps=8, interval_ns=50_000_000)
    folder = write_nuscenes(recording, tmp_path, key_frame_interval=0.15)  # samples 0, 3, 6, 7
    stamps = [stamp // 1000 for stamp in recording.timestamps]
    assert list(open_log(folder).timestamps) == stamps
    assert list(open_log(folder, sweep_step=2).timestamps) == [stamps[i] for i in (0, 2, 3, 5, 6, 7)]
    thinned = open_log(folder, sweep_step=2, own_vehicle=None)
    np.testing.assert_allclose(thinned.sweep(1).pose, recording.poses[2], atol=1e-12)
    T = np.linalg.inv(recording.poses[2]) @ recording.poses[0]
    points = thinned.sweep(0).points.astype(float)[~recording.is_on_car()]
    np.testing.assert_allclose(
        thinned.labels(0).flow[~recording.is_on_car()], points @ T[:3, :3].T + T[:3, 3] - points, atol=1e-5
    )
    with pytest.raises(CFlowError, match="sweep_step=0"):
        open_log(folder, sweep_step=0)


def test_own_vehicle_and_shots_without_return_are_removed(tiny):
    file = min((tiny / "samples" / "LIDAR_TOP").iterdir())
    edit(tiny, "calibrated_sensor", lambda rows: rows[0].update(translation=[0.9, 0, 1.8], rotation=[1, 0, 0, 0]))
    rows = np.zeros((6, 5), "<f4")
    # Bonnet, boot, beside the car, ahead of it, no return, no number.
    rows[:, :3] = [[1, 0.5, -1], [-1.9, 0, -1], [0, 0.9, -1], [2.5, 0, -1], [0, 0, 0], [np.nan, 1, 1]]
    rows.tofile(file)
    kept = open_log(tiny).sweep(0).points
    np.testing.assert_allclose(kept, [[0.9, 0.9, 0.8], [3.4, 0, 0.8]], atol=1e-6)
    assert len(open_log(tiny, own_vehicle=None).sweep(0).points) == 4
    assert len(open_log(tiny, own_vehicle=Footprint(-5, 5, 5)).sweep(0).points) == 0
    assert len(open_log(tiny, own_vehicle=Footprint(-5, 5, 5)).labels(0).flow) == 0


def test_lidars_are_chosen_by_channel(tmp_path):
    recording = TinyRecording(("LIDAR_TOP", "SECOND"))
    folder = write_nuscenes(recording, tmp_path)
    assert len(open_log(folder, own_vehicle=None).sweep(0).points) == 80
    one = open_log(folder, lidars=["SECOND"], own_vehicle=None).sweep(0).points
    np.testing.assert_allclose(one, recording.sweep(0).points[40:], atol=1e-5)
    with pytest.raises(CFlowError, match=r"no LiDAR \['THIRD'\]; it has \['LIDAR_TOP', 'SECOND'\]"):
        open_log(folder, lidars=["THIRD"])


def test_finding_scenes(tiny, tmp_path):
    write_nuscenes(TinyRecording(("LIDAR_TOP",), log_id="other"), tmp_path / "data")
    assert [source.name for source in find_nuscenes_scenes(tmp_path)] == ["other", "tiny"]
    for root in (tiny, tiny / VERSION):
        (source,) = find_nuscenes_scenes(root)
        assert (source.root, source.version, source.scene) == (tiny, VERSION, "tiny")
    assert len(NuScenesLog(SceneSource(tiny, VERSION, "tiny"))) == 6
    (tmp_path / "empty").mkdir()
    assert find_nuscenes_scenes(tmp_path / "empty") == []
    with pytest.raises(CFlowError, match="nowhere is no folder"):
        find_nuscenes_scenes(tmp_path / "nowhere")


def test_tables_are_read_once_and_points_when_asked_for(tiny, tmp_path):
    """Two scenes of one version, as in the real data set."""
    second = write_nuscenes(TinyRecording(("LIDAR_TOP",), num_sweeps=4, log_id="second"), tmp_path)
    for file in (second / VERSION).iterdir():
        if file.stem not in ("category", "visibility", "attribute"):
            edit(tiny, file.stem, lambda rows, file=file: rows + json.loads(file.read_text()))
    edit(tiny, "category", lambda rows: rows + json.loads((second / VERSION / "category.json").read_text()))
    for file in (second / "samples" / "LIDAR_TOP").iterdir():
        file.rename(tiny / "samples" / "LIDAR_TOP" / file.name)
    sources = find_nuscenes_scenes(tiny)
    first = NuScenesLog(sources[1])
    for file in (tiny / VERSION).iterdir():
        file.unlink()
    log = NuScenesLog(sources[0])
    assert (first.log_id, len(first), log.log_id, len(log)) == ("tiny", 6, "second", 4)
    assert len(log.sweep(0).points) == 40
    for file in (tiny / "samples" / "LIDAR_TOP").iterdir():
        file.unlink()
    with pytest.raises(CFlowError, match="is missing"):
        first.sweep(0)


# ---------------------------------------------------------------------------------------------- broken files

TABLES = ("scene", "sample", "sensor", "calibrated_sensor", "sample_data", "ego_pose", "category", "instance")


@pytest.mark.parametrize("table", [*TABLES, "sample_annotation"])
def test_missing_truncated_and_foreign_tables(tiny, table):
    file = tiny / VERSION / f"{table}.json"
    whole = file.read_bytes()
    for content, complaint in [
        (whole[: len(whole) // 2], "cannot read .* truncated"),
        (b"", "cannot read .* truncated"),
        (b"\x80\x04\x95 pickle", "cannot read"),
        (b'{"token": "a"}', "lacks|no list of rows"),
        (b"[1, 2]", "no list of rows"),
        (b'[{"a": 1}]', r"a row lacks \["),
        ((tiny / VERSION / "visibility.json").read_bytes(), r"a row lacks \["),
    ]:
        file.write_bytes(content)
        with pytest.raises(CFlowError, match=complaint) as error:
            open_log(tiny)
        assert file.name in str(error.value)
    file.unlink()
    if table == "scene":
        assert find_nuscenes_scenes(tiny) == []
        with pytest.raises(CFlowError, match=r"scene.json is missing"):
            NuScenesLog(SceneSource(tiny, VERSION, "tiny"))
    else:
        with pytest.raises(CFlowError, match=f"{file.name} is missing"):
            open_log(tiny)


@pytest.mark.parametrize(
    ("table", "change", "complaint"),
    [
        ("sample_data", {"ego_pose_token": "x"}, "sample_data.json names ego_pose 'x'"),
        ("sample_data", {"sample_token": "x"}, "sample_data.json names sample 'x'"),
        ("sample_data", {"next": "x"}, "sample_data.json: tiny, LIDAR_TOP: a sweep's next is x"),
        ("sample_data", {"prev": "x"}, "sample_data.json: tiny, LIDAR_TOP: prev and next do not chain"),
        ("sample_data", {"timestamp": 9_000_000_000_000_000}, "sample_data.json: .* in the order of time"),
        ("sample_data", {"timestamp": 1.5}, "sample_data.json: the field timestamp of a row is 1.5"),
        ("sample_data", {"is_key_frame": 1}, "sample_data.json: the field is_key_frame"),
        ("sample_data", {"calibrated_sensor_token": "x"}, "sample_data.json: tiny, LIDAR_TOP: "),
        ("sample", {"timestamp": 1_533_279_682_100_000}, "sample.json has two samples of tiny at one time"),
        ("ego_pose", {"rotation": [0.9, 0, 0, 0]}, "ego_pose.json: .* is no rigid motion"),
        ("ego_pose", {"translation": [1, 2]}, "ego_pose.json: the field translation"),
        ("ego_pose", {"translation": [1, 2, float("nan")]}, "ego_pose.json: the field translation"),
        ("calibrated_sensor", {"rotation": [0, 0, 0, 0]}, "calibrated_sensor.json: .* is no rigid motion"),
        ("sample_annotation", {"instance_token": "x"}, "sample_annotation.json names instance 'x'"),
        ("sample_annotation", {"size": ["a", 1, 1]}, "sample_annotation.json: the field size"),
        ("instance", {"category_token": "x"}, "instance.json names category 'x'"),
        ("sensor", {"modality": "camera"}, "has no LiDAR"),
    ],
)
def test_rows_that_contradict_each_other(tiny, table, change, complaint):
    edit(tiny, table, lambda rows: rows[0].update(change))
    with pytest.raises(CFlowError, match=complaint):
        open_log(tiny)


def test_unknown_category_and_too_few_sweeps(tiny, tmp_path):
    def rename(rows):
        for row in rows:
            row["name"] = row["name"].replace("vehicle.car", "vehicle.spaceship")

    edit(tiny, "category", rename)
    with pytest.raises(CFlowError, match="vehicle.spaceship"):
        open_log(tiny)
    with pytest.raises(CFlowError, match="has 1 sweeps"):
        open_log(write_nuscenes(TinyRecording(("LIDAR_TOP",), num_sweeps=1), tmp_path / "one"))
    with pytest.raises(CFlowError, match="no scene 'scene-0061'"):
        NuScenesLog(SceneSource(tiny, VERSION, "scene-0061"))
    with pytest.raises(CFlowError, match="asked for 6"):
        open_log(write_nuscenes(TinyRecording(), tmp_path / "two")).sweep(6)


def test_bad_sweeps(tiny):
    file = min((tiny / "samples" / "LIDAR_TOP").iterdir())
    whole = file.read_bytes()
    kitti = np.random.default_rng(0).uniform(-50, 50, (100, 4)).astype("<f4").tobytes()  # four columns: 1600 bytes
    log = open_log(tiny)
    for content, complaint in [
        (whole[:-1], "no whole number of rows"),
        (whole[: len(whole) // 2 - 10], "no whole number of rows"),
        (b"", "0 bytes"),
        (kitti, "no ring 0 ... 255"),
    ]:
        file.write_bytes(content)
        with pytest.raises(CFlowError, match=complaint) as error:
            log.sweep(0)
        assert file.name in str(error.value)
    assert len(log.sweep(1).points) == 40
    file.unlink()
    with pytest.raises(CFlowError, match=f"{file.name} is missing; copy"):
        log.sweep(0)


def test_truckscenes_is_refused(tiny):
    (tiny / VERSION / "ego_motion_cabin.json").write_text("[]")
    with pytest.raises(CFlowError, match="is not nuScenes: .* choose the other reader"):
        find_nuscenes_scenes(tiny)


def test_five_columns_are_read(tmp_path):
    rows = np.arange(10, dtype="<f4").reshape(2, 5)
    rows.tofile(tmp_path / "a.pcd.bin")
    assert np.array_equal(read_pcd_bin(tmp_path / "a.pcd.bin"), rows[:, :3])


# ---------------------------------------------------------------------------------------------- the writer


def test_an_existing_scene_is_only_replaced_on_request(tmp_path):
    folder = write_nuscenes(TinyRecording(), tmp_path)
    with pytest.raises(CFlowError, match="overwrite=True"):
        write_nuscenes(TinyRecording(), tmp_path)
    assert write_nuscenes(TinyRecording(num_sweeps=2), tmp_path, overwrite=True) == folder
    assert len(open_log(folder)) == 2 and os.listdir(tmp_path) == ["tiny"]


def test_a_failed_write_leaves_the_old_scene_and_no_rubbish(tmp_path, monkeypatch):
    folder = write_nuscenes(TinyRecording(), tmp_path)

    def full(*_):
        raise OSError("disk full")

    monkeypatch.setattr(nuscenes_writer, "write_tables", full)
    with pytest.raises(OSError, match="disk full"):
        write_nuscenes(TinyRecording(num_sweeps=2), tmp_path, overwrite=True)
    with pytest.raises(OSError, match="disk full"):
        write_nuscenes(TinyRecording(log_id="new"), tmp_path)
    assert os.listdir(tmp_path) == ["tiny"] and len(open_log(folder)) == 6


def test_recordings_that_cannot_be_written(tmp_path):
    strange = TinyRecording()
    boxes = strange.boxes(0)
    strange.boxes = lambda index: type(boxes)(boxes.track_id, ("BUS", "UFO"), boxes.size, boxes.pose, boxes.num_points)
    changing = TinyRecording()
    units = changing.units
    changing.units = lambda index: units(index)[: 1 + (index < 3)]
    frozen = TinyRecording(interval_ns=100)
    for recording, complaint in [
        (strange, "category 'UFO'"),
        (changing, "sweep 3 has other LiDARs"),
        (frozen, "ascend by a microsecond"),
        (TinyRecording(log_id="../up"), "folder name"),
    ]:
        with pytest.raises(CFlowError, match=complaint):
            write_nuscenes(recording, tmp_path)
    assert os.listdir(tmp_path) == []


# ---------------------------------------------------------------------------------------------- the official devkit


def test_the_official_devkit_opens_it(tmp_path):
    nuscenes = pytest.importorskip("nuscenes", reason="nuscenes-devkit is not installed")
    from nuscenes.utils.data_classes import LidarPointCloud

    recording = TinyRecording(("LIDAR_TOP",), num_sweeps=11, interval_ns=50_000_000)
    folder = write_nuscenes(recording, tmp_path)
    data = nuscenes.NuScenes(VERSION, str(folder), verbose=False)
    assert [scene["name"] for scene in data.scene] == ["tiny"] and len(data.sample) == 2
    first = data.sample[0]
    path, boxes, _ = data.get_sample_data(first["data"]["LIDAR_TOP"])
    (unit,) = recording.units(0)
    np.testing.assert_array_equal(LidarPointCloud.from_file(path).points[:3].T, unit.points)
    car = next(box for box in boxes if box.name == "vehicle.car")
    assert list(car.wlh) == [CAR_SIZE[1], CAR_SIZE[0], CAR_SIZE[2]]
    T_sensor_world = np.linalg.inv(recording.poses[0] @ unit.T_ego_sensor)
    middle = T_sensor_world @ recording.car_at(recording.timestamps[0])[:, 3]
    np.testing.assert_allclose(car.center, middle[:3], atol=1e-9)
    np.testing.assert_allclose(data.box_velocity(first["anns"][0])[:2], [3, 20], atol=1e-6)
    # Half-way between the samples, and the sweeps of a whole interval seen from its end.
    middle_token = [row["token"] for row in data.sample_data if row["timestamp"] == recording.timestamps[5] // 1000]
    assert not data.get("sample_data", middle_token[0])["is_key_frame"]
    half = next(box for box in data.get_boxes(middle_token[0]) if box.name == "vehicle.car")
    np.testing.assert_allclose(half.center, recording.car_at(recording.timestamps[5])[:3, 3], atol=1e-6)
    cloud, lag = LidarPointCloud.from_file_multisweep(
        data, data.sample[1], "LIDAR_TOP", "LIDAR_TOP", nsweeps=3, min_distance=0
    )
    assert cloud.points.shape == (4, 120)
    np.testing.assert_allclose(np.unique(lag), [0, 0.05, 0.1], atol=1e-6)
    assert len(TRACKS) == len(data.instance)
