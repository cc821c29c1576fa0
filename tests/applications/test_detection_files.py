"""Detections are read by the evaluators that own their formats, in the frames that these expect."""

from __future__ import annotations

import json
import pickle
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scenes import pose
from staged_cars import SIZE, Staged, straight
from tiny_recording import CAR_SIZE, CAR_VELOCITY, TinyRecording
from writers.nuscenes import write_nuscenes as write_scene

from cflow_torch import track
from cflow_torch.applications.detection_files import write_nuscenes, write_openpcdet
from cflow_torch.applications.track_table import COLUMNS, Table, boxes_in_sweeps, score_of
from cflow_torch.data.nuscenes.reader import NuScenesLog, find_nuscenes_scenes


def empty_rows(count: int) -> Table:
    return {**{name: np.zeros(count, dtype) for name, dtype in COLUMNS.items()}, "class": np.full(count, "car")}


def exact_tracks(recording: TinyRecording) -> Table:
    """The car of a recording in every sweep, as it is annotated."""
    count = len(recording.timestamps)
    boxes = np.stack([recording.car_at(stamp) for stamp in recording.timestamps])
    table = empty_rows(count)
    table.update(sweep=np.arange(count), confidence=np.full(count, 0.8), is_moving=np.ones(count, bool))
    table.update(dict(zip("xyz", boxes[:, :3, 3].T)), heading=np.arctan2(boxes[:, 1, 0], boxes[:, 0, 0]))
    table.update({name: np.full(count, CAR_VELOCITY[k]) for k, name in enumerate(("vx", "vy"))})
    table.update({name: np.full(count, CAR_SIZE[k]) for k, name in enumerate(("length", "width", "height"))})
    return table


@pytest.fixture
def scene(tmp_path: Path) -> tuple[NuScenesLog, Path]:
    """A scene of 11 sweeps and 3 samples, whose name is in nuScenes' split mini_val; and the results for it."""
    recording = TinyRecording(("LIDAR_TOP",), num_sweeps=11, interval_ns=50_000_000, log_id="scene-0103")
    (source,) = find_nuscenes_scenes(write_scene(recording, tmp_path / "data", key_frame_interval=0.25))
    log = NuScenesLog(source)
    write_nuscenes(tmp_path / "results", exact_tracks(recording), log)
    return log, tmp_path


def test_the_evaluator_of_nuscenes_scores_exact_tracks_as_exact(scene: tuple[NuScenesLog, Path]) -> None:
    pytest.importorskip("nuscenes", reason="needs nuscenes-devkit: scripts/evaluators.txt")
    from nuscenes import NuScenes
    from nuscenes.eval.common.config import config_factory
    from nuscenes.eval.detection.evaluate import DetectionEval

    _, folder = scene
    devkit = NuScenes("v1.0-mini", str(folder / "data" / "scene-0103"), verbose=False)
    results = str(folder / "results" / "nuscenes_detection.json")
    config = config_factory("detection_cvpr_2019")
    evaluation = DetectionEval(devkit, config, results, "mini_val", str(folder / "plots"), verbose=False)
    metrics = evaluation.evaluate()[0].serialize()
    assert min(metrics["label_aps"]["car"].values()) == pytest.approx(1.0)
    errors = metrics["label_tp_errors"]["car"]
    for name in ("trans_err", "scale_err", "orient_err", "vel_err"):
        assert errors[name] < 1e-6, name


def test_the_classes_of_nuscenes_read_the_tracking_results(scene: tuple[NuScenesLog, Path]) -> None:
    pytest.importorskip("nuscenes", reason="needs nuscenes-devkit: scripts/evaluators.txt")
    from nuscenes.eval.common.config import config_factory
    from nuscenes.eval.common.loaders import load_prediction
    from nuscenes.eval.tracking.data_classes import TrackingBox

    log, folder = scene
    config_factory("tracking_nips_2019")  # its boxes accept only the names of a configuration
    boxes, meta = load_prediction(str(folder / "results" / "nuscenes_tracking.json"), 500, TrackingBox)
    assert meta["use_lidar"] and not meta["use_camera"]
    keys = [token for token in log.sample_tokens if token is not None]
    assert len(keys) == 3 and boxes.sample_tokens == keys
    assert {(box.tracking_id, box.tracking_name) for box in boxes.all} == {("0", "car")}
    assert all(box.tracking_score == pytest.approx(0.8) for box in boxes.all)


