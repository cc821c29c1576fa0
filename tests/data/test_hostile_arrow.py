"""Feather and parquet files that lie: found by fuzzing (tests/fuzzing/arrow_targets.py), kept here one by one."""

from __future__ import annotations

import io
import os
import pickle
import struct
import subprocess
import sys
from pathlib import Path
from typing import Any, Callable, Dict, List

import numpy as np
import pyarrow as pa
import pytest
from fuzzing.arrow_targets import TARGETS as ARROW
from fuzzing.crafted_parquet import CODECS, DOUBLE, PLAIN, PREFIXED, RLE, RLE_DICTIONARY, deep, file, page, runs
from pyarrow import feather, parquet

from cflow_torch import CFlowError
from cflow_torch.data import feather_claims
from cflow_torch.data.arrays.cloud_file import read_cloud
from cflow_torch.data.arrow_file import texts
from cflow_torch.data.av2 import AV2Log
from cflow_torch.data.boxes import MAX_BOXES, Boxes
from cflow_torch.data.feather_file import FeatherFile
from cflow_torch.data.flow_file import read_flow
from cflow_torch.data.parquet_claims import Chunk, Footer, Leaf, check_parquet_claims
from cflow_torch.data.parquet_file import MAX_STREAMED_BYTES, ParquetFile
from cflow_torch.data.waymo.reader import WaymoLog
from cflow_torch.evaluation.submission.check import check_file
from cflow_torch.evaluation.submission.versions import VERSIONS
from cflow_torch.windows.memory import available_memory

TARGETS = {target.name: target for target in ARROW}
XYZ: Dict[str, Any] = {axis: np.arange(4.0) for axis in "xyz"}
MIB = 1 << 20


def feather_bytes(columns: Any, **options: Any) -> bytes:
    sink = io.BytesIO()
    feather.write_feather(columns if isinstance(columns, pa.Table) else pa.table(columns), sink, **options)
    return sink.getvalue()


def refused(folder: Path, name: str, data: bytes, message: str) -> None:
    (folder / name).write_bytes(data)
    with pytest.raises(CFlowError, match=message) as error:
        read_cloud(folder / name)
    assert name in str(error.value)


def place(data: bytes, field: int) -> int:
    """Where a batch of a feather file has its vector of columns (1) or buffers (2)."""
    start = len(data) - 10 - struct.unpack_from("<i", data, len(data) - 10)[0]
    footer = feather_claims._Table(data, start + struct.unpack_from("<I", data, start)[0])
    block = next(footer.entries(3, 24))
    _, message = feather_claims._message(data, *struct.unpack_from("<qi", data, block))
    return next(message.table(2).entries(field, 16))


def lie(data: bytes, at: int, value: int) -> bytes:
    return data[:at] + struct.pack("<q", value) + data[at + 8 :]


# ---------------------------------------------------------------------------------------------- feather


@pytest.mark.parametrize("value", [10**12, 2**31, 2**62, -2])
@pytest.mark.parametrize("compression", ["lz4", "zstd"])
def test_a_compressed_buffer_claims_too_much(tmp_path: Path, compression: str, value: int) -> None:
    whole = feather_bytes(XYZ, compression=compression)
    start, length = (struct.unpack_from("<q", whole, place(whole, 2) + 16 + k)[0] for k in (0, 8))
    prefixes = [at for at in range(len(whole) - 8) if whole[at : at + 8] == struct.pack("<q", 32)]
    assert length and start == 0 and prefixes  # 4 float64
    refused(tmp_path, "a.feather", lie(whole, prefixes[0], value), "claims")


@pytest.mark.parametrize(("field", "at"), [(1, 0), (1, 8), (2, 16), (2, 24)])
@pytest.mark.parametrize("value", [10**12, 2**63 - 1, -5])
@pytest.mark.parametrize("compression", ["uncompressed", "zstd"])
def test_rows_and_places_lie(tmp_path: Path, field: int, at: int, value: int, compression: str) -> None:
    # A compressed buffer of 2^63 - 1 bytes made Arrow 21 step out of the file: the next good file killed the process.
    whole = feather_bytes(XYZ, compression=compression)
    refused(tmp_path, "a.feather", lie(whole, place(whole, field) + at, value), r"a\.feather")


