"""Logs as sequences, their windows, and windows for a DataLoader; results as files, tables and objects."""

from __future__ import annotations

import json
import pickle
import sys
from pathlib import Path
from typing import Any, Sequence

import numpy as np
import pytest
from torch.utils.data import DataLoader

from cflow_torch import CFlowError, FlowResult, Window, make_config, make_model
from cflow_torch.data.flow_file import CONTENTS, ON_REQUEST, has_track_ids, read_flow, write_flow
from cflow_torch.data.log import CachedLog, FlowLabels, Log, WindowDataset, window, windows
from cflow_torch.errors import MissingFile
from cflow_torch.simulator import Drive, make_drive
from cflow_torch.types import Sweep


@pytest.fixture(scope="module")
def drive() -> Drive:
    return make_drive(seed=1, num_sweeps=5, profile="demo")


@pytest.fixture(scope="module")
def result(drive: Drive) -> FlowResult:
    """Flow of the second-last pair by the default preset."""
    (result,) = make_model(make_config())([window(drive, 3, 3)])
    return result


def points_of(windows: Sequence[Window]) -> list:
    return [[sweep.points for sweep in w.sweeps] for w in windows]


def test_logs_and_wrappers_are_sequences(drive):
    class Mine(Log):
        log_id, timestamps = "mine", (0, 1, 2)

        def sweep(self, index: int) -> Sweep:
            return Sweep(np.full((index, 3), index, np.float32))

    for log in (Mine(), CachedLog(Mine(), 2)):
        assert [len(sweep.points) for sweep in log] == [0, 1, 2] and len(log) == 3
        assert len(log[-1].points) == 2 and log.labels(0) is None
        assert [len(sweep.points) for sweep in log[1:3]] == [1, 2]
        assert [len(sweep.points) for sweep in log[::-2]] == [2, 0]
        with pytest.raises(IndexError):
            log[3]
    recent = pickle.loads(pickle.dumps(CachedLog(drive, 2)))
    assert np.array_equal(recent.sweep(1).points, drive.sweep(1).points)


@pytest.mark.parametrize(
    ("field", "values", "complaint"),
    [
        ("category", np.zeros(4, bool), r"category has dtype bool: give \(4,\) integers"),
        ("category", np.zeros(3, np.uint8), r"category has shape \(3,\)"),
        ("is_valid", np.ones(4, np.uint8), "is_valid has dtype uint8"),
        ("flow", np.zeros((4, 2), np.float32), r"flow has shape \(4, 2\)"),
        ("flow", np.zeros((4, 3), int), "flow has dtype int64"),
        ("flow", [[0.0] * 3] * 4, "flow is list"),
    ],
)
def test_labels_of_a_wrong_type_or_shape_are_refused(field, values, complaint):
    good = {"flow": np.zeros((4, 3), np.float32), "category": np.zeros(4, np.uint8), "is_valid": np.ones(4, bool)}
    FlowLabels(**good)
    with pytest.raises(CFlowError, match=f"FlowLabels.{complaint}"):
        FlowLabels(**{**good, field: values})


def test_windows_read_each_sweep_once(drive):
    class Counted(Log):
        log_id, timestamps, read = drive.log_id, drive.timestamps, []  # noqa: RUF012

        def sweep(self, index: int) -> Sweep:
            self.read.append(index)
            return drive.sweep(index)

    found = list(windows(Counted(), num_history=2, num_future=1))
    expected = [window(drive, index, 2, 1) for index in range(4)]
    assert all(map(np.array_equal, sum(points_of(found), []), sum(points_of(expected), [])))
    assert sorted(Counted.read) == [0, 1, 2, 3, 4]


@pytest.mark.parametrize("index, past, future", [(0, [], [2, 3]), (1, [0], [3, 4]), (2, [1, 0], [4]), (3, [2, 1], [])])
def test_windows_are_shorter_at_both_ends_of_a_log(index, past, future, drive):
    found, stamps = window(drive, index, 2, 2), list(drive.timestamps)
    sides = ((found.pc0, found.pc1), found.pch, found.pcf)
    places = [[stamps.index(sweep.timestamp_ns) for sweep in sweeps] for sweeps in sides]
    assert places == [[index, index + 1], past, future]


