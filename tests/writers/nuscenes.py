"""Write a recording in the layout of nuScenes: JSON tables and `.pcd.bin` sweeps."""

from __future__ import annotations

import hashlib
import json
from base64 import b64decode
from datetime import datetime, timezone
from pathlib import Path
from typing import Any, Dict, List, Mapping, Sequence

import numpy as np

from cflow_torch.data.atomic import new_folder
from cflow_torch.data.nuscenes.reader import NUSCENES_CATEGORIES
from cflow_torch.data.paths import safe_name
from cflow_torch.simulator.drive import Drive
from cflow_torch.simulator.recording import UnitReturns
from cflow_torch.transforms import to_quaternions
from cflow_torch.types import CFlowError

# A PNG of one pixel: the devkit requires a map file, which it opens only to draw it.
_BLACK_PIXEL = "iVBORw0KGgoAAAANSUhEUgAAAAEAAAABCAAAAAA6fptVAAAACklEQVR4nGNgAAAAAgABSK+kcQAAAABJRU5ErkJggg=="
_VERSION = "v1.0-mini"  # folder of the tables
_VISIBILITY = ("v0-40", "v40-60", "v60-80", "v80-100")
Table = List[Dict[str, Any]]
NUSCENES_NAMES: dict[str, str] = {
    **{name: own for own, name in reversed(NUSCENES_CATEGORIES.items()) if name != "NONE"},
    **dict.fromkeys(("BICYCLIST", "WHEELED_DEVICE", "WHEELED_RIDER"), "vehicle.bicycle"),
    **dict.fromkeys(("BOX_TRUCK", "TRUCK_CAB"), "vehicle.truck"),
    "CONSTRUCTION_BARREL": "movable_object.trafficcone",
    "DOG": "animal",
    "MOTORCYCLIST": "vehicle.motorcycle",
    "OFFICIAL_SIGNALER": "human.pedestrian.police_officer",
    "SCHOOL_BUS": "vehicle.bus.rigid",
}
"""Argoverse 2 category -> the nearest category of nuScenes in the same meta class."""


def write_nuscenes(recording: Drive, root: str | Path, key_frame_interval: float = 0.5) -> Path:
    """Write `recording` to `root/<log_id>`, a data root of nuScenes with one scene of that name.

    Args:
        recording: the recording. If no LiDAR is called LIDAR_TOP, the first one gets this name.
        root: folder, made if it does not exist.
        key_frame_interval: seconds between samples (key frames). Only they have boxes. The first and the last sweep
            are samples, so that boxes can be interpolated for every sweep.

    Returns:
        The data root.

    Convention:
        - The official devkit can load all 13 tables. `attribute` is empty. All boxes have the highest visibility.
        - Points are float32 in the frame of their LiDAR, with intensity and ring, in the order of the recording.
        - Time stamps are truncated to microseconds. Unlike in the real data set, ego poses have a height.
        - The format has no ground mask and no flow.

    Raises:
        CFlowError: the scene exists already, the log_id cannot be used as a folder name, a category has no counterpart,
            the LiDARs change from sweep to sweep, or time stamps do not increase by a microsecond or more.
    """

    def write_points(file: Path, unit: UnitReturns, stamp_ns: int) -> None:
        file.write_bytes(np.column_stack([unit.points, unit.intensity, unit.ring]).astype("<f4").tobytes())

    with new_folder(root, recording.log_id) as folder:
        scene = SceneWriter(recording, folder, "LIDAR_TOP", NUSCENES_NAMES)
        tables = scene.write("{name}__{channel}__{stamp}.pcd.bin", write_points, key_frame_interval)
        log = scene.token("log")
        image = f"maps/{recording.log_id}.png"
        day = datetime.fromtimestamp(recording.timestamps[0] * 1e-9, timezone.utc).strftime("%Y-%m-%d")
        tables["log"] = [
            {"token": log, "logfile": recording.log_id, "vehicle": "", "date_captured": day, "location": ""}
        ]
        tables["map"] = [
            {"token": scene.token("map"), "log_tokens": [log], "category": "semantic_prior", "filename": image}
        ]
        tables["scene"][0]["log_token"] = log
        (folder / "maps").mkdir()
        (folder / image).write_bytes(b64decode(_BLACK_PIXEL))
        write_tables(folder / _VERSION, tables)
    return Path(root) / recording.log_id


