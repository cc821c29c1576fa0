"""Whole boxes of objects that are seen from all sides, from one side, with strays; smoothing equals plain equations."""

from __future__ import annotations

from dataclasses import replace
from typing import Callable

import numpy as np
import pytest
import torch
from scenes import pose

from cflow_torch.applications.floor import Floor
from cflow_torch.applications.smoothing import ACCELERATION, MotionState, smooth
from cflow_torch.applications.whole_boxes import (
    CAR,
    CYCLIST,
    KINDS,
    PEDESTRIAN,
    TRUCK,
    Sightings,
    headings,
    quantiles,
    whole_boxes,
)
from cflow_torch.transforms import transform_points
from cflow_torch.types import Sweep

INTERVAL = 0.1
SIZE = (4.2, 1.8, 1.4)


def shell(size: tuple[float, float, float] = SIZE) -> np.ndarray:
    """Points on the four sides of a box around the origin."""
    length, width, height = size
    along = np.linspace(-length / 2, length / 2, 60)
    across = np.linspace(-width / 2, width / 2, 30)
    sides = [np.stack([along, np.full(60, side * width / 2)], 1) for side in (-1, 1)]
    ends = [np.stack([np.full(30, end * length / 2), across], 1) for end in (-1, 1)]
    outline = np.concatenate([*sides, *ends])
    return np.concatenate([np.column_stack([outline, np.full(len(outline), z)]) for z in np.linspace(0, height, 5)])


def seen(
    paths: list[np.ndarray],
    sensor: tuple[float, float],
    visible: Callable[[int, np.ndarray], np.ndarray] = lambda index, points: points,
    size: tuple[float, float, float] = SIZE,
    floor: float = np.nan,
) -> Sightings:
    """Sightings of objects on paths, (T, 3) x, y, heading; `visible` chooses their points in each sweep."""
    parts = []
    for number, path in enumerate(paths):
        speed = np.linalg.norm(np.gradient(path[:, :2], INTERVAL, axis=0), axis=1)
        velocity = speed[:, None] * np.stack([np.cos(path[:, 2]), np.sin(path[:, 2])], 1)
        rate = np.gradient(path[:, 2], INTERVAL)
        for index, (x, y, heading) in enumerate(path):
            local = visible(index, shell(size))
            turn = np.array([[np.cos(heading), -np.sin(heading)], [np.sin(heading), np.cos(heading)]])
            points = np.column_stack([local[:, :2] @ turn.T + (x, y), local[:, 2]])
            flow = velocity[index] + rate[index] * np.column_stack([y - points[:, 1], points[:, 0] - x])
            flows = np.column_stack([flow, np.zeros(len(flow))])
            parts.append((number, index * INTERVAL, (*sensor, 1.5), heading, floor, points, flows))
    columns = [torch.tensor(np.array([part[k] for part in parts])) for k in range(5)]
    row = torch.arange(len(parts)).repeat_interleave(torch.tensor([len(part[5]) for part in parts]))
    return Sightings(*columns, *(torch.from_numpy(np.concatenate([part[k] for part in parts])) for k in (5, 6)), row)


def straight(start: tuple[float, float], speed: float, heading: float, count: int = 20) -> np.ndarray:
    distance = speed * INTERVAL * np.arange(count)[:, None]
    place = np.array(start) + distance * [np.cos(heading), np.sin(heading)]
    return np.column_stack([place, np.full(count, heading)])


def test_a_box_stands_on_the_ground_also_where_its_lower_part_is_hidden() -> None:
    """The ground is 0.3 m below the lowest points; in every third sweep, a wall hides half of the car."""

    def behind_a_wall(index: int, points: np.ndarray) -> np.ndarray:
        return points[points[:, 2] > 0.5] if index % 3 == 0 else points

    path = straight((-6, 7), 9.0, 0.1)
    boxes = whole_boxes(seen([path], (0.0, 0.0), behind_a_wall, floor=-0.3))
    assert np.allclose(boxes.size[:, 2], SIZE[2] + 0.3, atol=1e-6)
    assert np.allclose(boxes.motion.position[:, 2], (SIZE[2] - 0.3) / 2, atol=1e-6)
    bridge = whole_boxes(seen([path], (0.0, 0.0), floor=-5.0))
    assert np.allclose(bridge.size[:, 2], SIZE[2], atol=1e-6), "this ground is that of a road below"


