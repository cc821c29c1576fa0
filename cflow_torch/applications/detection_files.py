"""Write tracks as detections that other tools read: results of nuScenes' tasks, and OpenPCDet's table of boxes."""

from __future__ import annotations

import pickle
from typing import Any

import numpy as np

from cflow_torch.applications.track_table import KITTI_NAMES, Table, boxes_in_sweeps, score_of
from cflow_torch.data.atomic import atomic_file
from cflow_torch.data.json_file import write_json
from cflow_torch.data.log import Log
from cflow_torch.data.paths import PathLike, as_path
from cflow_torch.types import CENTRE, SIZE, vectors

DETECTIONS_FILE = "nuscenes_detection.json"
TRACKING_FILE = "nuscenes_tracking.json"
OPENPCDET_FILE = "result.pkl"  # the name of OpenPCDet
NUSCENES_NAMES = {"pedestrian": "pedestrian", "cyclist": "bicycle", "car": "car", "truck": "truck"}
"""Class of a track -> class of nuScenes' tasks."""
_ATTRIBUTES = {  # class in nuScenes -> attribute of an object that moves, and of one that stands
    "pedestrian": ("pedestrian.moving", "pedestrian.standing"),
    "bicycle": ("cycle.with_rider", "cycle.with_rider"),
    "car": ("vehicle.moving", "vehicle.stopped"),
    "truck": ("vehicle.moving", "vehicle.stopped"),
}
_MOST_BOXES = 500  # of a sample; the evaluators reject files with more
_MODALITIES = {"use_camera": False, "use_lidar": True, "use_radar": False, "use_map": False, "use_external": False}


def write_nuscenes(folder: PathLike, table: Table, log: Log, data_set: str = "") -> None:
    """Write `folder/nuscenes_detection.json` and `folder/nuscenes_tracking.json`, results of nuScenes' two tasks.

    Args:
        folder: created if it does not exist.
        table: tracks, see `track`.
        log: the drive. The samples are the key frames of a scene of nuScenes, and all sweeps of any other log, which
            are then called `<log id>_<time stamp>`. A sample without tracks has an empty list.
        data_set: ignored.

    Convention: boxes are in the world of the log's poses. Sizes are width, length, height. The score is the mean
        confidence of the flow over the track, 1 where the method has none. Of more than 500 boxes of a sample, we keep
        those with the highest scores.

    Source: results formats of the detection and the tracking task of nuScenes.
    """
    folder = as_path(folder)
    tokens = log.sample_tokens
    score = score_of(table)
    detections: dict[str, list[Any]] = {token: [] for token in tokens if token is not None}
    trackings: dict[str, list[Any]] = {token: [] for token in tokens if token is not None}
    for row in np.argsort(-score, kind="stable").tolist():
        token = tokens[int(table["sweep"][row])]
        if token is None or len(detections[token]) == _MOST_BOXES:
            continue
        name = NUSCENES_NAMES[str(table["class"][row])]
        box = _nuscenes_box(table, row, token)
        attribute = _ATTRIBUTES[name][0 if table["is_moving"][row] else 1]
        detection = {"detection_name": name, "detection_score": score[row], "attribute_name": attribute}
        tracking = {"tracking_id": str(table["id"][row]), "tracking_name": name, "tracking_score": score[row]}
        detections[token].append({**box, **detection})
        trackings[token].append({**box, **tracking})
    write_json(folder / DETECTIONS_FILE, {"meta": _MODALITIES, "results": detections})
    write_json(folder / TRACKING_FILE, {"meta": _MODALITIES, "results": trackings})


def _nuscenes_box(table: Table, row: int, token: str) -> dict[str, Any]:
    half = table["heading"][row] / 2
    return {
        "sample_token": token,
        "translation": [float(table[name][row]) for name in CENTRE],
        "size": [float(table[name][row]) for name in ("width", "length", "height")],
        "rotation": [float(np.cos(half)), 0.0, 0.0, float(np.sin(half))],
        "velocity": [float(table[name][row]) for name in ("vx", "vy")],
    }


def write_openpcdet(folder: PathLike, table: Table, log: Log, data_set: str = "") -> None:
    """Write `folder/result.pkl`, a list with a dictionary per sweep of the log, as OpenPCDet writes its detections.

    Each has `frame_id`, the number of the sweep (`Log.frame_number`) as "000000"; `name` (K,), `score` (K,) and
    `boxes_lidar` (K, 7) float32 of the K tracks: centre, length, width and height in metres, and heading in radians, in
    the frame of the sweep's points; `pred_labels` (K,), 1 to 4 as in `KITTI_NAMES`; and `track_id` (K,). OpenPCDet's
    fields of the camera image are left out. The data set is ignored.
    """
    names = list(KITTI_NAMES)
    centre, heading = boxes_in_sweeps(table, log)
    box = np.concatenate([centre, vectors(table, SIZE), heading[:, None]], 1).astype(np.float32)
    score = score_of(table).astype(np.float32)
    label = np.array([1 + names.index(kind) for kind in table["class"].tolist()], np.int64)
    kitti_name = np.array([KITTI_NAMES[names[number - 1]] for number in label.tolist()], "<U10")
    frames = []
    for sweep in range(len(log.timestamps)):
        rows = np.flatnonzero(table["sweep"] == sweep)
        frames.append(
            {
                "frame_id": f"{log.frame_number(sweep):06d}",
                "name": kitti_name[rows],
                "score": score[rows],
                "boxes_lidar": box[rows],
                "pred_labels": label[rows],
                "track_id": table["id"][rows],
            }
        )
    # NumPy 2 names modules that NumPy 1, which OpenPCDet uses, does not have; both read the older names. In protocol 2,
    # names are plain text.
    content = pickle.dumps(frames, protocol=2).replace(b"cnumpy._core.", b"cnumpy.core.")
    with atomic_file(as_path(folder) / OPENPCDET_FILE) as file:
        file.write(content)
