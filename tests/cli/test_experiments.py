"""Experiments: one command per table or figure of the paper, one folder per job; launchers and sweepers."""

from __future__ import annotations

import csv
import itertools
import json
import subprocess
import sys
from typing import Any, Callable

import pytest
from hydra.core.override_parser.overrides_parser import OverridesParser
from omegaconf import OmegaConf

from cflow_torch.cli.choices import FOLDER
from cflow_torch.cli.comparison import FAILED, Comparison, compare
from cflow_torch.cli.eval import objective
from cflow_torch.config import Config, make_config
from cflow_torch.data.json_file import write_json

SCALES = (0.8, 0.4, 0.3, 0.2, 0.1)
# Number of jobs of an experiment, and settings of the first and the last one.
JOBS: dict[str, tuple[int, dict[str, Any], dict[str, Any]]] = {
    "pixel_size": (4, {"pixel_sizes": (0.05,)}, {"pixel_sizes": (0.4,)}),
    "views": (2, {"sectional_view": False}, {"sectional_view": True}),
    "clustering": (2, {"clustering": "components"}, {"clustering": "hdbscan"}),
    "history": (10, {"num_history": 0, "pixel_sizes": (0.1,)}, {"num_history": 9}),
    "scales": (15, {"num_history": 0, "pixel_sizes": (0.1,)}, {"num_history": 4, "pixel_sizes": SCALES}),
    "keypoints": (6, {"method": "dense", "num_history": 0}, {"densify": "clusters", "patch_size": 41}),
    "datasets": (2, {"num_history": 4, "pixel_sizes": SCALES}, {"densify": "clusters", "patch_size": 41}),
}
JOBS["range_split"] = JOBS["datasets"]


def jobs_of(compose: Callable[..., Any], experiment: str) -> list[tuple[str, ...]]:
    whole = compose("eval", f"experiment={experiment}")
    assert str(whole.hydra.mode) == "RunMode.MULTIRUN"
    params = [f"{key}={value}" for key, value in whole.hydra.sweeper.params.items()]
    swept = OverridesParser.create().parse_overrides(params)
    choices = [[f"{o.get_key_element()}={v}" for v in o.sweep_string_iterator()] for o in swept]
    return list(itertools.product(*choices))


@pytest.mark.parametrize("experiment", [file.stem for file in FOLDER.glob("experiment/*.yaml")])
def test_the_jobs_of_an_experiment_are_the_rows_of_its_table(experiment, compose):
    far, jobs = experiment in ("datasets", "range_split"), jobs_of(compose, experiment)
    count, *ends = JOBS[experiment]
    assert len(jobs) == count
    for job, settings in zip((jobs[0], jobs[-1]), ends):
        cfg = compose("eval", f"experiment={experiment}", *job)
        config = Config.of(OmegaConf.to_container(cfg.model))
        assert {name: getattr(config, name) for name in settings} == settings
        assert config.method == ("keypoints" if "densify" in settings else "dense")
        assert config.point_cloud_range[0] == (-70 if far else -35)
        assert cfg.definition == ("challenge_2026" if far else "opensceneflow")
        assert cfg.data.label == "benchmark" and cfg.experiment_name == experiment


def test_a_sweep_keeps_every_result_and_resumes(log_folder, tmp_path, cflow, capsys):
    small = ("model.point_cloud_range=[-20,-20,-9,20,20,9]", "model.pixel_sizes=[0.4]")
    data = ("data=av2", log_folder, "data.check=false", "data.step=2", *small)
    call = ("eval", "-m", "experiment=history", *data, f"output={tmp_path}", "model.num_history=0,2")
    assert cflow(*call) == 0
    files = sorted(tmp_path.rglob("results.json"))
    names = [f"experiment=history,model.num_history={h}" for h in (0, 2)]
    assert [str(file.parent.relative_to(tmp_path)) for file in files] == names, "what is swept, without the path"
    records = [json.loads(file.read_text()) for file in files]
    assert [r["config"]["model"]["num_history"] for r in records] == [0, 2]
    assert {r["config"]["experiment_name"] for r in records} == {"history"}
    assert len({r["data"]["digest"] for r in records}) == 1, "all settings see the same windows"
    assert not [file for file in tmp_path.rglob(".*") if file.is_file()], "no temporary file is left"
    header, *rows = csv.reader((tmp_path / "comparison.csv").read_text().splitlines())
    assert header[:2] == ["model.num_history", "mean dynamic error"]
    assert [float(row[1]) for row in rows] == [objective(record["results"]) for record in records]
    titles = "| model.num_history | mean dynamic error |"
    assert capsys.readouterr().out.splitlines()[-4].startswith(titles)

    before = {file: file.stat().st_mtime_ns for file in files}
    records[1]["failures"] = [["log", "bad"]]
    files[1].write_text(json.dumps(records[1]))
    assert FAILED in compare(tmp_path)[0]
    with pytest.raises(SystemExit, match="1"):
        Comparison().on_multirun_end({"output": tmp_path, "experiment_name": None})
    files[1].unlink()  # as if it had been stopped there
    assert cflow(*call) == 0
    assert capsys.readouterr().out.count("skipped, its results exist") == 1
    assert files[0].stat().st_mtime_ns == before[files[0]] and files[1].exists()
    assert cflow(*call, "overwrite=true") == 0
    assert files[0].stat().st_mtime_ns > before[files[0]]


