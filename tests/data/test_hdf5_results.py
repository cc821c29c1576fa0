"""A method's flow inside HDF5 scenes: a scene is written completely or not at all."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hdf5_scene import STAMPS, write_scene

from cflow_torch import CFlowError
from cflow_torch.data.hdf5.reader import HDF5Log, find_hdf5_scenes
from cflow_torch.data.hdf5.writer import write_hdf5_labels, write_hdf5_results

h5py = pytest.importorskip("h5py")


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    """Three sweeps of 50, 51 and 52 points."""
    return write_scene(tmp_path / "scene.h5", growth=1)


def flow_of(index: int, value: float = 1.0) -> np.ndarray:
    return np.full((50 + index, 3), value, np.float32)


def contents(file: Path) -> dict[str, Any]:
    with h5py.File(file, "r") as scene:
        return {f"{stamp}/{key}": scene[stamp][key][()] for stamp in scene for key in scene[stamp]}


def assert_unchanged(file: Path, before: bytes) -> None:
    assert file.read_bytes() == before
    assert os.listdir(file.parent) == [file.name], "no temporary file is left"


def test_a_result_is_written_and_the_rest_stays(scene: Path) -> None:
    before = contents(scene)
    results = [(STAMPS[0], flow_of(0, 0.25)), (STAMPS[1], torch.full((51, 3), 0.1, dtype=torch.float64))]
    assert write_hdf5_results(scene, "cflow", results) == 2
    after = contents(scene)
    assert set(after) - set(before) == {f"{STAMPS[0]}/cflow", f"{STAMPS[1]}/cflow"}
    for key, value in before.items():
        np.testing.assert_array_equal(after[key], value)
    stored = after[f"{STAMPS[1]}/cflow"]
    assert stored.dtype == np.float32 and stored.shape == (51, 3) and (stored == np.float32(0.1)).all()
    assert find_hdf5_scenes(scene.parent) == [scene] and os.listdir(scene.parent) == [scene.name]


def test_the_copy_of_another_writer_stays_until_it_is_old(scene: Path) -> None:
    copy = scene.with_name(f".{scene.name}.0123abcd.tmp")
    copy.write_bytes(b"half")
    for is_left in (True, False):
        write_hdf5_results(scene, "mine", [])
        assert copy.exists() == is_left
        if is_left:
            os.utime(copy, (0, 0))


@pytest.mark.parametrize("compression", [None, "gzip"])
def test_what_is_added_is_compressed_as_the_points_are(scene: Path, compression: str | None) -> None:
    with h5py.File(scene, "r+") as opened:
        for group in opened.values():
            points = group["lidar"][()]
            del group["lidar"]
            group.create_dataset("lidar", data=points, compression=compression, shuffle=compression is not None)
    write_hdf5_results(scene, "cflow", [(STAMPS[0], flow_of(0))])
    write_hdf5_labels(scene, [(STAMPS[0], {"dufo": np.ones(50, np.uint8), "nnd": np.zeros(50, np.uint8)})])
    with h5py.File(scene) as opened:
        for key in ("cflow", "dufo", "nnd"):
            stored = opened[str(STAMPS[0])][key]
            assert (stored.compression, stored.shuffle) == (compression, compression is not None)
        assert (opened[str(STAMPS[0])]["dufo"][()] == 1).all()


def test_an_older_result_is_replaced_without_growth(scene: Path) -> None:
    write_hdf5_results(scene, "cflow", [(STAMPS[0], flow_of(0, 1))])
    size = scene.stat().st_size
    for value in (3, 4):
        write_hdf5_results(scene, "cflow", [(STAMPS[0], flow_of(0, value))])
    assert (contents(scene)[f"{STAMPS[0]}/cflow"] == 4).all() and scene.stat().st_size == size
    write_hdf5_results(scene, "other", [(STAMPS[0], flow_of(0, 9))])
    assert (contents(scene)[f"{STAMPS[0]}/cflow"] == 4).all()


def test_reserved_and_invalid_names_are_refused(scene: Path) -> None:
    before = scene.read_bytes()
    for name in ("flow", "pc0", "a/b", "..", "", "[flow]", "1st", "x" * 65, None):
        with pytest.raises(CFlowError, match="name"):
            write_hdf5_results(scene, name, [(STAMPS[0], flow_of(0))])
    assert_unchanged(scene, before)


@pytest.mark.parametrize(
    ("name", "stamp", "flow", "complaint"),
    [
        ("cflow", STAMPS[0], flow_of(1), r"\(51, 3\): give \(50, 3\)"),
        ("cflow", STAMPS[0], flow_of(0)[:, :2], r"\(50, 2\)"),
        ("cflow", 17, flow_of(0), "no sweep 17"),
        ("mine", STAMPS[0], flow_of(0), "mine.*not a flow result"),
    ],
)
def test_a_wrong_result_changes_nothing(name: str, stamp: int, flow: np.ndarray, complaint: str, scene: Path) -> None:
    with h5py.File(scene, "r+") as file:
        file[str(STAMPS[0])]["mine"] = np.arange(50)
    before = scene.read_bytes()
    with pytest.raises(CFlowError, match=complaint):
        write_hdf5_results(scene, name, [(STAMPS[1], flow_of(1)), (stamp, flow)])
    assert_unchanged(scene, before)


def test_read_only_and_foreign_files_are_refused(scene: Path, tmp_path: Path) -> None:
    before = scene.read_bytes()
    scene.chmod(0o444)
    with pytest.raises(CFlowError, match="read-only"):
        write_hdf5_results(scene, "cflow", [(STAMPS[0], flow_of(0))])
    assert_unchanged(scene, before)
    scene.chmod(0o640)
    half = tmp_path / "half.h5"
    half.write_bytes(before[: len(before) // 2])
    with pytest.raises(CFlowError, match="cannot write .*half.h5.*free space"):
        write_hdf5_results(half, "cflow", [(STAMPS[0], flow_of(0))])
    with pytest.raises(CFlowError, match="missing.h5 does not exist"):
        write_hdf5_results(tmp_path / "missing.h5", "cflow", [])
    assert sorted(os.listdir(tmp_path)) == ["half.h5", "scene.h5"]


def test_mode_links_and_open_readers_survive(scene: Path, tmp_path: Path) -> None:
    scene.chmod(0o640)
    link = tmp_path / "link.h5"
    link.symlink_to(scene)
    with HDF5Log(scene) as log:
        points = log.sweep(0).points
        assert write_hdf5_results(link, "cflow", [(STAMPS[0], flow_of(0))]) == 1
        np.testing.assert_array_equal(log.sweep(0).points, points)
    assert link.is_symlink() and scene.stat().st_mode & 0o777 == 0o640
    assert f"{STAMPS[0]}/cflow" in contents(scene)
