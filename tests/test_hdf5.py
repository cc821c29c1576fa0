"""The reader of OpenSceneFlow's HDF5 scenes, on a scene made here and on the real one."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from cflow_torch import CFlowError
from cflow_torch.cli.main import main
from cflow_torch.data.hdf5 import HDF5Log, find_hdf5_scenes
from cflow_torch.data.log import window

h5py = pytest.importorskip("h5py")

STAMPS = (1_533_279_682_150_532, 1_533_279_682_250_532, 1_533_279_682_350_532)  # microseconds


def write_scene(file: Path, stamps=STAMPS, **replaced) -> Path:
    """Sweeps of 50 points, columns x, y, z, intensity; the last one has no flow. `replaced` values go into sweep 0."""
    rng = np.random.default_rng(0)
    with h5py.File(file, "w") as scene:
        for index, stamp in enumerate(stamps):
            group = scene.create_group(str(stamp))
            pose = np.eye(4)
            pose[0, 3] = index
            values = {
                "lidar": rng.uniform(-5, 5, (50, 4)).astype(np.float32),
                "ground_mask": rng.random(50) < 0.3,
                "pose": pose,
            }
            if index < len(stamps) - 1:
                values["flow"] = rng.normal(size=(50, 3)).astype(np.float32)
                values["flow_is_valid"] = rng.random(50) < 0.9
                values["flow_category_indices"] = rng.integers(0, 30, 50).astype(np.int8)
                values["eval_mask"] = rng.random((50, 1)) < 0.5
            if index == 0:
                values.update(replaced)
            for key, value in values.items():
                if value is not None:
                    group[key] = value
    return file


def test_what_is_stored_is_read(tmp_path):
    file = write_scene(tmp_path / "scene.h5")
    with h5py.File(file) as scene, HDF5Log(file) as log:
        assert log.log_id == "scene" and list(log.timestamps) == list(STAMPS)
        group = scene[str(STAMPS[1])]
        sweep, labels = log.sweep(1), log.labels(1)
        assert np.array_equal(sweep.points, group["lidar"][:, :3]) and sweep.points.dtype == np.float32
        assert np.array_equal(sweep.is_ground, group["ground_mask"][:])
        assert np.array_equal(sweep.pose, group["pose"][:]) and sweep.pose.dtype == np.float64
        assert sweep.timestamp_ns == STAMPS[1] * 1000, "microseconds become nanoseconds"
        assert np.array_equal(labels.flow, group["flow"][:]) and labels.category.dtype == np.uint8
        assert np.array_equal(log.eval_mask(1), group["eval_mask"][:, 0])
        assert log.labels(2) is None
        assert len(window(log, 1, 4).pch) == 1
    assert find_hdf5_scenes(tmp_path) == find_hdf5_scenes(file) == [file]


def test_nanoseconds_stay(tmp_path):
    stamps = (315_966_265_259_836_000, 315_966_265_360_032_000)
    with HDF5Log(write_scene(tmp_path / "a.h5", stamps)) as log:
        assert log.sweep(0).timestamp_ns == stamps[0]


@pytest.mark.parametrize(
    ("replaced", "complaint"),
    [
        ({"lidar": None}, "lidar"),
        ({"pose": None}, "pose"),
        ({"lidar": np.zeros((50, 2), np.float32)}, "lidar.*shape"),
        ({"ground_mask": np.zeros(49, bool)}, "ground_mask.*shape"),
    ],
)
def test_a_bad_sweep_is_named(tmp_path, replaced, complaint):
    with HDF5Log(write_scene(tmp_path / "a.h5", **replaced)) as log:
        with pytest.raises(CFlowError, match=complaint):
            log.sweep(0)
        assert len(log.sweep(1).points) == 50


@pytest.mark.parametrize("replaced", [{"flow_is_valid": None}, {"flow_category_indices": np.zeros(3, np.uint8)}])
def test_bad_labels_are_named(tmp_path, replaced):
    with HDF5Log(write_scene(tmp_path / "a.h5", **replaced)) as log, pytest.raises(
        CFlowError, match=next(iter(replaced))
    ):
        log.labels(0)


def test_files_that_are_no_scene(tmp_path):
    whole = write_scene(tmp_path / "whole.h5").read_bytes()
    (tmp_path / "half.h5").write_bytes(whole[: len(whole) // 2])
    (tmp_path / "empty.h5").write_bytes(b"")
    write_scene(tmp_path / "one.h5", STAMPS[:1])
    for name in ("half", "empty", "one", "missing"):
        with pytest.raises(CFlowError, match=f"{name}.h5"):
            HDF5Log(tmp_path / f"{name}.h5")
    with pytest.raises(CFlowError, match="nowhere"):
        find_hdf5_scenes(tmp_path / "nowhere")


def test_command_scores_the_eval_mask(tmp_path, capsys):
    write_scene(tmp_path / "scene.h5")
    (tmp_path / "broken.h5").write_bytes(b"no")
    with pytest.raises(SystemExit) as stop:
        main(["eval", "data=hdf5", f"data.root={tmp_path}", f"output={tmp_path / 'out'}", "model=paper"])
    assert stop.value.code == 1 and "broken.h5" in capsys.readouterr().err


def test_the_real_scene(kitti_file):
    with HDF5Log(kitti_file) as log:
        assert len(log.timestamps) == 16 and log.labels(15) is None
        sweep, labels = log.sweep(0), log.labels(0)
        assert len(labels.flow) == len(sweep.points) == len(log.eval_mask(0))
        assert 0.05 < (log.sweep(1).timestamp_ns - sweep.timestamp_ns) / 1e9 < 0.15
