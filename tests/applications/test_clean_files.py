"""Clean logs keep the form of their input: names, columns and types of its clouds; masks and counts of the rest."""

from __future__ import annotations

import gzip
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
from command_line import cflow
from pyarrow import feather, parquet
from staged_cars import Staged, straight

from cflow_torch import CFlowError, CleanLog, Sweep, make_model
from cflow_torch.applications.clean_files import stored_masks, write_clean_log
from cflow_torch.applications.cleaning import MaskedLog, static_map_with_intensity
from cflow_torch.data.arrays import ArraysLog, write_array_log
from cflow_torch.data.arrays.cloud_file import SUFFIXES, copy_rows, read_cloud, write_cloud

FAST = ("model.num_history=0", "model.pixel_sizes=[0.4,0.2]")
DRIVE = Staged([straight((1, 1), (0.9, 0.0), 4)])
NAMES = [f"scan_{1700000000 + index}.{index}00" for index in range(4)]  # seconds with decimals


def write_drive(folder: Path, suffix: str) -> None:
    """Write the staged drive in types and columns of a user."""
    folder.mkdir()
    for index, name in enumerate(NAMES):
        points = DRIVE.world(index)[0].astype(np.float64)
        ring = np.arange(len(points), dtype=np.uint16)
        intensity = np.linspace(0, 1, len(points), dtype=np.float32)
        file = folder / f"{name}{suffix}"
        if suffix == ".npy":
            kinds = [("intensity", "f4"), ("z", "f8"), ("y", "f8"), ("x", "f8"), ("ring", "u2"), ("normal", "f4", 3)]
            table = np.zeros(len(points), kinds)
            table["x"], table["y"], table["z"] = points.T
            table["ring"], table["intensity"], table["normal"][:, 2] = ring, intensity, 1.0
            np.save(file, table)
        elif suffix == ".npz":
            np.savez(file, lidar=points, ring=ring, sensor=np.array([7.0]))
        elif suffix in (".feather", ".parquet"):
            names = pa.array(["a"] * len(points))
            table = pa.table({"x": points[:, 0], "y": points[:, 1], "z": points[:, 2], "ring": ring, "of": names})
            (feather.write_feather if suffix == ".feather" else parquet.write_table)(table, file)
        elif suffix == ".bin":
            np.column_stack([points, intensity, ring]).astype("<f8").tofile(file)
        else:
            write_cloud(file, points, {"intensity": intensity, "ring": ring})


def content(file: Path) -> Any:
    """Columns of a file as another library reads them: (N,) records, or a dictionary of arrays."""
    if file.suffix == ".npy":
        return np.load(file)
    if file.suffix == ".npz":
        return dict(np.load(file))
    if file.suffix in (".feather", ".parquet"):
        return (feather if file.suffix == ".feather" else parquet).read_table(file)
    if file.suffix == ".bin":
        return np.fromfile(file, "<f8").reshape(-1, 5)
    if file.suffix == ".pcd":
        return pytest.importorskip("pypcd4").PointCloud.from_path(file).pc_data
    header, _, body = file.read_bytes().partition(b"end_header\n")
    assert b"property double x" in header and b"property ushort ring" in header
    return np.frombuffer(body, [("xyz", "<f8", 3), ("intensity", "<f4"), ("ring", "<u2")])


