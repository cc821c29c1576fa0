"""The table of targets: every row is measured or says why not, and is judged by the right side of its target."""

from __future__ import annotations

import json
from dataclasses import asdict, replace

import numpy as np
import pytest
import torch
from scenes import scene

from cflow_torch.bench import clustering, targets, targets_gpu
from cflow_torch.bench.measure import plain_config, run_bench
from cflow_torch.bench.table import format_targets
from cflow_torch.bench.target_row import FULL, NAMES, PAIR, WIDE, Bench, Row, against
from cflow_torch.bench.targets import measure_targets
from cflow_torch.bench.targets_gpu import batch_rows
from cflow_torch.bench.throughput import measure_throughput
from cflow_torch.types import CFlowError, Window

pytest.importorskip("cv2")
SETTINGS = {"repeats": 2, "num_threads": 1, "device": "cpu"}


@pytest.fixture(scope="module")
def window() -> Window:
    return scene(0, num_history=4)


@pytest.fixture(scope="module")
def report(window):
    return run_bench([window], {"pair": PAIR}, with_reference=False, **SETTINGS)


@pytest.fixture(scope="module")
def rows(window, report):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(targets, "measure_hdbscan", lambda window, config: 3.5)
        return measure_targets(window, report, batches=(1, 3), **SETTINGS)


def row_of(rows, what) -> Row:
    (row,) = (row for row in rows if row.what == what)
    return row


def test_every_row_is_measured_or_says_why(rows):
    assert len(rows) == 7 + 2 * 3 + 3 + 3 + 4 + 1
    for row in rows:
        assert (row.ours is None) == bool(row.why), row
        assert (row.met is None) == (not row.target or row.ours is None), row
    json.dumps([asdict(row) for row in rows], allow_nan=False)


def test_ratios_are_theirs_over_ours(rows, report):
    entry = report["results"]["pair"]
    row = row_of(rows, f"{NAMES[PAIR]}, one window")
    assert row.ratio == entry["opencv_over_fast"] and row.met == (row.ratio >= 2)
    assert row.ours == 1000 * entry["fast"]["median_s"] and row.theirs == 1000 * entry["opencv"]["median_s"]
    bare, density = (row for row in rows if row.what.startswith("clustering"))
    assert bare.ratio == entry["clustering"]["dilate_and_label_over_fast"]
    assert density.theirs == 3500 and density.ratio == pytest.approx(3500 / density.ours)
    assert density.met and density.competitor.startswith("HDBSCAN")


def test_what_the_report_holds_is_not_measured_again(window, report):
    bench = Bench(window, report, with_opencv=True, **SETTINGS)
    assert bench.entry(PAIR) is report["results"]["pair"]
    wide = bench.entry(WIDE)
    assert wide["config"] == plain_config(WIDE) and bench.entry(WIDE) is wide


def test_rows_with_history_need_a_long_log(window, report, monkeypatch):
    monkeypatch.setattr(targets, "measure_hdbscan", lambda window, config: "hdbscan is not installed")
    pair = replace(window, pch=window.pch[:1])
    rows = measure_targets(pair, report, batches=(), with_opencv=True, **SETTINGS)
    why = "3 sweeps, 6 are needed"
    assert row_of(rows, f"{NAMES[FULL]}, one window").why == why
    assert row_of(rows, f"memory above the input, {NAMES[FULL]}").why == why
    assert row_of(rows, f"{NAMES[FULL]}, batch 32, one GPU").why == why
    assert row_of(rows, f"{NAMES[PAIR]}, batch 32, one GPU").why == "no GPU here"
    assert [row.why for row in rows if row.competitor.startswith("HDBSCAN")] == ["hdbscan is not installed"]
    assert "max_memory = 100 MB, h = 0" in rows[-2].what and rows[-2].met


def test_a_ratio_on_the_edge_meets_its_target():
    assert against("a", 0.1, "b", 0.2, 2.0, 2.0) == Row("a", "ms", 100.0, "b", 200.0, 2.0, ">= 2", True)
    assert against("a", {"median_s": 0.1}, "b", 0.2, 1.99, 2.0).met is False
    assert against("a", 0.1, "b", "not installed", None, 2.0).why == "not installed"