def test_a_batch_that_is_listed_twice(tmp_path: Path) -> None:
    whole = feather_bytes({axis: np.zeros(1000) for axis in "xyz"}, compression="uncompressed", chunksize=999)
    start = len(whole) - 10 - struct.unpack_from("<i", whole, len(whole) - 10)[0]
    footer = feather_claims._Table(whole, start + struct.unpack_from("<I", whole, start)[0])
    large, small = footer.entries(3, 24)
    data = whole[:small] + whole[large : large + 24] + whole[small + 24 :]
    refused(tmp_path, "a.feather", data, "batches are longer than the file")


def test_version_1_is_refused(tmp_path: Path) -> None:
    refused(tmp_path, "a.feather", feather_bytes(XYZ, version=1), "version 1")


@pytest.mark.parametrize("suffix", ["feather", "parquet"])
def test_nothing_is_unpickled(tmp_path: Path, suffix: str) -> None:
    """CVE-2023-47248: an extension type of Arrow before 14.0.1 was a pickle."""

    class Runs:
        def __reduce__(self) -> Any:
            return os.mkdir, (str(tmp_path / "ran"),)

    metadata = {"ARROW:extension:name": "arrow.py_extension_type", "ARROW:extension:metadata": pickle.dumps(Runs())}
    schema = pa.schema([pa.field(axis, pa.float64(), metadata=metadata) for axis in "xyz"])
    write = feather.write_feather if suffix == "feather" else parquet.write_table
    write(pa.table([pa.array([0.5])] * 3, schema=schema), str(tmp_path / f"a.{suffix}"))
    try:
        assert len(read_cloud(tmp_path / f"a.{suffix}")) == 1  # Arrow of today knows nothing of this type
    except CFlowError as error:
        assert "arrow.py_extension_type" in str(error)
    assert not (tmp_path / "ran").exists()


@pytest.mark.parametrize("suffix", ["feather", "parquet"])
@pytest.mark.parametrize(
    ("column", "message"),
    [
        (pa.array([[0.5]] * 4), "floating-point"),
        (pa.array([[[0.5]]] * 4), "columns of numbers"),
        (pa.array([{"a": 0.5}] * 4), "columns of numbers|mixed"),
        (pa.array([None] * 4), "columns of numbers"),
        (pa.array(["a"] * 4), "floating-point"),
        (pa.array([0.5, None, 0.5, 0.5]), "floating-point"),
    ],
)
def test_columns_of_other_types(tmp_path: Path, suffix: str, column: pa.Array, message: str) -> None:
    write = feather.write_feather if suffix == "feather" else parquet.write_table
    write(pa.table({**XYZ, "y": column}), str(tmp_path / f"a.{suffix}"))
    refused(tmp_path, f"a.{suffix}", (tmp_path / f"a.{suffix}").read_bytes(), message)


@pytest.mark.parametrize("suffix", ["feather", "parquet"])
def test_a_column_that_occurs_twice(tmp_path: Path, suffix: str) -> None:
    table = pa.table([pa.array(np.arange(4.0))] * 4, names=["x", "y", "z", "x"])
    write = feather.write_feather if suffix == "feather" else parquet.write_table
    write(table, str(tmp_path / f"a.{suffix}"))
    refused(tmp_path, f"a.{suffix}", (tmp_path / f"a.{suffix}").read_bytes(), "2 columns x")


def test_names_as_long_as_books() -> None:
    with pytest.raises(CFlowError, match="a column of names claims"):
        texts(pa.chunked_array([pa.array(["a" * (65 * MIB)])]), "a.feather")


def test_offsets_of_texts_that_lie() -> None:
    whole = feather_bytes({"a": ["ab", "cd"]}, compression="uncompressed")
    at = whole.index(struct.pack("<3i", 0, 2, 4))
    for lies in ((0, 10**6, 4), (0, -1, 4), (4, 2, 0), (0, 2, 2**31 - 1)):
        data = whole[:at] + struct.pack("<3i", *lies) + whole[at + 12 :]
        with pytest.raises(CFlowError, match="cannot read"):
            FeatherFile("a", data).read(["a"])