@pytest.mark.parametrize("suffix", [".npy", ".npz", ".bin", ".pcd", ".ply", ".feather", ".parquet"])
def test_the_clouds_of_a_folder_keep_their_names_columns_and_types(tmp_path: Path, suffix: str) -> None:
    if suffix == ".pcd":
        pytest.importorskip("pypcd4")
    write_drive(tmp_path / "drive", suffix)
    log = ArraysLog(tmp_path / "drive")
    removed = write_clean_log(CleanLog(log, flow=DRIVE.result), log, tmp_path / "clean")
    folder = tmp_path / "clean" / "drive"
    assert sorted(file.name for file in (folder / "points").iterdir()) == [f"{name}{suffix}" for name in NAMES]
    count = 0
    for index, name in enumerate(NAMES):
        mask = np.load(folder / "removed" / f"{name}.npy")
        assert np.array_equal(mask, DRIVE.world(index)[2] >= 0) and mask.dtype == bool
        count += int(mask.sum())
        given = content(tmp_path / "drive" / f"{name}{suffix}")
        kept = content(folder / "points" / f"{name}{suffix}")
        if suffix in (".feather", ".parquet"):
            assert kept.equals(given.filter(pa.array(~mask)))
        elif suffix == ".npz":
            assert list(kept) == list(given) and np.array_equal(kept["sensor"], given["sensor"])
            assert np.array_equal(kept["lidar"], given["lidar"][~mask]) and kept["ring"].dtype == np.uint16
        else:
            assert kept.dtype == given.dtype and np.array_equal(kept, given[~mask])
    assert removed == (sum(len(DRIVE.world(index)[0]) for index in range(4)), count, 0)
    back = ArraysLog(folder)
    assert back.timestamps == log.timestamps and len(back[3].points) == (DRIVE.world(3)[2] < 0).sum()


def test_compressed_clouds_keep_their_columns_and_types(tmp_path: Path) -> None:
    write_drive(tmp_path / "drive", ".npy")
    given = {}
    for file in list((tmp_path / "drive").iterdir()):
        given[file.name] = np.load(file)
        Path(f"{file}.gz").write_bytes(gzip.compress(file.read_bytes()))
        file.unlink()
    log = ArraysLog(tmp_path / "drive")
    write_clean_log(CleanLog(log, flow=DRIVE.result), log, tmp_path / "clean")
    for index, (name, table) in enumerate(sorted(given.items())):
        kept = np.load(tmp_path / "clean" / "drive" / "points" / name)
        assert kept.dtype == table.dtype and np.array_equal(kept, table[DRIVE.world(index)[2] < 0])


def test_clouds_whose_format_we_only_read_are_written_in_another(tmp_path: Path) -> None:
    write_drive(tmp_path / "drive", ".ply")
    for file in list((tmp_path / "drive").iterdir()):
        points = read_cloud(file)
        table = np.column_stack([points, np.arange(len(points))])
        np.savetxt(file.with_suffix(".csv"), table, delimiter=",", header="x,y,z,intensity", comments="")
        file.unlink()
    log = ArraysLog(tmp_path / "drive")
    write_clean_log(CleanLog(log, flow=DRIVE.result), log, tmp_path / "clean")
    clean = ArraysLog(tmp_path / "clean" / "drive")
    assert [file.name for file in clean.files] == [f"{name}.npy" for name in NAMES]
    for index in range(len(NAMES)):
        points, _, car = DRIVE.world(index)
        assert np.allclose(clean.sweep(index).points, points[car < 0], atol=1e-4)
        assert np.allclose(clean.columns(index)["intensity"], log.columns(index)["intensity"][car < 0])


def test_points_without_a_position_are_left_out_and_counted(tmp_path: Path) -> None:
    write_drive(tmp_path / "drive", ".npy")
    file = tmp_path / "drive" / f"{NAMES[1]}.npy"
    table = np.load(file)
    table["x"][:5] = np.nan
    np.save(file, table)
    log = ArraysLog(tmp_path / "drive")
    clean = CleanLog(log, flow=DRIVE.result)
    removed = write_clean_log(clean, log, tmp_path / "clean")
    assert removed.without_position == 5 and ", and 5 without a position" in str(removed)
    assert np.isfinite(read_cloud(tmp_path / "clean" / "drive" / "points" / f"{NAMES[1]}.npy")).all()
    masked = MaskedLog(log, stored_masks(tmp_path / "clean" / "drive", log))
    for index in range(4):
        assert np.array_equal(masked[index].points, clean[index].points)
    np.save(tmp_path / "clean" / "drive" / "removed" / f"{NAMES[2]}.npy", np.zeros(3, bool))
    with pytest.raises(CFlowError, match="overwrite=true"):
        masked.sweep(2)


