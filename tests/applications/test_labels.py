"""Labels for self-supervised training: their types and meanings, and that no scene is ever half labelled."""

from __future__ import annotations

import os
import shutil
import signal
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command_line import cflow
from small_logs import make_small_drive

from cflow_torch import CFlowError, make_config, make_model
from cflow_torch.applications import labels
from cflow_torch.applications.labels import find_labels, label_scene
from cflow_torch.data.hdf5 import HDF5Log, write_hdf5_results, write_hdf5_scene, writer
from cflow_torch.data.hdf5.writer import LABELLED
from cflow_torch.data.log import windows

h5py = pytest.importorskip("h5py")
spatial = pytest.importorskip("scipy.spatial")

KEYS = {"dufo": np.uint8, "cluster": np.int16, "dufocluster": np.int16, "nnd": np.uint8, "ground_mask": np.bool_}
NEAR = (-25.0, -25.0, -np.inf, 25.0, 25.0, np.inf)
ONLINE = make_config(num_history=0, point_cloud_range=NEAR, pixel_sizes=(0.4, 0.2))
SMALL = "model.point_cloud_range=[-25,-25,-inf,25,25,inf]"
COARSE = "model.pixel_sizes=[0.4,0.2]"
CALL = ["label", "model=default", "model.num_history=0", SMALL, COARSE, "engine.workers=1", "data.check=false"]
NUM_SWEEPS = 4  # of a scene


