"""Several paths in a call, several data sets in an output, and what is checked before anything is computed."""

from __future__ import annotations

import shutil
import sys
from pathlib import Path
from typing import Any, Callable

import pytest
from small_logs import make_small_drive, write_small_log

from cflow_torch.cli import flow
from cflow_torch.data.arrays import write_array_log
from cflow_torch.data.json_file import read_json
from cflow_torch.errors import CFlowError, warn
from cflow_torch.fleet.progress import show_warnings_as_lines

MODEL = ("model=paper", "model.point_cloud_range=[-20,-20,-inf,20,20,inf]", "model.pixel_sizes=[0.4]")
SMALL = (*MODEL, "data.check=false")
OF_DEMO = "command: demo\nversions: {cflow_torch: 1}\n"


@pytest.fixture
def drives(log_folder: Path, tmp_path: Path) -> list[Path]:
    """Two logs of three pairs."""
    return [Path(shutil.copytree(log_folder, tmp_path / f"drive_{number}")) for number in (1, 2)]


def times(folder: Path) -> dict[Path, int]:
    return {file: file.stat().st_mtime_ns for file in folder.rglob("*") if file.is_file()}


def test_all_paths_and_patterns_are_processed(drives, tmp_path, cflow, capsys):
    call = ("flow", *SMALL, "engine.workers=1")
    assert cflow(*call, *drives, f"output={tmp_path / 'paths'}") == 0
    assert cflow(*call, tmp_path / "drive_*", f"output={tmp_path / 'pattern'}") == 0
    for output in (tmp_path / "paths", tmp_path / "pattern"):
        assert len(list(output.glob("drive_1/*.feather"))) == len(list(output.glob("drive_2/*.feather"))) == 3
    assert cflow("eval", *SMALL, *drives, f"output={tmp_path / 'eval'}") == 0
    assert "6 frames" in capsys.readouterr().out
    assert cflow("check", *drives, "data.check=false") in (0, 1)
    assert [line for line in capsys.readouterr().out.splitlines() if " (av2): " in line]
    for command in ("stream", "plot", "bench"):
        assert cflow(command, *drives, f"output={tmp_path / command}") == 2
        assert "paths were given: give one of them" in capsys.readouterr().err


def test_paths_of_several_formats_are_an_error(drives, tmp_path, cflow, capsys):
    other = write_small_log("arrays", tmp_path / "other")
    assert cflow("flow", *SMALL, drives[0], other, f"output={tmp_path / 'out'}") == 2
    assert "several formats, arrays and av2" in capsys.readouterr().err and not (tmp_path / "out").exists()


def test_a_path_takes_the_settings_of_its_format(drives, tmp_path, cflow, capsys):
    folder = write_small_log("arrays", tmp_path / "arrays")
    assert cflow("flow", *SMALL, folder, "data.times=null", f"output={tmp_path / 'out'}", "engine.workers=1") == 0
    assert list(tmp_path.glob("out/*/0.feather")), "time stamps are indices"
    assert cflow("flow", *SMALL, drives[0], "data.times=null", f"output={tmp_path / 'other'}") == 2
    assert "data=av2 has no such setting" in capsys.readouterr().err


def test_flow_touches_only_the_logs_of_its_run(drives, tmp_path, cflow, capsys):
    call = ("flow", *SMALL, f"output={tmp_path / 'out'}", "engine.workers=1")
    assert cflow(*call, drives[0]) == 0
    first = times(tmp_path / "out" / "drive_1")
    assert cflow(*call, drives[1], "model.connectivity=4") == 0, "another method, another log"
    assert cflow(*call, drives[0], "model.connectivity=4") == 2
    assert "drive_1 has results of another run (method.connectivity was 8, is 4)" in capsys.readouterr().err
    assert cflow(*call, drives[0], "overwrite=true", "device=cuda:99") == 2
    assert "device=cuda:99 cannot be used" in capsys.readouterr().err
    assert cflow(*call, drives[1], "overwrite=true") == 0
    assert times(tmp_path / "out" / "drive_1") == first
    assert cflow(*call, *drives) == 0
    assert "complete before  6" in capsys.readouterr().out