def test_the_floor_is_the_ground_around_and_unknown_elsewhere() -> None:
    x, y = np.meshgrid(np.arange(0, 40, 0.5), np.arange(-5, 5, 0.5), indexing="ij")
    ground = np.stack([x, y, 0.02 * x], -1).reshape(-1, 3)
    ground = np.concatenate([ground, [[1e6, 1e6, 5.0]]])  # a stray return, for which the map has no room
    points = np.concatenate([ground, ground + (0, 0, 9), [[np.nan, 0, 0]]]).astype(np.float32)
    sweep = Sweep(points, np.arange(len(points)) < len(ground), pose(10, 0, np.pi / 2, 1))
    floor = Floor.of(sweep)
    place = transform_points(np.array([[20.0, 0, 1], [60, 0, 0], [30, 1, 0]]), sweep.pose)
    np.testing.assert_allclose(floor.below(place), np.array([0.4, np.nan, 0.6]) + sweep.pose[2, 3], atol=0.05)
    assert np.isnan(Floor.of(replace(sweep, is_ground=None)).below(place)).all()


def test_a_box_seen_from_all_sides_is_recovered() -> None:
    angle = np.linspace(0, np.pi / 2, 30)
    bend = np.column_stack([20 + 15 * np.sin(angle), -15 * np.cos(angle), angle])
    paths = [straight((-6, 7), 9.0, 0.1), bend]
    boxes = whole_boxes(seen(paths, (0.0, 0.0)))
    truth = np.concatenate(paths)
    assert np.allclose(boxes.size, SIZE, atol=0.02) and set(boxes.kind.tolist()) == {CAR}
    assert np.allclose(boxes.motion.position[:, :2], truth[:, :2], atol=0.03)
    assert np.allclose(boxes.motion.position[:, 2], SIZE[2] / 2, atol=1e-6)
    assert np.allclose(np.sin(boxes.heading - truth[:, 2]), 0, atol=0.03)


def test_the_heading_of_a_turning_car_is_that_of_its_middle_though_only_its_front_is_seen() -> None:
    """The visible front moves 12 degrees to the side, because the car turns."""
    angle = np.linspace(0, np.pi / 4, 20)
    bend = np.column_stack([8 * np.sin(angle), 8 - 8 * np.cos(angle), angle])
    boxes = whole_boxes(seen([bend], (20.0, 12.0), lambda index, points: points[points[:, 0] > 1.2]))
    assert np.abs(np.degrees(boxes.heading.numpy() - bend[:, 2])).max() < 3
    assert np.allclose(boxes.size[:, 1], SIZE[1], atol=0.1)


@pytest.mark.parametrize("speed", [8.0, -8.0])
def test_a_partly_seen_car_keeps_its_far_end(speed: float) -> None:
    """The car drives by. First the sensor sees all of it, then only the third of it that is nearest."""
    heading = 0.0 if speed > 0 else np.pi
    path = straight((-np.sign(speed) * 14, 7), abs(speed), heading, 36)

    def nearest_third(index: int, points: np.ndarray) -> np.ndarray:
        if 12 <= index <= 24:
            return points
        x = points[:, 0] if index < 12 else -points[:, 0]  # it comes towards the sensor until it is beside it
        return points[x >= SIZE[0] / 6]

    boxes = whole_boxes(seen([path], (0.0, 0.0), nearest_third))
    assert np.allclose(boxes.size, boxes.size[0]), "the same in every sweep"
    assert np.allclose(boxes.size[0], SIZE, atol=0.05)
    assert np.abs(boxes.motion.position[:, :2].numpy() - path[:, :2]).max() < 0.15


def test_where_the_length_is_never_seen_the_box_reaches_away_from_the_sensor() -> None:
    path = straight((10, 0.0), 7.0, 0.0)
    boxes = whole_boxes(seen([path], (0.0, 0.0), lambda index, points: points[points[:, 0] < -1.5]))
    assert np.allclose(boxes.size[:, 0], 4.5) and np.allclose(boxes.size[:, 1], SIZE[1], atol=0.02)
    rear = boxes.motion.position[:, 0] - boxes.size[:, 0] / 2
    assert np.allclose(rear, path[:, 0] - SIZE[0] / 2, atol=0.02), "the end that is seen"


