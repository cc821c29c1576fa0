"""What a check says of logs that are wrong on purpose: poses, frames, units, axes, masks, repeated sweeps."""

from __future__ import annotations

import json
import pickle
import re
import warnings
from dataclasses import replace
from functools import lru_cache, partial

import numpy as np
import pytest

from cflow_torch import CFlowError, Sweep
from cflow_torch.data.arrays import ArraysLog, write_array_log
from cflow_torch.data.av2 import AV2Log
from cflow_torch.data.catalog import GroundSegmentedLog, open_log
from cflow_torch.data.deskewing import DeskewedLog
from cflow_torch.data.log import CachedLog, Log, LogWrapper, poses_beyond
from cflow_torch.data.log_check import FOUND, RIGHT, WRONG, check_log, examine, find_problems
from cflow_torch.data.log_motion import JUMP, POSE, find_lapses, judge_log
from cflow_torch.data.read_as import read_as
from cflow_torch.diagnosis.conventions import AXES, CAMERA, UNITS, WORLD
from cflow_torch.diagnosis.inspection import mask_problem
from cflow_torch.diagnosis.other_frame import mounting
from cflow_torch.diagnosis.pair import GIVEN
from cflow_torch.diagnosis.readings import NO_READING, UNKNOWN, Judgement, _compare
from cflow_torch.errors import MissingFile
from cflow_torch.simulator import make_drive
from cflow_torch.transforms import (
    as_matrix,
    halfway,
    interpolate_motion,
    rotations_about,
    to_quaternions,
    to_rotations,
    transform_points,
    turn_of,
)
from cflow_torch.types import CFlowWarning


class Wrong(Log):
    """A log with other points, poses, masks or order of sweeps. `points` is called with the points and the pose."""

    def __init__(self, log, points=None, poses=None, masks=True, order=None, is_broken=False, name=""):
        self.log, self.log_id, self.timestamps = log, name or log.log_id, log.timestamps
        self.points, self.masks, self.is_broken = points, masks, is_broken
        self.order = order or range(len(log.timestamps))
        true = np.stack([log.sweep(index).pose for index in range(len(log.timestamps))])
        self.true, self.poses = true, true
        if poses is not None:
            self.poses = poses(true)

    def sweep(self, index):
        if self.is_broken:
            raise CFlowError("broken")
        sweep = self.log.sweep(self.order[index])
        points = np.asarray(sweep.points, np.float64)
        points = points if self.points is None else self.points(points, self.true[index])
        mask = sweep.is_ground if self.masks is True else self.masks(sweep.is_ground) if self.masks else None
        pose = None if self.poses is None else self.poses[index]
        return Sweep(points.astype(np.float32), mask, pose, sweep.timestamp_ns)


def each(change):
    """A change of all poses, from a change of one."""
    return lambda poses: np.stack([change(pose) for pose in poses])


def to_world(points, pose):
    return points @ pose[:3, :3].T + pose[:3, 3]


def half(step):
    """Poses midway to those of the sweep `step` later."""
    return lambda poses: halfway(poses, extrapolated(step)(poses))


def scaled(factor):
    return each(lambda pose: as_matrix(pose[:3, :3], factor * pose[:3, 3]))


def extrapolated(step):
    """Poses that belong to the sweep `step` later."""

    def change(poses):
        first = poses[0] @ np.linalg.inv(poses[1]) @ poses[0]
        last = poses[-1] @ np.linalg.inv(poses[-2]) @ poses[-1]
        moved = np.concatenate([poses[1:], [last]]) if step > 0 else np.concatenate([[first], poses[:-1]])
        return moved if abs(step) == 1 else extrapolated(step - np.sign(step))(moved)

    return change


class Thinned(LogWrapper):
    """Every third point: more of them tell a check nothing more."""

    def sweep(self, index):
        sweep = self.log.sweep(index)
        return replace(sweep, points=sweep.points[::3], is_ground=sweep.is_ground[::3])


class Walls(Log):
    """A slow drive between smooth walls, along which all motions fit about equally, with poles in front of them."""

    def __init__(self, step=0.55):
        self.log_id, self.timestamps = "walls", [100_000_000 * index for index in range(8)]
        self.poses = np.stack([as_matrix(np.eye(3), (step * index, 0, 0)) for index in range(8)])
        random = np.random.default_rng(0)
        self.poles = np.column_stack([random.uniform(-40, 45, 80), random.choice([-5, 5], 80)])

    def sweep(self, index):
        random = np.random.default_rng(index)
        wall = random.uniform((-40, -0.02, -1.5), (40, 0.02, 3), (5000, 3)) + [0, 7, 0]
        wall[::2, 1] *= -1
        angle = random.uniform(0, 2 * np.pi, 8000)
        shaft = np.column_stack([np.cos(angle), np.sin(angle), random.uniform(-15, 30, 8000)]) / 10
        shaft[:, :2] += self.poles[random.integers(0, 80, 8000)] - self.poses[index, :2, 3]
        ground = random.uniform((-30, -6, -1.7), (30, 6, -1.7), (3000, 3))
        points = np.concatenate([wall, shaft, ground]).astype(np.float32)
        return Sweep(points, np.arange(len(points)) >= 13000, self.poses[index], self.timestamps[index])


@lru_cache(maxsize=None)
def drive_of(seed=2, num_sweeps=12, profile="demo", scene="street"):
    """Seed 2 of the street begins to turn in its first second."""
    return CachedLog(make_drive(seed=seed, num_sweeps=num_sweeps, profile=profile, scene=scene), num_sweeps)


@pytest.fixture
def whole():
    return drive_of()


@pytest.fixture(scope="module")
def drive():
    return CachedLog(Thinned(drive_of()), 12)


@pytest.fixture(scope="module")
def real(kitti_file):
    hdf5 = pytest.importorskip("cflow_torch.data.hdf5")
    return CachedLog(Thinned(hdf5.HDF5Log(kitti_file)), 16)


@pytest.fixture(scope="module")
def turning(kitti_file):
    """A real drive whose turn changes its direction."""
    hdf5 = pytest.importorskip("cflow_torch.data.hdf5")
    file = kitti_file.with_name("kitti-0000-c2.h5")
    if not file.exists():
        pytest.skip(f"needs {file.name}")
    return CachedLog(Thinned(hdf5.HDF5Log(file)), 27)


def reordered(order):
    """Poses whose quaternion (w, x, y, z) is read in another order."""
    return lambda pose: as_matrix(to_rotations(to_quaternions(pose[None, :3, :3])[:, order])[0], pose[:3, 3])


def mirrored(axes):
    return lambda pose: as_matrix(axes) @ pose @ as_matrix(axes)


def in_degrees(pose):
    """A pose whose roll, pitch and yaw are written in degrees, and read as radians."""
    r = pose[:3, :3]
    angles = np.arctan2(r[2, 1], r[2, 2]), -np.arcsin(r[2, 0]), np.arctan2(r[1, 0], r[0, 0])
    roll, pitch, yaw = (rotations_about(axis, np.degrees(angle)) for axis, angle in enumerate(angles))
    return as_matrix(yaw @ pitch @ roll, pose[:3, 3])


def rolled(pose):
    """A pose whose yaw and roll are interchanged."""
    roll, yaw = np.arctan2(pose[2, 1], pose[2, 2]), np.arctan2(pose[1, 0], pose[0, 0])
    pitch = rotations_about(1, -np.arcsin(pose[2, 0]))
    return as_matrix(rotations_about(2, roll) @ pitch @ rotations_about(0, yaw), pose[:3, 3])


POSES = {
    "inverted": np.linalg.inv,
    CAMERA: lambda pose: pose @ as_matrix(AXES[CAMERA]),
    "left": lambda pose: pose @ as_matrix(AXES["left"]),
    "back": lambda pose: pose @ as_matrix(AXES["back"]),
    "w_first": reordered((3, 0, 1, 2)),
    "w_last": reordered((1, 2, 3, 0)),
    "down": lambda pose: pose @ as_matrix(AXES["down"]),
    "right": lambda pose: pose @ as_matrix(AXES["right"]),
    "opengl": lambda pose: pose @ as_matrix(AXES["opengl"]),
    "mirrored": mirrored(np.diag([1, -1, 1])),
    "mirrored_back": mirrored(np.diag([-1, 1, 1])),
    "swapped": mirrored(np.eye(3)[[1, 0, 2]]),
    "swapped_back": mirrored(np.array([[0, -1, 0], [-1, 0, 0], [0, 0, 1]])),
    "transposed": lambda pose: as_matrix(pose[:3, :3].T, pose[:3, 3]),
    "compass": lambda pose: as_matrix(pose[:3, :3].T @ AXES["left"], pose[:3, 3]),
}
WRONG_POSES = {
    **{name: each(change) for name, change in POSES.items()},
    "reversed": lambda poses: poses[::-1],
    "late": extrapolated(-1),
    "early": extrapolated(1),
    "half_late": half(-1),
    "half_early": half(1),
    "millimetres": scaled(1000),
    "centimetres": scaled(100),
    "feet": scaled(1 / 0.3048),
    "yaw_first": lambda poses: each(rolled)(np.linalg.inv(poses[0]) @ poses),
    "degrees": lambda poses: each(in_degrees)(np.linalg.inv(poses[0]) @ poses),
    "steps": lambda poses: np.concatenate([poses[:1], np.linalg.inv(poses[:-1]) @ poses[1:]]),
    "steps_back": lambda poses: np.concatenate([np.linalg.inv(poses[:1]), np.linalg.inv(poses[1:]) @ poses[:-1]]),
}


