"""Tracks keep their ids through crossings, occlusions and stops; parts equal plain loops; tables of whole runs."""

from __future__ import annotations

import json
import shutil
import tracemalloc
from pathlib import Path
from typing import Any, Callable

import numpy as np
import pytest
import torch
from command_line import cflow
from oracle.static_places import CELL
from oracle.static_places import static_points as static_points_by_loops
from pyarrow import feather
from scenes import pose, rows_of
from small_logs import make_small_drive
from staged_cars import SIZE, Staged, straight
from torch.overrides import TorchFunctionMode

from cflow_torch import CFlowError, FlowResult, Sweep, Tracker, Window, make_config, make_model, track
from cflow_torch.applications import tracking
from cflow_torch.applications.association import VOXELS, box_of_point, enclosing_boxes, link
from cflow_torch.applications.instance_files import write_drivestudio
from cflow_torch.applications.kitti_tracks import write_kitti
from cflow_torch.applications.static_places import Sighting, cells_of, static_points
from cflow_torch.applications.track_table import join_tables, read_tracks, write_mot, write_tracks
from cflow_torch.applications.tracking import track_points
from cflow_torch.data.arrays import write_array_log
from cflow_torch.data.av2 import AV2Log
from cflow_torch.data.camera import Camera, intrinsic_matrix
from cflow_torch.data.catalog import find_sources, open_log
from cflow_torch.data.flow_file import read_flow
from cflow_torch.data.log import windows
from cflow_torch.simulator.writers.av2 import write_av2_log


def ids_of(log: Staged, table: dict[str, np.ndarray], car: int) -> list[int]:
    """Ids of the rows that lie on a car, in order."""
    ids = []
    for index in range(len(log)):
        centre = log.middle(car)[index]
        here = table["sweep"] == index
        near = np.hypot(table["x"] - centre[0], table["y"] - centre[1]) < 1.0
        ids += table["id"][here & near].tolist()
    return ids


def test_two_crossing_cars_keep_their_ids_and_velocities() -> None:
    log = Staged([straight((0, 0), (0.8, 0.8)), straight((-6, 9), (0.8, -0.8))])
    table = track(log, log.results())
    first, second = ids_of(log, table, 0), ids_of(log, table, 1)
    assert len(set(first)) == len(set(second)) == 1 and first[0] != second[0]
    assert len(first) == len(second) == 12 and len(table["id"]) == 24, "the last sweep has no flow"
    last = table["sweep"] == 11
    velocity = np.stack([table["vx"], table["vy"]], 1)[last & (table["id"] == second[0])][0]
    assert np.allclose(velocity, (8, -8), atol=0.01)
    assert np.allclose(table["age"][last], 1.1) and np.all(np.diff(table["sweep"]) >= 0)
    assert np.all(table["velocity_std"] < 0.5) and np.allclose(table["heading"][table["id"] == first[0]], np.pi / 4)


@pytest.mark.parametrize("gap, count", [(2, 1), (3, 1), (7, 2)])
def test_a_short_occlusion_is_bridged_and_a_long_one_starts_another_track(gap: int, count: int) -> None:
    path = straight((0, 0), (0.9, 0.0), 20)
    path[5 : 5 + gap] = np.nan
    log = Staged([path])
    table = track(log, log.results())
    assert len(set(table["id"])) == count and len(table["id"]) == 20 - gap
    assert not np.isin(table["sweep"], range(5, 5 + gap)).any()


def test_a_track_has_the_sweeps_before_its_flow_begins_and_those_where_it_is_missing() -> None:
    log = Staged([straight((0, 0), (0.8, 0.2)), straight((-8, 6), (0.0, 0.0))])
    results = log.results()
    for index in (0, 1, 2, 4):
        results[index][1].residual_flow[:] = 0
    table, points = track_points(log, results)
    assert table["sweep"].tolist() == list(range(12)) and len(set(table["id"])) == 1 and table["is_moving"].all()
    assert np.array_equal(table["cluster_id"] < 0, np.isin(table["sweep"], (0, 1, 2, 4, 11)))
    centre = log.middle(0)[:, :2]
    assert np.allclose(np.stack([table["x"], table["y"]], 1), centre, atol=0.05)
    assert np.allclose(table["vx"], 8, atol=0.2) and np.allclose(table["age"], np.arange(12) * 0.1)
    for index in (1, 4, 11):
        track_id = points[index].track_id(table["id"])
        assert np.array_equal(track_id == table["id"][0], log.world(index)[2] == 0)


def test_a_track_is_not_looked_for_where_it_is_hidden_or_before_it_starts_from_rest() -> None:
    steps = [0.0] * 5 + [0.9] * 7
    log = Staged([np.stack([np.cumsum(steps), np.zeros(12)], 1), straight((0, 9), (0.9, 0.0))])
    log.paths[1][:4] = np.nan
    table = track(log, log.results())
    assert not (table["sweep"][table["y"] > 5] < 4).any(), "there are no points"
    assert (table["sweep"][table["y"] < 5] >= 3).all(), "the car waits elsewhere"


