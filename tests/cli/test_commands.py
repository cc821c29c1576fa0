"""demo, flow, eval and bench as a user runs them: their output, and their errors."""

from __future__ import annotations

import json
import os
import platform
import re
import shutil
import signal
import sys
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Callable

import numpy as np
import pytest
from omegaconf import OmegaConf
from small_logs import write_small_log

from cflow_torch import make_config
from cflow_torch.cli import demo, failures, pairs
from cflow_torch.cli.comparison import summary
from cflow_torch.cli.eval import objective
from cflow_torch.config import Config
from cflow_torch.data.av2 import AV2Log
from cflow_torch.viz import page
from cflow_torch.windows import memory

SMALL = "model.point_cloud_range=[-20,-20,-inf,20,20,inf]"


def results_of(folder: Path) -> dict[str, Any]:
    """results.json as strict JSON, which has no NaN."""
    return json.loads((folder / "results.json").read_text(), parse_constant=pytest.fail)


@pytest.fixture
def evaluate(cflow: Callable[..., int], log_folder: Path, tmp_path: Path) -> Callable[..., int]:
    """`cflow eval` of the small log into `tmp_path`, by the paper's method."""
    data = ("data=av2", f"data.root={log_folder}", "data.check=false", f"output={tmp_path}")
    call = ("eval", *data, "model=paper", SMALL)
    return lambda *arguments: cflow(*call, *arguments)


def test_demo_writes_all_its_files(tmp_path, cache, cflow, capsys, monkeypatch):
    pytest.importorskip("matplotlib")
    monkeypatch.chdir(tmp_path)
    assert cflow("demo", f"output={tmp_path}", "data.num_sweeps=2", "pair=0", "model.num_history=0", SMALL) == 0
    (log,) = (AV2Log(folder) for folder in cache.glob("*-2/*/*"))
    assert [file.stem for file in (tmp_path / log.log_id).iterdir()] == [str(log.timestamps[0])]
    scores = results_of(tmp_path)
    assert scores["results"]["num_frames"] == 1 and 0 < scores["results"]["three_way"]["epe_fd"] < 2
    left: Any = OmegaConf.to_container(OmegaConf.load(tmp_path / "config.yaml").model)
    region = (-20.0, -20.0, -np.inf, 20.0, 20.0, np.inf)
    assert Config.of(left) == make_config(num_history=0, point_cloud_range=region)
    assert (tmp_path / "flow.png").read_bytes().startswith(b"\x89PNG")
    printed = capsys.readouterr().out
    assert re.search("^mean dynamic error 0[.]", printed, re.MULTILINE)  # Python 3.8 has no k3d, which is said before
    assert f"picture: {tmp_path / 'flow.png'}" in printed and "CAR" in printed
    if find_spec("k3d"):
        assert f"3-D page, for any browser: {tmp_path / 'flow.html'}" in printed
        assert '"preset":"default"' in (tmp_path / "flow.html").read_text(encoding="utf-8")
    assert not list(tmp_path.rglob(".*")), "no temporary file is left"
    again = tmp_path / "again"
    assert cflow("demo", "--config-dir", tmp_path, "--config-name", "config", f"output={again}") == 0
    assert results_of(again)["results"] == scores["results"]
    assert not (tmp_path / "outputs").exists() and not list(tmp_path.glob("*.log")), "Hydra writes no files"
    if find_spec("k3d"):
        assert (again / "flow.html").read_bytes() == (tmp_path / "flow.html").read_bytes()


def test_demo_without_the_extras_lacks_only_picture_and_page(tmp_path, cflow, monkeypatch, capsys):
    for name in ("matplotlib", "matplotlib.figure", "matplotlib.backends.backend_agg"):
        monkeypatch.setitem(sys.modules, name, None)
    monkeypatch.setattr(page, "find_spec", lambda name: None)
    assert cflow("demo", f"output={tmp_path}", "data.num_sweeps=2", "pair=0", "model=paper", SMALL) == 0
    printed = capsys.readouterr()
    assert printed.out.startswith("no picture (") and "pip install matplotlib" in printed.out and not printed.err
    assert results_of(tmp_path)["num_pairs"] == 1 and not list(tmp_path.glob("flow.*"))
    assert "no page (" in printed.out and "k3d" in printed.out


