"""The reader of OpenSceneFlow's HDF5 scenes, on a scene of random points and on a simulated drive."""

from __future__ import annotations

import pickle

import numpy as np
import pytest
from hdf5_scene import STAMPS, move_to_sensor, write_scene
from small_logs import make_small_drive

from cflow_torch import CFlowError
from cflow_torch.data.catalog import open_log
from cflow_torch.data.hdf5.reader import HDF5Log, find_hdf5_scenes
from cflow_torch.data.hdf5.writer import labelled_by, write_hdf5_scene
from cflow_torch.data.log import CachedLog, intervals_of, window
from cflow_torch.transforms import to_quaternions, transform_points
from cflow_torch.types import CFlowWarning

h5py = pytest.importorskip("h5py")


def test_another_process_opens_the_file_itself(tmp_path):
    with HDF5Log(write_scene(tmp_path / "a.h5")) as log, pickle.loads(pickle.dumps(log)) as other:
        assert np.array_equal(other.sweep(1).points, log.sweep(1).points, equal_nan=True)
        assert np.array_equal(other.ego_T_lidar, log.ego_T_lidar)


@pytest.mark.parametrize(
    ("replaced", "complaint"),
    [
        ({"lidar": None, "points": np.zeros((50, 3), np.float32)}, "has no lidar, .*it has .*points"),
        ({"pose": None}, "no pose"),
        ({"lidar": np.zeros((50, 2), np.float32)}, "lidar.*N, 3"),
        ({"lidar": np.zeros((3, 500), np.float32)}, "lidar.*N, 3"),
        ({"pose": np.full((4, 4), np.nan)}, "pose of sweep .* is not finite"),
        ({"lidar": ["a", "b"]}, "lidar is not an array of bool, integers or floats"),
        ({"ground_mask": np.zeros(49, bool)}, "ground_mask.*shape"),
        ({"flow_is_valid": None}, "flow_is_valid"),
        ({"flow_category_indices": np.zeros(3, np.uint8)}, "flow_category_indices"),
        ({"flow_category_indices": np.full(50, 300, np.int16)}, "flow_category_indices"),
    ],
)
def test_a_bad_sweep_is_named(tmp_path, replaced, complaint):
    with HDF5Log(write_scene(tmp_path / "a.h5", **replaced)) as log:
        with pytest.raises(CFlowError, match=f"a.h5.*{complaint}"):
            log.sweep(0), log.labels(0)
        assert len(log.sweep(1).points) == 50
        with pytest.raises(CFlowError, match="sweeps 0 ... 2, you asked for 3"):
            log.sweep(3)


def test_a_scene_without_poses_uses_its_ego_motion(drive, tmp_path):
    write_hdf5_scene(drive, tmp_path / "a.h5")
    with h5py.File(tmp_path / "a.h5", "r+") as scene:
        for group in scene.values():
            del group["pose"]
    start = np.linalg.inv(drive.poses[0])
    with HDF5Log(tmp_path / "a.h5") as log:
        for index in (2, 0, 1):
            assert np.allclose(log.sweep(index).pose, start @ drive.poses[index], atol=1e-5)
        assert np.allclose(log.poses, start @ drive.poses, atol=1e-5)
    with h5py.File(tmp_path / "a.h5", "r+") as scene:
        for group in scene.values():
            group.pop("ego_motion", None)
    with HDF5Log(tmp_path / "a.h5") as log, HDF5Log(tmp_path / "a.h5", needs_poses=False) as unposed:
        with pytest.raises(CFlowError, match="has no pose.*Store pose.*ego_motion.*data.odometry=true"):
            log.sweep(0)
        assert unposed.sweep(1).pose is None


def without_poses(drive, file, indices):
    write_hdf5_scene(drive, file)
    with h5py.File(file, "r+") as scene:
        for index in indices:
            del scene[sorted(scene)[index]]["pose"]
    return file


@pytest.mark.parametrize("indices", [[1], [1, 2]])
def test_sweeps_without_a_pose_follow_from_the_ego_motion_of_those_before(drive, tmp_path, indices):
    with HDF5Log(without_poses(drive, tmp_path / "a.h5", indices)) as log:
        assert np.allclose(log.sweep(indices[-1]).pose, drive.poses[indices[-1]], atol=1e-5)
        assert np.allclose(log.poses, drive.poses, atol=1e-5)


