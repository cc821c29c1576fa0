"""Write a recording in the layout of the Waymo Open Dataset, version 2: five parquet files per segment."""

from __future__ import annotations

import os
import tempfile
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import Any, Sequence

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from cflow_torch.data.categories import META_CLASSES
from cflow_torch.data.paths import safe_name
from cflow_torch.data.waymo.range_image import LASERS, TOP, LaserCalibration
from cflow_torch.data.waymo.reader import (
    BOX,
    CALIBRATION,
    LASER,
    LIDAR,
    PIXEL_POSE,
    TIME,
    TRACK,
    VEHICLE_POSE,
)
from cflow_torch.simulator.drive import Drive
from cflow_torch.simulator.recording import UnitReturns
from cflow_torch.types import CFlowError
from writers.waymo_encoding import encode_images, poses_of_shots, true_poses_of_shots

BOX_TYPE: dict[str, int] = {
    **dict.fromkeys(META_CLASSES["CAR"] + META_CLASSES["OTHER_VEHICLES"] + ("MOTORCYCLE", "MOTORCYCLIST"), 1),
    **dict.fromkeys(META_CLASSES["PEDESTRIAN"], 2),
    **dict.fromkeys(("SIGN", "STOP_SIGN"), 3),
    **dict.fromkeys(("BICYCLE", "BICYCLIST", "WHEELED_DEVICE", "WHEELED_RIDER"), 4),
}
"""Argoverse 2 category -> Waymo's box type. Motorcycles are vehicles. Boxes of all other categories are left out."""
del BOX_TYPE["RAILED_VEHICLE"]

_XYZ = ("x", "y", "z")
# For each component, the columns that our reader needs, named as in the official classes.
_IMAGE, _SHAPE, _TRANSFORM = pa.list_(pa.float32()), pa.list_(pa.int32(), 3), pa.list_(pa.float64(), 16)
_SEGMENT = "key.segment_context_name"
_FRAME_KEYS: list[tuple[str, Any]] = [(_SEGMENT, pa.string()), (TIME, pa.int64())]
SCHEMAS: dict[str, pa.Schema] = {
    "lidar": pa.schema(
        [
            *_FRAME_KEYS,
            (LASER, pa.int8()),
            *((f"{LIDAR}{k}.{name}", kind) for k in (1, 2) for name, kind in (("values", _IMAGE), ("shape", _SHAPE))),
        ]
    ),
    "lidar_calibration": pa.schema(
        [
            (_SEGMENT, pa.string()),
            (LASER, pa.int8()),
            (f"{CALIBRATION}extrinsic.transform", _TRANSFORM),
            (f"{CALIBRATION}beam_inclination.min", pa.float64()),
            (f"{CALIBRATION}beam_inclination.max", pa.float64()),
            (f"{CALIBRATION}beam_inclination.values", pa.list_(pa.float64())),
        ]
    ),
    "lidar_pose": pa.schema(
        [*_FRAME_KEYS, (LASER, pa.int8()), (f"{PIXEL_POSE}.values", _IMAGE), (f"{PIXEL_POSE}.shape", _SHAPE)]
    ),
    "vehicle_pose": pa.schema([*_FRAME_KEYS, (VEHICLE_POSE, _TRANSFORM)]),
    "lidar_box": pa.schema(
        [
            *_FRAME_KEYS,
            (TRACK, pa.string()),
            *((f"{BOX}box.{name}.{axis}", pa.float64()) for name in ("center", "size") for axis in "xyz"),
            (f"{BOX}box.heading", pa.float64()),
            (f"{BOX}type", pa.int8()),
            (f"{BOX}num_lidar_points_in_box", pa.int64()),
        ]
    ),
}


def write_waymo_segment(log: Drive, root: str | Path) -> Path:
    """Write `log` to `root/<component>/<log_id>.parquet`, one row group per frame.

    Args:
        log: the recording. Units whose names are in `LASERS` keep them. If no name is, the units become TOP, FRONT,
            ... in their order.
        root: folder of the split, made if it does not exist.

    Returns:
        The file of the component `lidar`, for `WaymoLog`.

    Convention:
        - TOP: each pixel has the vehicle's pose at the time of its shot, interpolated between the poses of the sweeps.
          If this misplaces a point by more than 1 m, we use the true poses of `log.poses_at`, if there are any. We
          shift each pose so that its point is exact, except for the rounding of poses and ranges to float32: 5e-5 m
          up to 1 km from the world's origin.
        - Other lasers: the images are as if the vehicle stood still at the pose of the frame, and their pixels have no
          poses. Returns on the rays of their pixels keep float32 accuracy, 5e-6 m at 75 m. We move other returns onto
          the ray, by up to 5 mm.
        - Times are rounded to microseconds. Boxes keep their heading, but not roll and pitch.
        - There are no second returns, no elongation, no no-label zones and no speeds of boxes.

    Raises:
        CFlowError: the segment exists already, its name cannot be used for a file, there are more than five units, only
            some of their names are in `LASERS`, a return is too far from its pixel's ray, two returns share a pixel,
            or two time stamps are rounded to the same microsecond.
    """
    root = Path(root)
    name = safe_name(f"{log.log_id}.parquet", "the file of log_id")
    files = {tag: root / tag / name for tag in SCHEMAS}
    present = [str(file) for file in files.values() if file.exists()]
    if present:
        raise CFlowError(f"{present[0]} exists already: delete the segment, or choose another root")
    root.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=f".{log.log_id}-", dir=root) as folder:
        _write_components(log, Path(folder))
        # Readers search for the file `lidar`: add it last, so that they never find half a segment.
        for tag in sorted(files, key=lambda tag: tag == "lidar"):
            files[tag].parent.mkdir(exist_ok=True)
            os.replace(Path(folder) / tag, files[tag])
    return files["lidar"]


