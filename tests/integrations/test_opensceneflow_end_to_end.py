"""CorrelationFlow in a real OpenSceneFlow checkout: its own scripts, unmodified, on the CPU.

Optional: OSF_ROOT names the checkout, OSF_PYTHON an interpreter that has what the harness needs and this package
(default: the one that runs the tests). Scores are held against the replay `miniature_opensceneflow` and `cflow eval`.

OSF_ROOT=~/OpenSceneFlow OSF_PYTHON=~/envs/opensf/bin/python pytest -m slow tests/integrations
"""

from __future__ import annotations

import json
import os
import shutil
import sys
import zipfile
from pathlib import Path
from typing import Any, Iterator

import numpy as np
import pytest
import torch

pytest.importorskip("h5py")

import h5py
import miniature_opensceneflow as osf
import pyarrow as pa
import pyarrow.feather as feather
from opensceneflow_stubs.harness import Harness, printed, read_scores

from cflow_torch.cli.main import main
from cflow_torch.data.av2 import AV2Log
from cflow_torch.data.hdf5 import write_hdf5_scene
from cflow_torch.data.hdf5.writer import write_index_files
from cflow_torch.evaluation.submission import Frame, check_submission, get_version
from cflow_torch.integrations.opensceneflow import CFlow
from cflow_torch.simulator import make_drive

# Pixels for which no mean of whole displacements has a length of 0.05 m: with 0.1 m many have exactly that, and whether
# they count as dynamic (IoU) hangs on the last bit of float32 sums, which is not the same on every machine.
PIXELS = [0.3748, 0.1874, 0.0937]
TARGET_PIXELS = "model.target.pixel_sizes=[0.3748,0.1874,0.0937]"
NUM_SWEEPS, STEP = 7, 2  # frames 0, 2 and 4 are scored
# Positions are float32 in the harness, 1.6e-5 m apart up to 256 m away; on another CPU the last bit may be another one.
FLOAT32 = 1.6e-5


@pytest.fixture(autouse=True)
def _precision_of_the_harness() -> Iterator[None]:
    """The harness sets it on import; on some CPUs it changes the last bits of its products."""
    before = torch.get_float32_matmul_precision()
    torch.set_float32_matmul_precision("medium")
    yield
    torch.set_float32_matmul_precision(before)


@pytest.fixture(scope="module")
def harness(tmp_path_factory: pytest.TempPathFactory) -> Harness:
    """The checkout."""
    root = os.environ.get("OSF_ROOT")
    if not root:
        pytest.skip("no OpenSceneFlow checkout: set OSF_ROOT to its folder (and OSF_PYTHON to its interpreter)")
    assert (Path(root) / "eval.py").is_file(), f"OSF_ROOT={root} has no eval.py"
    return Harness(Path(root), os.environ.get("OSF_PYTHON", sys.executable), tmp_path_factory.mktemp("runs"))


@pytest.fixture(scope="module")
def checkpoint(harness: Harness) -> Path:
    """Written by the command that users are told."""
    harness.python_run("-m", "cflow_torch.integrations.opensceneflow", str(harness.work / "cflow.ckpt"))
    return harness.work / "cflow.ckpt"


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """val: a simulated drive of seven sweeps; test: the same without truth."""
    folder = tmp_path_factory.mktemp("drive")
    write_hdf5_scene(make_drive(1, NUM_SWEEPS, "demo"), folder / "val" / "drive.h5", eval_step=STEP)
    write_index_files(folder / "val")
    shutil.copytree(folder / "val", folder / "test")
    with h5py.File(folder / "test" / "drive.h5", "r+") as scene:
        for group in scene.values():
            for key in [key for key in group if key.startswith("flow")]:
                del group[key]
    return folder


@pytest.fixture(scope="module")
def scores(harness: Harness, checkpoint: Path, data: Path) -> list[dict[str, float]]:
    """What eval.py prints for the drive."""
    return read_scores(harness.run("val", "eval.py", "model=cflow", *places(checkpoint, data), TARGET_PIXELS))


def places(checkpoint: Path, data: Path) -> list[str]:
    return [f"checkpoint={checkpoint}", f"dataset_path={data}"]


def module(preset: str = "default", num_frames: int = 6, **settings: Any) -> CFlow:
    """The model that the scripts build, built here."""
    return CFlow(preset=preset, **settings, num_frames=num_frames, ego_T_lidar="auto")


def replayed(folder: Path, model: CFlow) -> dict[str, float]:
    """Scores by the miniature harness, as they would be printed."""
    frames = model.config.num_history + 2
    return printed(osf.evaluate(model, folder / "val", num_frames=frames, top_num_frames=frames))


