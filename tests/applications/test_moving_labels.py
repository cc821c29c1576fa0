"""Labels of moving points, read back as the evaluators of moving object segmentation read them."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from command_line import cflow
from pyarrow import feather
from small_logs import make_small_drive

from cflow_torch.applications.moving_labels import moving_classes
from cflow_torch.data.av2 import AV2Log
from cflow_torch.data.flow_file import read_flow
from cflow_torch.simulator.writers.av2 import write_av2_log
from cflow_torch.types import FlowResult

RUN = ("model.num_history=0", "model.pixel_sizes=[0.4,0.2]", "engine.workers=1", "labels=semantickitti")


def evaluator_classes(file: Path) -> np.ndarray:
    """Class of each point, in the way of evaluate_mos.py: 0 = not scored, 1 = static, 2 = moving."""
    learning_map = np.zeros(359, np.int32)
    learning_map[[9, 251]] = 1, 2
    return learning_map[np.fromfile(file, dtype=np.int32) & 0xFFFF]


def test_a_point_moves_from_five_centimetres_per_sweep_on() -> None:
    residual = torch.tensor([[0.0, 0, 0], [0.049, 0, 0], [0.03, 0.0401, 0], [0, 0, -1]])
    result: Any = FlowResult.of({"residual_flow": residual})
    assert moving_classes(result).tolist() == [9, 9, 251, 251]


def test_flow_writes_a_label_file_for_every_sweep(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    monkeypatch.setattr(AV2Log, "gaps", frozenset([1]))
    folder = write_av2_log(make_small_drive(num_sweeps=5), tmp_path / "data")
    log, output = AV2Log(folder), tmp_path / "out"
    call = ("flow", "data=av2", f"data.root={folder}", "data.check=false", f"output={output}")
    assert (
        cflow(*call, *RUN, "contents=[cluster_id,is_valid]") == 2 and "add moving, residual" in capsys.readouterr().err
    )
    assert cflow(*call, *RUN[:3], "labels=kitti") == 2 and "semantickitti" in capsys.readouterr().err
    assert cflow(*call, *RUN, "contents=[residual,moving,points]") == 0
    labels = output / "sequences" / log.log_id / "predictions"
    assert sorted(file.name for file in labels.iterdir()) == [f"{index:06d}.label" for index in range(5)]
    for index, stamp in enumerate(log.timestamps):
        classes = evaluator_classes(labels / f"{index:06d}.label")
        assert len(classes) == len(log.sweep(index).points)
        if index in (1, 4):
            assert (classes == 0).all(), "there is no flow over a gap, nor from the last sweep on"
            continue
        file = output / log.log_id / f"{stamp}.feather"
        table = feather.read_table(file)
        assert table.column_names == ["x", "y", "z", "residual_tx_m", "residual_ty_m", "residual_tz_m", "moving"]
        assert np.array_equal(np.stack([table[axis] for axis in "xyz"], 1), log.sweep(index).points[:, :3])
        flow = read_flow(file)
        moves = (flow.residual_flow.norm(dim=1).numpy() >= 0.05) & (flow.moving.numpy() >= 0.5)
        assert 0 < (classes == 2).sum() < len(classes) and np.array_equal(classes == 2, moves)
        assert set(classes) == {1, 2}

    (labels / "notes.txt").write_text("mine")
    assert cflow(*call, *RUN[:3], "model.max_speed=20", "overwrite=true") == 0
    assert [file.name for file in labels.iterdir()] == ["notes.txt"], "labels of another flow go, other files stay"


def write_sequence(folder: Path, num_sweeps: int) -> None:
    """Write a simulated drive as SemanticKITTI, with the classes 252 (moving), 50 and 40 (ground)."""
    drive = make_small_drive(num_sweeps=num_sweeps)
    for name in ("velodyne", "labels"):
        (folder / name).mkdir(parents=True)
    poses = []
    for index, sweep in enumerate(drive):
        points = np.asarray(sweep.points, np.float32)[:, :3]
        np.pad(points, ((0, 0), (0, 1))).tofile(folder / "velodyne" / f"{index:06d}.bin")
        classes = np.where(np.asarray(sweep.is_ground), 40, 50)
        labels = drive.labels(index)
        if labels is not None:
            T_ego1_ego0 = np.linalg.inv(drive.sweep(index + 1).pose) @ np.asarray(sweep.pose)
            static = points @ T_ego1_ego0[:3, :3].T + T_ego1_ego0[:3, 3] - points
            classes[np.linalg.norm(labels.flow - static, axis=1) >= 0.05] = 252
            classes[~labels.is_valid] = 0
        (classes.astype("<u4") + (7 << 16)).tofile(folder / "labels" / f"{index:06d}.label")
        poses.append(np.asarray(sweep.pose)[:3].ravel())
    np.savetxt(folder / "poses.txt", np.stack(poses))
    np.savetxt(folder / "times.txt", 0.1 * np.arange(num_sweeps))


def test_the_moving_iou_is_that_of_the_evaluator(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    """`cflow eval definition=mos` against the counts of evaluate_mos.py over the files of `cflow flow`."""
    folder = tmp_path / "sequences" / "08"
    write_sequence(folder, 4)
    data = (f"data.root={folder}", "data=kitti", "data.check=false")
    assert cflow("flow", *data, *RUN, f"output={tmp_path / 'flow'}") == 0
    assert cflow("eval", *data, *RUN[:2], "definition=mos", f"output={tmp_path / 'eval'}") == 0
    learning_map = np.zeros(300, int)
    learning_map[[40, 50, 252]] = 1, 1, 2
    confusion = np.zeros((3, 3), int)
    predicted = tmp_path / "flow" / "sequences" / "08" / "predictions"
    for index in range(4):
        truth = learning_map[np.fromfile(folder / "labels" / f"{index:06d}.label", np.int32) & 0xFFFF]
        np.add.at(confusion, (evaluator_classes(predicted / f"{index:06d}.label"), truth), 1)
    confusion[0] = confusion[:, 0] = 0  # not scored
    both, union = confusion[2, 2], confusion[2].sum() + confusion[:, 2].sum() - confusion[2, 2]
    scores = json.loads((tmp_path / "eval" / "results.json").read_text())["results"]["moving"]
    assert scores["num_points"] == confusion.sum() and 0 < both < union
    assert scores["num_moving"] == confusion[:, 2].sum() and scores["num_predicted"] == confusion[2].sum()
    assert scores["iou"] == pytest.approx(both / union)
    printed = capsys.readouterr().out
    assert f"moving IoU {scores['iou']:.3f}, precision {scores['precision']:.3f}" in printed
    assert "| moving IoU | precision |" in printed