def test_points_of_another_frame_are_written_as_the_log_has_them(tmp_path: Path) -> None:
    write_drive(tmp_path / "drive", ".npy")
    T = np.eye(4)
    T[2, 3] = 1.5
    log = ArraysLog(tmp_path / "drive", ego_T_lidar=T)
    write_clean_log(CleanLog(log, flow=DRIVE.result), log, tmp_path / "clean")
    back = ArraysLog(tmp_path / "clean" / "drive")
    is_static = DRIVE.world(0)[2] < 0
    np.testing.assert_allclose(back[0].points, DRIVE.world(0)[0][is_static] + [0, 0, 1.5], atol=1e-6)
    assert back.files[0].stem == NAMES[0]


def test_a_map_has_the_intensities_of_its_points(tmp_path: Path) -> None:
    write_drive(tmp_path / "drive", ".bin")
    log = ArraysLog(tmp_path / "drive", poses=np.tile(np.eye(4), (4, 1, 1)))
    points, intensity = static_map_with_intensity(log, 0.4)
    first = DRIVE.world(0)[0].astype(np.float32)
    given = np.linspace(0, 1, len(first), dtype=np.float32)
    assert intensity is not None and intensity.shape == (len(points),)
    row = np.abs(points[0] - first).sum(1).argmin()
    assert intensity[0] == pytest.approx(given[row])
    without = Staged([straight((0, 0), (0.9, 0.0), 4)], np.tile(np.eye(4), (4, 1, 1)))
    assert static_map_with_intensity(without, 0.4)[1] is None


class Numbered(Staged):
    """Sweeps 4, 5, 6, 8, 9 of a data set, without time stamps."""

    def sweep(self, index: int) -> Sweep:
        return replace(super().sweep(index), timestamp_ns=None)

    def frame_number(self, index: int) -> int:
        return (4, 5, 6, 8, 9)[index]


def test_clouds_of_other_logs_have_the_numbers_of_the_data_set(tmp_path: Path) -> None:
    log = Numbered([straight((1, 1), (0.9, 0.0), 5)], np.tile(np.eye(4), (5, 1, 1)))
    numbers = [f"00000{number}.npy" for number in (4, 5, 6, 8, 9)]
    write_clean_log(CleanLog(log, flow=log.result), log, tmp_path / "clean")
    written = [tmp_path / "clean" / "staged", write_array_log(log, tmp_path / "all")]
    assert sorted(file.name for file in (written[0] / "removed").iterdir()) == numbers
    assert stored_masks(written[0], log)(3).any()
    for folder in (*written, write_array_log(ArraysLog(written[1]), tmp_path / "again")):
        back = ArraysLog(folder)
        assert [file.name for file in back.files] == numbers
        assert back.gaps == {2} and back.sweep_times() == pytest.approx([0, 0.1, 0.2, 0.4, 0.5])


def test_a_mask_of_another_sweep_is_an_error(tmp_path: Path) -> None:
    write_drive(tmp_path / "drive", ".npy")
    with pytest.raises(CFlowError, match="the mask 3"):
        copy_rows(tmp_path / "drive" / f"{NAMES[0]}.npy", tmp_path / "copy.npy", np.ones(3, bool))


def test_clouds_are_written_in_every_format(tmp_path: Path) -> None:
    write_drive(tmp_path / "drive", ".npy")
    log = ArraysLog(tmp_path / "drive", ground=None, poses=np.tile(np.eye(4), (4, 1, 1)))
    flows = make_model("default", "cpu", num_history=0)(list(log.windows()))
    clean = CleanLog(log, flow=flows.__getitem__)
    for suffix in SUFFIXES:
        counts = write_clean_log(clean, log, tmp_path / suffix, suffix)
        written = ArraysLog(tmp_path / suffix / "drive", ground=None)
        masks = [np.load(tmp_path / suffix / "drive" / "removed" / f"{name}.npy") for name in NAMES]
        assert counts.moving == sum(mask.sum() for mask in masks) > 0
        assert [len(sweep.points) for sweep in written] == [(~mask).sum() for mask in masks], suffix


