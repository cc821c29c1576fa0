"""Moving objects are removed, also while they wait; logs come back from disk; the map has one point per voxel."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from scenes import pose
from small_logs import make_small_drive
from staged_cars import Staged, straight
from test_tracking import calls_on_a_drive

from cflow_torch import CFlowError, CleanLog, FlowResult, Sweep, static_map
from cflow_torch.applications.cleaning import MaskedLog
from cflow_torch.data.arrays import ArraysLog, write_array_log
from cflow_torch.data.camera import Camera
from cflow_torch.data.log import CachedLog, Log


def cleaned(log: Staged, **more: Any) -> CleanLog:
    return CleanLog(log, flow=log.result, **more)


def test_moving_cars_are_removed_from_every_sweep_and_the_wall_stays() -> None:
    log = Staged([straight((0, 0), (0.9, 0.0)), straight((20, 5), (-1.0, 0.0))])
    clean = cleaned(log)
    for index in range(len(log)):  # the last one has no flow of its own
        assert np.array_equal(clean.moving(index), log.world(index)[2] >= 0), index
        assert len(clean[index].points) == (log.world(index)[2] < 0).sum()
        assert clean[index].timestamp_ns == log.timestamps[index]


def test_the_pair_over_a_gap_of_the_log_is_not_used() -> None:
    """Its two sweeps are far apart, so its flow would be wrong. The sweep before it is like a last sweep."""
    log = Staged([straight((0, 0), (0.9, 0.0)), straight((20, 5), (-1.0, 0.0))])
    log.gaps, asked = frozenset([2]), []

    def flow(index: int) -> FlowResult:
        asked.append(index)
        return log.result(index)

    for more in ({}, {"remove_stopped": True}):
        clean = CleanLog(log, flow=flow, **more)
        for index in range(len(log)):
            assert np.array_equal(clean.moving(index), log.world(index)[2] >= 0), index
    assert 2 not in asked and 1 in asked
    log.gaps = frozenset([1, 2])
    assert not cleaned(log).moving(2).any(), "no pair has flow for it"


@pytest.mark.parametrize("gap", [3, 13])
def test_waiting_cars_are_removed_by_their_tracks_and_parked_cars_stay(gap: int) -> None:
    """A car that waits for eight sweeps and starts, a car that stops, and a parked car that never moves."""
    start = np.cumsum([0.0] * 8 + [0.1, 0.2, 0.4, 0.7, 1.0, 1.0, 1.0, 1.0])
    stop = np.cumsum([1.0, 1.0, 1.0, 1.0, 0.7, 0.4, 0.2, 0.1] + [0.0] * 8)
    moving = [np.stack([start, 0 * start], 1), np.stack([stop, 0 * stop + 5], 1)]
    log = Staged([*moving, straight((25, 0), (0, 0), 16)])
    log.gaps = frozenset([gap])
    by_flow, by_tracks = cleaned(log), cleaned(log, remove_stopped=True)
    for index in range(len(log)):  # the last sweep, and the one before the gap, have no flow
        car = log.world(index)[2]
        assert np.array_equal(by_tracks.moving(index), (car == 0) | (car == 1)), index
    removed = sum(int(by_tracks.moving(k).sum()) - int(by_flow.moving(k).sum()) for k in range(len(log)))
    assert by_flow.num_stopped is None and by_tracks.num_stopped == removed > 0
    assert not by_flow.moving(2)[log.world(2)[2] == 0].any() and not by_flow.moving(12)[log.world(12)[2] == 1].any()


def test_a_piece_of_a_waiting_car_that_seems_to_move_does_not_take_its_track() -> None:
    class Outline(Staged):
        """After the car has stopped, the flow of its front end is wrong in every second sweep."""

        def result(self, index: int, confidence: float = 0.9) -> FlowResult:
            result, (points, flow, car) = super().result(index, confidence), self.world(index)
            is_front = (car == 0) & (points[:, 0] > points[car == 0, 0].max() - 0.7) & (flow[:, 0] == 0)
            result.residual_flow[is_front] = torch.tensor([-0.2 * (index % 2), 0.0, 0.0])
            return result

    steps = np.cumsum([1.0] * 5 + [0.6, 0.3, 0.1] + [0.0] * 8)
    log = Outline([np.stack([steps, 0 * steps], 1)])
    clean = cleaned(log, remove_stopped=True)
    for index in range(len(log) - 1):
        assert np.array_equal(clean.moving(index), log.world(index)[2] == 0), index


@pytest.mark.parametrize("suffix", [".npy", ".ply", ".bin"])
def test_ground_times_and_other_columns_stay_with_their_rows(tmp_path: Path, suffix: str) -> None:
    class WithRows(Staged):
        def sweep(self, index: int) -> Sweep:
            points = super().sweep(index).points
            rows = np.arange(len(points))
            return Sweep(points, rows % 7 == 0, None, self.timestamps[index], rows * 1e-6)

        def columns(self, index: int) -> dict[str, np.ndarray]:
            return {"column_3": np.arange(len(self.sweep(index).points), dtype=np.float32)}

    log = WithRows([straight((0, 0), (0.9, 0.0))])
    sweep, stays = cleaned(log)[3], np.flatnonzero(~cleaned(log).moving(3))
    assert np.array_equal(sweep.is_ground, stays % 7 == 0) and np.allclose(sweep.point_times, stays * 1e-6)
    source = ArraysLog(write_array_log(log, tmp_path / "all", suffix))
    clean = CleanLog(source, flow=log.result)
    back = ArraysLog(write_array_log(clean, tmp_path / "clean", suffix))
    for index in (3, len(log) - 1):
        row, points = back.columns(index)["column_3"].astype(int), source.sweep(index).points
        assert 0 < len(row) < len(points) and np.array_equal(back.sweep(index).points, points[row])
    log.columns = lambda index: {"ring": np.zeros(3, int)}  # type: ignore[method-assign]
    with pytest.raises(CFlowError, match="column ring of sweep 2 has shape"):
        cleaned(log).columns(2)


def test_a_clean_log_is_written_and_read_like_any_log(tmp_path: Path) -> None:
    poses = np.stack([pose(k, 0, 0) for k in range(12)])
    log = Staged([straight((0, 0), (0.9, 0.0))], poses)
    back = ArraysLog(write_array_log(cleaned(log), tmp_path, ".ply"))
    assert len(back) == 12 and np.allclose(back.poses, poses)
    assert np.allclose(back[4].points, log.sweep(4).points[log.world(4)[2] < 0])
    points = static_map(back, 0.4)
    wall = log.world(0)[0][log.world(0)[2] < 0]
    voxels = np.unique(np.floor(points / 0.4), axis=0)
    assert len(voxels) == len(points), "one point of each voxel"
    assert np.array_equal(voxels, np.unique(np.floor(wall.astype(np.float32).astype(float) / 0.4), axis=0))


def test_empty_sweeps_give_empty_sweeps_and_an_empty_map() -> None:
    class Empty(Log):
        log_id, timestamps = "empty", (1, 2, 3)

        def sweep(self, index: int) -> Sweep:
            return Sweep(np.zeros((0, 3), np.float32), None, np.eye(4), 10**8 * index)

    for remove_stopped in (False, True):
        clean = CleanLog(Empty(), remove_stopped=remove_stopped)
        assert [len(sweep.points) for sweep in clean] == [0, 0, 0]
    assert static_map(clean).shape == (0, 3)


def test_wrong_inputs_are_one_clear_error() -> None:
    log = Staged([straight((0, 0), (0.9, 0.0))])
    with pytest.raises(CFlowError, match="odometry"):
        static_map(cleaned(log))
    with pytest.raises(CFlowError, match="voxel_size"):
        static_map(log, 0.0)
    with pytest.raises(CFlowError, match="rows"):
        CleanLog(log, flow=lambda index: Staged(log.paths * np.nan).result(index)).moving(0)
    log.poses = np.tile(np.eye(4), (12, 1, 1))
    with pytest.raises(CFlowError, match="larger voxels"):
        static_map(log, 1e-5)


def test_the_command_resumes_and_refuses_changed_settings(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    call = calls_on_a_drive(tmp_path)
    settings = ("map=true", "voxel_size=0.5", "suffix=.ply")
    assert call("clean", "clean", *settings) == 0
    (file,) = (tmp_path / "clean").glob("*/map.ply")
    log = ArraysLog(file.parent)
    assert len(log) == 4 and len(log[0].points) > 1000 and log[0].is_ground is not None
    before = file.read_bytes()
    picture = file.with_suffix(".png")
    assert picture.read_bytes()[:4] == b"\x89PNG"
    given = log.columns(0)
    assert set(given) == {"intensity", "laser_number", "offset_ns"} and len(given["intensity"]) == len(log[0].points)
    file.unlink()
    capsys.readouterr()
    assert call("clean", "clean", *settings) == 0 and file.read_bytes() == before
    assert f"drawn in {picture}" in capsys.readouterr().out
    capsys.readouterr()
    assert call("clean", "clean", "remove_stopped=true") == 2
    assert "remove_stopped was" in capsys.readouterr().err
    assert call("clean", "other", "suffix=.xyz") == 2 and ".ply" in capsys.readouterr().err


def test_all_else_of_a_log_stays_with_its_rows() -> None:
    drive = CachedLog(make_small_drive(3), 3)
    camera = Camera("front", "0", (2, 1), np.eye(3), np.eye(4))
    drive.cameras, drive.T_camera0_lidar = lambda index: [camera], np.eye(4)
    drive.moving = lambda index: np.arange(len(drive.sweep(index).points)) % 3 == 0
    drive.eval_mask = lambda index: np.arange(len(drive.sweep(index).points)) % 5 == 0
    masked = MaskedLog(drive, lambda index: np.arange(len(drive.sweep(index).points)) % 2 == 0)
    assert masked.cameras(1) == [camera] and np.array_equal(masked.T_camera0_lidar, np.eye(4))
    assert np.array_equal(masked.poses, drive.poses) and masked.sample_tokens == drive.sample_tokens
    rows = np.arange(len(drive.sweep(1).points))[1::2]
    labels, given = masked.labels(1), drive.labels(1)
    assert len(rows) == len(masked.sweep(1).points) and np.array_equal(labels.flow, given.flow[rows])
    assert np.array_equal(labels.category, given.category[rows]) and masked.labels(2) is None
    assert np.array_equal(masked.moving(1), rows % 3 == 0) and np.array_equal(masked.eval_mask(1), rows % 5 == 0)
    assert masked.units(1) is None
