"""Streams give the flow of windows to the bit, through gaps and late, repeated or bad sweeps, in bounded memory."""

from __future__ import annotations

import gc
import json
import warnings
import weakref
from dataclasses import replace
from importlib.util import find_spec
from typing import Any

import numpy as np
import pytest
import torch
from command_line import cflow
from preset_windows import small
from scenes import assert_same_bits, scene
from small_logs import make_small_drive

from cflow_torch import CFlowError, FlowResult, FlowStream, Sweep, Window, make_config, make_model
from cflow_torch.errors import CFlowWarning
from cflow_torch.simulator import make_drive
from cflow_torch.transforms import as_matrix


@pytest.fixture(scope="module")
def sweeps() -> list[Sweep]:
    """Seven sweeps of a vehicle that drives and turns, oldest first, 0.08 to 0.1 s apart, with ground."""
    window = scene(12, num_history=5, stamps=True, num_points=90)
    return [*window.pch[::-1], window.pc0, window.pc1]


def push(stream: FlowStream, sweep: Sweep, **changes: Any) -> FlowResult | None:
    return stream.push(replace(sweep, **changes))


def expected(sweeps: list[Sweep], index: int, settings: Any) -> FlowResult:
    """Flow of sweep `index` with all available history."""
    oldest = max(index - settings.num_history, 0)
    window = Window(sweeps[index], sweeps[index + 1], tuple(sweeps[oldest:index][::-1]))
    return make_model(settings, "cpu")([window])[0]


@pytest.mark.parametrize("preset", ["default", "paper", "keypoints"])
def test_results_equal_those_of_windows(preset, sweeps):
    settings = small(preset)
    timed = [replace(s, point_times=np.linspace(0, 0.09, len(s.points))) for s in sweeps]
    stream = FlowStream(settings, device="cpu")
    assert push(stream, timed[0]) is None and stream.window is None
    for index, sweep in enumerate(timed[1:]):
        result = push(stream, sweep)
        assert result is not None
        assert_same_bits(result, expected(timed, index, settings))
        assert np.array_equal(stream.window.pc0.points, timed[index].points, equal_nan=True)


def test_few_sweeps_are_kept_and_buffers_may_be_reused(sweeps):
    settings, buffer = small("paper", num_history=1), np.empty((2000, 3), np.float32)
    stream, seen = FlowStream(settings), []
    for index, sweep in enumerate(sweeps):
        count = len(sweep.points)
        buffer[:count] = sweep.points
        result = push(stream, sweep, points=buffer[:count])
        buffer.fill(7.0)
        if result is not None:
            assert_same_bits(result, expected(sweeps, index - 1, settings))
            seen.append(weakref.ref(stream.window.pc0.points))
    gc.collect()
    assert [reference() is not None for reference in seen] == [False] * 4 + [True, True]


def test_late_and_repeated_sweeps_are_skipped_and_gaps_start_again(sweeps, caplog):
    settings = small("default", num_history=2)
    stream = FlowStream(settings, max_gap=0.5)
    for sweep in sweeps[:3]:
        last = push(stream, sweep)
    assert last is not None
    assert push(stream, sweeps[2]) is None and push(stream, sweeps[1]) is None  # repeated, late
    assert_same_bits(push(stream, sweeps[3]), expected(sweeps, 2, settings))  # as if they had not come
    later = 1_000_000_000
    lost = [replace(sweep, timestamp_ns=sweep.timestamp_ns + later) for sweep in sweeps[4:]]
    assert push(stream, lost[0]) is None and "starts again" in caplog.text
    assert_same_bits(push(stream, lost[1]), expected(lost, 0, settings))  # no history from before
    assert push(stream, sweeps[0]) is None  # the clock was set back: a bag from its start
    assert_same_bits(push(stream, sweeps[1]), expected(sweeps, 0, settings))
    stream.reset()
    assert push(stream, sweeps[5]) is None


def test_times_in_seconds_and_missing_times_give_the_same_flow(sweeps):
    settings = small("default", num_history=2, max_speed=8.0)
    regular = [replace(sweep, timestamp_ns=None) for sweep in sweeps]
    stream, by_second = FlowStream(settings), FlowStream(settings)
    for index, sweep in enumerate(regular[:4]):
        result = push(stream, sweep)
        again = by_second.push(sweep.points, sweep.pose, 10.0 + 0.1 * index, sweep.is_ground)
        if index:
            assert_same_bits(result, expected(regular, index - 1, settings))
            assert torch.allclose(again.residual_flow, result.residual_flow, atol=1e-5)


BAD = [
    ({"points": np.zeros((5, 2))}, r"give \(N, 3\+\)", True),
    ({"pose": np.zeros((4, 4))}, "not rigid", True),
    ({"is_ground": np.zeros(3, bool)}, "one per point", True),
    ({"pose": None}, "have no pose", False),
    ({"timestamp_ns": None}, "have no time", False),
    ({"pose": np.full((4, 4), np.nan), "timestamp_ns": 10**12}, "pose1 holds NaN", False),  # and after a gap
]