def test_the_page_and_the_picture_of_a_demo_show_the_first_log(log_folder, tmp_path, cflow, monkeypatch, capsys):
    pytest.importorskip("matplotlib")
    for name in ("a", "b"):
        shutil.copytree(log_folder, tmp_path / "logs" / name)
    pages: list[Any] = []
    monkeypatch.setattr(demo, "load_k3d", lambda: None)
    monkeypatch.setattr(demo, "save_page", lambda log, results, *_, **__: pages.append((log.log_id, len(results))))
    titles: list[str] = []
    plot = demo.plot_flow
    monkeypatch.setattr(
        demo, "plot_flow", lambda *given, title, **view: (titles.append(title), plot(*given, **view))[1]
    )
    monkeypatch.setattr(AV2Log, "gaps", frozenset({2}))
    data = ("data=av2", f"data.root={tmp_path / 'logs'}", "data.check=false")
    call = ("demo", *data, f"output={tmp_path / 'out'}", "model=paper", SMALL)
    assert cflow(*call, "pair=2") == 2 and "has pairs 0 to 2, without 2 (gaps)" in capsys.readouterr().err
    assert cflow(*call, "pair=1") == 0
    assert pages == [("a", 2)] and titles == ["CorrelationFlow, a"]
    assert results_of(tmp_path / "out")["num_pairs"] == 4, "of two logs, without the pairs over their gaps"


def test_a_sweep_writes_to_an_object_store(tmp_path, evaluate, monkeypatch, capsys):
    pytest.importorskip("upath")
    monkeypatch.chdir(tmp_path)
    assert evaluate("-m", "data.step=3,4", "output=memory://swept") == 0 and not list(tmp_path.iterdir())
    assert "also in memory://swept/comparison.csv" in capsys.readouterr().out


def test_demo_and_submit_write_to_this_machine(log_folder, cflow, capsys):
    pytest.importorskip("upath")
    for call in (["demo"], ["submit", log_folder]):
        assert cflow(*call, "output=memory://out") == 2
        assert "give a folder of this machine" in capsys.readouterr().err


def test_the_results_file_is_complete(log_folder, tmp_path, evaluate):
    assert evaluate("data.first=1") == 0
    record = results_of(tmp_path)
    assert record["num_pairs"] == record["results"]["num_frames"] == 2  # pairs 1 and 2
    assert record["results"]["definition"] == record["definition"]["name"] == "opensceneflow"
    assert record["definition"]["region"] == "disc" and record["definition"]["speed_edges"][-1] == "inf"
    assert {"bucketed", "three_way", "range_wise", "num_points"} <= set(record["results"])
    assert set(record["versions"]) == {"cflow_torch", "torch", "numpy"} and "+" not in record["versions"]["torch"]
    assert record["machine"]["python"] == platform.python_version(), "another patch version may continue a run"
    assert record["config"]["model"]["pixel_sizes"] == [0.1] and record["config"]["experiment_name"] is None
    assert record["data"]["logs"] == [{"log_id": log_folder.name, "sweeps": 4}] and len(record["data"]["digest"]) == 16
    times = record["seconds_per_pair"]
    assert 0 < times["min"] <= times["median"] <= times["max"] and times["pairs"] == 1
    assert {"cluster", "correlate"} <= set(times["stages"]) and sum(times["stages"].values()) < times["max"]
    assert record["failures"] == [] and record["date"].startswith("20")
    assert evaluate("data.first=2", "overwrite=true") == 0
    assert results_of(tmp_path)["data"]["digest"] != record["data"]["digest"], "of what was scored"


def test_pairs_without_labels_are_not_estimated(tmp_path, evaluate, monkeypatch, capsys):
    labels, windows, read = AV2Log._labels, [], pairs.window
    monkeypatch.setattr(AV2Log, "_labels", lambda log, index: labels(log, index) if index == 1 else None)
    monkeypatch.setattr(pairs, "window", lambda log, index, *rest: (windows.append(index), read(log, index, *rest))[1])
    assert evaluate() == 0 and results_of(tmp_path)["num_pairs"] == 1 and windows == [1]
    assert evaluate("data.first=9", "overwrite=true") == 2
    assert "no pair could be scored" in (error := capsys.readouterr().err) and "has pairs 0 to 2" in error


def test_a_folder_of_another_run_is_an_error_that_names_the_difference(tmp_path, evaluate, capsys):
    file = tmp_path / "results.json"
    assert evaluate("data.step=3") == 0
    first = file.read_bytes()
    assert evaluate("device=cpu", "data.step=2") == 2
    error = capsys.readouterr().err
    assert "(data.step was 3, is 2; device was auto, is cpu)" in error and "overwrite=true" in error
    file.write_bytes(first.replace(b'"torch": "', b'"torch": "0.'))
    assert evaluate("data.step=3") == 2 and "versions.torch" in capsys.readouterr().err
    for broken, message in ((first[:1000], f"cannot read {file} as JSON"), (b"{}", "has results of another run")):
        file.write_bytes(broken)
        assert evaluate("data.step=3") == 2 and message in capsys.readouterr().err
    assert evaluate("data.step=3", "overwrite=true") == 0
    capsys.readouterr()
    (tmp_path / "moved").mkdir()
    file.rename(tmp_path / "moved" / "results.json")
    assert evaluate("data.step=3", f"output={tmp_path / 'moved'}") == 0
    assert "skipped" in capsys.readouterr().out, "the folder is not a setting"