# Of readings that differ by a sign, a factor, or axes, one is tried in the ordinary run.
ALIKE = (
    *(
        "left",
        "back",
        "down",
        "right",
        "opengl",
        "w_last",
        "mirrored_back",
        "swapped",
        "swapped_back",
        "compass",
        "yaw_first",
    ),
    *("millimetres", "centimetres", "early", "steps_back"),
)
OF_REAL = ("left", "back", "down", "w_last", "millimetres", "centimetres")


@pytest.mark.parametrize("reading", WRONG_POSES)
def test_a_reading_gives_the_true_motion_of_wrong_poses(reading, drive):
    wrong = Wrong(drive, poses=WRONG_POSES[reading])
    true, read = (np.linalg.inv(log.poses[2:-1]) @ log.poses[1:-2] for log in (Wrong(drive), read_as(wrong, reading)))
    is_half = "half" in reading  # a pose midway between two others is interpolated
    assert np.allclose(true, read, atol=0.01 if is_half else 1e-6)


@pytest.mark.parametrize(
    ("source", "reading"),
    [
        *(("drive", reading) for reading in WRONG_POSES if "half" not in reading and reading not in ALIKE),
        *(("turning", reading) for reading in ("late", "half_early")),  # at even motion a neighbour's pose is as good
        *(pytest.param("drive", reading, marks=pytest.mark.slow) for reading in ALIKE),
        *(
            pytest.param("real", reading, marks=pytest.mark.slow)
            for reading in (CAMERA, "inverted", "w_first", *OF_REAL)
        ),
        *(pytest.param("turning", reading, marks=pytest.mark.slow) for reading in ("early", "half_late")),
    ],
)
def test_wrong_poses_are_named_and_fit_under_the_reading(reading, source, request):
    good = request.getfixturevalue(source)
    wrong = Wrong(good, poses=WRONG_POSES[reading])
    (problem,) = [text for text in find_problems(wrong) if "ground masks" not in text]
    assert f"data.read_as={reading}" in problem and "as given" in problem
    assert "multiplied by" not in problem, "a unit says more than a factor"
    again = read_as(wrong, reading)
    assert judge_log(again).best == ()


def test_a_small_tilt_is_told_as_a_turn_of_that_size(drive):
    """As 0 degrees about z, it would be no help."""
    wrong = Wrong(drive, poses=each(lambda pose: pose @ as_matrix(rotations_about(1, np.radians(9.5)))))
    assert any("turned by about 10 degrees" in text for text in find_problems(wrong))
    tilted = mounting(rotations_about(1, np.radians(4)), np.zeros(3))
    assert "turned by about 4 degrees" in tilted.cause


@pytest.mark.parametrize("name", ["mirrored", "swapped", pytest.param("swapped_back", marks=pytest.mark.slow)])
def test_mirrored_clouds_are_named_and_no_pose_is_blamed(drive, name):
    axes = AXES[name]  # its own inverse
    (problem,) = find_problems(Wrong(drive, points=lambda points, _: points @ axes))
    assert "(left-handed)" in problem and f"data.read_as={name}" in problem


def test_points_with_the_axes_of_the_world_are_named(drive):
    """As of drivers that level and align clouds, but leave them around the vehicle."""
    wrong = Wrong(drive, points=lambda points, pose: points @ pose[:3, :3].T)
    (problem,) = find_problems(wrong)
    assert "the points have the axes of the world" in problem and "data.read_as=world_axes" in problem
    assert find_problems(read_as(wrong, "world_axes")) == []


@pytest.mark.parametrize("factor", [0.5, 2.5])
def test_positions_of_another_scale_are_named_with_the_factor(drive, factor):
    (problem,) = find_problems(Wrong(drive, poses=scaled(factor)))
    found = re.search(r"positions multiplied by ([0-9.]+)", problem)
    assert found and abs(float(found[1]) * factor - 1) < 0.04


@pytest.mark.parametrize("factor", [0.5, 2])
def test_positions_of_another_scale_are_named_beside_smooth_walls(factor):
    """There, two fifths of what fits under the right motion are in place under any."""
    (problem,) = find_problems(Wrong(Walls(), poses=scaled(factor)))
    assert f"{factor} times as long as the motion" in problem


def test_poses_that_drift_while_the_vehicle_stands_are_told():
    def drift(poses):
        shift = np.random.default_rng(0).normal(0, 0.08, (8, 3)).cumsum(0) * (1, 1, 0)
        return as_matrix(poses[:, :3, :3], shift)

    (problem,) = find_problems(Wrong(Walls(step=0), poses=drift))
    assert "stands still without the poses" in problem and "data.poses=null" in problem
    assert find_problems(Walls(step=0)) == []


def test_poses_of_a_vehicle_that_stands_have_the_unit_of_the_points():
    def shaken(poses):
        return as_matrix(poses[:, :3, :3], np.random.default_rng(0).normal(0, 8, (8, 3)))

    problems = find_problems(Wrong(Walls(step=0), lambda points, _: 1000 * points, shaken))
    assert problems[-1].endswith("give data.read_as=[points_millimetres,millimetres]")


@pytest.mark.parametrize("sweeps", [5, pytest.param(-3, marks=pytest.mark.slow)])
def test_poses_that_are_several_sweeps_late_are_named_with_their_number(turning, sweeps):
    wrong = Wrong(turning, poses=extrapolated(-sweeps))
    name = f"late_{sweeps}" if sweeps > 0 else f"early_{-sweeps}"
    (problem,) = [text for text in find_problems(wrong) if "ground masks" not in text]
    assert problem.endswith(f"data.read_as={name}") and f"of sweep i {'-+'[sweeps < 0]} {abs(sweeps)})" in problem
    assert find_problems(read_as(wrong, name)) == []


@pytest.mark.parametrize("source", ["drive", "real"])
def test_points_in_the_world_are_found_and_moved_back(source, request):
    good = request.getfixturevalue(source)
    world = Wrong(good, points=to_world)
    assert judge_log(world).best == (WORLD,)
    log = read_as(world)
    assert np.allclose(log.sweep(9).points, good.sweep(9).points, atol=1e-4)
    (text,) = find_problems(log)
    assert "world's frame" in text and "data.read_as=world" in text
    assert find_problems(read_as(world, "world")) == [], "what you say is not repeated"
    assert "world's frame" in find_problems(world)[0] and read_as(good) is good


def test_points_in_the_frame_of_the_first_sweep_are_found_and_moved_back(drive):
    """Clouds of an odometry program that begins at the first sweep, next to poses in a map's frame."""
    start, far = np.linalg.inv(drive.poses[0]), as_matrix(rotations_about(2, 1.0), (500, -300, 20))
    first = Wrong(
        drive,
        points=lambda points, pose: to_world(to_world(points, pose), start),
        poses=lambda poses: far @ poses,
    )
    for reading in ("auto", "world"):
        log = read_as(first, reading)
        assert log.readings == (WORLD,)
        assert np.allclose(log.sweep(9).points, drive.sweep(9).points, atol=1e-3)
        steps = [np.linalg.inv(each.poses[9]) @ each.poses[3] for each in (log, drive)]
        assert np.allclose(*steps, atol=1e-6)


def test_points_near_the_first_pose_are_in_the_world_only_if_no_other_reading_fits_better():
    """Between walls, much is in place without the poses, and the points lie around the vehicle and the first pose."""
    left = Wrong(Walls(), poses=each(POSES["left"]))
    assert left.surrounds_poses and judge_log(Walls()).best == ()
    assert "left" in judge_log(left).best


def test_a_mounting_that_one_pair_shows_weakly_is_not_named():
    """A slight turn in one of several pairs is no evidence: in the others, both mountings are the same."""
    straight = {GIVEN: 0.34}
    turn = {GIVEN: 0.12, "mount 0 0.7": 0.136, "mount 0 -0.7": 0.10}
    assert _compare([straight, turn])[1] == []
    assert _compare([straight, {**turn, "mount 0 0.7": 0.22}])[1] == ["mount 0 0.7"]


