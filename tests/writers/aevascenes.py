"""Write a recording in the layout of AevaScenes: `sequence.json` and one npz per LiDAR and frame."""

from __future__ import annotations

import json
import uuid
from pathlib import Path
from typing import Any

import numpy as np

from cflow_torch.data.aevascenes import CATEGORY_NAME, GROUND
from cflow_torch.data.atomic import new_folder
from cflow_torch.data.boxes import Boxes, rows_in_box
from cflow_torch.data.paths import safe_name
from cflow_torch.simulator.drive import Drive
from cflow_torch.simulator.recording import UnitReturns
from cflow_torch.transforms import to_quaternions
from cflow_torch.types import CFlowError

CLASS_OF: dict[str, str] = {
    **{name: kind for kind, name in CATEGORY_NAME.items() if name != "NONE"},
    **dict.fromkeys(("ARTICULATED_BUS", "SCHOOL_BUS"), "bus"),
    **dict.fromkeys(("BOX_TRUCK", "TRUCK_CAB"), "truck"),
    **dict.fromkeys(("MESSAGE_BOARD_TRAILER", "TRAFFIC_LIGHT_TRAILER"), "traffic_item"),
    **dict.fromkeys(("OFFICIAL_SIGNALER", "STROLLER", "WHEELCHAIR"), "pedestrian"),
    **dict.fromkeys(("WHEELED_DEVICE", "WHEELED_RIDER"), "bicyclist"),
    **dict.fromkeys(("BOLLARD", "CONSTRUCTION_BARREL"), "traffic_item"),
    **dict.fromkeys(("MOBILE_PEDESTRIAN_CROSSING_SIGN", "STOP_SIGN"), "traffic_sign"),
    "DOG": "animal",
}
"""Argoverse 2 category -> class of AevaScenes."""

_BACKGROUND, _ON_GROUND = "other_structure", GROUND[0]
_CLASSES = tuple(CATEGORY_NAME)  # we write the position as the class index, because Aeva's own table is not published
_FOLDER = "pointcloud_compensated"
_PATH_KEY = {"v2": "point_cloud_compensated_path", "v0.1": "point_cloud_path"}
_XYZ = ("x", "y", "z")


def write_aevascenes_sequence(log: Drive, root: str | Path, layout: str = "v2") -> Path:
    """Write `log` to `root/<log_id>`.

    Args:
        log: the recording.
        root: folder of the split, made if it does not exist.
        layout: "v2", or "v0.1", which has another key for the paths of the clouds.

    Returns:
        The sequence folder, for `AevaScenesLog`.

    Convention:
        - Points are float32 in the frame of their LiDAR. Poses and boxes are exact float64 JSON numbers. Rotations are
          quaternions. Ego poses are relative to the first one.
        - We write only motion-compensated clouds, because a recording has no others.
        - Every point has a class name: "road" on the ground, the class of the box that holds it, or "other_structure".
          `semantic_labels_idx` is the position of the name in `CATEGORY_NAME`. Aeva's own numbers may differ.
        - Points have a radial velocity of 0, because a recording has none.
        - Boxes have no velocities, because the reader does not use them.

    Raises:
        CFlowError: the sequence exists already, the folder name or the layout is not valid, a shot is before its
            sweep's time stamp or more than 4 s after it, or a category has no class.
    """
    if layout not in _PATH_KEY:
        raise CFlowError(f"layout={layout!r}: give one of {', '.join(_PATH_KEY)}")
    with new_folder(root, log.log_id) as folder:
        (folder / _FOLDER).mkdir()
        _write_sequence(log, folder, _PATH_KEY[layout])
    return Path(root) / log.log_id


