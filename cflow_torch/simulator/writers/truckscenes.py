"""Writes a recording in the on-disk layout of MAN TruckScenes: JSON tables and PCD sweeps with a time per point."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from cflow_torch.data.arrays.pcd import write_pcd
from cflow_torch.simulator.recording import Recording, UnitReturns
from cflow_torch.simulator.writers.av2 import new_folder
from cflow_torch.simulator.writers.nuscenes import NUSCENES_NAMES, SceneWriter, write_tables

# Tables that the devkit wants besides those of nuScenes; a simulated truck has nothing to put there.
_VERSION, _KEY_FRAME_INTERVAL = "v1.2-mini", 0.5  # seconds
_EMPTY = ("ego_motion_cabin", "ego_motion_chassis", "weather_annotation")
TRUCKSCENES_NAMES: dict[str, str] = {
    **NUSCENES_NAMES,
    "SIGN": "static_object.traffic_sign",
    "STOP_SIGN": "static_object.traffic_sign",
}
"""Argoverse 2 name of a box -> the nearest category of TruckScenes."""


def write_truckscenes(recording: Recording, root: str | Path, overwrite: bool = False) -> Path:
    """Writes `recording` to `root/<log_id>`, a data root of TruckScenes with one scene of that name.

    Args:
        recording: what to write. If none of its LiDARs is called LIDAR_LEFT, the first one is in the file.
        root: folder, made if absent.
        overwrite: replace a scene of that name.

    Returns:
        The data root.

    Convention:
        - All 14 tables, complete enough for the official devkit; cabin and chassis motion and weather are empty.
        - Fields of a sweep: x, y, z, intensity float32, timestamp uint64, microseconds since 1970 of each shot (cut).
        - Points stay in the frame of their LiDAR, in the order of the recording; nothing is compensated here.
        - Ground mask and flow have no place in the format.

    Raises:
        CFlowError: as `write_nuscenes`.
    """

    def write_points(file: Path, unit: UnitReturns, stamp_ns: int) -> None:
        x, y, z = np.asarray(unit.points, dtype=np.float32).T
        times = ((int(stamp_ns) + np.asarray(unit.offset_ns, dtype=np.int64)) // 1000).astype(np.uint64)
        fields = {"x": x, "y": y, "z": z, "intensity": unit.intensity.astype(np.float32), "timestamp": times}
        write_pcd(file, fields)

    with new_folder(root, recording.log_id, overwrite) as folder:
        scene = SceneWriter(recording, folder, "LIDAR_LEFT", TRUCKSCENES_NAMES)
        tables = scene.write("{channel}_{stamp}.pcd", write_points, _KEY_FRAME_INTERVAL)
        write_tables(folder / _VERSION, {**tables, **{name: [] for name in _EMPTY}})
    return Path(root) / recording.log_id
