"""Damaged files are one error, names cannot leave their folder, and nothing from a file is executed."""

from __future__ import annotations

import json
import os
import pickle
import re
from contextlib import suppress
from pathlib import Path
from typing import Any, Iterator

import numpy as np
import pytest
from small_logs import SMALL_LOGS, write_small_log
from tiny_recording import TinyRecording
from writers.aevascenes import write_aevascenes_sequence
from writers.nuscenes import write_nuscenes

from cflow_torch.data.aevascenes import AevaScenesLog
from cflow_torch.data.arrays.cloud_file import read_cloud
from cflow_torch.data.catalog import find_sources, open_log
from cflow_torch.data.json_file import read_json
from cflow_torch.data.npy_file import read_npy
from cflow_torch.data.paths import is_timestamp, path_inside, safe_name
from cflow_torch.types import CFlowError

# A clone without git-lfs has these instead of large files. They are as long as ten points of a `.bin`.
POINTER = f"version https://git-lfs.github.com/spec/v1\noid sha256:{64 * '0'}\nsize 1234\n".ljust(160).encode()
# Parts of file names that no reader opens.
UNREAD = r"calibration/|log_map|index_|\.png|visibility|attribute|/log\.|/map\.|_motion_|weather|stats"


def read_all(name: str, root: Path) -> None:
    for source in find_sources(name, root):
        with open_log(name, source, check=False) as log:
            for index in range(len(log)):
                log.sweep(index), log.labels(index)


@pytest.mark.parametrize(
    ("name", "suffix"),
    [
        *((name, "") for name in SMALL_LOGS if name not in ("bags", "truckscenes")),
        ("truckscenes", ".pcd"),  # its tables are those of nuscenes
        pytest.param("truckscenes", ".json", marks=pytest.mark.slow),
    ],
)
def test_a_damaged_file_is_one_error_with_its_name(name: str, suffix: str, tmp_path: Path) -> None:
    root = write_small_log(name, tmp_path / name)
    found = [path for path in root.rglob("*.*") if path.is_file()]
    kinds = {(file.parent, file.stem if file.suffix == ".json" else file.suffix): file for file in found}
    for file in kinds.values():
        if re.search(UNREAD, str(file)) or not file.name.endswith(suffix):
            continue
        whole = file.read_bytes()
        for content in (whole[: len(whole) // 2 + 1], b"", b"a poem\n" * 99, POINTER):
            file.write_bytes(content)
            with pytest.raises(CFlowError, match=file.name + (".* is a git-lfs pointer" if content == POINTER else "")):
                read_all(name, root)
        file.unlink()
        with suppress(CFlowError):  # some files are optional
            read_all(name, root)
        file.write_bytes(whole)
    read_all(name, root)


@pytest.mark.parametrize("content", [b"[" * 200_000, '{"a": 1}'.encode("utf-16"), b'{"a": "\xff"}', b"", b"{'a': 1}"])
def test_what_is_not_json_is_refused_by_the_name_of_the_file(content: bytes, tmp_path: Path) -> None:
    file = tmp_path / "a.json"
    file.write_bytes(content)
    with pytest.raises(CFlowError, match="cannot read .*a.json as JSON") as error:
        read_json(file)
    assert len(str(error.value)) < 700


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


class Payload:
    """Creates a folder when it is unpickled."""

    def __init__(self, marker: Path) -> None:
        self.marker = str(marker)

    def __reduce__(self) -> Any:
        return os.mkdir, (self.marker,)


@pytest.fixture
def marker(tmp_path: Path) -> Iterator[Path]:
    yield tmp_path / "marker"
    assert not (tmp_path / "marker").exists(), "something ran"


def objects(marker: Path, shape: tuple[int, ...] = (1,)) -> np.ndarray:
    values = np.empty(shape, dtype=object)
    values.fill(Payload(marker))
    return values


def test_the_payload_works(tmp_path: Path) -> None:
    pickle.loads(pickle.dumps(Payload(tmp_path / "marker")))
    assert (tmp_path / "marker").is_dir()


def test_arrays_of_objects_are_refused(marker: Path, tmp_path: Path) -> None:
    np.save(tmp_path / "a.npy", objects(marker, (4, 3)))
    np.savez(tmp_path / "a.npz", points=objects(marker, (4, 3)))
    with pytest.raises(CFlowError, match="a.npy.*copy it"):
        read_npy(tmp_path / "a.npy", "copy it")
    with pytest.raises(CFlowError, match="a.npz.*pass plain arrays"):
        read_cloud(tmp_path / "a.npz")


@pytest.mark.parametrize("key", ["semantic_labels", "xyz", "velocity"])
def test_pickled_strings_run_nothing(key: str, marker: Path, tmp_path: Path) -> None:
    """The labels may be pickled text, but nothing else."""
    folder = write_aevascenes_sequence(TinyRecording(("front",), num_sweeps=2), tmp_path / "data")
    for file in folder.rglob("*.npz"):
        with np.load(file, allow_pickle=True) as stored:  # our own
            arrays = {name: stored[name] for name in stored.files}
        np.savez(file, **{**arrays, key: objects(marker, arrays[key].shape)})
    with pytest.raises(CFlowError, match=key):
        log = AevaScenesLog(folder)
        log.sweep(0), log.radial_velocity(0)