def test_opening_a_folder_finds_points_in_the_world(drive, tmp_path):
    write_array_log(Wrong(drive, points=to_world, masks=False, name="log"), tmp_path)
    with pytest.warns(CFlowWarning, match="world's frame"):
        log = open_log("arrays", tmp_path / "log", find_ground="grid")
    assert np.allclose(log.sweep(11).points, drive.sweep(11).points, atol=1e-3)
    assert not np.allclose(open_log("arrays", tmp_path / "log", read_as=None).sweep(11).points, log.sweep(11).points)
    with pytest.raises(CFlowError, match="read_as='sideways': give one of auto, null, world"):
        open_log("arrays", tmp_path / "log", read_as="sideways")


def test_scenes_and_bags_in_the_world_are_found_when_they_are_opened(drive, tmp_path):
    """Own data in the world's frame, in a scene, and in a bag whose headers name the LiDAR's frame."""
    h5py = pytest.importorskip("h5py")
    pytest.importorskip("rosbags")
    from bag_writer import BagWriter

    world = Wrong(drive, points=to_world)
    writer = BagWriter(tmp_path, "ros1")
    with h5py.File(tmp_path / "scene.h5", "w") as file:
        for index, time in enumerate(drive.timestamps):
            sweep, group = world.sweep(index), file.create_group(str(time))
            group["lidar"], group["pose"], group["ground_mask"] = sweep.points, sweep.pose, sweep.is_ground
            transform = writer.transform(time, "odom", "velodyne", sweep.pose)
            writer.write("/tf", time, "tf2_msgs/msg/TFMessage", [transform])
            cloud = writer.cloud(time, sweep.points, None)
            writer.write("/points", time, "sensor_msgs/msg/PointCloud2", *cloud)
    writer.bag.close()
    for name, path in (("hdf5", tmp_path / "scene.h5"), ("bags", tmp_path / "drive.bag")):
        with pytest.warns(CFlowWarning, match="world's frame, so we move them to that of the vehicle"):
            log = open_log(name, path, find_ground="grid")
        assert np.allclose(log.sweep(11).points, drive.sweep(11).points, atol=1e-3)


def test_labels_move_with_the_points(whole):
    """Flow in the world's axes becomes flow in the axes of the vehicle at t+1."""
    truth = whole.labels(8)

    class Labelled(Wrong):
        def _labels(self, index):
            end = to_world(whole.sweep(index).points + whole.labels(index).flow, self.true[index + 1])
            return replace(whole.labels(index), flow=(end - self.sweep(index).points).astype(np.float32))

    labels = read_as(Labelled(whole, points=to_world)).labels(8)
    assert np.allclose(labels.flow, truth.flow, atol=1e-3) and len(labels.flow) == len(truth.flow)


def test_a_few_sweeps_of_another_time_are_no_reading_of_all_poses(drive):
    """Sweeps 6 and 10 have the points of four sweeps earlier. The other pairs tell that the vehicle does not stand."""
    wrong = Wrong(drive, order=[0, 1, 2, 3, 4, 5, 2, 7, 8, 9, 6, 11])
    assert judge_log(wrong).best == ()


def test_poses_of_another_log_are_named(drive):
    still = Wrong(drive, order=[0] * 12)
    noise = np.random.default_rng(0)
    noisy = Wrong(drive, points=lambda points, _: points + noise.normal(0, 0.005, points.shape), order=[0] * 12)
    assert "data.read_as=still" in find_problems(noisy)[0]
    assert judge_log(still).best == ("still",) and find_problems(read_as(noisy, "still")) == []
    mixed = Wrong(drive, order=[0, 6, 1, 7, 2, 8, 3, 9, 4, 10, 5, 11])
    assert judge_log(mixed).best == (NO_READING,) and "no reading" in find_problems(mixed)[0]


@pytest.mark.parametrize("poses", [None, lambda _: None], ids=["poses", "no poses"])
def test_two_sweeps_that_do_not_fit_are_told(drive, poses):
    turn = rotations_about(2, 1.9)
    log = Wrong(
        drive, lambda points, pose: points if np.array_equal(pose, drive.sweep(0).pose) else points @ turn.T, poses
    )
    log.timestamps = log.timestamps[:2]
    if poses is None:
        log.poses = log.poses[:2]
    (text,) = find_problems(log)
    assert text.startswith("the sweeps fit under no reading (only 0.00 of the static structure is in place)")


def test_a_small_share_that_is_larger_than_half_a_metre_farther_is_not_told(drive):
    random = np.random.default_rng(0)
    noisy = Wrong(drive, lambda points, _: points + random.normal(0, 0.08, points.shape))
    assert 0.04 < judge_log(noisy).given < 0.1 and find_problems(noisy) == [], "the poses are right"
    assert Judgement({GIVEN: 0.05}).is_low and not Judgement({GIVEN: 0.05}, is_peak=True).is_low


def test_points_at_the_centres_of_voxels_are_told(drive):
    (problem,) = find_problems(Wrong(drive, lambda points, _: np.floor(points / 0.2) * 0.2 + 0.1))
    assert "grid of 0.2 m" in problem


@pytest.mark.parametrize(
    ("source", "side"), [pytest.param("drive", 0, marks=pytest.mark.slow), ("real", 0), ("drive", 2)]
)
def test_a_lidar_elsewhere_on_the_vehicle_shows_in_turns(source, side, request):
    mounting = as_matrix(np.eye(3), (1.35, side, 1.6))
    mixed = Wrong(request.getfixturevalue(source), poses=each(lambda pose: pose @ np.linalg.inv(mounting)))
    (place,) = re.findall(
        r"data.ego_T_lidar with a position of about x = (.*) m and y = (.*) m", find_problems(mixed)[0]
    )
    assert np.hypot(float(place[0]) - 1.35, float(place[1]) - side) < 0.4


def test_a_lidar_that_is_turned_and_elsewhere_is_located(turning):
    """A bag without a transform to the LiDAR: "left" and "mount" fit only together."""
    ego_T_lidar = as_matrix(rotations_about(2, np.radians(90)), (2, 0, 0.3))
    mixed = Wrong(turning, points=lambda points, _: transform_points(points, np.linalg.inv(ego_T_lidar)), masks=False)
    (problem,) = [text for text in find_problems(mixed) if "ground" not in text]
    found = re.search(
        r"a rotation of about 90 degrees about z and a position of about x = (.*) m and y = (.*) m", problem
    )
    assert found and np.hypot(float(found[1]) - 2, float(found[2])) < 0.5


def test_a_rotation_and_a_place_that_fit_only_together_are_one_matrix(real):
    """The rotation alone would be 27 degrees, under which some sweeps do not fit."""
    ego_T_lidar = as_matrix(rotations_about(2, np.radians(30)), (1, 0.2, 0))
    mixed = Wrong(real, points=lambda points, _: transform_points(points, np.linalg.inv(ego_T_lidar)), masks=False)
    problem = next(text for text in find_problems(mixed) if "ego_T_lidar" in text)
    matrix = np.array(json.loads(re.search(r"data.ego_T_lidar=(\[\[\S*\]\])", problem)[1]))
    assert np.degrees(turn_of(matrix[:3, :3].T @ ego_T_lidar[:3, :3])) < 1.5
    assert np.hypot(*(matrix - ego_T_lidar)[:2, 3]) < 0.4


@pytest.mark.parametrize("reader", ["ego", "sensor", "hdf5"])
def test_the_matrix_that_is_told_contains_the_mounting_in_use(whole, tmp_path, reader):
    first, more = (as_matrix(rotations_about(2, turn), (turn, 0.5, 1)) for turn in (0.3, 1.2))
    if reader == "hdf5":
        hdf5 = pytest.importorskip("cflow_torch.data.hdf5")
        hdf5.write_hdf5_scene(whole, tmp_path / "drive.h5")
        make = partial(hdf5.HDF5Log, tmp_path / "drive.h5")
    else:
        write_array_log(whole, tmp_path)
        make = partial(ArraysLog, tmp_path / whole.log_id, poses_of=reader)
    log = make(ego_T_lidar=first)
    corrected = make(ego_T_lidar=log.mounting_with(more)).sweep(2)
    expected = transform_points(log.sweep(2).points, log.sweep(2).pose @ more)
    assert np.allclose(transform_points(corrected.points, corrected.pose), expected, atol=1e-3)


@pytest.mark.parametrize(
    ("source", "degrees"),
    [
        *(("drive", 30), ("drive", -4), ("real", 5)),
        *(pytest.param(source, degrees, marks=pytest.mark.slow) for source, degrees in (("drive", -135), ("real", 45))),
    ],
)
def test_a_lidar_that_is_turned_by_any_angle_is_named(source, degrees, request):
    turn = rotations_about(2, np.radians(degrees))
    turned = Wrong(request.getfixturevalue(source), points=lambda points, _: points @ turn)
    (problem,) = [text for text in find_problems(turned) if "ground masks" not in text]
    found = re.search(r"ego_T_lidar with a rotation of about (-?[\d.]+) degrees about z", problem)
    assert found and abs(float(found[1]) - degrees) <= 4