def test_a_car_that_stops_keeps_its_id() -> None:
    steps = [1.0] * 6 + [0.7, 0.4, 0.2] + [0.0] * 8 + [0.2, 0.5, 0.8, 1.0]
    log = Staged([np.stack([np.cumsum([0.0, *steps]), np.zeros(len(steps) + 1)], 1)])
    table = track(log, log.results())
    assert set(table["id"]) == {table["id"][0]} and len(table["id"]) == len(log)
    is_static = np.isin(table["sweep"], range(9, 17))
    assert np.array_equal(~table["is_moving"], is_static) and np.all(table["cluster_id"][is_static] == -1)
    assert np.hypot(table["vx"], table["vy"])[table["sweep"] == 14] < 0.1
    assert np.allclose(table["heading"][is_static], 0, atol=0.01), "the heading it had before"


def test_tracks_do_not_depend_on_the_motion_of_the_vehicle() -> None:
    poses = np.stack([pose(100 + 0.7 * k, -50, 0.05 * k, 3) for k in range(12)])
    paths = [straight((105, -50), (0.8, 0.3))]
    driving, parked = Staged(paths, poses), Staged(paths)
    moved, static = track(driving, driving.results()), track(parked, parked.results())
    for name in ("x", "y", "z", "vx", "vy", "vz", "heading", "length"):
        assert np.allclose(moved[name], static[name], atol=1e-3), name
    assert np.array_equal(moved["id"], static["id"])


def test_returns_of_the_own_vehicle_are_not_a_track() -> None:
    """Its roof rides along with it, so it moves like another car. Points of a car beside it must stay."""
    roof = straight((-2.25, -0.95), (0.9, 0.0))
    beside = straight((-2.0, 1.6), (0.9, 0.0))
    log = Staged([roof, beside], np.stack([pose(0.9 * k, 0, 0.0) for k in range(12)]))
    table = track(log, log.results())
    assert len(set(table["id"])) == 1 and len(ids_of(log, table, 1)) == 12


@pytest.mark.parametrize("step", [0.0, 0.3])
def test_cars_below_a_sensor_are_tracks(step: float) -> None:
    """They drive below a sensor on a bridge, or on a vehicle that drives more slowly than they do."""
    log = Staged([straight((-6.0, -0.95), (1.4, 0.0))], np.stack([pose(step * k, 0, 0.0) for k in range(12)]))
    table = track(log, log.results())
    assert table["is_moving"].all() and len(table["id"]) == 12 and np.allclose(table["vx"], 14.0, atol=0.5)


@pytest.mark.parametrize(("step", "place", "is_own"), [(0.9, 1.3, True), (0.9, 3.0, False), (0.1, 1.3, False)])
def test_mirrors_that_ride_along_are_not_a_track(step: float, place: float, is_own: bool) -> None:
    """A small object beside the vehicle keeps its place: a mirror, one too far away, a person beside a slow robot."""

    class Small(Staged):
        def _body(self, car: int) -> np.ndarray:
            return 0.15 * super()._body(car)

    poses = np.stack([pose(step * k, 0, 0.0) for k in range(12)])
    log = Small([straight((-1.0, place), (step, 0.0))], poses)
    assert len(set(track(log, log.results())["id"])) == (not is_own)


def test_flicker_that_goes_nowhere_is_not_a_track() -> None:
    log = Staged([straight((0, 0), (0.0, 0.0)), straight((15, 0), (0.9, 0.0))])
    results = log.results()
    for index, result in results:
        flicker = result.cluster_id == 1
        result.residual_flow[flicker] = torch.tensor([0.15, 0.0, 0.0]) * (1.0 if index < 6 else 0.0)
    table = track(log, results)
    assert len(set(table["id"])) == 1 and np.all(table["x"] > 12)


def test_parts_of_a_wall_that_grow_or_jump_are_not_tracks() -> None:
    class Wall(Staged):
        """A part of the wall that grows at one end, and one that jumps; both have confident flow along the wall."""

        def world(self, index: int) -> Any:
            points, flow, car = super().world(index)
            points = points + (car < 0)[:, None] * np.where(np.arange(len(car)) % 2, 0.3, 0)[:, None] * [0, 1, 0]
            return points, flow, car

        def result(self, index: int, confidence: float = 0.9) -> FlowResult:
            result = super().result(index, confidence)
            x, on_wall = torch.from_numpy(self.world(index)[0][:, 0]), result.cluster_id == 0
            for number, start, end in ((8, -10, -7 + 0.8 * index), (9, 10 + 3 * index, 12 + 3 * index)):
                chosen = on_wall & (x >= start) & (x < end)
                result.cluster_id[chosen] = number
                result.residual_flow[chosen] = torch.tensor([0.4, 0.0, 0.0])
            return result

    log = Wall([straight((0, 0), (0.9, 0.0))])
    table = track(log, log.results())
    assert len(set(table["id"])) == 1 and np.all(table["y"] < 2)


def test_a_strip_that_one_beam_draws_is_not_a_track_unless_it_goes_far() -> None:
    class Strip(Staged):
        """One beam hits each car."""

        def world(self, index: int) -> Any:
            points, flow, car = super().world(index)
            kept = (car < 0) | (points[:, 2] < 0.1)
            return points[kept], flow[kept], car[kept]

    near, far = straight((0, 0), (0.17, 0.0)), straight((0, 5), (0.9, 0.0))
    assert len(set(track(Staged([near, far]), Staged([near, far]).results())["id"])) == 2
    log = Strip([near, far])
    table = track(log, log.results())
    assert len(set(table["id"])) == 1 and np.all(table["y"] > 4), "the one that moves by more than its length"


