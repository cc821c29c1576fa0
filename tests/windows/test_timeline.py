"""Which sweeps of a window are compared, and how long before t+1 they are."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from preset_windows import small
from scenes import assert_same_bits, scene

from cflow_torch import Config, Sweep, Window, make_model
from cflow_torch.windows.bev_grid import Grid
from cflow_torch.windows.timeline import Timeline


def intervals(config: Config, num_history: int, num_future: int = 0) -> list[list[float]]:
    """Sweep intervals from the compared sweeps to t+1, before t+1 and, if there are later sweeps, after it."""
    clouds = np.random.default_rng(0).uniform(-1, 1, (2 + num_history + num_future, 5, 3)).astype(np.float32)
    newest, *others = map(Sweep, clouds)
    window = Window(others[0], newest, tuple(others[1 : 1 + num_history]), tuple(others[1 + num_history :]))
    timeline = Timeline.of([window], config, Grid(0.1, (-2.0, -2.0, -2.0), (2.0, 2.0, 2.0)), needs_times=False)
    return [side[side != 0].tolist() for side in timeline.table[0]]


@pytest.mark.parametrize(
    ("num_compared", "num_history", "expected"),
    [
        (None, 4, [1, 2, 3, 4, 5]),
        (2, 4, [1, 2, 5]),
        (3, 4, [1, 2, 4, 5]),
        (3, 5, [1, 2, 4, 6]),
        (2, 3, [1, 2, 4]),
        (2, 2, [1, 2, 3]),
        (2, 1, [1, 2]),
        (2, 0, [1]),
        (1, 4, [1, 5]),
    ],
)
def test_the_farthest_and_the_nearest_sweeps_are_compared(num_compared, num_history, expected):
    config = small("default", num_history=6, num_compared=num_compared)
    assert intervals(config, num_history) == [expected]


def test_sweeps_after_t_plus_1_are_chosen_likewise():
    config = small("offline", num_history=4, num_future=3, num_compared=2)
    assert intervals(config, 4, 3) == [[1, 2, 5], [1, -1, -3]]


def test_older_and_later_sweeps_without_points_are_left_out():
    window = scene(12, num_history=1, num_points=90)
    empty = replace(window.pch[0], points=window.pch[0].points[:0], is_ground=None)
    model = make_model(small("offline", num_history=4, num_future=3), "cpu")
    (expected,) = model([window])
    (result,) = model([replace(window, pch=(*window.pch, empty), pcf=(empty,))])
    assert_same_bits(result, expected)
    assert expected.residual_flow.any()


def test_the_result_is_that_of_a_window_with_the_compared_sweeps_alone():
    window = scene(12, num_history=4, num_points=90)
    stamps = iter(range(10**9, 0, -(10**8)))
    newest, sweep_t, *older = (replace(s, timestamp_ns=next(stamps)) for s in (window.pc1, window.pc0, *window.pch))
    window = Window(sweep_t, newest, tuple(older))
    config = small("live", num_history=4)
    alone = replace(window, pch=(window.pch[0], window.pch[3]))
    every = config.replace(num_compared=None)
    (result,) = make_model(config, "cpu")([window])
    assert_same_bits(result, make_model(every, "cpu")([alone])[0])
    assert result.residual_flow.any() and not result.residual_flow.equal(
        make_model(every, "cpu")([window])[0].residual_flow
    )