def noisy(deviation):
    def change(poses):
        poses = poses.copy()
        poses[:, :3, 3] += np.random.default_rng(0).normal(0, deviation, (len(poses), 3))
        return poses

    return change


def shaken(poses):
    """Poses with noise of half a degree, too, under which a sweep fits the second next one by chance."""
    rng = np.random.default_rng(0)
    noise = [as_matrix(rotations_about(2, np.radians(rng.normal(0, 0.5))), rng.normal(0, 0.15, 3)) for _ in poses]
    return poses @ np.stack(noise)


def swaying(poses):
    """Poses whose headings have a noise of 0.3 degrees."""
    rng = np.random.default_rng(1)
    return poses @ np.stack([as_matrix(rotations_about(2, np.radians(rng.normal(0, 0.3)))) for _ in poses])


def rounded(pose):
    """A pose whose position is rounded, which fits half a sweep late by chance."""
    return as_matrix(pose[:3, :3], pose[:3, 3].round(1))


def resampled(jitter):
    """Poses that were interpolated at times that are off by so many sweeps."""
    return lambda poses: interpolated(poses, np.random.default_rng(0).uniform(-jitter, jitter, len(poses)))


@pytest.mark.parametrize(
    ("source", "change"),
    [
        *(("drive", noisy(0.15)), ("whole", shaken), ("drive", resampled(0.4))),
        *(("drive", swaying), ("drive", each(rounded))),
        pytest.param("turning", noisy(0.1), marks=pytest.mark.slow),
    ],
)
def test_poses_that_are_not_exact_are_told_and_no_convention_is_blamed(source, change, request):
    (text,) = [
        text
        for text in find_problems(Wrong(request.getfixturevalue(source), poses=change))
        if "ground masks" not in text
    ]
    assert "the poses are off, by up to 0." in text and text.endswith("data.odometry=refine if they are noisy")


def test_a_slight_turn_is_named_with_conventions_that_remove_it_by_chance():
    """On a straight road, poses without rotations have no turn either."""
    turned = Wrong(Walls(step=1.1), poses=each(lambda pose: pose @ as_matrix(rotations_about(2, np.radians(1.5)))))
    (problem,) = find_problems(turned)
    assert "1.5 degrees to the right" in problem and "yaw, pitch, roll" in problem


@pytest.mark.parametrize(("source", "factor"), [("whole", 1 / 0.9144), ("turning", 1.1)])
def test_points_that_are_a_little_too_large_are_no_lidar_elsewhere(source, factor, request):
    wrong = Wrong(request.getfixturevalue(source), lambda points, _: factor * points)
    (text,) = [text for text in find_problems(wrong) if "ground masks" not in text]
    found = re.search(r"positions multiplied by ([0-9.]+)", text)
    assert found and abs(float(found[1]) / factor - 1) < 0.04


@pytest.mark.slow
@pytest.mark.parametrize("source", ["drive", "real"])
@pytest.mark.parametrize("unit", ["feet", "inches", "decimetres", "centimetres"])
def test_units_of_points_and_poses_are_told_by_the_height_of_the_sensor(source, unit, request):
    good = request.getfixturevalue(source)
    is_made = source == "drive"  # its frame is on the ground
    shift = as_matrix(np.eye(3), (0, 0, 1.7 if is_made else 0))
    wrong = Wrong(
        good,
        lambda points, _: (points - shift[:3, 3]) / UNITS[unit],
        lambda poses: scaled(1 / UNITS[unit])(poses @ shift),
        masks=False,
    )
    texts = find_problems(wrong)
    assert any(unit in text and f"data.read_as=points_{unit}" in text for text in texts)
    assert any(f"data.read_as=[points_{unit},{unit}]" in text for text in texts)
    assert find_problems(read_as(wrong, [f"points_{unit}", unit])) == []


class Accumulated(Wrong):
    """Sweeps with the points of up to `count` sweeps before them."""

    def __init__(self, log, count, **settings):
        super().__init__(log, **settings)
        self.count = count

    def sweep(self, index):
        sweep = super().sweep(index)
        poses = self.true
        older = [
            transform_points(self.log.sweep(k).points, np.linalg.inv(poses[index]) @ poses[k])
            for k in range(max(index - self.count, 0), index)
        ]
        points = np.concatenate([sweep.points, *older]).astype(np.float32)
        return replace(sweep, points=points, is_ground=None)


def test_sweeps_that_hold_the_points_of_earlier_ones_are_told(drive):
    class InWorld(Accumulated):
        def sweep(self, index):
            sweep = super().sweep(index)
            return replace(sweep, points=to_world(sweep.points, self.true[index]).astype(np.float32))

    start = CachedLog(Wrong(drive, poses=lambda poses: np.linalg.inv(poses[0]) @ poses), 12)
    cases = (
        (Accumulated(start, 1), "100 % of the points"),
        (Accumulated(start, 12), "100 % of the points"),
        (InWorld(start, 12, poses=lambda _: None), "100 % of the points"),
    )
    for log, text in cases:
        (told,) = [each for each in find_problems(log) if "to the millimetre" in each]
        assert text in told and "not a map" in told


def test_times_that_jitter_are_told_if_the_motion_is_even(drive):
    late = Wrong(drive)
    jitter = np.random.default_rng(0).uniform(-0.03, 0.03, 12) * 1e9
    late.timestamps = [stamp + int(by) for stamp, by in zip(drive.timestamps, jitter)]
    times = next(one for one in examine(late) if one.topic == "times")
    assert times.status == WRONG and "but the motion does not" in times.text
    early = Wrong(drive, poses=lambda poses: interpolated(poses, jitter / 1e8))
    early.timestamps = late.timestamps
    times = next(one for one in examine(early) if one.topic == "times")
    assert times.status == RIGHT and "intervals change by" in times.text, "then the motion changes with them"


def interpolated(poses, shift):
    times = np.arange(len(poses)) + shift
    before = np.floor(times).astype(int).clip(0, len(poses) - 2)
    return interpolate_motion(poses[before], poses[before + 1], times - before)


def jumping(poses):
    """Poses that are corrected every four sweeps, as by a map."""
    poses = poses.copy()
    for step in (4, 8):
        poses[step:] = as_matrix(rotations_about(2, 0.03), (0.9 * (-1) ** step, 0.6, 0)) @ poses[step:]
    return poses


def test_jumps_of_the_poses_do_not_hide_other_mistakes(drive):
    (problem,) = find_problems(Wrong(drive, poses=jumping))
    assert "jump" in problem and "before sweep 4" in problem and "before sweep 8" in problem
    both = Wrong(drive, poses=lambda poses: np.linalg.inv(jumping(poses)))
    (problem,) = find_problems(both)
    assert "data.read_as=inverted" in problem
    (problem,) = find_problems(read_as(both, "inverted"))
    assert "jump" in problem


@pytest.mark.slow
def test_two_mistakes_are_named_with_one_setting(drive):
    """Points and poses in millimetres; an upside-down sensor that looks backward; a camera's axes."""
    down, back, camera = AXES["down"], AXES["back"], AXES[CAMERA]
    cases = {
        "points_millimetres,millimetres": Wrong(drive, lambda points, _: 1000 * points, scaled(1000), masks=False),
        "points_upside_down,back": Wrong(drive, lambda points, _: points @ back @ down, masks=False),
        "points_upside_down,down": Wrong(drive, lambda p, _: p @ down, each(lambda T: T @ as_matrix(down)), False),
        "points_camera,camera": Wrong(drive, lambda p, _: p @ camera, each(lambda T: T @ as_matrix(camera)), False),
    }
    for setting, wrong in cases.items():
        assert any(f"data.read_as=[{setting}]" in text for text in find_problems(wrong))
        assert find_problems(read_as(wrong, setting.split(","))) == []


@pytest.mark.parametrize("is_frozen_again", [False, True])
def test_poses_that_are_frozen_in_most_sweeps_are_named(drive, is_frozen_again):
    """The few pairs that move show little."""

    def frozen(poses):
        poses = poses.copy()
        poses[:8] = poses[0]
        if is_frozen_again:
            poses[8:] = as_matrix(np.eye(3), (1, 0, 0)) @ poses[0]
        return poses

    assert any("hardly move" in text for text in find_problems(Wrong(drive, poses=frozen)))


@pytest.mark.parametrize("source", ["drive", "real"])
def test_missing_poses_are_named_if_the_sensor_moves(source, request):
    good = request.getfixturevalue(source)
    assert judge_log(Wrong(good, poses=lambda _: None)).best == (UNKNOWN,)
    assert "no poses" in find_problems(Wrong(good, poses=lambda _: None))[0]
    static = Wrong(good, poses=lambda _: None, order=[0] * len(good.timestamps))
    assert judge_log(static).best == () and judge_log(static).given == 1


