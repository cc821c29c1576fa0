"""scripts/paper: tables and figures from results files, the paper's numbers beside ours."""

from __future__ import annotations

import importlib
import json
import math
import os
import subprocess
import sys
from pathlib import Path
from typing import Any, Dict, List, Sequence, Tuple

import numpy as np
import pytest

from cflow_torch import Config, make_config
from cflow_torch.simulator import make_drive
from cflow_torch.simulator.writers.av2 import write_av2_log

ROOT = Path(__file__).resolve().parents[2]
SCRIPTS = ROOT / "scripts" / "paper"
if not SCRIPTS.is_dir():
    pytest.skip(f"no {SCRIPTS}", allow_module_level=True)
OURS = "benchmark_small (av2)"
SCALES = ((0.1,), (0.2, 0.1), (0.4, 0.2, 0.1), (0.8, 0.4, 0.2, 0.1), (0.8, 0.4, 0.3, 0.2, 0.1))
KEY_POINTS = [make_config("paper", "keypoints", densify=how) for how in ("components", "nearest", "clusters")]
# The settings of the runs of each experiment, see configs/experiment.
RUNS: Dict[str, List[Config]] = {
    "pixel_size": [make_config("paper", pixel_size=size) for size in (0.05, 0.1, 0.2, 0.4)],
    "views": [make_config("paper", sectional_view=view) for view in (False, True)],
    "clustering": [make_config("paper", clustering=name) for name in ("components", "hdbscan")],
    "history": [make_config("paper", num_history=h) for h in range(10)],
    "scales": [make_config("paper", num_history=h, pixel_sizes=sizes) for h in (0, 2, 4) for sizes in SCALES],
    "keypoints": [make_config("paper", num_history=h) for h in (0, 4)] + KEY_POINTS + [make_config("keypoints")],
    "datasets": [make_config("paper"), make_config("keypoints")],
    "range_split": [make_config("paper"), make_config("keypoints")],
}


@pytest.fixture()
def script(monkeypatch: pytest.MonkeyPatch) -> Any:
    """Imports a module of scripts/paper by name."""
    monkeypatch.syspath_prepend(str(SCRIPTS))
    for name in ("results", "plots", "pages", "tables"):
        monkeypatch.delitem(sys.modules, name, raising=False)
    return importlib.import_module


def fake_run(folder: Path, experiment: str, config: Config, error: float) -> None:
    """A results file with all errors around `error`."""
    classes = ("CAR", "OTHER_VEHICLES", "PEDESTRIAN", "WHEELED_VRU")
    scores = {name: {"dynamic_error": error + 0.01 * k} for k, name in enumerate(classes)}
    by_range = {
        n: {"classes": scores, "mean": {"dynamic_error": error + 0.2 * k}} for k, n in enumerate(("0-35", "35-70"))
    }
    model = {name: value for name, value in config.as_dict().items() if name != "point_cloud_range"}  # infinite
    record = {
        "results": {
            "bucketed": {"classes": scores, "mean": {"dynamic_error": error + 0.015}},
            "bucketed_by_range": {"ranges": by_range, "mean": {"dynamic_error": error + 0.1}},
        },
        "definition": {"name": "opensceneflow"},
        "num_pairs": 20,
        "failures": [],
        "seconds_per_pair": {"median": 0.5, "stages": {"cluster": 0.125, "correlate": 0.25, "pool": 0.0625}},
        "data": {"logs": [1, 2], "digest": "abc"},
        "config": {
            "model": model,
            "experiment_name": experiment,
            "data": {"label": "benchmark_small", "name": "benchmark", "profile": "av2"},
        },
        "versions": {"cflow_torch": "0.1.0", "torch": "2"},
        "date": "2026-01-02T03:04:05+00:00",
        "machine": {"threads": 1},
    }
    folder.mkdir(parents=True)
    (folder / "results.json").write_text(json.dumps(record))


def fake_all(root: Path, leave_out: Sequence[Tuple[str, int]] = ()) -> None:
    for experiment, configs in RUNS.items():
        for number, config in enumerate(configs):
            if (experiment, number) not in leave_out:
                fake_run(root / experiment / str(number), experiment, config, 0.1 * (number + 1))


def table(root: Path, name: str) -> List[List[str]]:
    return [line.split(",") for line in (root / "paper" / f"{name}.csv").read_text().splitlines()]


def test_the_paper_s_numbers_agree_with_themselves_and_have_a_run_each(script: Any) -> None:
    results = script("results")
    paper = results.load_paper()
    assert sorted(paper) == sorted(RUNS) == sorted(script("tables").EXPERIMENTS)
    for experiment, configs in RUNS.items():
        rows = [results.row_of(experiment, config.as_dict()) for config in configs]
        wanted = paper[experiment].get("rows", results.METHODS.values())
        assert set(wanted) <= set(rows) and len(set(rows)) == len(rows), experiment
    rounding = 1e-4 + 1e-9  # four decimals on both sides
    for name in ("pixel_size", "views", "clustering", "keypoints"):
        for row, values in paper[name]["rows"].items():
            assert abs(np.mean(values[:4]) - values[4]) <= rounding, (name, row)
    base = paper["pixel_size"]["rows"]["0.1"][:5]
    assert paper["views"]["rows"]["BEV"][:5] == paper["clustering"]["rows"]["Connected components"][:5] == base
    for h in (0, 2, 4):
        assert paper["history"]["rows"][f"h={h}"] == paper["scales"]["rows"][f"h={h}, 1 scales"]
    columns = paper["datasets"]["at"]
    for data_set, lines in paper["range_split"]["panels"].items():
        for method, (short, far) in lines.items():
            printed = paper["datasets"]["bars"][method][columns.index(data_set)]
            assert abs((short + far) / 2 - printed) <= 1e-4, (data_set, method)


