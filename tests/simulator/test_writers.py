"""The Argoverse 2 writer, read back with pyarrow, the Waymo writer where a turn begins, and drives that are cached."""

from __future__ import annotations

import os
import shutil
from dataclasses import replace

import numpy as np
import pytest
from pyarrow import feather
from scipy.spatial import cKDTree
from writers import waymo_encoding
from writers.waymo import write_waymo_segment

from cflow_torch.data.av2 import AV2Log
from cflow_torch.data.boxes import BoxLog
from cflow_torch.data.log import window
from cflow_torch.data.waymo import WaymoLog
from cflow_torch.simulator import Drive, benchmark, make_drive
from cflow_torch.simulator.benchmark import benchmark_logs
from cflow_torch.simulator.writers.av2 import write_av2_log
from cflow_torch.types import CFlowError


def schema(path):
    return [(field.name, str(field.type)) for field in feather.read_table(path).schema]


def columns(path, *names):
    table = feather.read_table(path)
    return np.stack([table[name].to_numpy() for name in names], -1)


@pytest.fixture(scope="module")
def drive():
    return make_drive(seed=2, num_sweeps=3, profile="av2")


@pytest.fixture(scope="module")
def folder(drive, tmp_path_factory):
    return write_av2_log(drive, tmp_path_factory.mktemp("split") / "val")


def test_files_and_schemas_are_those_of_argoverse_2(drive, folder, request):
    stamps, name = drive.timestamps, drive.log_id
    assert folder.name == name and os.listdir(folder.parent) == [name]  # no temporary folder stays
    assert {str(p.relative_to(folder)) for p in folder.rglob("*") if p.is_file()} == {
        *(f"sensors/lidar/{stamp}.feather" for stamp in stamps),
        *(f"flow_labels/{stamp}.feather" for stamp in stamps[:-1]),
        *("city_SE3_egovehicle.feather", "calibration/egovehicle_SE3_sensor.feather", "annotations.feather"),
        f"map/{name}_ground_height_surface____SYN.npy",
        f"map/{name}___img_Sim2_city.json",
        f"map/log_map_archive_{name}____SYN_city_00000.json",
    }
    real = request.getfixturevalue("av2_folder")
    for pattern in ("sensors/lidar/*.feather", "c*.feather", "a*.feather", "calibration/egovehicle_SE3_sensor.feather"):
        assert schema(next(folder.glob(pattern))) == schema(next(real.glob(pattern))), pattern


def test_labels_come_back_row_by_row_and_boxes_explain_them(drive, folder):
    path, labels = folder / "flow_labels" / f"{drive.timestamps[0]}.feather", drive.labels(0)
    assert np.array_equal(columns(path, "flow_tx_m", "flow_ty_m", "flow_tz_m"), labels.flow)
    written = {"classes": labels.category, "is_valid": labels.is_valid, "is_ground_0": drive.sweep(0).is_ground}
    for name, values in written.items():
        assert np.array_equal(feather.read_table(path)[name].to_numpy(), values)
    points = drive.sweep(0).points.astype(float)
    T = np.linalg.inv(drive.poses[1]) @ drive.poses[0]
    residual = labels.flow + points - points @ T[:3, :3].T - T[:3, 3]
    dynamic = feather.read_table(path)["dynamic"].to_numpy()
    assert np.array_equal(dynamic, np.linalg.norm(residual, axis=1) >= 0.05) and dynamic.sum() > 1000
    # Truth rebuilt from the written boxes and poses alone equals the written flow of the points of each track.
    made = BoxLog._labels(AV2Log(folder), 0)
    same = made.is_valid & labels.is_valid & (made.category == labels.category) & (labels.category > 0)
    assert same.sum() > 0.9 * (labels.category > 0).sum() and np.abs(made.flow - labels.flow)[same].max() < 0.01


def test_raster_finds_the_ground(drive, folder):
    sweep, found = drive.sweep(0), AV2Log(folder).sweep(0).is_ground
    city = sweep.points.astype(float) @ drive.poses[0, :3, :3].T + drive.poses[0, :3, 3]
    # With Argoverse 2's rule, the lowest part of every object counts as ground, but nothing above.
    true_height = drive.scene.ground.height(city[:, 0].copy(), city[:, 1].copy())
    clear = city[:, 2] > true_height + 0.3 + drive.scene.ground.kerb + 0.02
    assert found[sweep.is_ground].all() and clear.sum() > 30_000 and not found[clear].any()


def test_an_existing_log_is_not_replaced(tmp_path):
    folder = write_av2_log(make_drive(seed=1, num_sweeps=1, profile="demo"), tmp_path)
    with pytest.raises(CFlowError, match="exists already"):
        write_av2_log(make_drive(seed=1, num_sweeps=2, profile="demo"), tmp_path)
    assert len(list((folder / "sensors" / "lidar").iterdir())) == 1 and os.listdir(tmp_path) == [folder.name]


def test_waymo_writes_true_poses_where_a_turn_begins(tmp_path, monkeypatch):
    """There, interpolated poses of the vehicle are wrong by more than a metre at a range of 75 m."""
    turning, used = make_drive(316, 8, "waymo", "crossing"), []
    true_poses = waymo_encoding.true_poses_of_shots
    monkeypatch.setattr(
        "writers.waymo.true_poses_of_shots",
        lambda log, index, offsets: (used.append(index), true_poses(log, index, offsets))[1],
    )
    profile = replace(turning._profile, units=(replace(turning._profile.units[0], num_columns=530),))
    drive = Drive(turning.scene, profile, 0, 8, "turning")
    log = WaymoLog(write_waymo_segment(drive, tmp_path))
    assert used, "this drive tests nothing if interpolation suffices"
    for index in used:
        stored, read = drive.sweep(index).points, log.sweep(index).points
        assert len(stored) == len(read) and cKDTree(read).query(stored)[0].max() < 1e-4


def test_a_drive_is_made_once(tmp_path, monkeypatch):
    first = benchmark_logs(tmp_path, "demo", [1, 2], 3)
    drive, log = make_drive(seed=2, num_sweeps=3, profile="demo"), AV2Log(first[1])
    assert log.log_id == drive.log_id and list(log.timestamps) == list(drive.timestamps)
    np.testing.assert_array_equal(window(log, 1).pc0.points, drive.sweep(1).points.astype(np.float16))
    stamps = {file: file.stat().st_mtime_ns for file in tmp_path.rglob("*.feather")}
    (first[0].parent / ".making-x" / "synthetic-demo-0003").mkdir(parents=True)  # left over from a run that was killed
    again = benchmark_logs(tmp_path, "demo", [1, 2, 3], 3)
    assert again[:2] == first and len(list(again[2].rglob("*.feather"))) > 3
    assert {file: file.stat().st_mtime_ns for file in stamps} == stamps
    with pytest.raises(CFlowError, match="profile"):
        benchmark_logs(tmp_path, "none", [1], 3)


def test_a_changed_generator_makes_new_drives(tmp_path, monkeypatch):
    shutil.copytree(benchmark._HERE, tmp_path / "code")
    key = benchmark.generator_key()
    assert benchmark.generator_key(benchmark.HDF5) != key, "the code of its writer is of it, too"
    monkeypatch.setattr(benchmark, "_HERE", tmp_path / "code")
    assert benchmark.generator_key() == key
    file = tmp_path / "code" / "street.py"
    file.write_bytes(file.read_bytes() + b"\n")
    assert benchmark.generator_key() != key
