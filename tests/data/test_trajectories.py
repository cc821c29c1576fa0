"""Poses of odometry programs: late, early, rounded, with gaps, named columns, other units; and names that are times."""

from __future__ import annotations

import gzip
import io
import json
import re
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml  # type: ignore[import-untyped]

from cflow_torch import CFlowError
from cflow_torch.data.arrays import poses_text
from cflow_torch.data.arrays.cloud_file import write_cloud
from cflow_torch.data.arrays.folder import find_array_logs
from cflow_torch.data.arrays.reader import ArraysLog
from cflow_torch.data.arrays.stamps import nanoseconds_of_dates, nanoseconds_of_numbers, times_of_names
from cflow_torch.data.catalog import open_log
from cflow_torch.data.column_names import role_of_name
from cflow_torch.data.log import Log, window
from cflow_torch.data.trajectory import Trajectory, fit_to_sweeps
from cflow_torch.diagnosis.conventions import READINGS
from cflow_torch.simulator import make_drive
from cflow_torch.transforms import as_matrix, rotations_about, to_quaternions
from cflow_torch.types import CFlowWarning, Sweep

START, COUNT = 1_700_000_000_123_456_789, 12
STAMPS = [START + k * 100_000_123 for k in range(COUNT)]


def clouds(folder: Path, names: Any = STAMPS) -> Path:
    """Clouds whose first x is their number."""
    folder.mkdir(parents=True, exist_ok=True)
    for k, name in enumerate(names):
        np.save(folder / f"{name}.npy", np.full((4, 3), k + 1, np.float32))
    return folder


def line(k: int, time: str, order: str = "t x y z qx qy qz qw", separator: str = " ") -> str:
    values = {"t": time, "x": k, "y": 0.5, "z": 0, "qx": 0, "qy": 0, "qz": 0.6, "qw": 0.8, "n": k, "vx": 9}
    return separator.join(str(values[name]) for name in order.split())


def seconds(stamp: int) -> str:
    return f"{stamp // 10**9}.{stamp % 10**9:09d}"


EXACT = [line(k, seconds(stamp)) for k, stamp in enumerate(STAMPS)]


@pytest.mark.parametrize(
    ("lines", "kept", "gaps", "note"),
    [
        (EXACT, range(12), [], ""),
        ([line(k, f"{stamp * 1e-9:.7f}") for k, stamp in enumerate(STAMPS)], range(12), [], ""),  # through a float64
        (EXACT[3:], range(3, 12), [], "3 of 12 sweeps .* 3 before the first pose"),
        (EXACT[2:10], range(2, 10), [], "4 of 12 sweeps .* 2 before the first pose, 2 after the last pose"),
        (EXACT[:4] + EXACT[10:], [0, 1, 2, 3, 10, 11], [3], "6 of 12 sweeps .* in gaps of more than 0.5 s"),
        (EXACT[:5] + EXACT[4:], range(12), [], ""),  # one line twice
        (EXACT[:4] + EXACT[7:], range(12), [], ""),  # we interpolate over 0.4 s
    ],
)
def test_sweeps_without_a_pose_are_left_out_and_counted(tmp_path, recwarn, lines, kept, gaps, note) -> None:
    (clouds(tmp_path) / "poses.txt").write_text("\n".join(lines))
    log = ArraysLog(tmp_path)
    assert [sweep.points[0, 0] - 1 for sweep in log] == list(kept) and log.gaps == set(gaps)
    assert np.allclose(log.poses[:, 0, 3], list(kept), atol=1e-5)
    # A file that a test before left open would be another warning.
    texts = [str(warning.message) for warning in recwarn.list if issubclass(warning.category, CFlowWarning)]
    assert len(texts) == bool(note) and log.notes == [text.partition(": ")[2] for text in texts]
    if note:
        with pytest.warns(CFlowWarning, match=note):
            ArraysLog(tmp_path)


def test_windows_end_at_a_gap(tmp_path) -> None:
    (clouds(tmp_path) / "poses.txt").write_text("\n".join(EXACT[:4] + EXACT[10:]))
    with pytest.warns(CFlowWarning):
        log = ArraysLog(tmp_path)
    assert len(window(log, 2, 4, 4).pch) == 2 and len(window(log, 2, 4, 4).pcf) == 0
    assert len(window(log, 4, 4, 4).pch) == 0 and len(window(log, 1, 4, 4).pcf) == 1


def test_other_clocks_are_named(tmp_path) -> None:
    folder = clouds(tmp_path)
    (folder / "poses.txt").write_text("\n".join(line(k, str(k / 10)) for k in range(COUNT)))
    with pytest.raises(CFlowError, match=r"clocks differ by about 1\.7e\+09 s"):
        ArraysLog(folder)
    (folder / "poses.txt").write_text("\n".join(line(k, seconds(START - 10**9 + k * 10**10)) for k in range(3)))
    with pytest.raises(CFlowError, match="a pose every 10 s"):
        ArraysLog(folder)


