"""The methods and labels in a checkout of OpenSceneFlow (commit 848bf86), whose scripts run unmodified on the CPU.

The checkout is ../shared/opensceneflow next to the project, or $OPENSCENEFLOW. Its scripts run in the interpreter of
the tests, or in $OPENSCENEFLOW_PYTHON, which needs what the harness imports (scripts/evaluators.txt). We compare what
they print and write with `cflow eval`, `cflow submit` and `cflow flow`.

The harness swallows the exceptions of a model, prints a table and exits with 0. So its status proves nothing, and
`Harness.run` also reads the text.
"""

from __future__ import annotations

import csv
import importlib.util
import json
import math
import os
import re
import shutil
import subprocess
import sys
import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("h5py")

import h5py
from command_line import cflow
from hdf5_scene import move_to_sensor
from pyarrow import feather

from cflow_torch.data.av2 import AV2Log
from cflow_torch.data.hdf5 import write_hdf5_scene
from cflow_torch.data.hdf5.writer import write_index_files
from cflow_torch.integrations.opensceneflow import write_null_checkpoint
from cflow_torch.simulator import make_drive
from cflow_torch.transforms import poses_from_quaternions

ROOT = Path(__file__).resolve().parents[2]
LAUNCHER = Path(__file__).with_name("opensceneflow_launcher.py")
FOLDERS = (ROOT, LAUNCHER.parent, ROOT / "scripts" / "benchmarks")  # of what the launcher imports
SEARCHPATH = "hydra.searchpath=[pkg://cflow_torch.configs.opensceneflow]"
SCORES = {"EPE_FD": "epe_fd", "EPE_BS": "epe_bs", "EPE_FS": "epe_fs", "IoU": "dynamic_iou", "Three-way": "epe_3way"}
ROW = re.compile(rf"^({'|'.join(SCORES)}) +(\S+) *$", re.MULTILINE)
MEAN = re.compile(r"^\| Mean +\| +(\S+) +\| +(\S+) +\| *$", re.MULTILINE)  # over classes: static, dynamic
SWALLOWED = ("==> Exception occur", "failed to write to")
# Pixels for which no mean of whole displacements has a length of 0.05 m. With 0.1 m many have exactly that, and the
# last bit of a float32 sum, which depends on the CPU, decides whether they count as dynamic.
SETTINGS = ("pixel_sizes=[0.3748,0.1874,0.0937]", "point_cloud_range=[-38.4,-38.4,-5,38.4,38.4,5]")
OURS = [f"model.{setting}" for setting in SETTINGS]
THEIRS = ["model=cflow", *(f"model.target.{setting}" for setting in SETTINGS)]
FLOAT32 = 1.6e-5  # metres between float32 positions up to 256 m away, in which the harness computes


@dataclass(frozen=True)
class Harness:
    """A checkout, which is never modified; `work` is the folder for what the runs write."""

    root: Path
    work: Path

    def run(self, name: str, script: str, *overrides: Any) -> str:
        """Run a script and return what it printed. Its exit status must be 0, and no exception swallowed."""
        # The scripts replace the last folder but one by the name of the model; what they write stays in `work`.
        settings = [SEARCHPATH, f"hydra.run.dir={self.work}/runs-{name}/job", *map(str, overrides)]
        python = os.environ.get("OPENSCENEFLOW_PYTHON", sys.executable)
        environment = {
            **os.environ,
            "PYTHONPATH": os.pathsep.join([*map(str, FOLDERS), os.environ.get("PYTHONPATH", "")]),
            "CUDA_VISIBLE_DEVICES": "",  # the harness computes with fewer digits on a GPU
            "COLUMNS": "200",
            "HYDRA_FULL_ERROR": "1",
        }
        pipes: dict[str, Any] = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT, "encoding": "utf-8"}
        call = [python, str(LAUNCHER), script, *settings]
        done = subprocess.run(call, cwd=self.root, env=environment, timeout=600, **pipes)
        assert done.returncode == 0 and not any(sign in done.stdout for sign in SWALLOWED), done.stdout[-6000:]
        return done.stdout