def test_one_sweep_without_a_pose_does_not_lose_the_others(drive, tmp_path):
    file = without_poses(drive, tmp_path / "a.h5", [0])
    log = open_log("hdf5", file, check=False)
    with pytest.raises(CFlowError, match="has no pose"):
        log.sweep(0)
    assert np.allclose(log.sweep(1).pose, drive.poses[1], atol=1e-6)
    estimated = open_log("hdf5", file, check=False, odometry=True)
    assert np.isfinite(estimated.sweep(0).pose).all()


def test_a_gap_in_the_times_splits_windows(tmp_path):
    write_hdf5_scene(make_small_drive(num_sweeps=6), tmp_path / "a.h5")
    with h5py.File(tmp_path / "a.h5", "r+") as scene:
        *_, before, last = sorted(scene)
        scene.move(last, str(int(last) + 20 * 10**9))
    with pytest.warns(CFlowWarning, match="1 gaps between sweeps .the first is 20 s long"):
        log = open_log("hdf5", tmp_path / "a.h5", deskew="clockwise")
    last = len(log) - 1
    assert log.gaps == {last - 1} and window(log, last - 2, num_future=1).pcf == ()
    assert log.labels(last - 2) is not None and log.labels(last - 1) is None and log.labels(last) is None


def test_poses_may_be_the_upper_three_rows(drive, tmp_path):
    write_hdf5_scene(drive, tmp_path / "a.h5")
    with h5py.File(tmp_path / "a.h5", "r+") as scene:
        for group in scene.values():
            rows = group["pose"][:3]
            del group["pose"]
            group["pose"] = rows
    with HDF5Log(tmp_path / "a.h5") as log:
        assert np.allclose(log.sweep(1).pose, drive.poses[1], atol=1e-6)
        assert np.allclose(log.poses, drive.poses, atol=1e-6)


def test_poses_may_be_seven_numbers(drive, tmp_path):
    write_hdf5_scene(drive, tmp_path / "a.h5")
    with h5py.File(tmp_path / "a.h5", "r+") as scene:
        for group in scene.values():
            pose = group["pose"][()]
            w, x, y, z = to_quaternions(pose[None, :3, :3])[0]
            del group["pose"]
            group["pose"] = np.r_[pose[:3, 3], x, y, z, w]
    with HDF5Log(tmp_path / "a.h5") as log:
        assert np.allclose(log.poses, drive.poses, atol=1e-6)


def test_a_pose_of_nan_shortens_windows(drive, tmp_path):
    write_hdf5_scene(drive, tmp_path / "a.h5")
    with h5py.File(tmp_path / "a.h5", "r+") as scene:
        scene[sorted(scene)[0]]["pose"][...] = np.nan
    with HDF5Log(tmp_path / "a.h5") as log, pytest.warns(CFlowWarning, match="shorter, because .*pose .* not finite"):
        assert len(window(log, 1, num_history=1).pch) == 0


@pytest.mark.parametrize("form", ["nanoseconds", "unix seconds", "seconds"])
def test_times_of_points_may_have_any_unit(drive, tmp_path, form):
    write_hdf5_scene(drive, tmp_path / "a.h5")
    with h5py.File(tmp_path / "a.h5", "r+") as scene:
        for name, group in scene.items():
            seconds = np.linspace(0, 0.1, len(group["lidar"]))
            group.pop("lidar_dt", None)
            units = {"nanoseconds": (seconds * 1e9).astype(np.int64), "unix seconds": int(name) * 1e-9 + seconds}
            group["lidar_dt"] = units.get(form, seconds)
    with HDF5Log(tmp_path / "a.h5") as log:
        times = log.sweep(1).point_times
        assert np.allclose(times, np.linspace(0, 0.1, len(times)), atol=1e-5)


def test_data_of_other_files_are_never_read(tmp_path):
    """Links, external storage and virtual datasets refer to other files, which may be any file."""
    other, secret = write_scene(tmp_path / "other.h5"), tmp_path / "secret"
    secret.write_bytes(np.ones((50, 4), np.float32).tobytes())
    layout = h5py.VirtualLayout((50, 4), np.float32)
    layout[:] = h5py.VirtualSource(str(other), f"{STAMPS[0]}/lidar", (50, 4), np.float32)
    for make in (
        lambda group: group.__setitem__("lidar", h5py.ExternalLink(str(other), f"{STAMPS[0]}/lidar")),
        lambda group: group.__setitem__("lidar", h5py.SoftLink(f"/{STAMPS[1]}/lidar")),
        lambda group: group.create_virtual_dataset("lidar", layout),
        lambda group: group.create_dataset("lidar", (50, 4), np.float32, external=[(str(secret), 0, 800)]),
    ):
        file = write_scene(tmp_path / "a.h5", lidar=None)
        with h5py.File(file, "r+") as scene:
            make(scene[str(STAMPS[0])])
        with HDF5Log(file) as log, pytest.raises(CFlowError, match="lidar is a link or lies in other files"):
            log.sweep(0)


