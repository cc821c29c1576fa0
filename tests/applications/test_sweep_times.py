"""Every application takes the times of sweeps from one clock, and the numbers of frames from the data set."""

from __future__ import annotations

import pickle
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from command_line import cflow
from small_logs import make_small_drive
from staged_cars import Staged, straight

from cflow_torch import CFlowError, FlowResult, FlowStream, Sweep, Tracker, Window, make_config, make_model, track
from cflow_torch.applications import tracking
from cflow_torch.applications.detection_files import write_openpcdet
from cflow_torch.applications.kitti_tracks import write_kitti
from cflow_torch.applications.labels import find_labels
from cflow_torch.applications.masks import DynamicShapes
from cflow_torch.applications.moving_labels import write_moving_labels
from cflow_torch.applications.track_table import read_tracks
from cflow_torch.cli.stream import play
from cflow_torch.data.arrays import ArraysLog, write_array_log
from cflow_torch.data.log import CachedLog, TimedLog

STEP = 0.9  # metres per sweep
NEAR = "model.point_cloud_range=[-20,-20,-inf,20,20,inf]"
SMALL = ("model.num_history=0", "model.pixel_sizes=[0.4,0.2]", NEAR, "data.check=false", "engine.workers=1")


class Numbered(Staged):
    """A car in sweeps without time stamps, as files of these numbers; those that are missing are never read."""

    def __init__(self, numbers: Any) -> None:
        self.numbers = list(numbers)
        path = straight((0, 0), (STEP, 0), max(self.numbers) - self.numbers[0] + 1)
        super().__init__([path[np.array(self.numbers) - self.numbers[0]]])
        self.timestamps = list(range(len(self.numbers)))
        self.gaps = frozenset(np.flatnonzero(np.diff(self.numbers) > 1).tolist())

    def sweep(self, index: int) -> Sweep:
        return replace(super().sweep(index), timestamp_ns=None)

    def frame_number(self, index: int) -> int:
        return self.numbers[index]

    def results(self) -> list[tuple[int, FlowResult]]:
        return [(index, result) for index, result in super().results() if index not in self.gaps]


def test_missing_files_and_the_interval_tell_the_time_of_sweeps_without_stamps(tmp_path: Path) -> None:
    drive = make_small_drive(6)
    write_array_log(drive, tmp_path, ".bin")
    folder = tmp_path / drive.log_id
    (folder / "times.txt").unlink()
    for file in sorted((folder / "points").iterdir(), reverse=True):
        file.rename(file.with_name(f"{int(file.stem) + 127:06d}.bin"))
    (folder / "points" / "000128.bin").unlink()
    log = ArraysLog(folder, poses=None, ground=None)
    assert [log.frame_number(index) for index in range(5)] == [127, 129, 130, 131, 132]
    assert np.allclose(log.sweep_times(0.5), [0, 1, 1.5, 2, 2.5])
    timed = CachedLog(TimedLog(log, 0.5), 2)
    assert [sweep.timestamp_ns for sweep in timed] == [0, 10**9, 15 * 10**8, 2 * 10**9, 25 * 10**8]
    assert np.allclose(timed.sweep_times(), log.sweep_times(0.5)) and timed.timestamps == log.timestamps
    with_stamps = TimedLog(drive, 0.5)
    assert np.allclose(with_stamps.sweep_times(), 0.1 * np.arange(6))
    assert with_stamps.sweep(2).timestamp_ns == drive.timestamps[2]


@pytest.mark.parametrize("numbers", [range(127, 139), [*range(127, 132), *range(135, 142)]])
def test_a_track_goes_on_where_files_are_missing(numbers: Any) -> None:
    log = Numbered(numbers)
    table = track(log, log.results(), sweep_interval=0.05)
    assert len(set(table["id"])) == 1 and np.allclose(table["vx"], STEP / 0.05, atol=0.1)
    assert np.allclose(table["age"][-1], 0.05 * (table["sweep"][-1] + max(numbers) - min(numbers) + 1 - len(numbers)))


def test_pairs_far_apart_confirm_a_track_and_a_long_pause_ends_it() -> None:
    """The box of a track also moves between the pairs. After a pause, what is in its place may be anything."""
    log = Staged([straight((0, 0), (0.5, 0.0), 40)])
    pairs = [(index, log.result(index)) for index in range(0, 39, 4)]
    assert len(set(track(log, pairs)["id"])) == 1
    late = Staged([straight((0, 0), (0.1, 0.0), 48)])
    results = list(late.results())
    assert len(set(track(late, [pair for pair in results if not 20 <= pair[0] < 28])["id"])) == 1
    assert len(set(track(late, [pair for pair in results if not 20 <= pair[0] < 40])["id"])) == 2


