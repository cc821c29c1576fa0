"""CorrelationFlow in a real OpenSceneFlow checkout: its own scripts, unmodified, on the CPU.

Optional: OSF_ROOT names the checkout, OSF_PYTHON an interpreter that has what the harness needs and this package
(default: the one that runs the tests). Scores are held against the replay `miniature_opensceneflow` and `cflow eval`.

OSF_ROOT=~/OpenSceneFlow OSF_PYTHON=~/envs/opensf/bin/python pytest -m slow tests/test_opensceneflow_end_to_end.py
"""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path
from typing import Any, Dict, Iterator, List

import numpy as np
import pytest
import torch

pytest.importorskip("h5py")

import h5py
import miniature_opensceneflow as osf
import pyarrow as pa
import pyarrow.feather as feather
from opensceneflow_labels import up_lidar, write_own_scene
from opensceneflow_stubs.harness import BadRun, Harness, checked_text, disagreements, flat, read_sweep, read_tables

from cflow_torch import make_config
from cflow_torch.data.hdf5 import write_hdf5_scene
from cflow_torch.data.hdf5.writer import write_index_files
from cflow_torch.integrations.opensceneflow import CFlow
from cflow_torch.simulator import make_drive

# Pixels for which no mean of whole displacements has a length of 0.05 m: with 0.1 m many have exactly that, and whether
# they count as dynamic (IoU) hangs on the last bit of float32 sums, which is not the same on every machine.
PIXELS = [0.3748, 0.1874, 0.0937]
MODEL_PIXELS = "model.pixel_sizes=[0.3748,0.1874,0.0937]"  # of this program
TARGET_PIXELS = MODEL_PIXELS.replace("model.", "model.target.")  # of the harness
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
    harness.write_checkpoint(harness.work / "cflow.ckpt")
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
def real(av2_folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """val: the real pair as the harness's own extraction stores it."""
    folder = tmp_path_factory.mktemp("real")
    (folder / "val").mkdir()
    write_own_scene(av2_folder, folder / "val" / f"{av2_folder.name}.h5")
    write_index_files(folder / "val")
    return folder


@pytest.fixture(scope="module")
def dense(harness: Harness, checkpoint: Path, data: Path) -> Dict[str, str]:
    """What eval.py prints for the drive."""
    text = harness.run("val", "eval.py", "model=cflow", *places(checkpoint, data), TARGET_PIXELS)
    return read_tables(text)


def places(checkpoint: Path, data: Path) -> List[str]:
    return [f"checkpoint={checkpoint}", f"dataset_path={data}"]


def module(preset: str = "default", num_frames: int = 6, **settings: Any) -> CFlow:
    """The model that the scripts build, built here."""
    values = make_config(preset, **settings).as_dict()
    values.pop("num_history")
    return CFlow(**values, num_frames=num_frames, ego_T_lidar="auto")


def replayed(folder: Path, model: Any, num_frames: int, path: str = "B") -> Dict[str, float]:
    """Scores by the miniature harness."""
    layout = {"num_frames": num_frames, "top_num_frames": num_frames, "path": path}
    return flat(osf.evaluate(model, folder / "val", **layout))


# ------------------------------------------------------------------------------------------- the checker, always run

GOOD = """
---------  ---------
EPE_FD     0.676812
EPE_BS     0.0081513
EPE_FS     0.0107423
IoU        0
Three-way  0.231902
---------  ---------
| Class          |       Static |   Dynamic |
|----------------+--------------+-----------|
| BACKGROUND     |   0.0081513  |       nan |
| CAR            |   0.010684   |         1 |
| OTHER_VEHICLES | nan          |       nan |
| PEDESTRIAN     |   0.00892663 |         1 |
| WHEELED_VRU    |   0.00994298 |       nan |
| Mean           |   0.00942622 |         1 |
"""


def test_checker_takes_a_good_run() -> None:
    tables = read_tables(checked_text(0, GOOD))
    assert len(tables) == 17 and tables["EPE_FD"] == "0.676812" and tables["PEDESTRIAN/static"] == "0.00892663"
    assert tables["OTHER_VEHICLES/dynamic"] == "nan" and tables["Mean/dynamic"] == "1"
    values = {key: float(digits) for key, digits in tables.items()}
    assert not disagreements(tables, values)
    assert not disagreements(tables, {**values, "CAR/static": 0.01068405})
    assert read_sweep(GOOD + GOOD.replace("0.676812", "0.5")) == [tables, {**tables, "EPE_FD": "0.5"}]
    for key, value in (
        ("EPE_FD", 0.676814),
        ("CAR/static", float("nan")),
        ("OTHER_VEHICLES/static", 0.0),
        ("IoU", 1e-6),
    ):
        assert len(disagreements(tables, {**values, key: value})) == 1


@pytest.mark.parametrize(
    ("status", "text"),
    [
        (1, GOOD),
        (-9, GOOD),
        (0, f"==> Exception occur during training/validation step: a fault. Skip this batch.\n{GOOD}"),
        (0, f"{GOOD}\nRank 0 failed to write to drive.h5: no such key"),
    ],
)
def test_checker_refuses_a_failed_run(status: int, text: str) -> None:
    with pytest.raises(BadRun):
        checked_text(status, text)


@pytest.mark.parametrize(
    "text",
    [
        "",
        GOOD.replace("| Mean ", "| Average "),
        GOOD.replace("EPE_BS     0.0081513", ""),
        GOOD[: GOOD.index("| Class")],
        GOOD + GOOD,
        re.sub(r"^(\S+ +)[0-9.]+$", r"\1nan", GOOD, flags=re.MULTILINE),
        GOOD.replace("0.00942622 ", "nan ").replace("0.0081513  |", "nan |"),
    ],
    ids=["silent", "no mean", "no EPE_BS", "no classes", "twice", "NaN three-way", "NaN mean"],
)
def test_checker_refuses_an_empty_table(text: str) -> None:
    with pytest.raises(BadRun):
        read_tables(text)


# ----------------------------------------------------------------------------------- the harness with models we know


@pytest.mark.slow
@pytest.mark.parametrize("model", ["Raises", "NotANumber"])
def test_a_model_with_a_fault_is_noticed(model: str, harness: Harness, checkpoint: Path, data: Path) -> None:
    """The harness itself ends with status 0 and a table in both cases."""
    with pytest.raises(BadRun, match="a fault in the model" if model == "Raises" else "nothing was scored"):
        target = f"model.target._target_=known_models.{model}"
        read_tables(harness.run(model, "eval.py", "model=cflow", *places(checkpoint, data), target))


# As measured in the harness at its version of April 2026.
KNOWN: Dict[str, Dict[str, float]] = {
    "Zero": {
        "EPE_FD": 0.676812,
        "EPE_FS": 0.0107423,
        "EPE_BS": 0.0081513,
        "IoU": 0.0,
        "Three-way": 0.231902,
        "BACKGROUND/static": 0.0081513,
        "CAR/static": 0.010684,
        "CAR/dynamic": 1.0,
        "PEDESTRIAN/static": 0.00892663,
        "PEDESTRIAN/dynamic": 1.0,
        "WHEELED_VRU/static": 0.00994298,
        "Mean/static": 0.00942622,
    },
    "StaticWorld": {"EPE_FD": 0.674522, "EPE_FS": 0.00618095, "EPE_BS": 0.00133243, "Three-way": 0.227345},
    "Truth": {"IoU": 1.0, "CAR/static": 0.0, "CAR/dynamic": 0.0, "PEDESTRIAN/static": 0.0, "Mean/dynamic": 0.0},
}


@pytest.mark.slow
@pytest.mark.parametrize("model", list(KNOWN))
def test_known_models_score_as_known(
    model: str, harness: Harness, checkpoint: Path, real: Path, av2_folder: Path
) -> None:
    matrix = str(up_lidar(av2_folder).tolist()).replace(" ", "")
    target = [f"model.target._target_=known_models.{model}", f"model.target.ego_T_lidar={matrix}"]
    tables = read_tables(harness.run(model, "eval.py", "model=cflow", *places(checkpoint, real), *target))
    assert not disagreements({key: tables[key] for key in KNOWN[model]}, KNOWN[model])
    if model == "Truth":
        assert float(tables["EPE_FD"]) < 1e-9 and float(tables["EPE_BS"]) < 1e-10


# ------------------------------------------------------------------------------------------------ CorrelationFlow


@pytest.mark.slow
def test_eval_prints_what_the_replay_computes(dense: Dict[str, str], data: Path) -> None:
    assert not disagreements(dense, replayed(data, module(pixel_sizes=PIXELS), 6))


@pytest.mark.slow
def test_valid_rows_alone_give_the_same_digits(
    harness: Harness, checkpoint: Path, data: Path, dense: Dict[str, str]
) -> None:
    """Rows that are left out have no flow of their own in the harness, which is what the full output says."""
    overrides = [*places(checkpoint, data), TARGET_PIXELS, "model.target.output=valid"]
    assert read_tables(harness.run("valid", "eval.py", "model=cflow", *overrides)) == dense


@pytest.mark.slow
@pytest.mark.parametrize("model", ["cflow", "cflow_keypoints"])
def test_eval_of_the_real_pair(model: str, harness: Harness, checkpoint: Path, real: Path, tmp_path: Path) -> None:
    """Points of the sensor, poses of the vehicle: `ego_T_lidar` is found by the module itself."""
    tables = read_tables(harness.run(model, "eval.py", f"model={model}", *places(checkpoint, real)))
    preset, num_frames = ("default", 6) if model == "cflow" else ("keypoints", 2)
    assert not disagreements(tables, replayed(real, module(preset, num_frames), num_frames))
    if model == "cflow":  # the gate of the key points is a little wider where the time of t+1 is known
        assert not disagreements(tables, by_cflow_eval(real, tmp_path, "model.num_history=4", "model.clearance=null"))


@pytest.mark.slow
@pytest.mark.parametrize("model", ["cflow", "cflow_keypoints"])
def test_eval_prints_what_cflow_eval_computes(
    model: str, harness: Harness, checkpoint: Path, data: Path, dense: Dict[str, str], tmp_path: Path
) -> None:
    if model == "cflow":
        tables, settings = dense, ["model.num_history=4", "model.clearance=null", MODEL_PIXELS]
    else:
        one_size = "pixel_sizes=[0.0937]"
        overrides = [*places(checkpoint, data), f"model.target.{one_size}"]
        tables = read_tables(harness.run("drive-keypoints", "eval.py", f"model={model}", *overrides))
        settings = ["model=keypoints", f"model.{one_size}"]
        assert tables != dense
    assert not disagreements(tables, by_cflow_eval(data, tmp_path, f"data.step={STEP}", *settings))


def by_cflow_eval(folder: Path, output: Path, *settings: str) -> Dict[str, float]:
    """Scores by this package's own program, products as precise as in the harness."""
    call = ["eval", "data=hdf5", f"data.root={folder / 'val'}", "definition=opensceneflow", f"output={output}"]
    precision = "import torch; torch.set_float32_matmul_precision('medium')"
    program = f"{precision}; import sys; from cflow_torch.cli.main import main; sys.exit(main())"
    subprocess.run([sys.executable, "-c", program, *call, *settings], check=True)
    return flat(json.loads((output / "results.json").read_text())["results"])


@pytest.mark.slow
def test_sweep(harness: Harness, checkpoint: Path, data: Path) -> None:
    """Three values by the harness's own -m."""
    wanted = ["-m", "model=cflow", *places(checkpoint, data), TARGET_PIXELS, "model.target.num_frames=2,3,4"]
    jobs = read_sweep(harness.run("frames", "eval.py", *wanted))
    assert len(jobs) == 3 and all((harness.work / "cflow" / str(job) / "output.log").is_file() for job in range(3))
    for num_frames, tables in zip((2, 3, 4), jobs):
        assert not disagreements(tables, replayed(data, module(pixel_sizes=PIXELS, num_frames=num_frames), num_frames))
    assert len({json.dumps(tables) for tables in jobs}) == 3


@pytest.mark.slow
def test_runner_without_checkpoint(harness: Harness, data: Path, dense: Dict[str, str]) -> None:
    """The second path: history comes with its ground. The same flow, so the same digits."""
    overrides = ["model=cflow", "model.iter_only=true", f"dataset_path={data}", "num_frames=6", "+num_workers=0"]
    tables = read_tables(harness.run("runner", "eval.py", *overrides, TARGET_PIXELS, runner=True))
    assert tables == dense


@pytest.mark.slow
@pytest.mark.parametrize("version", [1, 3])
def test_submission(version: int, harness: Harness, checkpoint: Path, data: Path, tmp_path: Path) -> None:
    overrides = [*places(checkpoint, data), "data_mode=test", "save_res=True", f"leaderboard_version={version}"]
    harness.run(f"test-{version}", "eval.py", "model=cflow", *overrides, TARGET_PIXELS)
    layout = {"num_frames": 6, "top_num_frames": 6}
    osf.write_test_files(module(pixel_sizes=PIXELS), data / "test", tmp_path, version, **layout)
    expected = sorted(str(file.relative_to(tmp_path)) for file in tmp_path.glob("*/*.feather"))
    assert len(expected) == 3
    with zipfile.ZipFile(data.parent / "results" / f"cflow-e0-test-v{version}.zip") as archive:
        assert sorted(archive.namelist()) == expected
        for name in expected:
            written = feather.read_table(pa.BufferReader(archive.read(name)))
            own = feather.read_table(str(tmp_path / name))
            assert written.num_rows == own.num_rows
            assert [(field.name, field.type) for field in written.schema] == [
                (field.name, field.type) for field in own.schema
            ]
            flow = [np.stack([table[f"flow_t{axis}_m"].to_numpy() for axis in "xyz"], 1) for table in (written, own)]
            assert np.abs(flow[0]).max() > 0.1
            np.testing.assert_allclose(*(values.astype(np.float64) for values in flow), rtol=2**-10, atol=FLOAT32)
            if version == 1:
                assert written["is_dynamic"].equals(own["is_dynamic"])
                assert set(written["is_dynamic"].to_pylist()) == {False, True}


@pytest.mark.slow
def test_save(harness: Harness, checkpoint: Path, data: Path, tmp_path: Path) -> None:
    """Total flow under the name of the checkpoint, for every frame with full history and a successor."""
    theirs, ours = tmp_path / "theirs", tmp_path / "ours"
    for folder in (theirs, ours):
        shutil.copytree(data / "val", folder)
    harness.run("save", "save.py", "model=cflow", *places(checkpoint, theirs), TARGET_PIXELS)
    osf.save(module(pixel_sizes=PIXELS), ours, "cflow", num_frames=6, top_num_frames=6)
    with h5py.File(theirs / "drive.h5", "r") as left, h5py.File(ours / "drive.h5", "r") as right:
        stamps = sorted(left, key=int)
        assert [("cflow" in left[stamp]) for stamp in stamps] == [False] * 4 + [True, True, False]
        for stamp in stamps[4:6]:
            written = left[stamp]["cflow"]
            assert written.dtype == np.float32 and written.shape == (len(left[stamp]["lidar"]), 3)
            np.testing.assert_allclose(written[()], right[stamp]["cflow"][()], rtol=0, atol=FLOAT32)