def read_scores(text: str) -> dict[str, float]:
    """Read the printed scores, by the names of `SCORES`, "static" and "dynamic"."""
    rows, mean = dict(ROW.findall(text)), MEAN.search(text)
    assert set(rows) == set(SCORES) and mean is not None and math.isfinite(float(mean.group(1))), text[-6000:]
    rows["static"], rows["dynamic"] = mean.groups()
    return {name: float(digits) for name, digits in rows.items()}


def evaluated(scenes: Path, output: Path, *settings: str) -> Any:
    """Scores by `cflow eval`, as the harness would print them, with a tolerance for the rounding of its last digit."""
    assert cflow("eval", "data=hdf5", f"data.root={scenes}", f"output={output}", *settings) == 0
    results = json.loads((output / "results.json").read_text())["results"]
    mean = results["bucketed"]["mean"]
    values = {name: results["three_way"][ours] for name, ours in SCORES.items()}
    values.update(static=mean["static_epe"], dynamic=mean["dynamic_error"])
    printed = {name: math.nan if value is None else float(f"{value:.6g}") for name, value in values.items()}
    return pytest.approx(printed, rel=1e-5, abs=1e-9, nan_ok=True)


@pytest.fixture(scope="module")
def harness(tmp_path_factory: pytest.TempPathFactory) -> Harness:
    root = Path(os.environ.get("OPENSCENEFLOW") or ROOT.parent / "shared" / "opensceneflow")
    if not (root / "eval.py").is_file():
        pytest.skip(f"no checkout of OpenSceneFlow at {root}; set OPENSCENEFLOW to its folder")
    packages = ("av2", "lightning")
    if "OPENSCENEFLOW_PYTHON" not in os.environ and not all(map(importlib.util.find_spec, packages)):
        pytest.skip("OpenSceneFlow's packages are missing: pip install --no-deps -r scripts/evaluators.txt")
    return Harness(root, tmp_path_factory.mktemp("runs"))


@pytest.fixture(scope="module")
def checkpoint(harness: Harness) -> Path:
    return write_null_checkpoint(harness.work / "cflow.ckpt")


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """val: a simulated drive of five sweeps; test: the same without truth."""
    folder = tmp_path_factory.mktemp("drive")
    write_hdf5_scene(make_drive(1, 5, "demo"), folder / "val" / "drive.h5", eval_step=1)
    write_index_files(folder / "val")
    shutil.copytree(folder / "val", folder / "test")
    with h5py.File(folder / "test" / "drive.h5", "r+") as scene:
        for group in scene.values():
            for key in [key for key in group if key.startswith("flow")]:
                del group[key]
    return folder


def inputs(checkpoint: Path, folder: Path) -> list[str]:
    return [*THEIRS, f"checkpoint={checkpoint}", f"dataset_path={folder}"]


@pytest.mark.slow
def test_eval_prints_the_scores_of_cflow_eval(harness: Harness, checkpoint: Path, data: Path, tmp_path: Path) -> None:
    scores = read_scores(harness.run("val", "eval.py", *inputs(checkpoint, data)))
    assert scores == evaluated(data / "val", tmp_path, *OURS)


def up_lidar(log_folder: Path) -> np.ndarray:
    """(4, 4) float64 T_ego_lidar of the upper LiDAR, in whose frame OpenSceneFlow's converter stores the points."""
    rows = feather.read_table(str(log_folder / "calibration" / "egovehicle_SE3_sensor.feather")).to_pylist()
    (row,) = (row for row in rows if row["sensor_name"] == "up_lidar")
    quaternion = [row[name] for name in ("qw", "qx", "qy", "qz")]
    return poses_from_quaternions([[row[name] for name in ("tx_m", "ty_m", "tz_m")]], [quaternion], str)[0]


@pytest.mark.slow
def test_eval_of_the_real_pair(harness: Harness, checkpoint: Path, av2_folder: Path, tmp_path: Path) -> None:
    """Points are of the upper LiDAR and poses of the vehicle, which the module recognises."""
    file = tmp_path / "val" / f"{av2_folder.name}.h5"
    write_hdf5_scene(AV2Log(av2_folder), file)
    move_to_sensor(file, up_lidar(av2_folder))
    write_index_files(tmp_path / "val")
    scores = read_scores(harness.run("real", "eval.py", *inputs(checkpoint, tmp_path)))
    assert scores == evaluated(tmp_path / "val", tmp_path / "out", *OURS)


