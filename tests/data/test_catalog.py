"""Every data set by name: found, opened with its reader's settings, given ground masks, scored from its own format."""

from __future__ import annotations

import json
import pickle
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
from command_line import cflow
from pyarrow import csv, feather, parquet
from small_logs import make_small_drive
from writers import FORMATS

import cflow_torch
from cflow_torch.data.arrays import write_array_log
from cflow_torch.data.arrays.cloud_file import read_cloud
from cflow_torch.data.catalog import GroundSegmentedLog, Logs, find_sources, open_log, recognise, source_name
from cflow_torch.data.log import Log, window
from cflow_torch.simulator import Drive
from cflow_torch.simulator.benchmark import benchmark_logs
from cflow_torch.simulator.writers.av2 import write_av2_log
from cflow_torch.types import CFlowError, CFlowWarning


@pytest.fixture(scope="module")
def drive() -> Drive:
    return make_small_drive(num_sweeps=3)


@pytest.fixture(scope="module")
def arrays(drive: Drive, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The drive as a folder of .npy files without ground masks."""
    folder = write_array_log(drive, tmp_path_factory.mktemp("arrays"))
    (folder / "ground").rename(folder.parent / "ground")
    return folder


def check_scores(folder: Path, *data: str) -> None:
    """Score the logs of the data settings."""
    assert cflow("eval", *data, "data.first=1", "model=paper", f"output={folder}") == 0
    record = json.loads((folder / "results.json").read_text())
    assert record["num_pairs"] >= 2 and not record["failures"]
    dynamic, static = record["results"]["three_way"]["epe_fd"], record["results"]["three_way"]["epe_bs"]
    assert dynamic < 0.9 and static < 0.2, "most moving objects are found, and static points stay"


@pytest.mark.parametrize("profile", FORMATS)
@pytest.mark.slow
def test_a_simulated_drive_of_every_sensor_is_scored_from_its_own_format(profile: str, tmp_path: Path) -> None:
    chosen = FORMATS[profile]
    benchmark_logs(tmp_path / "cache", profile, [300], 4, chosen=chosen)
    (root,) = (tmp_path / "cache").glob("*/*")
    settings = [f"data.{name}={value}" for name, value in {**chosen.settings, "check": "false"}.items()]
    check_scores(tmp_path / "out", f"data={chosen.data_set}", f"data.root={root}", *settings)


@pytest.mark.parametrize("profile", ["av2", pytest.param("waymo", marks=pytest.mark.slow)])
def test_a_simulated_drive_of_a_sensor_is_scored(profile: str, tmp_path: Path) -> None:
    data = ("data=benchmark_sensors", f"data.profile={profile}", f"data.cache={tmp_path}", "data.num_drives=1")
    check_scores(tmp_path / "out", *data, "data.num_sweeps=4")


def test_ground_is_found_where_there_is_no_mask(drive: Drive, arrays: Path) -> None:
    (source,) = find_sources("arrays", arrays)
    assert open_log("arrays", source, find_ground=None).sweep(0).is_ground is None
    with pytest.warns(CFlowWarning, match="no ground masks, so we find the ground .find_ground=auto"):
        default = open_log("arrays", source)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        log: Any = open_log("arrays", source, find_ground="grid")
    truth, found = drive.sweep(1).is_ground, log.sweep(1).is_ground
    assert np.array_equal(default.sweep(1).is_ground, found)
    assert found.dtype == np.bool_ and (found & truth).sum() / (found | truth).sum() > 0.9
    assert log.labels(0) is None and log.log_id == drive.log_id and np.array_equal(log.poses, drive.poses)
    assert log.eval_mask(0) is None and pickle.loads(pickle.dumps(log)).files == log.files
    kept = GroundSegmentedLog(drive).sweep(0).is_ground
    assert np.array_equal(kept, drive.sweep(0).is_ground), "an existing mask is kept"


@pytest.mark.parametrize(
    "name, settings, complaint",
    [
        ("lyft", {}, "one of av2, hdf5"),
        ("arrays", {"clouds": "raw"}, "no setting clouds; it has poses"),
        ("arrays", {"find_ground": "magic"}, "find_ground='magic'"),
        ("arrays", {"suffix": 5}, "arrays cannot be opened with suffix=5"),
        ("arrays", {"times": 5}, "5' is not a valid path"),
    ],
)
def test_wrong_settings_are_refused(arrays: Path, name: str, settings: dict[str, Any], complaint: str) -> None:
    with pytest.raises(CFlowError, match=complaint):
        open_log(name, arrays, **settings)


@pytest.mark.parametrize(
    "name, log", [("av2", "sensors/lidar/1.npy"), ("aevascenes", "sequence.json"), ("arrays", "1.npy")]
)
def test_logs_are_found_below_and_at_a_folder(name: str, log: str, tmp_path: Path) -> None:
    """Folders below a log, hidden folders and folders deeper than the layouts are not searched."""
    for place in ("b", "a/x", "b/points/y", ".hidden", "1/2/3/4/5"):
        for file in (log, log.replace("1", "2")):
            (tmp_path / place / file).parent.mkdir(parents=True, exist_ok=True)
            (tmp_path / place / file).write_bytes(b"")
    assert find_sources(name, tmp_path) == [tmp_path / "a" / "x", tmp_path / "b"]
    assert find_sources(name, tmp_path / "b") == [tmp_path / "b"]
    with pytest.raises(CFlowError, match="nowhere is not a folder"):
        find_sources(name, tmp_path / "nowhere")
    chain = tmp_path / "c/h/a/i/n"
    for file in (log, log.replace("1", "2")):
        (chain / "1/2/3" / file).parent.mkdir(parents=True, exist_ok=True)
        (chain / "1/2/3" / file).write_bytes(b"")
    (chain / "other").mkdir()
    assert find_sources(name, tmp_path / "c") == [chain / "1/2/3"], "folders that are alone cost no depth"


@pytest.mark.parametrize(
    ("names", "message"),
    [
        ([], "it has no files"),
        (["a.pcd.gz"], r"it has one file of points \(\.pcd\)"),
        (["a.gz"], r"its 1 \.gz files are not read: unpack them"),
        (["a.las", "b.laz", "c.las"], "its 2 .las files are not read: convert them with pdal"),
        (["a/1.xyz", "a/2.xyz"], "its 2 .xyz files are not read"),
        (["a.las", "b.las", "poses.txt"], "its 2 .las files are not read"),
        (["drive_0.db3.zstd"], r"its 1 \.zstd files are not read: unpack them"),
        (["a/1.xyz"], r"it has one file of points \(.xyz\); .* a file for each of two sweeps"),
        (["1.pcd"], "it has one file of points"),
        (["0/points.ply", "1/points.ply"], "its 2 .ply files lie alone in their folders: put those of a log into one"),
        (["a.pcap"], "its 1 .pcap files are not read"),
        (["a.pcap", "a.json", "b.json", "poses.txt", "times.txt"], "its 1 .pcap files are not read"),
        (["a.osf"], "its 1 .osf files are not read"),
    ],
)
def test_what_is_not_read_is_said(names: list, message: str, tmp_path: Path) -> None:
    for name in names:
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_bytes(b"")
    with pytest.raises(CFlowError, match=message):
        recognise(tmp_path)
    if len(names) == 1:
        with pytest.raises(CFlowError, match=message):
            recognise(tmp_path / names[0])


def test_a_path_is_opened_with_one_call(drive: Drive, arrays: Path, tmp_path: Path) -> None:
    log = cflow_torch.open(arrays, find_ground="grid")
    assert isinstance(log, Log) and log.log_id == drive.log_id
    pairs = list(log.windows(num_history=1))
    assert [len(pair.pch) for pair in pairs] == [0, 1]
    expected = window(open_log("arrays", arrays, find_ground="grid"), 1, 1)
    assert np.array_equal(pairs[1].pch[0].points, expected.pch[0].points)
    assert np.array_equal(pairs[1].pc1.is_ground, expected.pc1.is_ground)

    for name in ("one", "two"):
        (tmp_path / name).symlink_to(arrays)
    (tmp_path / "two_more").mkdir()
    broken = tmp_path / "two_more" / "000000.npy"
    broken.write_bytes(b"")
    broken.with_name("000001.npy").write_bytes(b"")
    logs = cflow_torch.open(tmp_path, find_ground="grid", check=False)
    assert isinstance(logs, Logs) and len(logs) == 3 and "3 logs" in repr(logs)
    assert len(list(logs[:2].windows())) == 4 and logs[1].log_id
    with pytest.raises(CFlowError):
        logs[2][0]
    with pytest.raises(CFlowError, match="has no setting sweeps"):
        cflow_torch.open(arrays, sweeps=3)
    with pytest.raises(CFlowError, match="data set 'ply'"):
        cflow_torch.open(arrays, data="ply")


def test_several_paths_and_patterns_are_opened_with_one_call(drive: Drive, tmp_path: Path) -> None:
    for name in ("drive_1", "drive_2", "other"):
        write_array_log(drive, tmp_path / name)
    logs: Any = cflow_torch.open(tmp_path / "drive_*", check=False)
    assert len(logs) == 2 and len(logs[0]) == len(drive)
    assert len(cflow_torch.open([tmp_path / "drive_1", str(tmp_path / "*")], check=False)) == 3, "paths may overlap"
    with pytest.raises(CFlowError, match="no file or folder matches this pattern"):
        cflow_torch.open(tmp_path / "drives_*")
    write_av2_log(drive, tmp_path / "av2")
    with pytest.raises(CFlowError, match="several formats, arrays and av2"):
        cflow_torch.open(str(tmp_path / "*"))


def test_the_name_open_does_not_hide_that_of_python() -> None:
    names: dict[str, Any] = {}
    exec("from cflow_torch import *", names)
    assert "open" not in names and "estimate_flow" in names and "open" in dir(cflow_torch)


@pytest.mark.parametrize(
    ("name", "file"),
    [("hdf5", "scene.h5"), ("hdf5", "train/scene.h5"), ("waymo", "lidar/a.parquet"), ("bags", "drive.bag")],
)
def test_hidden_files_are_no_logs(name: str, file: str, tmp_path: Path) -> None:
    """macOS puts a file ._NAME next to each file."""
    path = tmp_path / file
    path.parent.mkdir(exist_ok=True)
    for each in (path, path.with_name(f"._{path.name}")):
        each.write_bytes(b"")
    assert find_sources(name, tmp_path) == [path]


def test_results_in_the_folder_of_the_data_are_no_input(tmp_path: Path) -> None:
    """Else flow was computed of flow, and the first log got another name, so a run was not resumed."""
    for place in ("drive/points", "flow/drive", "clean/drive/points"):
        (tmp_path / place).mkdir(parents=True)
        for number in range(2):
            np.save(tmp_path / place / f"{number}.npy", np.ones((5, 3)))
    record = json.dumps({"run": {"versions": {"cflow_torch": "1"}}})
    (tmp_path / "flow" / "drive" / "manifest.json").write_text(record)
    (tmp_path / "clean" / "drive" / "clean.json").write_text(record)
    assert find_sources("arrays", tmp_path) == [tmp_path / "drive"]
    assert find_sources("arrays", tmp_path / "clean") == [tmp_path / "clean" / "drive"], "a clean log alone is one"
    (tmp_path / "flow" / "drive" / "manifest.json").write_text("{}")
    assert len(find_sources("arrays", tmp_path)) == 2, "a file of that name of others means nothing"


def test_logs_of_one_name_are_told_apart(tmp_path: Path) -> None:
    """Else the results of the second one would be taken for those of the first."""
    for place in ("monday/run", "tuesday/run", "tuesday/walk"):
        (tmp_path / place).mkdir(parents=True)
        for number in range(2):
            np.save(tmp_path / place / f"{number}.npy", np.ones((5, 3)))
    logs: Any = cflow_torch.open(tmp_path, check=False)
    assert [log.log_id for log in logs] == ["monday-run", "tuesday-run", "walk"]
    assert [source_name(source) for source in logs.sources] == ["monday-run", "tuesday-run", "walk"]
    assert cflow_torch.open(tmp_path / "monday", check=False).log_id == "run"


@pytest.mark.parametrize(
    ("clouds", "other"),
    [
        ("sensors/lidar", "poses.txt"),  # AV2
        ("lidar", "lidar/poses.json"),  # PandaSet
        ("points", "features.h5"),
        ("points", "imu.bag"),
        ("points", "sequence.json"),  # AevaScenes
        ("velodyne_points", "poses.txt"),  # KITTI
    ],
)
def test_folders_of_clouds_may_be_called_as_those_of_a_data_set(clouds: str, other: str, tmp_path: Path) -> None:
    folder = tmp_path / "drive" / clouds
    folder.mkdir(parents=True)
    for number in range(2):
        np.ones((9, 4), np.float32).tofile(folder / f"{number:06d}.bin")
    (tmp_path / "drive" / other).write_text("1 0 0 0 0 1 0 0 0 0 1 0\n" * 2 if other == "poses.txt" else "[]")
    assert recognise(tmp_path) == "arrays"
    assert len(cflow_torch.open(tmp_path, check=False)) == 2


def test_labels_and_boxes_are_no_logs(tmp_path: Path) -> None:
    for place in ("scans", "labels", "annotations"):
        (tmp_path / place).mkdir()
        for number in range(2):
            np.save(tmp_path / place / f"{number}.npy", np.ones((5, 3)))
    assert find_sources("arrays", tmp_path) == [tmp_path / "scans"]


@pytest.mark.parametrize("shape", [(64, 900), (5,), (5, 2), (900, 2)])
def test_images_and_labels_in_arrays_are_no_logs(shape: tuple, tmp_path: Path) -> None:
    for place, of_place in (("scans", (900, 3)), ("depth", shape)):
        (tmp_path / place).mkdir()
        for number in range(2):
            np.save(tmp_path / place / f"{number}.npy", np.ones(of_place))
    assert find_sources("arrays", tmp_path) == [tmp_path / "scans"]


@pytest.mark.parametrize("shape", [(0, 0), (0, 3), (0,)])
def test_an_empty_first_array_does_not_tell_what_a_folder_holds(shape: tuple, tmp_path: Path) -> None:
    for place, others in (("scans", (5, 3)), ("classes", (5,))):
        (tmp_path / place).mkdir()
        for number in range(3):
            np.save(tmp_path / place / f"{number}.npy", np.ones(others if number else shape))
    assert find_sources("arrays", tmp_path) == [tmp_path / "scans"]
    assert len(cflow_torch.open(tmp_path / "scans", check=False)) == 3


def write_table(table: pa.Table, file: Path) -> None:
    write = {".feather": feather.write_feather, ".parquet": parquet.write_table, ".csv": csv.write_csv}[file.suffix]
    write(table, str(file))


@pytest.mark.parametrize("suffix", [".feather", ".parquet", ".csv"])
def test_tables_of_boxes_are_no_clouds(suffix: str, tmp_path: Path) -> None:
    """Their times repeat, so they are not a trajectory either."""
    names = ["timestamp_ns", "length_m", "width_m", "height_m", "qw", "qx", "qy", "qz", "tx_m", "ty_m", "tz_m"]
    table = pa.table({name: np.full(30, 0.5) for name in names})
    for name in ("objects_1", "objects_2"):
        write_table(table, tmp_path / (name + suffix))
    with pytest.raises(CFlowError, match="poses or boxes"):
        read_cloud(tmp_path / f"objects_1{suffix}")
    with pytest.raises(CFlowError, match="no folder of point clouds"):
        find_sources("arrays", tmp_path)


@pytest.mark.parametrize("suffix", [".feather", ".parquet", ".csv"])
def test_points_of_mobile_mapping_have_angles_and_are_clouds(suffix: str, tmp_path: Path) -> None:
    file = tmp_path / f"scan{suffix}"
    angles = {name: np.full(30, 0.5) for name in ("heading", "pitch", "roll")}
    write_table(pa.table({**dict(zip("XYZ", np.eye(30)[:3])), **angles}), file)
    assert np.array_equal(read_cloud(file), np.eye(30)[:, :3])
    write_table(pa.table({**dict(zip(("tx_m", "ty_m", "tz_m"), np.eye(30)[:3])), **angles}), file)
    with pytest.raises(CFlowError, match="poses or boxes"):
        read_cloud(file)
