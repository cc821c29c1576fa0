"""Writes a log in the on-disk layout of Argoverse 2, so that every tool for that data set can read it."""

from __future__ import annotations

import json
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Callable, Mapping, Protocol, Sequence, Tuple, Union

import numpy as np
import pyarrow as pa
from pyarrow import feather

from cflow_torch.data.atomic import atomic_folder
from cflow_torch.data.log import Log
from cflow_torch.data.names import safe_name
from cflow_torch.types import CFlowError

CITY = "SYN"  # stands where Argoverse 2 has the code of the city
_DYNAMIC = 0.05  # metres per sweep from which a point counts as dynamic in Argoverse 2


@dataclass(frozen=True)
class Boxes:
    """Annotation boxes of one sweep.

    Args:
        track_id: (M,) UUIDs, the same in every sweep.
        category: (M,) Argoverse 2 names.
        size: (M, 3) float64 length, width, height, metres.
        pose: (M, 4, 4) float64 `T_ego_box`, origin in the middle of the box.
        num_points: (M,) int64 LiDAR points on the object.
    """

    track_id: Tuple[str, ...]
    category: Tuple[str, ...]
    size: np.ndarray
    pose: np.ndarray
    num_points: np.ndarray


@dataclass(frozen=True)
class Channels:
    """What a LiDAR tells about each of N points besides where it is.

    Args:
        intensity: (N,) uint8.
        laser_number: (N,) uint8.
        offset_ns: (N,) int32, time of the shot after the sweep's time stamp.
    """

    intensity: np.ndarray
    laser_number: np.ndarray
    offset_ns: np.ndarray


@dataclass(frozen=True)
class GroundRaster:
    """Ground height on a grid.

    Args:
        height: (H, W) world z in metres at the middle of each cell, row from y, column from x; NaN = unknown.
        origin: world x, y of the outer corner of cell (0, 0), metres.
        step: side of a cell, metres.
    """

    height: np.ndarray
    origin: Tuple[float, float]
    step: float


class AnnotatedLog(Log, Protocol):
    """A log that knows all that Argoverse 2 stores."""

    @property
    def calibration(self) -> Mapping[str, np.ndarray]:
        """Sensor name -> (4, 4) float64 `T_ego_sensor`."""

    def channels(self, index: int) -> Channels:
        """Of every point of sweep `index`."""

    def boxes(self, index: int) -> Boxes:
        """Of sweep `index`."""

    def ground_raster(self) -> GroundRaster:
        """Of the whole log."""


def write_av2_log(log: AnnotatedLog, root: Union[str, Path], overwrite: bool = False) -> Path:
    """Writes `log` to `root/<log_id>` in Argoverse 2's layout.

    All files are written to a temporary folder beside it, flushed to disk, and appear under their name at once.

    Args:
        log: what to write.
        root: folder of the split, made if absent.
        overwrite: replace a log of that name.

    Returns:
        The log's folder.

    Convention:
        - Points are rounded to float16, as in Argoverse 2: steps of 8 mm at 8-16 m, 31 mm at 32-64 m.
        - Beyond Argoverse 2: `flow_labels/<ns>.feather` per pair, rows in the order of the points of sweep t, columns
          of Argoverse 2's flow labels (total flow, axes of ego1) and `is_valid`.
        - `is_ground_0` is the log's own ground mask. The raster holds the true height; read with Argoverse 2's rule
          (|z - h| <= 0.3 m or below), the lowest 0.3 m of every object is ground as well.

    Raises:
        CFlowError: the log exists, or it lacks something that the layout needs.
    """
    missing = [n for n in ("calibration", "channels", "boxes", "ground_raster") if not hasattr(log, n)]
    if missing:
        raise CFlowError(
            f"log {log.log_id} has no {', '.join(missing)}, which the Argoverse 2 layout needs; only logs with all "
            "members of AnnotatedLog can be written"
        )
    folder = Path(root) / safe_name(log.log_id, "log_id")
    if folder.exists() and not overwrite:
        raise CFlowError(f"{folder} exists already; pass overwrite=True to replace it, or choose another root")
    with atomic_folder(folder) as new:
        _write_log(log, new)
    return folder


