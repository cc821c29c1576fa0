"""Experiments: one command per table and figure of the paper, resumable, and what is made of their results."""

from __future__ import annotations

import importlib
import itertools
import json
import os
import subprocess
import shutil
import sys
import time
from pathlib import Path
from types import ModuleType
from typing import Any, Dict, List

import cflow_torch.configs
import numpy as np
import pytest
import torch
from hydra import compose, initialize_config_module
from hydra.core.override_parser.overrides_parser import OverridesParser
from omegaconf import OmegaConf
from torch.profiler import record_function

from cflow_torch import CFlowError, Config
from cflow_torch.cli.eval import objective
from cflow_torch.cli.main import main
from cflow_torch.cli.run import _folder_name
from cflow_torch.data.av2 import AV2Log
from cflow_torch.data.log import window
from cflow_torch.simulator import benchmark, make_drive
from cflow_torch.simulator.benchmark import benchmark_logs
from cflow_torch.simulator.writers.av2 import write_av2_log
from cflow_torch.stages import StopWatch

CONFIGS = Path(cflow_torch.configs.__file__).parent
EXPERIMENTS = sorted(file.stem for file in CONFIGS.glob("experiment/*.yaml"))
SCRIPTS = Path(__file__).resolve().parents[2] / "scripts"
TUNING_SEEDS = {*range(100, 104), *range(200, 210)}
RANGES = ("0-35", "35-70")


@pytest.fixture(scope="module")
def log_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A small simulated log in Argoverse 2's format: three pairs."""
    return write_av2_log(make_drive(seed=3, num_sweeps=4), tmp_path_factory.mktemp("drive"))


@pytest.fixture()
def script(monkeypatch: pytest.MonkeyPatch) -> Any:
    """Imports a module of scripts/ by name."""
    monkeypatch.syspath_prepend(str(SCRIPTS))
    return importlib.import_module


@pytest.fixture(autouse=True)
def _same_argv(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "argv", list(sys.argv))


def run(*arguments: object) -> int:
    """Exit status of a command."""
    try:
        main([str(argument) for argument in arguments])
    except SystemExit as stop:
        return int(stop.code or 0)
    return 0


def results_of(folder: Path) -> Dict[str, Any]:
    """results.json as strict JSON."""

    def refuse(constant: str) -> None:
        raise AssertionError(f"{constant} is no JSON")

    return json.loads((folder / "results.json").read_text(), parse_constant=refuse)


def jobs_of(experiment: str, *overrides: str) -> List[Any]:
    """Resolved settings of every job of an experiment's sweep."""
    with initialize_config_module("cflow_torch.configs", version_base="1.3"):
        whole = compose("eval", [f"experiment={experiment}", *overrides], return_hydra_config=True)
        assert str(whole.hydra.mode) == "RunMode.MULTIRUN"
        params = [f"{key}={value}" for key, value in whole.hydra.sweeper.params.items()]
        swept = OverridesParser.create().parse_overrides(params)
        choices = [[f"{o.get_key_element()}={v}" for v in o.sweep_string_iterator()] for o in swept]
        return [compose("eval", [f"experiment={experiment}", *overrides, *job]) for job in itertools.product(*choices)]


# ---------------------------------------------------------------- the experiments and the tables they fill


@pytest.mark.parametrize("experiment", EXPERIMENTS)
def test_the_jobs_of_an_experiment_are_the_rows_of_its_table(experiment: str, script: Any) -> None:
    results = script("paper_results")
    about = results.load_paper()[experiment]
    rows = []
    for job in jobs_of(experiment):
        assert job.experiment_name == experiment
        model = OmegaConf.to_container(job.model, resolve=True)
        Config(**model)  # valid
        rows.append(results.row_of(experiment, model))
    expected = list(about["rows"]) if "rows" in about else list(results.METHODS.values())
    ours = {*results.DENSIFIED.values(), results.PRESET}  # a table may have rows of our own
    assert sorted(row for row in rows if row in expected or row not in ours) == sorted(expected)


