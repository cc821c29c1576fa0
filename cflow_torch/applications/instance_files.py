"""Write tracks as the instances of DriveStudio, `instances_info.json` and `frame_instances.json`, and its masks."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Iterable, Sequence

import numpy as np

from cflow_torch.applications.masks import DynamicShapes, check_cameras, write_mask
from cflow_torch.applications.track_table import Table, poses_of
from cflow_torch.data.camera import Camera
from cflow_torch.data.json_file import write_json
from cflow_torch.data.log import Log, TimedLog
from cflow_torch.data.paths import PathLike, as_path
from cflow_torch.transforms import upright_poses
from cflow_torch.types import CENTRE, SIZE, FlowResult, vectors

INSTANCES_FILE = "instances_info.json"
FRAMES_FILE = "frame_instances.json"
CLASSES_OF_READER = {
    "av2": ("REGULAR_VEHICLE", "BICYCLIST"),
    "kitti": ("Car", "Cyclist"),
    "nuscenes": ("vehicle.car", "vehicle.bicycle"),
    "pandaset": ("Car", "Bicycle"),
    "waymo": ("Vehicle", "Cyclist"),
}
"""Data set -> classes of rigid and of deformable objects in DriveStudio, whose loaders know only those of their set."""
CLASSES = CLASSES_OF_READER["kitti"]
"""Classes for logs of other data sets."""
CAMERAS_OF_READER = {
    "av2": (
        "ring_front_center",
        "ring_front_left",
        "ring_front_right",
        "ring_side_left",
        "ring_side_right",
        "ring_rear_left",
        "ring_rear_right",
    ),
    "kitti": ("image_02", "image_03"),
    "nuscenes": ("CAM_FRONT", "CAM_FRONT_LEFT", "CAM_FRONT_RIGHT", "CAM_BACK_LEFT", "CAM_BACK_RIGHT", "CAM_BACK"),
    "pandaset": (
        "front_camera",
        "front_left_camera",
        "front_right_camera",
        "left_camera",
        "right_camera",
        "back_camera",
    ),
}
"""Data set -> names of its cameras in our logs, in the order of DriveStudio's numbers 0, 1, 2, ..."""
_RIGID = ("car", "truck")  # classes of tracks
_DEFORMABLE = ("pedestrian", "cyclist")
_PER_KEY_FRAME = 5  # frames of 10 Hz, from one key frame of nuScenes to the next


def write_drivestudio(folder: PathLike, table: Table, log: Log, data_set: str = "") -> None:
    """Write `folder/instances_info.json` and `folder/frame_instances.json`.

    The first has, for each track, the frames in which it is seen, `T_world_box` (4, 4) and length, width, height in
    metres. The second has the tracks of each frame.

    Args:
        folder: created if it does not exist. DriveStudio reads `<scene>/instances`.
        table: tracks, see `track`.
        log: the drive. Frames are its sweeps, and boxes are in the world of its poses. In a scene of nuScenes, frames
            are its key frames and four times between each two of them, as DriveStudio prepares it at 10 Hz
            (`interpolate_N=4`). Each has the boxes of the sweep that is nearest in time.
        data_set: name of the reader of the log. By the class of an object, DriveStudio chooses the kind of its model.
            We take the classes of `CLASSES_OF_READER`, or `CLASSES` for other logs. We do not use a class of
            pedestrians, for which DriveStudio needs poses of their bodies.

    Convention: instances are numbered 0, 1, 2, ... without gaps, in the order of the ids of their tracks. `id` is the
        id of the track. A box has x along its length, y to the left and z up.
    """
    folder = as_path(folder)
    rigid_class, deformable_class = CLASSES_OF_READER.get(data_set, CLASSES)
    sweep_of_frame = _sweep_of_frames(log)
    frame, row = np.nonzero(sweep_of_frame[:, None] == table["sweep"])
    ids, instance = np.unique(table["id"][row], return_inverse=True)
    boxes = upright_poses(vectors(table, ("heading", *CENTRE)))
    sizes = vectors(table, SIZE)
    infos: dict[str, Any] = {}
    for number, track_id in enumerate(ids.tolist()):
        is_here = instance == number
        rows = row[is_here]
        infos[str(number)] = {
            "id": str(track_id),
            "class_name": deformable_class if table["class"][rows[0]] in _DEFORMABLE else rigid_class,
            "frame_annotations": {
                "frame_idx": frame[is_here].tolist(),
                "obj_to_world": boxes[rows].tolist(),
                "box_size": sizes[rows].tolist(),
            },
        }
    frames = {str(number): instance[frame == number].tolist() for number in range(len(sweep_of_frame))}
    write_json(folder / FRAMES_FILE, frames)
    write_json(folder / INSTANCES_FILE, infos)


