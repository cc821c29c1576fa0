"""What `Inspection` says of windows that are wrong on purpose: ground masks and history."""

from __future__ import annotations

import warnings
from dataclasses import replace

import numpy as np
import pytest

from cflow_torch.data.log import window
from cflow_torch.diagnosis.inspection import Inspection, mask_problem
from cflow_torch.diagnosis.point_frame import tilt_problem
from cflow_torch.simulator import make_drive
from cflow_torch.transforms import as_matrix, rotations_about, transform_points


@pytest.fixture(scope="module")
def right():
    return window(make_drive(seed=2, num_sweeps=6), 4, num_history=3)


def said_of(wrong):
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        Inspection()([wrong])
    return [str(each.message) for each in caught]


def test_right_windows_stay_silent(right):
    assert said_of(right) == []
    ground = right.pc0.is_ground
    road = ground & (np.abs(right.pc0.points[:, 1]) < 3)
    assert road.sum() < ground.sum() / 2
    for mask in (np.zeros_like(ground), road):  # you say that there is none, or mask the road alone
        assert said_of(replace(right, pc0=replace(right.pc0, is_ground=mask))) == []


@pytest.mark.parametrize(
    ("mask", "text"),
    [
        (np.logical_not, "invert the mask"),
        (np.ones_like, "no point would have flow"),
        (lambda mask: mask[::-1], "has it the rows of this sweep"),
        (lambda mask: None, "without a ground mask contains ground"),
    ],
)
def test_wrong_ground_masks_are_told(right, mask, text):
    wrong = replace(right, pc0=replace(right.pc0, is_ground=mask(right.pc0.is_ground)))
    (said,) = said_of(wrong)
    assert text in said


@pytest.mark.parametrize(("place", "found"), [(0, "2, 3 and 4"), (1, "1, 3 and 4"), (2, "1, 2 and 4")])
def test_a_column_before_z_is_told(right, place, found):
    def with_column(sweep, place, values):
        return replace(sweep, points=np.insert(sweep.points, place, values, axis=1))

    ones = [with_column(sweep, place, 1) for sweep in (right.pc0, right.pc1)]
    (said,) = said_of(replace(right, pc0=ones[0], pc1=ones[1]))
    assert f"x, y and z seem to be in columns {found}" in said
    for last in (1, np.linspace(0, 1, len(right.pc0.points))):
        assert said_of(replace(right, pc0=with_column(right.pc0, 3, last))) == []


def test_masks_of_the_next_sweep_are_told_and_those_of_a_height_are_not(kitti_file):
    hdf5 = pytest.importorskip("cflow_torch.data.hdf5")
    with hdf5.HDF5Log(kitti_file) as log:
        sweep, following = log.sweep(0), log.sweep(1)
    heights = sweep.points[sweep.is_ground, 2]
    for height in (0.1, 0.3, 0.8):
        assert mask_problem(replace(sweep, is_ground=sweep.points[:, 2] < np.median(heights) + height)) == ""
    mask = np.resize(following.is_ground, len(sweep.points))
    assert "has it the rows of this sweep" in mask_problem(replace(sweep, is_ground=mask))


def test_a_history_with_other_poses_or_in_the_reverse_order_is_told(right):
    late = [replace(sweep, pose=before.pose) for sweep, before in zip(right.pch, right.pch[1:])]
    back = [replace(sweep, pose=other.pose) for sweep, other in zip(reversed(right.pch), right.pch)]
    for history in (late, back):
        (said,) = said_of(replace(right, pch=tuple(history)))
        assert "the first sweep of the history does not fit pc0" in said


def test_a_tilt_of_one_sweep_is_not_that_of_a_log_whose_other_sweeps_have_no_ground(right):
    tilted = transform_points(right.pc0.points, as_matrix(rotations_about(0, np.radians(25))))
    wall = np.random.default_rng(0).uniform((5, -20, 0), (5.1, 20, 9), (1000, 3))
    assert "tilted by about 25 degrees" in tilt_problem([tilted] * 4 + [wall])
    assert tilt_problem([tilted, *[wall] * 4]) == tilt_problem([]) == ""


def test_under_a_tilt_the_ego_motion_is_judged_too(right):
    tilt = as_matrix(rotations_about(0, np.radians(10)))

    def tilted(sweep, pose):
        return replace(sweep, points=transform_points(sweep.points, tilt), pose=pose @ np.linalg.inv(tilt))

    first, second = (tilted(right.pc0, right.pc0.pose), tilted(right.pc1, right.pc1.pose))
    (said,) = said_of(replace(right, pc0=first, pc1=second, pch=()))
    assert "tilted by about 10 degrees" in said
    swapped = replace(right, pc0=replace(first, pose=second.pose), pc1=replace(second, pose=first.pose), pch=())
    said = said_of(swapped)
    assert "tilted by about 10 degrees" in said[0] and "in place as given" in said[1]