def test_other_files_are_refused(tmp_path):
    write_scene(tmp_path / "one.h5", STAMPS[:1])
    for name in ("one", "missing"):
        with pytest.raises(CFlowError, match=f"{name}.h5"):
            HDF5Log(tmp_path / f"{name}.h5")
    with pytest.raises(CFlowError, match="nowhere"):
        find_hdf5_scenes(tmp_path / "nowhere")


def test_every_key_is_read_in_its_own_type(tmp_path):
    """float32 poses, (N, 3) points, int8 categories with -1 = no label, eval_mask (N,) are variants that occur."""
    extra = {
        "pose": np.eye(4, dtype=np.float32),
        "lidar": np.ones((50, 3), np.float32),
        "flow_category_indices": np.array([-1, 19] * 25, np.int8),
        "flow_is_valid": np.ones(50, bool),
        "eval_mask": np.arange(50) < 7,
        "lidar_center": np.random.default_rng(1).random((2, 4, 4)).astype(np.float32),
        "cluster": np.arange(50, dtype=np.int16)[:, None],
        "my_result": np.ones((50, 3), np.float32),
    }
    (tmp_path / "val").mkdir()
    file = write_scene(tmp_path / "val" / "scene.h5", **extra)
    assert find_hdf5_scenes(tmp_path) == find_hdf5_scenes(file.parent) == find_hdf5_scenes(file) == [file]
    with HDF5Log(file) as log:
        assert list(log.timestamps) == [1000 * stamp for stamp in STAMPS], "microseconds become nanoseconds"
        assert log.sweep(1).timestamp_ns == log.timestamps[1] and log.sweep_name(1) == str(STAMPS[1])
        assert len(window(log, 1, 4).pch) == 1 and np.allclose(intervals_of(log), 0.1)
        assert CachedLog(log, 1).sweep_name(1) == log.sweep_name(1)
        for key, value in extra.items():
            read = log.values(0, key)
            assert read.dtype == value.dtype and np.array_equal(read, value[:, 0] if key == "cluster" else value), key
        with pytest.raises(CFlowError, match=r"no nnd; it has cluster, .*my_result"):
            log.values(0, "nnd")
        assert log.sweep(0).pose.dtype == np.float64 and log.eval_mask(0).sum() == 7
        labels = log.labels(0)
        assert labels.category.tolist() == [0, 19] * 25 and labels.is_valid.tolist() == [False, True] * 25


@pytest.fixture(scope="module")
def drive():
    return make_small_drive(3, seed=1)


@pytest.mark.parametrize("points_frame", ["ego", "sensor"])
def test_a_simulated_drive_comes_back(drive, tmp_path, points_frame):
    file = tmp_path / "scene.h5"
    write_hdf5_scene(drive, file, eval_step=2)
    extrinsics = drive.units(0)[0].T_ego_sensor if points_frame == "sensor" else np.eye(4)
    if points_frame == "sensor":
        move_to_sensor(file, extrinsics, is_stated=True)
    step = 0.0 if points_frame == "ego" else 1e-5  # float32 at 100 m
    with HDF5Log(file) as log:
        assert list(log.timestamps) == list(drive.timestamps) and np.array_equal(log.ego_T_lidar, extrinsics)
        assert np.array_equal(log.poses, drive.poses @ extrinsics)
        for index in range(3):
            stored, read, units = drive.sweep(index), log.sweep(index), drive.units(index)
            assert np.abs(transform_points(read.points, extrinsics) - stored.points).max() <= step
            assert np.array_equal(read.is_ground, stored.is_ground) and read.timestamp_ns == stored.timestamp_ns
            assert np.array_equal(log.values(index, "pose"), drive.poses[index]), "of the ego frame"
            assert log.values(index, "lidar_id").max() == len(units)
            assert np.array_equal(log.values(index, "lidar_center")[0], units[0].T_ego_sensor.astype(np.float32))
            assert np.allclose(read.point_times * 1e9, units[0].offset_ns, atol=10)
            truth, labels = drive.labels(index), log.labels(index)
            if index == 2:
                assert truth is labels is None and "ego_motion" not in log.keys(2)
                continue
            assert np.abs(labels.flow @ extrinsics[:3, :3].T - truth.flow).max() <= step
            assert np.array_equal(labels.category, truth.category) and np.array_equal(labels.is_valid, truth.is_valid)
            motion = np.linalg.inv(drive.poses[index + 1]) @ drive.poses[index]
            assert np.array_equal(log.values(index, "ego_motion"), motion.astype(np.float32))
            assert (log.values(index, "flow_instance_id")[truth.category > 0] > 0).mean() > 0.99
            # In the frame of the points, static points move as the poses say.
            rigid = transform_points(read.points, np.linalg.inv(log.sweep(index + 1).pose) @ read.pose) - read.points
            assert np.abs(labels.flow - rigid)[truth.category == 0].max() < 1e-4
        assert log.eval_mask(1) is None
        assert np.array_equal(log.eval_mask(0), log.labels(0).is_valid & ~log.sweep(0).is_ground)