def test_a_gpu_is_judged_by_its_own_targets(window, report, monkeypatch):
    # No GPU needed: the machine says it has one, the figures are made up.
    there = {**report, "machine": {**report["machine"], "device": "some GPU"}}
    bench = Bench(window, there, with_opencv=True, **SETTINGS)
    figures = {1: {"median_s": 0.016, "windows_per_s": 62.5}, 32: {"median_s": 0.1, "windows_per_s": 320.0}}
    monkeypatch.setattr(targets_gpu, "measure_throughput", lambda *_: figures)
    judged = {(row.what, row.unit): (row.target, row.met) for row in batch_rows(bench, (1, 32)) if row.target}
    assert judged == {
        (f"{NAMES[FULL]}, batch 1", "ms"): ("<= 15 ms", False),
        (f"{NAMES[FULL]}, batch 32", "windows/s"): (">= 300 windows/s", True),
        (f"{NAMES[PAIR]}, batch 32", "windows/s"): (">= 2000 windows/s", False),
    }
    row = bench.for_cpu(Row("a", "ms", 1.0, target=">= 2", met=True))
    assert (row.target, row.met) == ("", None)


def test_devices_are_compared(window, report, monkeypatch):
    there = {**report, "machine": {**report["machine"], "device": "some GPU"}}
    bench = Bench(window, there, with_opencv=True, **SETTINGS)  # both sides on the CPU: the same bits
    assert [row.met for row in targets_gpu.device_rows(bench)] == [True] * 3

    def wrong(config, device):
        def model(windows):
            (result,) = make_model(config, "cpu")(windows)
            return [replace(result, score=result.score + (device != "cpu"))]

        return model

    make_model = targets_gpu.make_model
    monkeypatch.setattr(targets_gpu, "make_model", wrong)
    bench.device = "auto"
    for row in targets_gpu.device_rows(bench):
        assert row.met is False and row.why == "differ: score"


def test_table_of_targets(rows):
    lines = format_targets(rows).splitlines()
    assert len(lines) == 2 + len(rows)
    assert len({line.count("|") for line in lines}) == 1
    line = format_targets([Row("a", "ms", 1.0, "b", 3.0, 3.0, ">= 2", True)]).splitlines()[-1]
    assert line == "| a | 1.0 ms | b | 3.0 ms | 3.00 | >= 2 | yes |  |"
    line = format_targets([Row("a", "ms", target="<= 15 ms", why="no GPU here")]).splitlines()[-1]
    assert line == "| a |  |  |  |  | <= 15 ms | ? | no GPU here |"


def test_throughput_counts_windows(window, monkeypatch):
    sizes = []

    def fake(config, device):
        def model(windows):
            sizes.append(len(windows))
            return [type("Result", (), {"flow": torch.zeros(1)})]

        return model

    monkeypatch.setattr("cflow_torch.bench.throughput.make_model", fake)
    measured = measure_throughput([window], PAIR, (1, 5), repeats=3)
    assert sizes == [1] * 4 + [5] * 4
    assert measured[5]["windows_per_s"] == pytest.approx(5 / measured[5]["median_s"])
    assert measured[5]["runs"] == 3


def test_missing_hdbscan_is_said(window, monkeypatch):
    def absent(points, min_cluster_size):
        raise CFlowError("absent")

    monkeypatch.setattr(clustering, "hdbscan_labels", absent)
    assert clustering.measure_hdbscan(replace(window, pch=()), PAIR) == "hdbscan is not installed"


def test_hdbscan_is_timed_on_all_points(window, monkeypatch):
    seen = []
    monkeypatch.setattr(clustering, "hdbscan_labels", lambda points, size: seen.append(len(points)))
    assert clustering.measure_hdbscan(replace(window, pch=()), PAIR) > 0
    sweeps = (window.pc0, window.pc1)
    assert seen[-1] == sum(int((~s.is_ground & np.isfinite(s.points).all(1)).sum()) for s in sweeps)