def write_drivestudio_masks(
    folder: Path,
    log: Log,
    results: Iterable[tuple[int, FlowResult]],
    table: Table,
    cameras: Sequence[str] | None = None,
) -> None:
    """Write `folder/KIND/FRAME_CAMERA.png`, as DriveStudio's loader reads them from `<scene>/dynamic_masks`.

    The kinds are "all", which has the moving points and all boxes that `write_masks` draws, "human" with the boxes of
    pedestrians and cyclists, and "vehicle" with those of cars and trucks.

    Args:
        folder: created if it does not exist.
        log: a log whose reader knows the calibration of its cameras (`Log.cameras`).
        results: (index, flow of sweep `index` to `index + 1`).
        table: tracks of the log, see `track`.
        cameras: names of the cameras 0, 1, 2, ...; the log's other cameras have no masks. None = all, in the order of
            the log.

    Convention: frames are those of `write_drivestudio`. The loader needs a file for each of them. Where a sweep has no
        flow, such as the last one, we move the points and boxes of the sweep before to its time.
    """
    log = TimedLog(log)
    cameras = [camera.name for camera in log.cameras(0)] if cameras is None else cameras
    seconds = log.sweep_times()
    shapes = {index: DynamicShapes.of(log, index, result, table) for index, result in results}
    if not shapes:
        return
    for frame, sweep in enumerate(_sweep_of_frames(log).tolist()):
        source = max((index for index in shapes if index <= sweep), default=min(shapes))
        kinds = {
            "all": shapes[source],
            "human": shapes[source].boxes(_DEFORMABLE),
            "vehicle": shapes[source].boxes(_RIGID),
        }
        for camera in _cameras_at(log, sweep, source, seconds[sweep] - seconds[source]):
            if camera.name in cameras:
                name = f"{frame:03d}_{cameras.index(camera.name)}.png"
                for kind, drawn in kinds.items():
                    write_mask(folder / kind / name, drawn.draw(camera))


def _cameras_at(log: Log, sweep: int, source: int, later: float) -> list[Camera]:
    """Return the cameras of a sweep for the points of another one, the source, from which it is `later` seconds."""
    seen = log.cameras(sweep)
    check_cameras(log, seen)
    T_world_sweep, T_world_source = poses_of(log, (sweep, source))
    T_sweep_source = np.linalg.inv(T_world_sweep) @ T_world_source
    return [
        camera._replace(T_camera_ego=camera.T_camera_ego @ T_sweep_source, seconds=camera.seconds + later)
        for camera in seen
    ]


def _sweep_of_frames(log: Log) -> np.ndarray:
    """Return the sweep of each frame of DriveStudio, (F,) int64."""
    is_key_frame = np.array([token is not None for token in log.sample_tokens])
    if is_key_frame.all():
        return np.arange(len(is_key_frame))
    times = np.array(log.timestamps)
    key_times = times[is_key_frame]
    position = np.arange(_PER_KEY_FRAME * (len(key_times) - 1) + 1) / _PER_KEY_FRAME  # in key frames
    frame_times = np.interp(position, np.arange(len(key_times)), key_times)
    return np.abs(times - frame_times[:, None]).argmin(axis=1)
