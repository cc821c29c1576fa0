"""Whole runs: in batches, resumed, in shards, with broken logs; the files are always those of one worker."""

from __future__ import annotations

import json
import os
import re
import shutil
import signal
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pyarrow import feather
from small_fleet import CONFIG, PAIRS, SWEEPS, command, flow_files, frames, run, tree

from cflow_torch import CFlowError, make_config, make_model
from cflow_torch.data.av2 import AV2Log
from cflow_torch.data.flow_file import read_flow
from cflow_torch.data.log import window
from cflow_torch.fleet import work
from cflow_torch.fleet.job import Shard, find_shard
from cflow_torch.fleet.manifest import claim_log

OTHER = {"config": make_config("paper", pixel_size=0.8)}  # settings of another run


@pytest.fixture
def out(single_run: Path, tmp_path: Path) -> Path:
    """A copy of the output of a complete run."""
    return Path(shutil.copytree(single_run, tmp_path / "out"))


def test_files_contain_the_results_and_their_origin(fleet, single_run):
    model = make_model(CONFIG)
    for folder in sorted(fleet.iterdir()):
        log = AV2Log(folder)
        for index in range(len(log.timestamps) - 1):
            (expected,) = model([window(log, index, 1)])
            stored = read_flow(single_run / log.log_id / f"{log.timestamps[index]}.feather")
            for name, values in expected.numpy().items():
                np.testing.assert_array_equal(stored.numpy()[name], values, err_msg=name)
        about = json.loads((single_run / log.log_id / "manifest.json").read_text())
        assert about["timestamps"] == list(log.timestamps) and about["log_id"] == log.log_id
    assert len(frames(single_run)) == PAIRS


def test_a_batch_changes_no_byte(fleet, single, tmp_path):
    report = run(fleet, tmp_path, batch=4)
    assert tree(tmp_path) == single
    assert (report["status"], report["exit_status"]) == ("complete", 0)
    assert list(report["frames"].values()) == [PAIRS, 0, PAIRS, 0, 0, 0, 0]
    assert report["frames_per_s"] == pytest.approx(PAIRS / report["seconds"])
    assert {"read", "compute", "write", "compute/cluster", "compute/correlate"} <= set(report["stages"])
    assert json.loads((tmp_path / "reports" / "shard-0-of-1.json").read_text())["frames"] == report["frames"]


def test_a_file_has_only_the_contents_asked_for(fleet, single_run, tmp_path):
    run(fleet, tmp_path, settings={"contents": ("residual", "is_valid")})
    file = frames(tmp_path)[0]
    small, whole = feather.read_table(file), feather.read_table(single_run / file.relative_to(tmp_path))
    assert small.column_names == ["residual_tx_m", "residual_ty_m", "residual_tz_m", "is_valid"]
    assert small.equals(whole.select(small.column_names))
    with pytest.raises(CFlowError, match="contents was"):
        run(fleet, tmp_path)


def test_a_second_run_computes_only_missing_frames(fleet, single, out):
    gone = frames(out)[2::3]
    for file in gone:
        file.unlink()
    times = {file: file.stat().st_mtime_ns for file in frames(out)}
    counted = run(fleet, out)["frames"]
    assert tree(out) == single
    assert (counted["computed"], counted["complete_before"]) == (len(gone), PAIRS - len(gone))
    assert all(file.stat().st_mtime_ns == time for file, time in times.items()), "complete files are kept"