def _write_log(log: AnnotatedLog, folder: Path) -> None:
    poses, annotations = [], []
    for index, stamp in enumerate(log.timestamps):
        sweep, channels, labels = log.sweep(index), log.channels(index), log.labels(index)
        if sweep.pose is None:
            raise CFlowError(
                f"sweep {index} of log {log.log_id} has no pose; Argoverse 2 needs T_world_ego of every sweep"
            )
        poses.append(np.asarray(sweep.pose, np.float64))
        annotations.append(_annotations(stamp, log.boxes(index)))
        x, y, z = np.asarray(sweep.points)[:, :3].T.astype(np.float16)
        lidar = {"x": x, "y": y, "z": z}
        lidar.update({name: getattr(channels, name) for name in ("intensity", "laser_number", "offset_ns")})
        _write_feather(folder / "sensors" / "lidar" / f"{stamp}.feather", lidar)
        if labels is not None:
            T_ego1_ego0 = np.linalg.inv(np.asarray(log.sweep(index + 1).pose)) @ poses[-1]
            points = np.asarray(sweep.points, np.float64)[:, :3]
            residual = points + labels.flow - points @ T_ego1_ego0[:3, :3].T - T_ego1_ego0[:3, 3]
            is_ground = np.zeros(len(points), bool) if sweep.is_ground is None else np.asarray(sweep.is_ground)
            flow = {f"flow_t{axis}_m": labels.flow[:, k].astype(np.float32) for k, axis in enumerate("xyz")}
            flow["classes"] = labels.category
            flow["dynamic"] = np.linalg.norm(residual, axis=1) >= _DYNAMIC
            flow["is_ground_0"] = is_ground
            flow["is_valid"] = labels.is_valid
            _write_feather(folder / "flow_labels" / f"{stamp}.feather", flow)

    _write_feather(
        folder / "city_SE3_egovehicle.feather",
        {"timestamp_ns": np.asarray(log.timestamps, np.int64), **_pose_columns(np.stack(poses))},
    )
    _write_feather(
        folder / "calibration" / "egovehicle_SE3_sensor.feather",
        {"sensor_name": list(log.calibration), **_pose_columns(np.stack(list(log.calibration.values())))},
    )
    columns = {name: np.concatenate([part[name] for part in annotations]) for name in annotations[0]}
    _write_feather(folder / "annotations.feather", columns)
    _write_map(folder / "map", log.log_id, log.ground_raster())


def _annotations(stamp: int, boxes: Boxes) -> Mapping[str, np.ndarray]:
    return {
        "timestamp_ns": np.full(len(boxes.track_id), stamp, np.int64),
        "track_uuid": np.array(boxes.track_id, dtype=object),
        "category": np.array(boxes.category, dtype=object),
        **{name: boxes.size[:, k] for k, name in enumerate(("length_m", "width_m", "height_m"))},
        **_pose_columns(boxes.pose),
        "num_interior_pts": boxes.num_points.astype(np.int64),
    }


def _write_map(folder: Path, log_id: str, raster: GroundRaster) -> None:
    """The ground raster, how to index it, and a vector map with nothing but the raster's outline as drivable area."""
    (x0, y0), step = raster.origin, raster.step
    rows, columns = raster.height.shape
    _write(
        folder / f"{log_id}_ground_height_surface____{CITY}.npy",
        lambda file: np.save(file, raster.height.astype(np.float16)),
    )
    # Pixel = s (R city + t), so t is in metres.
    sim2 = {"R": [1.0, 0.0, 0.0, 1.0], "t": [-x0, -y0], "s": 1.0 / step}
    _write(folder / f"{log_id}___img_Sim2_city.json", lambda file: file.write(json.dumps(sim2).encode()))
    x1, y1 = x0 + columns * step, y0 + rows * step
    outline = [{"x": x, "y": y, "z": 0.0} for x, y in ((x0, y0), (x1, y0), (x1, y1), (x0, y1))]
    archive = {
        "pedestrian_crossings": {},
        "lane_segments": {},
        "drivable_areas": {"1": {"area_boundary": outline, "id": 1}},
    }
    _write(
        folder / f"log_map_archive_{log_id}____{CITY}_city_00000.json",
        lambda file: file.write(json.dumps(archive).encode()),
    )


def _pose_columns(poses: np.ndarray) -> Mapping[str, np.ndarray]:
    """Columns qw ... tz_m of (M, 4, 4) rigid transforms."""
    names = ("qw", "qx", "qy", "qz", "tx_m", "ty_m", "tz_m")
    values = np.concatenate([quaternions(poses[:, :3, :3]), poses[:, :3, 3]], axis=1)
    return {name: np.ascontiguousarray(values[:, k]) for k, name in enumerate(names)}


def quaternions(rotations: np.ndarray) -> np.ndarray:
    """Unit quaternions (M, 4) float64, scalar first, not negative, of rotation matrices (M, 3, 3)."""
    m = rotations.reshape(-1, 9).T
    xx, xy, xz, yx, yy, yz, zx, zy, zz = m
    # Four times (w, x, y, z) times w, x, y and z; the row with the largest diagonal has no cancellation.
    products = np.array(
        [
            [1 + xx + yy + zz, zy - yz, xz - zx, yx - xy],
            [zy - yz, 1 + xx - yy - zz, yx + xy, xz + zx],
            [xz - zx, yx + xy, 1 - xx + yy - zz, zy + yz],
            [yx - xy, xz + zx, zy + yz, 1 - xx - yy + zz],
        ]
    ).transpose(2, 0, 1)
    best = np.diagonal(products, axis1=1, axis2=2).argmax(1)
    q = products[np.arange(len(best)), best]
    q = q / np.linalg.norm(q, axis=1, keepdims=True)
    return np.where(q[:, :1] < 0, -q, q)


def _write_feather(path: Path, columns: Mapping[str, Union[np.ndarray, Sequence[str]]]) -> None:
    table = pa.table({name: pa.array(values) for name, values in columns.items()})
    _write(path, lambda file: feather.write_feather(table, file))


def _write(path: Path, write: Callable[[Any], Any]) -> None:
    """Lets `write` fill the file and waits until it is on disk."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with open(path, "wb") as file:
        write(file)
        file.flush()
        os.fsync(file.fileno())
