"""Write a recording in the layout of MAN TruckScenes: JSON tables, and PCD sweeps with a time for every point."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from cflow_torch.data.arrays.cloud_file import write_cloud
from cflow_torch.data.atomic import new_folder
from cflow_torch.simulator.drive import Drive
from cflow_torch.simulator.recording import UnitReturns
from writers.nuscenes import NUSCENES_NAMES, SceneWriter, write_tables

_VERSION, _KEY_FRAME_INTERVAL = "v1.2-mini", 0.5  # seconds
# The devkit also requires these tables, which nuScenes does not have. A simulated truck has no data for them.
_EMPTY = ("ego_motion_cabin", "ego_motion_chassis", "weather_annotation")
TRUCKSCENES_NAMES: dict[str, str] = {
    **NUSCENES_NAMES,
    "SIGN": "static_object.traffic_sign",
    "STOP_SIGN": "static_object.traffic_sign",
}
"""Argoverse 2 category -> the nearest category of TruckScenes."""


def write_truckscenes(recording: Drive, root: str | Path) -> Path:
    """Write `recording` to `root/<log_id>`, a data root of TruckScenes with one scene of that name.

    Args:
        recording: the recording. If no LiDAR is called LIDAR_LEFT, the first one gets this name.
        root: folder, made if it does not exist.

    Returns:
        The data root.

    Convention:
        - The official devkit can load all 14 tables. Those of cabin motion, chassis motion and weather are empty.
        - Fields of a sweep: x, y, z, intensity float32; timestamp uint64, microseconds of each shot since 1970.
        - Points are in the frame of their LiDAR, in the order of the recording, without motion compensation.
        - The format has no ground mask and no flow.

    Raises:
        CFlowError: the scene exists already, the log_id cannot be used as a folder name, a category has no counterpart,
            the LiDARs change from sweep to sweep, or time stamps do not increase by a microsecond or more.
    """

    def write_points(file: Path, unit: UnitReturns, stamp_ns: int) -> None:
        times = ((int(stamp_ns) + np.asarray(unit.offset_ns, dtype=np.int64)) // 1000).astype(np.uint64)
        points = np.asarray(unit.points, dtype=np.float32)
        intensity = unit.intensity.astype(np.float32)
        write_cloud(file, points, {"intensity": intensity, "timestamp": times})

    with new_folder(root, recording.log_id) as folder:
        scene = SceneWriter(recording, folder, "LIDAR_LEFT", TRUCKSCENES_NAMES)
        tables = scene.write("{channel}_{stamp}.pcd", write_points, _KEY_FRAME_INTERVAL)
        write_tables(folder / _VERSION, {**tables, **{name: [] for name in _EMPTY}})
    return Path(root) / recording.log_id
