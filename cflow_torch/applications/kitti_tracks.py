"""Write tracks as text of KITTI's tracking benchmark."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from cflow_torch.applications.track_table import KITTI_NAMES, Table, box_corners, boxes_in_sweeps, score_of
from cflow_torch.data.atomic import write_text
from cflow_torch.data.log import Log
from cflow_torch.data.paths import PathLike, as_path
from cflow_torch.transforms import transform_points
from cflow_torch.types import SIZE, vectors

KITTI_FILE = "kitti.txt"
_AHEAD = np.array([[0.0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]])
_ANNOTATED_CAMERA = "image_02"


class _Boxes(NamedTuple):
    """R boxes as the camera sees them."""

    position: np.ndarray  # (R, 3) metres, middle of the lower face, frame of the camera
    turn: np.ndarray  # (R,) radians, rotation_y
    rectangle: np.ndarray  # (R, 4) pixels: left, top, right, bottom; -1 = unknown
    is_seen: np.ndarray  # (R,) bool


def write_kitti(folder: PathLike, table: Table, log: Log, data_set: str = "") -> None:
    """Write tracks as `folder/kitti.txt`, text of KITTI's tracking benchmark: a line of 18 columns per row.

    Frames are numbered by `Log.frame_number`, ids from 0; unknown columns are -1.

    Args:
        folder: created if it does not exist.
        table: tracks, see `track`.
        log: the drive. If it is a drive of KITTI with its calibration, boxes are in the frame of KITTI's labels, the
            rectified camera 0, have rectangles in the image of camera 2, and are left out where it does not see them.
        data_set: ignored.

    Convention: KITTI's camera has x to the right, y down, z ahead. Without calibration, it is at the origin of the
        ego frame of the sweep and looks to +x. The position is the middle of the lower face of the box.

    Source: development kit of the KITTI tracking benchmark (2012).
    """
    size = vectors(table, SIZE)
    boxes = _seen_by_camera(table, log, size)
    alpha = _wrapped(boxes.turn - np.arctan2(boxes.position[:, 0], boxes.position[:, 2]))
    columns = (alpha, boxes.rectangle, size[:, ::-1], boxes.position, boxes.turn, score_of(table))
    numbers = np.column_stack(columns)
    lines = []
    for row in np.flatnonzero(boxes.is_seen).tolist():
        kind = KITTI_NAMES[str(table["class"][row])]
        values = " ".join(f"{value:.6f}" for value in numbers[row])
        frame = log.frame_number(int(table["sweep"][row]))
        lines.append(f"{frame} {table['id'][row]} {kind} -1 -1 {values}\n")
    write_text(as_path(folder) / KITTI_FILE, "".join(lines))


def _seen_by_camera(table: Table, log: Log, size: np.ndarray) -> _Boxes:
    """Convert boxes of (R, 3) size to the frame of the camera."""
    centre, heading = boxes_in_sweeps(table, log)
    T_camera_ego = _AHEAD if log.T_camera0_lidar is None else log.T_camera0_lidar
    foot = centre - size * (0, 0, 0.5)
    ahead = np.stack([np.cos(heading), np.sin(heading), np.zeros(len(heading))], 1) @ T_camera_ego[:3, :3].T
    turn = np.arctan2(-ahead[:, 2], ahead[:, 0])
    rectangle = np.full((len(centre), 4), -1.0)
    is_seen: Any = np.ones(len(centre), bool)
    if log.T_camera0_lidar is not None:
        rectangle = _rectangles(log, box_corners(centre, heading, size))
        is_seen = np.all(rectangle[:, 2:] > rectangle[:, :2], axis=1)
    return _Boxes(transform_points(foot, T_camera_ego), turn, rectangle, is_seen)


def _rectangles(log: Log, corners: np.ndarray) -> np.ndarray:
    """Return the rectangles around boxes in the image, (R, 4) pixels; without area for a box outside of it.

    The corners are (R, 8, 3) metres. What is behind the camera is cut off.
    """
    (camera,) = (each for each in log.cameras(0) if each.name == _ANNOTATED_CAMERA)
    rectangles = np.zeros((len(corners), 4))
    for rectangle, box in zip(rectangles, corners):
        faces = camera.project_box(box)
        if faces:
            pixels = np.concatenate(faces).clip(0, np.array(camera.size) - 1.0)
            rectangle[:] = *pixels.min(axis=0), *pixels.max(axis=0)
    return rectangles


def _wrapped(angle: np.ndarray) -> np.ndarray:
    """Angles in -pi ... pi."""
    return np.arctan2(np.sin(angle), np.cos(angle))
