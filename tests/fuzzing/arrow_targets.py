"""Everything that comes through Arrow: Argoverse 2, Waymo's parquet, clouds, flow, submissions and their masks."""

from __future__ import annotations

import io
import random
import zipfile
from functools import lru_cache
from pathlib import Path
from typing import Any, Callable, Dict, List, Sequence, Tuple

import numpy as np
import pyarrow as pa
from pyarrow import feather, parquet

from cflow_torch import CFlowError
from cflow_torch.data.arrays.cloud_file import read_cloud
from cflow_torch.data.av2 import AV2Log
from cflow_torch.data.flow_file import read_flow
from cflow_torch.data.log import Log
from cflow_torch.data.waymo.parquet import SCHEMAS
from cflow_torch.data.waymo.reader import WaymoLog
from cflow_torch.evaluation.submission.check import check_file
from cflow_torch.evaluation.submission.masks import MaskArchive
from cflow_torch.evaluation.submission.versions import VERSIONS
from fuzzing.crafted_arrow import crafted, feather_bytes, hostile_table, one_of_several, parquet_bytes
from fuzzing.crafted_parquet import deep, lying
from fuzzing.target import Target

_ROWS, _TIMES = 4, (100, 200)
_WAYMO = ("lidar", "lidar_calibration", "lidar_pose", "vehicle_pose", "lidar_box")
_TURN = np.eye(4).reshape(-1).tolist()
_POSE = {"qw": 1.0, "qx": 0.0, "qy": 0.0, "qz": 0.0, "tx_m": 1.0, "ty_m": 2.0, "tz_m": 3.0}


def _floats(names: Sequence[str], kind: Any = np.float32) -> Dict[str, Any]:
    return {name: np.arange(_ROWS, dtype=kind) for name in names}


def _av2_tables() -> Dict[str, pa.Table]:
    pose = {name: [value] * 2 for name, value in _POSE.items()}
    sizes = {name: [20.0] * 2 for name in ("length_m", "width_m", "height_m")}
    times = {"timestamp_ns": np.array(_TIMES)}
    boxes = {"track_uuid": ["a", "a"], "category": ["BUS", "BUS"], **sizes, **pose, "num_interior_pts": [3, 3]}
    flow = _floats([f"flow_t{axis}_m" for axis in "xyz"])
    classes = {"classes": np.zeros(_ROWS, np.uint8), "is_valid": np.ones(_ROWS, bool)}
    return {
        "sensors/lidar/100.feather": pa.table(
            {**_floats("xyz", np.float16), "laser_number": np.zeros(_ROWS, np.uint8)}
        ),
        "city_SE3_egovehicle.feather": pa.table({**times, **pose}),
        "annotations.feather": pa.table({**times, **boxes}),
        "flow_labels.feather": pa.table({**flow, **classes}),
    }


def _waymo_tables() -> Dict[str, pa.Table]:
    keys = [("key.segment_context_name", "seg"), ("key.frame_timestamp_micros", 0), ("key.laser_name", 1)]
    rows: Dict[str, List[Dict[str, Any]]] = {tag: [] for tag in _WAYMO}
    for time in _TIMES:
        for laser in (1, 3):
            here = {**dict(keys), "key.frame_timestamp_micros": time, "key.laser_name": laser}
            for tag, depth in (("lidar", 4), ("lidar_pose", 6)):
                rows[tag].append(
                    {**here, **{name: [2, 1, depth] if name.endswith("shape") else [1.0] * 2 * depth
                                for name in SCHEMAS[tag].names[3:]}}
                )  # fmt: skip
        rows["vehicle_pose"].append({**here, SCHEMAS["vehicle_pose"].names[2]: _TURN})
        box = {field.name: 4.0 if str(field.type) == "double" else 1 for field in SCHEMAS["lidar_box"]}
        rows["lidar_box"].append({**box, **here, "key.laser_object_id": "a"})
    names = SCHEMAS["lidar_calibration"].names
    for laser in (1, 3):
        rows["lidar_calibration"].append(dict(zip(names, ("seg", laser, _TURN, -0.5, 0.1, [-0.3, 0.0][: 3 - laser]))))
    return {
        f"{tag}/seg.parquet": pa.Table.from_pylist(
            [{name: row.get(name) for name in SCHEMAS[tag].names} for row in rows[tag]], schema=SCHEMAS[tag]
        )
        for tag in _WAYMO
    }


def _written(table: pa.Table, **options: Any) -> bytes:
    sink = io.BytesIO()
    feather.write_feather(table, sink, **options)
    return sink.getvalue()


def _feathers(table: pa.Table) -> List[bytes]:
    return [_written(table, compression=name) for name in ("uncompressed", "lz4", "zstd")] + [
        _written(table, chunksize=1)
    ]


def _parquets(table: pa.Table) -> List[bytes]:
    found = []
    for codec, dictionary, version in (("snappy", True, "1.0"), ("zstd", False, "2.0"), ("none", True, "1.0")):
        sink = io.BytesIO()
        parquet.write_table(
            table, sink, compression=codec, use_dictionary=dictionary, data_page_version=version, row_group_size=3
        )
        found.append(sink.getvalue())
    return found


