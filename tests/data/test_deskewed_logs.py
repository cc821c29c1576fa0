"""Sweeps that were never de-skewed: made by the simulator, whose de-skewed twin of the same shots is the truth."""

from __future__ import annotations

import pickle
import warnings
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command_line import cflow
from scipy.spatial.transform import Rotation

from cflow_torch.data.arrays import ArraysLog, write_array_log
from cflow_torch.data.arrays.cloud_file import write_cloud
from cflow_torch.data.arrays.poses_text import write_kitti_poses, write_times
from cflow_torch.data.catalog import open_log
from cflow_torch.data.deskewing import DeskewedLog
from cflow_torch.data.finding import RIGHT
from cflow_torch.data.log import CachedLog, FlowLabels, Log, LogWrapper
from cflow_torch.data.log_check import examine
from cflow_torch.diagnosis import readings
from cflow_torch.diagnosis.stillness import Structure, static_rows, thinned_rows
from cflow_torch.simulator.drive import Drive
from cflow_torch.simulator.profiles import PROFILES
from cflow_torch.simulator.street import build_street
from cflow_torch.transforms import poses_at, rotations_about
from cflow_torch.types import CFlowError, CFlowWarning, Sweep
from cflow_torch.windows.deskewing import scan_fractions

LIDAR = PROFILES["demo"].units[0]


def make(
    speed: float = 14.0,
    is_deskewed: bool = False,
    num_sweeps: int = 8,
    reference: float = 0.5,
    seed: int = 1,
    **lidar: Any,
) -> Drive:
    """Drive past houses; the LiDAR turns clockwise, from behind, and the instant of a sweep is when it looks ahead."""
    scene = build_street(np.random.default_rng([seed, 0]))
    scene = replace(scene, ego=replace(scene.ego, speed=speed))
    profile = replace(PROFILES["demo"], units=(replace(LIDAR, **lidar),), reference=reference)
    return Drive(scene, replace(profile, is_rolling=True, is_deskewed=is_deskewed), seed, num_sweeps, "drive")


class Untimed(LogWrapper):
    """The log of a format that has no times of points."""

    lidar_position = LIDAR.position

    @property
    def unwrapped(self) -> Log:
        return self

    def sweep(self, index: int) -> Sweep:
        return replace(self.log.sweep(index), point_times=None)


class Later(LogWrapper):
    """A drive of another year: Argoverse 2, which is known to be compensated, is recognised by its time stamps."""

    def __init__(self, log: Drive) -> None:
        super().__init__(log)
        self.timestamps = [stamp + 10**18 for stamp in log.timestamps]

    def sweep(self, index: int) -> Sweep:
        return replace(self.log.sweep(index), timestamp_ns=self.timestamps[index])


@pytest.fixture(scope="module")
def raw() -> Drive:
    return make()


@pytest.fixture(scope="module")
def truth() -> Drive:
    return make(is_deskewed=True)


def largest_error(log: Log, truth: Log, index: int) -> float:
    """Return the largest distance of static points from their truth, metres."""
    points, expected = np.asarray(log.sweep(index).points), np.asarray(truth.sweep(index).points)
    return float(np.linalg.norm(points - expected, axis=1).max())


def test_the_direction_is_found_and_points_return_to_the_truth(raw: Drive, truth: Drive) -> None:
    log = DeskewedLog(Untimed(raw))
    assert log.scan == "clockwise" and "data.deskew=clockwise" in log.findings()[-1].text
    assert largest_error(raw, truth, 3) > 0.5
    # The vehicle turns by 4.5 degrees a sweep. A chord between two poses is off its arc by 1.4 cm.
    assert max(largest_error(log, truth, index) for index in (3, 7)) < 0.015
    assert np.abs(log.sweep(3).point_times - raw.sweep(3).point_times).max() < 2e-4
    again = pickle.loads(pickle.dumps(log))
    assert np.array_equal(again.sweep(3).points, log.sweep(3).points) and again.scan == log.scan


def test_times_that_count_down_do_not_hide_the_azimuth(raw: Drive) -> None:
    class CountingDown(Untimed):
        has_raw_times = True

        def sweep(self, index: int) -> Sweep:
            sweep = self.log.sweep(index)
            return replace(sweep, point_times=-np.asarray(sweep.point_times))

    log = DeskewedLog(CountingDown(raw))
    assert log.scan == "clockwise" and "with times" in log.findings()[-1].text