def test_bad_frames_and_bad_logs_are_reported_and_skipped(log_folder, tmp_path, evaluate, capsys):
    root = tmp_path / "root"
    for name in ("broken", "good", "bad-poses"):
        shutil.copytree(log_folder, root / name)
    (root / "bad-poses" / "city_SE3_egovehicle.feather").write_bytes(b"")
    sweeps = sorted((root / "broken" / "sensors" / "lidar").iterdir())
    sweeps[3].write_bytes(sweeps[3].read_bytes()[:1000])
    assert evaluate(f"data.root={root}") == 1
    record, frame, error = results_of(tmp_path), f"broken/{sweeps[2].stem}", capsys.readouterr().err
    assert "2 failed:" in error and f"  {frame}: " in error and "  bad-poses: " in error
    assert record["num_pairs"] == 2 + 3 and [name for name, _ in record["failures"]] == ["bad-poses", frame]
    shutil.copy(log_folder / "sensors" / "lidar" / sweeps[3].name, sweeps[3])
    assert evaluate(f"data.root={root}") == 1 and results_of(tmp_path)["num_pairs"] == 6, "what failed is repeated"
    shutil.rmtree(root / "bad-poses")
    assert evaluate(f"data.root={root}") == 0 and "skipped" not in capsys.readouterr().out
    assert evaluate(f"data.root={root}") == 0 and "skipped" in capsys.readouterr().out


def test_a_scene_without_poses_names_what_helps(tmp_path, cflow, capsys):
    h5py = pytest.importorskip("h5py")
    file = write_small_log("hdf5", tmp_path / "data") / "synthetic-demo-0003.h5"
    with h5py.File(file, "r+") as scene:
        for group in scene.values():
            group.pop("pose"), group.pop("ego_motion", None)
    assert cflow("eval", file, f"output={tmp_path / 'out'}", "model=paper") == 2
    last = capsys.readouterr().err.splitlines()[-1]
    assert all(text in last for text in ("no pair could be scored", "has no pose", "ego_motion", "data.odometry=true"))


def test_warnings_are_one_line_without_a_source_path(tmp_path, cflow, capsys):
    folder = write_small_log("arrays", tmp_path / "data")
    shutil.rmtree(next(folder.rglob("ground")))
    for command in (("plot",), ("flow", "engine.workers=1")):
        assert cflow(*command, folder, f"output={tmp_path / command[0]}", "model=paper", SMALL) == 0
        lines = [line for line in capsys.readouterr().err.splitlines() if "warning" in line.lower()]
        assert len(lines) == 1 and lines[0].startswith("warning: ") and ".py" not in lines[0]
        assert "no ground masks, so we find the ground" in lines[0] and "data.find_ground=null" in lines[0]


def test_a_failure_ends_a_run_but_not_a_sweep(monkeypatch):
    monkeypatch.setattr(failures, "is_sweep", lambda: False)
    with pytest.raises(SystemExit, match="1"):
        failures.finish([("a", "bad")])
    monkeypatch.setattr(failures, "is_sweep", lambda: True)
    failures.finish([])
    with pytest.raises(failures.UnfinishedJob, match="1"):
        failures.finish([("a", "bad")])
    with pytest.raises(SystemExit, match="130"):
        failures.end_unfinished("stopped by Ctrl-C", 130)


def test_the_first_line_has_the_scores_and_names_classes_with_few_points():
    classes = {"CAR": {"num_dynamic": 5000}, "PEDESTRIAN": {"num_dynamic": 12}, "BACKGROUND": {"num_dynamic": 0}}
    bucketed = {"mean": {"dynamic_error": 0.25, "static_epe": 0.0125}, "classes": classes}
    first, second = summary({"bucketed": bucketed, "three_way": {}}, {"median": 0.5}).splitlines()
    assert first == "mean dynamic error 0.250, static EPE 0.013 m, 0.50 s a frame"
    assert second.startswith("few dynamic points, ") and second.endswith(": PEDESTRIAN (12)")
    only = summary({"three_way": {"epe_fd": 0.5, "epe_bs": float("nan")}}, {"median": 0.5})
    assert only == "EPE FD 0.500 m, EPE BS nan m, 0.50 s a frame"