def _write_components(log: Drive, folder: Path) -> None:
    times = [(stamp + 500) // 1000 for stamp in log.timestamps]
    if len(set(times)) < len(times):
        raise CFlowError(f"log {log.log_id} has sweeps less than a microsecond apart, which Waymo's files cannot store")
    with ExitStack() as stack:
        writers = {
            tag: stack.enter_context(pq.ParquetWriter(folder / tag, schema, compression="zstd"))
            for tag, schema in SCHEMAS.items()
        }
        tables: dict[str, list[dict[str, Any]]] = {tag: [] for tag in SCHEMAS}  # written as one row group
        for index, time in enumerate(times):
            key = {_SEGMENT: log.log_id, TIME: time}
            units = log.units(index)
            numbers = _laser_numbers([unit.name for unit in units])
            images = []
            for unit, number in sorted(zip(units, numbers), key=lambda pair: pair[1]):
                calibration = _calibration(unit)
                image, pixel_poses = _image_cells(log, index, unit, calibration, number == TOP)
                images.append({**key, LASER: number, **image})
                if pixel_poses is not None:
                    _write_rows(writers["lidar_pose"], [{**key, LASER: TOP, **pixel_poses}])
                if index == 0:
                    tables["lidar_calibration"].append(_calibration_row(log.log_id, number, calibration))
            _write_rows(writers["lidar"], images)
            tables["lidar_box"] += _box_rows(log, index, key)
            pose = np.asarray(log.poses[index], np.float64)
            tables["vehicle_pose"].append({**key, VEHICLE_POSE: pose.reshape(-1)})
        for tag in ("lidar_calibration", "lidar_box", "vehicle_pose"):
            _write_rows(writers[tag], tables[tag])


def _image_cells(
    log: Drive, index: int, unit: UnitReturns, calibration: LaserCalibration, is_top: bool
) -> tuple[dict[str, Any], dict[str, Any] | None]:
    """Return the cells of both range images of a unit, and of its pixel poses; None = not TOP."""
    where = f"sweep {index} of log {log.log_id}, unit {unit.name}"
    shots = poses_of_shots(log, index, unit.offset_ns) if is_top else None
    true_shots = None
    if shots is not None and hasattr(log, "poses_at"):
        true_shots = partial(true_poses_of_shots, log, index, unit.offset_ns)
    images = encode_images(unit, calibration, where, shots, true_shots)
    cells = {**_cells(f"{LIDAR}1", images["first"]), **_cells(f"{LIDAR}2", images["second"])}
    return cells, _cells(PIXEL_POSE, images["poses"]) if is_top else None


def _laser_numbers(names: Sequence[str]) -> list[int]:
    if len(names) > len(LASERS):
        raise CFlowError(f"Waymo's vehicles carry up to {len(LASERS)} LiDARs, the recording has {list(names)}")
    if not set(names) & set(LASERS):
        return list(LASERS.values())[: len(names)]
    unknown = sorted(set(names) - set(LASERS))
    if unknown:
        raise CFlowError(f"units {unknown} are not Waymo's, but others are; rename all to {', '.join(LASERS)}")
    return [LASERS[name] for name in names]


def _calibration(unit: UnitReturns) -> LaserCalibration:
    """Calibration of a unit. As for Waymo's small lasers, evenly spaced beams are given by their outer edges only."""
    T_ego_sensor = np.asarray(unit.T_ego_sensor, np.float64)
    elevations = np.asarray(unit.elevations, np.float64)
    steps = np.diff(elevations)
    if len(steps) and np.ptp(steps) < 1e-12 and unit.name != "TOP":
        half = (elevations[-1] - elevations[0]) / len(steps) / 2
        return LaserCalibration(T_ego_sensor, None, float(elevations[0] - half), float(elevations[-1] + half))
    return LaserCalibration(T_ego_sensor, elevations, float(elevations[0]), float(elevations[-1]))


def _cells(column: str, image: np.ndarray) -> dict[str, Any]:
    return {f"{column}.values": image.astype(np.float32).reshape(-1), f"{column}.shape": list(image.shape)}


def _calibration_row(log_id: str, number: int, calibration: LaserCalibration) -> dict[str, Any]:
    values = (calibration.T_ego_sensor.reshape(-1), calibration.low, calibration.high, calibration.inclinations)
    return dict(zip(SCHEMAS["lidar_calibration"].names, (log_id, number, *values)))


def _box_rows(log: Drive, index: int, key: dict[str, Any]) -> list[dict[str, Any]]:
    """Boxes of one frame."""
    boxes = log.boxes(index)
    rows = []
    for track, category, size, pose, count in zip(
        boxes.track_id, boxes.names, boxes.size, boxes.pose, boxes.num_points
    ):
        if category in BOX_TYPE:
            numbers = {f"{BOX}box.center.{axis}": pose[k, 3] for k, axis in enumerate(_XYZ)}
            numbers.update({f"{BOX}box.size.{axis}": size[k] for k, axis in enumerate(_XYZ)})
            numbers[f"{BOX}box.heading"] = np.arctan2(pose[1, 0], pose[0, 0])
            kind = {f"{BOX}type": BOX_TYPE[category], f"{BOX}num_lidar_points_in_box": int(count)}
            rows.append({**key, TRACK: track, **numbers, **kind})
    return rows


def _write_rows(writer: pq.ParquetWriter, rows: Sequence[dict[str, Any]]) -> None:
    """Append one row group. Columns that a row lacks become null."""
    arrays = [pa.array([row.get(field.name) for row in rows], field.type) for field in writer.schema]
    writer.write_table(pa.Table.from_arrays(arrays, schema=writer.schema), row_group_size=max(len(rows), 1))
