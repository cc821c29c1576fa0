"""Disks that are full, read-only, cut off or taken away: one line names the file, what is there is whole, and the same
command, given again, ends with the bytes of a run that nothing disturbed."""

from __future__ import annotations

import os
import shutil
import subprocess
from pathlib import Path
from typing import Any, Callable, Dict, List

import numpy as np
import pytest
from full_disk import STEPS, SmallDisk, fill
from small_fleet import PAIRS, flow, report, run, tree, write_fleet

from cflow_torch import CFlowError
from cflow_torch.data import atomic
from cflow_torch.data.atomic import remove_stale
from cflow_torch.data.flow_file import read_flow
from cflow_torch.fleet import work
from cflow_torch.fleet.manifest import complete_frames
from cflow_torch.model import CoarseToFine

TARGETS = {  # what is written -> exit status
    "/.manifest.json.": 2,
    "/.config.yaml.": 2,
    "1/.manifest.json.": 1,
    ".feather.": 1,
    "/.shard-0-of-1.json.": 1,
}
QUICK = [("write", "/.config.yaml."), ("write", "1/.manifest.json."), ("rename", ".feather.")]


@pytest.fixture(scope="module")
def fleet(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Logs of 2 and 3 pairs."""
    return write_fleet(tmp_path_factory.mktemp("fleet"))


@pytest.fixture(scope="module")
def single(fleet: Path, tmp_path_factory: pytest.TempPathFactory) -> Dict[str, bytes]:
    """What an undisturbed run leaves."""
    output = tmp_path_factory.mktemp("single")
    assert flow(fleet, output, "engine.batch=1") == 0
    return tree(output)


def is_part(output: Path, single: Dict[str, bytes]) -> bool:
    """Whether all that is there is as it should be, with nothing beside it."""
    return tree(output).items() <= single.items()


# Full


@pytest.mark.parametrize(
    ("step", "target"),
    [
        pytest.param(step, target, marks=[] if (step, target) in QUICK else pytest.mark.slow)
        for target in TARGETS
        for step in STEPS
    ],
)
def test_a_disk_that_is_full_for_a_while(
    fleet: Path, single: Dict[str, bytes], tmp_path: Path, capsys: pytest.CaptureFixture, step: str, target: str
) -> None:
    out = tmp_path / "out"
    with pytest.MonkeyPatch.context() as patch:
        fill(patch, step, target)
        assert flow(fleet, out) == TARGETS[target]
    told = capsys.readouterr()
    name = target.strip("1/.")
    assert "No space left on device" in told.err and f"{name}" in told.err and str(out) in told.err
    assert "Traceback" not in told.err and ("no report" in told.out) == ("shard" in target)
    assert is_part(out, single)
    assert flow(fleet, out) == 0
    assert tree(out) == single


def test_a_few_frames_find_no_room(
    fleet: Path, single: Dict[str, bytes], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    fill(monkeypatch, "write", ".feather.", 2)
    assert flow(fleet, tmp_path) == 1
    assert report(tmp_path)["frames"]["computed"] == PAIRS - 2
    assert flow(fleet, tmp_path) == 0
    assert report(tmp_path)["frames"] == {**report(tmp_path)["frames"], "computed": 2, "complete_before": PAIRS - 2}
    assert tree(tmp_path) == single


ENGINES = {
    "one": ("engine.workers=1",),
    "two": ("engine.workers=2",),
    "ray": ("engine=ray", "engine.workers=2"),
}
SMALL = {  # mount -> how room is made
    "size=1m": "size=50m",
    "size=24k": "size=50m",
    "size=4k": "size=50m",
    "nr_inodes=9,size=50m": "nr_inodes=200",
    "nr_inodes=4,size=50m": "nr_inodes=200",
}


@pytest.mark.parametrize("engine", [pytest.param(e, marks=[] if e == "one" else pytest.mark.slow) for e in ENGINES])
@pytest.mark.parametrize("options", [pytest.param(o, marks=[] if "1m" in o else pytest.mark.slow) for o in SMALL])
def test_a_small_disk(
    fleet: Path, single: Dict[str, bytes], tmp_path: Path, capfd: pytest.CaptureFixture, options: str, engine: str
) -> None:
    if engine == "ray":
        pytest.importorskip("ray.data", reason="needs the extra ray")
    with SmallDisk(tmp_path / "disk", options) as disk:
        out = disk.folder / "out"
        assert flow(fleet, out, *ENGINES[engine]) in (1, 2)
        told = capfd.readouterr().err
        assert "No space left on device" in told and "Traceback" not in told
        assert is_part(out, single)
        disk.change(SMALL[options])
        assert flow(fleet, out, *ENGINES[engine]) == 0
        assert tree(out) == single


# Read-only, in the way, taken away


@pytest.mark.slow
@pytest.mark.parametrize("engine", ENGINES)
def test_a_disk_that_turns_read_only(
    fleet: Path, single: Dict[str, bytes], tmp_path: Path, capfd: pytest.CaptureFixture, engine: str
) -> None:
    if engine == "ray":
        pytest.importorskip("ray.data", reason="needs the extra ray")
    with SmallDisk(tmp_path / "disk", "size=50m") as disk:
        out = disk.folder / "out"
        assert flow(fleet, out, *ENGINES[engine]) == 0
        gone = sorted(out.glob("*/*.feather"))[::2]
        for file in gone:
            file.unlink()
        before = tree(out)
        disk.change("ro")
        assert flow(fleet, out, *ENGINES[engine]) == 2
        told = capfd.readouterr().err
        assert "Read-only file system" in told and f"cannot write into {out}" in told
        disk.change("rw")
        assert tree(out) == before
        assert flow(fleet, out, *ENGINES[engine]) == 0
        assert tree(out) == single


WORKING = {  # a command that writes -> settings of a run that would take seconds
    "eval": ("model=fast", "data.num_sweeps=2"),
    "demo": ("model=fast", "data.num_sweeps=5"),
    "bench": ("model=fast", "data.num_sweeps=2"),
    "plot": ("model=fast", "data.num_sweeps=2", "pair=0"),
    "plot picture=animation": ("model=fast", "data.num_sweeps=2", "first=0"),
    "submit": ("model=fast", "data.num_sweeps=2", "version=2"),
    "view": ("model=fast", "data.num_sweeps=2"),
}


@pytest.fixture(scope="module")
def cache(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where the simulated street is kept."""
    return tmp_path_factory.mktemp("cache")


@pytest.mark.parametrize(
    "command", [pytest.param(c, marks=[] if c in ("eval", "bench") else pytest.mark.slow) for c in WORKING]
)
def test_an_output_that_cannot_be_written_is_noticed_before_the_work(
    cache: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture, command: str
) -> None:
    if command == "view":
        pytest.importorskip("rerun", reason="needs the extra rerun")
    if "plot" in command or command == "demo":
        pytest.importorskip("matplotlib", reason="needs the extra viz")

    def work_hard(*_: Any) -> Any:
        raise AssertionError("hours of work")

    monkeypatch.setattr(CoarseToFine, "forward", work_hard)
    monkeypatch.setattr("cflow_torch.cli.bench.run_bench", work_hard)
    (tmp_path / "file").write_text("mine")
    settings = [*WORKING[command], f"data.cache={cache}", "data=synthetic"]
    assert run(*command.split(), *settings, f"output={tmp_path / 'file'}") == 2
    told = capsys.readouterr().err
    assert str(tmp_path / "file") in told and "output=" in told
    assert (tmp_path / "file").read_text() == "mine"
    fill(monkeypatch, "write", str(tmp_path / "new"))
    assert run(*command.split(), *settings, f"output={tmp_path / 'new'}") == 2
    assert "No space left" in capsys.readouterr().err
    assert not list((tmp_path / "new").rglob("*"))


def during(patch: pytest.MonkeyPatch, number: int, act: Callable[[], Any]) -> None:
    """Do something when a run begins to write its so-many-th frame."""
    calls: List[int] = []
    write = work.write_flow

    def write_after(*arguments: Any) -> None:
        calls.append(0)
        if len(calls) == number:
            act()
        write(*arguments)

    patch.setattr(work, "write_flow", write_after)


@pytest.mark.parametrize("which", ["all", pytest.param("first log", marks=pytest.mark.slow)])
def test_an_output_that_is_removed_during_the_run_is_told(
    fleet: Path,
    single: Dict[str, bytes],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture,
    which: str,
) -> None:
    out, first = tmp_path / "out", sorted(fleet.iterdir())[0].name
    place = {"all": out, "first log": out / first}[which]
    with pytest.MonkeyPatch.context() as patch:
        during(patch, 4, lambda: shutil.rmtree(place))
        assert flow(fleet, out, "engine.batch=1") == 1
    assert "removed" in capsys.readouterr().err and report(out)["status"] == "incomplete"
    assert flow(fleet, out) == 0
    assert tree(out) == single


@pytest.mark.slow
def test_frames_of_unknown_origin_are_not_taken_for_results(fleet: Path, tmp_path: Path) -> None:
    """Somebody removed the folder of a log in the middle of a run of other settings: what is written then is alone."""
    assert flow(fleet, tmp_path) == 0
    for file in tmp_path.rglob("manifest.json"):
        file.unlink()
    (tmp_path / "config.yaml").unlink()
    assert flow(fleet, tmp_path, "model.connectivity=4") == 0
    assert report(tmp_path)["frames"]["computed"] == PAIRS


@pytest.mark.parametrize("left", [pytest.param("nothing", marks=pytest.mark.slow), "zeros"])
def test_files_that_a_power_cut_spoiled_are_done_again(
    fleet: Path, single: Dict[str, bytes], tmp_path: Path, left: str
) -> None:
    assert flow(fleet, tmp_path) == 0
    for file in sorted(tmp_path.glob("*/*.feather"))[::2]:
        whole = file.read_bytes()
        half = whole[: len(whole) // 2]
        file.write_bytes({"nothing": b"", "zeros": half + bytes(len(whole) - len(half))}[left])
    (tmp_path / "config.yaml").write_bytes(b"")
    (tmp_path / "reports" / "shard-0-of-1.json").write_bytes(b"")
    assert flow(fleet, tmp_path) == 0
    assert report(tmp_path)["frames"]["computed"] == (PAIRS + 1) // 2
    assert tree(tmp_path) == single


@pytest.mark.slow
def test_a_manifest_that_a_power_cut_spoiled_is_named(
    fleet: Path, single: Dict[str, bytes], tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    assert flow(fleet, tmp_path) == 0
    log = sorted(fleet.iterdir())[0].name
    for file, status in ((tmp_path / log / "manifest.json", 1), (tmp_path / "manifest.json", 2)):
        file.write_bytes(b"")
        assert flow(fleet, tmp_path) == status
        assert f"{file} is no manifest" in capsys.readouterr().err
        file.unlink()
        assert flow(fleet, tmp_path) == 0
        assert tree(tmp_path) == single


# Input


def test_an_input_that_is_removed_during_the_run(
    fleet: Path, single: Dict[str, bytes], tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    root, out = tmp_path / "root", tmp_path / "out"
    shutil.copytree(fleet, root)
    with pytest.MonkeyPatch.context() as patch:
        during(patch, 1, lambda: shutil.rmtree(root))
        assert flow(root, out, "engine.batch=1") == 1
    told = capsys.readouterr().err
    assert "Traceback" not in told and sorted(fleet.iterdir())[1].name in told
    assert is_part(out, single) and tree(out)
    shutil.copytree(fleet, root)
    before = len(list(out.glob("*/*.feather")))
    assert flow(root, out) == 0
    assert report(out)["frames"]["computed"] == PAIRS - before and tree(out) == single


def test_a_log_that_cannot_be_read_costs_no_other(
    fleet: Path, single: Dict[str, bytes], tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    root, out = tmp_path / "root", tmp_path / "out"
    shutil.copytree(fleet, root)
    first, second = sorted(root.iterdir())
    poses = first / "city_SE3_egovehicle.feather"
    whole = poses.read_bytes()
    for spoil in (
        lambda: poses.write_bytes(whole[:100]),
        poses.unlink,
        poses.mkdir,
        lambda: (poses.rmdir(), poses.symlink_to(poses.name)),
    ):
        spoil()
        assert flow(root, out) == 1
        told = report(out)
        assert [name for name, _ in told["failures"]] == [first.name] and told["frames"]["failed_logs"] == 1
        assert {Path(name).parts[0] for name in tree(out)} == {second.name, "manifest.json"} and is_part(out, single)
        assert f"  {first.name}: " in capsys.readouterr().err
    poses.unlink()
    poses.write_bytes(whole)
    assert flow(root, out) == 0
    assert report(out)["frames"]["computed"] == len(list(out.glob(f"{first.name}/*.feather")))
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
    assert flow(fleet, tmp_path) == 0
    assert len(robbed) == 1 and tree(tmp_path) == single


def test_what_dead_runs_left_is_removed_whoever_has_their_number_now(
    fleet: Path, single: Dict[str, bytes], tmp_path: Path
) -> None:
    assert flow(fleet, tmp_path) == 0
    file = sorted(tmp_path.glob("*/*.feather"))[0]
    file.unlink()
    for name in (file.name, "manifest.json"):
        (file.parent / atomic.temporary_name(name).replace(f"-{os.getpid()}-", "-1-")).write_bytes(b"half")  # init
    ended = subprocess.Popen(["true"])
    ended.wait()
    for folder in (tmp_path, tmp_path / "reports"):
        (folder / atomic.temporary_name("x").replace(f"-{os.getpid()}-", f"-{ended.pid}-")).write_bytes(b"half")
    assert flow(fleet, tmp_path) == 0
    left = {name for name in tree(tmp_path) if name not in single}
    assert left == {name for name in left if "manifest.json" in name} and not list((tmp_path / "reports").glob(".*"))


def test_a_folder_without_manifest_has_no_complete_frames(tmp_path: Path) -> None:
    (tmp_path / "1.feather").write_bytes(b"ARROW1")
    assert complete_frames(tmp_path) == set()
    (tmp_path / "manifest.json").write_text("{}")
    (tmp_path / "2.feather").write_bytes(b"ARRO")
    assert complete_frames(tmp_path) == {1}
    with pytest.raises(CFlowError, match="no flow file"):
        read_flow(tmp_path / "1.feather")


def test_results_in_scenes_find_no_room(fleet: Path, tmp_path: Path) -> None:
    """The scene stays as it was; copies that a killed writer left are removed."""
    pytest.importorskip("h5py", reason="needs the extra hdf5")
    from cflow_torch.data.hdf5 import write_hdf5_scene
    from cflow_torch.data.hdf5.results import write_hdf5_results
    from cflow_torch.simulator import make_drive

    drive = make_drive(seed=0, num_sweeps=2, profile="demo")
    with SmallDisk(tmp_path / "disk", "size=50m") as disk:
        scene = disk.folder / "scene.h5"
        write_hdf5_scene(drive, scene)
        ended = subprocess.Popen(["true"])
        ended.wait()
        stale = disk.folder / atomic.temporary_name(scene.name).replace(f"-{os.getpid()}-", f"-{ended.pid}-")
        stale.write_bytes(b"half")
        before = scene.read_bytes()
        disk.change(f"size={2 * len(before) // 1024 + 60}k")
        results = [(drive.timestamps[0], np.ones((len(drive.sweep(0).points), 3), np.float32))]
        with pytest.raises(CFlowError, match="No space left on device.*make room"):
            write_hdf5_results(scene, "mine", results)
        assert [path.name for path in disk.folder.iterdir()] == ["scene.h5"] and scene.read_bytes() == before
        disk.change("size=50m")
        assert write_hdf5_results(scene, "mine", results) == 1