@pytest.mark.parametrize(
    ("file", "header", "order", "separator", "unit"),
    [
        ("poses.txt", "num t x y z qx qy qz qw", "n t x y z qx qy qz qw", " ", 10**9),
        ("poses.txt", "timestamp x y z q_x q_y q_z q_w", "t x y z qx qy qz qw", " ", 10**9),
        ("poses.txt", "# timestamp tx ty tz qw qx qy qz", "t x y z qw qx qy qz", " ", 10**9),
        ("poses.csv", "timestamp,tx,ty,tz,qw,qx,qy,qz", "t x y z qw qx qy qz", ",", 10**9),
        (
            "poses.csv",
            "#timestamp [ns], p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x [], q_RS_y [], q_RS_z []",
            "t x y z qw qx qy qz",
            ",",
            1,
        ),
        (
            "odometry.csv",
            "header.stamp,pose.pose.position.x,pose.pose.position.y,pose.pose.position.z,pose.pose.orientation.x,"
            "pose.pose.orientation.y,pose.pose.orientation.z,pose.pose.orientation.w,twist.twist.linear.x",
            "t x y z qx qy qz qw vx",
            ",",
            10**9,
        ),
        ("poses.csv", "time,north,east,up,qx,qy,qz,qw", "t y x z qx qy qz qw", ",", 1),
        ("trajectory.txt", "", "t x y z qx qy qz qw", " ", 1),
        ("trajectory.txt", "", "t x y z qx qy qz qw", " ", 1000),
    ],
)
def test_columns_are_found_by_name_and_times_by_size(tmp_path, file, header, order, separator, unit) -> None:
    texts = [seconds(stamp) if unit == 10**9 else str(stamp // unit) for stamp in STAMPS]
    lines = [header] * bool(header) + [line(k, text, order, separator) for k, text in enumerate(texts)]
    (clouds(tmp_path / "a") / file).write_text("\n".join(lines))
    log: Any = ArraysLog(tmp_path / "a")
    assert len(log) == COUNT and np.allclose(log.poses[:, 0, 3], range(COUNT), atol=1e-4)
    assert np.allclose(log.poses[:, :2, :2], [[0.28, -0.96], [0.96, 0.28]], atol=1e-12)


def test_seconds_and_nanoseconds_in_two_columns(tmp_path) -> None:
    header = "secs,nsecs,x,y,z,qx,qy,qz,qw"
    rows = [line(k, f"{s // 10**9},{s % 10**9}", separator=",") for k, s in enumerate(STAMPS)]
    (tmp_path / "a.csv").write_text("\n".join([header, *rows]))
    assert poses_text.read_poses(tmp_path / "a.csv").times_ns.tolist() == STAMPS
    (tmp_path / "a.csv").write_text("\n".join(["note: these are\nmy poses", *rows]))
    with pytest.raises(CFlowError, match=r"a\.csv.*text before its numbers"):
        poses_text.read_poses(tmp_path / "a.csv")
    (tmp_path / "a.csv").write_text("\n".join([*EXACT[:2], line(9, seconds(STAMPS[1]))]))
    with pytest.raises(CFlowError, match="ascend, and number 3 does not: write all digits"):
        poses_text.read_poses(tmp_path / "a.csv")


SHIFTED = [1_700_000_000_050_000_000 + k * 50_000_000 for k in range(24)]


@pytest.mark.parametrize(
    "name",
    [
        lambda stamp: str(stamp / 1e9),  # 1700000000.1, 1700000000.15, 1700000000.2
        seconds,
        lambda stamp: seconds(stamp).replace(".", "_"),
        lambda stamp: f"{stamp // 10**9}_{stamp % 10**9}" if stamp != 1_700_000_001_000_000_000 else "1700000001_0",
        lambda stamp: f"cloud_{stamp / 1e9:.6f}",
        lambda stamp: f"scan_0001_{stamp // 10**9}.{stamp % 10**9 // 1000:06d}",
        lambda stamp: f"{np.datetime64(stamp, 'us' if stamp < 10**17 else 'ns')}".replace("T", "_").replace(":", "-"),
        str,
    ],
)
def test_names_are_times_and_sort_the_clouds(tmp_path, name: Any) -> None:
    log = ArraysLog(clouds(tmp_path / "a", [name(stamp) for stamp in SHIFTED]))
    assert np.abs(np.subtract(log.timestamps, SHIFTED)).max() < 1000, "a float has steps of 240 ns"
    assert [sweep.points[0, 0] for sweep in log] == list(range(1, 25))


def test_names_are_milliseconds() -> None:
    assert times_of_names(["1700000000123", "1700000000223"]) == [1_700_000_000_123_000_000, 1_700_000_000_223_000_000]


@pytest.mark.parametrize("fraction", ["{}", ".{}", "{}000", "_{}"])
def test_names_are_dates_without_separators(fraction: str) -> None:
    """A number of 17 digits was taken for microseconds, which an int64 of nanoseconds cannot hold."""
    names = [f"20231114221{320 + k // 10}" + fraction.format(f"{k % 10}00") for k in range(24)]
    assert times_of_names(names) == [1_700_000_000_000_000_000 + k * 100_000_000 for k in range(24)]
    assert times_of_names(["99999999999999997", "99999999999999998"]) is None


@pytest.mark.parametrize("first", ["000001", "frame1", "000_001", "2024_01_05", "0000000000001", "0000000000000000001"])
def test_other_names_are_no_times(first: str) -> None:
    assert times_of_names([first, first[:-1] + "2"]) is None and times_of_names(["1.5", "a"]) is None


@pytest.mark.parametrize("start", ["2023-05-12-10-00-00_", "20230512_", "os1.", "2023-05-12 10:00:00."])
def test_numbers_that_count_the_files_are_no_times(start: str) -> None:
    for step in (1, 5):
        assert times_of_names([f"{start}{k:06d}" for k in range(0, 60, step)]) is None
    names = [f"1700000000.{k:03d}_{number:06d}" for number, k in enumerate(range(0, 900, 50))]
    assert times_of_names(names) == [1_700_000_000_000_000_000 + 50_000_000 * k for k in range(18)]


def test_the_fractions_of_regular_times_are_no_counter() -> None:
    stamps = [1_700_000_000_000_000_000 + k * 100_000_000 + 1000 * (k * 7 % 11) for k in range(600)]
    assert times_of_names([f"{stamp // 10**9}.{stamp % 10**9 // 1000:06d}" for stamp in stamps]) == stamps


def test_dates_may_have_a_time_zone() -> None:
    noon, utc = "2023-11-14T22:13:20", 1_700_000_000_000_000_000
    zones = {"": 0, "Z": 0, "+08:00": -8, "-0330": 3.5, ".25+01:00": -1, "_25": 0}
    for end, hours in zones.items():
        expected = utc + int(hours * 3600) * 10**9 + (250_000_000 if "25" in end else 0)
        assert nanoseconds_of_dates([noon + end]) == [expected], end
    assert nanoseconds_of_dates(["2023-11-14-22-13-20-0250"]) == [utc + 25_000_000]


def test_a_missing_sweep_shortens_windows_and_fails_its_pairs(tmp_path) -> None:
    log: Log = ArraysLog(clouds(tmp_path))
    (tmp_path / f"{STAMPS[5]}.npy").rename(tmp_path / "5.moved")
    for index in (4, 5):
        with pytest.raises(CFlowError, match=str(STAMPS[5])):
            window(log, index, 4)
    with pytest.warns(CFlowWarning, match="windows near sweep 5 are shorter, because .* is missing"):
        found = window(log, 7, 4)
    assert [sweep.points[0, 0] for sweep in found.pch] == [7] and isinstance(found.pc0, Sweep)
    assert len(window(log, 1, 4, 4).pcf) == 2 and len(window(log, 10, 4).pch) == 4
    (tmp_path / f"{STAMPS[5]}.npy").write_bytes((tmp_path / "5.moved").read_bytes()[:100])
    with pytest.warns(CFlowWarning, match="windows near sweep 5 are shorter, because .* truncated or damaged"):
        assert len(window(log, 7, 4).pch) == 1
    (tmp_path / f"{STAMPS[5]}.npy").unlink()
    (tmp_path / f"{STAMPS[5]}.npy").mkdir()
    with pytest.raises(CFlowError, match=str(STAMPS[5])):  # of the file system, so that the next run may read it
        window(log, 7, 4)


def test_a_compressed_sweep_with_a_wrong_checksum_shortens_windows(tmp_path) -> None:
    """gzip's error for it is an OSError, but no other run reads the sweep."""
    for file in list(clouds(tmp_path).glob("*.npy")):
        content = gzip.compress(file.read_bytes())
        if file.stem == str(STAMPS[5]):
            content = content[:-8] + bytes(4) + content[-4:]
        file.with_name(f"{file.name}.gz").write_bytes(content)
        file.unlink()
    log: Log = ArraysLog(tmp_path)
    with pytest.raises(CFlowError, match="BadGzipFile: CRC check failed"):
        window(log, 4)
    with pytest.warns(CFlowWarning, match="windows near sweep 5 are shorter, because .*BadGzipFile: CRC"):
        assert [sweep.points[0, 0] for sweep in window(log, 7, 4).pch] == [7]


def test_a_vehicle_that_stands_has_a_pose_in_every_line(tmp_path: Path) -> None:
    """Lines without times may be equal. Only a line with a time can be a repetition."""
    np.savetxt(tmp_path / "poses.txt", np.tile(np.eye(4)[:3].reshape(12), (4, 1)))
    assert poses_text.read_poses(tmp_path / "poses.txt").poses.shape == (4, 4, 4)


POSES = as_matrix(rotations_about(2, 3 + 0.1 * np.arange(12)) @ rotations_about(0, 0.02), np.arange(36).reshape(12, 3))
QUATERNIONS = to_quaternions(POSES[:, :3, :3]).tolist()
ANGLES = [(0.02, 0, (3 + 0.1 * k + np.pi) % (2 * np.pi) - np.pi) for k in range(12)]  # roll, pitch, yaw


DEGREES = [(*pose[:3, 3], *np.degrees(angles)) for pose, angles in zip(POSES, ANGLES)]


def rows(table: Any, separator: str = " ") -> list[str]:
    return [separator.join(f"{value:.17g}" for value in row) for row in table]


LAYOUTS = {
    "13 numbers": rows([(k, *pose[:3].reshape(-1)) for k, pose in enumerate(POSES)]),
    "17 numbers": rows([(k, *pose.reshape(-1)) for k, pose in enumerate(POSES)]),
    "16 numbers": rows(POSES.reshape(12, 16), ","),
    "by columns": rows(POSES.transpose(0, 2, 1).reshape(12, 16)),
    "time, by columns": rows([(k, *pose.T.reshape(-1)) for k, pose in enumerate(POSES)]),
    "12 numbers and the time": [
        "# R00 R01 R02 tx ... time",
        *rows([(*p[:3].reshape(-1), k) for k, p in enumerate(POSES)]),
    ],
    "trajectory of Open3D": [line for k, pose in enumerate(POSES) for line in (f"{k} {k} {k + 1}", *rows(pose))],
    "time and angles": rows([(k, *POSES[k, :3, 3], *ANGLES[k]) for k in range(12)], ","),
    "angles": rows([(*POSES[k, :3, 3], *ANGLES[k]) for k in range(12)]),
    "quaternion x y z w first": rows([(*q[1:], q[0], *pose[:3, 3]) for q, pose in zip(QUATERNIONS, POSES)]),
    "time, quaternion w first": rows([(k, *QUATERNIONS[k], *POSES[k, :3, 3]) for k in range(12)]),
    "vertices of g2o": [
        *(
            f"VERTEX_SE3:QUAT {k} {rows([[*POSES[k, :3, 3], *QUATERNIONS[k][1:], QUATERNIONS[k][0]]])[0]}"
            for k in range(12)
        ),
        "EDGE_SE3:QUAT 0 1 1 0 0 0 0 0 1 " + "1 " * 21,
    ],
    "printed by NumPy": [line for pose in POSES for line in str(pose).splitlines()],
    "four lines": rows(POSES.reshape(48, 4)),
    "four lines with a time": [line for k, pose in enumerate(POSES) for line in rows([*pose[:3], (0, 0, 0, k)])],
    "radians": ["t,x,y,z,roll,pitch,yaw", *rows([(k, *POSES[k, :3, 3], *ANGLES[k]) for k in range(12)], ",")],
    "degrees": ["x y z roll_deg pitch_deg yaw_deg", *rows(DEGREES)],
    "large angles": ["id,x,y,z,roll,pitch,heading", *rows([(k, *row) for k, row in enumerate(DEGREES)], ",")],
}


def test_a_single_matrix_whose_last_number_is_not_1_has_no_time(tmp_path) -> None:
    pose = rows(POSES[0, :3])
    (tmp_path / "pose.txt").write_text("\n".join([*pose, "0 0 0 5"]))
    with pytest.raises(CFlowError, match="4 numbers per line"):
        poses_text.read_poses(tmp_path / "pose.txt")
    (tmp_path / "pose.txt").write_text(" ".join([*pose, "0 0 0 5"]))
    assert poses_text.read_poses(tmp_path / "pose.txt").times_ns is None


@pytest.mark.parametrize("layout", LAYOUTS)
def test_layouts_of_poses(tmp_path, layout) -> None:
    (tmp_path / "poses.csv").write_text("\n".join(LAYOUTS[layout]))
    read = poses_text.read_poses(tmp_path / "poses.csv")
    assert np.allclose(read.poses, POSES, atol=1e-12)
    has_times = layout in (
        "13 numbers",
        "12 numbers and the time",
        "17 numbers",
        "radians",
        "time, by columns",
        "time and angles",
        "time, quaternion w first",
        "four lines with a time",
    )
    assert (read.times_ns is not None) == has_times and (not has_times or read.times_ns[2] == 2 * 10**9)


def test_a_plane_pose_and_a_pose_without_a_time(tmp_path) -> None:
    (tmp_path / "odometry.csv").write_text("time,x,y,yaw\n1,2,3,0.5\n2,3,4,0.5\n")
    (tmp_path / "poses.txt").write_text("2 3 0 0 0 0.6 0.8\n3 4 0 0 0 0.6 0.8\n")
    plane, untimed = (poses_text.read_poses(tmp_path / name) for name in ("odometry.csv", "poses.txt"))
    assert np.allclose(plane.poses[0], as_matrix(rotations_about(2, 0.5), (2, 3, 0)))
    assert untimed.times_ns is None and np.allclose(untimed.poses[1, :3, 3], (3, 4, 0))
    assert np.allclose(untimed.poses[1, :2, 0], (1 - 2 * 0.36, 2 * 0.6 * 0.8))


def test_a_yaw_that_is_not_wrapped_is_undone_by_a_reading(tmp_path) -> None:
    yaw = np.arange(60) * 0.2  # almost two turns
    for unit, reading in ((1.0, "radians"), (180 / np.pi, None)):
        lines = rows(np.column_stack([*np.zeros((5, 60)), yaw * unit]))
        (tmp_path / "poses.txt").write_text("\n".join(lines))
        read = poses_text.read_poses(tmp_path / "poses.txt").poses
        convert = READINGS[reading].of_poses if reading else np.asarray
        assert np.allclose(convert(read)[:, 0, 0], np.cos(yaw), atol=1e-6), unit


def test_a_number_may_be_in_front_of_tum(tmp_path) -> None:
    (tmp_path / "poses.txt").write_text("\n".join(f"{k} {each}" for k, each in enumerate(EXACT)))
    read = poses_text.read_poses(tmp_path / "poses.txt")
    assert read.times_ns.tolist() == STAMPS and np.allclose(read.poses[:, 0, 3], range(12), atol=1e-5)
    (tmp_path / "poses.txt").write_text("\n".join(f"{k % 3} {each}" for k, each in enumerate(EXACT)))
    with pytest.raises(CFlowError, match="9 numbers per line"):
        poses_text.read_poses(tmp_path / "poses.txt")


def test_places_on_the_globe_become_metres(tmp_path) -> None:
    """The first place is the origin, x is east, and 1e-5 degrees of latitude are 1.113 m."""
    header = "time,latitude_deg,longitude_deg,alt,roll,pitch,yaw"
    lines = [f"{k},{60 + 1e-5 * k:.6f},{8 - 1e-5 * k:.6f},{100 + k},0,0,0.5" for k in range(3)]
    (tmp_path / "gps.csv").write_text("\n".join([header, *lines]))
    read = poses_text.read_poses(tmp_path / "gps.csv")
    expected = [[-0.5566 * k, 1.1132 * k, 100 + k] for k in range(3)]
    assert np.allclose(read.poses[:, :3, 3], expected, atol=1e-3)
    assert np.allclose(read.poses[:, :3, :3], rotations_about(2, 0.5))


W_FIRST = [line(k, seconds(stamp), "t x y z qw qx qy qz", ",") for k, stamp in enumerate(STAMPS)]
QUOTED = [",".join(f'"{word}"' for word in text.split()) for text in EXACT]


@pytest.mark.parametrize(
    "lines",
    [
        ["timestamp,frame,x,y,z,qw,qx,qy,qz", *(text.replace(",", ",,", 1) for text in W_FIRST)],
        [
            "t,note,x,y,z,qx,qy,qz,qw",
            *(text.replace(" ", f",{k // 5 or ''},", 1).replace(" ", ",") for k, text in enumerate(EXACT)),
        ],
        ["t,x,y,z,qx,qy,qz,qw", *QUOTED],
        ["t,status,x,y,z,qw,qx,qy,qz", *(text.replace(",", ",not good,", 1) for text in W_FIRST)],
        [text.replace(" ", ", ", 1) for text in EXACT],
        ["export, version 2", "timestamp,x,y,z,qw,qx,qy,qz", "s,m,m,m,1,1,1,1", *W_FIRST],
        ["t,x,y,z,qx,qy,qz,qw", *(text.replace(" ", ", ") + "," for text in EXACT[:-1]), EXACT[-1].replace(" ", ",")],
        ["t,x,y,z,qx,qy,qz,qw,covariance", *(text.replace(" ", ",") + ",nan" for text in EXACT)],
    ],
)
def test_columns_may_be_empty_quoted_or_nan(tmp_path, lines) -> None:
    (tmp_path / "a").mkdir()  # logs of other tests look into folders of tables
    (tmp_path / "a" / "poses.csv").write_text("\n".join(lines))
    read = poses_text.read_poses(tmp_path / "a" / "poses.csv")
    assert read.times_ns is not None and read.times_ns.tolist() == STAMPS
    assert np.allclose(read.poses[:, 0, 3], range(COUNT)) and np.allclose(read.poses[3, 1, 0], 0.96)


def test_labels_of_rows_stay_with_their_poses(tmp_path) -> None:
    lines = [f"{name},{line(k, str(k), separator=',')}" for k, name in ((2, "c"), (0, "a"), (1, "b"))]
    (tmp_path / "poses.csv").write_text("\n".join(["name,t,x,y,z,qx,qy,qz,qw", *lines]))
    read = poses_text.read_poses(tmp_path / "poses.csv")
    assert read.labels == ["a", "b", "c"] and read.poses[:, 0, 3].tolist() == [0, 1, 2]


def test_keys_of_a_graph_are_no_times(tmp_path) -> None:
    """GTSAM writes keys that are a letter in the upper bits of 64."""
    folder = clouds(tmp_path, [f"{k:06d}" for k in range(COUNT)])
    for first in (0, 8646911284551352320):
        lines = [f"VERTEX_SE3:QUAT {first + k} {line(k, '').strip()}" for k in range(COUNT)]
        (folder / "graph.g2o").write_text("\n".join(lines))
        log = ArraysLog(folder, "graph.g2o")
        assert log.poses[:, 0, 3].tolist() == list(range(COUNT)) and not log._has_times


def test_a_table_may_have_a_column_of_times(tmp_path) -> None:
    clouds(tmp_path, range(COUNT))
    (tmp_path / "times.txt").write_text("\n".join(["frame,time", *(f"{k},{seconds(t)}" for k, t in enumerate(STAMPS))]))
    assert ArraysLog(tmp_path).timestamps == STAMPS
    (tmp_path / "times.txt").write_text("1 2\n2 3\n")
    with pytest.raises(CFlowError, match="one time per line, or a column called time"):
        poses_text.read_times(tmp_path / "times.txt")
    (tmp_path / "times.txt").write_text("1 2\n2 3\n", "utf-16")
    with pytest.raises(CFlowError, match="in UTF-8"):
        poses_text.read_times(tmp_path / "times.txt")


def test_lines_with_times_may_have_any_order(tmp_path) -> None:
    texts = [line(k, seconds(stamp)) for k, stamp in enumerate(STAMPS)]
    (tmp_path / "poses.txt").write_text("\n".join(reversed(texts)))
    read = poses_text.read_poses(tmp_path / "poses.txt")
    assert read.times_ns.tolist() == STAMPS and np.allclose(read.poses[:, 0, 3], range(COUNT))


def test_matrices_by_columns_may_begin_at_the_origin(tmp_path) -> None:
    poses = POSES.copy()
    poses[:, :3, 3] -= poses[2, :3, 3]
    by_columns = poses.transpose(0, 2, 1)
    (tmp_path / "poses.json").write_text(json.dumps(by_columns.tolist()))
    assert np.allclose(poses_text.read_poses(tmp_path / "poses.json").poses, poses)
    (tmp_path / "poses.txt").write_text("\n".join(rows(by_columns.reshape(12, 16))))
    assert np.allclose(poses_text.read_poses(tmp_path / "poses.txt").poses, poses)


def test_four_numbers_are_a_matrix_only_if_every_fourth_line_ends_it(tmp_path) -> None:
    (tmp_path / "poses.txt").write_text("\n".join(f"{k} {k} 0 0.1" for k in range(12)))
    with pytest.raises(CFlowError, match="4 numbers per line"):
        poses_text.read_poses(tmp_path / "poses.txt")


FRAMES = [{"file_path": f"clouds/{name}.npy", "transform_matrix": POSES[name].tolist()} for name in range(12)]
JSON: dict[str, Any] = {
    "nerfstudio": {"camera_model": "PINHOLE", "fl_x": 500.0, "frames": FRAMES[6:] + FRAMES[:6]},
    "frames by name": {f"{name}.pcd": pose.tolist() for name, pose in reversed(list(enumerate(POSES)))},
    "open3d": {
        "class_name": "PinholeCameraTrajectory",
        "parameters": [
            {"extrinsic": np.linalg.inv(pose).T.reshape(16).tolist(), "intrinsic": {"intrinsic_matrix": [0.5] * 9}}
            for pose in POSES
        ],
    },
    "a list of matrices": POSES.tolist(),
    "three rows": {"sensor": "roof", "poses": POSES[:, :3].tolist()},
    "vectors, w first": [{"translation": pose[:3, 3].tolist(), "rotation": q} for pose, q in zip(POSES, QUATERNIONS)],
    "vectors, w last": [
        {
            "timestamp": float(k),
            "position": POSES[k, :3, 3].tolist(),
            "orientation": [*QUATERNIONS[k][1:], QUATERNIONS[k][0]],
        }
        for k in range(12)
    ],
    "objects": [
        {"pose": {"position": dict(zip("xyz", pose[:3, 3])), "heading": dict(zip("wxyz", q))}, "speed": 3}
        for pose, q in zip(POSES, QUATERNIONS)
    ],
    "by columns": {
        **{f"t{axis}": POSES[:, k, 3].tolist() for k, axis in enumerate("xyz")},
        **{f"q{axis}": [q[k] for q in QUATERNIONS] for k, axis in enumerate("wxyz")},
    },
}


@pytest.mark.parametrize("layout", JSON)
def test_poses_in_json_are_found_and_read_in_the_order_of_the_clouds(tmp_path, layout) -> None:
    clouds(tmp_path, range(12))
    (tmp_path / "transforms.json").write_text(json.dumps(JSON[layout]))
    (tmp_path / "sensors.json").write_text(json.dumps({"front": np.eye(4).tolist(), "rear": np.eye(4).tolist()}))
    with pytest.warns(CFlowWarning, match="its poses are those of transforms.json"):
        log: Any = ArraysLog(tmp_path)
    assert np.allclose(log.poses, POSES, atol=1e-9)


@pytest.mark.parametrize("name", ["poses.npz", "odometry.yaml", "odometry.yml"])
def test_poses_in_yaml_and_npz_are_read(tmp_path, name) -> None:
    clouds(tmp_path, range(12))
    if name.endswith(".npz"):
        np.savez(tmp_path / name, T=POSES, stamps=np.arange(12) * 0.1, camera=np.eye(3))
    elif name.endswith(".yml"):  # as messages that are printed
        documents = [
            {
                "header": {"frame_id": "odom"},
                "pose": {"position": dict(zip("xyz", pose[:3, 3].tolist())), "orientation": dict(zip("wxyz", q))},
            }
            for pose, q in zip(POSES, QUATERNIONS)
        ]
        (tmp_path / name).write_text(yaml.safe_dump_all(documents))
    else:
        rows_of = [{"stamp": 0.1 * k, "transform": pose.tolist()} for k, pose in enumerate(POSES)]
        (tmp_path / name).write_text(yaml.safe_dump({"trajectory": rows_of}))
    log: Any = ArraysLog(tmp_path)
    assert np.allclose(log.poses, POSES, atol=1e-9)
    assert name.endswith(".yml") or log.timestamps[3] == 300_000_000


def test_poses_belong_to_the_numbers_of_sweeps(tmp_path) -> None:
    """KITTI-360: a number and a matrix per line, and some sweeps have none. Argoverse 1: names with times."""
    clouds(tmp_path, [f"{k:010d}" for k in range(12)])
    lines = rows([(k, *pose[:3].reshape(-1)) for k, pose in enumerate(POSES)])
    (tmp_path / "poses.txt").write_text("\n".join(lines[1:4] + lines[6:]))
    with pytest.warns(CFlowWarning, match="3 of 12 sweeps have no pose"):
        log: Any = ArraysLog(tmp_path)
    assert np.allclose(log.poses, POSES[[1, 2, 3, *range(6, 12)]]) and log.gaps == {2}
    named = clouds(tmp_path / "argoverse" / "lidar", [f"PC_{stamp}" for stamp in STAMPS]).parent
    (named / "poses").mkdir()
    for k in range(24):  # twice as many as sweeps
        text = json.dumps({"translation": POSES[k // 2, :3, 3].tolist(), "rotation": QUATERNIONS[k // 2]})
        (named / "poses" / f"city_{STAMPS[k // 2] + 50_000_000 * (k % 2)}.json").write_text(text)
    assert np.allclose(ArraysLog(named).poses, POSES, atol=1e-9)


def test_poses_near_a_folder_are_those_at_its_times(tmp_path) -> None:
    """MulRan and Newer College: poses lie two levels above the clouds, or in a folder next to them."""
    (tmp_path / "truth").mkdir()
    folder = clouds(tmp_path / "sensor_data" / "Ouster")
    (tmp_path / "truth" / "poses.csv").write_text("\n".join(EXACT))
    (tmp_path / "other.csv").write_text("\n".join(line(k, f"{k / 10}") for k in range(12)))
    with pytest.warns(CFlowWarning, match="its poses are those of .*truth.*poses.csv"):
        assert ArraysLog(folder).poses[:, 0, 3].tolist() == list(range(12))
    (tmp_path / "global.txt").write_text("\n".join(EXACT))
    with pytest.warns(CFlowWarning, match="choose data.poses=.*global.txt or .*poses.csv"):
        assert ArraysLog(folder).poses is None


def test_files_that_nobody_named_stop_no_log(tmp_path, monkeypatch) -> None:
    """A folder of another user, a table whose times repeat after its start, and times that end with text."""
    root = tmp_path / "a" / "b"
    folder = clouds(root / "drive")
    (root / "other").mkdir()
    list_all = Path.iterdir
    monkeypatch.setattr(Path, "iterdir", lambda path: locked(path) if path.name == "other" else list_all(path))
    (root / "cam").mkdir()
    imu = [line(k, seconds(START + k * 10**6)) for k in range(500)]
    (root / "cam" / "imu.csv").write_text("\n".join([*imu, line(9, seconds(START))]))
    with pytest.warns(CFlowWarning, match=r"we do not use imu\.csv: .*times must ascend"):
        assert ArraysLog(folder).poses is None
    numbered = clouds(tmp_path / "numbered" / "drive", range(COUNT))
    lines = [str(k / 10) for k in range(3000)]
    (numbered / "camera_timestamps.txt").write_text("\n".join([*lines, "end"]))
    with pytest.warns(CFlowWarning, match=r"we do not use camera_timestamps\.txt"):
        assert not ArraysLog(numbered)._has_times


def test_what_is_wrong_with_a_file_of_poses_is_told_once(tmp_path, monkeypatch) -> None:
    folder = clouds(tmp_path / "drive")
    lines = [line(k, seconds(START + k * 10**6)) for k in range(500)]
    (folder / "poses_gt.txt").write_text("\n".join([*lines, line(9, seconds(START))]))
    monkeypatch.chdir(tmp_path)
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        assert ArraysLog(folder.name).poses is None
    assert len([each for each in told if "we do not use poses_gt.txt" in str(each.message)]) == 1


def locked(path: Any) -> Any:
    raise PermissionError(f"{path}: permission denied")


@pytest.mark.parametrize("bad", ["nan", "1e400", "9" * 40])
def test_times_that_are_no_times_are_an_error_of_ours(tmp_path, bad) -> None:
    (tmp_path / "times.txt").write_text(f"{bad}\n1.0\n")
    with pytest.raises(CFlowError, match=r"times\.txt"):
        poses_text.read_times(tmp_path / "times.txt")


def test_seconds_and_nanoseconds_may_be_floats(tmp_path) -> None:
    rows_of = [line(k, f"{s // 10**9}.0,{s % 10**9:.1f}", separator=",") for k, s in enumerate(STAMPS)]
    (tmp_path / "a").mkdir()
    (tmp_path / "a" / "a.csv").write_text("\n".join(["secs,nsecs,x,y,z,qx,qy,qz,qw", *rows_of]))
    assert poses_text.read_poses(tmp_path / "a" / "a.csv").times_ns.tolist() == STAMPS


@pytest.mark.parametrize("name", ["poses.npy.gz", "poses.NPY", "poses.txt.gz", "poses.json.gz"])
def test_poses_may_be_compressed_and_suffixes_large(tmp_path, name) -> None:
    folder = clouds(tmp_path, [f"{k:06d}" for k in range(COUNT)])
    content = io.BytesIO()
    np.save(content, POSES)
    texts = {"npy": content.getvalue(), "txt": "\n".join(rows(POSES[:, :3].reshape(12, 12))).encode()}
    texts["json"] = json.dumps(POSES.tolist()).encode()
    raw = texts[name.split(".")[1].lower()]
    (folder / name).write_bytes(gzip.compress(raw) if name.endswith("gz") else raw)
    with pytest.warns(CFlowWarning, match=f"its poses are those of {name}"):
        assert np.allclose(ArraysLog(folder).poses, POSES, atol=1e-6)
    (folder / name).write_bytes(gzip.compress(raw)[:60] + b"broken" * 9)
    assert ArraysLog(folder).poses is None


def test_rotations_with_few_decimals_become_the_nearest_ones(tmp_path) -> None:
    tum = [f"{k} {k} 0 0 0 0 0.71 0.71" for k in range(12)]
    (tmp_path / "poses.txt").write_text("\n".join(tum))
    assert np.allclose(poses_text.read_poses(tmp_path / "poses.txt").poses[:, :2, 0], (0, 1), atol=1e-12)
    for decimals in (2, 3):
        np.savetxt(tmp_path / "poses.txt", POSES[:, :3].reshape(12, 12), f"%.{decimals}f")
        read = poses_text.read_poses(tmp_path / "poses.txt").poses
        assert np.allclose(read, POSES, atol=2 * 10**-decimals)
    mirrored = POSES[:, :3] * (1, 1, -1, 1)
    np.savetxt(tmp_path / "poses.txt", mirrored.reshape(12, 12), "%.3f")
    with pytest.raises(CFlowError, match="not rigid.*right-handed"):
        poses_text.read_poses(tmp_path / "poses.txt")


def test_unknown_poses_do_not_hide_where_the_vehicle_drives(tmp_path) -> None:
    """Poses of the LiDAR next to KITTI's calibration of the camera, one of zeros."""
    clouds(tmp_path, [f"{k:06d}" for k in range(COUNT)])
    poses = np.tile(np.eye(4)[:3], (COUNT, 1, 1))
    poses[:, 0, 3] = range(COUNT)
    poses[4] = 0
    np.savetxt(tmp_path / "poses.txt", poses.reshape(COUNT, 12))
    (tmp_path / "calib.txt").write_text("Tr: 0 -1 0 0 0 0 -1 0 1 0 0 0\n")
    with pytest.warns(CFlowWarning, match="drive along x"):
        log = ArraysLog(tmp_path)
    assert log.poses[:, 0, 3].tolist() == [k for k in range(COUNT) if k != 4]


def test_numbers_of_files_tell_missing_sweeps(tmp_path) -> None:
    """Without times, a gap is found by the numbers. If they are irregular, it is ten times as long as others."""
    for name, numbers, gaps in (
        ("missing", (0, 2, 4, 8, 10, 12, 14), {2}),
        ("whole", range(5, 12), set()),
        ("irregular", (0, 1, 3, 4, 6, 9, 10), set()),
        ("two pairs", (94, 95, 198, 199), {1}),
        ("three", (0, 100, 101), {0}),
        ("irregular, with a gap", (0, 1, 3, 4, 6, 9, 30), {5}),
    ):
        log = ArraysLog(clouds(tmp_path / name, numbers))
        assert log.gaps == gaps, name
        assert len(log.notes) == len(gaps)


def test_numbers_of_sweeps_are_no_times(tmp_path) -> None:
    clouds(tmp_path)
    (tmp_path / "poses.txt").write_text("\n".join(line(k, f"{k}") for k in range(12)))
    assert ArraysLog(tmp_path).poses[:, 0, 3].tolist() == list(range(12))


def test_rounded_poses_are_refused(tmp_path) -> None:
    clouds(tmp_path, range(12))
    far = POSES.copy()
    far[:, :3, 3] += (690_000, 5_330_000, 500)
    np.save(tmp_path / "poses.npy", far.astype(np.float32))
    with pytest.raises(CFlowError, match="only holds multiples of 0.5 m"):
        ArraysLog(tmp_path)


@pytest.mark.parametrize("suffix", [".txt", ".json", ".npy"])
def test_a_folder_may_have_a_file_per_pose(tmp_path, suffix) -> None:
    clouds(tmp_path / "points", range(12))
    (tmp_path / "pose").mkdir()
    for k, pose in enumerate(POSES):
        file = tmp_path / "pose" / f"{k}{suffix}"
        if suffix == ".npy":
            np.save(file, pose)
        else:
            text = json.dumps({"transform": pose.tolist()}) if suffix == ".json" else rows([pose.reshape(-1)])[0]
            file.write_text(text)
    assert np.allclose(ArraysLog(tmp_path).poses, POSES, atol=1e-12)


def test_a_line_of_json_per_pose_and_decimal_commas(tmp_path) -> None:
    clouds(tmp_path, range(12))
    (tmp_path / "odometry.jsonl").write_text("\n".join(json.dumps({"pose": pose.tolist()}) for pose in POSES))
    assert np.allclose(ArraysLog(tmp_path).poses, POSES, atol=1e-12)
    numbers = rows([(*POSES[k, :3, 3], *ANGLES[k]) for k in range(12)], ";")
    lines = ["x;y;z;roll;pitch;yaw", *(row.replace(".", ",") for row in numbers)]
    (tmp_path / "poses.csv").write_text("\n".join(lines))
    assert np.allclose(ArraysLog(tmp_path).poses, POSES, atol=1e-12)


def test_rows_of_poses_may_be_an_array(tmp_path) -> None:
    clouds(tmp_path, range(12))
    for table in (
        POSES[:, :3].reshape(12, 12),
        np.column_stack([POSES[:, :3, 3], QUATERNIONS])[:, [0, 1, 2, 4, 5, 6, 3]],
    ):
        np.save(tmp_path / "poses.npy", table)
        assert np.allclose(ArraysLog(tmp_path).poses, POSES, atol=1e-12)


def test_times_from_another_start_have_the_unit_of_their_steps(tmp_path) -> None:
    clouds(tmp_path, range(12))
    for unit, step in ((1, 0.1), (10**3, 100), (10**6, 100_000), (10**9, 100_000_000)):
        np.savetxt(tmp_path / "times.txt", 0.1 * unit * np.arange(12), "%.7g" if unit == 1 else "%d")
        assert ArraysLog(tmp_path).timestamps == [k * 100_000_000 for k in range(12)], step


@pytest.mark.parametrize(
    ("first", "step", "unit"),
    [
        (150 * 10**9, 10**8, 1),  # since boot
        (1_700_000_000, 10**8, 1),  # since boot, of the size of unix seconds
        (150 * 10**9, 2_500_000, 1),  # 400 poses a second
        (3 * 86_400 * 10**6, 10**5, 10**3),
        (300_000 * 10**6, 10**5, 10**3),  # of the GPS week
        (1_700_000_000, 1, 10**9),
        (5, 1, 10**9),
    ],
)
def test_times_of_any_size_have_the_unit_of_their_steps(first: int, step: int, unit: int) -> None:
    times = [first + k * step for k in range(12)]
    assert nanoseconds_of_numbers([str(time) for time in reversed(times)]) == [time * unit for time in reversed(times)]


def test_rare_poses_are_joined_by_arcs_and_not_called_late() -> None:
    drive = make_drive(seed=1, num_sweeps=21, profile="demo")  # turns by 18 degrees a second
    kept = np.arange(2, 21, 3)
    trajectory = Trajectory(drive.poses[kept], np.array(drive.timestamps)[kept], False, "x")
    poses, is_covered, _ = fit_to_sweeps(trajectory, drive.timestamps)
    assert np.abs(poses - drive.poses[is_covered]).max() < 1e-3, "chords are off by 2 cm"
    assert trajectory.is_sparse(drive.timestamps) and not trajectory.is_sparse(drive.timestamps[::3])


def test_json_without_poses_is_an_error_that_says_what_poses_are(tmp_path) -> None:
    clouds(tmp_path, range(12))
    (tmp_path / "a.json").write_text(json.dumps({"frames": [{"speed": k, "gps": [49.0, 8.4]} for k in range(12)]}))
    assert ArraysLog(tmp_path).poses is None
    with pytest.raises(CFlowError, match="no list of poses: matrices of 16"):
        ArraysLog(tmp_path, poses="a.json")


@pytest.mark.parametrize(
    ("below", "name"), [(".", "gt_tum.txt"), ("points", "glim.csv"), ("any_folder", "optimized.tum")]
)
def test_poses_are_found_under_any_name_and_said(tmp_path, below, name) -> None:
    clouds(tmp_path / below)
    (tmp_path / name).write_text("\n".join(EXACT))
    (tmp_path / "notes.txt").write_text("1 2 3\n4 5 6\n")
    assert find_array_logs(tmp_path) == [tmp_path]
    with pytest.warns(CFlowWarning, match=f"its poses are those of {name}"):
        log = ArraysLog(tmp_path)
    assert np.allclose(log.poses[:, 0, 3], range(12), atol=1e-5)
    (tmp_path / "second_tum.txt").write_text("\n".join(EXACT))
    with pytest.raises(CFlowError, match=f"several files for poses: .*{name}.*choose one"):
        ArraysLog(tmp_path)
    assert ArraysLog(tmp_path, poses=None).poses is None


def test_a_long_file_of_matrices_is_found(tmp_path) -> None:
    clouds(tmp_path / "points", range(90))
    poses = np.tile(np.eye(4), (90, 1, 1)) + np.arange(90)[:, None, None] * (np.arange(16).reshape(4, 4) == 3)
    (tmp_path / "lidar.txt").write_text("\n".join(rows(poses.reshape(360, 4), " " * 8)))
    (tmp_path / "extrinsics.txt").write_text("\n".join(rows(np.eye(4))))  # a single one is a calibration
    assert (tmp_path / "lidar.txt").stat().st_size > 8192
    assert np.array_equal(ArraysLog(tmp_path).poses, poses)


def test_a_folder_with_a_file_per_pose_and_a_file_of_times(tmp_path) -> None:
    clouds(tmp_path / "points", range(12))
    (tmp_path / "ego_pose").mkdir()
    for k, pose in enumerate(POSES):
        np.savetxt(tmp_path / "ego_pose" / f"{k}.txt", pose, "%.17g")
    dates = [f"2023-11-14 22:13:{20 + k}.5" for k in range(12)]
    (tmp_path / "timestamps.txt").write_text("\n".join(dates))
    log = ArraysLog(tmp_path)
    assert np.allclose(log.poses, POSES) and log.timestamps[1] == 1_700_000_001_500_000_000
    assert log.notes == ["its poses are those of ego_pose", "the times of its sweeps are those of timestamps.txt"]


def test_an_array_of_poses_is_found_by_its_contents(tmp_path) -> None:
    clouds(tmp_path / "points", range(12))
    np.save(tmp_path / "ego2global.npy", np.random.default_rng(0).normal(size=(500, 6)))  # of another length
    assert ArraysLog(tmp_path).poses is None
    np.save(tmp_path / "ego2global.npy", POSES)
    with pytest.warns(CFlowWarning, match="its poses are those of ego2global.npy"):
        assert np.allclose(ArraysLog(tmp_path).poses, POSES)


def test_columns_may_be_called_theta_or_by_the_order_of_a_quaternion(tmp_path) -> None:
    assert [role_of_name(name) for name in ("theta", "quaternion_xyzw.x", "orientation_wxyz.0")] == ["yaw", "qx", "q0"]
    clouds(tmp_path / "points", range(12))
    lines = [f"{0.4 * k};{0.0};{0.01 * k}" for k in range(12)]
    (tmp_path / "pose2d.csv").write_text("\n".join(["x;y;theta", *lines]))
    poses = ArraysLog(tmp_path).poses
    assert np.allclose(poses[:, 0, 3], 0.4 * np.arange(12)) and np.allclose(poses[5, 1, 0], np.sin(0.05))


def test_poses_of_missing_sweeps_are_skipped_by_number(tmp_path) -> None:
    clouds(tmp_path, [f"{k:06d}" for k in range(12) if k != 7])
    (tmp_path / "poses.txt").write_text("\n".join(rows(POSES[:, :3].reshape(12, 12))))
    with pytest.warns(CFlowWarning, match="12 poses in .* for 11 sweeps, so each takes that of its number"):
        log = ArraysLog(tmp_path)
    assert np.allclose(log.poses, np.delete(POSES, 7, 0)) and log.gaps == {6}
    (tmp_path / "000011.npy").unlink()
    (tmp_path / "000000.npy").unlink()  # 1 to 10: counted from 0 or from 1?
    with pytest.raises(CFlowError, match="12 poses for 9 sweeps"):
        ArraysLog(tmp_path)


def test_a_trajectory_of_another_rate_is_not_taken_by_number(tmp_path) -> None:
    clouds(tmp_path, range(12))
    (tmp_path / "gt_tum.txt").write_text("\n".join(line(k, f"{k}") for k in range(100)))
    with pytest.raises(CFlowError, match="has 100 poses for 12 sweeps: pass one each, or poses with times"):
        ArraysLog(tmp_path)


def test_poses_a_second_apart_are_joined_and_rarer_ones_refused(tmp_path) -> None:
    (clouds(tmp_path) / "poses.txt").write_text("\n".join(EXACT[::10]))
    with pytest.warns(CFlowWarning, match="1 after the last pose; its poses are 1 s apart, .*=refine"):
        log = ArraysLog(tmp_path)
    assert np.allclose(log.poses[:, 0, 3], range(11), atol=1e-6) and log.has_sparse_poses
    (tmp_path / "poses.txt").write_text("\n".join([EXACT[0], line(20, seconds(START + 2 * 10**9))]))
    with pytest.raises(CFlowError, match="has a pose every 2 s, and we interpolate up to 1.1 s: give more poses"):
        ArraysLog(tmp_path)


def test_far_points_keep_their_precision(tmp_path) -> None:
    points = np.random.default_rng(0).random((50, 3)) + (6.9e5, 5.33e6, 500)
    for k in range(2):
        write_cloud(tmp_path / f"{k}.ply", points, {"GpsTime": 2.9e8 + 0.1 * k + np.linspace(0, 0.1, 50)})
    sweep = ArraysLog(tmp_path).sweep(1)
    assert sweep.points.dtype == np.float64 and np.array_equal(sweep.points, points)
    assert np.allclose(sweep.point_times, np.linspace(0, 0.1, 50), atol=1e-6)


def test_tables_may_hold_texts_and_lines_of_nan(tmp_path) -> None:
    """As `rostopic echo -p` writes, with a lost pose: it is interpolated. Without times, its sweep is left out."""
    clouds(tmp_path)
    names = "%time,field.header.frame_id,field.pose.position.x,y,z,field.pose.orientation.x,qy,qz,qw,twist.linear.x"
    table = [line(k, str(stamp), "t x y z qx qy qz qw", ",").split(",") for k, stamp in enumerate(STAMPS)]
    rows_of = [",".join([each[0], "odom", *each[1:], "6.5"]) for each in table]
    rows_of[5] = rows_of[5].replace(",0.5,", ",nan,")
    (tmp_path / "odom.csv").write_text("\n".join([names, *rows_of]))
    assert np.allclose(ArraysLog(tmp_path).poses[:, 0, 3], range(12), atol=1e-5)
    (tmp_path / "odom.csv").unlink()
    matrices = POSES[:, :3].reshape(12, 12).copy()
    matrices[4, 3] = np.nan
    named = [f"{stamp}.npy {row}" for stamp, row in zip(STAMPS, rows(matrices))]
    (tmp_path / "poses.txt").write_text("\n".join(named))
    with pytest.warns(CFlowWarning, match="1 of 12 sweeps have no pose, or one of NaN or zeros, .* left out"):
        log = ArraysLog(tmp_path)
    assert np.allclose(log.poses, np.delete(POSES, 4, 0)) and log.gaps == {3}


@pytest.mark.parametrize("comment", ["#", "% ", "// "])
@pytest.mark.parametrize("date", ["2023-11-14 22:13:{}.5", "2023-11-14T22:13:{}.5Z"])
def test_comments_counts_and_dates_in_tables_of_poses(tmp_path, comment, date) -> None:
    """Programs begin comments in other ways, write the number of poses first, and dates for times."""
    lines = [line(k, date.format(20 + k), separator=", ") + "," for k in range(COUNT)]
    header = [comment + "made by us", comment + "time, x, y, z, qx, qy, qz, qw"]
    (tmp_path / "poses.txt").write_text("\n".join(header + lines))
    trajectory = poses_text.read_poses(tmp_path / "poses.txt")
    assert trajectory.times_ns is not None
    assert trajectory.times_ns.tolist() == [1_700_000_000_500_000_000 + k * 10**9 for k in range(COUNT)]
    assert np.allclose(trajectory.poses[:, 0, 3], range(COUNT))
    (tmp_path / "poses.txt").write_text("\n".join([str(COUNT), *rows(POSES[:, :3].reshape(COUNT, 12))]))
    assert np.allclose(poses_text.read_poses(tmp_path / "poses.txt").poses, POSES)


def test_times_of_day_are_times(tmp_path) -> None:
    clouds(tmp_path, range(COUNT))
    texts = [f"12:59:59.{k}00" if k < 10 else f"13:00:00.{k - 10}00" for k in range(COUNT)]
    (tmp_path / "times.txt").write_text("\n".join(["// local time", *texts]))
    assert np.diff(ArraysLog(tmp_path).timestamps).tolist() == [100_000_000] * (COUNT - 1)


@pytest.mark.parametrize("form", ["matrices", "quaternions", "array"])
def test_poses_of_zeros_are_unknown(tmp_path, form) -> None:
    """Programs write zeros for a pose that they lost."""
    poses = np.concatenate([POSES[:4], np.zeros((1, 4, 4)), POSES[5:]])
    clouds(tmp_path)
    if form == "array":
        np.save(tmp_path / "poses.npy", poses)
    elif form == "matrices":
        (tmp_path / "poses.txt").write_text("\n".join(rows(poses[:, :3].reshape(COUNT, 12))))
    else:
        lines = EXACT[:4] + [f"{seconds(STAMPS[4])} 0 0 0 0 0 0 0"] + EXACT[5:]
        (tmp_path / "poses.txt").write_text("\n".join(lines))
        assert np.allclose(ArraysLog(tmp_path).poses[:, 0, 3], range(12), atol=1e-5)
        return
    with pytest.warns(CFlowWarning, match="1 of 12 sweeps have no pose, or one of NaN or zeros, .* left out") as told:
        log = ArraysLog(tmp_path)
    assert np.allclose(log.poses, np.delete(POSES, 4, 0)) and log.gaps == {3}
    assert len(told) == 1


def test_numbers_in_front_of_poses_are_no_times(tmp_path) -> None:
    """Of sweeps without times, too: these would have a second between them."""
    clouds(tmp_path, range(COUNT))
    lines = [f"{k} {row}" for k, row in enumerate(rows(POSES[:, :3].reshape(COUNT, 12)))]
    (tmp_path / "poses.txt").write_text("\n".join(lines))
    log = ArraysLog(tmp_path)
    assert log.timestamps == list(range(COUNT)) and log.sweep(0).timestamp_ns is None and log.trajectory is None
    assert np.allclose(log.poses, POSES)


def test_clouds_of_a_second_sensor_are_said(tmp_path) -> None:
    for name in ("front", "rear"):
        clouds(tmp_path / name)
    (tmp_path / "poses.txt").write_text("\n".join(EXACT))
    with pytest.warns(CFlowWarning, match="we read the clouds in front; there are others in rear"):
        ArraysLog(tmp_path)


def test_labels_and_maps_next_to_clouds_are_not_the_clouds(tmp_path) -> None:
    for name in ("a_labels", "sweeps", "dense"):
        clouds(tmp_path / name)
    for file in (tmp_path / "a_labels").iterdir():
        np.save(file, np.zeros(5, np.int32))
    for file in (tmp_path / "sweeps").iterdir():
        np.save(file, np.ones((500, 3)))
    for name in ("global", "surface"):
        np.save(tmp_path / f"{name}.npy", np.ones((2000, 3)))
    (tmp_path / "poses.txt").write_text("\n".join(EXACT))
    assert find_array_logs(tmp_path) == [tmp_path]
    with pytest.warns(CFlowWarning, match="we read the clouds in sweeps; there are others in dense, "):
        log: Any = ArraysLog(tmp_path)
    assert len(log) == len(log.poses) == 12 and {file.parent.name for file in log.files} == {"sweeps"}


POSES_NEAR = {
    "lidar/pcd": "poses.txt",
    "lidar/top": "poses.txt",
    "clouds_of_os1": "poses/poses.txt",
    "one": "poses_one.txt",
    "two": "ground_truth/two.txt",
}


@pytest.mark.parametrize("below", POSES_NEAR)
def test_poses_of_as_many_sweeps_are_found_near_a_folder(tmp_path, below) -> None:
    """Without times, the name of the file or of its folder must say that these are poses."""
    folder = clouds(tmp_path / "drive" / below, range(12))
    file = tmp_path / "drive" / POSES_NEAR[below]
    file.parent.mkdir(exist_ok=True)
    file.write_text("\n".join(rows(POSES[:, :3].reshape(12, 12))))
    file.with_name("poses_other.txt").write_text("\n".join(rows(POSES[:9, :3].reshape(9, 12))))  # of another length
    (tmp_path / "drive" / "numbers.txt").write_text(file.read_text())
    assert np.allclose(ArraysLog(folder).poses, POSES)


def test_a_calibration_of_a_few_matrices_is_no_trajectory(tmp_path) -> None:
    clouds(tmp_path, range(12))
    (tmp_path / "calib").mkdir()
    for name in ("camera", "radar", "imu"):
        np.savetxt(tmp_path / "calib" / f"{name}.txt", np.eye(4))
    assert ArraysLog(tmp_path).poses is None


def test_of_two_trajectories_that_of_the_times_of_the_sweeps_is_used(tmp_path) -> None:
    clouds(tmp_path)
    (tmp_path / "Ouster_gt.txt").write_text("\n".join(EXACT))
    other = [line(k, seconds(stamp + 30_000_000)) for k, stamp in enumerate(STAMPS)]
    (tmp_path / "Velodyne_gt.txt").write_text("\n".join([line(0, seconds(STAMPS[0] - 10**8)), *other]))
    with pytest.warns(CFlowWarning, match="its poses are those of Ouster_gt.txt"):
        assert ArraysLog(tmp_path).poses[:, 0, 3].tolist() == list(range(12))


def test_a_gap_in_the_times_splits_a_folder(tmp_path) -> None:
    late = [stamp + 2 * 10**9 * (k > 5) for k, stamp in enumerate(STAMPS)]
    with pytest.warns(CFlowWarning, match="it has 1 gaps between sweeps .the first is 2.1 s long, after sweep 5"):
        log = open_log("arrays", clouds(tmp_path, late))
    assert log.gaps == {5} and len(window(log, 7, num_history=4).pch) == 1


@pytest.mark.parametrize(
    ("names", "step"),
    [
        ([f"20240101_12000{k}" for k in range(5)], 10**9),
        ([f"1700000000{k:03d}" for k in range(120, 160, 8)], 8 * 10**6),
        ([f"20240101_120000_{k:03d}" for k in range(5)], None),  # a date and a counter
    ],
)
def test_a_time_that_grows_slowly_is_no_counter(names: list[str], step: int | None) -> None:
    times = times_of_names(names)
    assert times is None if step is None else set(np.diff(times)) == {step}


@pytest.mark.parametrize(
    ("lines", "step"),
    [
        (["00:00:02", "00:00:04", "00:00:06"], 2 * 10**9),
        (["1990-01-01 00:00:00", "1990-01-01 00:00:10"], 10**10),
        (["2011-09-26 13:00:00", "2011-09-26 13:05:00", "2011-09-26 13:10:00"], 300 * 10**9),
        (["2011-09-26 13:02:25,594", "2011-09-26 13:02:25,694"], 10**8),
        (["0", "2", "4", "8"], 2 * 10**9),
        (["0", "6", "12"], 6 * 10**6),  # milliseconds
    ],
)
def test_lines_of_times_have_seconds_or_the_unit_of_their_steps(tmp_path: Path, lines: list[str], step: int) -> None:
    (tmp_path / "times.txt").write_text("\n".join(lines))
    assert np.diff(poses_text.read_times(tmp_path / "times.txt"))[0] == step


def test_poses_of_another_log_and_poses_that_do_not_fit_are_not_taken(tmp_path):
    """poses_B.txt is of B. KITTI's file is used whatever lies next to it. A poses.txt that is too long is an error."""
    cloud = np.random.default_rng(0).normal(size=(30, 3)).astype(np.float32)
    poses = "\n".join(f"1 0 0 {x} 0 1 0 0 0 0 1 0" for x in range(3))
    for name in ("A", "B"):
        (tmp_path / "sequences" / name).mkdir(parents=True)
        for index in range(3):
            np.save(tmp_path / "sequences" / name / f"{index}.npy", cloud)
    (tmp_path / "sequences" / "poses_B.txt").write_text(poses)
    assert ArraysLog(tmp_path / "sequences" / "A").poses is None
    (tmp_path / "poses").mkdir()
    (tmp_path / "poses" / "README.md").write_text("of all logs")
    (tmp_path / "poses" / "A.txt").write_text(poses)
    assert ArraysLog(tmp_path / "sequences" / "A").poses is not None
    (tmp_path / "sequences" / "A" / "poses.txt").write_text(poses.replace("1 0 0 2", "1 0 0 5"))  # as SemanticKITTI
    assert ArraysLog(tmp_path / "sequences" / "A").poses[2, 0, 3] == 5, "poses.txt comes first"
    (tmp_path / "sequences" / "B" / "poses.txt").write_text(poses + "\n1 0 0 9 0 1 0 0 0 0 1 0")
    (tmp_path / "sequences" / "B" / "imu.txt").write_text(poses)
    with pytest.raises(CFlowError, match="has 4 poses for 3 sweeps"):
        ArraysLog(tmp_path / "sequences" / "B")


def test_an_empty_first_cloud_and_a_folder_called_as_a_record_hide_no_log(tmp_path):
    (tmp_path / "drive" / "manifest.json").mkdir(parents=True)
    np.save(tmp_path / "drive" / "0.npy", np.zeros((0, 3)))
    for index in (1, 2):
        np.save(tmp_path / "drive" / f"{index}.npy", np.ones((30, 3)))
    assert find_array_logs(tmp_path) == [tmp_path / "drive"]


@pytest.mark.parametrize("is_from_origin", [False, True])
@pytest.mark.parametrize("order", ["tq", "qt", "tq_w_first", "qt_w_first"])
def test_poses_of_seven_numbers_in_json_are_read(tmp_path, order, is_from_origin) -> None:
    """From the origin, the first pose is 0, 0, 0, 1, 0, 0, 0: both ends look like a quaternion."""
    poses = np.linalg.inv(POSES[0]) @ POSES if is_from_origin else POSES
    quaternion = to_quaternions(poses[:, :3, :3])  # w first
    quaternion = quaternion if order.endswith("w_first") else np.roll(quaternion, -1, 1)
    parts = [quaternion, poses[:, :3, 3]]
    numbers = np.concatenate(parts if order.startswith("qt") else parts[::-1], axis=1).tolist()
    frames = [{"frame_id": f"sweep {k}", "pose": pose} for k, pose in enumerate(numbers)]
    (tmp_path / "poses.json").write_text(
        json.dumps({"calib": dict.fromkeys("ab", {"T": np.eye(4).tolist()}), "frames": frames})
    )
    assert np.allclose(poses_text.read_poses(tmp_path / "poses.json").poses, poses)
    frames[3]["pose"] = [0.0] * 7  # a pose that is missing
    for time, frame in enumerate(frames):
        frame["time"] = 100.0 + time
    (tmp_path / "poses.json").write_text(json.dumps(frames))
    assert np.allclose(poses_text.read_poses(tmp_path / "poses.json").poses, np.delete(poses, 3, axis=0))


@pytest.mark.parametrize("order", ["w first", "w last", "w last, rolled", "w last, of a camera"])
def test_the_order_of_a_quaternion_without_names_follows_from_the_rotations(tmp_path, order) -> None:
    """FAST-LIVO2 and CODa write w first. A vehicle and a tilted sensor turn about z, a camera about y."""
    axis, roll = (1, 0.0) if order.endswith("camera") else (2, 0.3 * order.endswith("rolled"))
    poses = as_matrix(rotations_about(axis, 0.02 * np.arange(12)) @ rotations_about(0, roll), POSES[:, :3, 3])
    quaternions = np.roll(to_quaternions(poses[:, :3, :3]), 0 if order == "w first" else -1, 1)
    table = np.column_stack([np.arange(12), poses[:, :3, 3], quaternions])
    for numbers in (table, table[:, 1:], np.column_stack([np.arange(12), table])):
        np.savetxt(tmp_path / "poses.txt", numbers, "%.17g")
        assert np.allclose(poses_text.read_poses(tmp_path / "poses.txt").poses, poses), numbers.shape


def test_quaternions_of_one_length_are_normalised(tmp_path) -> None:
    table = np.concatenate([POSES[:, :3, 3], 1000 * np.roll(to_quaternions(POSES[:, :3, :3]), -1, 1)], axis=1)
    np.savetxt(tmp_path / "poses.csv", table, "%.9f", ",", header="x,y,z,qx,qy,qz,qw", comments="")
    assert np.allclose(poses_text.read_poses(tmp_path / "poses.csv").poses, POSES)
    table[3, 3:] *= 2
    np.savetxt(tmp_path / "poses.csv", table, "%.9f", ",", header="x,y,z,qx,qy,qz,qw", comments="")
    with pytest.raises(CFlowError, match="not a rigid motion"):
        poses_text.read_poses(tmp_path / "poses.csv")


JSON_TEXTS = {
    "a line per pose": "\n".join(json.dumps({"k": k, "T": pose.tolist()}) for k, pose in enumerate(POSES)),
    "numbers": "\n".join(rows([(*pose[:3, 3], *q) for q, pose in zip(QUATERNIONS, POSES)])),
    "a rotation and a translation": json.dumps(
        [{"rotation": T[:3, :3].tolist(), "translation": T[:3, 3:].tolist()} for T in POSES]
    ),
}


@pytest.mark.parametrize("form", JSON_TEXTS)
def test_files_of_json_may_hold_lines_and_rotations_of_nine_numbers(tmp_path, form) -> None:
    """FAST-LIVO2 and HBA, objects in lines, DAIR-V2X."""
    (tmp_path / "poses.json").write_text(JSON_TEXTS[form])
    assert np.allclose(poses_text.read_poses(tmp_path / "poses.json").poses, POSES)


def test_objects_of_other_keys_in_lines_are_one_object(tmp_path) -> None:
    """View-of-Delft has a file per sweep with a matrix in each line."""
    names = ("odomToCamera", "mapToCamera")
    text = "\n".join(json.dumps({name: pose.reshape(-1).tolist()}) for name, pose in zip(names, POSES))
    (tmp_path / "pose.json").write_text(text)
    assert poses_text.read_poses(tmp_path / "pose.json").labels == ["mapToCamera", "odomToCamera"]


@pytest.mark.parametrize(
    ("files", "told"),
    [
        ({"results/a/x_poses_kitti.txt": "matrices"}, "choose data.poses=results/a/x_poses_kitti.txt"),
        ({f"novatel/data/{k:02d}.txt": "1 2 3 4 5\n" for k in range(12)}, r"novatel/data \(it/00.txt has 5 numbers"),
        ({"scene.pkl": "pose"}, r"scene.pkl \(pickles are not read\)"),
        ({"../scene.json": '{"rotation": 1, "translation": 2}'}, r"scene.json \(it has no list of poses"),
        ({f"calib/to_camera/{k:02d}.json": json.dumps({"pose": np.eye(4).tolist()}) for k in range(12)}, None),
        ({"../other/maps/poses.txt": "matrices"}, None),
        ({f"../novatel/data/{k:02d}.txt": "1 2 3 4 5\n" for k in range(12)}, "novatel/data .*has 5 numbers"),
        ({f"labels/{k:02d}.txt": "car 1 2 3 4 5\n" for k in range(12)}, None),
    ],
)
def test_poses_that_are_not_used_are_told(tmp_path, files, told) -> None:
    log_folder = tmp_path / "run" / "drive"
    clouds(log_folder / "points", [f"{k:02d}" for k in range(12)])
    matrices = "\n".join(rows([pose[:3].reshape(-1) for pose in POSES]))
    for name, text in files.items():
        (log_folder / name).parent.mkdir(parents=True, exist_ok=True)
        (log_folder / name).write_text(matrices if text == "matrices" else text)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        log = ArraysLog(log_folder)
    texts = [str(each.message) for each in caught]
    assert log.poses is None and len(texts) == (told is not None)
    assert told is None or re.search(told, texts[0]), texts


def test_a_relative_path_is_also_looked_for_above_the_log(tmp_path) -> None:
    folder = clouds(tmp_path / "given" / "frames")
    (tmp_path / "given" / "x.txt").write_text("\n".join(EXACT))
    assert ArraysLog(folder, poses="x.txt").poses[:, 0, 3].tolist() == list(range(12))
    with pytest.raises(CFlowError, match="neither here nor in .*frames or above it"):
        ArraysLog(folder, poses="y.txt")