@lru_cache(None)
def _whole(tables: Callable[[], Dict[str, pa.Table]]) -> List[Tuple[str, pa.Table, List[bytes]]]:
    write = _feathers if tables is _av2_tables else _parquets
    return [(name, table, write(table)) for name, table in tables().items()]


def _several(
    name: str, tables: Callable[[], Dict[str, pa.Table]], write: Callable[..., bytes], read: Callable[[Path], Any]
) -> Target:
    """A reader of several files, one of which is hostile: the first byte says which."""

    def prepare(folder: Path) -> None:
        for file, _, whole in _whole(tables):
            (folder / file).parent.mkdir(parents=True, exist_ok=True)
            (folder / file).write_bytes(whole[0])
        if name == "av2":
            (folder / "sensors/lidar/200.feather").write_bytes(_whole(tables)[0][2][0])

    def read_one(folder: Path) -> None:
        data = (folder / "hostile").read_bytes() or b"\0"
        file, _, whole = _whole(tables)[data[0] % len(_whole(tables))]
        if not file.startswith("flow_labels") and name == "av2":  # which win over the boxes
            (folder / "flow_labels.feather").unlink()
        try:
            (folder / file).write_bytes(data[1:])
            read(folder)
        finally:
            (folder / file).write_bytes(whole[0])
            if name == "av2":
                (folder / "flow_labels.feather").write_bytes(_whole(tables)[3][2][0])

    def seeds() -> List[bytes]:
        return [bytes([number]) + data for number, (_, _, whole) in enumerate(_whole(tables)) for data in whole]

    hostile = one_of_several(
        [lambda chance, number=number: write(chance, hostile_table(chance, _whole(tables)[number][1]))
         for number in range(len(tables()))]
    )  # fmt: skip
    return Target(name, "hostile", seeds, read_one, prepare, hostile, _TOKENS)


def _read_log(log: Log) -> None:
    for index in range(len(log.timestamps)):
        log.sweep(index)
        log.labels(index)


def _read_waymo(folder: Path) -> None:
    _read_log(WaymoLog(folder / "lidar/seg.parquet", both_returns=True))


def _cloud(name: str) -> Target:
    whole = pa.table({**_floats("xyz"), "intensity": np.zeros(_ROWS)})

    def hostile(chance: random.Random) -> bytes:
        if name == "parquet":
            kind = chance.random()
            if kind < 0.5:
                return lying(chance, "xyz")
            return deep(chance.choice((3, 1500, 30000))) if kind < 0.51 else parquet_bytes(chance, _hostile(chance))
        return feather_bytes(chance, _hostile(chance))

    def _hostile(chance: random.Random) -> pa.Table:
        return hostile_table(chance, whole)

    seeds = _feathers if name == "feather" else _parquets
    return Target(
        name, f"a.{name}", lambda: seeds(whole), lambda folder: read_cloud(folder / f"a.{name}"),
        crafted=crafted(hostile), tokens=_TOKENS,
    )  # fmt: skip


def _single(name: str, table: pa.Table, read: Callable[[Path], Any]) -> Target:
    hostile = crafted(lambda chance: feather_bytes(chance, hostile_table(chance, table)))
    return Target(name, "a.feather", lambda: _feathers(table), read, crafted=hostile, tokens=_TOKENS)


def _read_frame(folder: Path) -> None:
    data = (folder / "a.feather").read_bytes()
    problems = [check_file("a", data, _ROWS, version) for version in VERSIONS.values()]
    if all(problems):
        raise CFlowError("\n".join(problems[0]))


def _read_mask(folder: Path) -> None:
    with zipfile.ZipFile(folder / "masks.zip", "w") as archive:
        archive.write(folder / "a.feather", "log/100.feather")
    MaskArchive(folder / "masks.zip").mask("log", 100)


_TOKENS = (b"ARROW1", b"PAR1", b"FEA1", b"\xff\xff\xff\xff", b"x", b"tx_m", b"ARROW:extension:name", b"ARROW:schema")
_FLOW = [f"{name}_t{axis}_m" for name in ("flow", "residual", "pose") for axis in "xyz"] + ["score"]
_RESULT = {**_floats(_FLOW), "cluster_id": np.zeros(_ROWS, np.int64), "is_valid": np.ones(_ROWS, bool)}
_FRAME = {"is_dynamic": np.ones(_ROWS, bool), **_floats([f"flow_t{axis}_m" for axis in "xyz"], np.float16)}
TARGETS: Tuple[Target, ...] = (
    _several("av2", _av2_tables, feather_bytes, lambda folder: _read_log(AV2Log(folder))),
    _several("waymo", _waymo_tables, parquet_bytes, _read_waymo),
    _cloud("feather"),
    _cloud("parquet"),
    _single("flow", pa.table(_RESULT), lambda folder: read_flow(folder / "a.feather")),
    _single("submission", pa.table(_FRAME), _read_frame),
    _single("mask", pa.table({"mask": np.ones(_ROWS, bool)}), _read_mask),
)
