"""Submission archives: their contents, their checks, and the frames and points that they must contain."""

from __future__ import annotations

import io
import shutil
import zipfile
from pathlib import Path
from typing import Any, Callable, Dict

import numpy as np
import pyarrow as pa
import pytest
import torch
from command_line import cflow
from hdf5_scene import write_scene
from public_evaluators import FLOW, LOG, TIME, official_mask, read_pair
from pyarrow import feather
from small_logs import make_small_drive

from cflow_torch import CFlowError, CorrelationFlow
from cflow_torch.data.av2 import AV2Log
from cflow_torch.data.hdf5.reader import HDF5Log
from cflow_torch.data.log import window
from cflow_torch.evaluation.submission.archive import check_submission, encode, get_version, write_frame, write_zip
from cflow_torch.evaluation.submission.frames import MaskArchive, plan_log, point_mask, read_frame_list, require_logs
from cflow_torch.simulator.writers.av2 import write_av2_log

Files = Dict[str, bytes]


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> AV2Log:
    """Seven simulated sweeps: pairs 0 and 5 are submitted."""
    return AV2Log(write_av2_log(make_small_drive(7), tmp_path_factory.mktemp("drive")))


@pytest.fixture(scope="module")
def estimated(log: AV2Log) -> dict[int, Any]:
    """Windows and results of the submitted pairs."""
    model = CorrelationFlow.from_preset("paper", pixel_size=0.4)
    windows = {index: window(log, index) for index in (0, 5)}
    return {index: (sweeps, model([sweeps])[0]) for index, sweeps in windows.items()}


@pytest.fixture(scope="module")
def archives(log: AV2Log, estimated: dict[int, Any], tmp_path_factory: pytest.TempPathFactory) -> dict[int, Any]:
    """Version -> folder, zip, expected files with their rows."""
    result = {}
    for number in (1, 3):
        version, folder = get_version(number), tmp_path_factory.mktemp(f"v{number}") / "files"
        expected = {}
        for frame in plan_log(log):
            sweeps, flow = estimated[frame.index]
            mask = point_mask(log, frame.index, sweeps.pc0) if version.is_masked else None
            write_frame(folder, frame.name, encode(version, flow, sweeps.pc0.is_ground, mask)[0])
            expected[frame.name] = frame.count_rows(version)
        write_zip(folder, expected, folder.parent / "a.zip")
        result[number] = (folder, folder.parent / "a.zip", expected)
    return result


def read(file: Path) -> dict[str, np.ndarray]:
    table = feather.read_table(str(file), memory_map=False)
    return {name: table[name].to_numpy() for name in table.column_names}


def flow_of(columns: dict[str, np.ndarray]) -> np.ndarray:
    return np.stack([columns[name] for name in FLOW], 1)


def test_version_1_is_total_flow_of_the_mask(log: AV2Log, estimated: dict[int, Any], archives: dict[int, Any]) -> None:
    for index, (sweeps, flow) in estimated.items():
        columns = read(archives[1][0] / log.log_id / f"{log.timestamps[index]}.feather")
        assert list(columns) == [*FLOW, "is_dynamic"] and flow_of(columns).dtype == np.float16
        points = sweeps.pc0.points
        rows = np.flatnonzero((np.abs(points[:, 0]) <= 50) & (np.abs(points[:, 1]) <= 50) & ~sweeps.pc0.is_ground)
        assert 0 < len(rows) < len(points)
        np.testing.assert_array_equal(flow_of(columns), flow.flow.numpy()[rows].astype(np.float16))
        speed = np.sqrt((flow.residual_flow.numpy()[rows].astype(np.float64) ** 2).sum(1))
        sure = np.abs(speed - 0.05) > 1e-6
        np.testing.assert_array_equal(columns["is_dynamic"][sure], speed[sure] >= 0.05)
        assert columns["is_dynamic"].any() and not columns["is_dynamic"].all()


