"""The comparison with peers scores every method on the same points; the ablation can leave out every step."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cflow_torch.simulator import make_drive

pytest.importorskip("h5py")
pytest.importorskip("scipy")


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    from cflow_torch.data.hdf5 import write_hdf5_scene

    file = tmp_path_factory.mktemp("peers") / "drive.h5"
    write_hdf5_scene(make_drive(1, 5, "demo"), file)
    return file


def test_rows_of_a_scene(script: Any, scene: Path, tmp_path: Path, monkeypatch: Any, capsys: Any) -> None:
    """Known values of zero flow; a table; rows of an earlier run are kept, and replaced by the same run again."""
    peers, file = script("benchmarks", "peers"), tmp_path / "rows.json"
    call = ["peers.py", str(scene), "--start", "2", "--history", "0", "2", "--json", str(file)]
    monkeypatch.setattr(sys, "argv", [*call, "--methods", "zero", "nearest", "nsfp"])
    peers.main()
    monkeypatch.setattr(sys, "argv", [*call, "--merge", str(file), "--methods", "default", "zero"])
    peers.main()
    printed = capsys.readouterr()
    assert "skipped nsfp: give --opensceneflow PATH" in printed.err
    rows = {(row["method"], row["history"]): row for row in json.loads(file.read_text())}
    assert len(json.loads(file.read_text())) == len(rows) == 4
    (zero, nearest, ours, older) = (rows[key] for key in (("zero", 0), ("nearest", 0), ("default", 0), ("default", 2)))
    assert zero["ratio"] == pytest.approx(1) and zero["static"] < 1e-5 and zero["dynamic"] > 0.1
    assert ours["dynamic"] < 0.5 * zero["dynamic"] and older["dynamic"] < 0.5 * zero["dynamic"]
    assert 0.2 * zero["dynamic"] < nearest["dynamic"] and nearest["static"] > 2 * ours["static"]
    lines = printed.out.splitlines()[-4:-1]
    assert [line.split(" | ")[0] for line in lines] == ["| default", "| zero", "| nearest"]
    assert f"{zero['dynamic']:.3f} / 1.00 / 0.0" in lines[1]


def test_clouds_of_the_peers(script: Any, scene: Path) -> None:
    """They lie in the frame of t+1: with the true flow a static world coincides, and no point is ground or far."""
    import argparse

    peers = script("benchmarks", "peers")
    given = argparse.Namespace(start=2, every=8, windows=None, history=(0,), reach=20.0)
    ((*_, case),) = peers.cases(scene, given)
    truth, pc0 = case.item.frame(np.zeros_like(case.item.pose_flow)), case.item.window.pc0
    assert np.abs(case.pc0[:, :2]).max() <= 20 and np.abs(case.pc1[:, :2]).max() <= 20
    assert len(case.rows) > 1000 and not pc0.is_ground[case.rows].any()
    expected = truth.points[case.rows] + truth.pose_flow[case.rows]
    np.testing.assert_allclose(case.pc0, expected, atol=1e-5)
    assert np.abs(truth.pose_flow[case.rows]).max() > 0.1, "the vehicle drives"


def test_true_and_false_labels_are_counted(script: Any, scene: Path) -> None:
    from cflow_torch.data.hdf5 import HDF5Log

    labels, log = script("benchmarks", "labels"), HDF5Log(scene)
    none = [np.zeros(len(log.sweep(index).points), bool) for index in range(len(log))]
    found, false, missed, _, missed_walkers = labels.counts(log, none)
    assert (found, false) == (0, 0) and missed > missed_walkers
    found, false, *_ = labels.counts(log, [~each for each in none])
    assert found == missed and false > missed


def test_every_step_can_be_left_out(script: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """What the ablation replaces exists under the name that the script uses."""
    script("figures", "drives")
    steps = script("ablation", "steps")
    monkeypatch.setattr(steps, "score_preset", lambda scored, preset, changes: changes)
    for name in (*steps.STEPS, *steps.SETTINGS):
        assert steps.score_without(None, name) == steps.SETTINGS.get(name, {})