def test_clean_resumes_and_overwrites_as_flow_does(drives, tmp_path, cflow, capsys):
    out = tmp_path / "out"
    call = ("clean", *SMALL, f"output={out}")
    assert cflow(*call, drives[0], "map=true", "voxel_size=0.2") == 0 and (out / "drive_1" / "map.ply").exists()
    first = times(out / "drive_1")
    assert cflow(*call, *drives, "voxel_size=0.2") == 0
    assert times(out / "drive_1") == first and (out / "drive_2" / "points").is_dir()
    second = times(out / "drive_2")
    assert cflow(*call, drives[0], "remove_stopped=true") == 2
    error = capsys.readouterr().err
    assert "remove_stopped was False, is True" in error and "overwrite=true" in error
    assert cflow(*call, drives[0], "remove_stopped=true", "overwrite=true") == 0
    assert times(out / "drive_1").values() != first.values() and not (out / "drive_1" / "map.ply").exists()
    assert times(out / "drive_2") == second
    shutil.rmtree(drives[1])
    shutil.copytree(drives[0], drives[1])
    next((drives[1] / "sensors" / "lidar").iterdir()).unlink()
    assert cflow(*call, drives[1], "voxel_size=0.2") == 2, "another log of this name"
    assert times(out / "drive_2") == second


def files_of(folder: Path) -> dict[Path, bytes]:
    return {file: file.read_bytes() for file in folder.rglob("*") if file.is_file()}


def test_clean_removes_nothing_that_it_has_not_written(tmp_path, cflow, capsys):
    """The parent of the drive as the output, with and without overwrite: the raw data and other files stay."""
    write_array_log(make_small_drive(num_sweeps=3), tmp_path, ".npy")
    (drive,) = tmp_path.iterdir()
    for suffix in (".ply", ".png", ".json"):
        drive.with_name(f"{drive.name}{suffix}").write_text("of the user")
    before = files_of(tmp_path)
    call = ("clean", *SMALL, "map=true", "voxel_size=0.5")
    for more in ((), ("overwrite=true",)):
        assert cflow(*call, drive, f"output={tmp_path}", *more) == 2
        error = capsys.readouterr().err
        assert "is not a result of `cflow clean`: give output=FOLDER" in error and "overwrite" not in error
    assert files_of(tmp_path) == before
    results = tmp_path / "results"
    results.mkdir()
    (results / f"{drive.name}.ply").write_text("of the user")
    for more in ((), ("overwrite=true",)):
        assert cflow(*call, drive, f"output={results}", *more) == 0
    assert {path.name for path in results.iterdir()} == {drive.name, f"{drive.name}.ply", "config.yaml"}
    clean = files_of(results)
    assert cflow(*call, results / drive.name, f"output={results}", "overwrite=true") == 2, "its own input"
    assert "has the log that is to be cleaned" in capsys.readouterr().err and files_of(results) == clean


@pytest.mark.parametrize(
    ("command", "content"),
    [
        *(("flow", content) for content in ("name: mine\n", "{", "- 1\n", OF_DEMO)),
        *((command, OF_DEMO) for command in ("clean", "eval")),
    ],
)
def test_a_config_of_another_program_or_command_is_not_replaced(command, content, drives, tmp_path, cflow, capsys):
    config = tmp_path / "out" / "config.yaml"
    config.parent.mkdir()
    config.write_text(content)
    assert cflow(command, *SMALL, drives[0], f"output={config.parent}", "overwrite=true") == 2
    assert f"is not a record of `cflow {command}`" in capsys.readouterr().err and config.read_text() == content


