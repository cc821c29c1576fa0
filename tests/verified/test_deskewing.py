"""De-skewing of moving objects: hand-made truths, times that change nothing or are refused."""

from __future__ import annotations

import re
from dataclasses import replace
from typing import Sequence

import numpy as np
import pytest
import torch
from moving_scenes import Scene, one_object
from preset_windows import changed, untimed
from scenes import assert_same_bits, pose
from turning_car import MODEL, turning_car

from cflow_torch import CFlowError, FlowResult, Sweep, VerifiedFlow, Window
from cflow_torch.verified.refinement import Registration, deskew, register_deskewed
from cflow_torch.verified.rigid_motion import RigidMotion

HISTORY = MODEL.replace(num_history=3)
NOT_SLOW = torch.tensor([False])  # one object


def with_times(scene: Scene, times: torch.Tensor) -> Scene:
    sweeps = scene.sweeps
    return scene._replace(sweeps=replace(sweeps, batch=replace(sweeps.batch, point_times=times.float())))


def late(window: Window, seed: int) -> Window:
    """Times of two units half a turn apart, with positions of points as they were."""
    rng = np.random.default_rng(seed)

    def timed(sweep: Sweep) -> Sweep:
        angle = np.arctan2(sweep.points[:, 1], sweep.points[:, 0]) / (2 * np.pi)
        times = 0.1 * ((angle + 0.5 * rng.integers(0, 2, len(angle))) % 1.0) + rng.uniform(0, 0.01)
        return replace(sweep, point_times=times)

    return changed(window, timed)


def at_once(window: Window) -> Window:
    return changed(window, lambda sweep: replace(sweep, point_times=np.zeros(len(sweep.points))))