def test_version_3_is_residual_flow_of_all_points(log: AV2Log, estimated: dict[int, Any], archives: Any) -> None:
    for index, (sweeps, flow) in estimated.items():
        columns = read(archives[3][0] / log.log_id / f"{log.timestamps[index]}.feather")
        assert list(columns) == list(FLOW)
        assert flow_of(columns).dtype == np.float16 and flow_of(columns).any()
        np.testing.assert_array_equal(flow_of(columns), flow.residual_flow.numpy().astype(np.float16))
        loud = type(flow)(**{**vars(flow), "residual_flow": flow.residual_flow + 50})
        values = flow_of(encode(get_version(3), loud, sweeps.pc0.is_ground)[0])
        assert not values[sweeps.pc0.is_ground].any() and values[~sweeps.pc0.is_ground].all(), "ground is always 0"


def test_unsuitable_values_and_versions_are_refused(estimated: dict[int, Any]) -> None:
    _, flow = estimated[0]
    for value, message in ((np.nan, "NaN"), (np.inf, "infinite"), (65505.0, "beyond float16")):
        with pytest.raises(CFlowError, match=message):
            spoiled = type(flow)(**{**vars(flow), "residual_flow": torch.full_like(flow.residual_flow, value)})
            encode(get_version(3), spoiled)
    for number, message in ((2, "closed"), (4, "1, 3")):
        with pytest.raises(CFlowError, match=message):
            get_version(number)


def test_the_same_files_make_the_same_zip(archives: dict[int, Any], tmp_path: Path) -> None:
    folder, good, expected = archives[1]
    shutil.copytree(folder, tmp_path / "copy")
    write_zip(tmp_path / "copy", reversed(list(expected)), tmp_path / "again.zip")
    assert (tmp_path / "again.zip").read_bytes() == good.read_bytes()
    first = min(expected)
    (tmp_path / "copy" / first).unlink()
    with pytest.raises(OSError, match=first):
        write_zip(tmp_path / "copy", expected, tmp_path / "never.zip")
    assert not (tmp_path / "never.zip").exists()


# ---- damaged archives: version, change of one file of a valid archive, words of the one problem


def in_table(change: Callable[[pa.Table], pa.Table]) -> Callable[[bytes], bytes]:
    def spoil(data: bytes) -> bytes:
        sink = io.BytesIO()
        feather.write_feather(change(feather.read_table(pa.BufferReader(data))), sink)
        return sink.getvalue()

    return spoil


def column(name: str, change: Callable[[Any], Any]) -> Callable[[bytes], bytes]:
    return in_table(lambda t: t.set_column(t.column_names.index(name), name, pa.array(change(t[name].to_numpy()))))


def with_value(value: Any) -> Callable[[np.ndarray], Any]:
    return lambda values: [*values[:7], value, *values[8:]] if value is None else np.r_[values[:-1], np.float16(value)]