@pytest.mark.parametrize(
    ("profile", "scene", "seed"),
    [
        ("nuscenes", "street", 1),
        *(pytest.param(profile, "street", 1, marks=pytest.mark.slow) for profile in ("av2", "truckscenes", "waymo")),
        *(("demo", "highway", 1), ("demo", "narrow", 1)),
        *(pytest.param("demo", "highway", seed, marks=pytest.mark.slow) for seed in (3, 4, 21, 31)),
        *(pytest.param("demo", scene, 1, marks=pytest.mark.slow) for scene in ("car_park", "crossing")),
    ],
)
def test_right_logs_stay_silent(profile, scene, seed):
    """Raw truck scenes, vehicles of the same speed, and walls along the road must not look like wrong poses."""
    log = drive_of(seed, 6, profile, scene)
    assert find_problems(log) == []
    bare = Wrong(log, masks=lambda mask: np.zeros_like(mask))
    assert judge_log(bare).best == (), "ground that is not masked looks the same everywhere"


@pytest.mark.parametrize(
    "name",
    [
        *("kitti-0000/kitti-0000-a", "av2"),
        *(pytest.param(name, marks=pytest.mark.slow) for name in ("kitti-0000/kitti-0000-c2", "av2-crown/av2-crown")),
        *(pytest.param(f"pandaset-002/panda-002-{part}", marks=pytest.mark.slow) for part in ("a1", "c")),
    ],
)
def test_prepared_real_data_stay_silent(name, data_root, av2_folder):
    if name == "av2":
        log = AV2Log(av2_folder)
    else:
        file = data_root / f"{name}.h5"
        if not file.exists():
            pytest.skip(f"needs {file.name}")
        log = pytest.importorskip("cflow_torch.data.hdf5").HDF5Log(file)
    assert [finding for finding in examine(log) if finding.status != RIGHT] == []


def test_single_poses_that_are_off_are_found(drive):
    def glitch(poses):
        poses = poses.copy()
        poses[6, 0, 3] += 0.6
        return poses

    def turned(poses):
        poses = poses.copy()
        poses[6] = poses[6] @ as_matrix(rotations_about(2, np.radians(5)))
        return poses

    def jump(poses):
        poses = poses.copy()
        poses[7:, 1, 3] += 1.5
        return poses

    def small(index):
        def change(poses):
            poses = poses.copy()
            poses[index, 0, 3] += 0.3
            return poses

        return change

    ends = (small(0), 1, JUMP), (small(11), 11, JUMP)
    for change, index, kind in ((glitch, 6, POSE), (turned, 6, POSE), (jump, 7, JUMP), (small(5), 5, POSE), *ends):
        (lapse,) = find_lapses(Wrong(drive, poses=change))
        assert (lapse.sweep, lapse.kind) == (index, kind)
    assert "jump by 1.5 m before sweep 7" in find_problems(Wrong(drive, poses=jump))[0]
    assert find_lapses(Wrong(drive)) == []


def camera_points(points, _):
    return points @ AXES[CAMERA]


def spherical(unit):
    def change(points, _):
        flat = np.hypot(points[:, 0], points[:, 1])
        azimuth, elevation = np.arctan2(points[:, 1], points[:, 0]), np.arctan2(points[:, 2], flat)
        return np.column_stack([np.hypot(flat, points[:, 2]), azimuth / unit, elevation / unit])

    return change


WRONG_POINTS = {
    "millimetres": (lambda points, _: 1000 * points, "data.read_as=points_millimetres"),
    "centimetres": (lambda points, _: 100 * points, "data.read_as=points_centimetres"),
    "decimetres": (lambda points, _: 10 * points, "data.read_as=points_decimetres"),
    "kilometres": (lambda points, _: 0.001 * points, "data.read_as=points_kilometres"),
    "inches": (lambda points, _: points / 0.0254, "data.read_as=points_inches"),
    "camera": (camera_points, "data.read_as=points_camera"),
    "z down": (lambda points, _: points @ AXES["down"], "data.read_as=points_upside_down"),
    "y up": (lambda points, _: points @ AXES["opengl"], "data.read_as=points_opengl"),
    "z first": (lambda points, _: points[:, [2, 0, 1]], "data.read_as=points_z_first"),
    "radians": (spherical(1.0), "data.read_as=points_spherical"),
    "degrees": (spherical(np.pi / 180), "data.read_as=points_spherical"),
    "elsewhere": (lambda points, _: points + [500, 0, 0], "frame of the LiDAR or of the vehicle"),
    "pitch": (lambda points, _: points @ rotations_about(1, 0.5), "about y.: give points with z up"),
    "roll": (lambda points, _: points @ rotations_about(0, -0.4), "data.ego_T_lidar"),
    "slight pitch": (
        lambda points, _: points @ rotations_about(1, np.radians(8)),
        "[89] degrees .turn it by .[89] about y",
    ),
    "slight roll": (
        lambda points, _: points @ rotations_about(0, np.radians(-12)),
        "12 degrees .turn it by -12 about x",
    ),
    "both": (
        lambda points, _: points @ rotations_about(1, 0.1) @ rotations_about(0, 0.15),
        "[67] about y and .9 about x",
    ),
}
# Those with a factor or a rotation like that of another one.
POINTS_ALIKE = {"centimetres", "decimetres", "kilometres", "inches", "y up", "z first"}
POINTS_ALIKE |= {"radians", "slight pitch", "slight roll", "roll"}


@pytest.mark.parametrize("name", [name for name, (_, found) in WRONG_POINTS.items() if "read_as" in found])
def test_a_reading_gives_the_true_points(name, drive):
    change, found = WRONG_POINTS[name]
    again = read_as(Wrong(drive, points=change, masks=False), found.split("=")[-1])
    assert np.allclose(again.sweep(3).points, drive.sweep(3).points, atol=1e-3)


@pytest.mark.parametrize(
    ("source", "name"),
    [
        *(("drive", name) for name in WRONG_POINTS if name not in POINTS_ALIKE),
        *(pytest.param("drive", name, marks=pytest.mark.slow) for name in sorted(POINTS_ALIKE)),
        *(pytest.param("real", name, marks=pytest.mark.slow) for name in WRONG_POINTS),
    ],
)
def test_wrong_units_and_axes_are_recognised(source, name, request):
    good = request.getfixturevalue(source)
    change, found = WRONG_POINTS[name]

    def with_strays(points, pose):
        return np.concatenate([change(points, pose), np.zeros((8, 3)), np.full((2, 3), 5.0)])

    masks = {"masks": False}
    (text,) = [
        text for text in find_problems(Wrong(good, points=with_strays, **masks)) if re.search("sweep|tilt", text)
    ][:1]
    assert re.search(found, text)
    if found.startswith("about y"):
        told = float(re.findall(r"turn it by \+(\d+)", text)[0])
        assert abs(told - np.degrees(0.5)) < 3
    if "read_as=points" in found:
        again = read_as(Wrong(good, points=change, masks=False), found.split("=")[-1])
        assert judge_log(again).best == ()


def test_a_sensor_that_tilts_for_a_moment_is_not_tilted(drive):
    """A robot that rolls and pitches: its sweeps disagree. If they agree, the motion is judged, too."""

    def tilted(angles):
        tilts = np.stack([as_matrix(rotations_about(0, np.radians(angle))) for angle in angles])

        class Tilted(Wrong):
            def sweep(self, index):
                sweep = super().sweep(index)
                points = transform_points(sweep.points, np.linalg.inv(tilts[index]))
                return replace(sweep, points=points.astype(np.float32))

        return Tilted(drive, poses=lambda poses: poses @ tilts)

    assert find_problems(tilted([6, -6] * 6)) == []
    (problem,) = find_problems(tilted([25] * 12))
    assert "tilted by about 25 degrees" in problem, "and nothing else"
    page = {finding.topic: finding for finding in examine(tilted([10] * 12))}
    assert "tilted by about 10 degrees" in page["frame"].text and page["ego motion"].status == RIGHT


def test_points_in_feet_are_told_by_the_motion(drive):
    feet = Wrong(drive, lambda points, _: points / 0.3048)
    (problem,) = find_problems(feet)
    assert "give data.read_as=points_feet" in problem and find_problems(read_as(feet, "points_feet")) == []


def ring(points, axis):
    return np.arange(len(points)) % 32