def test_pages_have_the_paper_s_numbers_beside_ours_and_list_what_is_missing(
    tmp_path: Path, script: Any, capsys: pytest.CaptureFixture
) -> None:
    pytest.importorskip("matplotlib")
    fake_all(tmp_path, leave_out=(("history", 3), ("clustering", 0), ("clustering", 1)))
    (tmp_path / "broken").mkdir()
    (tmp_path / "broken" / "results.json").write_text("{")
    assert script("pages").main([str(tmp_path)]) == 0
    missing, remarks = capsys.readouterr().err.split("Remarks:")
    assert f"history, {OURS}: h=3 (cflow eval -m experiment=history" in missing and missing.count("experiment=") == 2
    assert "clustering, any data: Connected components; HDBSCAN" in missing and "broken" in remarks
    rows = {row[0]: row[2:] for row in table(tmp_path, "history") if row[1] != "paper"}
    assert rows["h=3"] == ["-"] * 6 and "-" not in rows["h=4"]
    assert table(tmp_path, "pixel_size")[3:5] == [
        ["0.1", "paper", "0.3093", "0.3458", "0.3746", "0.3799", "0.3524", "0.4674"],
        ["0.1", OURS, "0.2000", "0.2100", "0.2200", "0.2300", "0.2150", "0.5000"],
    ]
    views = table(tmp_path, "views")
    assert views[2][1:] == [OURS, "0.1000", "0.1100", "0.1200", "0.1300", "0.1150", "0.3125"]  # correlate + pool
    assert views[4][1:] == [OURS, "+0.1000", "+0.1000", "+0.1000", "+0.1000", "+0.1000", "+0.0000"]
    assert table(tmp_path, "datasets")[-2][:3] == ["CorrelationFlow", "ours", "0.2000"]
    assert table(tmp_path, "range_split")[-1][-2:] == ["0.2000", "0.4000"]
    page = (tmp_path / "paper" / "paper.md").read_text()
    assert "20 windows of 2 logs (digest abc)" in page and "tab:which_pixel_size" in page
    for name in RUNS:
        assert "\\bottomrule" in (tmp_path / "paper" / f"{name}.tex").read_text()
    for name in ("history", "scales", "datasets", "range_split"):
        assert (tmp_path / "paper" / f"{name}.png").read_bytes().startswith(b"\x89PNG") and f"({name}.png)" in page


def test_figures_hold_the_numbers(tmp_path: Path, script: Any) -> None:
    pytest.importorskip("matplotlib")
    fake_all(tmp_path, leave_out=(("history", 3),))
    results, plots = script("results"), script("plots")
    paper, (runs, _) = results.load_paper(), results.load_runs(tmp_path)
    printed, ours = plots.draw("history", paper["history"], runs["history"]).axes
    assert [list(line.get_ydata()) for line in printed.lines][0] == paper["history"]["lines"]["CAR"]
    car = ours.lines[0].get_ydata()
    assert math.isnan(car[3]) and car[4] == pytest.approx(0.5)
    figure = plots.draw("scales", paper["scales"], runs["scales"])
    assert list(figure.axes[5].lines[2].get_ydata()) == pytest.approx([1.12, 1.22, 1.32, 1.42, 1.52])  # PED, h = 4
    nothing = runs["datasets"][OURS]["CorrelationFlow"]
    for scores in nothing.record["results"]["bucketed_by_range"]["ranges"].values():
        scores["mean"]["dynamic_error"] = None  # no moving points
    for name in ("datasets", "range_split"):
        assert plots.draw(name, paper[name], {"empty": {"CorrelationFlow": nothing}}).axes


@pytest.mark.slow
def test_one_command_runs_an_experiment_and_makes_its_table(tmp_path: Path) -> None:
    log = write_av2_log(make_drive(seed=3, num_sweeps=3, profile="demo"), tmp_path / "drive")
    command = [sys.executable, str(SCRIPTS / "tables.py"), "data=av2", f"data.root={log}", f"output={tmp_path / 'out'}"]
    around: Dict[str, Any] = {"capture_output": True, "text": True, "cwd": str(ROOT)}
    around["env"] = {**os.environ, "PYTHONPATH": str(ROOT)}
    done = subprocess.run([*command, "--only", "views"], **around)
    assert done.returncode == 0, done.stderr
    assert len(list(tmp_path.glob("out/views/*/results.json"))) == 2
    assert "| +Sectional | av2 |" in (tmp_path / "out" / "paper" / "views.md").read_text()
    wrong = subprocess.run([*command, "history"], **around)
    assert wrong.returncode == 2 and "NAME=VALUE" in wrong.stderr
