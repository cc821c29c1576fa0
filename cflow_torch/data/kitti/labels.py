"""Labels of KITTI: tracklets of raw drives, boxes of the tracking set, classes of points of SemanticKITTI."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple, Sequence
from xml.etree import ElementTree

import numpy as np

from cflow_torch.data.boxes import Boxes, category_indices
from cflow_torch.data.categories import CATEGORY_INDEX
from cflow_torch.data.file_errors import file_errors
from cflow_torch.data.paths import read_bytes
from cflow_torch.transforms import as_matrix, rotations_about, upright_poses
from cflow_torch.types import CFlowError

CATEGORY_NAME = {
    "Car": "REGULAR_VEHICLE",
    "Cyclist": "BICYCLIST",
    "Misc": "NONE",
    "Pedestrian": "PEDESTRIAN",
    "Person": "PEDESTRIAN",
    "Person (sitting)": "PEDESTRIAN",
    "Person_sitting": "PEDESTRIAN",
    "Tram": "RAILED_VEHICLE",
    "Truck": "TRUCK",
    "Van": "REGULAR_VEHICLE",
}
"""Type of a box -> Argoverse 2 name. This map is ours."""

_CLASSES = {
    "BICYCLE": (11,),
    "BICYCLIST": (31, 253),
    "BUS": (13, 257),
    "LARGE_VEHICLE": (20, 259),
    "MOTORCYCLE": (15,),
    "MOTORCYCLIST": (32, 255),
    "PEDESTRIAN": (30, 254),
    "RAILED_VEHICLE": (16, 256),
    "REGULAR_VEHICLE": (10, 252),
    "TRUCK": (18, 258),
}
MOVING = tuple(range(251, 260))  # classes of moving points; 251 in labels that tell only static (9) and moving
GROUND = (40, 44, 48, 49, 60, 72)  # road, parking, sidewalk, other ground, lane marking, terrain
UNLABELLED = (0, 1)  # unlabelled, outlier
CATEGORY_OF_CLASS = np.zeros(1 << 16, np.uint8)  # Argoverse 2 index of each class, 0 = background
for _name, _classes in _CLASSES.items():
    CATEGORY_OF_CLASS[list(_classes)] = CATEGORY_INDEX[_name]
_OUT_OF_IMAGE = 2  # truncation of a tracklet's pose
# Axes of a box (x along its length, y left, z up) in the axes of an object in the camera's frame (x along its length, y
# down, z right of x).
_OBJECT_FROM_BOX = np.array([[1.0, 0, 0], [0, 0, -1], [0, -1, 0]])


class FrameBoxes(NamedTuple):
    """Boxes of one sweep in the frame of the LiDAR, and image regions without annotation, (K, 4) pixels."""

    boxes: Boxes
    ignored: np.ndarray


NO_BOXES = FrameBoxes(Boxes([], [], [], []), np.zeros((0, 4)))


def read_tracklets(file: Path) -> dict[int, FrameBoxes]:
    """Read tracklet_labels.xml: number of the frame -> boxes. The file states positions of the middle of the base."""
    rows: dict[int, list[Any]] = {}  # frame -> track, type, length width height, heading x y z
    content = read_bytes(file)
    with file_errors(file):
        if b"<!ENTITY" in content:
            raise CFlowError("it defines entities, which are not read; copy it again")
        root: Any = ElementTree.fromstring(content)
        for number, track in enumerate(root.find("tracklets").findall("item")):
            size = [float(track.findtext(key)) for key in "lwh"]
            first_frame = int(track.findtext("first_frame"))
            for step, pose in enumerate(track.find("poses").findall("item")):
                if int(pose.findtext("truncation", "0")) != _OUT_OF_IMAGE:
                    heading, x, y, z = (float(pose.findtext(key)) for key in ("rz", "tx", "ty", "tz"))
                    place = (heading, x, y, z + size[2] / 2)
                    rows.setdefault(first_frame + step, []).append(
                        (str(number), track.findtext("objectType"), size, place)
                    )
    return {frame: _upright(*zip(*of_frame)) for frame, of_frame in rows.items()}


def _upright(tracks: Sequence[str], kinds: Sequence[str], sizes: Any, places: Any) -> FrameBoxes:
    boxes = Boxes(tracks, category_indices(kinds, CATEGORY_NAME), sizes, upright_poses(places))
    return NO_BOXES._replace(boxes=boxes)


def read_tracking_labels(file: Path, T_lidar_camera: np.ndarray) -> dict[int, FrameBoxes]:
    """Read label_02/NNNN.txt: number of the frame -> boxes.

    Convention: boxes are in the rectified frame of camera 0 (x right, y down, z ahead), at the middle of their base,
        turned about y. `T_lidar_camera`, (4, 4), maps this frame to that of the LiDAR.
    """
    rows: dict[int, list[list[str]]] = {}
    with file_errors(file):
        for line in read_bytes(file).decode("utf-8").splitlines():
            words = line.split()
            if words:
                rows.setdefault(int(words[0]), []).append(words)
        return {frame: _camera_boxes(of_frame, T_lidar_camera) for frame, of_frame in rows.items()}


def _camera_boxes(rows: list[list[str]], T_lidar_camera: np.ndarray) -> FrameBoxes:
    numbers = np.array([words[6:17] for words in rows], np.float64)  # left top right bottom, h w l, x y z, rotation
    is_box = np.array([words[2] != "DontCare" for words in rows])
    kept = [words for words, keep in zip(rows, is_box) if keep]
    boxes = numbers[is_box]
    centres = boxes[:, 7:10] - boxes[:, 4:5] * (0, 0.5, 0)
    T_camera_box = as_matrix(rotations_about(1, boxes[:, 10]) @ _OBJECT_FROM_BOX, centres)
    return FrameBoxes(
        boxes=Boxes(
            [words[1] for words in kept],
            category_indices([words[2] for words in kept], CATEGORY_NAME),
            boxes[:, [6, 5, 4]],
            T_lidar_camera @ T_camera_box,
        ),
        ignored=numbers[~is_box, :4],
    )


def read_classes(file: Path, rows: int) -> tuple[np.ndarray, np.ndarray]:
    """Read a .label file of SemanticKITTI: the class and the instance of each point, (N,) uint16 each."""
    with file_errors(file):
        values = np.frombuffer(read_bytes(file), "<u4")
    if len(values) != rows:
        raise CFlowError(f"{file} has {len(values)} labels for {rows} points; copy it again")
    return (values & 0xFFFF).astype(np.uint16), (values >> 16).astype(np.uint16)