def test_a_data_loader_with_workers_equals_the_loop(drive):
    model = make_model(make_config(num_history=2, point_cloud_range=(-20, -20, -9, 20, 20, 9)))
    data = WindowDataset([drive, make_drive(seed=2, num_sweeps=3, profile="demo")], num_history=2)
    assert len(WindowDataset(drive)) == 4
    loader: Any = DataLoader(data, batch_size=2, num_workers=2, collate_fn=data.collate)
    loaded = [result for batch in loader for result in model(batch)]
    looped = [result for number in range(len(data)) for result in model([data[number]])]
    assert len(loaded) == len(looped) == 6 and any(result.residual_flow.any() for result in looped)
    for one, other in zip(loaded, looped):
        assert all(np.array_equal(values, other.numpy()[name]) for name, values in one.numpy().items())


def test_a_result_is_saved_and_loaded(result, tmp_path):
    result.save(tmp_path / "a.npz")
    again = FlowResult.load(tmp_path / "a.npz").numpy()
    assert again.keys() == result.numpy().keys() and "confidence" in again
    assert all(np.array_equal(values, again[name]) for name, values in result.numpy().items())
    np.savez(tmp_path / "objects.npz", flow=np.array([{}], dtype=object))
    np.savez(tmp_path / "other.npz", points=np.zeros(3))
    (tmp_path / "short.npz").write_bytes((tmp_path / "a.npz").read_bytes()[:1000])
    for name in ("objects", "other", "short", "absent"):
        with pytest.raises(CFlowError, match=f"{name}.npz is not a result"):
            FlowResult.load(tmp_path / f"{name}.npz")


@pytest.mark.parametrize(
    "contents", [(*CONTENTS, *ON_REQUEST), ("residual", "is_valid"), ("score",), ("flow", "cluster_id")]
)
def test_every_flow_file_can_be_read(contents, result, tmp_path):
    file = tmp_path / "1.feather"
    write_flow(file, result, contents)
    again, columns = read_flow(file), result.columns()
    wanted = {name for name in columns if name.startswith(tuple(f"{c}_t" for c in contents)) or name in contents}
    assert again.columns().keys() == wanted
    assert all(np.array_equal(values, columns[name]) for name, values in again.columns().items())
    with pytest.raises(CFlowError, match="pass points="):
        write_flow(file, result, ("points", *contents), np.zeros((3, 3)))
    with pytest.raises(CFlowError, match="not a flow file"):
        read_flow(Path(__file__))


def test_a_data_frame_has_a_row_per_point(drive, result, monkeypatch):
    pandas = pytest.importorskip("pandas")
    points = drive.sweep(3).points
    frame = result.to_pandas(points)
    assert isinstance(frame, pandas.DataFrame) and list(frame.columns[:4]) == ["x", "y", "z", "residual_tx_m"]
    assert np.array_equal(frame[["flow_tx_m", "flow_ty_m", "flow_tz_m"]], result.flow) and len(frame) == len(points)
    with pytest.raises(CFlowError, match="pc0 has shape .* one row per point"):
        result.to_pandas(points[1:])
    monkeypatch.setitem(sys.modules, "pandas", None)
    with pytest.raises(CFlowError, match="pip install pandas"):
        result.to_pandas()


def test_a_result_is_printed_in_one_line(result):
    in_cluster = result.cluster_id[result.cluster_id >= 0]
    counts = f"{len(result.flow)} points, {int(result.is_valid.sum())} valid, {len(in_cluster)} in"
    assert repr(result) == f"FlowResult({counts} {len(set(in_cluster.tolist()))} clusters)"
    part = FlowResult.of({"flow": result.flow})
    assert repr(part).startswith(f"FlowResult({len(result.flow)} points, no residual_flow, no pose_flow, no cluster_id")