def test_the_command_counts_what_it_removes_and_writes_a_map_that_is_missing(
    tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    write_drive(tmp_path / "drive", ".npy")
    np.savetxt(tmp_path / "drive" / "poses.txt", np.tile(np.eye(4)[:3].reshape(12), (4, 1)))
    more = (*FAST, "map=true", "voxel_size=0.4", "data.find_ground=null", "data.check=false")
    for expected in ("removed {:,} of {:,} points", "it is complete"):
        assert cflow("clean", tmp_path / "drive", f"output={tmp_path / 'clean'}", "suffix=.bin", *more) == 0
        masks = [np.load(file) for file in (tmp_path / "clean" / "drive" / "removed").iterdir()]
        total, removed = sum(map(len, masks)), sum(mask.sum() for mask in masks)
        text = capsys.readouterr().out
        assert f"4 sweeps, {expected.format(removed, total)}" in text and 0 < removed < total
        assert "data.bin_columns=5" in text
        file = tmp_path / "clean" / "drive" / "map.ply"
        assert b"property float intensity" in file.read_bytes()[:300]
        older = file.read_bytes()
        file.unlink()
    clean = ("clean", tmp_path / "drive", f"output={tmp_path / 'clean'}", "suffix=.bin", *more)
    for more, changes in ((("voxel_size=0.8",), True), (("voxel_size=0.8",), False), (("voxel_size=0.4",), True)):
        before = file.stat().st_mtime_ns if file.exists() else 0
        assert cflow(*clean, *more) == 0 and "it is complete" in capsys.readouterr().out
        assert (file.stat().st_mtime_ns != before) == changes, "another map is written, from the masks that are there"
        assert (file.read_bytes() == older) == ("voxel_size=0.4" in more)


def test_clean_clouds_of_an_earlier_flow_are_not_taken_for_complete(
    tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    write_drive(tmp_path / "drive", ".npy")
    np.savetxt(tmp_path / "drive" / "poses.txt", np.tile(np.eye(4)[:3].reshape(12), (4, 1)))
    data = (tmp_path / "drive", "data.find_ground=null", "data.check=false")
    flow = ("flow", *data, f"output={tmp_path / 'flow'}", *FAST)
    clean = ("clean", *data, f"output={tmp_path / 'clean'}", f"flow={tmp_path / 'flow'}")
    assert cflow(*flow) == 0 and cflow(*clean) == 0 and cflow(*clean) == 0
    assert "it is complete" in capsys.readouterr().out
    few = "contents=[residual,cluster_id,score,is_valid]"
    assert cflow(*flow, few, "overwrite=true") == 0 and cflow(*clean, "overwrite=true") == 1
    assert "lacks moving: run `cflow flow` again with contents=auto" in capsys.readouterr().err
    assert cflow(*flow, "model.significance=2", "overwrite=true") == 0
    assert cflow(*clean) != 0
    message = capsys.readouterr().err
    assert "flow_by.significance was 1.5, is 2.0" in message and "overwrite=true" in message
    older = {file: file.read_bytes() for file in sorted((tmp_path / "clean" / "drive").rglob("*.npy"))}
    for frame in (tmp_path / "flow").rglob("*.feather"):
        frame.rename(frame.with_suffix(".away"))
    assert cflow(*clean, "overwrite=true") == 1, "a run that fails leaves the older results"
    assert "is missing: run `cflow flow` again" in capsys.readouterr().err
    assert older == {file: file.read_bytes() for file in sorted((tmp_path / "clean" / "drive").rglob("*.npy"))}
    for frame in (tmp_path / "flow").rglob("*.away"):
        frame.rename(frame.with_suffix(".feather"))
    assert cflow(*clean, "overwrite=true") == 0