def test_points_of_another_car_in_few_sweeps_do_not_make_the_length_seen() -> None:
    """The sensor is behind the car. Points far beside it would have their middle at the side of the sensor."""
    path = straight((6, 0.0), 7.0, 0.0)

    def rear(index: int, points: np.ndarray) -> np.ndarray:
        other = np.array([[7.0, 7.0, 0.5]]) + np.linspace(0, 1, 9)[:, None]
        of_car = points[points[:, 0] < -1.5]
        return np.concatenate([of_car, other]) if index in (3, 4) else of_car

    boxes = whole_boxes(seen([path], (0.0, 0.0), rear))
    assert np.allclose(boxes.size[:, 0], 4.5) and np.allclose(boxes.size[:, 1], SIZE[1], atol=0.02)


def test_points_of_other_objects_in_some_sweeps_change_nothing() -> None:
    path = straight((8, 6), 9.0, 0.0)
    clean = whole_boxes(seen([path], (0.0, 0.0)))

    def with_strays(index: int, points: np.ndarray) -> np.ndarray:
        other = np.array([[4.5, -2.0, 0.5]]) + np.linspace(0, 1, 9)[:, None]
        return np.concatenate([points, other]) if index % 5 == 2 else points

    boxes = whole_boxes(seen([path], (0.0, 0.0), with_strays))
    assert np.allclose(boxes.size[:, :2], clean.size[:, :2], atol=0.02)
    assert np.abs(boxes.motion.position - clean.motion.position)[:, :2].max() < 0.12


def test_a_person_stands_behind_the_points_that_are_seen_and_a_wall_beside_changes_little() -> None:
    path = straight((-3, 6), 1.4, 0.0, 30)
    angle = np.linspace(-np.pi / 2, np.pi / 2, 40)
    wall = np.column_stack([np.linspace(-0.2, 0.2, 12), np.full(12, 0.7), np.linspace(0, 2, 12)])

    def half(index: int, _: np.ndarray) -> np.ndarray:
        """The half of a body, 0.34 m wide, that faces the sensor at the origin."""
        facing = angle + np.arctan2(-path[index, 1], -path[index, 0])
        outline = 0.17 * np.stack([np.cos(facing), np.sin(facing)], 1)
        return np.concatenate([np.column_stack([outline, np.full(40, z)]) for z in np.linspace(0, 1.7, 6)])

    alone = whole_boxes(seen([path], (0.0, 0.0), half))
    assert set(alone.kind.tolist()) == {PEDESTRIAN}
    assert np.abs(alone.motion.position[:, :2].numpy() - path[:, :2]).max() < 0.03
    beside = whole_boxes(seen([path], (0.0, 0.0), lambda index, points: np.concatenate([half(index, points), wall])))
    assert np.abs(beside.motion.position[:, :2].numpy() - path[:, :2]).max() < 0.06


def test_a_cyclist_is_placed_behind_the_middle_of_what_is_seen() -> None:
    path = straight((-5, 5), 5.0, 0.0)
    boxes = whole_boxes(seen([path], (0.0, 0.0), lambda index, points: points[points[:, 1] < -0.27], (1.8, 0.56, 1.7)))
    assert set(boxes.kind.tolist()) == {CYCLIST}
    offset = boxes.motion.position[:, :2].numpy() - path[:, :2]
    assert np.allclose(offset[8:12, 1], -0.28 + 0.07, atol=0.02), "seen from the side"


def test_kinds_follow_from_size_and_speed() -> None:
    cases = [
        (PEDESTRIAN, (0.6, 0.5, 1.7), 1.4),
        (CYCLIST, (1.7, 0.6, 1.7), 5.0),
        (CYCLIST, (0.9, 0.6, 1.7), 6.0),
        (CAR, (4.4, 1.8, 1.5), 9.0),
        (TRUCK, (9.5, 2.5, 3.2), 9.0),
    ]
    for kind, size, speed in cases:
        boxes = whole_boxes(seen([straight((8, 6), speed, 0.6)], (0.0, 0.0), size=size))
        assert [KINDS[number] for number in boxes.kind.unique().tolist()] == [KINDS[kind]], (size, speed)


def test_an_object_at_rest_keeps_its_heading() -> None:
    velocity = torch.zeros(9, 3)
    velocity[3] = torch.tensor([0.0, 2.0, 0.0])
    velocity[5] = torch.tensor([2.0, 0.0, 0.0])
    track = torch.tensor([0, 0, 0, 0, 0, 0, 0, 1, 1])
    heading = headings(velocity, track, torch.full((9,), 0.7))
    up = np.pi / 2
    assert np.allclose(heading, [up, up, up, up, up, 0, 0, 0.7, 0.7])