def test_a_lidar_that_turns_the_other_way_is_found() -> None:
    log = DeskewedLog(Untimed(make(start=-180.0, span=360.0)))
    assert log.scan == "counterclockwise"


class Changed(LogWrapper):
    """A log whose points and their times are changed."""

    def __init__(self, log: Log, change: Any) -> None:
        super().__init__(log)
        self.change = change

    def sweep(self, index: int) -> Sweep:
        sweep = self.log.sweep(index)
        return Sweep(self.change(np.asarray(sweep.points)), None, sweep.pose, sweep.timestamp_ns)


def test_a_direction_and_a_reading_of_the_poses_are_found_together(data_root: Path) -> None:
    file = data_root / "kitti-raw" / "kitti-raw-0027-empty16.h5"
    if not file.exists():
        pytest.skip(f"needs {file.name}")
    log = pytest.importorskip("cflow_torch.data.hdf5").HDF5Log(file)
    mirrored = DeskewedLog(Changed(log, lambda points: points[:, :3] * np.float32([1, -1, 1])))
    assert mirrored.scan.startswith("counterclockwise") and mirrored.judgement.best == ("mirrored",)


def test_the_direction_is_found_if_few_points_are_measured_again(raw: Drive) -> None:
    few = DeskewedLog(Changed(Untimed(raw), lambda points: points[::4]))
    assert few.scan == "clockwise" and few.judgement.given < 0.1 and not few.judgement.is_low


@pytest.mark.parametrize(
    ("start", "deskew", "reading"),
    [(90.0, "auto", "clockwise_left"), (0.0, "clockwise_ahead", "clockwise_ahead")],
)
def test_a_turn_may_begin_elsewhere(start: float, deskew: str, reading: str) -> None:
    raw, truth = (make(start=start, is_deskewed=is_deskewed) for is_deskewed in (False, True))
    log = DeskewedLog(Untimed(raw), deskew)
    assert log.scan == reading
    # The instant of the simulated sweep is the middle of its turn. That of the reading is when the LiDAR looks ahead.
    later = 0.05 - 0.1 * (start / 360)
    times = log.sweep(4).point_times + later - 0.05 - raw.sweep(4).point_times
    assert np.abs(times - np.median(times)).max() < 2e-4, "no point is a turn off"
    shares = []
    for given in (raw, log, truth):
        sweeps = [given.sweep(index) for index in (2, 6)]
        source, target = (np.asarray(sweep.points)[static_rows(sweep.points, sweep.is_ground)] for sweep in sweeps)
        T = np.linalg.inv(sweeps[1].pose) @ sweeps[0].pose
        shares.append(Structure(target).share(source[thinned_rows(source)], T))
    assert shares[0] < 0.85 * shares[2] and shares[1] > 0.95 * shares[2]


@pytest.mark.parametrize(
    ("start", "span", "reading"), [(0.0, -360.0, "clockwise_ahead"), (-90.0, 360.0, "counterclockwise_right")]
)
def test_a_direction_is_found_where_turns_do_not_begin_behind(start: float, span: float, reading: str) -> None:
    """The seam of the turn hides the direction, if we only compare turns that begin behind."""
    log = DeskewedLog(Untimed(make(speed=15.0, num_sweeps=10, start=start, span=span)))
    assert log.scan == reading


@pytest.mark.parametrize(("reference", "reading"), [(0.0, "clockwise_at_start"), (1.0, "clockwise_at_end")])
def test_the_instant_of_a_sweep_may_be_the_start_or_the_end_of_its_turn(reference: float, reading: str) -> None:
    """Drivers stamp the start or the end of a turn. This shows where the vehicle begins to turn."""
    raw, truth = (make(10.0, each, reference=reference, seed=2) for each in (False, True))
    log = DeskewedLog(Untimed(raw))
    assert log.scan == reading and f"data.deskew={reading}" in log.findings()[-1].text
    assert max(largest_error(log, truth, index) for index in (2, 6)) < 0.015
    assert np.abs(log.sweep(3).point_times - raw.sweep(3).point_times).max() < 2e-4