def _write_sequence(log: Drive, folder: Path, path_key: str) -> None:
    poses = np.asarray(log.poses, np.float64)
    from_first = np.linalg.inv(poses[0]) @ poses
    from_first[0] = np.eye(4)  # without rounding errors
    frames: list[dict[str, Any]] = []
    mounts: dict[str, np.ndarray] = {}
    for index, stamp in enumerate(log.timestamps):
        units = log.units(index)
        boxes = log.boxes(index)
        classes = _classes(log, index, boxes)
        clouds = {}
        begin = 0
        for unit in units:
            mounts[unit.name] = np.asarray(unit.T_ego_sensor, np.float64)
            path = f"{_FOLDER}/{safe_name(unit.name, 'the LiDAR')}_{stamp}.npz"
            end = begin + len(unit.points)
            _write_cloud(folder / path, unit, classes[begin:end], f"sweep {index} of log {log.log_id}")
            clouds[unit.name] = {path_key: path}
            begin = end
        frames.append(
            {
                "timestamp_ns": int(stamp),
                "frame_idx": index,
                "frame_uuid": str(uuid.uuid5(uuid.NAMESPACE_OID, f"{log.log_id}/{stamp}")),
                "ego_pose": _pose(from_first[index]),
                "point_cloud": clouds,
                "image": {},
                "boxes": _boxes(boxes),
            }
        )
    metadata = {
        "sequence_uuid": log.log_id,
        "sensors": {"lidars": list(mounts), "cameras": []},
        "camera_lidar_mapping": {},
        "vehicle_to_lidar_extrinsics": {name: _pose(T_ego_sensor) for name, T_ego_sensor in mounts.items()},
        "vehicle_to_camera_extrinsics": {},
        "camera_intrinsics": {},
    }
    (folder / "sequence.json").write_text(json.dumps({"metadata": metadata, "frames": frames}, default=float))


def _write_cloud(path: Path, unit: UnitReturns, classes: np.ndarray, where: str) -> None:
    offset = np.asarray(unit.offset_ns)
    if offset.size and not 0 <= offset.min() <= offset.max() < 2**32:
        raise CFlowError(
            f"{where}, unit {unit.name}: shots {offset.min()} ... {offset.max()} ns after the time stamp; AevaScenes "
            f"stores 0 ... {2**32 - 1}: stamp a sweep with the time of its first shot"
        )
    np.savez(
        path,
        xyz=np.asarray(unit.points, np.float32),
        velocity=np.zeros((len(offset), 1), np.float32),
        reflectivity=np.asarray(unit.intensity, np.float32)[:, None],
        line_index=np.asarray(unit.ring, np.uint32)[:, None],
        time_offset_ns=offset.astype(np.uint32)[:, None],
        semantic_labels=np.array(_CLASSES, dtype=object)[classes][:, None],
        semantic_labels_idx=classes[:, None],
    )


def _classes(log: Drive, index: int, boxes: Boxes) -> np.ndarray:
    """(N,) int64, class of every point of a sweep, as an index of `_CLASSES`."""
    sweep = log.sweep(index)
    points = np.asarray(sweep.points)[:, :3]
    classes = np.full(len(points), _CLASSES.index(_BACKGROUND), np.int64)
    for category, size, pose in zip(boxes.names, boxes.size, boxes.pose):
        classes[rows_in_box(points, size, pose)] = _CLASSES.index(_class_of(category))
    if sweep.is_ground is not None:
        classes[np.asarray(sweep.is_ground)] = _CLASSES.index(_ON_GROUND)
    return classes


def _class_of(category: str) -> str:
    if category not in CLASS_OF:
        raise CFlowError(f"category {category!r} has no class in AevaScenes; give one of {', '.join(CLASS_OF)}")
    return CLASS_OF[category]


def _boxes(boxes: Boxes) -> list[dict[str, Any]]:
    """The boxes of a frame."""
    return [
        {
            "id": track,
            "class": _class_of(category),
            "class_idx": _CLASSES.index(_class_of(category)),
            "reference_frame": "VEHICLE",
            "dimensions": dict(zip(_XYZ, size.tolist())),
            "pose": _pose(pose),
        }
        for track, category, size, pose in zip(boxes.track_id, boxes.names, boxes.size, boxes.pose)
    ]


def _pose(T: np.ndarray) -> dict[str, Any]:
    rotation = to_quaternions(T[None, :3, :3])[0]
    return {"translation": dict(zip(_XYZ, T[:3, 3].tolist())), "rotation": dict(zip("wxyz", rotation.tolist()))}