def test_clean_names_a_second_log_of_a_name(drives, tmp_path, cflow, capsys):
    twin = Path(shutil.copytree(drives[0], tmp_path / "elsewhere" / "drive_1"))
    next((twin / "sensors" / "lidar").iterdir()).unlink()
    call = ("clean", *SMALL, f"output={tmp_path / 'out'}", "overwrite=true")
    for _ in range(2):
        assert cflow(*call, drives[0], twin) == 1
        assert "rename one of two logs of this name" in capsys.readouterr().err
        assert len(list((tmp_path / "out" / "drive_1" / "points").iterdir())) == 4


def test_a_run_whose_tracks_fail_names_them_and_not_its_frames(drives, tmp_path, cflow, monkeypatch, capsys):
    def refuse(*_: Any) -> None:
        raise CFlowError("no room")

    monkeypatch.setattr(flow, "_write_tracks", refuse)
    call = ("flow", "data.check=false", drives[0], f"output={tmp_path / 'out'}", "engine.workers=1")
    assert cflow(*call, "model.num_history=0", "model.point_cloud_range=[-9,-9,-inf,9,9,inf]", "tracks=true") == 1
    assert capsys.readouterr().err.endswith("missing:\n  drive_1: no room\n")
    report = read_json(tmp_path / "out" / "reports" / "shard-0-of-1.json")
    assert (report["status"], report["exit_status"]) == ("incomplete", 1)
    assert report["failures"] == [["drive_1", "no room"]] and report["frames"]["failed"] == 0


def test_a_run_without_a_frame_claims_nothing(drives, tmp_path, cflow):
    for file in (drives[0] / "sensors" / "lidar").iterdir():
        file.write_bytes(b"broken")
    call = ("flow", *SMALL, drives[0], f"output={tmp_path / 'out'}", "engine.workers=1")
    assert cflow(*call) == cflow(*call, "model.max_speed=20") == 1, "other settings are not rejected"


@pytest.mark.parametrize(
    ("package", "call", "extra"),
    [
        ("scipy.spatial", ("label", "hdf5", "model=offline"), "extra label"),
        ("pypcd4", ("clean", "arrays", "suffix=.pcd"), "extra clouds"),
        ("imageio_ffmpeg", ("plot", "arrays", "picture=animation", "format=mp4"), "extra video"),
    ],
)
def test_what_a_command_needs_is_checked_first(package, call, extra, tmp_path, monkeypatch, cflow, capsys):
    pytest.importorskip("h5py"), pytest.importorskip("matplotlib")
    command, name, *settings = call
    data = write_small_log(name, tmp_path / "data")
    monkeypatch.setitem(sys.modules, package, None)
    assert cflow(command, data, *settings, f"output={tmp_path / 'out'}") == 2
    assert extra in capsys.readouterr().err and not (tmp_path / "out").exists()


def test_a_second_eval_prints_its_tables(log_folder, tmp_path, cflow, capsys):
    log = shutil.copytree(log_folder, tmp_path / log_folder.name)
    call = ("eval", *SMALL, log, f"output={tmp_path / 'out'}")
    texts = []
    for _ in range(2):
        assert cflow(*call) == 0
        texts.append(capsys.readouterr().out)
    assert "| **mean**" in texts[0] and "skipped, its results exist" in texts[1]
    assert texts[1].endswith(texts[0].partition("\n")[2])
    next((log / "sensors" / "lidar").iterdir()).unlink()
    assert cflow(*call) == 2 and "(added, removed or changed: " in capsys.readouterr().err, "the log has changed"


def test_a_warning_is_shown_once(monkeypatch: Any, capsys: Any) -> None:
    monkeypatch.setattr("warnings.showwarning", None)
    show_warnings_as_lines()
    calls: list[Callable[[], None]] = [lambda: warn("the same"), lambda: warn("the same"), lambda: warn("another")]
    for call in calls:
        call()
    assert capsys.readouterr().err.splitlines() == ["warning: the same", "warning: another"]
