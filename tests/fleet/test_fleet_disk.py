"""Disks that are full, read-only or shared: one line names the file, what is there is whole, and the same run, begun
again, ends with the bytes of one that nothing disturbed."""

from __future__ import annotations

import os
import subprocess
from pathlib import Path
from typing import Any, Dict

import numpy as np
import pytest
from full_disk import STEPS, SmallDisk, fill
from small_fleet import ONE, PAIRS, TWO, command, frames, run, tree

from cflow_torch import CFlowError
from cflow_torch.data import atomic
from cflow_torch.data.atomic import remove_stale


@pytest.mark.parametrize(
    "target", ["/.manifest.json.", "demo-0001/.manifest.json.", ".feather.", "/.shard-0-of-1.json."]
)
@pytest.mark.parametrize("step", STEPS)
def test_a_disk_that_is_full_for_a_while(
    fleet: Path, single: Dict[str, bytes], tmp_path: Path, capsys: pytest.CaptureFixture, step: str, target: str
) -> None:
    name = target.split("/")[-1].strip(".")
    with pytest.MonkeyPatch.context() as patch:
        fill(patch, step, target)
        if target == "/.manifest.json.":
            with pytest.raises(OSError, match=f"No space left on device: '{tmp_path / name}'"):
                run(fleet, tmp_path)
        else:
            report = run(fleet, tmp_path)
            told = "".join(message for _, message in report["failures"]) + capsys.readouterr().err
            assert "No space left on device" in told and name in told
            assert report["exit_status"] == 1 and report["is_written"] == ("shard" not in target)
    assert tree(tmp_path).items() <= single.items()
    assert run(fleet, tmp_path)["exit_status"] == 0
    assert tree(tmp_path) == single


def test_a_few_frames_find_no_room(
    fleet: Path, single: Dict[str, bytes], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    fill(monkeypatch, "write", ".feather.", 2)
    report = run(fleet, tmp_path)
    assert (report["frames"]["computed"], report["frames"]["failed"]) == (PAIRS - 2, 2)
    assert all(message.startswith("[Errno 28] No space left on device: '") for _, message in report["failures"])
    assert run(fleet, tmp_path)["frames"]["computed"] == 2
    assert tree(tmp_path) == single


def test_an_output_that_cannot_be_written_is_one_line(
    fleet: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    (tmp_path / "file").write_text("mine")
    assert command(f"data.root={fleet}", f"output={tmp_path / 'file' / 'out'}") == 2
    assert "output=FOLDER" in capsys.readouterr().err and (tmp_path / "file").read_text() == "mine"
    fill(monkeypatch, "write", ".config.yaml.")
    assert command(f"data.root={fleet}", f"output={tmp_path / 'out'}") == 2
    told = capsys.readouterr().err
    assert "No space left on device" in told and "output=FOLDER" in told and "Traceback" not in told


@pytest.mark.parametrize(
    ("options", "room"),
    [("size=300k", "size=50m"), ("size=8k", "size=50m"), ("nr_inodes=9,size=50m", "nr_inodes=200")],
)
@pytest.mark.parametrize("layout", [ONE, pytest.param(TWO, marks=pytest.mark.slow)], ids=["one", "two"])
def test_a_small_disk(
    fleet: Path, single: Dict[str, bytes], tmp_path: Path, options: str, room: str, layout: Any
) -> None:
    with SmallDisk(tmp_path / "disk", options) as disk:
        out = disk.folder / "out"
        report = run(fleet, out, layout)
        assert report["exit_status"] == 1 and "No space left on device" in str(report["failures"])
        assert tree(out).items() <= single.items()
        disk.change(room)
        assert run(fleet, out, layout)["exit_status"] == 0
        assert tree(out) == single


def test_a_disk_that_is_read_only(fleet: Path, single: Dict[str, bytes], tmp_path: Path) -> None:
    with SmallDisk(tmp_path / "disk", "size=50m") as disk:
        out = disk.folder / "out"
        run(fleet, out)
        frames(out)[0].unlink()
        before = tree(out)
        disk.change("ro")
        report = run(fleet, out)
        assert "Read-only file system" in str(report["failures"]) and not report["is_written"]
        disk.change("rw")
        assert tree(out) == before
        assert run(fleet, out)["frames"]["computed"] == 1
        assert tree(out) == single


# Other writers


def test_a_run_that_begins_beside_this_one_costs_no_frame(
    fleet: Path, single: Dict[str, bytes], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It takes the temporary file of a frame for that of a dead run, and removes it."""
    replace, robbed = os.replace, []

    def replace_robbed(old: Any, new: Any) -> None:
        if not robbed and Path(new).suffix == ".feather":
            robbed.extend(remove_stale(Path(new).parent, {Path(new).name}))
        replace(old, new)

    monkeypatch.setattr(atomic.os, "replace", replace_robbed)
    assert run(fleet, tmp_path)["exit_status"] == 0
    assert len(robbed) == 1 and tree(tmp_path) == single


def test_what_dead_runs_left_is_removed(fleet: Path, single: Dict[str, bytes], tmp_path: Path) -> None:
    run(fleet, tmp_path)
    file = frames(tmp_path)[0]
    file.unlink()
    ended = subprocess.Popen(["true"])
    ended.wait()
    for place, process in ((file, 1), (tmp_path / "x", ended.pid), (tmp_path / "reports" / "x", ended.pid)):
        left = atomic.temporary_name(place.name).replace(f"-{os.getpid()}-", f"-{process}-")
        place.with_name(left).write_bytes(b"half")
    run(fleet, tmp_path)
    assert tree(tmp_path) == single and not list((tmp_path / "reports").glob(".*"))


def test_results_in_scenes_find_no_room(tmp_path: Path) -> None:
    """The scene stays as it was; copies that a killed writer left are removed."""
    pytest.importorskip("h5py", reason="needs the extra hdf5")
    from cflow_torch.data.hdf5 import write_hdf5_scene
    from cflow_torch.data.hdf5.results import write_hdf5_results
    from cflow_torch.simulator import make_drive

    drive = make_drive(seed=0, num_sweeps=2, profile="demo")
    with SmallDisk(tmp_path / "disk", "size=50m") as disk:
        scene = disk.folder / "scene.h5"
        write_hdf5_scene(drive, scene)
        before = scene.read_bytes()
        disk.change(f"size={2 * len(before) // 1024 + 60}k")
        results = [(drive.timestamps[0], np.ones((len(drive.sweep(0).points), 3), np.float32))]
        with pytest.raises(CFlowError, match="No space left on device.*make room"):
            write_hdf5_results(scene, "mine", results)
        assert [path.name for path in disk.folder.iterdir()] == ["scene.h5"] and scene.read_bytes() == before
        disk.change("size=50m")
        assert write_hdf5_results(scene, "mine", results) == 1