def test_incomplete_files_are_computed_again(fleet, single, out):
    for number, file in enumerate(frames(out)[::2]):
        whole = file.read_bytes()
        file.write_bytes(b"" if number == 0 else whole[: len(whole) // 2] + bytes(len(whole) - len(whole) // 2))
    assert run(fleet, out)["frames"]["computed"] == PAIRS // 2
    assert tree(out) == single


@pytest.mark.parametrize("manifest", [None, b"", b"[]", b'{"run": {}}'])
def test_files_that_no_manifest_of_ours_describes_stay(fleet, out, manifest):
    """Flow of `cflow demo`, or raw clouds where the output is the parent of the drive."""
    for file in frames(out):
        file.with_name("manifest.json").unlink(missing_ok=True)
        if manifest is not None:
            file.with_name("manifest.json").write_bytes(manifest)
    before = tree(out)
    for overwrite in (False, True):
        with pytest.raises(CFlowError, match=f"{frames(out)[0].parent} has files that no manifest.json of cflow"):
            run(fleet, out, overwrite=overwrite)
    for folder in {file.parent for file in frames(out)}:
        with pytest.raises(CFlowError, match="has files that no manifest.json of cflow"):
            claim_log(folder, {"run": {}})
    assert tree(out) == before


def test_other_settings_are_rejected_by_name(fleet, single, out):
    with pytest.raises(CFlowError, match=re.escape("method.pixel_sizes was [0.4], is [0.8]") + ".*overwrite=true"):
        run(fleet, out, settings=OTHER)
    with pytest.raises(CFlowError, match="preset was paper, is keypoints; "):
        run(fleet, out, settings={"config": make_config("keypoints", pixel_size=0.4)})
    with pytest.raises(CFlowError, match="find_ground was None, is grid"):
        run(fleet, out, settings={"settings": {"find_ground": "grid"}})
    with pytest.raises(CFlowError, match="remove that folder"):
        run(fleet, out, shard=Shard(0, 2), overwrite=True, settings=OTHER)
    assert run(fleet, out)["frames"]["computed"] == 0
    assert tree(out) == single, "nothing was touched"


def test_overwrite_replaces_the_logs_of_this_run_only(fleet, single, out, tmp_path):
    shutil.copytree(out / frames(out)[0].parent.name, out / "another-log")
    (out / "mine.txt").write_text("not of a run")
    run(fleet, out, overwrite=True, settings=OTHER)
    run(fleet, tmp_path / "fresh", settings=OTHER)
    another = {f"another-log/{name}": content for name, content in tree(out / "another-log").items()}
    kept = {**another, "mine.txt": b"not of a run"}
    assert another and tree(out) == {**tree(tmp_path / "fresh"), **kept}
    assert run(fleet, out, overwrite=True, settings=OTHER)["frames"]["computed"] == PAIRS, "its own frames, too"


def test_memory_limit_and_paths_may_change(fleet, out, tmp_path):
    moved = Path(shutil.copytree(fleet, tmp_path / "Straße 東京"))
    report = run(moved, out, settings={"config": CONFIG.replace(max_memory=5e7)})
    assert report["frames"]["computed"] == 0


def test_a_changed_log_is_rejected_and_the_others_are_done(fleet, single, out, tmp_path):
    root = Path(shutil.copytree(fleet, tmp_path / "root"))
    first, second, _ = sorted(folder.name for folder in root.iterdir())
    shutil.rmtree(out / second)
    sweeps = sorted((root / first / "sensors" / "lidar").iterdir())
    shutil.copy(sweeps[1], sweeps[-1])  # same names, another content
    ((name, message),) = run(root, out)["failures"]
    assert name == first and "changed since" in message
    assert tree(out) == single


def test_data_and_results_may_be_in_an_object_store(fleet, single_run, tmp_path):
    fsspec = pytest.importorskip("fsspec", reason="needs the extra remote")
    pytest.importorskip("upath", reason="needs the extra remote")
    memory = fsspec.filesystem("memory")
    memory.put(str(fleet), "/fleet-data", recursive=True)
    for computed in (PAIRS, 2):
        assert command("data.root=memory://fleet-data", "output=memory://fleet-flow") == 0
        memory.get("/fleet-flow", str(tmp_path), recursive=True)
        (reports,) = tmp_path.rglob("reports")
        assert json.loads((reports / "shard-0-of-1.json").read_text())["frames"]["computed"] == computed
        assert flow_files(reports.parent) == flow_files(single_run)
        for name in [name for name in memory.find("/fleet-flow") if name.endswith(".feather")][3:5]:
            memory.rm(name)
    memory.rm("/fleet-flow", recursive=True)
    memory.rm("/fleet-data", recursive=True)


def test_shards_together_are_the_single_run(fleet, single, tmp_path):
    for index in (2, 0, 1):
        shard = find_shard("auto", "auto", {"RANK": str(index), "WORLD_SIZE": "3"})  # as torchrun says
        assert run(fleet, tmp_path, shard=shard)["shard"] == {"index": index, "count": 3}
    assert tree(tmp_path) == single


def test_a_sweep_over_shards_shares_one_folder(fleet, single_run, tmp_path):
    assert command("-m", f"data.root={fleet}", f"output={tmp_path}", "shard.count=2", "shard.index=0,1") == 0
    reports = [json.loads(file.read_text()) for file in sorted((tmp_path / "reports").iterdir())]
    assert [report["exit_status"] for report in reports] == [0, 0]
    assert "\nshard:" not in (tmp_path / "config.yaml").read_text(), "a run of this file computes all frames"
    assert flow_files(tmp_path) == flow_files(single_run)


def test_a_broken_sweep_fails_only_its_frames(fleet, single, tmp_path, capsys):
    root, out = Path(shutil.copytree(fleet, tmp_path / "root")), tmp_path / "out"
    log = sorted(root.iterdir())[1]
    sweeps = sorted((log / "sensors" / "lidar").iterdir())
    whole = sweeps[3].read_bytes()
    sweeps[3].write_bytes(whole[:1000])
    expected = {f"{log.name}/{sweeps[i].stem}" for i in (2, 3)}  # as t+1 and t; frame 4 has less history
    report = run(root, out)
    assert {name for name, _ in report["failures"]} == expected
    assert (report["status"], report["exit_status"], report["frames"]["computed"]) == ("incomplete", 1, PAIRS - 2)
    assert all(name in capsys.readouterr().err for name in sorted(expected)[:1])
    sweeps[3].write_bytes(whole)
    assert run(root, out)["exit_status"] == 0
    assert tree(out).keys() == single.keys()


def test_a_log_that_cannot_be_opened_is_skipped(fleet, single, tmp_path):
    root, out = Path(shutil.copytree(fleet, tmp_path / "root")), tmp_path / "out"
    first = sorted(root.iterdir())[0]
    poses = first / "city_SE3_egovehicle.feather"
    whole = poses.read_bytes()
    for spoil in (lambda: poses.write_bytes(whole[:100]), lambda: (poses.unlink(), poses.mkdir())):
        spoil()
        report = run(root, out)
        assert [name for name, _ in report["failures"]] == [first.name] and report["frames"]["failed_logs"] == 1
        assert tree(out) == {name: content for name, content in single.items() if not name.startswith(first.name)}
    poses.rmdir()
    poses.write_bytes(whole)
    run(root, out)
    assert tree(out) == single


def test_a_signal_lets_frames_in_hand_be_finished(fleet, single, tmp_path, monkeypatch):
    calls, write = [], work.write_flow

    def stop_at_the_second(*arguments: Any) -> None:
        calls.append(0)
        if len(calls) == 2:
            os.kill(os.getpid(), signal.SIGTERM)
        write(*arguments)

    monkeypatch.setattr(work, "write_flow", stop_at_the_second)
    report = run(fleet, tmp_path, batch=1)
    assert (report["status"], report["stopped_by"], report["exit_status"]) == ("interrupted", "SIGTERM", 143)
    assert report["frames"]["computed"] == len(frames(tmp_path)) < PAIRS and report["frames"]["unopened_parts"]
    assert tree(tmp_path).items() <= single.items()
    assert run(fleet, tmp_path)["frames"]["complete_before"] == report["frames"]["computed"]
    assert tree(tmp_path) == single


def test_a_dry_run_counts_the_frames_that_the_command_then_computes(fleet, single_run, tmp_path, capsys):
    out = tmp_path / "out"
    assert command(f"data.root={fleet}", f"output={out}", "dry_run=true") == 0
    printed = capsys.readouterr().out
    assert not out.exists()
    for folder, sweeps in zip(sorted(fleet.iterdir()), SWEEPS):
        assert re.search(rf"^ +{sweeps - 1} +{sweeps - 1}  {folder.name}$", printed, re.M)
    assert re.search(rf"^ +{PAIRS} +{PAIRS}  in total", printed, re.M)
    assert command(f"data.root={fleet}", f"output={out}", "engine.batch=2") == 0
    assert re.search(rf"computed +{PAIRS}\n", capsys.readouterr().out)
    assert flow_files(out) == flow_files(single_run)
    frames(out)[0].unlink()
    assert command(f"data.root={fleet}", f"output={out}", "dry_run=true") == 0
    assert re.search(rf"^ +{PAIRS} +1  in total", capsys.readouterr().out, re.M)


def test_an_unknown_engine_and_an_output_that_cannot_be_written_are_one_line(fleet, tmp_path, capsys):
    assert command(f"data.root={fleet}", f"output={tmp_path / 'out'}", "engine.name=cloud") == 2
    assert "'local', 'ray'" in capsys.readouterr().err
    (tmp_path / "file").write_text("mine")
    assert command(f"data.root={fleet}", f"output={tmp_path / 'file' / 'out'}") == 2
    assert "output=FOLDER" in capsys.readouterr().err and (tmp_path / "file").read_text() == "mine"
