"""`cflow bench`: what it measures and writes."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from command_line import cflow
from scenes import RANGE, scene

from cflow_torch import make_config, make_model
from cflow_torch.cli.bench import measure


def test_it_measures_total_stages_and_batches() -> None:
    model = make_model(make_config("paper", point_cloud_range=RANGE), "cpu")
    report = measure(model, [scene(1), scene(2)], repeats=3, batches=[3])
    seconds = report["seconds"]
    assert seconds["pairs"] == 6 and 0 < seconds["min"] <= seconds["median"] <= seconds["max"]
    assert set(seconds["stages"]) == {"compensate", "project", "cluster", "correlate", "pool", "spread"}
    assert 0 < sum(seconds["stages"].values()) < 1.5 * seconds["max"]
    batch = report["batches"][3]
    assert batch["windows_per_s"] == pytest.approx(3 / batch["median"])
    assert report["peak_bytes"] > 2**20


def test_the_command_writes_what_it_prints(tmp_path: Path, capsys: Any) -> None:
    data = ["data.num_sweeps=3", f"data.cache={tmp_path}", "model=paper", "pairs=5", "repeats=1", "batches=[2]"]
    assert cflow("bench", *data, f"output={tmp_path / 'out'}") == 0
    report = json.loads((tmp_path / "out" / "bench.json").read_text())
    assert report["windows"] == 2, "the log has two pairs"
    assert report["model"]["method"] == "dense"
    printed = capsys.readouterr().out
    assert f"{1000 * report['seconds']['median']:.1f}" in printed and "windows per second" in printed