def test_smoothing_keeps_constant_velocity_exactly() -> None:
    seconds = torch.tensor([0.0, 0.1, 0.2, 0.5, 0.6], dtype=torch.float64)  # two sweeps are missing
    velocity = torch.tensor([3.0, -1.0, 0.5], dtype=torch.float64)
    position = torch.tensor([5.0, 6.0, 7.0], dtype=torch.float64) + seconds[:, None] * velocity
    measured = torch.stack([position, velocity.expand(5, 3)], 1)
    noise = torch.tensor([0.3, 0.2], dtype=torch.float64).expand(5, 2)
    motion = smooth(torch.zeros(5, dtype=torch.int64), seconds, measured, noise)
    assert torch.allclose(motion.state, measured, rtol=0, atol=1e-12)


def test_smoothing_equals_the_textbook_equations() -> None:
    """Tracks of several lengths at the same time, against a loop over one track and one axis with plain matrices."""
    generator = np.random.default_rng(0)
    lengths = (1, 4, 7)
    track = np.repeat(np.arange(3), lengths)
    seconds = np.concatenate([np.cumsum(generator.uniform(0.05, 0.2, n)) for n in lengths])
    measured = generator.normal(size=(len(track), 2, 3))
    noise = generator.uniform(0.1, 0.5, (len(track), 2))
    motion = smooth(*map(torch.from_numpy, (track, seconds, measured, noise)))
    for number in range(3):
        rows = np.flatnonzero(track == number)
        states, covariances, predicted = [measured[rows[0], :, 1]], [np.diag(noise[rows[0]] ** 2)], [None]
        for row in rows[1:]:
            dt = seconds[row] - seconds[row - 1]
            F = np.array([[1, dt], [0, 1]])
            push = ACCELERATION * np.array([dt**2 / 2, dt])
            x = F @ states[-1]
            P = F @ covariances[-1] @ F.T + np.outer(push, push)
            predicted.append((F, x, P))
            gain = P @ np.linalg.inv(P + np.diag(noise[row] ** 2))
            states.append(x + gain @ (measured[row, :, 1] - x))
            covariances.append((np.eye(2) - gain) @ P)
        for k in range(len(rows) - 2, -1, -1):
            F, x, P = predicted[k + 1]
            gain = covariances[k] @ F.T @ np.linalg.inv(P)
            states[k] = states[k] + gain @ (states[k + 1] - x)
            covariances[k] = covariances[k] + gain @ (covariances[k + 1] - P) @ gain.T
        assert np.allclose(motion.state[rows, :, 1], states) and np.allclose(motion.covariance[rows], covariances)
    assert len(smooth(*(torch.from_numpy(values[:0]) for values in (track, seconds, measured, noise))).state) == 0


def test_the_filter_equals_the_textbook_equations() -> None:
    covariance = torch.tensor([[[0.2, 0.05], [0.05, 0.1]]], dtype=torch.float64)
    before = MotionState(torch.tensor([[[0.0] * 3, [5.0] * 3]], dtype=torch.float64), covariance)
    ahead, _ = before.predict(torch.tensor([0.1], dtype=torch.float64))
    measured = torch.tensor([[[0.55] * 3, [5.1] * 3]], dtype=torch.float64)
    after = ahead.update(measured, torch.tensor([[0.3, 0.2]], dtype=torch.float64))
    F = np.array([[1, 0.1], [0, 1]])
    push = ACCELERATION * np.array([0.005, 0.1])
    P = F @ covariance[0].numpy() @ F.T + np.outer(push, push)
    gain = P @ np.linalg.inv(P + np.diag([0.09, 0.04]))
    expected = np.array([0.5, 5.0]) + gain @ (np.array([0.55, 5.1]) - [0.5, 5.0])
    assert np.allclose(after.state[0, :, 0], expected)
    assert np.allclose(after.covariance[0], (np.eye(2) - gain) @ P)


def test_quantiles_of_groups_equal_those_of_plain_loops() -> None:
    generator = np.random.default_rng(2)
    values, group = generator.normal(0, 1000, 200), generator.integers(0, 7, 200)
    group[group == 3] = 2
    ends = quantiles(torch.from_numpy(values), torch.from_numpy(group), 8, 0.0, 0.75)
    low, high = (each.numpy() for each in ends)
    for number in range(8):
        of_group = np.sort(values[group == number])
        if len(of_group) == 0:
            assert np.isnan(low[number]) and np.isnan(high[number])
            continue
        assert low[number] == of_group[0]
        assert high[number] == of_group[int(np.round((len(of_group) - 1) * 0.75))]