class Fence(Staged):
    """A piece of a fence seems to move along it, beside a car or alone: the fence is there again where the piece was.

    Args:
        path: of the corner of the car.
        has_car: False = the piece alone.
        has_fence: False = the fence is not there where the piece is not.
    """

    def __init__(self, path: np.ndarray, has_car: bool, has_fence: bool) -> None:
        super().__init__([path])
        self._has_car = has_car
        self._has_fence = has_fence

    def world(self, index: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        points, flow, car = super().world(index)
        x, y = self.paths[0, index]
        fence = np.stack(np.meshgrid(np.arange(-5, 25, 0.05), [y - 0.6], np.arange(0, 1.2, 0.2)), -1).reshape(-1, 3)
        is_piece = (fence[:, 0] >= x) & (fence[:, 0] <= x + SIZE[0])
        is_seen = is_piece | self._has_fence
        kept = (car < 0) | self._has_car
        flows = is_piece[:, None] * flow[car == 0][:1]
        return (
            np.concatenate([points[kept], fence[is_seen]]),
            np.concatenate([flow[kept], flows[is_seen]]),
            np.concatenate([car[kept], np.where(is_piece, 0, -1)[is_seen]]),
        )


@pytest.mark.parametrize("has_fence", [True, False])
def test_what_leaves_no_free_place_is_not_a_track(has_fence: bool) -> None:
    log = Fence(straight((0, 0), (0.9, 0.0), 16), has_car=False, has_fence=has_fence)
    assert len(set(track(log, log.results())["id"])) == (not has_fence)


@pytest.mark.parametrize("has_fence", [True, False])
def test_a_fence_beside_a_car_is_taken_out_of_its_track(has_fence: bool) -> None:
    log = Fence(straight((0, 0), (0.9, 0.0), 16), has_car=True, has_fence=has_fence)
    table, points = track_points(log, log.results())
    assert len(set(table["id"])) == 1
    track_id = points[8].track_id(table["id"])
    is_fence = log.world(8)[0][:, 1] == -0.6
    is_tracked = track_id >= 0
    assert is_tracked[~is_fence].sum() == (log.world(8)[2] == 0)[~is_fence].sum(), "the car keeps its points"
    assert is_tracked[is_fence].any() == (not has_fence)


class Hedge(Staged):
    """A hedge stands 5 cm beside the path of a car, and has more points than the car where the car passes."""

    def world(self, index: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        points, flow, car = super().world(index)
        hedge = np.stack(np.meshgrid(np.arange(-5, 25, 0.02), [-0.05], np.arange(0, 1.2, 0.1)), -1).reshape(-1, 3)
        return (
            np.concatenate([points, hedge]),
            np.concatenate([flow, np.zeros_like(hedge)]),
            np.concatenate([car, np.full(len(hedge), -1)]),
        )


def test_what_passes_close_to_static_points_has_not_stopped() -> None:
    log = Hedge([straight((0, 0), (0.9, 0.0))])
    table = track(log, log.results())
    assert table["is_moving"].all() and table["sweep"].tolist() == list(range(11))
    assert np.allclose(table["vx"], 9, atol=0.05)


def test_a_car_that_starts_and_one_that_stops_keep_their_points() -> None:
    """Cars that wait are static: another one left the place where one stops, and one starts where it has waited."""
    rest = straight((0, 0), (0.0, 0.0), 12)
    starts = np.concatenate([rest, straight((0.9, 0), (0.9, 0.0), 12)])
    comes = np.concatenate([straight((-18, 0), (0.9, 0.0), 20), straight((0, 0), (0.0, 0.0), 4)])
    log = Staged([starts, comes])
    table, points = track_points(log, log.results())
    assert len(set(table["id"])) == 2
    for sweep in range(12, 21):
        assert (points[sweep].track_id(table["id"]) >= 0).sum() == (log.world(sweep)[2] >= 0).sum()


@pytest.mark.parametrize("seed", range(3))
def test_static_points_of_a_track_equal_plain_loops(seed: int) -> None:
    """A box of points passes through random points without a track, which are new in every sweep or stay."""
    random = np.random.default_rng(seed)
    stays = random.uniform((-2, -1, 0), (14, 1, 1.5), (400, 3))
    positions, others = [], []
    for number in range(14):
        positions.append(random.uniform((0.8 * number, -0.7, 0), (0.8 * number + 1, 0.7, 1.5), (30, 3)))
        others.append(
            np.concatenate([stays[random.random(400) < 0.4], random.uniform((-2, -1, 0), (14, 1, 1.5))[None]])
        )
    found = static_points([Sighting(own, np.unique(cells_of(other))) for own, other in zip(positions, others)])
    names = [{tuple(np.floor(point / CELL).astype(int).tolist()) for point in other} for other in others]
    expected = static_points_by_loops(positions, names)
    assert [each.tolist() for each in found] == expected
    assert 0 < np.mean(expected) < 1


def test_the_memory_for_static_points_grows_with_the_length_of_a_track() -> None:
    """A table of all cells and sweeps of the longer track would have 33 times the memory of the shorter one."""
    peaks = []
    for count in (20, 200):
        body = np.random.default_rng(0).uniform(0, 2, (40, 3))
        seen = [Sighting(body + [1.5 * number, 0, 0], np.arange(5)) for number in range(count)]
        tracemalloc.start()
        static_points(seen)
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert peaks[1] < 15 * peaks[0]


def test_two_cars_in_one_cluster_keep_their_ids() -> None:
    log = Staged([straight((0, 0), (0.8, 0.0)), straight((0, 2.2), (0.8, 0.0))])
    results = log.results()
    for _, result in results[5:7]:
        result.cluster_id[result.cluster_id == 2] = 1
    table = track(log, results)
    assert len(table["id"]) == 24 and len(set(table["id"])) == 2
    for car in (0, 1):
        assert len(set(ids_of(log, table, car))) == 1
    assert np.allclose(table["vx"][table["sweep"] > 5], 8, atol=0.05) and np.allclose(
        table["width"], SIZE[1], atol=0.01
    )


def test_a_far_car_of_few_points_has_one_id() -> None:
    class Sparse(Staged):
        """Each sweep has some other points of the car."""

        def world(self, index: int) -> Any:
            kept = np.random.default_rng(index).random(len(super().world(index)[2])) < 0.02
            return tuple(values[kept] for values in super().world(index))

    log = Sparse([straight((0, 0), (0.9, 0.0), 16)])
    table = track(log, log.results())
    assert len(set(table["id"])) == 1 and len(table["id"]) >= 13


def test_low_confidence_confirms_only_long_motion_that_fits_and_missing_confidence_any() -> None:
    log = Staged([straight((0, 0), (0.95, 0.0))])
    unsure = [(index, log.result(index, 0.5)) for index in range(11)]
    table = track(log, unsure)
    assert np.flatnonzero(table["is_confirmed"])[0] == 5, "it has moved by its own length"
    for _, result in unsure:
        result.residual_flow.mul_(1.4)
    assert len(track(log, unsure)["id"]) == 0
    unsure = [(index, log.result(index)) for index in range(11)]
    for _, result in unsure:
        object.__setattr__(result, "confidence", None)
    table = track(log, unsure)
    assert len(table["id"]) == 12 and np.isnan(table["confidence"]).all() and table["is_confirmed"].sum() == 10


def test_a_car_that_comes_into_view_at_once_is_confirmed_by_its_motion_from_then_on() -> None:
    class Hidden(Staged):
        """Only the front of the car is visible in the first two sweeps, so its centre jumps back then."""

        def world(self, index: int) -> Any:
            points, flow, car = super().world(index)
            kept = (car < 0) | (index >= 2) | (points[:, 0] > self.paths[0, index, 0] + 3.7)
            return points[kept], flow[kept], car[kept]

    log = Hidden([straight((0, 0), (0.17, 0.0), 14)])
    table = track(log, log.results())
    assert len(table["id"]) == 14 and len(set(table["id"])) == 1
    assert np.array_equal(table["is_confirmed"], np.arange(14) >= 6)


@pytest.mark.parametrize("is_shown", [True, False])
def test_a_slow_car_of_which_ever_more_or_less_is_seen_is_confirmed_if_its_flow_is_confident(is_shown: bool) -> None:
    class Hidden(Staged):
        """The car drives out of, or behind, something that hides a part of it."""

        def world(self, index: int) -> Any:
            points, flow, car = super().world(index)
            is_seen = points[:, 0] > 3 if is_shown else points[:, 0] < 5
            kept = (car < 0) | is_seen
            return points[kept], flow[kept], car[kept]

    log = Hidden([straight((0, 0), (0.17, 0.0), 9)])
    assert len(set(track(log, log.results())["id"])) == 1
    assert not len(track(log, [(index, log.result(index, 0.6)) for index in range(8)])["id"])


def test_ids_survive_empty_sweeps_and_missing_frames() -> None:
    log = Staged([straight((0, 0), (0.9, 0.0))])
    empty, tracker, ids = rows_of(log.result(0), np.zeros(0, int)), Tracker(), []
    for index in range(11):
        no_points = Sweep(np.zeros((0, 3), np.float32), None, None, log.timestamps[index])
        is_empty = index in (0, 6)
        sweeps = Window(no_points if is_empty else log.sweep(index), log.sweep(index + 1))
        table, track_id = tracker.push(sweeps, empty if is_empty else log.result(index))
        assert len(track_id) == len(sweeps.pc0.points) and len(table["id"]) == (not is_empty)
        ids += table["id"].tolist()
        assert set(track_id) <= {-1, *ids}
    assert len(set(ids)) == 1
    assert len(set(track(log, [pair for pair in log.results() if pair[0] not in (4, 5)])["id"])) == 1
    assert all(len(values) == 0 for values in track(log, []).values())


def test_tracking_uses_one_thread(monkeypatch: pytest.MonkeyPatch) -> None:
    """With two threads next to other work, it took two to three times as long."""
    seen: list[int] = []

    def spied(function: Callable[..., Any]) -> Callable[..., Any]:
        return lambda *given: (seen.append(torch.get_num_threads()), function(*given))[1]

    monkeypatch.setattr(tracking, "match", spied(tracking.match))
    monkeypatch.setattr(tracking, "complete", spied(tracking.complete))
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    try:
        log = Staged([straight((0, 0), (0.9, 0.0), 4)])
        track(log, log.results())
        assert torch.get_num_threads() == 2
    finally:
        torch.set_num_threads(before)
    assert seen == [1, 1, 1, 1], "three sweeps, then the boxes"


def test_wrong_inputs_are_one_clear_error() -> None:
    log = Staged([straight((0, 0), (0.9, 0.0))])
    with pytest.raises(CFlowError, match=r"such as enumerate\(results\)"):
        track(log, [log.result(0)])  # type: ignore[list-item]
    tracker = Tracker()
    tracker.push((log.sweep(3), log.sweep(4)), log.result(3))
    with pytest.raises(CFlowError, match="order of time"):
        tracker.push(Window(log.sweep(2), log.sweep(3)), log.result(2))
    with pytest.raises(CFlowError, match="rows"):
        tracker.push(
            Window(Sweep(np.zeros((5, 3), np.float32), timestamp_ns=log.timestamps[4]), log.sweep(5)), log.result(4)
        )
    tracker.push((log.sweep(4), log.sweep(5)), log.result(4))
    with pytest.raises(CFlowError, match="cluster_id"):
        Tracker().push(Window(log.sweep(2), log.sweep(3)), FlowResult.of({"residual_flow": torch.zeros(5, 3)}))


def test_matches_equal_those_of_plain_loops() -> None:
    generator = np.random.default_rng(0)
    for _ in range(20):
        clouds = [generator.uniform(0, 3, (60, 3)) for _ in range(2)]
        groups = [generator.integers(0, 6, 60) for _ in range(2)]
        expected: dict[int, int] = {}
        for side in VOXELS:
            rest = [n for n in range(6) if n not in expected], [n for n in range(6) if n not in expected.values()]
            voxels = [
                {n: {tuple(v) for v in np.floor(c[g == n] / (side, side, 3 * side)).astype(int)} for n in numbers}
                for c, g, numbers in zip(clouds, groups, rest)
            ]
            shares = [
                (-len(a & b) / len(a | b), i, j)
                for i, a in voxels[0].items()
                for j, b in voxels[1].items()
                if a & b and len(a & b) / len(a | b) >= 0.1
            ]
            for _, i, j in sorted(shares):
                if i not in expected and j not in expected.values():
                    expected[i] = j
        given = [torch.from_numpy(value) for value in (clouds[0], groups[0], clouds[1], groups[1])]
        earlier, later = link(*given)
        assert dict(zip(earlier.tolist(), later.tolist())) == expected


def test_boxes_are_tight_around_their_points() -> None:
    generator = np.random.default_rng(1)
    points, group = torch.from_numpy(generator.normal(size=(80, 3))), torch.arange(80) % 4
    heading = torch.tensor([0.0, 0.5, 2.0, -3.0], dtype=torch.float64)
    centre, size = enclosing_boxes(points, group, heading)
    for number in range(4):
        own = slice(number, number + 1)
        inside = box_of_point(points, centre[own], size[own] + 1e-9, heading[own])
        assert (inside[group == number] == 0).all()
        inside = box_of_point(points, centre[own], size[own] * 0.99, heading[own])
        assert (inside[group == number] == -1).sum() >= 4, "points on the faces"


class LargestTensor(TorchFunctionMode):
    """Note the largest number of values in a result of an operation. A dispatch mode would import torch._dynamo."""

    num_values = 0

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        result = func(*args, **(kwargs or {}))
        if isinstance(result, torch.Tensor):
            self.num_values = max(self.num_values, result.numel())
        return result


def test_the_first_box_that_holds_a_point_is_found_with_memory_for_the_points_only() -> None:
    random = np.random.default_rng(2)
    points = random.uniform(-5, 5, (400, 3))
    centre = random.uniform(-5, 5, (60, 3))
    size = random.uniform(0.5, 4, (60, 3))
    heading = random.uniform(-4, 4, 60)
    with LargestTensor() as largest:
        found = box_of_point(*map(torch.from_numpy, (points, centre, size, heading))).tolist()
    assert largest.num_values <= 3 * len(points)
    for point, box in zip(points, found):
        offset = point - centre
        along = np.cos(heading) * offset[:, 0] + np.sin(heading) * offset[:, 1]
        across = np.cos(heading) * offset[:, 1] - np.sin(heading) * offset[:, 0]
        is_inside = (np.abs(np.stack([along, across, offset[:, 2]], 1)) <= size / 2).all(1)
        assert box == (is_inside.argmax() if is_inside.any() else -1)
    assert len(set(found)) > 20
    none = box_of_point(torch.from_numpy(points), *(torch.zeros(0, *shape).double() for shape in ((3,), (3,), ())))
    assert (none == -1).all()


def test_an_empty_table_comes_back_from_disk_and_a_broken_one_is_refused(tmp_path: Path) -> None:
    write_tracks(tmp_path / "none.parquet", join_tables([]))
    assert len(read_tracks(tmp_path / "none.parquet")["id"]) == 0
    (tmp_path / "broken.parquet").write_bytes(b"PAR1")
    for name in ("broken.parquet", "missing.parquet"):
        with pytest.raises(CFlowError, match="tracks=true"):
            read_tracks(tmp_path / name)


def test_a_table_that_lacks_a_column_is_refused(tmp_path: Path) -> None:
    log = Staged([straight((0, 0), (0.9, 0.0))])
    table = track(log, log.results())
    write_tracks(tmp_path / "tracks.parquet", {name: values for name, values in table.items() if name != "class"})
    with pytest.raises(CFlowError, match="class.*tracks=true"):
        read_tracks(tmp_path / "tracks.parquet")


def test_tracks_are_written_as_text(tmp_path: Path) -> None:
    """A car that drives to the left of a vehicle that has turned by 90 degrees to the left: ahead of the vehicle."""
    log = Staged([straight((-12, 0), (0.0, 0.9))], np.tile(pose(-20, -5, np.pi / 2, 1), (12, 1, 1)))
    table = track(log, log.results())
    write_mot(tmp_path, table, log)
    mot = np.loadtxt(tmp_path / "mot.txt", delimiter=",", ndmin=2)
    assert np.array_equal(mot[:, :6], [[frame, 1, -1, -1, -1, -1] for frame in range(1, 13)])
    assert np.allclose(mot[:, 6], 0.9)
    assert np.allclose(mot[:, 7:], np.stack([table[axis] for axis in "xyz"], 1), atol=1e-3)

    write_kitti(tmp_path, table, log)
    lines = [line.split() for line in (tmp_path / "kitti.txt").read_text().splitlines()]
    assert [line[:5] for line in lines] == [[str(index), "0", "Car", "-1", "-1"] for index in range(12)]
    height, width, length, x, y, z, rotation, score = np.array([line[10:] for line in lines], float).T
    assert np.allclose(height, 1.2) and np.allclose(score, 0.9, atol=1e-6)
    assert np.allclose(width, 1.9, atol=1e-5) and np.allclose(length, 4.5, atol=1e-5), "a whole car"
    # Its middle is 8 - .95 m to the right, first 5 + 2.25 m ahead, and its lower face is 1 m below the origin.
    assert np.allclose(x, 7.05, atol=0.01) and np.allclose(y, 1, atol=1e-5)
    assert np.allclose(z, 7.25 + 0.9 * np.arange(12), atol=0.05)
    assert np.allclose(rotation, -np.pi / 2, atol=1e-5), "KITTI: 0 = along x of the camera, negative to the left"
    alpha = np.array([line[5] for line in lines], float)
    assert np.allclose(alpha, rotation - np.arctan2(x, z), atol=1e-4)


class Calibrated(Staged):
    """A vehicle at rest that has turned by 90 degrees to the left, with the cameras of KITTI."""

    T_camera0_lidar = np.array([[0.0, -1, 0, 0.01], [0, 0, -1, -0.07], [1, 0, 0, -0.27], [0, 0, 0, 1]])

    def cameras(self, index: int) -> list[Camera]:
        beside = np.eye(4)
        beside[0, 3] = 0.06  # camera 2 is to the left of camera 0
        matrix = intrinsic_matrix(720, 720, 620, 187)
        return [Camera("image_02", f"{index:06d}", (1242, 375), matrix, beside @ self.T_camera0_lidar)]


def test_tracks_of_a_calibrated_drive_are_in_the_frame_of_kittis_labels(tmp_path: Path) -> None:
    """A car 20 m ahead crosses the image from the left, drives out of it, and another one is behind."""
    vehicle = np.tile(pose(0, -20, np.pi / 2, 1), (12, 1, 1))
    log = Calibrated([straight((-8, 0), (1.6, 0.0)), straight((-8, -50), (0.9, 0.0))], vehicle)
    table = track(log, log.results())
    write_kitti(tmp_path, table, log)
    numbers = np.array([line.split()[5:] for line in (tmp_path / "kitti.txt").read_text().splitlines()], float)
    middle = log.middle(0)
    u = 620 + 720 * (middle[:, 0] + 0.07) / (middle[:, 1] + 20 - 0.27)
    assert len(numbers) == ((u > -100) & (u < 1342)).sum() == 12
    x, y, z, rotation = numbers[:, 8:12].T
    np.testing.assert_allclose(x, middle[:, 0] + 0.01, atol=0.05)
    np.testing.assert_allclose(y, 1 - 0.07, atol=1e-5)
    np.testing.assert_allclose(z, middle[:, 1] + 20 - 0.27, atol=0.05)
    np.testing.assert_allclose(rotation, 0, atol=1e-5)
    rectangle = numbers[:, 1:5]
    for index in range(12):
        points = log.cameras(0)[0].see(log.sweep(index).points[log.world(index)[2] == 0])
        pixels = log.cameras(0)[0].project(points).clip(0, (1241, 374))
        np.testing.assert_allclose(rectangle[index], [*pixels.min(0), *pixels.max(0)], atol=3)


def test_the_rectangle_of_a_car_that_reaches_behind_the_camera_is_cut_off_by_the_image(tmp_path: Path) -> None:
    """A car overtakes on the left: its front is ahead of the camera while its rear is behind."""
    log = Calibrated([straight((-1.5, -30), (0.0, 0.9), 14)], np.tile(pose(0, -20, np.pi / 2, 1), (14, 1, 1)))
    write_kitti(tmp_path, track(log, log.results()), log)
    lines = [line.split() for line in (tmp_path / "kitti.txt").read_text().splitlines()]
    rectangles = {int(line[0]): np.array(line[6:10], float) for line in lines}
    for sweep in (9, 10, 11):
        front = -30 + 0.9 * sweep + SIZE[0]
        right = 620 + 720 * (-1.5 + 0.07) / (front + 20 - 0.27)
        np.testing.assert_allclose(rectangles[sweep], [0, 0, right, 374], atol=3)


def read_instances(folder: Path) -> tuple[np.ndarray, np.ndarray, list[str]]:
    """Read the files by the steps of DriveStudio's loaders.

    Returns poses (frames, instances, 4, 4), NaN where an instance is not in the list of a frame, the mean size
    (instances, 3) and the classes.
    """
    infos = json.loads((folder / "instances_info.json").read_text())
    frames = json.loads((folder / "frame_instances.json").read_text())
    poses = np.full((len(frames), len(infos), 4, 4), np.nan)
    sizes = np.zeros((len(frames), len(infos), 3))
    classes = [""] * len(infos)
    for number, info in infos.items():
        classes[int(number)] = info["class_name"]
        notes = info["frame_annotations"]
        for frame, box, size in zip(notes["frame_idx"], notes["obj_to_world"], notes["box_size"]):
            poses[frame, int(number)] = np.array(box).reshape(4, 4)
            sizes[frame, int(number)] = size
    is_listed = np.zeros(poses.shape[:2], bool)
    for frame, numbers in frames.items():
        is_listed[int(frame), numbers] = True
    assert np.array_equal(is_listed, np.isfinite(poses).all((2, 3))), "both files name the same boxes"
    return poses, sizes.sum(0) / is_listed.sum(0)[:, None], classes


def test_tracks_are_written_for_the_loaders_of_drivestudio(tmp_path: Path) -> None:
    """Two cars, one hidden at first, seen from a vehicle that has turned. The world is that of the poses."""
    hidden = straight((-12, 0), (0.0, 0.9))
    hidden[:4] = np.nan
    log = Staged([straight((0, -6), (0.8, 0.0)), hidden], np.tile(pose(-20, -5, np.pi / 2, 1), (12, 1, 1)))
    table = track(log, log.results())
    table["id"] = table["id"] * 3 + 5  # ids have gaps, because most tracks are not confirmed
    write_drivestudio(tmp_path / "instances", table, log, "nuscenes")
    poses, sizes, classes = read_instances(tmp_path / "instances")
    assert poses.shape[:2] == (12, 2) and classes == ["vehicle.car"] * 2
    person = {**table, "class": np.where(table["id"] == table["id"].max(), "pedestrian", "truck")}
    write_drivestudio(tmp_path / "people", person, log, "nuscenes")
    assert read_instances(tmp_path / "people")[2] == ["vehicle.car", "vehicle.bicycle"]
    assert np.isfinite(poses[:, :, 0, 0]).sum(0).tolist() == [12, 8]
    middle = np.stack([log.middle(car) for car in range(2)], 1)
    assert np.allclose(poses[4:, :, :2, 3], middle[4:], atol=0.1), "the middle of the box"
    assert np.allclose(poses[10, 0, :3, 0], (1, 0, 0), atol=0.01), "x along its length"
    assert np.allclose(poses[10, 1, :3, 0], (0, 1, 0), atol=0.01)
    assert np.allclose(sizes, SIZE, atol=1e-4)


def test_frames_of_nuscenes_are_those_of_drivestudio_at_10_hz(tmp_path: Path) -> None:
    """Sweep 11 begins the second key frame, so four frames between are at sweeps 2.2, 4.4, 6.6 and 8.8."""
    log = Staged([straight((0, -6), (0.8, 0.0), 13)])
    table = track(log, log.results())
    log.sample_tokens = ["first", *[None] * 10, "second", None]
    write_drivestudio(tmp_path, table, log)
    poses, _, _ = read_instances(tmp_path)
    assert len(poses) == 6
    for frame, sweep in enumerate((0, 2, 4, 7, 9, 11)):
        assert np.allclose(poses[frame, 0, :2, 3], log.middle(0)[sweep], atol=0.1), frame


SMALL = "model.point_cloud_range=[-20,-20,-inf,20,20,inf]"
FAST = (SMALL, "model.num_history=0", "model.pixel_sizes=[0.4,0.2]")
RANGE = (-20, -20, -float("inf"), 20, 20, float("inf"))


def calls_on_a_drive(folder: Path, num_sweeps: int = 4) -> Callable[..., int]:
    """Write a small simulated drive; returns (command, folder of its output, settings) -> exit status."""
    write_av2_log(make_small_drive(num_sweeps=num_sweeps), folder / "data")
    data = ("data=av2", f"data.root={folder / 'data'}", "data.check=false", *FAST)
    return lambda command, output, *settings: cflow(command, *data, f"output={folder / output}", *settings)


def test_resumed_and_sharded_runs_write_the_same_table(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    call = calls_on_a_drive(tmp_path, num_sweeps=5)
    run = ("engine.workers=1", "tracks=true")
    assert call("flow", "whole", *run) == 0
    (file,) = (tmp_path / "whole").glob("*/tracks.parquet")
    whole = read_tracks(file)
    assert len(whole["id"]) > 4 and set(whole["sweep"]) <= set(range(5)) and not np.isnan(whole["confidence"]).any()
    model = make_model(make_config(num_history=0, pixel_sizes=(0.4, 0.2), point_cloud_range=RANGE))
    (source,) = find_sources("av2", tmp_path / "data")
    log = open_log("av2", source)
    flow = [model([sweeps])[0] for sweeps in windows(log, model.config.num_history)]
    expected = track(log, enumerate(flow))
    assert all(np.array_equal(whole[name], expected[name]) for name in expected)
    for row, stamp in enumerate(log.timestamps[:4]):
        ids = read_flow(file.parent / f"{stamp}.feather").track_id.numpy()
        now = {name: values[whole["sweep"] == row] for name, values in whole.items()}
        number, count = np.unique(ids[ids >= 0], return_counts=True)
        assert np.array_equal(number, now["id"]), "only confirmed tracks"
        is_seen = now["is_moving"]
        assert np.array_equal(count[is_seen], now["num_points"][is_seen])
        cluster = flow[row].cluster_id.numpy()
        has_flow = now["cluster_id"] >= 0
        for track_id, of_flow in zip(now["id"][has_flow], now["cluster_id"][has_flow]):
            assert (cluster[ids == track_id] == of_flow).all()
    for index in (0, 1):
        assert not list((tmp_path / "shards").glob("*/tracks.parquet")), "half of the frames are not a whole log"
        capsys.readouterr()
        assert call("flow", "shards", *run, f"shard.index={index}", "shard.count=2") == 0
        assert (": no tracks, because frames are missing" in capsys.readouterr().out) == (index == 0)
    (other,) = (tmp_path / "shards").glob("*/tracks.parquet")
    assert other.read_bytes() == file.read_bytes()

    before = file.read_bytes()
    assert call("flow", "whole", *run[:-1], "tracks=mot") == 0 and call("flow", "whole", *run[:-1], "tracks=csv") == 2
    assert (file.parent / "mot.txt").read_text().count("\n") == len(whole["id"])
    assert call("flow", "whole", *run[:-1], "tracks=drivestudio") == 0
    poses, _, classes = read_instances(file.parent)
    assert np.isfinite(poses[:, :, 0, 0]).sum() == len(whole["id"]) and set(classes) <= {"REGULAR_VEHICLE", "BICYCLIST"}
    assert call("flow", "whole", *run[:-1], "tracks=nuscenes") == 0
    detections = json.loads((file.parent / "nuscenes_detection.json").read_text())["results"]
    assert sum(map(len, detections.values())) == len(whole["id"]) and len(detections) == 5
    assert call("flow", "whole", *run[:-1], "tracks=openpcdet") == 0 and (file.parent / "result.pkl").exists()
    for lost in (file, sorted(file.parent.glob("*.feather"))[2]):
        lost.unlink()
        assert call("flow", "whole", *run) == 0 and file.read_bytes() == before
        tables = [feather.read_table(each) for each in file.parent.glob("*.feather")]
        assert [table.column_names.count("track_id") for table in tables] == [1] * 4, "also in a frame that was missing"
    assert call("flow", "whole", *run[:-1], "overwrite=true") == 0 and not file.exists(), "tracks of another run"
    others = [other.name for other in file.parent.iterdir() if other.suffix != ".feather"]
    assert others == ["manifest.json"], "nor their other forms"
    capsys.readouterr()
    assert call("flow", "small", *run, "contents=[residual,cluster_id,is_valid]") == 2
    assert "add confidence" in capsys.readouterr().err


def test_boxes_stand_on_the_ground_that_we_find(tmp_path: Path) -> None:
    """The log has no ground masks. The command and Python give the same boxes."""
    drive = make_small_drive(5)
    write_array_log(drive, tmp_path / "data", ".npy")
    (folder,) = (tmp_path / "data").iterdir()
    shutil.rmtree(folder / "ground")
    call = (folder, f"output={tmp_path / 'out'}", "data.check=false", *FAST, "engine.workers=1", "tracks=true")
    assert cflow("flow", *call) == 0
    written = read_tracks(tmp_path / "out" / folder.name / "tracks.parquet")
    log = open_log("arrays", folder, check=False)
    results = [(k, read_flow(tmp_path / "out" / folder.name / f"{log.timestamps[k]}.feather")) for k in range(4)]
    expected = track(log, results)
    assert len(expected["id"]) and all(np.array_equal(written[name], expected[name]) for name in expected)


def test_a_log_with_a_gap_has_tracks_before_and_behind_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(AV2Log, "gaps", frozenset([2]))
    call = calls_on_a_drive(tmp_path, num_sweeps=6)
    assert call("flow", "flow", "tracks=true", "engine.workers=1") == 0
    (file,) = (tmp_path / "flow").glob("*/tracks.parquet")
    assert len(list(file.parent.glob("*.feather"))) == 4, "the pair over the gap has no flow"
    assert set(read_tracks(file)["sweep"]) == set(range(6))


def test_the_viewer_shows_all_tracks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("rerun")
    from cflow_torch.viz import recording

    call, shown = calls_on_a_drive(tmp_path, 5), []
    assert call("flow", "flow", "tracks=true", "engine.workers=1") == 0
    add = recording._Drive.add_tracks
    monkeypatch.setattr(recording._Drive, "add_tracks", lambda self, rows: (shown.append(rows), add(self, rows)))
    assert call("view", "view", "format=rerun", f"flow={tmp_path / 'flow'}") == 0
    (file,) = (tmp_path / "flow").glob("*/tracks.parquet")
    ids = np.concatenate([rows["id"] for rows in shown])
    table = read_tracks(file)
    assert len(shown) == 4 and np.array_equal(ids, table["id"][table["sweep"] < 4]) and len(ids) > 3
    assert len(list((tmp_path / "view").glob("*.rrd"))) == 1