@pytest.mark.slow
def test_runner_without_checkpoint(harness: Harness, data: Path, tmp_path: Path) -> None:
    """The path of methods without training, whose history contains the ground."""
    overrides = ["model.iter_only=true", f"dataset_path={data}", "num_frames=6", "+num_workers=0"]
    scores = read_scores(harness.run("runner", "eval.py", *THEIRS, *overrides))
    assert scores == evaluated(data / "val", tmp_path, *OURS)


def columns_of(archive: Path) -> dict[str, np.ndarray]:
    """Name of a file -> its columns as (rows, columns) float64."""
    with zipfile.ZipFile(archive) as files:
        return {name: feather.read_feather(files.open(name)).to_numpy(np.float64) for name in files.namelist()}


@pytest.mark.slow
@pytest.mark.parametrize("version", [1, 3])
def test_its_leaderboard_archive_is_that_of_cflow_submit(version, harness, checkpoint, data, tmp_path):
    overrides = ["data_mode=test", "save_res=True", f"leaderboard_version={version}"]
    harness.run(f"test-{version}", "eval.py", *inputs(checkpoint, data), *overrides)
    theirs = data.parent / "results" / f"cflow-e0-test-v{version}.zip"
    call = ["submit", "data=hdf5", f"data.root={data / 'test'}", f"version={version}", f"output={tmp_path}", *OURS]
    assert cflow(*call) == 0 and cflow(*call, f"archive={theirs}") == 0
    expected = columns_of(tmp_path / f"v{version}.zip")
    found = columns_of(theirs)
    assert len(found) == 4 and set(found) == set(expected)
    for name, values in found.items():
        assert np.abs(values).max() > 0.1
        np.testing.assert_allclose(values, expected[name], rtol=2**-10, atol=FLOAT32)


@pytest.mark.slow
def test_save_writes_the_flow_of_cflow_flow(harness: Harness, checkpoint: Path, data: Path, tmp_path: Path) -> None:
    """save.py writes the total flow of sweeps with a whole history and a successor, under the checkpoint's name."""
    scenes = tmp_path / "val"
    shutil.copytree(data / "val", scenes)
    harness.run("save", "save.py", *inputs(checkpoint, scenes), "model.target.num_frames=4")
    ours = ["result_name=ours", f"output={tmp_path / 'out'}", "engine.workers=1", "model.num_history=2", *OURS]
    assert cflow("flow", "data=hdf5", f"data.root={scenes}", *ours) == 0
    with h5py.File(tmp_path / "val" / "drive.h5", "r") as scene:
        stamps = sorted(scene, key=int)
        assert [("cflow" in scene[stamp]) for stamp in stamps] == [False, False, True, True, False]
        for stamp in stamps[2:4]:
            written = scene[stamp]["cflow"]
            assert written.dtype == np.float32
            np.testing.assert_allclose(written[()], scene[stamp]["ours"][()], rtol=0, atol=2 * FLOAT32)


@pytest.mark.slow
def test_seflow_trains_on_labels_of_cflow_label(harness: Harness, data: Path, tmp_path: Path) -> None:
    """SeFlow's data loader reads the labels, and one step of train.py uses all four terms of its loss."""
    shutil.copytree(data / "test", tmp_path / "train")
    assert cflow("label", tmp_path / "train", f"output={tmp_path / 'out'}", "model=default", "engine.workers=1") == 0
    losses = {"chamfer_dis": 1.0, "static_flow_loss": 1.0, "dynamic_chamfer_dis": 1.0, "cluster_based_pc0pc1": 1.0}
    terms = ", ".join(f"{name}: {weight}" for name, weight in losses.items())
    folders = [f"train_data={tmp_path / 'train'}", f"val_data={data / 'val'}", "num_workers=0"]
    settings = ["loss_fn=seflowLoss", "+ssl_label=seflow_auto", f"+add_seloss={{{terms}}}"]
    network = "model.target._target_=opensceneflow_launcher.TinyNetwork"
    harness.run("train", "train.py", "model=deflow", network, *folders, *settings)
    (file,) = harness.work.rglob("metrics.csv")
    rows = list(csv.DictReader(file.read_text().splitlines()))
    for name in losses:
        assert all(float(row[f"trainer/{name}"] or 1) > 0 for row in rows), name
    assert any(row["trainer/loss"] for row in rows)