@pytest.mark.parametrize(
    ("other", "place", "found"),
    [
        (np.linalg.norm, 0, "2, 3 and 4"),
        (lambda points, axis: np.random.default_rng(0).random(len(points)) ** 2, 2, "1, 2 and 4"),
        pytest.param(ring, 0, "2, 3 and 4", marks=pytest.mark.slow),
    ],
)
def test_a_column_before_x_or_z_is_told_and_no_pose_is_blamed(drive, tmp_path, other, place, found):
    write_array_log(drive, tmp_path)
    for file in (tmp_path / drive.log_id / "points").iterdir():
        points = np.load(file)
        np.save(file, np.insert(points, place, other(points, axis=1), axis=1))
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        open_log("arrays", tmp_path / drive.log_id, ground=None)
    texts = [str(each.message) for each in caught]
    assert any(f"x, y and z seem to be in columns {found}" in text for text in texts)
    assert not any("the poses" in text or "world's frame" in text for text in texts)


@pytest.mark.parametrize("has_poses", [True, False])
def test_sweeps_that_measure_parts_of_a_turn_are_told(drive, has_poses):
    """A cloud per packet, or two sensors, alternating."""

    class Part(Wrong):
        def sweep(self, index):
            sweep = super().sweep(index // 3)
            azimuth = np.arctan2(sweep.points[:, 1], sweep.points[:, 0]) / (2 * np.pi) % 1
            keep = np.floor(3 * azimuth) == index % 3
            return replace(sweep, points=sweep.points[keep], is_ground=sweep.is_ground[keep])

    texts = find_problems(Part(drive, poses=None if has_poses else lambda _: None))
    assert any("share 0 % of the directions" in text or "share 4 %" in text for text in texts), texts


def test_sweeps_of_half_a_turn_are_told_once(whole):
    """Each fits the second next one, as those of two sensors do, but the directions say more."""

    class Half(Wrong):
        def sweep(self, index):
            sweep = super().sweep(index // 2)
            keep = (sweep.points[:, 1] > 0) == index % 2
            return replace(sweep, points=sweep.points[keep], is_ground=sweep.is_ground[keep])

    wrong = [finding.text for finding in examine(Half(whole)) if finding.status == WRONG]
    assert len(wrong) == 1 and "share 0 % of the directions" in wrong[0]


def test_sweeps_of_half_a_view_are_told_once(whole):
    """Drivers that publish the upper and the lower beams alternately."""

    class Half(Wrong):
        def sweep(self, index):
            sweep = super().sweep(index)
            ring = self.log.units(index)[0].ring
            keep = (ring >= np.median(ring)) == (index % 2 == 0)
            return replace(sweep, points=sweep.points[keep], is_ground=sweep.is_ground[keep])

    wrong = [finding.text for finding in examine(Half(whole)) if finding.status == WRONG]
    assert len(wrong) == 1 and re.search("share [1-5]?[0-9] % of the directions", wrong[0])


def test_a_chosen_method_replaces_wrong_masks_only(drive):
    inverted = Wrong(drive, masks=np.logical_not)
    chosen = GroundSegmentedLog(inverted, "grid")
    (text,) = find_problems(chosen)
    assert text.startswith(
        "find_ground=grid replaces all masks, because one is not that of points that lie low: invert"
    )
    assert (chosen.sweep(3).is_ground == drive.sweep(3).is_ground).mean() > 0.9
    assert "data.find_ground=grid replaces it" in find_problems(inverted)[0]
    assert np.array_equal(GroundSegmentedLog(inverted, "auto").sweep(3).is_ground, inverted.sweep(3).is_ground)
    assert np.array_equal(GroundSegmentedLog(drive, "grid").sweep(3).is_ground, drive.sweep(3).is_ground)


def test_poses_that_are_held_are_told_and_no_second_sensor(whole):
    held = Wrong(whole, poses=lambda poses: poses[np.arange(len(poses)) // 2 * 2])
    (text,) = [text for text in find_problems(held) if "ground masks" not in text]
    assert "6 poses repeat the one before while the vehicle moves, the first is that of sweep 1" in text
    assert "data.odometry=true" in text


def test_steps_of_a_straight_fast_road_are_told(data_root):
    hdf5 = pytest.importorskip("cflow_torch.data.hdf5")
    file = data_root / "kitti-raw" / "kitti-raw-0027-empty16.h5"
    if not file.exists():
        pytest.skip(f"needs {file.name}")
    road = CachedLog(Thinned(hdf5.HDF5Log(file)), 16)
    steps = Wrong(road, poses=lambda poses: np.concatenate([np.eye(4)[None], np.linalg.inv(poses[:-1]) @ poses[1:]]))
    assert judge_log(steps).best == ("steps",)


@pytest.mark.parametrize("angle", [0.0, 0.6])
def test_two_sensors_in_turns_are_told_and_nothing_else(drive, angle):
    T_points_second = np.linalg.inv(as_matrix(rotations_about(2, angle), (-1.5, 0, 0.4)))

    class InTurns(Wrong):
        def sweep(self, index):
            sweep = super().sweep(index)
            points = sweep.points if index % 2 == 0 else transform_points(sweep.points, T_points_second)
            return replace(sweep, points=points.astype(np.float32))

    wrong = [finding for finding in examine(InTurns(drive)) if finding.status == WRONG]
    assert [finding.topic for finding in wrong] == ["sweeps"] and "two sensors, alternating" in wrong[0].text


def test_the_poses_of_a_trajectory_go_on_beyond_the_sweeps(drive):
    """Sweeps 4 to 9 have the poses of two sweeps earlier; the trajectory has those after the last sweep, too."""

    class Part(Wrong):
        def __init__(self, log):
            super().__init__(log)
            self.timestamps = log.timestamps[2:8]
            self.poses = self.true[2:8]
            self.trajectory = np.array(log.timestamps, np.int64), self.true

        def sweep(self, index):
            sweep = self.log.sweep(index + 4)
            return replace(sweep, pose=self.poses[index], timestamp_ns=self.timestamps[index])

    extended, num_before = poses_beyond(Part(drive), Part(drive).poses, 10)
    assert num_before == 2 and np.allclose(extended, Part(drive).true, atol=1e-6)
    again = read_as(Part(drive), "late_2")
    assert np.allclose(again.sweep(5).pose, drive.sweep(9).pose, atol=1e-6), "not extrapolated"


def test_points_in_the_world_without_poses_are_told_by_the_last_sweep(drive):
    def far(points, pose):
        return to_world(points, as_matrix(np.eye(3), 20 * (pose[:3, 3] - drive.sweep(0).pose[:3, 3])) @ pose)

    (problem,) = find_problems(Wrong(drive, far, poses=lambda _: None))
    assert "in sweep 11 the points lie around x = " in problem


def test_points_in_the_frame_of_the_first_sweep_without_poses_are_told(drive):
    """FAST-LIO2 writes such clouds. The static world stands still, but the sensor leaves the origin."""
    start = np.linalg.inv(drive.sweep(0).pose)
    (problem,) = find_problems(Wrong(drive, lambda points, pose: to_world(points, start @ pose), poses=lambda _: None))
    assert "they are in the world's frame, and there are no poses: pass them" in problem


def test_missing_poses_are_told_with_the_files_that_may_have_them(drive, tmp_path):
    write_array_log(drive, tmp_path)
    folder = tmp_path / drive.log_id
    (folder / "results" / "a").mkdir(parents=True)
    (folder / "poses.txt").rename(folder / "results" / "a" / "poses.txt")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        log = open_log("arrays", folder, check=False)
    assert any(
        "there are no poses" in text and "choose data.poses=results/a/poses.txt" in text for text in find_problems(log)
    )


def test_masks_and_repeated_sweeps_are_recognised(drive):
    assert "invert the mask" in find_problems(Wrong(drive, masks=np.logical_not))[0]
    repeated = Wrong(drive, order=[0, 0, *range(2, 12)])
    assert any("sweep 1 repeats the points" in text for text in find_problems(repeated))


@pytest.mark.parametrize("source", ["drive", "real"])
def test_ground_masks_of_other_rows_and_of_all_points_are_recognised(request, source):
    log = request.getfixturevalue(source)
    shuffled = Wrong(log, masks=np.random.default_rng(0).permutation)
    shifted = Wrong(log, masks=lambda mask: np.roll(mask, len(mask) // 7))
    assert any("has it the rows of this sweep" in text for text in find_problems(shuffled))
    assert "has it the rows of this sweep" in mask_problem(shifted.sweep(0))
    assert "no point would have flow" in mask_problem(Wrong(log, masks=np.ones_like).sweep(0))
    assert "empty, but the sweep contains ground" in mask_problem(Wrong(log, masks=np.zeros_like).sweep(0))


@pytest.mark.parametrize(
    ("share", "text"), [(0.0, "we find no ground in the first sweep"), (0.5, "we find other points than those")]
)
def test_a_mask_that_we_made_is_not_blamed_on_the_user(drive, monkeypatch, share, text):
    def ground_of(points, _):
        return np.random.default_rng(0).random(len(points)) < share

    monkeypatch.setattr("cflow_torch.data.catalog.ground_of", ground_of)
    log = GroundSegmentedLog(Wrong(drive, masks=False))
    (problem,) = [each for each in find_problems(log) if each.startswith(text)]
    assert "data.find_ground=grid" in problem


def test_poses_of_the_lidar_are_told_from_those_of_the_vehicle(drive, tmp_path):
    """As who corrects a tilted LiDAR with poses from its own odometry, which the check advises."""
    tilt = as_matrix(rotations_about(1, np.radians(20)))
    level = Wrong(drive, points=lambda points, _: transform_points(points, np.linalg.inv(tilt)), masks=False)
    for name, poses in (("lidar", drive.poses @ tilt), ("ego", drive.poses)):
        write_array_log(Wrong(level, poses=lambda _, poses=poses: poses, masks=False, name=name), tmp_path)
        log = ArraysLog(tmp_path / name, ego_T_lidar=tilt)
        assert np.allclose(log.poses, drive.poses, atol=1e-6)
        assert any("its poses are those of the LiDAR" in note for note in log.notes) == (name == "lidar")
    sensor = ArraysLog(tmp_path / "ego", ego_T_lidar=tilt, poses_of="sensor")
    assert np.allclose(sensor.poses, drive.poses @ tilt, atol=1e-6)
    bare = ArraysLog(tmp_path / "ego", poses=None, ego_T_lidar=tilt, poses_of="sensor")
    for log in (sensor, bare):
        assert np.allclose(log.sweep(3).points, level.sweep(3).points, atol=1e-4), "the points stay"


CAMERA_AHEAD = as_matrix(rotations_about(1, np.radians(8)) @ AXES[CAMERA], (1.2, 0.3, 0.4))
INERTIAL_UNIT = as_matrix(rotations_about(2, np.radians(15)) @ rotations_about(1, np.radians(30)), (0.1, 0.05, -0.2))


@pytest.mark.parametrize(
    ("lidar_T_sensor", "cause"),
    [
        pytest.param(
            as_matrix(AXES["z_first"].T),
            "another sensor, whose x, y and z axes point left, up, ahead",  # as of LOAM
            marks=pytest.mark.slow,
        ),
        (CAMERA_AHEAD, "another sensor, whose x, y and z axes point right, down, ahead"),
        (INERTIAL_UNIT, "the points are turned by about 3"),  # 33 degrees
    ],
    ids=["loam", "camera", "imu"],
)
def test_poses_of_another_sensor_are_named_with_its_axes_and_place(turning, lidar_T_sensor, cause):
    """The points are right: nothing may be said of them."""
    wrong = Wrong(turning, poses=each(lambda pose: pose @ lidar_T_sensor))
    (problem,) = [text for text in find_problems(wrong) if "ground masks" not in text]
    assert cause in problem and "data.read_as" not in problem
    rotation = np.array(json.loads(re.search(r"rotation of about (\[\[.*?\]\])", problem)[1]))
    assert np.degrees(turn_of(rotation @ lidar_T_sensor[:3, :3])) < 5
    if lidar_T_sensor is CAMERA_AHEAD:
        place = re.search(r"origin is at about x = (.*) m and y = (.*) m and z = (.*) m in", problem)
        assert np.abs(np.linalg.inv(lidar_T_sensor)[[0, 2], 3] - (float(place[1]), float(place[3]))).max() < 0.8


class Changed(LogWrapper):
    """A log with changed sweeps. `change` is called with the index and the sweep."""

    def __init__(self, log, change):
        super().__init__(log)
        self.change = change

    def sweep(self, index):
        return self.change(index, self.log.sweep(index))


def test_a_first_sweep_of_a_part_of_a_turn_hides_no_mistake(drive):
    def upside_down(index, sweep):
        points = sweep.points[: 500 if index == 0 else None]
        return replace(sweep, points=points * np.float32([1, -1, -1]), is_ground=None)

    assert any("points_upside_down" in text for text in find_problems(Changed(drive, upside_down)))


def test_masks_that_are_wrong_in_later_sweeps_are_told(drive):
    def inverted(index, sweep):
        return replace(sweep, is_ground=sweep.is_ground == (index == 0))

    (problem,) = find_problems(Changed(drive, inverted))
    assert "the mask of sweep 5 is" in problem and "invert the mask" in problem


def test_coordinates_in_the_world_that_are_too_large_for_float32_are_told(drive):
    far = as_matrix(np.eye(3), (690_000, 5_330_000, 520))
    wrong = Wrong(drive, points=lambda points, pose: to_world(points, far @ pose), poses=each(lambda pose: far @ pose))
    assert any("float32 with steps of 0.5 m" in text for text in find_problems(read_as(wrong)))


def test_opening_a_log_warns_of_likely_mistakes(drive):
    with pytest.warns(CFlowWarning, match=f"log {drive.log_id}: .*static world moves"):
        check_log(Wrong(drive, poses=WRONG_POSES["inverted"]))
    few = Wrong(drive, points=lambda points, _: np.full((50, 3), 5.0), masks=False)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for good in (drive, few, Wrong(drive, is_broken=True)):
            check_log(good)


def test_the_page_says_what_was_found(drive):
    at_lidar = each(lambda pose: pose @ as_matrix(np.eye(3), (1.35, 0, 1.64)))
    in_sensor = Wrong(drive, points=lambda points, _: points - [1.35, 0, 1.64], poses=at_lidar)
    findings = {one.topic: one for one in examine(in_sensor)}
    assert {one.status for one in findings.values()} == {RIGHT}
    assert "32 beams" in findings["sensor"].text
    assert "10.0 Hz" in findings["times"].text and "none" in findings["labels"].text
    (error,) = [one for one in examine(Wrong(drive, is_broken=True)) if one.status == WRONG]
    assert error.text == "broken", "once, although several checks need the sweep"
    late = Wrong(drive)
    late.timestamps = [*drive.timestamps[:6], *(stamp + 700_000_000 for stamp in drive.timestamps[6:])]
    times = next(one for one in examine(late) if one.topic == "times")
    assert times.status == FOUND and "0.8 s after sweep 5" in times.text


def test_the_page_counts_sweeps_that_cannot_be_read(drive):
    class Damaged(Wrong):
        def sweep(self, index):
            if index in lost:
                raise MissingFile(f"sweep {index} does not exist")
            return super().sweep(index)

    for lost in ((7, 8), (2, 5, 9)):
        texts = [one.text for one in examine(Damaged(drive)) if one.status == WRONG and one.topic == "sweeps"]
        first = f"the first is sweep {lost[0]}: sweep {lost[0]} does not exist"
        assert texts == [f"{len(lost)} of 12 sweeps cannot be read, {first}. Their pairs have no flow"]


def test_the_page_names_sweeps_with_few_points(whole):
    class Cut(Wrong):
        def sweep(self, index):
            sweep = super().sweep(index)
            kept = slice(None) if index not in (4, 7) else slice(0 if index == 7 else 3000)
            return replace(sweep, points=sweep.points[kept], is_ground=sweep.is_ground[kept])

    (text,) = [one.text for one in examine(Cut(whole)) if one.status == WRONG]
    assert text.startswith("2 of them have few points, the first is sweep 4 with 3,000, while those around it have 2")


@pytest.mark.parametrize(
    ("order", "told"),
    [
        (
            [0, 1, 2, 3, 4, 5, 5, 5, 8, 9, 10, 11],
            "2 of them repeat the points of the sweep before, the first is",
        ),
        ([0, 1, 2, 3, 5, 4, 6, 7, 8, 9, 10, 11], "sweeps 4 to 5 do not fit those around"),
        ([0, 1, 2, 3, 4, 5, 11, 7, 8, 9, 10, 11], "sweep 6 does not fit those around"),
        ([9, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11], "sweep 0 does not fit those around"),
        ([0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 2], "sweep 11 does not fit those around"),
        pytest.param(
            [0, 1, 2, 3, 4, 4, 6, 7, 8, 9, 10, 11],
            "1 of them repeat the points of the sweep before, the first is sweep 5",
            marks=pytest.mark.slow,
        ),
    ],
    ids=["dropped", "interchanged", "foreign", "first", "last", "middle"],
)
def test_the_page_names_sweeps_that_are_repeated_or_misplaced(drive, order, told):
    wrong = [one for one in examine(Wrong(drive, order=order)) if one.status == WRONG]
    assert [one.topic for one in wrong] == ["sweeps"] and wrong[0].text.startswith(told)


@pytest.mark.parametrize(
    ("of_poses", "told"),
    [
        (
            [0, 1, 2, 3, 4, 5, 9, 10, 11],
            "sweeps seem to be missing before sweep 6, because the vehicle moves 2.5 m there",
        ),
        (range(9), "sweeps 5 and 6 do not fit each other, while those around do"),
    ],
    ids=["with their poses", "without"],
)
def test_the_page_names_missing_sweeps_of_a_log_without_times(drive, of_poses, told):
    class Untimed(Wrong):
        def sweep(self, index):
            return replace(super().sweep(index), timestamp_ns=None)

    log = Untimed(drive, poses=lambda poses: poses[of_poses], order=[0, 1, 2, 3, 4, 5, 9, 10, 11])
    log.timestamps = range(9)
    (text,) = [one.text for one in examine(log) if one.topic == "sweeps"]
    assert text.startswith(told)


def test_a_start_from_rest_lacks_no_sweeps(drive):
    """The first step is longer than usual, but so are those after it."""
    rng = np.random.default_rng(0)
    order = [0] * 6 + list(range(1, 12))
    log = Wrong(
        drive, lambda points, _: points + rng.normal(0, 0.005, points.shape), lambda poses: poses[order], order=order
    )
    log.timestamps, log.true = range(len(order)), log.poses
    assert not [one for one in examine(log) if one.status == WRONG and one.topic != "times"]


def test_sweeps_without_a_finite_point_are_told_and_change_nothing_else(drive):
    def blank(points, pose):
        return points * (np.nan if np.array_equal(pose, drive.sweep(0).pose) else 1)

    with warnings.catch_warnings():
        warnings.simplefilter("error")
        (text,) = [one.text for one in examine(Wrong(drive, points=blank)) if one.status == WRONG]
    assert text.startswith("1 of them have few points, the first is sweep 0 with 0")


def test_sweeps_without_points_are_told(drive):
    with pytest.warns(CFlowWarning, match="no point is finite in the first sweep"):
        check_log(Wrong(drive, points=lambda points, _: np.zeros((0, 3)), masks=False))


@pytest.mark.parametrize("full", [[], [2, 5]])
def test_sweeps_of_which_most_have_no_finite_point_are_told(drive, full):
    class Blank(Wrong):
        def sweep(self, index):
            sweep = super().sweep(index)
            return sweep if index in full else replace(sweep, points=np.full_like(sweep.points, np.nan))

    log = Blank(drive)
    quick = "no point is finite in the first sweep, sweep 5, sweep 11: are the files complete?"
    assert find_problems(log) == ([] if full else [quick])
    texts = [finding.text for finding in examine(log) if finding.status == WRONG]
    assert len(texts) == 1 and texts[0].startswith("10 of them have few points" if full else quick)


def twice(points, _):
    """Two returns of each shot; one of ten is from something behind."""
    rng = np.random.default_rng(len(points))
    behind = 1 + (rng.random(len(points)) < 0.1) * rng.uniform(0.02, 0.2, len(points))
    return np.stack([points, points * behind[:, None]], axis=1).reshape(-1, 3)


def without_sector(points, _):
    azimuth = np.arctan2(points[:, 1], points[:, 0])
    return np.where((np.abs(azimuth - len(points) % 3) < 0.4)[:, None], np.nan, points)


@pytest.mark.parametrize(
    "change",
    [
        twice,
        without_sector,
        lambda points, _: np.concatenate([points, points]),
        lambda points, _: np.unique(np.floor(points / 0.05), axis=0) * 0.05 + 0.02,
        lambda points, _: points[np.abs(np.arctan2(points[:, 1], points[:, 0])) < 0.6],
        lambda points, _: points[np.abs(np.arctan2(points[:, 2] - 1.6, np.hypot(points[:, 0], points[:, 1]))) < 0.005],
    ],
    ids=["dual returns", "NaN sectors", "points twice", "a grid", "a view ahead", "one ring"],
)
def test_unusual_but_right_sweeps_stay_silent(drive, change):
    texts = find_problems(Wrong(drive, points=change, masks=False))
    assert texts == []


def test_sweeps_of_few_points_do_not_blame_the_poses(drive):
    """A small sensor: of so few points, hardly any is measured again within 10 cm."""

    class Sparse(Wrong):
        def sweep(self, index):
            sweep = super().sweep(index)
            return replace(sweep, points=sweep.points[::20], is_ground=sweep.is_ground[::20])

    assert find_problems(Sparse(drive)) == []


def test_the_page_lists_notes_of_the_reader_and_its_gaps(drive):
    log = Wrong(drive)
    log.timestamps = [time + 3 * 10**9 * (index > 5) for index, time in enumerate(drive.timestamps)]
    assert "reader" not in {finding.topic for finding in examine(log)}
    with pytest.warns(CFlowWarning, match="it has a gap"):
        log._note("it has a gap")
    page = {finding.topic: finding for finding in examine(log)}
    assert page["times"].status == FOUND and "after sweep 5" in page["times"].text
    assert page["reader"][1:3] == (FOUND, "it has a gap")


@pytest.mark.parametrize("source", ["drive", pytest.param("real", marks=pytest.mark.slow)])
def test_two_clouds_without_their_transform_are_warned_of(source, request):
    from cflow_torch import estimate_flow

    log = request.getfixturevalue(source)
    pc0, pc1 = log.sweep(2), log.sweep(3)
    T = np.linalg.inv(pc1.pose) @ pc0.pose
    coarse = {"preset": "paper", "pixel_size": 0.4}
    given = {"gm0": pc0.is_ground, "gm1": pc1.is_ground, **coarse}
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        estimate_flow(pc0.points, pc1.points, T_ego1_ego0=T, **given)
        estimate_flow(pc0.points, pc0.points + np.float32(0.004), gm0=pc0.is_ground, gm1=pc0.is_ground, **coarse)
    with pytest.warns(CFlowWarning, match="the sensor moves by about.*give T_ego1_ego0"):
        estimate_flow(pc0.points, pc1.points, **given)
    with pytest.warns(CFlowWarning, match="inverted"):
        estimate_flow(pc0.points, pc1.points, T_ego1_ego0=np.linalg.inv(T), **given)
    with pytest.warns(CFlowWarning, match="still without"):
        estimate_flow(
            pc0.points,
            pc0.points + np.float32(0.004),
            T_ego1_ego0=as_matrix(np.eye(3), (2, 1, 0)),
            gm0=pc0.is_ground,
            gm1=pc0.is_ground,
            **coarse,
        )
    with pytest.warns(CFlowWarning, match="millimetres"):
        points = [1000 * np.concatenate([each.points, np.zeros((5, 3), np.float32)]) for each in (pc0, pc1)]
        estimate_flow(*points, T_ego1_ego0=T, **coarse)


@pytest.mark.parametrize(
    ("change", "cause"),
    [
        (lambda points: points @ AXES[CAMERA], "camera's axes"),
        (lambda points: points @ AXES["down"], "z seems to point down"),
        (lambda points: points + (120, -40, 0), "lie around x = 1"),
        (lambda points: points @ rotations_about(2, 0.8), "degrees to the left"),
    ],
    ids=["camera", "down", "far", "turned"],
)
def test_two_clouds_with_a_transform_of_another_frame_have_one_cause(drive, change, cause):
    from cflow_torch import estimate_flow

    pc0, pc1 = drive.sweep(2), drive.sweep(3)
    T = np.linalg.inv(pc1.pose) @ pc0.pose
    with warnings.catch_warnings(record=True) as warned:
        warnings.simplefilter("always")
        points = [change(each.points.astype(np.float64)) for each in (pc0, pc1)]
        estimate_flow(*points, T_ego1_ego0=T, gm0=pc0.is_ground, gm1=pc1.is_ground, preset="paper", pixel_size=0.4)
    texts = [str(each.message) for each in warned if issubclass(each.category, CFlowWarning)]
    assert len(texts) == 1 and cause in texts[0]


def test_the_command_prints_a_page_or_json(tmp_path, capsys):
    pytest.importorskip("hydra")
    from command_line import cflow

    log = Thinned(drive_of(1, 6))
    for name, change in (("good", None), ("bad", WRONG_POSES["inverted"])):
        write_array_log(Wrong(log, poses=change, name=name), tmp_path)
    assert cflow("check", tmp_path / "good", tmp_path / "bad") == 1
    both = capsys.readouterr().out
    assert "good (arrays): nothing is wrong" in both and "bad (arrays): 1 wrong" in both
    assert "ego motion   right" in both
    assert cflow("check", tmp_path / "bad", "json=true") == 1
    (log,) = json.loads(capsys.readouterr().out)
    assert log["log"] == "bad" and {row["status"] for row in log["findings"]} == {RIGHT, WRONG}
    assert cflow("check", tmp_path / "bad", "data.read_as=inverted") == 0
    assert FOUND not in capsys.readouterr().out


def test_a_checked_log_is_picklable(drive, tmp_path):
    """Its cached judgement may hold a scale of the poses."""
    scaled_drive = Wrong(drive, poses=scaled(1.5))
    log = DeskewedLog(scaled_drive)
    assert "times as long as the motion of the points" in str(log.judgement)
    assert pickle.loads(pickle.dumps(log.judgement)).best == log.judgement.best
