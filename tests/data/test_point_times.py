"""Times of points in any unit, of any clock, with wraps and stray values."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from cflow_torch.data.column_names import time_columns
from cflow_torch.data.point_times import find_times, seconds_after

STAMP = 1_700_000_000_123_456_789
SHARES = np.linspace(0, 1, 2001)
NS = np.round(SHARES * 1e8).astype(np.int64)


@pytest.mark.parametrize(
    ("values", "first", "is_assumed"),
    [
        (NS.astype(np.uint32), 0.0, False),  # Ouster: nanoseconds after the stamp
        ((SHARES - 1).astype(np.float32) * np.float32(0.1), -0.1, False),  # Velodyne: seconds, up to the stamp
        (SHARES * 100, 0.0, False),  # milliseconds
        ((NS // 1000).astype(np.uint32), 0.0, False),  # microseconds
        (STAMP * 1e-9 + SHARES * 0.1, 0.0, False),  # Hesai: unix seconds
        (STAMP * 1e-3 + SHARES * 1e5, 0.0, False),  # unix microseconds
        (np.uint64(STAMP + 2_000_000) + NS.astype(np.uint64), 0.002, False),  # unix nanoseconds
        (
            (NS - 5_000_000).astype(np.uint32),
            -0.005,
            False,
        ),  # the counter wraps
        ((NS - 95_000_000).astype(np.uint32), -0.095, False),
        (SHARES, 0.0, True),  # shares of the sweep
        (SHARES.astype(np.float32), 0.0, True),
        (7e17 + SHARES * 1e8, 0.0, True),  # Livox without a common clock
        (STAMP * 1e-9 + 37 + SHARES * 0.1, 0.0, True),  # TAI
        (0.3 + SHARES * 0.1, 0.0, True),  # a sensor that has just started
        ((NS + 300_000_000).astype(np.int64), 0.0, True),
        (STAMP * 1e-9 - 0.24 + SHARES * 0.1, -0.24, False),  # stamps of arrival, 0.14 s after the last point
    ],
)
def test_the_unit_and_origin_of_times_are_recognised(values: Any, first: float, is_assumed: bool) -> None:
    times = seconds_after(values, STAMP, 0.1)
    assert times.seconds is not None and not times.is_stray.any()
    assert np.allclose(times.seconds, first + SHARES * 0.1, atol=2e-6)
    assert (times.note == "") == (not is_assumed)


def test_columns_of_times_are_found_by_name() -> None:
    names = "t time timestamp stamps GpsTime dt delta_t offset offset_ns time_offset_ns point_time_offset t_offset t_us"
    found = [*names.split(), "time_nsec", "timestamp_nsec", "offset_time", "time [s]", "timestamp_unix"]
    others = ["x", "intensity", "tag", "x_offset", "height", "line", "return_count", "dts_x", "target"]
    assert time_columns([*found, *others]) == found


@pytest.mark.parametrize("boot", [0.0, 0.2, 3.0, 700.0])
@pytest.mark.parametrize("is_relative", [False, True])
def test_times_since_the_sensor_started_are_recognised_by_their_distance_to_the_stamp(boot, is_relative) -> None:
    stamp = round((boot + 0.03) * 1e9)
    values = SHARES * 0.1 + (0 if is_relative else stamp * 1e-9)
    assert np.allclose(seconds_after(values, stamp, 0.1).seconds, SHARES * 0.1, atol=0.031 if boot == 0 else 1e-6)


@pytest.mark.parametrize("stray", [0, 4_000_000_000, 900_000_000, 123_456_789_000])
def test_stray_values_are_found_and_change_no_other_time(stray: int) -> None:
    values = NS.astype(np.uint64) + np.uint64(STAMP)
    is_wrong = np.arange(len(values)) % 33 == 7  # 3 %, as of lost packets
    values[is_wrong] = stray if stray < 10**9 else np.uint64(STAMP) + np.uint64(stray)
    times = seconds_after(values, STAMP, 0.1)
    assert np.array_equal(times.is_stray, is_wrong)
    assert np.allclose(times.seconds[~is_wrong], SHARES[~is_wrong] * 0.1, atol=1e-6)
    assert np.abs(times.seconds).max() < 0.2, "the model refuses sweeps with other times"


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("share", [0.1, 0.3])
def test_a_column_of_which_many_values_are_stray_holds_no_times(share: float) -> None:
    """Such a column may be read from other bytes: its values have any size."""
    values = STAMP * 1e-9 + SHARES * 0.1
    is_wrong = np.random.default_rng(0).random(len(values)) < share
    values[is_wrong] = np.resize((1e308, -1e308, np.nan, 1e-200, np.inf), is_wrong.sum())
    values[is_wrong.argmax()] = np.array(0x7FF0000000000001, np.uint64).view(np.float64)  # a signalling NaN
    times = seconds_after(values, STAMP, 0.1)
    assert (times.seconds is None) == (share > 0.2)
    assert "stray: ignored" in times.note if share > 0.2 else np.array_equal(times.is_stray, is_wrong)


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("stray", [0.0, np.nan, -1e300])
def test_points_of_many_lost_packets_are_left_out_if_they_have_one_value(stray: float) -> None:
    values = STAMP * 1e-9 + SHARES * 0.1
    is_lost = np.arange(len(values)) % 10 < 3
    values[is_lost] = stray
    values[5] = 7.0  # and one other stray value
    times = seconds_after(values, STAMP, 0.1)
    is_stray = is_lost | (np.arange(len(values)) == 5)
    assert times.seconds is not None and np.array_equal(times.is_stray, is_stray)
    assert np.allclose(times.seconds[~is_stray], 0.1 * SHARES[~is_stray], atol=1e-6)


def test_a_sweep_without_returns_has_no_times_and_that_is_not_said() -> None:
    for size in (0, 5):
        assert seconds_after(np.zeros(size), STAMP, 0.1, np.ones(size, bool)) == (
            None,
            pytest.approx(np.zeros(size)),
            "",
        )


def test_missing_returns_have_no_stray_times() -> None:
    values = STAMP * 1e-9 + SHARES * 0.1
    is_missing = np.arange(len(values)) % 2 == 1
    values[is_missing] = np.resize((np.nan, 0.0), is_missing.sum())
    told: list[str] = []
    times = find_times({"t": values}, STAMP, 0.1, lambda note, kind: told.append(note), is_missing)
    assert times is not None and not times.is_stray.any() and told == [""]
    assert times.seconds is not None and np.allclose(times.seconds[~is_missing], 0.1 * SHARES[~is_missing], atol=1e-6)


def test_points_of_lost_packets_at_time_zero_are_stray_within_the_sweep() -> None:
    values = (np.arange(64_000) // 64 * 100_000).astype(np.uint32)  # 1000 columns of 64 points
    is_lost = np.arange(len(values)) % 33 == 7
    values[is_lost] = 0
    assert (seconds_after(values, STAMP, 0.1).is_stray[is_lost]).all()
    assert seconds_after(values, STAMP, 0.1).is_stray.sum() <= is_lost.sum() + 64
    packets = (np.arange(64_000) // 6400 * 10_000_000).astype(np.uint32)  # ten times only
    assert not seconds_after(packets, STAMP, 0.1).is_stray.any()


def test_times_are_read_in_a_thinned_log_and_without_a_period() -> None:
    for period in (None, 0.1, 0.05, 0.5, 5.0):
        assert np.allclose(seconds_after(NS.astype(np.uint32), STAMP, period).seconds, SHARES * 0.1)
        assert seconds_after(SHARES, STAMP, period).seconds.max() == (0.05 if period == 0.05 else 0.1)


@pytest.mark.parametrize(
    ("values", "note"),
    [
        (np.zeros(30), "all equal"),
        (np.full(30, np.nan), "finite"),
        (np.array([0.0, 1e-4]), "span"),
        (np.array([0, 1 << 62], np.uint64), "span"),
        ((STAMP * 1e-9 + SHARES * 0.1).astype(np.float32), "too coarse in float32"),  # steps of 128 s
    ],
)
def test_values_that_are_not_times_are_ignored_and_said(values: Any, note: str) -> None:
    times = seconds_after(values, STAMP, 0.1)
    assert times.seconds is None and note in times.note and not times.is_stray.any()
