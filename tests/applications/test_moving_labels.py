"""Labels of moving points, read back as the evaluators of moving object segmentation read them."""

from __future__ import annotations

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
    assert cflow(*call, *RUN, "contents=[cluster_id,is_valid]") == 2 and "add residual" in capsys.readouterr().err
    assert cflow(*call, *RUN[:3], "labels=kitti") == 2 and "semantickitti" in capsys.readouterr().err
    assert cflow(*call, *RUN, "contents=[residual,points]") == 0
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
        assert table.column_names == ["x", "y", "z", "residual_tx_m", "residual_ty_m", "residual_tz_m"]
        assert np.array_equal(np.stack([table[axis] for axis in "xyz"], 1), log.sweep(index).points[:, :3])
        speed = read_flow(file).residual_flow.norm(dim=1).numpy()
        assert 0 < (classes == 2).sum() < len(classes) and np.array_equal(classes == 2, speed >= 0.05)
        assert set(classes) == {1, 2}

    (labels / "notes.txt").write_text("mine")
    assert cflow(*call, *RUN[:3], "model.max_speed=20", "overwrite=true") == 0
    assert [file.name for file in labels.iterdir()] == ["notes.txt"], "labels of another flow go, other files stay"