def read_results(folder: Path, task: str) -> dict[str, Any]:
    results: dict[str, Any] = json.loads((folder / f"nuscenes_{task}.json").read_text())["results"]
    return results


def test_samples_of_other_logs_are_their_sweeps_and_hold_at_most_500_boxes(tmp_path: Path) -> None:
    log = Staged([straight((0, 0), (0.9, 0.0))])
    table = empty_rows(1003)
    table["id"] = np.arange(1003)
    table["sweep"][:2] = 3
    table["sweep"][2:] = 5
    table["confidence"] = np.linspace(0.0, 1.0, 1003)
    table["confidence"][0] = np.nan
    table["is_moving"][1] = True
    table["class"] = np.where(table["sweep"] == 3, "pedestrian", "truck")
    write_nuscenes(tmp_path, table, log)
    results = read_results(tmp_path, "detection")
    assert list(results) == [f"staged_{stamp}" for stamp in log.timestamps]
    assert sorted(map(len, results.values())) == [0] * 10 + [2, 500]
    first, second = results[f"staged_{log.timestamps[3]}"]
    assert first["detection_score"] == 1.0 and first["attribute_name"] == "pedestrian.standing"
    assert second["attribute_name"] == "pedestrian.moving" and second["detection_name"] == "pedestrian"
    assert {box["detection_name"] for box in results[f"staged_{log.timestamps[5]}"]} == {"truck"}
    scores = [box["tracking_score"] for box in read_results(tmp_path, "tracking")[f"staged_{log.timestamps[5]}"]]
    assert scores == sorted(table["confidence"][2:], reverse=True)[:500]


def test_the_score_of_a_track_is_the_same_in_all_its_sweeps() -> None:
    table = empty_rows(4)
    table["id"] = np.array([7, 3, 7, 3])
    table["confidence"] = np.array([0.2, np.nan, 0.6, np.nan])
    assert np.allclose(score_of(table), [0.4, 1.0, 0.4, 1.0])


def test_openpcdet_reads_boxes_in_the_frame_of_the_points(tmp_path: Path) -> None:
    """A vehicle that has turned and tilted stands beside a car that drives along the world's x axis."""
    vehicle = pose(-20, -5, np.pi / 2, 1)
    log = Staged([straight((0, -6), (0.8, 0.0))], np.tile(vehicle, (12, 1, 1)))
    table = track(log, log.results())
    table["class"] = np.where(table["sweep"] == 2, "cyclist", "car")
    write_openpcdet(tmp_path, table, log)
    content = (tmp_path / "result.pkl").read_bytes()
    assert b"numpy.core.multiarray" in content and b"numpy._core" not in content, "NumPy 1 reads it"
    frames = pickle.loads(content)
    assert [frame["frame_id"] for frame in frames] == [f"{sweep:06d}" for sweep in range(12)]
    assert frames[2]["name"].tolist() == ["Cyclist"] and frames[2]["pred_labels"].tolist() == [3]
    for frame in (*frames[:2], *frames[3:]):
        assert frame["name"].tolist() == ["Car"] and frame["pred_labels"].tolist() == [1]
        assert frame["score"].shape == (1,) and frame["boxes_lidar"].dtype == np.float32
    for sweep in (6, 11):
        points = log.sweep(sweep).points
        car = points[log.world(sweep)[2] == 0]
        box = frames[sweep]["boxes_lidar"][0]
        np.testing.assert_allclose(box[:3], (car.min(0) + car.max(0)) / 2, atol=0.1)
        np.testing.assert_allclose(box[3:6], SIZE, atol=0.01)
        assert box[6] == pytest.approx(-np.pi / 2, abs=0.02), "the car drives to the right of the vehicle"
    empty = {name: values[:0] for name, values in table.items()}
    write_openpcdet(tmp_path, empty, log)
    frames = pickle.loads((tmp_path / "result.pkl").read_bytes())
    assert frames[11]["boxes_lidar"].shape == (0, 7) and len(frames[11]["name"]) == 0


def test_boxes_in_sweeps_of_known_poses_read_no_points() -> None:
    vehicle = np.stack([pose(0.5 * k, 0, 0.1 * k) for k in range(12)])
    log = Staged([straight((10, -6), (0.8, 0.0))], vehicle)
    table = track(log, log.results())
    expected = boxes_in_sweeps(table, log)
    log.sweep = lambda index: pytest.fail("a cloud is read")  # type: ignore[method-assign]
    assert all(map(np.array_equal, boxes_in_sweeps(table, log), expected))
    assert np.ptp(expected[0][:, 0]) > 1
