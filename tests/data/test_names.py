"""Names from data cannot leave their folder."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from tiny_recording import TinyRecording

from cflow_torch import CFlowError
from cflow_torch.data.catalog import find_sources, open_log
from cflow_torch.data.names import is_timestamp, path_inside, safe_name
from cflow_torch.simulator.writers.nuscenes import write_nuscenes

BAD = (
    *("", ".", "..", "../up", "/etc/passwd", "a/b", "a\\b", "c:x", "\\\\host\\share", ".hidden"),
    *("a\0b", "a\nb", "\u2028", "\ud800"),
)


def test_only_safe_names_are_accepted(tmp_path: Path) -> None:
    for name in (*BAD, None, 5, b"a", ["a"]):
        with pytest.raises(CFlowError, match="the scene .* cannot be used as a file or folder name: ") as error:
            safe_name(name, "the scene")
        assert str(error.value).isprintable() and len(str(error.value)) < 300
    for name in ("scene-0001", "a b", "é\U0001f600", "2024-01-01T12:00", "n" * 255, "a..b", "-", "@home"):
        assert safe_name(name, "the scene") == name
        (tmp_path / name).mkdir()


def test_paths_in_tables_cannot_leave_the_folder(tmp_path: Path) -> None:
    assert path_inside(tmp_path, "samples/LIDAR_TOP/x__1.bin", "f") == tmp_path / "samples" / "LIDAR_TOP" / "x__1.bin"
    assert path_inside(tmp_path, "./a//b.npz", "f") == tmp_path / "a" / "b.npz"
    outside = ("/etc/passwd", "../x", "a/../../x", "a/..", "\\x", "C:/x", ".", "", None, 5, "a/.hidden", "a/b\0c")
    for relative in outside:
        with pytest.raises(CFlowError, match="f .* is not read: "):
            path_inside(tmp_path, relative, "f")


def test_links_in_the_data_are_followed(tmp_path: Path) -> None:
    elsewhere, root = tmp_path / "elsewhere", tmp_path / "root"
    elsewhere.mkdir(), root.mkdir()
    (elsewhere / "x.bin").write_bytes(b"data")
    (root / "data").symlink_to(elsewhere)
    assert path_inside(root, "data/x.bin", "f").read_bytes() == b"data", "users link data sets"


def test_time_stamps_are_recognised() -> None:
    assert is_timestamp("315966000000000000") and is_timestamp("0")
    for name in ("", "-1", "²", "\u0663", "1e5", "9" * 19 + "0", "9223372036854775808", " 1"):
        assert not is_timestamp(name), name


def test_names_of_a_data_set_cannot_leave_it(tmp_path: Path) -> None:
    root = write_nuscenes(TinyRecording(("LIDAR_TOP",), num_sweeps=2), tmp_path / "data" / "deep")
    (tmp_path / "secret.pcd.bin").write_bytes(np.zeros((3, 5), "<f4").tobytes())

    def change(table: str, **values: str) -> None:
        (file,) = root.rglob(f"{table}.json")
        file.write_text(json.dumps([{**row, **values} for row in json.loads(file.read_text())]))

    for name in ("../../secret.pcd.bin", "/etc/hostname", "a\0b"):
        change("sample_data", filename=name)
        log = open_log("nuscenes", find_sources("nuscenes", root)[0], check=False)
        with pytest.raises(CFlowError, match="the filename in sample_data.json .* is not read"):
            log.sweep(0)
    change("scene", name="../../escaped")
    with pytest.raises(CFlowError, match="scene.json: the scene .* cannot be used as"):
        find_sources("nuscenes", root)