def test_the_comparison_has_the_settings_in_which_jobs_differ_and_names_other_data(tmp_path, capsys):
    def write(job: str, digest: str, model: Config, **config: Any) -> None:
        results = {"bucketed": {"mean": {"dynamic_error": 0.5}}, "three_way": {"epe_fd": 0.25, "epe_bs": None}}
        record = {"results": results, "seconds_per_pair": {"median": 2.0}, "data": {"digest": digest}, "failures": []}
        settings = {"output": job, "model": model.as_dict(), "definition": "av2", **config}
        (tmp_path / job).mkdir(parents=True)
        write_json(tmp_path / job / "results.json", {**record, "config": settings})

    paper = make_config("paper")
    write("model.num_history=10", "x", paper.replace(num_history=10, pixel_sizes=(0.2, 0.1)))
    write("model.num_history=2", "x", paper.replace(num_history=2))
    scores = [0.5, 0.25, 2.0]
    header, rows = compare(tmp_path)
    names = ["model.pixel_sizes", "model.num_history"]
    assert header == [*names, "mean dynamic error", "EPE FD [m]", "seconds a frame"]
    assert rows == [["[0.1]", "2", *scores], ["[0.2, 0.1]", "10", *scores]]
    write("model=live,definition=mos", "y", make_config("live"), definition="mos")
    (tmp_path / "old").mkdir()
    (tmp_path / "old" / "results.json").write_text("{}")
    header, rows = compare(tmp_path)
    assert header[:5] == ["model", *names, "definition", "scored data"]
    assert rows[0][:5] == ["live", "[0.4, 0.2, 0.1]", "4", "mos", "y"] and rows[1][0] == rows[2][0] == "paper"
    assert "old/results.json is not compared" in capsys.readouterr().out


PLUGINS = {
    "joblib_launcher": ["hydra/launcher=joblib", "hydra.launcher.n_jobs=2", "model.connectivity=4,8"],
    "submitit_launcher": ["hydra/launcher=submitit_local", "model.connectivity=4,8"],
    "optuna_sweeper": ["hydra/sweeper=optuna", "hydra.sweeper.n_trials=2", "model.max_extent=interval(5,30)"],
}


@pytest.mark.slow
@pytest.mark.parametrize("plugin", sorted(PLUGINS))
def test_sweeps_with_plugins(plugin, log_folder, tmp_path):
    pytest.importorskip(f"hydra_plugins.hydra_{plugin}")
    command = [sys.executable, "-m", "cflow_torch.cli.main", "eval", "-m", *PLUGINS[plugin], "model=paper", "data=av2"]
    call = [*command, f"data.root={log_folder}", f"output={tmp_path}"]
    done = subprocess.run(call, capture_output=True, text=True, cwd=str(tmp_path))
    assert done.returncode == 0, done.stderr
    records = [json.loads(file.read_text()) for file in tmp_path.rglob("results.json")]
    assert len(records) == 2
    if plugin == "optuna_sweeper":
        best = OmegaConf.load(tmp_path / "optimization_results.yaml")
        assert best.best_value == pytest.approx(min(objective(r["results"]) for r in records))
    else:
        assert {r["config"]["model"]["connectivity"] for r in records} == {4, 8}
