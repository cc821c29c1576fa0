"""docs/limits.md: each failure is there, and what is said to help helps."""

from __future__ import annotations

import warnings
from typing import Any

import pytest

# Case: error of the first setting at least, of the last one at most, metres per sweep.
MENDED = {
    "long_side": (0.7, 0.045),
    "rail": (1.8, 0.03),
    "touching": (0.4, 0.005),
    "turning": (0.2, 0.13),
    "vertical": (0.17, 0.02),
    "fast": (4.0, 0.012),
    "ground_left_in": (1.1, 0.03),
    "wrong_frame": (0.05, 0.0005),
}


@pytest.fixture()
def failures(script: Any) -> Any:
    return script("figures", "failure_cases")


QUICK = ("touching", "wrong_frame")


@pytest.mark.filterwarnings("ignore:there are ground points")
@pytest.mark.parametrize("name", [pytest.param(n, marks=[] if n in QUICK else pytest.mark.slow) for n in MENDED])
def test_the_failure_is_there_and_the_setting_mends_it(failures: Any, name: str) -> None:
    case = failures.make_case(name, 0)
    assert case.concerned.sum() > 50
    fails, mended = MENDED[name]
    errors = case.errors()
    assert errors[0] >= fails and errors[-1] <= mended


@pytest.mark.slow
def test_what_appears_is_wrong_at_first(failures: Any) -> None:
    first, later = failures.make_case("appearing", 0), failures.make_case("appeared", 0)
    assert first.errors()[0] > 0.8 and later.errors()[0] < 0.01
    assert later.confidences()[0] > 0.8


def test_sweeps_after_t1_mend_what_appears(failures: Any) -> None:
    for seed in range(3):  # in the second a van stands near, so that the car is a part of its coarse component
        online, offline = failures.make_case("appearing", seed).errors()
        assert online > 0.5 and offline < 0.09 and offline < online / 6


def test_a_wrong_frame_is_found_by_the_static_check(failures: Any) -> None:
    from cflow_torch.data.static_check import StaticWorldWarning, check_static_world

    good = failures.drives.turn(0).drive
    with warnings.catch_warnings():
        warnings.simplefilter("error", StaticWorldWarning)
        check_static_world(good)
    with pytest.warns(StaticWorldWarning, match="ego_T_lidar"):
        check_static_world(failures.MisplacedPoses(good))
