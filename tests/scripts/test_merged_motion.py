"""The table of merged motion: its figures are those of a hand-made estimate, and the command prints them."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any, List

import numpy as np
import pytest
import torch

from cflow_torch import make_config, make_model
from cflow_torch.data.log import FlowLabels, window
from cflow_torch.types import Sweep, Window

CAR, PEDESTRIAN = 19, 17


@pytest.fixture()
def command(script: Any) -> Any:
    return script("benchmarks", "merged_motion")


@pytest.fixture()
def hand_made(command: Any, script: Any) -> Any:
    """Ten points that stand, a car, a walker; a car at 40 m and a point of the ground, which do not count."""
    sets = script("ablation", "sets")
    points = np.zeros((15, 3), np.float32)
    points[:, 0] = [*range(1, 14), 40, 5]
    flow = np.zeros((15, 3), np.float32)
    flow[10:12, 0], flow[12, 1], flow[13:, 0] = 1.0, 0.1, 2.0
    category = np.array([0] * 9 + [CAR] * 3 + [PEDESTRIAN, CAR, CAR], np.uint8)  # one car is parked
    ground = np.arange(15) == 14
    sweep = Sweep(points, ground, np.eye(4))
    items = [sets.make_item(Window(sweep, sweep), FlowLabels(flow, category, np.ones(15, bool)))]
    return sets.ScoredSet("hand", "merged", 0, 35.0, lambda: items)


def test_figures_are_those_of_a_hand_made_estimate(
    command: Any, script: Any, hand_made: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    figures = script("benchmarks", "merged_figures")
    estimate = torch.zeros(15, 3)
    estimate[0, 0], estimate[9, 2], estimate[10, 0], estimate[11, 0] = 0.09, 0.02, 0.75, 0.25  # row 11: a quarter
    confidence = torch.full((15,), 0.9)
    confidence[[1, 11, 12]] = torch.tensor([0.4, 0.3, 0.6])
    result = SimpleNamespace(residual_flow=estimate, confidence=confidence)
    monkeypatch.setattr(figures, "make_model", lambda config: lambda windows: [result])
    (measured,) = figures.measure([hand_made], [figures.Setting("", "default")])
    errors = measured.errors
    assert errors["dynamic"] == pytest.approx((0.25 + 0.75 + 0.1) / 3)
    assert errors["pedestrian"] == pytest.approx(1.0)
    assert errors["static"] == pytest.approx(0.09 / 9)
    assert errors["stands"] == pytest.approx((0.09 + 0.02) / 10)
    assert math.isnan(errors["near"])
    misses = measured.misses
    assert (misses.moving, misses.missed) == (3, 2), "a car point at a quarter of its speed, and the walker"
    assert misses.confidence_at(0.01) == pytest.approx(0.4), "no standing point may lie below it"
    assert misses.flagged_below(misses.confidence_at(0.01)) == misses.flagged_below(0.5) == 0.5
    assert misses.confidence_at(0.1) == pytest.approx(0.9), "one in ten may"
    assert misses.standing_below(0.5) == pytest.approx(0.1)
    assert len(measured.times) == 1


def test_settings_without_confidence_flag_nothing(command: Any, script: Any, hand_made: Any) -> None:
    figures = script("benchmarks", "merged_figures")
    paper, default = figures.measure([hand_made], [figures.Setting("", "paper"), figures.Setting("", "default")])
    assert paper.misses.missed == default.misses.missed == 3, "both sweeps are the same: nothing moves"
    assert math.isnan(paper.misses.flagged_below(0.5)) and not math.isnan(default.misses.flagged_below(0.5))


def test_the_command_prints_a_line_per_setting(command: Any, script: Any, capsys: Any) -> None:
    drives = script("figures", "failure_drives")
    choice = ["--only", "crowd", "--scene-seeds", "0-0"]
    assert command.main([*choice, "--preset", "fast", "--set", "--set", "num_history=0"]) == 0
    header, _, *lines = ([cell.strip() for cell in line.split("|")[1:-1]] for line in _printed(capsys))
    shown = [dict(zip(header, line)) for line in lines]
    assert [line["setting"] for line in shown] == ["fast", "fast num_history=0"]
    staged = drives.crowd(0)
    rows = drives.body_of(staged.drive) == 0
    for line, history in zip(shown, (4, 0)):
        config = make_config("fast", num_history=history)
        (result,) = make_model(config)([window(staged.drive, drives.PAIR, history)])
        error = np.linalg.norm(result.flow.numpy() - staged.drive.labels(drives.PAIR).flow, axis=1)[rows].mean()
        assert float(line["dynamic"]) == pytest.approx(error, abs=1e-4)
        assert int(line["moving"]) == rows.sum() > 100
    assert shown[0]["ratio"] == "1.00"


def test_a_family_of_rows_and_unknown_ones(command: Any, capsys: Any) -> None:
    rows = list(command.all_rows((0, 0), [(0, 0)], None))
    assert len({row.name for row in rows}) == len(rows)
    assert len(command.chosen(rows, ["facade"])) == 10 and len(command.chosen(rows, ["crown"])) == 1
    assert command.main(["--only", "crwn"]) == 2
    assert "crown" in capsys.readouterr().err


def _printed(capsys: Any) -> List[str]:
    return capsys.readouterr().out.splitlines()
