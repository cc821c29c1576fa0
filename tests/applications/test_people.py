"""People who walk together become tracks of their own; one person, and a low thing of two parts, stay one."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from staged_cars import INTERVAL_NS

from cflow_torch import FlowResult, Sweep, track
from cflow_torch.applications.people import people
from cflow_torch.applications.tracking import track_points
from cflow_torch.data.log import Log

COUNT = 16


def body(index: int, height: float = 1.7) -> np.ndarray:
    """Points of someone who walks along x, around the middle of the body: a trunk, and legs that swing."""
    z = np.linspace(0.0, height, 12)
    trunk = [
        np.column_stack([np.full(12, x), np.full(12, y), z])
        for x in (-0.1, 0.0, 0.1)
        for y in np.linspace(-0.2, 0.2, 5)
    ]
    swing = 0.2 * np.sin(index)
    legs = [np.column_stack([np.full(2, x), np.full(2, 0.1), z[:2]]) for x in (-swing, swing)]
    return np.concatenate(trunk + legs)


def group(*places: tuple[float, float], height: float = 1.7) -> tuple[torch.Tensor, torch.Tensor]:
    """Points of bodies at places in the axes of the group in all sweeps, and the sweep of each."""
    bodies = [[body(index + 2 * k, height) + [*place, 0] for k, place in enumerate(places)] for index in range(COUNT)]
    points = torch.from_numpy(np.concatenate([np.concatenate(each) for each in bodies]))
    return points, torch.arange(COUNT).repeat_interleave(len(points) // COUNT)


@pytest.mark.parametrize("places", [((0, -0.4), (0, 0.4)), ((-0.7, 0.1), (0.1, 0), (0.9, -0.1))])
def test_people_are_told_apart(places: tuple[tuple[float, float], ...]) -> None:
    points, sweep = group(*places)
    person = people(points, sweep)
    truth = torch.arange(len(places)).repeat_interleave(len(body(0))).repeat(COUNT)
    pairs = torch.unique(torch.stack([truth, person]), dim=1)
    assert pairs.shape[1] == len(places) and set(person.tolist()) == set(range(len(places)))


def test_one_person_and_two_low_things_are_not_divided() -> None:
    assert people(*group((0, 0))).unique().tolist() == [0]
    assert people(*group((0, -0.4), (0, 0.4), height=0.3)).unique().tolist() == [0]


def test_what_is_too_high_or_rarely_seen_is_nobody() -> None:
    points, sweep = group((0, -0.4), (0, 0.5))
    is_second = points[:, 1] > 0.1
    wall = points.clone()
    wall[is_second, 2] *= 2
    assert people(wall, sweep)[is_second].unique().tolist() == [-1]
    rare = ~is_second | (sweep < COUNT // 3)
    person = people(points[rare], sweep[rare])
    assert person[is_second[rare]].unique().tolist() == [-1] and person[~is_second[rare]].unique().tolist() == [0]


class Walkers(Log):
    """Two people side by side in one cluster; the second one is hidden in the last sweeps."""

    log_id = "walkers"
    timestamps = [INTERVAL_NS * (1 + index) for index in range(COUNT)]

    def points(self, index: int) -> np.ndarray:
        sides = (-0.4, 0.4) if index < COUNT - 4 else (-0.4,)
        return np.concatenate([body(index + 2 * k) + [8 + 0.14 * index, side, 0] for k, side in enumerate(sides)])

    def sweep(self, index: int) -> Sweep:
        return Sweep(self.points(index).astype(np.float32), None, np.eye(4), self.timestamps[index])

    def result(self, index: int) -> FlowResult:
        count = len(self.points(index))
        values = {"residual_flow": torch.tensor([0.14, 0, 0]).repeat(count, 1), "cluster_id": torch.ones(count).long()}
        return FlowResult.of({**values, "is_valid": torch.ones(count).bool(), "confidence": torch.full((count,), 0.9)})


def test_each_person_of_a_group_has_a_track() -> None:
    log = Walkers()
    results = [(index, log.result(index)) for index in range(COUNT - 1)]
    table, points = track_points(log, results)
    assert set(table["class"]) == {"pedestrian"} and len(set(table["id"])) == 2
    for number, side, count in ((0, -0.4, COUNT), (1, 0.4, COUNT - 4)):
        rows = np.flatnonzero(np.abs(table["y"] - side) < 0.15)
        assert len(set(table["id"][rows])) == 1 and table["sweep"][rows].tolist() == list(range(count)), number
        assert np.allclose(table["width"][rows], 0.4 + 0.16, atol=0.02)
        for row in rows:
            each = points[table["sweep"][row]]
            mine = each.track_id(table["id"]) == table["id"][row]
            assert np.array_equal(mine, np.sign(log.points(each.sweep)[:, 1]) == np.sign(side))
            assert table["num_points"][row] == mine.sum()
    again = track(log, results)
    assert all(np.array_equal(again[name], table[name]) for name in table)