def approximately(scores: dict[str, float]) -> Any:
    return pytest.approx(scores, rel=1e-5, abs=1e-9, nan_ok=True)  # the last digit may be rounded the other way


# ------------------------------------------------------------------------------------------------ CorrelationFlow


@pytest.mark.slow
def test_eval_prints_what_the_replay_computes(scores: list[dict[str, float]], data: Path) -> None:
    assert scores == [approximately(replayed(data, module(pixel_sizes=PIXELS)))]


@pytest.mark.slow
def test_eval_of_the_real_pair(harness: Harness, checkpoint: Path, av2_folder: Path, tmp_path: Path) -> None:
    """With points of the sensor and poses of the vehicle: `ego_T_lidar` is found by the module itself."""
    layout = {"points_frame": "sensor", "ego_T_lidar": osf.up_lidar(av2_folder), "store_extrinsics": False}
    write_hdf5_scene(AV2Log(av2_folder), tmp_path / "val" / f"{av2_folder.name}.h5", **layout, pose_dtype="float32")
    write_index_files(tmp_path / "val")
    (found,) = read_scores(harness.run("real", "eval.py", "model=cflow", *places(checkpoint, tmp_path)))
    assert found == approximately(replayed(tmp_path, module()))
    out = tmp_path / "out"
    main(["eval", "data=hdf5", f"data.root={tmp_path / 'val'}", f"output={out}", "model.min_height=null"])
    assert found == approximately(printed(json.loads((out / "results.json").read_text())["results"]))


@pytest.mark.slow
def test_runner_without_checkpoint(harness: Harness, data: Path, scores: list[dict[str, float]]) -> None:
    """The second path: history comes with its ground. The same flow, so the same digits."""
    overrides = ["model=cflow", "model.iter_only=true", f"dataset_path={data}", "num_frames=6", "+num_workers=0"]
    text = harness.run("runner", "eval.py", *overrides, TARGET_PIXELS, runner=True)
    assert read_scores(text) == [approximately(scores[0])]


def replayed_outcomes(folder: Path, eval: bool) -> dict[str, osf.Outcome]:
    """Time stamp -> what the miniature harness makes of our flow."""
    found = osf.outcomes(module(pixel_sizes=PIXELS), folder, num_frames=6, top_num_frames=6, eval=eval)
    return {outcome.batch["timestamp"]: outcome for outcome in found}


@pytest.mark.slow
@pytest.mark.parametrize("version", [1, 3])
def test_submission(version: int, harness: Harness, checkpoint: Path, data: Path) -> None:
    overrides = [*places(checkpoint, data), "data_mode=test", "save_res=True", f"leaderboard_version={version}"]
    harness.run(f"test-{version}", "eval.py", "model=cflow", *overrides, TARGET_PIXELS)
    file, frames = data.parent / "results" / f"cflow-e0-test-v{version}.zip", []
    with zipfile.ZipFile(file) as archive:
        for stamp, outcome in replayed_outcomes(data / "test", True).items():
            flow = outcome.final_flow - outcome.pose_flow
            if version == 1:
                flow = outcome.final_flow[outcome.batch["eval_mask"]]
            frames.append(Frame(f"drive/{stamp}.feather", len(flow)))
            table = feather.read_table(pa.BufferReader(archive.read(frames[-1].name)))
            written = np.stack([table[f"flow_t{axis}_m"].to_numpy() for axis in "xyz"], 1).astype(np.float64)
            assert np.abs(written).max() > 0.1
            np.testing.assert_allclose(written, flow.numpy(), rtol=2**-10, atol=FLOAT32)
    assert len(frames) == 3 and check_submission(file, get_version(version), frames) == []


@pytest.mark.slow
def test_save(harness: Harness, checkpoint: Path, data: Path, tmp_path: Path) -> None:
    """save.py writes the total flow of every sweep with a whole history and a successor under the checkpoint's name."""
    shutil.copytree(data / "val", tmp_path / "val")
    harness.run("save", "save.py", "model=cflow", *places(checkpoint, tmp_path / "val"), TARGET_PIXELS)
    expected = replayed_outcomes(data / "val", False)
    with h5py.File(tmp_path / "val" / "drive.h5", "r") as scene:
        stamps = sorted(scene, key=int)
        assert [("cflow" in scene[stamp]) for stamp in stamps] == [False] * 4 + [True, True, False]
        for stamp in stamps[4:6]:
            written, flow = scene[stamp]["cflow"], expected[stamp].final_flow.numpy()
            assert written.dtype == np.float32 and written.shape == flow.shape
            np.testing.assert_allclose(written[()], flow, rtol=0, atol=FLOAT32)