@pytest.fixture(scope="module")
def drives(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two scenes."""
    folder = tmp_path_factory.mktemp("drives")
    for seed in (1, 2):
        write_hdf5_scene(make_small_drive(NUM_SWEEPS, seed), folder / f"scene-{seed}.h5")
    return folder


@pytest.fixture
def scenes(drives: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(drives, tmp_path / "scenes"))


@pytest.fixture(scope="module")
def labelled(drives: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The first scene with labels by the preset offline within 25 m."""
    file = Path(shutil.copy(drives / "scene-1.h5", tmp_path_factory.mktemp("labelled")))
    model = make_model(make_config("offline", point_cloud_range=NEAR), "cpu")
    assert label_scene(file, model) == NUM_SWEEPS
    return file


def stored(file: Path) -> list[dict[str, Any]]:
    with h5py.File(file, "r") as scene:
        return [{key: scene[stamp][key][()] for key in scene[stamp]} for stamp in sorted(scene, key=int)]


def label(*arguments: Any) -> int:
    return cflow(*CALL, *arguments)


def test_labels_have_the_types_and_meanings_of_the_harness(labelled: Path, drives: Path) -> None:
    for old, new in zip(stored(drives / "scene-1.h5"), stored(labelled)):
        assert set(new) == set(old) | set(KEYS)
        for key, value in old.items():
            np.testing.assert_array_equal(new[key], value)
        for key, dtype in KEYS.items():
            assert new[key].dtype == dtype and new[key].shape == (len(old["lidar"]),)
        moves, ground = new["dufo"] > 0, new["ground_mask"]
        assert moves.any() and new["dufo"].max() == 1 and new["nnd"].max() == 1
        assert not (moves & ground).any() and not new["cluster"][ground].any()
        np.testing.assert_array_equal(new["dufocluster"], np.where(moves, new["cluster"], 0))
        assert (new["cluster"][moves] > 0).all(), "a moving point without a group would be trained as static"
        moving = set(range(1, new["dufocluster"].max() + 1))
        assert set(new["cluster"][moves]) == moving, "the harness has 8 bits for them"
        count = np.bincount(new["cluster"])[1:]
        static = np.setdiff1d(new["cluster"], [0, *moving])
        assert count.min() > 0 and (count[static - 1] >= 20).all()


def confusion(file: Path, reach: float) -> np.ndarray:
    """(sweeps, 3) int: moving points that are labelled, static ones that are, moving ones that are not; in reach."""
    counts, moving = [], []
    with HDF5Log(file) as log:
        for index, sweep in enumerate(stored(file)):
            points = sweep["lidar"].astype(np.float64)
            scored = ~sweep["ground_mask"] & (np.linalg.norm(points[:, :2], axis=1) <= reach)
            if "flow" in sweep:
                T = np.linalg.inv(log.poses[index + 1]) @ log.poses[index]
                residual = sweep["flow"] - (points @ T[:3, :3].T + T[:3, 3] - points)
                moves = np.linalg.norm(residual, axis=1) >= 0.05
                moving = np.setdiff1d(sweep["flow_instance_id"][moves & ~sweep["ground_mask"]], [0])
                scored &= log.labels(index).is_valid
            elif "flow_instance_id" not in sweep:  # nor has the last sweep of a real drive ids: nothing is scored
                moves, scored = np.zeros_like(scored), np.zeros_like(scored)
            else:  # the last sweep has no flow: objects that moved in the sweep before still move
                moves = np.isin(sweep["flow_instance_id"], moving)
            dufo = sweep["dufo"] > 0
            counts.append([(scored & a & b).sum() for a, b in ((dufo, moves), (dufo, ~moves), (~dufo, moves))])
    return np.array(counts)


def test_moving_points_agree_with_the_truth_also_in_the_last_sweep(labelled: Path) -> None:
    counts = confusion(labelled, 25)
    found, false, missed = counts.sum(0)
    assert len(counts) == NUM_SWEEPS and (counts[:, 0] > 0.7 * (counts[:, 0] + counts[:, 2])).all()
    assert found / (found + false) > 0.9 and found / (found + missed) > 0.8


def test_nnd_is_the_nearest_point_of_the_next_sweep(labelled: Path) -> None:
    sweeps = stored(labelled)
    with HDF5Log(labelled) as log:
        for index, other in ((0, 1), (3, 2)):
            T = np.linalg.inv(log.poses[other]) @ log.poses[index]
            points = sweeps[index]["lidar"][::50].astype(np.float64) @ T[:3, :3].T + T[:3, 3]
            nearest = spatial.distance.cdist(points, sweeps[other]["lidar"]).min(1)
            expected = (nearest >= 0.14) & (nearest < 4.4)
            assert 0 < expected.mean() < 1
            np.testing.assert_array_equal(sweeps[index]["nnd"][::50], expected)


def test_motion_that_neighbouring_sweeps_contradict_is_rejected() -> None:
    """One of three groups keeps its motion, one reverses it, and one is not there in the other sweeps."""

    def dynamic_points(index: int) -> labels.DynamicPoints:
        shape = np.stack(np.meshgrid(*[np.arange(5) * 0.2] * 3), -1).reshape(-1, 3)
        steady, reverses, once = shape + [index, 0, 0], shape + [0, 9, 0], shape + [0, 30, 9 * index]
        velocity = np.repeat([[10.0, 0, 0], [10.0 * (-1) ** index, 0, 0], [0, 10, 0]], len(shape), 0)
        count = len(velocity)
        positions = np.concatenate([steady, reverses, once])
        return labels.DynamicPoints(
            np.arange(count), positions, velocity, np.arange(count) // len(shape), np.full(count, 0.7), 0.1 * index
        )

    three = [dynamic_points(index) for index in range(3)]
    confirmed = labels._is_confirmed(three, [spatial.cKDTree(each.positions) for each in three], 1)
    assert confirmed.reshape(3, -1).tolist() == [[True] * 125, [False] * 125, [False] * 125]
    none = three[1]._replace(**{name: getattr(three[1], name)[:0] for name in labels.DynamicPoints._fields[:-1]})
    assert len(labels._is_confirmed([none, none], [None, None], 0)) == 0


def test_ground_is_estimated_only_where_the_mask_is_missing(scenes: Path) -> None:
    file = scenes / "scene-1.h5"
    before = stored(file)
    with h5py.File(file, "r+") as scene:
        names = sorted(scene, key=int)
        del scene[names[1]]["ground_mask"]
        scene[names[2]]["ground_mask"][...] = before[2]["ground_mask"] & (np.arange(len(before[2]["lidar"])) % 2 == 0)
        given = scene[names[2]]["ground_mask"][()]
    label_scene(file, make_model(ONLINE, "cpu"))
    after = stored(file)
    np.testing.assert_array_equal(after[2]["ground_mask"], given)
    found, truth = after[1]["ground_mask"], before[1]["ground_mask"]
    assert found.dtype == np.bool_ and (found & truth).sum() / (found | truth).sum() > 0.9


def test_existing_labels_are_replaced_only_with_overwrite(
    drives: Path, scenes: Path, tmp_path: Path, capsys: Any
) -> None:
    file, output = scenes / "scene-2.h5", f"output={tmp_path / 'out'}"
    with h5py.File(file, "r+") as scene:
        for name in scene:
            scene[name]["dufo"] = np.full(len(scene[name]["lidar"]), 7, np.int64)
    before = file.read_bytes()
    with pytest.raises(CFlowError, match="already has labels: overwrite=true"):
        label_scene(file, make_model(ONLINE, "cpu"))
    assert label(scenes, output) == 2
    error = capsys.readouterr().err
    assert "scene-2.h5 has labels of other settings or of another program: give overwrite=true" in error
    assert error.count("\n") == 1
    assert file.read_bytes() == before and not list(tmp_path.glob("out/*/*.feather"))
    assert label(scenes, output, "overwrite=true") == 0
    frames, inode = {f: f.stat().st_mtime_ns for f in tmp_path.glob("out/*/*.feather")}, file.stat().st_ino
    with h5py.File(scenes / "scene-1.h5", "r+") as scene:
        del scene.attrs[LABELLED]  # as if the run had been killed before it labelled this scene
    assert label(scenes, output, "overwrite=true") == 0
    assert frames == {f: f.stat().st_mtime_ns for f in frames} and file.stat().st_ino == inode, "it is resumed"
    assert all(sweep["dufo"].dtype == np.uint8 and sweep["dufo"].max() == 1 for sweep in stored(file))
    in_python = Path(shutil.copy(drives / "scene-2.h5", tmp_path))
    label_scene(in_python, make_model(ONLINE, "cpu"))
    for one, other in zip(stored(file), stored(in_python)):
        assert all(np.array_equal(one[key], other[key]) for key in KEYS), "the command and Python have one rule"
    assert label(scenes, output, "model.significance=2") == 2
    assert "has labels of other settings" in capsys.readouterr().err


def test_a_killed_run_leaves_whole_scenes_and_resumes(scenes: Path, tmp_path: Path) -> None:
    """The run is killed in the middle of the second scene, whose copy is half written."""
    before = {file.name: file.read_bytes() for file in scenes.iterdir()}
    output = f"output={tmp_path / 'out'}"
    store, count = writer._store_label, []

    def die(*arguments: Any) -> None:
        count.append(1)
        store(*arguments)
        if len(count) == 27:
            os.kill(os.getpid(), signal.SIGKILL)

    child = os.fork()  # a new process would import torch
    if child == 0:
        try:
            writer._store_label = die
            label(scenes, output)
        finally:
            os._exit(1)
    _, status = os.waitpid(child, 0)
    assert os.WIFSIGNALED(status) and os.WTERMSIG(status) == signal.SIGKILL
    first, second = scenes / "scene-1.h5", scenes / "scene-2.h5"
    assert second.read_bytes() == before["scene-2.h5"] and first.read_bytes() != before["scene-1.h5"]
    (left,) = scenes.glob(".*.tmp")
    os.utime(left, (0, 0))
    inode, frames = first.stat().st_ino, {f: f.stat().st_mtime_ns for f in tmp_path.glob("out/*/*.feather")}
    assert label(scenes, output) == 0
    assert first.stat().st_ino == inode, "a labelled scene is not written again"
    assert frames == {f: f.stat().st_mtime_ns for f in tmp_path.glob("out/*/*.feather")}, "flow is not computed again"
    assert all("nnd" in sweep for sweep in stored(second))
    assert sorted(name for name in os.listdir(scenes) if not name.endswith(".json")) == sorted(before)
    shutil.rmtree(tmp_path / "out")
    assert label(scenes, output) == 0 and not list(tmp_path.glob("out/*/*.feather")), "labelled scenes need no flow"


def test_shards_label_every_scene_once(scenes: Path, tmp_path: Path, capsys: Any) -> None:
    """Three shards of two scenes: the middle one has a part of both."""
    for index, count in ((1, 0), (0, 1), (2, 1)):
        assert label(scenes, f"output={tmp_path / 'out'}", f"shard.index={index}", "shard.count=3") == 0
        assert f"scenes labelled: {count}," in capsys.readouterr().out
    assert all("dufo" in sweep for file in scenes.glob("*.h5") for sweep in stored(file))


def test_broken_scenes_are_reported_and_the_others_labelled(scenes: Path, tmp_path: Path, capsys: Any) -> None:
    """One scene has a single sweep, and one file is not a scene."""
    (scenes / "scene-3.h5").write_bytes(b"not a scene")
    single = scenes / "scene-1.h5"
    with h5py.File(single, "r+") as scene:
        for name in sorted(scene, key=int)[1:]:
            del scene[name]
    before = single.read_bytes()
    assert label(scenes, f"output={tmp_path / 'out'}") == 1
    error = capsys.readouterr().err
    assert "has 1 sweeps; scene flow needs two or more" in error and "scene-3.h5" in error and "Traceback" not in error
    assert single.read_bytes() == before and "dufo" in stored(scenes / "scene-2.h5")[0]


def test_a_scene_with_gaps_is_labelled_part_by_part(tmp_path: Path, capsys: Any) -> None:
    """Sweeps 0 to 2, then 8 alone, then 14 to 16: the labels of the parts are those of scenes of their own."""
    drive = make_small_drive(17, 1)
    write_hdf5_scene(drive, tmp_path / "drive.h5")
    (tmp_path / "scenes").mkdir()
    for name, kept in (("whole", [*range(3), 8, *range(14, 17)]), ("first", range(3)), ("last", range(14, 17))):
        shutil.copy(tmp_path / "drive.h5", tmp_path / "scenes" / f"{name}.h5")
        with h5py.File(tmp_path / "scenes" / f"{name}.h5", "r+") as scene:
            for index in set(range(17)) - set(kept):
                del scene[str(drive.timestamps[index])]
    assert label(tmp_path / "scenes", f"output={tmp_path / 'out'}") == 0
    assert "scenes labelled: 3, scenes without complete flow yet: 0" in capsys.readouterr().out
    whole, first, last = (stored(tmp_path / "scenes" / f"{name}.h5") for name in ("whole", "first", "last"))
    for part, expected in ((whole[:3], first), (whole[4:], last)):
        assert len(part) == len(expected) and any(sweep["dufo"].any() for sweep in part)
        for sweep, other in zip(part, expected):
            assert all(np.array_equal(sweep[key], other[key]) for key in KEYS)
    assert not whole[3]["dufo"].any() and not whole[3]["nnd"].any() and whole[3]["cluster"].any()


@pytest.mark.parametrize(
    ("call", "message"),
    [
        ("{}", "no scene in {}"),
        ("{}/nowhere", "nowhere: there is no such file or folder"),
        ("data=av2 data.root={}", "labels are written into HDF5 scenes of OpenSceneFlow"),
        ("{} model=paper", "give model=offline or default"),
    ],
)
def test_a_wrong_call_is_one_clear_error(call: str, message: str, tmp_path: Path, capsys: Any) -> None:
    assert label(*call.format(tmp_path).split(), f"output={tmp_path / 'out'}") == 2
    error = capsys.readouterr().err
    assert error.startswith("error: ") and error.count("\n") == 1 and message.format(tmp_path) in error


def test_flow_of_another_log_is_refused(scenes: Path) -> None:
    model = make_model(ONLINE, "cpu")
    with HDF5Log(scenes / "scene-1.h5") as log:
        flows = [model([each])[0] for each in windows(log, 2)]
        for wrong, message in (
            (flows[:-1], "3 pairs and fewer flows"),
            ([*flows, flows[0]], "3 pairs and more flows"),
            ([*flows[1:], flows[0]], "rows of another sweep"),
        ):
            with pytest.raises(CFlowError, match=message):
                list(find_labels(log, wrong, model))
    with pytest.raises(CFlowError, match="key of the scenes themselves"):
        write_hdf5_results(scenes / "scene-1.h5", "dufo", [])


@pytest.mark.slow
def test_labels_of_a_real_drive_have_precision_and_recall(kitti_file: Path, tmp_path: Path) -> None:
    file = Path(shutil.copy(kitti_file, tmp_path))
    file.chmod(0o644)
    label_scene(file, make_model(make_config("offline"), "cpu"))
    found, false, missed = confusion(file, 50)[:-1].sum(0)
    assert found / (found + false) >= 0.9 and found / (found + missed) >= 0.8