@pytest.mark.parametrize("constant", [0.0, 0.04])
def test_times_that_are_all_equal_do_not_say_anything(raw: Drive, constant: float) -> None:
    class Equal(Untimed):
        def sweep(self, index: int) -> Sweep:
            sweep = self.log.sweep(index)
            return replace(sweep, point_times=np.full(len(sweep.points), constant, np.float32))

    assert DeskewedLog(Equal(raw)).scan == "clockwise"


@pytest.mark.parametrize("case", ["compensated", "slow"])
def test_compensated_and_slow_sweeps_stay_as_they_are(case: str, truth: Drive) -> None:
    given = truth if case == "compensated" else make(speed=1.0, num_sweeps=4)
    log = DeskewedLog(Untimed(given))
    assert log.scan == "off" and [finding.status for finding in log.findings()] == [RIGHT]
    assert np.array_equal(log.sweep(1).points, given.sweep(1).points) and log.sweep(1).point_times is None


def write_clouds(drive: Drive, folder: Path, suffix: str, unit: float = 1e9, kind: Any = np.uint32) -> Path:
    """Write a folder of clouds with a column t, the time since the first shot or, by `unit` 1e6, since 1970 in us."""
    (folder / "points").mkdir(parents=True)
    for index in range(len(drive)):
        sweep = drive.sweep(index)
        seconds = np.asarray(sweep.point_times)
        times = (seconds * 1e9).round() if unit == 1e9 else drive.timestamps[index] / 1e3 + seconds * 1e6
        name = f"{index:06d}{suffix}"
        write_cloud(folder / "points" / name, sweep.points, {"t": times.astype(kind)})
    write_kitti_poses(folder / "poses.txt", drive.poses)
    write_times(folder / "times.txt", drive.timestamps)
    return folder


@pytest.mark.parametrize(
    ("suffix", "unit", "kind"),
    [
        (".pcd", 1e9, np.int32),
        pytest.param(".ply", 1e6, np.float64, marks=pytest.mark.slow),
        (".npy", 1e6, np.int64),
    ],
)
def test_times_in_files_are_used(raw: Drive, truth: Drive, tmp_path: Path, suffix: str, unit: float, kind: Any) -> None:
    if suffix == ".pcd":
        pytest.importorskip("pypcd4")
    folder = write_clouds(raw, tmp_path / "drive", suffix, unit, kind)
    with pytest.warns(CFlowWarning, match="moves? each point.*times of its points.*data.deskew=times"):
        log: Any = open_log("arrays", folder)
    assert log.scan == "times"
    assert max(largest_error(log, truth, index) for index in (3, 7)) < 0.015
    assert np.abs(log.sweep(3).point_times - raw.sweep(3).point_times).max() < 1e-5
    if suffix != ".npy":
        return
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        chosen = open_log("arrays", folder, find_ground="grid", deskew="times")
        stored = open_log("arrays", folder, find_ground="grid", deskew="off", check=False)
        same = open_log("arrays", folder, find_ground="grid", read_as="times", check=False)
        assert np.array_equal(same.sweep(1).points, chosen.sweep(1).points)
    assert np.array_equal(chosen.sweep(3).points, log.sweep(3).points)
    assert np.array_equal(stored.sweep(3).points, raw.sweep(3).points)


def test_compensated_clouds_with_times_are_left_alone(truth: Drive, tmp_path: Path) -> None:
    log: Any = open_log("arrays", write_clouds(truth, tmp_path / "drive", ".npy", kind=np.int64), check=False)
    assert log.scan == "off" and any("already" in found.text for found in log.findings())
    assert np.array_equal(log.sweep(3).points, truth.sweep(3).points)
    assert np.allclose(log.sweep(3).point_times, truth.sweep(3).point_times, atol=1e-6)


def test_a_scene_with_times_is_measured_before_they_are_used(raw: Drive, truth: Drive, tmp_path: Path) -> None:
    pytest.importorskip("h5py")
    from cflow_torch.data.hdf5 import write_hdf5_scene

    for name, drive in (("raw", raw), ("truth", truth)):
        write_hdf5_scene(Later(drive), tmp_path / f"{name}.h5", 0)
    logs: Any = [open_log("hdf5", tmp_path / f"{name}.h5", check=False) for name in ("raw", "truth")]
    assert [log.scan for log in logs] == ["times", "off"]
    assert largest_error(logs[0], truth, 3) < 0.015 and largest_error(logs[1], truth, 3) == 0