def test_a_sweeper_minimises_the_mean_dynamic_error():
    mean = {"mean": {"dynamic_error": 0.25}}
    assert objective({"bucketed": mean, "three_way": {"epe_3way": 1.0}}) == 0.25
    assert objective({"bucketed": mean, "bucketed_by_range": {"mean": {"dynamic_error": 0.5}}}) == 0.5
    assert objective({"three_way": {"epe_3way": 1.0}}) == 1.0
    assert np.isnan(objective({"bucketed": {"mean": {"dynamic_error": None}}}))


def test_worker_processes_give_the_results_of_one_process(log_folder, tmp_path, evaluate, monkeypatch):
    """Scores, times of all pairs, and a bad frame that is reported and skipped."""
    root = tmp_path / "data" / "log"
    shutil.copytree(log_folder, root)
    sorted(root.glob("sensors/lidar/*"))[0].write_bytes(b"broken")
    records = []
    for name, workers in (("one", 1), ("two", 2)):
        monkeypatch.setattr(pairs, "choose_devices", lambda *_, count=workers: ("cpu",) * count)
        monkeypatch.setattr(pairs, "frames_per_worker", lambda config: 1)
        assert evaluate(f"data.root={root}", f"output={tmp_path / name}") == 1
        records.append(results_of(tmp_path / name))
    one, two = records
    assert two["num_pairs"] == 2 and one["seconds_per_pair"]["pairs"] == 1, "the first pair is a warm-up"
    assert two["seconds_per_pair"]["pairs"] in (1, 2), "and so is that of each process, unless there is no other"
    assert all(one[key] == two[key] for key in ("results", "failures", "data"))


class DeadlyEstimator(pairs._Estimator):
    """Kills its process at a window that has a file in the folder CFLOW_TEST_DEADLY, which says how often."""

    def estimate(self, sweeps: Any) -> Any:
        file = Path(os.environ["CFLOW_TEST_DEADLY"]) / str(sweeps.pc0.timestamp_ns)
        count = int(file.read_text()) if file.exists() else 0
        if count > 0:
            file.write_text(str(count - 1))
            os.kill(os.getpid(), signal.SIGKILL)
        return super().estimate(sweeps)


@pytest.mark.slow
def test_a_pair_whose_process_dies_is_tried_once_more_then_reported(log_folder, tmp_path, evaluate, monkeypatch):
    monkeypatch.setattr(pairs, "choose_devices", lambda *_: ("cpu", "cpu"))
    monkeypatch.setattr(pairs, "frames_per_worker", lambda config: 1)
    monkeypatch.setattr(pairs, "_Estimator", DeadlyEstimator)
    monkeypatch.setenv("CFLOW_TEST_DEADLY", str(tmp_path))
    stamps = AV2Log(log_folder).timestamps
    (tmp_path / str(stamps[0])).write_text("1")
    (tmp_path / str(stamps[1])).write_text("9")
    assert evaluate() == 1
    record = results_of(tmp_path)
    assert record["num_pairs"] == 2 and (tmp_path / str(stamps[1])).read_text() == "7"
    ((name, message),) = record["failures"]
    assert name.endswith(str(stamps[1])) and "2 worker processes died on it, the last one: signal 9" in message


def test_bench_keeps_freed_memory_and_writes_what_it_prints(tmp_path, cflow, capsys, monkeypatch):
    calls: list[Any] = []
    monkeypatch.setattr(memory, "keep_freed_memory", lambda: calls.append(1))
    data = ["data.num_sweeps=3", f"data.cache={tmp_path}", "model=paper", SMALL, "pairs=5", "repeats=1", "batches=[2]"]
    assert cflow("bench", *data, f"output={tmp_path / 'out'}") == 0
    report = json.loads((tmp_path / "out" / "bench.json").read_text())
    assert report["windows"] == 2 and len(calls) == 1, "the log has two pairs"
    assert report["model"]["method"] == "dense" and report["peak_bytes"] > 2**20
    seconds, batch = report["seconds"], report["batches"]["2"]
    assert seconds["pairs"] == 2 and 0 < seconds["min"] <= seconds["median"] <= seconds["max"]
    assert set(seconds["stages"]) == {"compensate", "project", "cluster", "correlate", "pool", "spread"}
    assert 0 < sum(seconds["stages"].values()) < 1.5 * seconds["max"]
    assert batch["windows_per_s"] == pytest.approx(2 / batch["median"])
    printed = capsys.readouterr().out
    assert f"{1000 * report['seconds']['median']:.1f}" in printed and "windows per second" in printed