def test_objects_are_the_moving_objects_of_the_simulator(drive, result):
    """Objects with 50 points or more; the articulated lorry is left out because it is not a rigid body."""
    objects = result.objects(drive.sweep(3).points)
    assert np.array_equal(result.objects(drive.sweep(3)), objects), "the sweep will do, too"
    assert len(objects) and (np.diff(objects["id"]) > 0).all()
    assert (np.linalg.norm(objects["velocity"], axis=1) >= 0.5).all()
    T, before, after = np.linalg.inv(drive.poses[4]) @ drive.poses[3], drive.boxes(3), drive.boxes(4)
    num_moving, num_missed, is_found = 0, 0, np.zeros(len(objects), bool)
    for track, pose0, count, category in zip(before.track_id, before.pose, before.num_points, before.names):
        number = after.track_id.index(track)
        pose, size = after.pose[number], after.size[number]
        velocity = (pose - T @ pose0)[:3, 3] / 0.1
        within = (np.abs((objects["centre"] - pose[:3, 3]) @ pose[:3, :3]) <= size / 2).all(1)
        if np.linalg.norm(velocity) < 0.5:
            continue
        is_found |= within
        if count < 50 or category in ("TRUCK_CAB", "VEHICULAR_TRAILER"):
            continue
        num_moving += 1
        if not within.any():
            num_missed += 1
            continue
        row = max(objects[within], key=lambda one: one["num_points"])
        assert np.linalg.norm(row["velocity"] - velocity) < 0.75, category
        assert 0.7 * count < row["num_points"] <= count and (row["size"] < size + 0.6).all(), category
        difference = np.angle(np.exp(1j * (row["heading"] - np.arctan2(pose[1, 0], pose[0, 0]))))
        assert abs(difference) < 0.4, category
    assert num_moving >= 6 and num_missed <= 1 and is_found[objects["confidence"] > 0.7].mean() > 0.8
    large = result.objects(drive.sweep(3).points, min_points=100)
    assert np.array_equal(objects[objects["num_points"] >= 100], large) and 0 < len(large) < len(objects)
    with pytest.raises(CFlowError, match="without"):
        FlowResult.of({"flow": result.flow}).objects(drive.sweep(3).points)
    assert type(objects["velocity"]) is np.ndarray
    records = objects[:2].to_records()
    assert json.loads(json.dumps(records, allow_nan=False)) == records and len(records) == 2
    first, row = records[0], objects[0]
    assert [first["x"], first["y"], first["z"]] == row["centre"].tolist() and first["id"] == row["id"]
    assert [first["length"], first["width"], first["height"]] == row["size"].tolist()
    assert [first["vx"], first["vy"], first["vz"]] == row["velocity"].tolist()
    assert (first["heading"], first["num_points"]) == (row["heading"], row["num_points"])
    pandas = pytest.importorskip("pandas")
    assert pandas.DataFrame(objects[:2]).to_dict("records") == records
    without = FlowResult.of({**vars(result), "confidence": None}).objects(drive.sweep(3).points).to_records()
    assert without[0]["confidence"] is None and json.dumps(without, allow_nan=False)
    empty = result.objects(drive.sweep(3).points, min_speed=1e3)
    assert empty.to_records() == []
    assert len(empty) == 0 and empty.dtype == objects.dtype


def test_a_stopped_cache_stays_stopped_in_another_process(drive):
    log = CachedLog(drive, 3)
    log.stop()
    for stopped in (log, pickle.loads(pickle.dumps(log))):
        assert stopped.sweep(1) is not stopped.sweep(1)


def test_a_damaged_flow_file_is_named(tmp_path):
    (tmp_path / "1.feather").write_bytes(b"no arrow file")
    with pytest.raises(CFlowError, match="1.feather"):
        has_track_ids(tmp_path / "1.feather")
    with pytest.raises(MissingFile, match="2.feather is missing"):
        read_flow(tmp_path / "2.feather")