def seen_box(
    velocity: Sequence[float], times: Sequence[Sequence[float]], elapsed: Sequence[int] = (0, 1, 2), angle: float = 0.0
) -> tuple[list[np.ndarray], np.ndarray]:
    """A box of points that moves and rotates by `angle` per interval, met twice a sweep, by two units at the times
    given, the second 0.5 m higher: clouds of the sweeps that are so many intervals before t+1, and times."""
    grid = np.stack(np.meshgrid(np.arange(-0.5, 0.6, 0.23), np.arange(-1.2, 1.3, 0.23), [0.2, 1.2]), -1)
    clouds = []
    for k, of_sweep in zip(elapsed, times):
        poses = [pose(*np.multiply(velocity, a - k), angle * (a - k), 0.5 * unit) for unit, a in enumerate(of_sweep)]
        clouds.append(np.concatenate([grid.reshape(-1, 3) @ T[:3, :3].T + T[:3, 3] for T in poses]))
    return clouds, np.concatenate([np.repeat(of_sweep, grid.size // 3) for of_sweep in times])


@pytest.mark.parametrize("elapsed, angle", [((0, 1), 0.0), ((0, 1, 2), 0.0), ((0, 1, -1, -2), 0.0), ((0, 1, 2), 0.06)])
def test_a_known_motion_under_known_times_is_found(elapsed, angle):
    velocity = (0.8, -0.3)
    clouds, of_points = seen_box(velocity, [(0.05 - 0.1 * k, 0.55 - 0.1 * k) for k in elapsed], elapsed, angle)
    apparent = [1.1 * v for v in velocity]  # an interval and a tenth lie between two sightings
    scene = with_times(one_object(clouds, apparent, elapsed), torch.from_numpy(of_points))
    points = scene.points()
    found, seen = register_deskewed(points, scene.sweeps, scene.flow, NOT_SLOW)
    loose = 1 if angle == 0 else 20  # the sides of a box that rotates are met at other places
    np.testing.assert_allclose(seen.flow[0], apparent, atol=1e-3 * loose)
    np.testing.assert_allclose(found.flow[0], velocity, atol=1e-3 * loose)
    assert abs(float(found.rotation) - np.tan(angle / 2)) < max(1e-3, 0.1 * angle)


def test_both_walls_of_a_corner_count_for_the_time_between_two_sweeps():
    """A wall weighs across itself only; one is met 0.2 intervals later than in the sweep before, one 0.1 earlier."""
    u, z = (values.ravel() for values in np.meshgrid(np.arange(-0.95, 1.0, 0.1), (0.25, 0.55, 0.85, 1.15)))
    along_x, along_y = np.stack((u, 0 * u - 1.45, z), 1), np.stack((0 * u + 2.05, u, z), 1)
    corner, times = np.concatenate((along_x, along_y)), np.repeat([0.0, 0.0, -0.2, 0.1], len(u))
    scene = with_times(one_object([corner, corner], (0.0, 0.0)), torch.from_numpy(times))
    rigid = RigidMotion(scene.flow, torch.zeros(1).double(), torch.zeros(1, 2).double())
    assert abs(float(Registration.of_objects(scene.points(), scene.sweeps, 1).stretch(rigid)) - 1.05) < 0.005


@pytest.mark.parametrize("angle", [0.0, 0.06])
def test_points_are_moved_to_where_they_were_at_the_instant_of_their_sweep(angle):
    velocity, elapsed = (0.8, -0.3), (0, 1, 2)
    clouds, of_points = seen_box(velocity, [(0.2, 0.6), (-0.3, 0.4), (0.1, 0.0)], elapsed, angle)
    at_instant, _ = seen_box(velocity, [(0.0, 0.0)] * 3, elapsed, angle)
    scene = with_times(one_object(clouds, velocity, elapsed), torch.from_numpy(of_points))
    centre = -torch.tensor([velocity], dtype=torch.float64)  # at t
    rigid = RigidMotion(scene.flow, torch.tensor([np.tan(angle / 2)]), centre)
    sharp = deskew(scene.points(), scene.sweeps, rigid)
    np.testing.assert_allclose(sharp.position.T, np.concatenate(at_instant), atol=1e-4)
    expected = torch.stack(scene.sweeps.grid.row_col(sharp.position))
    assert torch.equal(sharp.place[2:], expected.long())


def test_points_without_an_offset_in_time_stay_exactly_where_they_are():
    """Windows without times have such points if another window of the batch has times."""
    lattice = 0.1 * np.mgrid[-20:20, -20:20].reshape(2, -1).T  # every other point is at the edge of its pixel
    cloud = np.column_stack((lattice, np.full(len(lattice), 0.2)))
    scene = with_times(one_object([cloud, cloud], (0.8, -0.3)), torch.zeros(2 * len(cloud)))
    rigid = RigidMotion(scene.flow, torch.tensor([0.1]).double(), torch.tensor([[0.7, 0.3]]).double())
    points = scene.points()
    assert torch.equal(deskew(points, scene.sweeps, rigid).position, points.position)


def test_points_that_leave_the_region_are_dropped_and_a_pixel_belongs_to_the_first_object():
    cloud = np.array([[0.05, 0.05, 0.2], [1.05, 0.05, 0.2], [2.95, 1.05, 0.2]])
    scene = with_times(one_object([cloud[:2], cloud], (0.0, 0.0)), torch.tensor([0.0, 0.0, 0.0, 1.0, -0.5]))
    points = scene.points()
    points = replace(points, object_id=torch.tensor([0, 1, 0, 1, 0]))
    rigid = RigidMotion(torch.tensor([[1.0, 0.0]] * 2).double(), torch.zeros(2).double(), torch.zeros(2, 2).double())
    sharp = deskew(points, scene.sweeps, rigid)
    assert sharp.object_id.tolist() == [0, 1, 0]
    np.testing.assert_allclose(sharp.position[0], [0.05, 1.05, 0.05], atol=1e-12)
    assert sharp.step.tolist() == [0, 0, 1]


@pytest.mark.parametrize("num_history", [0, 2])
def test_times_change_the_motion(num_history):
    window, model = late(turning_car(3, num_history, 0.4), 3), VerifiedFlow(HISTORY)
    assert not torch.equal(model([window])[0].residual_flow, model([untimed(window)])[0].residual_flow)


def test_times_that_differ_by_a_rotation_of_the_sensor_are_ignored():
    """What is met at the end of one sweep and at the start of the next would be faster by far than it seems."""
    clouds, of_points = seen_box((0.3, 0.0), [(0.0,), (0.0,)])
    of_points[len(clouds[0]) :] = 0.9
    scene = with_times(one_object(clouds, (0.3, 0.0)), torch.from_numpy(of_points))
    found, seen = register_deskewed(scene.points(), scene.sweeps, scene.flow, NOT_SLOW)
    assert torch.equal(found.flow, seen.flow)


@pytest.mark.parametrize("num_history", [0, 3])
def test_times_of_zero_and_times_of_some_sweeps_change_no_bit(num_history):
    window, model = turning_car(4, num_history), VerifiedFlow(HISTORY)
    (expected,) = model([window])
    assert expected.residual_flow.any()
    assert_same_bits(model([at_once(window)])[0], expected)
    some = late(window, 1)
    assert_same_bits(model([replace(some, pc1=replace(some.pc1, point_times=None))])[0], expected)


def flow_with(times: object) -> FlowResult:
    window = late(turning_car(4), 1)
    return VerifiedFlow(MODEL)([replace(window, pc0=replace(window.pc0, point_times=times))])[0]


def test_times_may_be_arrays_or_tensors_of_any_width():
    times = np.floor(late(turning_car(4), 1).pc0.point_times * 2**12) / 2**12
    expected = flow_with(times)
    for given in (times.astype(np.float32), torch.from_numpy(times), torch.from_numpy(times).float()):
        assert_same_bits(flow_with(given), expected)


@pytest.mark.parametrize(
    "change, message",
    [
        (lambda times: times[:-1], "shape"),
        (lambda times: times[:, None], "shape"),
        (lambda times: times.tolist(), "list"),
        (lambda times: (1e9 * times).astype(np.int64), "int64"),
        (lambda times: 1e9 * times, "nanoseconds"),
        (lambda times: np.where(np.arange(len(times)) == 3, np.nan, times), "finite"),
        (lambda times: np.where(np.arange(len(times)) == 3, np.inf, times), "finite"),
        (lambda times: np.ma.masked_array(times), "masked"),
    ],
)
def test_invalid_times_are_refused(change, message):
    times = late(turning_car(4), 1).pc0.point_times
    with pytest.raises(CFlowError, match=message) as caught:
        flow_with(change(times))
    assert re.match(r"Sweep\.point_times|point times of pc0", str(caught.value))


def test_time_stamps_give_the_length_of_an_interval():
    """Two tenths of a second between the sweeps: the same times are half as many intervals."""
    window = late(turning_car(4), 1)
    pc0, pc1 = (replace(s, timestamp_ns=stamp) for s, stamp in ((window.pc0, 0), (window.pc1, 200_000_000)))
    half = [replace(s, point_times=0.5 * s.point_times, timestamp_ns=None) for s in (pc0, pc1)]
    (found,) = VerifiedFlow(MODEL.replace(max_speed=None))([Window(pc0, pc1)])
    (expected,) = VerifiedFlow(MODEL.replace(max_speed=None))([Window(*half)])
    assert_same_bits(found, expected)
