"""Write a recording in the layout of Argoverse 2, so that all tools for this data set can read it."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Mapping, Sequence

import numpy as np
import pyarrow as pa
from pyarrow import feather

from cflow_torch.data.atomic import new_folder
from cflow_torch.data.av2 import GroundRaster
from cflow_torch.data.boxes import Boxes
from cflow_torch.data.log import FlowLabels
from cflow_torch.simulator.drive import Drive
from cflow_torch.transforms import to_quaternions
from cflow_torch.types import Sweep

CITY = "SYN"  # code of the city in file names; real logs have PIT, MIA, ...
_DYNAMIC = 0.05  # Argoverse 2 calls a point dynamic if its residual flow is at least this, metres per sweep


def write_av2_log(log: Drive, root: str | Path) -> Path:
    """Write `log` to `root/<log_id>` in Argoverse 2's layout.

    Args:
        log: the recording.
        root: folder of the split, made if it does not exist.

    Returns:
        The log's folder.

    Convention:
        - Points are rounded to float16, as in Argoverse 2: steps of 8 mm at 8-16 m, 31 mm at 32-64 m.
        - We add `flow_labels/<ns>.feather` for each pair: a row per point of sweep t, in its order, with the columns
          of Argoverse 2's flow labels (total flow, axes of the ego frame at t+1) and `is_valid`.
        - `is_ground_0` is the log's own ground mask. The raster has the true height h. By Argoverse 2's rule
          (z <= h + 0.3 m), the lowest 0.3 m of every object would be ground, too.

    Raises:
        CFlowError: the log exists already, or its name cannot be used as a folder name.
    """
    with new_folder(root, log.log_id) as folder:
        _write_log(log, folder)
    return Path(root) / log.log_id


def _write_log(log: Drive, folder: Path) -> None:
    poses = np.asarray(log.poses, np.float64)
    annotations = []
    for index, stamp in enumerate(log.timestamps):
        sweep = log.sweep(index)
        points = np.asarray(sweep.points)
        annotations.append(_annotations(stamp, log.boxes(index)))
        lidar = {**dict(zip("xyz", points[:, :3].T.astype(np.float16))), **log.channels(index)}
        _write_feather(folder / "sensors" / "lidar" / f"{stamp}.feather", lidar)
        labels = log.labels(index)
        if labels is not None:
            T_ego1_ego0 = np.linalg.inv(poses[index + 1]) @ poses[index]
            columns = _label_columns(sweep, labels, T_ego1_ego0)
            _write_feather(folder / "flow_labels" / f"{stamp}.feather", columns)

    _write_feather(
        folder / "city_SE3_egovehicle.feather",
        {"timestamp_ns": np.asarray(log.timestamps, np.int64), **_pose_columns(poses)},
    )
    _write_feather(
        folder / "calibration" / "egovehicle_SE3_sensor.feather",
        {"sensor_name": list(log.calibration), **_pose_columns(np.stack(list(log.calibration.values())))},
    )
    _write_feather(
        folder / "annotations.feather",
        {name: np.concatenate([table[name] for table in annotations]) for name in annotations[0]},
    )
    _write_map(folder / "map", log.log_id, log.ground_raster())


def _label_columns(sweep: Sweep, labels: FlowLabels, T_ego1_ego0: np.ndarray) -> Mapping[str, np.ndarray]:
    """Return the columns of the flow labels of a sweep."""
    points = np.asarray(sweep.points, np.float64)[:, :3]
    residual = points + labels.flow - points @ T_ego1_ego0[:3, :3].T - T_ego1_ego0[:3, 3]
    return {
        **{f"flow_t{axis}_m": labels.flow[:, k].astype(np.float32) for k, axis in enumerate("xyz")},
        "classes": labels.category,
        "dynamic": np.linalg.norm(residual, axis=1) >= _DYNAMIC,
        "is_ground_0": np.zeros(len(points), bool) if sweep.is_ground is None else np.asarray(sweep.is_ground),
        "is_valid": labels.is_valid,
    }


def _annotations(stamp: int, boxes: Boxes) -> Mapping[str, np.ndarray]:
    return {
        "timestamp_ns": np.full(len(boxes.track_id), stamp, np.int64),
        "track_uuid": np.array(boxes.track_id, dtype=object),
        "category": np.array(boxes.names, dtype=object),
        **{name: boxes.size[:, k] for k, name in enumerate(("length_m", "width_m", "height_m"))},
        **_pose_columns(boxes.pose),
        "num_interior_pts": boxes.num_points.astype(np.int64),
    }


def _write_map(folder: Path, log_id: str, raster: GroundRaster) -> None:
    """Write the ground raster, its transform, and a vector map with the raster's outline as drivable area."""
    folder.mkdir()
    np.save(folder / f"{log_id}_ground_height_surface____{CITY}.npy", raster.heights.astype(np.float16))
    sim2 = {"R": raster.rotation.ravel().tolist(), "t": raster.translation.tolist(), "s": raster.scale}
    (folder / f"{log_id}___img_Sim2_city.json").write_text(json.dumps(sim2))
    x0, y0 = -raster.translation
    rows, columns = raster.heights.shape
    x1, y1 = x0 + columns / raster.scale, y0 + rows / raster.scale
    outline = [{"x": x, "y": y, "z": 0.0} for x, y in ((x0, y0), (x1, y0), (x1, y1), (x0, y1))]
    archive = {
        "pedestrian_crossings": {},
        "lane_segments": {},
        "drivable_areas": {"1": {"area_boundary": outline, "id": 1}},
    }
    (folder / f"log_map_archive_{log_id}____{CITY}_city_00000.json").write_text(json.dumps(archive))


def _pose_columns(poses: np.ndarray) -> Mapping[str, np.ndarray]:
    """Columns qw ... tz_m of (M, 4, 4) rigid transforms."""
    names = ("qw", "qx", "qy", "qz", "tx_m", "ty_m", "tz_m")
    values = np.concatenate([to_quaternions(poses[:, :3, :3]), poses[:, :3, 3]], axis=1)
    return {name: np.ascontiguousarray(values[:, k]) for k, name in enumerate(names)}


def _write_feather(path: Path, columns: Mapping[str, np.ndarray | Sequence[str]]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    feather.write_feather(pa.table({name: pa.array(values) for name, values in columns.items()}), str(path))