def test_argoverse_scenes_without_extrinsics_are_recognised(drive, tmp_path):
    """Time stamps of that set and ground 2 m below the origin: up_lidar; ground 0.35 m below: the ego frame."""
    mount = drive.units(0)[0].T_ego_sensor
    for frame in ("sensor", "ego"):
        file = tmp_path / f"{frame}.h5"
        write_hdf5_scene(drive, file)
        move_to_sensor(file, mount if frame == "sensor" else np.eye(4))
        with HDF5Log(file) as log, HDF5Log(file, ego_T_lidar=mount) as told, HDF5Log(file, ego_T_lidar=None) as plain:
            if frame == "ego":
                assert np.array_equal(log.ego_T_lidar, np.eye(4))
            else:
                assert np.abs(log.ego_T_lidar[:3, 3] - mount[:3, 3]).max() < 1e-2
                assert abs(np.degrees(np.arctan2(log.ego_T_lidar[1, 0], log.ego_T_lidar[0, 0])) + 0.58) < 0.01
            assert np.array_equal(told.ego_T_lidar, mount)
            assert np.array_equal(plain.sweep(0).pose, drive.poses[0].astype(np.float32))
    with pytest.raises(CFlowError, match="ego_T_lidar of"):
        HDF5Log(file, ego_T_lidar=np.ones((4, 4)))


def test_points_in_a_map_keep_their_precision_and_fillers_are_missing(tmp_path):
    """Float64 coordinates in UTM, of which float32 has steps of 0.5 m, and drivers' 1e10 for shots without a return."""
    rng, far = np.random.default_rng(0), np.array((6.9e5, 5.3e6, 500))
    points = rng.uniform(-60, 60, (50, 3))
    points[7:19] = 1e10
    is_filler = points[:, 0] == 1e10
    near = write_scene(tmp_path / "near.h5", lidar=points)
    in_map = write_scene(tmp_path / "map.h5", lidar=np.where(is_filler[:, None], points, points + far))
    for file, moved, dtype in ((near, 0, np.float32), (in_map, far, np.float64)):
        read = HDF5Log(file).sweep(0).points
        assert read.dtype == dtype and np.isnan(read[is_filler]).all()
        assert np.allclose((read - moved)[~is_filler], points[~is_filler], atol=1e-5)


@pytest.mark.parametrize(
    ("name", "stamps", "has_times"),
    [
        ("{:06d}", [0, 1, 2], False),
        ("1700000000.{}", [1_700_000_000_000_000_000 + k * 10**8 for k in range(3)], True),
        ("1700000000_{}00000000", [1_700_000_000_000_000_000 + k * 10**8 for k in range(3)], True),
        ("frame_{}", [0, 1, 2], False),
    ],
)
def test_groups_may_be_numbered_or_called_by_seconds(tmp_path, name, stamps, has_times):
    file, h5py = write_scene(tmp_path / "a.h5"), pytest.importorskip("h5py")
    before = [sweep.points for sweep in HDF5Log(file)]
    with h5py.File(file, "r+") as scene:
        for k, stamp in enumerate(STAMPS):
            scene.move(str(stamp), name.format(k))
    with HDF5Log(file) as log:
        assert list(log.timestamps) == stamps
        assert all(map(np.array_equal, before, [sweep.points for sweep in log]))
        assert log.sweep(1).timestamp_ns == (stamps[1] if has_times else None)
    assert labelled_by(file) is None
    with h5py.File(file, "r+") as scene:
        scene[name.format(1)]["dufo"] = np.zeros(50, np.uint8)
    assert labelled_by(file) == "", "of an unknown method"
