"""The real Argoverse 2 log as OpenSceneFlow's own extraction stores it: its frames, its rounding, its truth.

The project's writer stores the same layout, but the truth that a log brings. This file makes the truth that the golden
rows "on its own h5" were measured with; it differs from the official truth in 804 of the pair's 99,229 points.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, Dict, Tuple

import numpy as np
import pyarrow.feather as feather
from scipy.spatial.transform import Rotation

from cflow_torch.data.av2 import AV2Log
from cflow_torch.data.boxes import points_in_box
from cflow_torch.data.categories import CATEGORY_INDEX

# Metres (see `growth`): a box whose points move by more than this is made larger.
GROWS_FROM = 0.04
MARGIN = 0.2
LARGEST_STRETCH = 2.0
MASK_BOX = 50.0  # metres: half side of the official mask, in the ego frame

Box = Tuple[int, np.ndarray, np.ndarray]  # category, (3,) size, (4, 4) T_ego_box


def write_own_scene(log_folder: Path, file: Path) -> None:
    """Write the log as `extract_av2.py` does, with the official evaluation mask.

    Points in the frame of up_lidar; pose, ego_motion and flow of the ego frame, not turned; everything float32.
    """
    import h5py

    log = AV2Log(log_folder)
    inverse = np.linalg.inv(up_lidar(log_folder))
    with h5py.File(file, "w") as scene:
        for index, stamp in enumerate(log.timestamps):
            sweep = log.sweep(index)
            points, pose = np.asarray(sweep.points, np.float64), np.asarray(sweep.pose)
            group = scene.create_group(str(stamp))
            group["lidar"] = moved(inverse, points).astype(np.float32)
            group["ground_mask"] = sweep.is_ground
            group["pose"] = pose.astype(np.float32)
            if index == len(log.timestamps) - 1:
                continue
            T_ego1_ego0 = np.linalg.inv(log.sweep(index + 1).pose) @ pose
            rounded = T_ego1_ego0.astype(np.float32).astype(np.float64)
            boxes = [read_boxes(log_folder, stamp) for stamp in log.timestamps[index : index + 2]]
            flow, category, is_valid = own_labels(points, boxes[0], boxes[1], rounded)
            in_reach = (np.abs(points[:, :2]) <= MASK_BOX).all(axis=1)
            group["ego_motion"] = rounded.astype(np.float32)
            group["flow"], group["flow_category_indices"], group["flow_is_valid"] = flow, category, is_valid
            group["eval_mask"] = (~np.asarray(sweep.is_ground) & in_reach)[:, None]


def own_labels(
    points: np.ndarray, boxes0: Dict[str, Box], boxes1: Dict[str, Box], T_ego1_ego0: np.ndarray
) -> Tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Total flow (N, 3) float32, category (N,) uint8, is_valid (N,) bool, of points (N, 3) float64 in the ego frame.

    Boxes are taken as annotated; one whose points seem to move is made larger, the more the faster. A point in several
    boxes has the flow of the last one. A box without successor leaves its points as background that is not valid.
    """
    flow = (moved(T_ego1_ego0, points) - points).astype(np.float32)
    category = np.zeros(len(points), np.uint8)
    is_valid = np.ones(len(points), bool)
    for track, (kind, size, pose) in boxes0.items():
        inside = points_in_box(points, size, pose)
        if track not in boxes1:
            is_valid[inside] = False
            continue
        motion = boxes1[track][2] @ np.linalg.inv(pose)
        inside = points_in_box(points, size + growth(points[inside], motion, T_ego1_ego0), pose)
        flow[inside] = (moved(motion, points[inside]) - points[inside]).astype(np.float32)
        category[inside] = kind
    return flow, category, is_valid


def growth(inside: np.ndarray, motion: np.ndarray, T_ego1_ego0: np.ndarray) -> np.ndarray:
    """(3,) metres added to a box. The harness's measure of motion grows with the root of the number of points: it takes
    the length of each column of the residual, not of each row, and the mean of the three."""
    residual = moved(np.linalg.inv(T_ego1_ego0) @ motion, inside) - inside
    measure = float(np.linalg.norm(residual, axis=0).mean())
    if measure <= GROWS_FROM:
        return np.zeros(3)
    return MARGIN + np.array([min(measure / 2, LARGEST_STRETCH), 0.0, 0.0])


def read_boxes(log_folder: Path, timestamp: int) -> Dict[str, Box]:
    """Track -> box of one sweep, in the order of the file."""
    rows = feather.read_table(str(log_folder / "annotations.feather")).to_pylist()
    return {
        row["track_uuid"]: (
            CATEGORY_INDEX[row["category"]],
            np.array([row[f"{name}_m"] for name in ("length", "width", "height")]),
            pose_of(row),
        )
        for row in rows
        if row["timestamp_ns"] == timestamp
    }


def up_lidar(log_folder: Path) -> np.ndarray:
    """(4, 4) float64 T_ego_lidar of the upper LiDAR."""
    rows = feather.read_table(str(log_folder / "calibration" / "egovehicle_SE3_sensor.feather")).to_pylist()
    return next(pose_of(row) for row in rows if row["sensor_name"] == "up_lidar")


def pose_of(row: Dict[str, Any]) -> np.ndarray:
    """(4, 4) float64 of a row's quaternion and translation."""
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_quat([row[name] for name in ("qx", "qy", "qz", "qw")]).as_matrix()
    pose[:3, 3] = [row[name] for name in ("tx_m", "ty_m", "tz_m")]
    return pose


def moved(T: np.ndarray, points: np.ndarray) -> np.ndarray:
    """(N, 3) float64 points in another frame."""
    return points @ T[:3, :3].T + T[:3, 3]