class OneCar(Log):
    """A vehicle at 20 m/s meets a car at 15 m/s; boxes are drawn around points as a clockwise LiDAR measures them."""

    log_id = "car"
    timestamps = [0, 10**8, 2 * 10**8]
    SPEED, CAR = 2.0, -1.5  # metres a sweep

    def __init__(self) -> None:
        self.poses = np.tile(np.eye(4), (3, 1, 1))
        self.poses[:, 0, 3] = self.SPEED * np.arange(3)

    def measured(self, index: int) -> np.ndarray:
        """Return the car as seen, by iteration: the azimuth sets the time, and the time the place."""
        fraction = np.zeros(5)
        for _ in range(30):
            x = 16 + self.CAR * (index + fraction) - self.SPEED * (index + fraction)
            points = np.stack([x + np.arange(5), np.full(5, 4.0), np.zeros(5)], 1)
            fraction = scan_fractions(points, "clockwise")
        return points

    def sweep(self, index: int) -> Sweep:
        house = np.array([[3.0, 12, 1]])
        points = np.concatenate([self.measured(index), house])
        return Sweep(points.astype(np.float32), None, self.poses[index], self.timestamps[index])

    def _labels(self, index: int) -> FlowLabels:
        flow = np.concatenate([self.measured(index + 1) - self.measured(index), [[-self.SPEED, 0, 0]]])
        return FlowLabels(flow.astype(np.float32), np.ones(6, np.uint8), np.ones(6, bool))


def test_labels_of_moving_objects_become_motions_between_the_instants() -> None:
    own = OneCar()
    log = DeskewedLog(own, "clockwise")
    before: Any = own.labels(1)
    after: Any = log.labels(1)
    residual = after.flow - (-own.SPEED, 0, 0)
    assert np.abs(before.flow[:5, 0] + own.SPEED - own.CAR).max() > 0.05
    assert np.abs(residual[:5] - (own.CAR, 0, 0)).max() < 1e-4, "the speed of the car"
    assert np.abs(residual[5]).max() < 1e-6, "static points stay static"


@pytest.mark.parametrize(
    ("deskew", "message"),
    [
        ("left", "deskew='left'.*times, off, clockwise, counterclockwise"),
        ("times", "no times of points for deskew=times"),
    ],
)
def test_settings_that_cannot_be_used_are_refused(deskew: str, message: str, raw: Drive) -> None:
    with pytest.raises(CFlowError, match=message):
        DeskewedLog(Untimed(raw), deskew).sweep(0)
    with pytest.raises(CFlowError, match="deskew='left'"):
        open_log("arrays", "nowhere", deskew="left")