@pytest.mark.parametrize("bad, message, first", [*BAD, *(case[:2] + (False,) for case in BAD[:3])])
def test_a_bad_sweep_is_refused_and_the_stream_goes_on(bad, message, first, sweeps):
    settings = small("default", num_history=2)
    stream = FlowStream(settings)
    good = sweeps[:3]
    for sweep in good[: 0 if first else 2]:
        push(stream, sweep)
    with pytest.raises(CFlowError, match=message):
        push(stream, sweeps[2], **bad)
    for sweep in good if first else good[2:]:
        result = push(stream, sweep)
    assert_same_bits(result, expected(good, 1, settings))


def test_settings_that_a_stream_cannot_have_are_refused(sweeps):
    for settings, message in (
        ({"preset": "offline"}, "does not know later sweeps"),
        ({"ground": "grass"}, "ground="),
        ({"max_gap": 0}, "max_gap"),
    ):
        with pytest.raises(CFlowError, match=message):
            FlowStream(**settings)
    with pytest.raises(CFlowError, match="into the Sweep"):
        FlowStream("default").push(sweeps[0], sweeps[0].pose)


def test_missing_ground_and_poses_are_estimated():
    drive = make_small_drive(4, seed=2)
    stream = FlowStream("default", num_history=0, pixel_sizes=(0.4, 0.2))
    if find_spec("small_gicp") is None:
        with pytest.raises(CFlowError, match="pip install small-gicp"):
            stream.push(drive.sweep(0).points)
        return
    with pytest.raises(CFlowError, match="fewer than 100"):
        stream.push(drive.sweep(0).points[:10])
    for index in range(4):
        result = stream.push(drive.sweep(index).points, time=drive.timestamps[index])
    found, truth = stream.window.pc1.is_ground, drive.sweep(3).is_ground
    assert (found.numpy() == truth).mean() > 0.95
    moved = np.linalg.inv(stream.window.pc0.pose) @ stream.window.pc1.pose
    true = np.linalg.inv(drive.sweep(2).pose) @ drive.sweep(3).pose
    assert np.abs(moved - true).max() < 0.2 and result.residual_flow.any()
    given = FlowStream("default", num_history=0)
    with pytest.raises(CFlowError, match="fewer than 100"):
        given.push(drive.sweep(0).points[:10])
    for index in range(2):  # the stream is still one without estimated poses
        result = given.push(drive.sweep(index))
    assert result is not None


def test_ground_is_found_by_default_but_a_given_mask_wins():
    drive = make_small_drive(2, seed=2)
    settings = make_config(num_history=0, point_cloud_range=(-20, -20, -9, 20, 20, 9))
    given = [drive.sweep(index) for index in range(2)]
    bare = [replace(sweep, is_ground=None) for sweep in given]

    def masks(sweeps: list[Sweep], **arguments: Any) -> list[np.ndarray | None]:
        stream = FlowStream(settings, device="cpu", **arguments)
        for sweep in sweeps:
            push(stream, sweep)
        pair = (stream.window.pc0, stream.window.pc1)
        return [None if sweep.is_ground is None else np.asarray(sweep.is_ground) for sweep in pair]

    with pytest.warns(CFlowWarning, match="no ground mask") as told:
        found = masks(bare)
    assert len([one for one in told if "no ground mask" in str(one.message)]) == 1, "it warns once"
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert all(map(np.array_equal, masks(bare, ground="grid"), found)), "the same without the warning"
        own = [replace(sweep, is_ground=sweep.is_ground & (np.arange(len(sweep.points)) % 9 > 0)) for sweep in given]
        assert all(np.array_equal(mask, sweep.is_ground) for mask, sweep in zip(masks(own), own))
    truth = [sweep.is_ground for sweep in given]
    assert all((mask == ground).mean() > 0.95 for mask, ground in zip(found, truth))


def test_the_command_reports_latency(tmp_path, capsys):
    data = ("model=paper", "data.num_sweeps=4", f"data.cache={tmp_path / 'cache'}")
    assert cflow("stream", *data, "pace=null", f"output={tmp_path / 'out'}") == 0
    report = json.loads((tmp_path / "out" / "stream.json").read_text())
    assert cflow("stream", *data, "pace=null", "max_gap=0.01", f"output={tmp_path / 'none'}") == 2
    assert not (tmp_path / "none" / "stream.json").exists()
    assert report["sweeps"] == 4 and report["results"] == 3 and report["in_time"] is None
    assert 0 < report["latency"]["p50"] <= report["latency"]["p99"] and "latency: median" in capsys.readouterr().out


def shifted(poses):
    """Poses that jump to the left by a metre before the last sweep."""
    return [*poses[:-1], as_matrix(np.eye(3), (0, 1, 0)) @ poses[-1]]


@pytest.mark.parametrize(
    ("poses", "unit", "text"),
    [
        (list, 1, ""),
        (list, 1000, "pc1 is 0.0001 s after pc0: give times in nanoseconds"),
        (shifted, 1, "the second sweep does not fit the first one"),
    ],
)
def test_times_and_poses_of_later_sweeps_are_checked(poses, unit, text):
    drive = make_drive(seed=2, num_sweeps=4, profile="demo", scene="narrow")
    stream = FlowStream("default", num_history=1, pixel_sizes=(0.8, 0.4))
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        for sweep, pose in zip(drive, poses(drive.poses)):
            push(stream, sweep, pose=pose, timestamp_ns=sweep.timestamp_ns // unit)
    said = [str(each.message) for each in caught]
    assert len(said) == bool(text) and all(text in each for each in said)