# ---------------------------------------------------------------------------------------------- parquet


def cloud(pages: List[bytes], count: int, **lies: Any) -> bytes:
    return file(dict.fromkeys("xyz", (DOUBLE, pages, count)), count, **lies)


def test_a_parquet_file_written_by_hand_is_read(tmp_path: Path) -> None:
    for codec in ("none", "snappy", "gzip", "zstd", "brotli"):
        pages = [page(struct.pack("<d", 0.5), 1, codec, PLAIN, True), page(runs(0, 3), 3, codec, RLE_DICTIONARY)]
        (tmp_path / "a.parquet").write_bytes(cloud(pages, 3, codec=codec))
        assert (read_cloud(tmp_path / "a.parquet") == 0.5).all()


def test_runs_of_nothing(tmp_path: Path) -> None:
    count = 2**31 - 1  # 16 GiB a column
    word = page(bytes(8), 1, dictionary=True)
    refused(tmp_path, "a.parquet", cloud([word, page(runs(0, count), count, encoding=RLE_DICTIONARY)], count), "claims")
    refused(tmp_path, "a.parquet", cloud([page(bytes(24), 3)], 3, groups=1000, rows=3, group_rows=10**12), "claims")
    many = [word, *[page(runs(0, 10**8), 10**8, encoding=RLE_DICTIONARY)] * 2]
    refused(tmp_path, "a.parquet", cloud(many, 2 * 10**8), "claims")


def test_pages_of_less_than_they_claim(tmp_path: Path) -> None:
    refused(tmp_path, "a.parquet", cloud([page(bytes(24), 3, "zstd", claim=2**31 - 1)], 3, codec="zstd"), "claims")
    refused(tmp_path, "a.parquet", cloud([page(bytes(24), 3, "zstd", claim=8)], 3, codec="zstd"), "cannot read")
    refused(tmp_path, "a.parquet", cloud([page(bytes(24), 3, claim=-1)], 3), "negative")


def test_odd_statistics(tmp_path: Path) -> None:
    # pyarrow's own metadata object ended the process (std::terminate).
    (tmp_path / "a.parquet").write_bytes(cloud([page(bytes(24), 3)], 3, histogram=2))
    try:
        read_cloud(tmp_path / "a.parquet")
    except CFlowError as error:
        assert "histogram" in str(error)


@pytest.mark.parametrize("depth", [1500, 100000])
def test_a_deep_schema(tmp_path: Path, depth: int) -> None:
    refused(tmp_path, "a.parquet", deep(depth), "cannot read")  # Arrow follows it by recursion: the stack ran over


def test_many_row_groups_are_counted(tmp_path: Path) -> None:
    refused(tmp_path, "a.parquet", cloud([page(bytes(24), 3)], 3, groups=1025, rows=3075), "row groups")


def test_names_of_folders_are_no_columns(tmp_path: Path) -> None:
    folder = tmp_path / "x=5"
    folder.mkdir()
    parquet.write_table(pa.table(XYZ), str(folder / "a.parquet"))
    assert read_cloud(folder / "a.parquet").shape == (4, 3)