SPOILED: dict[str, Any] = {
    "row missing": (3, in_table(lambda t: t.slice(1)), "rows, expected"),
    "NaN": (3, column("flow_ty_m", with_value(np.nan)), "flow_ty_m has 1 values that are NaN"),
    "empty value": (3, column("flow_tx_m", with_value(None)), "flow_tx_m has 1 empty"),
    "float64": (3, column("flow_tz_m", lambda v: v.astype(np.float64)), "flow_tz_m is float64, expected float16"),
    "dynamic as number": (1, column("is_dynamic", lambda v: v.astype(np.uint8)), "is_dynamic is uint8, expected bool"),
    "column missing": (1, in_table(lambda t: t.drop(["is_dynamic"])), "flow_tz_m, is_dynamic"),
    "foreign column": (3, in_table(lambda t: t.append_column("score", t["flow_tx_m"])), "flow_tz_m, score, expected"),
    "truncated": (3, lambda data: data[: len(data) // 2], "cannot be read"),
}


def unzip(file: Path) -> Files:
    with zipfile.ZipFile(file) as archive:
        return {name: archive.read(name) for name in archive.namelist()}


def rezip(files: Files, file: Path) -> Path:
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in files.items():
            archive.writestr(zipfile.ZipInfo(name), data)
    return file


@pytest.mark.parametrize("kind", SPOILED)
def test_a_damaged_file_is_one_line_with_its_name(kind: str, archives: dict[int, Any], tmp_path: Path) -> None:
    number, spoil, words = SPOILED[kind]
    _, good, expected = archives[number]
    files, name = unzip(good), max(expected)
    files[name] = spoil(files[name])
    (problem,) = check_submission(rezip(files, tmp_path / "a.zip"), get_version(number), expected)
    assert problem.startswith(f"{name}: ") and words in problem and "\n" not in problem


def test_every_problem_of_an_archive_is_listed(archives: dict[int, Any], tmp_path: Path) -> None:
    _, good, expected = archives[3]
    files, name = {**unzip(good), "notes.txt": b""}, min(expected)
    del files[name]
    foreign, missing = check_submission(rezip(files, tmp_path / "a.zip"), get_version(3), expected)
    assert "notes.txt" in foreign and missing == f"{name}: missing"


def test_damaged_zips_are_one_problem(archives: dict[int, Any], tmp_path: Path) -> None:
    _, good, expected = archives[3]
    whole = good.read_bytes()
    (tmp_path / "half.zip").write_bytes(whole[: len(whole) // 2])
    for name, words in (("half.zip", "zip"), ("missing.zip", "is missing")):
        (problem,) = check_submission(tmp_path / name, get_version(3), expected)
        assert name in problem and words in problem
    damaged = bytearray(whole)
    damaged[200:260] = bytes(60)  # inside the first entry's data
    (tmp_path / "damaged.zip").write_bytes(damaged)
    (problem,) = check_submission(tmp_path / "damaged.zip", get_version(3), expected)
    assert problem.startswith(min(expected)) and "cannot be read" in problem


MICROSECONDS = range(1_533_279_682_150_532, 1_533_279_682_950_532, 100_000)


def test_frames_go_by_the_masks_of_the_scene(tmp_path: Path) -> None:
    with HDF5Log(write_scene(tmp_path / "scene.h5", MICROSECONDS, 1, [2, 3, 7])) as log:
        plan = plan_log(log)
        names = [f"scene/{MICROSECONDS[i]}.feather" for i in (2, 3)]
        assert [frame.name for frame in plan] == names, "groups have names in microseconds, and 7 is the last"
        for number, rows in ((1, log.eval_mask(2).sum()), (3, 52)):
            assert plan[0].count_rows(get_version(number)) == rows
    with HDF5Log(write_scene(tmp_path / "plain.h5", range(8), 1, [])) as log:
        assert [frame.index for frame in plan_log(log)] == [0, 5]
        for name in (log.sweep_name(7), "17"):
            with pytest.raises(CFlowError, match="is not a sweep of the log or is its last one"):
                plan_log(log, {"plain": [name]})
        listed = {"plain": [log.sweep_name(4), log.sweep_name(1)]}
        assert [frame.index for frame in plan_log(log, listed)] == [1, 4]
        assert plan_log(log, {"another": ["1"]}) == []
        with pytest.raises(CFlowError, match="another"):
            require_logs([log], {"another": ["1"], "plain": ["2"]})
        with pytest.raises(CFlowError, match="several"):
            require_logs([log, log], None)


def test_a_list_of_frames_is_text(tmp_path: Path) -> None:
    file = tmp_path / "frames.txt"
    file.write_text("a/5\n\n a/7 # the second\nb/6")
    assert read_frame_list(file) == {"a": ["5", "7"], "b": ["6"]}
    for content, message in ((b"a/5\nseven", "line 2: 'seven' is not a frame"), (b"\x80\x04", "text")):
        file.write_bytes(content)
        with pytest.raises(CFlowError, match=message):
            read_frame_list(file)


def write_masks(file: Path, log_id: str, timestamp: int, mask: np.ndarray) -> Path:
    """A mask archive of one frame, as av2's tools write it."""
    sink = io.BytesIO()
    feather.write_feather(pa.table({"mask": pa.array(mask)}), sink)
    return rezip({f"{log_id}/{timestamp}.feather": sink.getvalue()}, file)


def test_official_masks_take_precedence(log: AV2Log, tmp_path: Path) -> None:
    sweep, stamp = log.sweep(3), log.timestamps[3]
    mask = np.arange(len(sweep.points)) % 3 == 0
    masks = MaskArchive(write_masks(tmp_path / "masks.zip", log.log_id, stamp, mask))
    assert masks.frames == {log.log_id: [str(stamp)]}
    (planned,) = plan_log(log, masks.frames)
    assert planned.index == 3 and planned.count_rows(get_version(1), masks) == mask.sum()
    np.testing.assert_array_equal(point_mask(log, 3, sweep, masks), mask)
    short = MaskArchive(write_masks(tmp_path / "short.zip", log.log_id, stamp, mask[1:]))
    numbers = MaskArchive(write_masks(tmp_path / "numbers.zip", log.log_id, stamp, mask.astype(np.int8)))
    for index, broken, message in ((3, short, "rows"), (3, numbers, "column of bool"), (2, masks, "cannot read")):
        with pytest.raises(CFlowError, match=message):
            point_mask(log, index, sweep, broken)
    with pytest.raises(CFlowError, match="not a zip"):
        MaskArchive(__file__)


def test_command_makes_checks_resumes(log: AV2Log, tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    data = ("data=av2", f"data.root={log.folder}", "data.check=false")
    call = ["submit", *data, f"output={tmp_path}", "version=3", "model=paper", "model.pixel_sizes=[0.4]"]
    assert cflow(*call) == 0
    printed = capsys.readouterr().out
    assert "frames written: 2" in printed and "float16 rounding" in printed and "v3.zip: passes" in printed
    first = (tmp_path / "v3.zip").read_bytes()
    one, two = sorted((tmp_path / "v3" / log.log_id).iterdir())
    before = one.stat().st_mtime_ns
    two.write_bytes(two.read_bytes()[:500])
    (two.parent / f".{two.name}.abc").write_bytes(b"left by a killed run")
    assert cflow(*call) == 0
    assert "frames written: 1, already there: 1" in capsys.readouterr().out
    assert one.stat().st_mtime_ns == before and (tmp_path / "v3.zip").read_bytes() == first

    assert cflow(*call, "model.connectivity=4") == 2
    assert "model.connectivity was 8, is 4" in capsys.readouterr().err
    assert cflow(*call, f"archive={tmp_path / 'v3.zip'}") == 0
    two.unlink()
    assert cflow(*call, f"archive={tmp_path / 'v3'}") == 1
    error = capsys.readouterr().err
    assert f"{two.name}: missing" in error and "1 failed:" in error
    (tmp_path / "v3" / "notes.txt").write_text("mine")
    assert cflow(*call) == 1, "an unknown file is reported"
    assert "notes.txt" in capsys.readouterr().err
    assert cflow(*call, "overwrite=true", "model.connectivity=4") == 0
    (tmp_path / "config.yaml").unlink()
    assert cflow(*call, "overwrite=true") == 2, "a folder of somebody else"
    assert "v3 exists and is not a result of `cflow submit`" in capsys.readouterr().err and (tmp_path / "v3").exists()


def test_av2_accepts_the_real_pair_with_its_masks(av2_tools: Any, av2_folder: Path, tmp_path: Path) -> None:
    """Point 31058 is 0.4 mm from the edge of a cell of the ground raster (city x 5242.499975, column 566.9986). av2's
    float32 coordinates (5242.500488) put it into the next cell, where it is ground; float64 does not. So the official
    mask has one point less than the rule computed here, and the submission uses the official mask."""
    file = write_masks(tmp_path / "masks.zip", LOG, TIME, official_mask(read_pair(av2_folder)))
    call = ["submit", "data=av2", f"data.root={av2_folder}", "version=1", "model=paper", f"masks={file}"]
    assert cflow(*call, f"output={tmp_path}") == 0
    written, log = tmp_path / "v1" / LOG / f"{TIME}.feather", AV2Log(av2_folder)
    assert {len(values) for values in read(written).values()} == {78_506}
    own, official = (point_mask(log, 0, log.sweep(0), given) for given in (None, MaskArchive(file)))
    assert np.flatnonzero(own != official).tolist() == [31058]

    tools = av2_tools.make_submission_archive
    tools.validate(tmp_path / "v1", file)  # raises if it does not accept a file
    written.write_bytes(in_table(lambda t: t.slice(1))(written.read_bytes()))
    with pytest.raises(ValueError, match="rows"):
        tools.validate(tmp_path / "v1", file)