def test_every_table_and_figure_of_the_paper_has_an_experiment_and_the_script_runs_them_all(script: Any) -> None:
    assert sorted(script("paper_results").load_paper()) == EXPERIMENTS == sorted(script("paper").EXPERIMENTS)


@pytest.mark.parametrize("experiment", EXPERIMENTS)
def test_every_experiment_runs_on_any_data(experiment: str) -> None:
    (small, *_) = jobs_of(experiment, "data=benchmark_small")
    (real, *_) = jobs_of(experiment, "data=av2", "data.root=/somewhere")
    assert small.data.label == "benchmark_small" and real.data.root == "/somewhere"


# ---------------------------------------------------------------- one folder per job, resumable


def test_a_sweep_keeps_every_result_and_goes_on_where_it_stopped(
    log_folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    data = ("data=av2", f"data.root={log_folder}")
    call = ("eval", "-m", "experiment=history", *data, f"output={tmp_path}")
    assert run(*call, "model.num_history=0,2") == 0
    files = sorted(tmp_path.rglob("results.json"))
    assert len(files) == 2 and len({file.parent for file in files}) == 2
    records = [results_of(file.parent) for file in files]
    assert [r["config"]["model"]["num_history"] for r in records] == [0, 2]
    assert all(file.parent.parent.name == "history" for file in files)
    assert len({r["data"]["digest"] for r in records}) == 1, "all settings see the same windows"
    assert not [file for file in tmp_path.rglob(".*") if file.is_file()], "no temporary file is left"
    capsys.readouterr()

    before = {file: file.stat().st_mtime_ns for file in files}
    files[1].unlink()  # as if it had been stopped there
    assert run(*call, "model.num_history=0,2") == 0
    assert capsys.readouterr().out.count("skipped, done before") == 1
    assert files[0].stat().st_mtime_ns == before[files[0]] and files[1].exists()
    assert run(*call, "model.num_history=0,2", "overwrite=true") == 0
    assert files[0].stat().st_mtime_ns > before[files[0]]


def test_another_config_in_the_same_folder_is_an_error_that_says_so(
    log_folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    call = ("eval", "data=av2", f"data.root={log_folder}", f"output={tmp_path}", "model=paper")
    assert run(*call) == 0
    first = (tmp_path / "results.json").read_bytes()
    assert run(*call, "device=cpu", "data.step=2") == 2
    error = capsys.readouterr().err
    assert "config.data.step was 1, is 2" in error and "config.device was auto" in error and "overwrite=true" in error
    (tmp_path / "results.json").write_bytes(first.replace(b'"torch": "', b'"torch": "0.'))
    assert run(*call) == 2 and "versions.torch" in capsys.readouterr().err
    (tmp_path / "results.json").write_bytes(first[:1000])
    assert run(*call) == 2 and "no results file" in capsys.readouterr().err
    assert run(*call, "overwrite=true") == 0
    assert run(*call, "data.step=0", "overwrite=true") == 2 and "data.step=0" in capsys.readouterr().err


def test_where_a_run_lies_does_not_matter(log_folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    call = ("eval", "data=av2", f"data.root={log_folder}", "model=paper")
    assert run(*call, f"output={tmp_path / 'a'}") == 0
    (tmp_path / "a").rename(tmp_path / "b")
    assert run(*call, f"output={tmp_path / 'b'}") == 0
    assert "skipped" in capsys.readouterr().out


def test_folder_names_are_safe_and_different() -> None:
    texts = ["a=1,b=2", "a=1,b=[0.4,0.2]", "data.root=/a/b", "data.root=_a_b", "data.root=/a_b", "x" * 400, "x" * 401]
    names = [_folder_name(text) for text in texts]
    assert len(set(names)) == len(texts)
    assert names[:2] == texts[:2], "readable where it can be"
    assert all(len(name) < 200 and "/" not in name for name in names)
    assert _folder_name("..") not in (".", "..")


def test_a_results_file_says_everything(log_folder: Path, tmp_path: Path) -> None:
    assert run("eval", "data=av2", f"data.root={log_folder}", f"output={tmp_path}", "model=paper", "data.first=1") == 0
    record = results_of(tmp_path)
    assert record["num_pairs"] == record["results"]["num_frames"] == 2  # pairs 1 and 2
    assert record["results"]["definition"] == record["definition"]["name"] == "opensceneflow"
    assert record["definition"]["region"] == "disc" and record["definition"]["speed_edges"][-1] == "inf"
    assert {"bucketed", "three_way", "range_wise", "num_points"} <= set(record["results"])
    assert set(record["versions"]) == {"cflow_torch", "torch", "numpy", "python"}
    assert record["config"]["model"]["pixel_sizes"] == [0.1] and record["date"].startswith("20")
    assert record["data"]["logs"] == [{"log_id": log_folder.name, "sweeps": 4}] and len(record["data"]["digest"]) == 16
    times = record["seconds_per_pair"]
    assert 0 < times["min"] <= times["median"] <= times["max"] and times["pairs"] == 1
    assert {"cluster", "correlate"} <= set(times["stages"])
    assert sum(times["stages"].values()) < times["max"]
    assert record["failures"] == []


def test_real_hdf5_data(kitti_file: Path, tmp_path: Path) -> None:
    pytest.importorskip("h5py")
    assert run("eval", "data=hdf5", f"data.root={kitti_file}", f"output={tmp_path}", "model=paper") == 0
    record = results_of(tmp_path)
    assert record["num_pairs"] == 15
    car = record["results"]["bucketed"]["classes"]["CAR"]
    assert car["num_dynamic"] > 1000 and 0.05 < car["dynamic_error"] < 0.3


def test_the_score_of_a_sweep() -> None:
    mean = {"mean": {"dynamic_error": 0.25}}
    assert objective({"bucketed": mean, "three_way": {"epe_3way": 1.0}}) == 0.25
    assert objective({"bucketed": mean, "bucketed_by_range": {"mean": {"dynamic_error": 0.5}}}) == 0.5
    assert objective({"three_way": {"epe_3way": 1.0}}) == 1.0
    assert np.isnan(objective({"bucketed": {"mean": {"dynamic_error": None}}}))


def test_the_stop_watch_times_pairs_and_stages() -> None:
    class Sleeper:
        config = Config()
        calls = 0

        def __call__(self, _: Any) -> List[Any]:
            self.calls += 1
            for _ in range(2):
                with record_function("cluster"):
                    time.sleep(0.2 if self.calls == 1 else 0.01)
            time.sleep(0.01)
            return []

    watch = StopWatch(Sleeper())
    for _ in range(3):
        watch([])
    with record_function("cluster"):  # the ordinary one is back
        assert torch.ones(1).sum() == 1
    times = watch.report()
    assert times["pairs"] == 2 and times["max"] < 0.4, "the first pair does not count"
    assert 0.02 <= times["stages"]["cluster"] < times["median"] - 0.009


# ---------------------------------------------------------------- launchers and sweepers

PLUGINS = {
    "joblib": (
        "hydra_plugins.hydra_joblib_launcher",
        ["hydra/launcher=joblib", "hydra.launcher.n_jobs=2", "model.connectivity=4,8"],
    ),
    "submitit": ("hydra_plugins.hydra_submitit_launcher", ["hydra/launcher=submitit_local", "model.connectivity=4,8"]),
    "optuna": (
        "hydra_plugins.hydra_optuna_sweeper",
        ["hydra/sweeper=optuna", "hydra.sweeper.n_trials=2", "model.max_extent=interval(5,30)"],
    ),
}


@pytest.mark.slow
@pytest.mark.parametrize("plugin", sorted(PLUGINS))
def test_sweeps_with_plugins(plugin: str, log_folder: Path, tmp_path: Path) -> None:
    module, settings = PLUGINS[plugin]
    pytest.importorskip(module)
    command = [sys.executable, "-m", "cflow_torch.cli.main", "eval", "-m", *settings, "model=paper", "data=av2"]
    done = subprocess.run(
        [*command, f"data.root={log_folder}", f"output={tmp_path}"],
        capture_output=True,
        text=True,
        cwd=str(SCRIPTS.parent),
    )
    assert done.returncode == 0, done.stderr
    records = [results_of(file.parent) for file in tmp_path.glob("*/results.json")]
    assert len(records) == 2
    if plugin == "optuna":
        best = OmegaConf.load(tmp_path / "optimization_results.yaml")
        assert best.best_value == pytest.approx(min(objective(r["results"]) for r in records))
    else:
        assert {r["config"]["model"]["connectivity"] for r in records} == {4, 8}


# ---------------------------------------------------------------- the synthetic benchmark


def test_the_benchmark_is_large_enough_and_apart_from_tuning_data() -> None:
    with initialize_config_module("cflow_torch.configs", version_base="1.3"):
        full, small = (compose("eval", [f"data={name}"]).data for name in ("benchmark", "benchmark_small"))
    counts = []
    for data in (full, small):
        windows = range(data.first, data.num_sweeps - 1, data.step)
        assert windows[0] >= 9, "every window has nine older sweeps"
        counts.append(len(windows) * data.num_drives)
    assert counts[0] >= 200 and 15 <= counts[1] <= 30
    assert (full.first_seed, full.num_sweeps) == (small.first_seed, small.num_sweeps), "the small one is part of it"
    assert not TUNING_SEEDS & set(range(full.first_seed, full.first_seed + full.num_drives))


def test_a_benchmark_drive_is_made_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    first = benchmark_logs(tmp_path, "demo", [1, 2], 3)
    drive = make_drive(seed=2, num_sweeps=3, profile="demo")
    log = AV2Log(first[1])  # sources of data=av2 are folders
    assert log.log_id == drive.log_id and list(log.timestamps) == list(drive.timestamps)
    np.testing.assert_array_equal(window(log, 1).pc0.points, drive.sweep(1).points.astype(np.float16))
    stamps = {file: file.stat().st_mtime_ns for file in tmp_path.rglob("*.feather")}
    (first[0].parent / ".making-x" / "synthetic-demo-0003").mkdir(parents=True)  # left over from a run that was killed
    again = benchmark_logs(tmp_path, "demo", [1, 2, 3], 3)
    assert again[:2] == first and len(list(again[2].rglob("*.feather"))) > 3
    assert {file: file.stat().st_mtime_ns for file in stamps} == stamps
    monkeypatch.setattr(benchmark, "generator_key", lambda: "other")
    assert benchmark_logs(tmp_path, "demo", [1], 3)[0] != first[0], "a changed generator makes new drives"
    with pytest.raises(CFlowError, match="profile"):
        benchmark_logs(tmp_path, "none", [1], 3)


def test_the_generator_key_depends_on_the_generator(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    source = benchmark._HERE
    shutil.copytree(source, tmp_path, dirs_exist_ok=True)
    monkeypatch.setattr(benchmark, "_HERE", tmp_path)
    key = benchmark.generator_key()
    monkeypatch.undo()
    assert key == benchmark.generator_key()
    (tmp_path / "street.py").write_bytes((source / "street.py").read_bytes() + b"\n")
    monkeypatch.setattr(benchmark, "_HERE", tmp_path)
    assert key != benchmark.generator_key()


# ---------------------------------------------------------------- the paper's numbers


@pytest.fixture()
def paper(script: Any) -> Dict[str, Any]:
    return script("paper_results").load_paper()


def test_the_paper_s_tables_agree_with_themselves(paper: Dict[str, Any]) -> None:
    rounding = 1e-4 + 1e-9  # four decimals on both sides
    for name in ("pixel_size", "views", "clustering", "keypoints"):
        for row, values in paper[name]["rows"].items():
            assert abs(np.mean(values[:4]) - values[4]) <= rounding, (name, row)
    base = paper["pixel_size"]["rows"]["0.1"][:5]
    assert paper["views"]["rows"]["BEV"][:5] == paper["clustering"]["rows"]["Connected components"][:5] == base
    assert paper["keypoints"]["rows"]["CorrelationFlow (h=0)"] == base


def test_the_paper_s_figures_agree_with_each_other(paper: Dict[str, Any]) -> None:
    for h in (0, 2, 4):
        assert paper["history"]["rows"][f"h={h}"] == paper["scales"]["rows"][f"h={h}, 1 scales"]
    # What the table calls h=4 is the figure's h=3.
    np.testing.assert_allclose(
        paper["keypoints"]["rows"]["CorrelationFlow (h=4)"], paper["history"]["rows"]["h=3"], atol=6e-5
    )
    for values in paper["datasets"]["bars"].values():
        assert abs(np.mean(values[1:]) - values[0]) <= 1e-4
    columns = paper["datasets"]["at"]
    for data_set, lines in paper["range_split"]["panels"].items():
        for method, (short, far) in lines.items():
            printed = paper["datasets"]["bars"][method][columns.index(data_set)]
            assert abs((short + far) / 2 - printed) <= 1e-4, (data_set, method)


# ---------------------------------------------------------------- tables and figures from results files


def fake_run(folder: Path, job: Any, error: float) -> None:
    """A results file of a job, all errors around `error`."""
    classes = ("CAR", "OTHER_VEHICLES", "PEDESTRIAN", "WHEELED_VRU")
    scores = {name: {"dynamic_error": error + 0.01 * k} for k, name in enumerate(classes)}
    by_range = {name: {"classes": scores, "mean": {"dynamic_error": error + 0.2 * k}} for k, name in enumerate(RANGES)}
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
        "config": OmegaConf.to_container(job, resolve=True),
        "versions": {"cflow_torch": "0.1.0", "torch": "2"},
        "date": "2026-01-02T03:04:05+00:00",
        "machine": {"threads": 1},
    }
    record["config"]["model"].pop("point_cloud_range")  # infinite, not needed here
    folder.mkdir(parents=True)
    (folder / "results.json").write_text(json.dumps(record))


def fake_all(root: Path, leave_out: tuple = ()) -> None:
    for experiment in EXPERIMENTS:
        for number, job in enumerate(jobs_of(experiment, "data=benchmark_small")):
            if (experiment, number) not in leave_out:
                fake_run(root / experiment / str(number), job, 0.1 * (number + 1))


def table(root: Path, name: str) -> List[List[str]]:
    return [line.split(",") for line in (root / "paper" / f"{name}.csv").read_text().splitlines()]


def test_tables_have_the_paper_s_numbers_beside_ours(tmp_path: Path, script: Any, capsys: Any) -> None:
    pytest.importorskip("matplotlib")
    fake_all(tmp_path)
    assert script("paper_tables").main([str(tmp_path)]) == 0
    captured = capsys.readouterr()
    assert "Missing" not in captured.err
    ours = "benchmark_small (av2)"
    assert table(tmp_path, "pixel_size")[3:5] == [
        ["0.1", "paper", "0.3093", "0.3458", "0.3746", "0.3799", "0.3524", "0.4674"],
        ["0.1", ours, "0.2000", "0.2100", "0.2200", "0.2300", "0.2150", "0.5000"],
    ]
    views = table(tmp_path, "views")
    assert views[2][1:] == [ours, "0.1000", "0.1100", "0.1200", "0.1300", "0.1150", "0.3125"]  # correlate + pool
    assert views[4][1:] == [ours, "+0.1000", "+0.1000", "+0.1000", "+0.1000", "+0.1000", "+0.0000"]
    assert table(tmp_path, "clustering")[2][-1] == "0.1250"
    datasets = table(tmp_path, "datasets")
    assert datasets[0][-1] == ours and datasets[1][:3] == ["CorrelationFlow", "paper", "0.4440"]
    assert datasets[-2][:3] + datasets[-2][-1:] == ["CorrelationFlow", "ours", "0.2000", "0.2000"]
    assert table(tmp_path, "range_split")[-1][-2:] == ["0.2000", "0.4000"]
    page = (tmp_path / "paper" / "paper.md").read_text()
    assert "20 windows of 2 logs (digest abc)" in page and "tab:which_pixel_size" in page
    for name in EXPERIMENTS:
        assert "\\bottomrule" in (tmp_path / "paper" / f"{name}.tex").read_text()
    for name in ("history", "scales", "datasets", "range_split"):
        assert (tmp_path / "paper" / f"{name}.png").read_bytes().startswith(b"\x89PNG")
        assert (tmp_path / "paper" / f"{name}.pdf").read_bytes().startswith(b"%PDF")
        assert f"({name}.png)" in page


def test_missing_runs_are_listed(tmp_path: Path, script: Any, capsys: Any) -> None:
    fake_all(tmp_path, leave_out=(("history", 3), ("clustering", 0), ("clustering", 1), ("datasets", 1)))
    (tmp_path / "broken").mkdir()
    (tmp_path / "broken" / "results.json").write_text("{")
    assert script("paper_tables").main([str(tmp_path)]) == 0
    missing, remarks = capsys.readouterr().err.split("Remarks:")
    assert "history, benchmark_small (av2): h=3 (cflow eval -m experiment=history" in missing
    assert "clustering, any data: Connected components; HDBSCAN" in missing
    assert "CorrelationFlow-Keypoint" in missing and "broken" in remarks
    assert missing.count("experiment=") == 3
    rows = {row[0]: row[2:] for row in table(tmp_path, "history") if row[1] != "paper"}
    assert rows["h=3"] == ["-"] * 6 and "-" not in rows["h=4"]
    assert "Missing runs" in (tmp_path / "paper" / "paper.md").read_text()


def test_figures_hold_the_numbers(tmp_path: Path, script: Any) -> None:
    pytest.importorskip("matplotlib")
    fake_all(tmp_path, leave_out=(("history", 3),))
    results, plots = script("paper_results"), script("paper_plots")
    paper, (runs, _) = results.load_paper(), results.load_runs(tmp_path)
    figure = plots.draw("history", paper["history"], runs["history"])
    printed, ours = figure.axes
    assert [list(line.get_ydata()) for line in printed.lines][0] == paper["history"]["lines"]["CAR"]
    car = ours.lines[0].get_ydata()
    assert np.isnan(car[3]) and car[4] == pytest.approx(0.5)
    assert ours.get_ylim()[1] > 1 and printed.get_ylim() == ours.get_ylim()
    figure = plots.draw("scales", paper["scales"], runs["scales"])
    assert [axes.get_title() for axes in figure.axes] == ["Car", "Pedestrian", "VRU", "Other"] * 2
    assert list(figure.axes[5].lines[2].get_ydata()) == pytest.approx([1.12, 1.22, 1.32, 1.42, 1.52])  # PED, h = 4
    nothing = runs["datasets"]["benchmark_small (av2)"]["CorrelationFlow"]
    for scores in nothing.record["results"]["bucketed_by_range"]["ranges"].values():
        scores["mean"]["dynamic_error"] = None  # no moving points
    for name in ("datasets", "range_split"):
        assert plots.draw(name, paper[name], {}).axes  # the paper alone
        assert plots.draw(name, paper[name], {"empty": {"CorrelationFlow": nothing}}).axes
    assert [axes.get_title() for axes in plots.draw("range_split", paper["range_split"], runs["range_split"]).axes][:2]


@pytest.mark.slow
def test_paper_script_passes_settings_on(log_folder: Path, tmp_path: Path) -> None:
    command = [sys.executable, str(SCRIPTS / "paper.py"), "data=av2", f"data.root={log_folder}", f"output={tmp_path}"]
    environment = {**os.environ, "PYTHONPATH": str(SCRIPTS.parent)}
    done = subprocess.run(
        [*command, "--only", "views"], capture_output=True, text=True, env=environment, cwd=str(SCRIPTS.parent)
    )
    assert done.returncode == 0, done.stderr
    assert len(list(tmp_path.glob("views/*/results.json"))) == 2
    assert "| +Sectional | av2 |" in (tmp_path / "paper" / "views.md").read_text()
    wrong = subprocess.run([*command, "history"], capture_output=True, text=True, env=environment)
    assert wrong.returncode == 2 and "NAME=VALUE" in wrong.stderr


def test_scripts_are_importable_modules(script: Any) -> None:
    for name in ("paper", "paper_tables", "paper_results"):
        assert isinstance(script(name), ModuleType)