def test_a_long_segment_in_one_row_group_is_read() -> None:
    # 199 frames of Waymo's five lasers, as large as the real ones; once counted as pages, values and levels together.
    values = 199 * 4 * (64 * 2650 + 4 * 200 * 600)
    pages = b"".join(page(b"", values // 4, claim=values) for _ in range(4))

    def check(num_values: int) -> None:
        footer = Footer([Leaf("a", 4, 4)], [995], [[Chunk(0, len(pages), num_values)]])
        check_parquet_claims("a", pa.BufferReader(pages), footer, ["a"], [0], MAX_STREAMED_BYTES)

    check(values)
    with pytest.raises(CFlowError, match="column a claims"):
        check(2 * values)


def test_texts_that_share_their_beginnings(tmp_path: Path) -> None:
    parquet.write_table(pa.table({"a": ["a" * 99, "b" * 99]}), str(tmp_path / "a.parquet"), use_dictionary=False)
    data = bytearray((tmp_path / "a.parquet").read_bytes())
    with ParquetFile(tmp_path / "a.parquet", str(tmp_path / "a.parquet")) as opened:
        assert texts(opened.read(["a"]).column("a"), "a")[1] == "b" * 99
    head = data.index(struct.pack("6B", 0x15, 4, 0x15, PLAIN, 0x15, RLE << 1))  # 2 values, PLAIN, levels in runs
    data[head + 3] = PREFIXED << 1
    (tmp_path / "a.parquet").write_bytes(data)
    opened = ParquetFile(tmp_path / "a.parquet", str(tmp_path / "a.parquet"))
    with opened, pytest.raises(CFlowError, match="DELTA_BYTE_ARRAY"):
        opened.read(["a"])


def test_texts_are_held_once(tmp_path: Path) -> None:
    words = pa.DictionaryArray.from_arrays(np.zeros(4000, np.int32), pa.array(["a" * 2**16]))
    parquet.write_table(pa.table({"a": words}), str(tmp_path / "a.parquet"), store_schema=False)
    with ParquetFile(tmp_path / "a.parquet", str(tmp_path / "a.parquet")) as opened:
        before = pa.total_allocated_bytes()
        column = opened.read(["a"]).column("a")
        assert pa.total_allocated_bytes() - before < 16 * MIB  # 250 MiB if written out
        assert len({id(word) for word in texts(column, "a")}) == 1


def test_a_file_that_shrinks(tmp_path: Path) -> None:
    place = tmp_path / "a.parquet"
    parquet.write_table(pa.table({"a": np.random.default_rng(0).random(100_000)}), str(place))
    with ParquetFile(place, str(place)) as opened:
        os.truncate(place, 1000)
        with pytest.raises(CFlowError, match="cannot read"):  # a mapped file would end the process: SIGBUS
            opened.read(["a"])


def test_bombs_take_little_memory(tmp_path: Path) -> None:
    """Files of some hundred kilobytes that unpack to 1.5 GiB, in a process of their own."""
    sink = pa.BufferOutputStream()
    with pa.CompressedOutputStream(sink, "zstd") as stream:
        for _ in range(24):
            stream.write(bytes(64 * MIB))
    packed, count = sink.getvalue().to_pybytes(), 24 * 8 * MIB
    for name, claim, rows in (("honest", 24 * 64 * MIB, count), ("lying", 1000, 125)):
        data = cloud([page(packed, rows, claim=claim)], rows, coded=CODECS["zstd"])
        assert len(data) < MIB
        (tmp_path / f"{name}.parquet").write_bytes(data)
    whole = feather_bytes(XYZ, compression="zstd")
    at = whole.index(struct.pack("<q", 32))
    (tmp_path / "a.feather").write_bytes(lie(whole, at, 24 * 64 * MIB))
    program = """
import resource, sys
from cflow_torch import CFlowError
from cflow_torch.data.arrays.cloud_file import read_cloud
before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
for name in sys.argv[1:]:
    try:
        read_cloud(name)
    except CFlowError as error:
        print(error)
print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before)
"""
    names = [str(file) for file in sorted(tmp_path.iterdir())]
    done = subprocess.run([sys.executable, "-c", program, *names], capture_output=True, text=True, check=True)
    *errors, grown = done.stdout.splitlines()
    assert len(errors) == 3
    assert int(grown) < 100 * 1024  # KiB


@pytest.mark.slow
def test_one_range_image_of_a_whole_row_group(tmp_path: Path) -> None:
    """The dearest file there is: 250 kB, one list of all the values that a row group may have."""
    if (available_memory({}) or 0) < 12 << 30:
        pytest.skip("needs 12 GiB")
    count = 700_000_000  # of 4 bytes: a little less than MAX_STREAMED_BYTES
    making = """
import sys
import numpy as np, pyarrow as pa
from pyarrow import parquet
name, count = sys.argv[1], int(sys.argv[2])
values = pa.ListArray.from_arrays(pa.array([0, count], pa.int32()), pa.array(np.zeros(count, np.float32)))
table = pa.table({"image.values": values, "image.shape": pa.array([[1, count // 4, 4]], pa.list_(pa.int32(), 3))})
parquet.write_table(table, name, compression="zstd", use_dictionary=False, write_statistics=False)
"""
    reading = """
import resource, sys
from pathlib import Path
from cflow_torch.data.waymo.parquet import read_images
before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
assert read_images(Path(sys.argv[1]), [0], "image", 4)[0].size == int(sys.argv[2])
print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before)
"""
    place, grown = tmp_path / "a.parquet", ""
    for program in (making, reading):
        command = [sys.executable, "-c", program, str(place), str(count)]
        grown = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    assert place.stat().st_size < MIB
    assert 2 << 20 < int(grown) < 7.5 * (1 << 20)  # KiB


# ---------------------------------------------------------------------------------------------- readers


@pytest.fixture
def av2(tmp_path: Path) -> Path:
    TARGETS["av2"].prepare(tmp_path)
    (tmp_path / "flow_labels.feather").unlink()
    return tmp_path


def changed(place: Path, change: Callable[[pa.Table], pa.Table]) -> None:
    read, write = (
        (feather.read_table, feather.write_feather)
        if place.suffix == ".feather"
        else (parquet.read_table, parquet.write_table)
    )
    table = change(read(str(place)))
    write(table, str(place))


def with_column(name: str, values: Any) -> Callable[[pa.Table], pa.Table]:
    return lambda table: table.set_column(table.column_names.index(name), name, pa.array(values))


@pytest.mark.parametrize(
    ("name", "values", "message"),
    [
        ("timestamp_ns", np.array([100, 2**64 - 1], np.uint64), "more than"),
        ("track_uuid", ["a", None], "no name|empty entries"),
        ("track_uuid", [1, 2], "must be text"),
        ("category", ["x" * 10**6] * 2, "unknown categories .{1,500} ...; the known"),
        ("length_m", [np.nan] * 2, "not finite"),
        ("num_interior_pts", pa.array([None, 3], pa.int64()), "empty entries"),
    ],
)
def test_hostile_annotations(av2: Path, name: str, values: Any, message: str) -> None:
    assert AV2Log(av2).labels(0) is not None
    changed(av2 / "annotations.feather", with_column(name, values))
    with pytest.raises(CFlowError, match=message):
        AV2Log(av2).labels(0)


def test_names_that_are_no_times(av2: Path) -> None:
    for stem in ("²", "٣", "9" * 40):
        (av2 / "sensors/lidar" / f"{stem}.feather").write_bytes(b"")
    assert list(AV2Log(av2).timestamps) == [100, 200]


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no pipes here")
def test_a_pipe_is_no_file(av2: Path) -> None:
    (av2 / "annotations.feather").unlink()
    os.mkfifo(av2 / "annotations.feather")
    with pytest.raises(CFlowError, match="annotations"):
        AV2Log(av2).labels(0)


def test_tables_of_a_million_rows(av2: Path) -> None:
    rows = (1 << 20) + 1
    columns = {"timestamp_ns": np.zeros(rows, np.int64), **{name: np.zeros(rows) for name in ("tx_m", "ty_m", "tz_m")}}
    table = pa.table({**columns, **{name: np.zeros(rows) for name in ("qw", "qx", "qy", "qz")}})
    feather.write_feather(table, str(av2 / "city_SE3_egovehicle.feather"))
    with pytest.raises(CFlowError, match="1048577 rows"):
        AV2Log(av2)


def test_too_many_boxes_and_many_of_one_name() -> None:
    def boxes(names: List[str]) -> Boxes:
        count = len(names)
        return Boxes(names, np.zeros(count, np.uint8), np.ones((count, 3)), np.zeros((count, 4, 4)))

    boxes([str(number) for number in range(MAX_BOXES)])
    with pytest.raises(CFlowError, match="up to 10000"):
        boxes([str(number) for number in range(MAX_BOXES + 1)])
    with pytest.raises(CFlowError, match="named twice"):
        boxes([str(number // 2) for number in range(200_000)])  # was quadratic: minutes


@pytest.mark.parametrize(
    ("tag", "column", "values", "message"),
    [
        ("lidar", 4, pa.array([[-2, -1, 4]] * 4, pa.list_(pa.int32(), 3)), "range image of shape"),
        ("lidar", 4, pa.array([[2**31 - 1, 2**31 - 1, 4]] * 4, pa.list_(pa.int32(), 3)), "range image of shape"),
        ("lidar", 4, pa.array([[2, 1, None]] * 4, pa.list_(pa.int32(), 3)), "range image of shape"),
        ("lidar", 3, pa.array([["a"] * 8] * 4), "lists of floats|columns of numbers"),
        ("lidar", 3, pa.array([[1.0] * 7 + [None]] * 4, pa.list_(pa.float32())), "empty pixels"),
        ("lidar", 3, pa.array([1.0] * 4), "lists of floats"),
        ("lidar", 1, pa.array([0.5, 0.5, 200.0, 200.0]), "whole numbers"),
        ("lidar", 1, pa.array([2**62] * 4), "whole numbers"),
        ("lidar", 0, pa.array([None] * 4, pa.string()), "no name"),
        ("lidar", 0, pa.array([1] * 4), "must be text"),
        ("lidar_box", 0, pa.array([b"seg"] * 2), "columns of numbers|text"),
        ("vehicle_pose", 2, pa.array(["a" * 16] * 2), "numbers"),
        ("lidar_calibration", 2, pa.array([["1"] * 16] * 2), "numbers"),
        ("lidar_calibration", 3, pa.array(["-0.5"] * 2), "numbers"),
        ("lidar_calibration", 5, pa.array(["x"] * 2), "numbers"),
    ],
)
def test_hostile_components(tmp_path: Path, tag: str, column: int, values: Any, message: str) -> None:
    TARGETS["waymo"].prepare(tmp_path)
    place = tmp_path / tag / "seg.parquet"
    changed(place, lambda table: table.set_column(column, table.column_names[column], values))
    with pytest.raises(CFlowError, match=message):
        log = WaymoLog(tmp_path / "lidar" / "seg.parquet")
        log.labels(0)
        log.sweep(1)


@pytest.mark.parametrize("column", [3, 4])
def test_limits_of_beams_that_are_empty_lists(tmp_path: Path, column: int) -> None:
    TARGETS["waymo"].prepare(tmp_path)
    place, empty = tmp_path / "lidar_calibration" / "seg.parquet", pa.array([[]] * 2, pa.list_(pa.float64()))
    changed(place, lambda table: table.set_column(column, table.column_names[column], empty))
    with pytest.raises(CFlowError, match="neither beam inclinations nor their limits"):
        WaymoLog(tmp_path / "lidar" / "seg.parquet").sweep(0)


def test_a_row_group_of_fewer_rows_than_it_claims(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    TARGETS["waymo"].prepare(tmp_path)
    log = WaymoLog(tmp_path / "lidar" / "seg.parquet")
    monkeypatch.setattr(ParquetFile, "batches", lambda *_: iter(()))  # what Arrow made of a damaged file
    with pytest.raises(CFlowError, match="fewer rows than it claims: row 0 is missing"):
        log.sweep(0)


@pytest.mark.parametrize("name", ["cluster_id", "is_valid", "flow_tx_m", "score"])
@pytest.mark.parametrize("values", [["a"] * 4, np.zeros(4, np.uint64), [None] * 4, np.zeros(4, np.float64)])
def test_hostile_flow_files(tmp_path: Path, name: str, values: Any) -> None:
    place = tmp_path / "a.feather"
    place.write_bytes(TARGETS["flow"].seeds()[0])
    assert len(read_flow(place).flow) == 4
    changed(place, with_column(name, values))
    if name in ("flow_tx_m", "score") and isinstance(values, np.ndarray) and values.dtype == np.float64:
        return
    with pytest.raises(CFlowError, match="no flow file"):
        read_flow(place)


def test_a_submission_says_one_line_each() -> None:
    table = pa.table({**XYZ, "a\nb" * 5000: np.zeros(4), "x" * 5: np.zeros(4)})
    for version in VERSIONS.values():
        problems = check_file("a", feather_bytes(table), 4, version)
        assert problems and all("\n" not in line and len(line) < 1000 for line in problems)
