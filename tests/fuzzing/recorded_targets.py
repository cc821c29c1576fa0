"""Sweeps of recorded data sets: nuScenes, TruckScenes, Waymo (tfrecord), AevaScenes (npz)."""

from __future__ import annotations

import json
import pickle
from functools import lru_cache
from pathlib import Path
from typing import Any, Callable, List, Sequence, Tuple

import numpy as np
from tiny_recording import START_NS, TinyRecording

from cflow_torch.data.aevascenes.reader import AevaScenesLog
from cflow_torch.data.arrays.pcd import write_pcd
from cflow_torch.data.nuscenes.reader import NuScenesLog, find_nuscenes_scenes
from cflow_torch.data.truckscenes.reader import TruckScenesLog, find_truckscenes_scenes
from cflow_torch.data.waymo.tfrecord import WaymoRecordLog
from cflow_torch.simulator.writers.nuscenes import write_nuscenes
from cflow_torch.simulator.writers.truckscenes import write_truckscenes
from fuzzing.clouds_targets import PCD_TOKENS, any_of, written
from fuzzing.crafted_clouds import BODY, crafted_pcd, npy_of
from fuzzing.crafted_recordings import NAMES, Frames, crafted_frames, crafted_names, names_npz, object_npy, varint
from fuzzing.target import Target

_STAMPS = (START_NS, START_NS + 100_000_000)


def _scene(write: Callable[..., Any], lidar: str) -> Callable[[Path], None]:
    """Writes a scene of three sweeps to the folder `tiny`, of which the middle one is `tiny/sweep`."""

    def prepare(folder: Path) -> None:
        write(TinyRecording((lidar,), num_sweeps=3), folder, key_frame_interval=0.1)
        (table,) = folder.glob("tiny/v*/sample_data.json")
        rows = json.loads(table.read_text())
        middle = sorted((row for row in rows if lidar in row["filename"]), key=lambda row: row["timestamp"])[1]
        middle["filename"] = "sweep"
        table.write_text(json.dumps(rows))

    return prepare


@lru_cache(maxsize=4)  # the tables are not what is fuzzed here
def _nuscenes(folder: Path) -> Sequence[Any]:
    return [NuScenesLog(source) for source in find_nuscenes_scenes(folder / "tiny")]


@lru_cache(maxsize=4)
def _truckscenes(folder: Path) -> Sequence[Any]:
    (source,) = find_truckscenes_scenes(folder / "tiny")
    return [TruckScenesLog(source), TruckScenesLog(source, deskew=False)]


def _read_truck(folder: Path) -> List[Any]:
    each, at_once = _truckscenes(folder)
    return any_of(lambda: each.labels(1), lambda: at_once.sweep(1))


@lru_cache(maxsize=4)
def _aevascenes(folder: Path) -> Sequence[Any]:
    return [AevaScenesLog(folder)]


def _read_frames(folder: Path) -> List[Any]:
    log = WaymoRecordLog(folder / "a.tfrecord")
    flow = WaymoRecordLog(folder / "a.tfrecord", stored_flow=True)
    return any_of(lambda: log.labels(0), lambda: flow.labels(0))  # of the points of both frames


def _nuscenes_seeds() -> List[bytes]:
    rows = np.zeros((3, 5), "<f4")
    rows[:, :3], rows[:, 4] = 5.0, (0, 1, 31)
    return [rows.tobytes()]


def _truckscenes_seeds() -> List[bytes]:
    fields = {axis: np.full(4, 9.0, np.float32) for axis in "xyz"}
    fields["timestamp"] = np.full(4, _STAMPS[1] // 1000 + 5, np.uint64)
    kinds = ("ascii", "binary", "binary_compressed")
    return written("a.pcd", *(lambda file, d=data: write_pcd(file, fields, d) for data in kinds))


def _prepare_sequence(folder: Path) -> None:
    pose = {"translation": dict.fromkeys("xyz", 0.0), "rotation": {"w": 1.0, "x": 0.0, "y": 0.0, "z": 0.0}}
    box = {"id": "a", "class": "car", "dimensions": dict.fromkeys("xyz", 2.0), "pose": pose}
    names = dict(zip(_STAMPS, ("cloud.npz", "other.npz")))
    frames = [
        {"timestamp_ns": t, "ego_pose": pose, "point_cloud": {"l": {"point_cloud_path": name}}, "boxes": [box]}
        for t, name in names.items()
    ]
    metadata = {"sensors": {"lidars": ["l"]}, "vehicle_to_lidar_extrinsics": {"l": pose}}
    (folder / "sequence.json").write_text(json.dumps({"metadata": metadata, "frames": frames}))
    (folder / "other.npz").write_bytes(_aevascenes_seeds()[0])


def _aevascenes_seeds() -> List[bytes]:
    pickles = [pickle.dumps(NAMES, protocol=protocol) for protocol in (3, 4, 5)]
    pickles.append(pickle.dumps(np.array([[np.str_("car")]] * 4, dtype=object), protocol=4))
    return [*(names_npz(object_npy(content)) for content in pickles), names_npz(npy_of(NAMES.astype(str)))]


def _read_cloud(folder: Path) -> List[Any]:
    (log,) = _aevascenes(folder)
    return any_of(lambda: log.sweep(0), lambda: log.radial_velocity(0), lambda: log.labels(0))


TARGETS: Tuple[Target, ...] = (
    Target(
        *("nuscenes_sweep", "tiny/sweep", _nuscenes_seeds),
        lambda folder: [log.labels(1) for log in _nuscenes(folder)],  # of the sweep's points
        prepare=_scene(write_nuscenes, "LIDAR_TOP"),
        crafted=BODY,
    ),
    Target(
        *("truckscenes_sweep", "tiny/sweep", _truckscenes_seeds),
        _read_truck,
        prepare=_scene(write_truckscenes, "LIDAR_LEFT"),
        crafted=crafted_pcd((*"xyz", "timestamp")),
        tokens=PCD_TOKENS,
    ),
    Target(
        *("waymo_tfrecord", "a.tfrecord", lambda: [Frames().build()], _read_frames),
        crafted=crafted_frames(),
        tokens=(b"\x08", b"\x12", b"\xff" * 12, b"\x09", b"\x0a\x00", varint(1 << 40)),
    ),
    Target(
        *("aevascenes_npz", "cloud.npz", _aevascenes_seeds, _read_cloud),
        prepare=_prepare_sequence,
        crafted=crafted_names(),
        tokens=(
            b"PK\1\2",
            b"PK\3\4",
            b"R",
            b"b",
            b"h\0",
            b"e",
            b"(",
            b"cnumpy\ndtype\n",
            b"'|O'",
            b"semantic_labels.npy",
        ),
    ),
)