def test_the_command_line_takes_the_setting(raw: Drive, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = write_clouds(raw, tmp_path / "drive", ".npy", kind=np.int64)
    flow = ("flow", "data=arrays", f"data.root={folder}", "model=paper", "data.find_ground=grid")
    assert cflow(*flow, f"output={tmp_path / 'out'}", "data.deskew=sideways") == 1
    assert "deskew='sideways'" in capsys.readouterr().err


class Half(Untimed):
    """Every second sweep."""

    def __init__(self, log: Drive, turn_seconds: float | None = None) -> None:
        super().__init__(log)
        self.timestamps = log.timestamps[1::2]
        self.poses = log.poses[1::2]
        self.turn_seconds = turn_seconds

    def sweep(self, index: int) -> Sweep:
        return super().sweep(2 * index + 1)


class Slow(Untimed):
    """Twice as slow, so that turns and intervals last 0.2 s."""

    def __init__(self, log: Drive) -> None:
        super().__init__(log)
        self.timestamps = [2 * stamp for stamp in log.timestamps]

    def sweep(self, index: int) -> Sweep:
        return replace(super().sweep(index), timestamp_ns=self.timestamps[index])


def test_turns_may_be_shorter_than_the_intervals_of_a_slow_log(truth: Drive, raw: Drive) -> None:
    half = DeskewedLog(Half(make(num_sweeps=16)))
    assert half.scan == "clockwise"
    for log, index, true in ((half, 1, 3), (DeskewedLog(Slow(raw), "clockwise"), 3, 3)):
        moved = np.asarray(log.sweep(index).points)
        assert np.linalg.norm(moved - truth.sweep(true).points, axis=1).max() < 0.06


def test_a_log_of_every_second_sweep_is_moved_by_turns_not_by_pose_intervals(raw: Drive, truth: Drive) -> None:
    moved = np.asarray(DeskewedLog(Half(raw, 0.1), "clockwise").sweep(1).points)
    assert np.linalg.norm(moved - truth.sweep(3).points, axis=1).max() < 0.06  # chords of twice the length


@pytest.mark.parametrize(
    ("scene", "reading"),
    [
        ("kitti-raw/kitti-raw-0027-a", "clockwise"),
        pytest.param("kitti-raw/kitti-raw-0027-b2", "clockwise", marks=pytest.mark.slow),
        pytest.param("kitti-raw/kitti-raw-0027-empty16", "clockwise", marks=pytest.mark.slow),
        ("kitti-0000/kitti-0000-a", "off"),
        pytest.param("kitti-0000/kitti-0000-c2", "off", marks=pytest.mark.slow),
        ("pandaset-002/panda-002-c", "off"),
    ],
)
def test_real_drives(scene: str, reading: str, data_root: Path) -> None:
    pytest.importorskip("h5py")
    file = data_root / f"{scene}.h5"
    if not file.exists():
        pytest.skip(f"needs {file.name}")
    log: Any = open_log("hdf5", file, check=False)
    assert log.scan == reading


class InBag(Untimed):
    """A log as `BagLog`: raw times are expected, and its trajectory has more poses than one per sweep."""

    has_raw_times = True

    def __init__(self, log: Drive) -> None:
        super().__init__(log)
        times = np.array(log.timestamps, np.int64)
        between = np.arange(times[0], times[-1], 10**7)
        self.trajectory = between, poses_at(between, times, np.array(log.poses))

    def sweep(self, index: int) -> Sweep:
        return self.log.sweep(index)


@pytest.mark.parametrize("form", ["bag", "folder"])
def test_the_azimuth_and_all_poses_move_points(form: str, raw: Drive, truth: Drive, tmp_path: Path) -> None:
    """The vehicle begins to turn in the first sweeps, so its motion changes between the poses of two sweeps."""
    log: Any = InBag(raw)
    times = np.arange(raw.timestamps[0] - 10**8, raw.timestamps[-1] + 10**8, 10**7)
    log.trajectory = times, np.concatenate([raw.poses_at(0, np.array([time - raw.timestamps[0]])) for time in times])
    if form == "folder":
        folder = write_array_log(Untimed(raw), tmp_path)
        times, poses = log.trajectory
        rows = np.column_stack([times * 1e-9, poses[:, :3, 3], Rotation.from_matrix(poses[:, :3, :3]).as_quat()])
        (folder / "poses.txt").unlink()
        np.savetxt(folder / "poses.txt", rows, "%.9f")
        log = ArraysLog(folder, ground=None)
    coarse = InBag(raw)
    coarse.trajectory = None
    errors = [
        max(largest_error(DeskewedLog(each, "clockwise"), truth, index) for index in range(8)) for each in (log, coarse)
    ]
    assert errors[0] < (0.03 if form == "bag" else 0.15), "a folder does not know the place of the LiDAR"
    assert errors[1] > 1


@pytest.mark.parametrize(("case", "reading"), [("raw", "times"), ("truth", "off")])
def test_times_of_points_are_used_only_if_points_fit_better(case: str, reading: str, request: Any) -> None:
    """Clouds of odometry programs are compensated, and still have their times."""
    drive, truth = request.getfixturevalue(case), request.getfixturevalue("truth")
    log = DeskewedLog(InBag(drive))
    assert log.scan == reading
    assert max(largest_error(log, truth, index) for index in (3, 5)) < 0.02, "a chord between poses is off its arc"


def test_slow_sweeps_with_times_are_compared_too() -> None:
    for is_deskewed in (False, True):
        log = DeskewedLog(InBag(make(speed=3.0, is_deskewed=is_deskewed)))
        assert log.scan == ("off" if is_deskewed else "times")


def test_the_motion_over_a_gap_is_not_that_within_a_sweep(raw: Drive, truth: Drive) -> None:
    late = Untimed(raw)
    late.timestamps = [stamp + 20 * 10**9 * (k > 3) for k, stamp in enumerate(raw.timestamps)]
    late.gaps = frozenset([3])
    log = DeskewedLog(late, "clockwise")
    assert max(largest_error(log, truth, index) for index in (2, 3, 4, 5)) < 0.05


def test_without_times_steps_over_missing_sweeps_move_no_points() -> None:
    kept = [0, 1, 2, 3, 5, 6, 7, 8, 9, 10, 11]
    raw, truth = make(num_sweeps=12), make(num_sweeps=12, is_deskewed=True)

    class Kept(Untimed):
        poses = raw.poses[kept]

        def __init__(self, log: Drive) -> None:
            super().__init__(log)
            self.timestamps = range(len(kept))

        def sweep(self, index: int) -> Sweep:
            return replace(super().sweep(kept[index]), timestamp_ns=None)

    log = DeskewedLog(Kept(raw))
    assert log.scan.startswith("clockwise")
    for index in (3, 4):
        moved, expected = np.asarray(log.sweep(index).points), np.asarray(truth.sweep(kept[index]).points)
        assert np.linalg.norm(moved - expected, axis=1).max() < 0.05


def test_a_sweep_that_repeats_the_one_before_is_told_though_both_are_moved(raw: Drive) -> None:
    class Repeated(Untimed):
        def sweep(self, index: int) -> Sweep:
            sweep = super().sweep(index)
            again = replace(super().sweep(4), pose=sweep.pose, timestamp_ns=sweep.timestamp_ns)
            return again if index == 5 else sweep

    log = CachedLog(DeskewedLog(Repeated(raw), "clockwise"), 8)
    assert [index for index in range(1, 8) if log.repeats(index)] == [5]
    assert not np.array_equal(log.sweep(4).points, log.sweep(5).points)
    texts = [finding.text for finding in examine(log) if finding.topic == "sweeps"]
    assert texts[0].startswith("1 of them repeat the points of the sweep before, the first is sweep 5")


def test_a_direction_without_poses_is_said(raw: Drive) -> None:
    class Unposed(Untimed):
        poses = None

        def sweep(self, index: int) -> Sweep:
            return replace(super().sweep(index), pose=None)

    log = DeskewedLog(Unposed(raw), "clockwise")
    with pytest.warns(CFlowWarning, match="deskew=clockwise needs poses, and sweep 1 has none: try data.odometry=true"):
        assert log.sweep(1) is not None


def test_points_of_four_columns_and_of_nan_move_along_a_trajectory(raw: Drive) -> None:
    class Four(Untimed):
        trajectory = np.array(raw.timestamps), raw.poses

        def sweep(self, index: int) -> Sweep:
            sweep = super().sweep(index)
            points = np.column_stack([sweep.points, np.zeros(len(sweep.points), np.float32)])
            points[0] = np.nan
            return replace(sweep, points=points)

    three = DeskewedLog(Untimed(raw), "clockwise")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        moved = DeskewedLog(Four(raw), "clockwise").sweep(2).points
    assert np.isnan(moved[0]).all() and np.abs(moved[1:] - three.sweep(2).points[1:]).max() < 0.02


def test_a_turned_lidar_whose_points_have_times_is_named(raw: Drive, monkeypatch: pytest.MonkeyPatch) -> None:
    """ZOD: x of the LiDAR points to the right, so nothing fits as given, and noise chooses between the scans."""

    class Turned(LogWrapper):
        has_raw_times = True

        def sweep(self, index: int) -> Sweep:
            sweep = self.log.sweep(index)
            return replace(sweep, points=np.asarray(sweep.points) @ rotations_about(2, np.pi / 2).T.astype("f4"))

    monkeypatch.setattr(readings, "_best_scan", lambda pairs: ("times", {}))
    log = DeskewedLog(Turned(raw))
    assert log.judgement is not None and log.judgement.best == ("left",) and log.scan == "off"