def test_the_pair_over_a_gap_is_not_estimated(monkeypatch: pytest.MonkeyPatch) -> None:
    log = Numbered([0, 1, 2, 5, 6, 7, 8])

    class Known:
        config = make_config("default", num_history=0)

        def __call__(self, sweeps: list[Window]) -> list[FlowResult]:
            (index,) = (k for k in range(len(log)) if np.array_equal(log.sweep(k).points, sweeps[0].pc0.points))
            assert index not in log.gaps
            return [log.result(index)]

    monkeypatch.setattr(tracking, "make_model", lambda *_: Known())
    assert log.pairs == [0, 1, 3, 4, 5] and set(track(log)["sweep"]) == set(range(7))


def test_pairs_that_do_not_go_forward_in_time_are_an_error() -> None:
    log = Staged([straight((0, 0), (0.9, 0.0))])
    for later in (log.sweep(3), log.sweep(2)):
        with pytest.raises(CFlowError, match="order of time"):
            Tracker().push(Window(log.sweep(3), later), log.result(3))


def test_files_for_others_have_the_numbers_of_the_data_set(tmp_path: Path) -> None:
    log = Numbered([127, 128, 129, 130, 131, 135, 136, 137, 138, 139])
    table = track(log, log.results())
    write_kitti(tmp_path, table, log)
    write_openpcdet(tmp_path, table, log)
    write_moving_labels(tmp_path / "labels", log, log.results())
    frames = [int(line.split()[0]) for line in (tmp_path / "kitti.txt").read_text().splitlines()]
    assert frames == [log.numbers[sweep] for sweep in table["sweep"]] and 136 in frames
    names = [f"{number:06d}" for number in log.numbers]
    assert [frame["frame_id"] for frame in pickle.loads((tmp_path / "result.pkl").read_bytes())] == names
    assert sorted(file.stem for file in (tmp_path / "labels").iterdir()) == names


def test_masks_streams_and_labels_know_the_interval() -> None:
    log = Numbered(range(6))
    shapes = DynamicShapes.of(TimedLog(log, 0.2), 1, log.result(1), track(log, log.results()))
    assert np.allclose(shapes.point_velocity, (STEP / 0.2, 0, 0), atol=1e-5)
    stream = FlowStream("paper", device="cpu", ground=None, sweep_interval=0.02)
    assert play(stream, log, pace=1.0, count=4)["interval"] == pytest.approx(0.02)


def test_labels_need_masks_and_no_stamps() -> None:
    pytest.importorskip("scipy")
    model = make_model("default", "cpu", num_history=0, pixel_sizes=(0.4,))
    log = Numbered(range(3))
    results = [replace(log.result(index), moving=torch.ones(len(log.sweep(index).points))) for index in range(2)]
    with pytest.raises(CFlowError, match="has no ground mask, which labels need"):
        list(find_labels(log, results, model))
    sweep = log.sweep
    log.sweep = lambda index: replace(sweep(index), is_ground=np.zeros(len(sweep(index).points), bool))  # type: ignore
    assert [stamp for stamp, _ in find_labels(log, results, model)] == [0, 1, 2]


def test_commands_use_the_interval_of_the_method(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The command measures ages and paces in seconds of `model.sweep_interval`, also for flow that is stored."""
    pytest.importorskip("k3d")
    from cflow_torch.cli import view

    write_array_log(make_small_drive(5), tmp_path / "data")
    (folder,) = (tmp_path / "data").iterdir()
    (folder / "times.txt").unlink()
    call = (folder, "data.poses=poses.txt", *SMALL, f"output={tmp_path / 'flow'}")
    assert cflow("flow", *call, "tracks=true", "model.sweep_interval=0.3", "model.max_speed=10") == 0
    (file,) = (tmp_path / "flow").glob("*/tracks.parquet")
    table = read_tracks(file)
    assert len(table["id"]) and table["age"].max() == pytest.approx(0.3 * table["sweep"].max())
    seen: list[float] = []
    save = view.save_page
    monkeypatch.setattr(view, "save_page", lambda log, *a, **b: seen.extend(log.sweep_times()) or save(log, *a, **b))
    stored = (f"flow={tmp_path / 'flow'}", f"output={tmp_path / 'view'}", "data.check=false", "count=2")
    assert cflow("view", folder, *stored) == 0
    assert seen == pytest.approx(0.3 * np.arange(5))
