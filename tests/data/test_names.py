"""One rule for names out of data: they become folders and files of their own, and lie where they should."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any, Dict

import numpy as np
import pytest
from tiny_recording import TinyRecording

from cflow_torch import CFlowError, Sweep
from cflow_torch.config import Config
from cflow_torch.data.aevascenes import AevaScenesLog
from cflow_torch.data.arrays import write_array_log
from cflow_torch.data.catalog import find_sources, open_log
from cflow_torch.data.names import folder_in, inside, is_safe_name, is_stamp, safe_name, same_names
from cflow_torch.evaluation.submission import get_version, plan_log, write_frame
from cflow_torch.evaluation.submission.plan import read_frame_list, require_logs
from cflow_torch.fleet.job import Failed, Job, Unit
from cflow_torch.fleet.manifest import claim_folder, claim_log, make_identity
from cflow_torch.fleet.run import report_file
from cflow_torch.fleet.shard import Shard
from cflow_torch.fleet.work import Worker
from cflow_torch.simulator.writers.aevascenes import write_aevascenes_sequence
from cflow_torch.simulator.writers.nuscenes import write_nuscenes
from cflow_torch.simulator.writers.truckscenes import write_truckscenes
from cflow_torch.simulator.writers.waymo import write_waymo_segment

BAD = (
    *("", ".", "..", "../up", "/etc/passwd", "a/b", "a\\b", "..\\up", "C:", "c:x", "\\\\host\\share", ".hidden"),
    *("a\0b", "a\nb", "\x7f", "\x85", "\u2028", "\ud800", "a.", "a ", "CON", "con", "aux.txt", "Nul.tar.gz", "COM1"),
    *("lpt9.x", "COM\u00b9", "CONIN$", "nul .txt", "n" * 256, "\U0001f600" * 64),
)
GOOD = (
    *(
        "scene-0001",
        "10203656353524179475_7625_000_7645_000",
        "a b",
        "é\U0001f600",
        "2024-01-01T12:00:00",
        "con2",
        "aux_",
    ),
    *("n" * 255, "\U0001f600" * 63, "a..b", "COM10", "console", "-", "@home", "a=b,c"),
)


@pytest.mark.parametrize("name", BAD)
def test_names_that_are_refused(name: str) -> None:
    assert not is_safe_name(name)
    with pytest.raises(CFlowError, match="the scene .* is no folder name and no file name: ") as error:
        safe_name(name, "the scene")
    assert str(error.value).isprintable() and len(str(error.value)) < 300


def test_what_is_no_text_is_no_name() -> None:
    for value in (None, 5, b"a", ["a"], Path("a")):
        with pytest.raises(CFlowError, match="no text"):
            safe_name(value, "the scene")


@pytest.mark.parametrize("name", GOOD)
def test_names_that_are_taken(name: str, tmp_path: Path) -> None:
    assert safe_name(name, "the scene") == name
    (tmp_path / name).mkdir()
    assert folder_in(tmp_path, name, "the log") == tmp_path / name


def test_files_that_tables_name_lie_below_the_folder(tmp_path: Path) -> None:
    assert (
        inside(tmp_path, "samples/LIDAR_TOP/x__1.pcd.bin", "f") == tmp_path / "samples" / "LIDAR_TOP" / "x__1.pcd.bin"
    )
    assert inside(tmp_path, "./a//b.npz", "f") == tmp_path / "a" / "b.npz"
    for relative in ("/etc/passwd", "../x", "a/../../x", "a/..", "\\\\host\\x", "\\x"):
        with pytest.raises(CFlowError, match="f .* leaves "):
            inside(tmp_path, relative, "f")
    for relative in (
        *(f"a/{name}" for name in BAD if name not in ("", ".", "..", "../up", "/etc/passwd", "a/b")),
        "C:/x",
    ):
        with pytest.raises(CFlowError, match="f .* is not read"):
            inside(tmp_path, relative, "f")
    for relative in ("", ".", "/".join("a" * 100), None, 5):
        with pytest.raises(CFlowError, match="parts|expected the name"):
            inside(tmp_path, relative, "f")


def test_links_in_the_data_are_followed_links_in_the_output_are_not(tmp_path: Path) -> None:
    elsewhere, output = tmp_path / "elsewhere", tmp_path / "output"
    elsewhere.mkdir(), output.mkdir()
    (elsewhere / "x.bin").write_bytes(b"data")
    (output / "data").symlink_to(elsewhere)
    assert inside(output, "data/x.bin", "f").read_bytes() == b"data", "users link data sets"
    with pytest.raises(CFlowError, match="is a link to .*elsewhere, outside of"):
        folder_in(output, "data", "the log")
    (output / "kept").mkdir()
    (output / "other").symlink_to(output / "kept")
    assert folder_in(output, "other", "the log").is_dir(), "it stays inside"
    (tmp_path / "linked").symlink_to(output)
    assert folder_in(tmp_path / "linked", "new", "the log") == tmp_path / "linked" / "new", "the output may be a link"


def test_names_that_some_file_systems_take_for_one() -> None:
    assert same_names(["a", "b", "A", "c", "c"]) == ["A", "a", "c"]
    assert same_names(["Ärger", "A\u0308rger", "straße", "STRASSE"]) == ["A\u0308rger", "STRASSE", "straße", "Ärger"]
    assert same_names(["scene-1", "scene-10"]) == []


def test_time_stamps_as_names() -> None:
    assert is_stamp("315966000000000000") and is_stamp("0")
    for name in ("", "-1", "²", "\u0663", "1e5", "9" * 19 + "0", "9223372036854775808", " 1"):
        assert not is_stamp(name), name


# ------------------------------------------------------------------------------------------------ readers and writers


class Named:
    """Two sweeps under any name."""

    timestamps = [315_966_000_000_000_000, 315_966_000_100_000_000]

    def __init__(self, log_id: str) -> None:
        self.log_id = log_id

    def sweep(self, index: int) -> Sweep:
        return Sweep(np.zeros((4, 3), np.float32), None, np.eye(4), self.timestamps[index])

    def labels(self, index: int) -> None:
        return None


@pytest.mark.parametrize("write", [write_nuscenes, write_truckscenes, write_aevascenes_sequence, write_waymo_segment])
def test_writers_of_recordings(write: Any, tmp_path: Path) -> None:
    root = tmp_path / "a" / "b"
    for name in ("../up", "a/b", "", "..", "a\0b", "/etc/x"):
        with pytest.raises(CFlowError, match="folder name and no file name"):
            write(TinyRecording(("LIDAR_TOP",), num_sweeps=2, log_id=name), root)
    assert not root.exists() or not list(root.iterdir())


def test_writers_of_logs(tmp_path: Path) -> None:
    for name in ("../up", "CON", ""):
        with pytest.raises(CFlowError, match="folder name and no file name"):
            write_array_log(Named(name), tmp_path / "a", poses=None)
        with pytest.raises(CFlowError, match="folder name and no file name"):
            plan_log(Named(name), get_version(3))
        with pytest.raises(CFlowError, match="folder name and no file name"):
            write_frame(tmp_path / "v3", f"{name}/1.feather", {"a": np.zeros(1)})
    assert list(tmp_path.iterdir()) == []


def change(root: Path, table: str, values: Dict[str, Any]) -> None:
    (file,) = root.rglob(f"{table}.json")
    rows = json.loads(file.read_text())
    for row in rows:
        row.update(values)
    file.write_text(json.dumps(rows))


def test_a_scene_cannot_leave_the_output(tmp_path: Path) -> None:
    root = write_nuscenes(TinyRecording(("LIDAR_TOP",), num_sweeps=2), tmp_path / "data")
    for name in ("../../escaped", "/tmp/escaped", "..", "aux"):
        change(root, "scene", {"name": name})
        with pytest.raises(CFlowError, match="scene.json: the scene .* is no folder name"):
            find_sources("nuscenes", root)


@pytest.mark.parametrize(
    "name", ["../../secret.pcd.bin", "/etc/hostname", "samples/../../x", "C:/x", "a\\..\\x", "a\0b"]
)
def test_a_file_of_a_table_cannot_leave_the_data(name: str, tmp_path: Path) -> None:
    root = write_nuscenes(TinyRecording(("LIDAR_TOP",), num_sweeps=2), tmp_path / "data" / "deep")
    (tmp_path / "secret.pcd.bin").write_bytes(np.zeros((3, 5), "<f4").tobytes())
    change(root, "sample_data", {"filename": name})
    log = open_log("nuscenes", find_sources("nuscenes", root)[0], check=False)
    with pytest.raises(CFlowError, match="the filename in sample_data.json .* (leaves|is not read)"):
        log.sweep(0)


def test_a_cloud_of_a_sequence_cannot_leave_it(tmp_path: Path) -> None:
    folder = write_aevascenes_sequence(TinyRecording(("front",), num_sweeps=2), tmp_path)
    whole = json.loads((folder / "sequence.json").read_text())
    for name in ("../x.npz", "/x.npz", "a\0.npz", "NUL", 5, None):
        for cloud in whole["frames"][0]["point_cloud"].values():
            cloud.update(dict.fromkeys(cloud, name))
        (folder / "sequence.json").write_text(json.dumps(whole))
        with pytest.raises(CFlowError, match="the path"):
            AevaScenesLog(folder).sweep(0)


@pytest.mark.parametrize("name", ["aux", "a\nb", "trailing.", "con.1"])
def test_a_log_whose_folder_has_such_a_name_is_not_opened(name: str, tmp_path: Path) -> None:
    folder = tmp_path / name
    write_array_log(Named("log"), tmp_path, poses=None).rename(folder)
    with pytest.raises(CFlowError, match="is no folder name and no file name"):
        open_log("arrays", folder, check=False)


def test_names_of_files_that_are_no_time_stamps(tmp_path: Path) -> None:
    folder = write_array_log(Named("log"), tmp_path, poses=None)
    (folder / "times.txt").unlink()
    for index, name in enumerate(("²²²²²²²²²²²²²²²²", "1²")):
        np.save(folder / "points" / f"{name}.npy", np.zeros((4, 3), np.float32))
        assert len(open_log("arrays", folder, check=False).timestamps) == 3 + index


# -------------------------------------------------------------------------------------------------------------- runs


@pytest.fixture
def job(tmp_path: Path) -> Job:
    write_array_log(Named("log"), tmp_path / "data", poses=None)
    (tmp_path / "output").mkdir()
    return Job(Config(), "0" * 64, "arrays", {}, str(tmp_path / "output"))


def test_a_link_in_the_output_of_a_fleet_is_not_written_through(job: Job, tmp_path: Path) -> None:
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    (Path(job.output) / "log").symlink_to(elsewhere)
    events = list(Worker(job, "cpu", ahead=0, model=lambda windows: []).run(Unit(0, tmp_path / "data" / "log")))
    assert [type(event) for event in events] == [Failed] and "is a link to" in events[0].message
    (Path(job.output) / "reports").symlink_to(elsewhere)
    with pytest.raises(CFlowError, match="is a link to"):
        report_file(job.output, Shard())
    with pytest.raises(CFlowError, match="is a link to"):
        write_frame(job.output, "log/1.feather", {"a": np.zeros(1)})
    assert list(elsewhere.iterdir()) == []


def test_overwrite_removes_nothing_behind_a_link(job: Job, tmp_path: Path) -> None:
    other = tmp_path / "other run" / "log"
    other.mkdir(parents=True)
    (other / "315966000000000000.feather").write_bytes(b"flow")
    (other / "manifest.json").write_text("{}")
    output = Path(job.output)
    claim_folder(output, make_identity(Config(), "av2", {}), True, False, True)
    (output / "log").symlink_to(other)
    claim_folder(output, make_identity(Config(), "hdf5", {}), False, True, True)
    assert sorted(os.listdir(other)) == ["315966000000000000.feather", "manifest.json"]


def test_files_that_are_links_are_replaced_not_followed(tmp_path: Path) -> None:
    from cflow_torch.data.records import write_text

    (tmp_path / "precious").write_text("precious")
    (tmp_path / "config.yaml").symlink_to(tmp_path / "precious")
    write_text(tmp_path / "config.yaml", "new")
    assert (tmp_path / "precious").read_text() == "precious" and (tmp_path / "config.yaml").read_text() == "new"


def test_logs_of_names_that_differ_by_case_alone_are_not_packed_together() -> None:
    require_logs([Named("log-1"), Named("log-2")], None)
    with pytest.raises(CFlowError, match="several logs are called Log, log"):
        require_logs([Named("log"), Named("Log")], None)


def test_two_logs_never_share_a_folder(tmp_path: Path) -> None:
    """As on a file system that takes log and Log for one name."""
    claim_log(tmp_path, Named("log"), "0" * 64)
    with pytest.raises(CFlowError, match="two logs have one name"):
        claim_log(tmp_path, Named("Log"), "0" * 64)


def test_time_stamps_of_a_list_of_frames(tmp_path: Path) -> None:
    file = tmp_path / "frames.txt"
    for stamp in ("9" * 5000, "9" * 20, "²", "\u0663"):
        file.write_text(f"log/{stamp}\n", encoding="utf-8")
        with pytest.raises(CFlowError, match="line 1"):
            read_frame_list(file)