class SceneWriter:
    """Write the sweeps and tables that nuScenes and TruckScenes have in common.

    Args:
        recording: the recording.
        folder: data root.
        reference: channel name for the first LiDAR, if no LiDAR has this name.
        names: Argoverse 2 category -> category of the format.
    """

    def __init__(self, recording: Drive, folder: Path, reference: str, names: Mapping[str, str]) -> None:
        self.recording = recording
        self.folder = folder
        self._names = names
        self._units = recording.units(0)
        self._channels = [safe_name(unit.name, "the LiDAR") for unit in self._units]
        if reference not in self._channels:
            self._channels[0] = reference
        self._stamps = [int(stamp) // 1000 for stamp in recording.timestamps]
        if any(later <= earlier for earlier, later in zip(self._stamps, self._stamps[1:])):
            raise CFlowError(f"log {recording.log_id}: time stamps must ascend by a microsecond or more")

    def token(self, *what: object) -> str:
        """Token of 32 hex characters, which depends only on `log_id` and `what`."""
        return hashlib.md5(repr((self.recording.log_id, *what)).encode()).hexdigest()

    def write(self, file_name: str, write_points: Any, key_frame_interval: float) -> dict[str, Table]:
        """Write the points of all sweeps. Return the tables, which the caller writes.

        Args:
            file_name: pattern with {name} of the log, {channel}, {stamp} in microseconds.
            write_points: writes a file; takes its path, the returns of a LiDAR, and the time stamp in nanoseconds.
            key_frame_interval: seconds between samples.

        Returns:
            Table name -> rows.
        """
        keys = self._key_frames(key_frame_interval)
        tables = self._fixed_tables(keys)
        last = len(self._stamps) - 1
        for index, stamp in enumerate(self._stamps):
            units = self.recording.units(index)
            if [unit.name for unit in units] != [unit.name for unit in self._units]:
                raise CFlowError(f"log {self.recording.log_id}: sweep {index} has other LiDARs than the first sweep")
            sample = next(key for key in keys if key >= index)  # a sweep belongs to the next sample
            for channel, unit in zip(self._channels, units):
                kind = "samples" if index == sample else "sweeps"
                name = file_name.format(name=self.recording.log_id, channel=channel, stamp=stamp)
                file = self.folder / kind / channel / name
                file.parent.mkdir(parents=True, exist_ok=True)
                write_points(file, unit, self.recording.timestamps[index])
                token = self.token("sweep", channel, index)
                tables["ego_pose"].append(
                    {"token": token, "timestamp": stamp, **_pose(np.asarray(self.recording.poses[index]))}
                )
                tables["sample_data"].append(
                    {
                        "token": token,
                        "sample_token": self.token("sample", sample),
                        "ego_pose_token": token,
                        "calibrated_sensor_token": self.token("mount", channel),
                        "timestamp": stamp,
                        "fileformat": "pcd",
                        "is_key_frame": index == sample,
                        "height": 0,
                        "width": 0,
                        "filename": f"{kind}/{channel}/{name}",
                        "prev": self.token("sweep", channel, index - 1) if index > 0 else "",
                        "next": self.token("sweep", channel, index + 1) if index < last else "",
                    }
                )
        self._annotate(keys, tables)
        return tables

    def _key_frames(self, interval: float) -> list[int]:
        step = int(np.median(np.diff(self._stamps))) if len(self._stamps) > 1 else 0
        keys = [0]
        for index, stamp in enumerate(self._stamps):
            if stamp - self._stamps[keys[-1]] >= interval * 1e6 - step / 2 and index > 0:
                keys.append(index)
        last = len(self._stamps) - 1
        return keys if keys[-1] == last else [*keys, last]

    def _fixed_tables(self, keys: Sequence[int]) -> dict[str, Table]:
        """The tables of the scene, its samples and sensors, and empty tables to fill."""
        token = self.token
        scene = self.token("scene")
        samples = [token("sample", key) for key in keys]
        links = zip(samples, keys, ["", *samples[:-1]], [*samples[1:], ""])
        mounts = list(zip(self._channels, self._units))
        return {
            "scene": [
                {
                    "token": scene,
                    "log_token": "",
                    "nbr_samples": len(samples),
                    "first_sample_token": samples[0],
                    "last_sample_token": samples[-1],
                    "name": self.recording.log_id,
                    "description": "",
                }
            ],
            "sample": [
                {"token": this, "timestamp": self._stamps[key], "prev": before, "next": after, "scene_token": scene}
                for this, key, before, after in links
            ],
            "sensor": [{"token": token("sensor", c), "channel": c, "modality": "lidar"} for c in self._channels],
            "calibrated_sensor": [
                {
                    "token": token("mount", channel),
                    "sensor_token": token("sensor", channel),
                    **_pose(unit.T_ego_sensor),
                    "camera_intrinsic": [],
                }
                for channel, unit in mounts
            ],
            "visibility": [
                {"token": str(i + 1), "level": name, "description": name} for i, name in enumerate(_VISIBILITY)
            ],
            **{name: [] for name in ("attribute", "sample_data", "ego_pose")},
        }

    def _annotate(self, keys: Sequence[int], tables: dict[str, Table]) -> None:
        """Add the tables of categories, instances, and boxes of the samples."""
        tracks: dict[str, Table] = {}  # track -> its boxes
        category_of: dict[str, str] = {}
        for key in keys:
            boxes = self.recording.boxes(key)
            poses = np.asarray(self.recording.poses[key]) @ boxes.pose
            for row, (track, name) in enumerate(zip(boxes.track_id, boxes.names)):
                if name not in self._names:
                    raise CFlowError(
                        f"log {self.recording.log_id} has a box of category {name!r}, which the format does not have; "
                        f"give one of {sorted(self._names)}"
                    )
                category_of[track] = self._names[name]
                length, width, height = (float(side) for side in boxes.size[row])
                tracks.setdefault(track, []).append(
                    {
                        "token": self.token("box", track, key),
                        "sample_token": self.token("sample", key),
                        "instance_token": self.token("instance", track),
                        "visibility_token": str(len(_VISIBILITY)),
                        "attribute_tokens": [],
                        **_pose(poses[row]),
                        "size": [width, length, height],
                        "prev": "",
                        "next": "",
                        "num_lidar_pts": int(boxes.num_points[row]),
                        "num_radar_pts": 0,
                    }
                )
        for rows in tracks.values():
            for before, after in zip(rows, rows[1:]):
                before["next"], after["prev"] = after["token"], before["token"]
        tables["category"] = [
            {"token": self.token("category", name), "name": name, "description": "", "index": number}
            for number, name in enumerate(sorted(set(self._names.values())))
        ]
        tables["instance"] = [
            {
                "token": rows[0]["instance_token"],
                "category_token": self.token("category", category_of[track]),
                "nbr_annotations": len(rows),
                "first_annotation_token": rows[0]["token"],
                "last_annotation_token": rows[-1]["token"],
            }
            for track, rows in tracks.items()
        ]
        tables["sample_annotation"] = [row for rows in tracks.values() for row in rows]


def write_tables(folder: Path, tables: Mapping[str, Table]) -> None:
    """Write one JSON file per table."""
    folder.mkdir()
    for table, rows in tables.items():
        (folder / f"{table}.json").write_text(json.dumps(rows, indent=0, allow_nan=False))


def _pose(pose: np.ndarray) -> dict[str, list[float]]:
    rotation = to_quaternions(pose[None, :3, :3])[0]
    return {"translation": [float(v) for v in pose[:3, 3]], "rotation": rotation.tolist()}
