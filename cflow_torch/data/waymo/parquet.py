"""Access to Waymo's parquet files: columns with checks, and single range images out of large files."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any, Callable, Dict, List, Optional, Sequence, Tuple

import numpy as np
import pyarrow as pa

from cflow_torch.data.arrow_file import check_columns, check_rows, shortened
from cflow_torch.data.parquet_file import ParquetFile
from cflow_torch.data.paths import mapped, ranged
from cflow_torch.types import CFlowError

SEGMENT, TIME, LASER, TRACK = (
    f"key.{name}" for name in ("segment_context_name", "frame_timestamp_micros", "laser_name", "laser_object_id")
)
"""Key columns."""

LIDAR, PIXEL_POSE = "[LiDARComponent].range_image_return", "[LiDARPoseComponent].range_image_return1"
CALIBRATION, BOX = "[LiDARCalibrationComponent].", "[LiDARBoxComponent]."
VEHICLE_POSE = "[VehiclePoseComponent].world_from_vehicle.transform"
"""Beginnings of the columns that are read, and one whole name."""

STATS = "[StatsComponent]."
_IMAGE, _SHAPE, _TRANSFORM = pa.list_(pa.float32()), pa.list_(pa.int32(), 3), pa.list_(pa.float64(), 16)
_FRAME_KEYS: List[Tuple[str, Any]] = [(SEGMENT, pa.string()), (TIME, pa.int64())]
SCHEMAS: Dict[str, pa.Schema] = {
    "lidar": pa.schema(
        [
            *_FRAME_KEYS,
            (LASER, pa.int8()),
            *((f"{LIDAR}{k}.{part}", kind) for k in (1, 2) for part, kind in (("values", _IMAGE), ("shape", _SHAPE))),
        ]
    ),
    "lidar_calibration": pa.schema(
        [
            (SEGMENT, pa.string()),
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
            *((f"{BOX}box.{part}.{axis}", pa.float64()) for part in ("center", "size") for axis in "xyz"),
            (f"{BOX}box.heading", pa.float64()),
            (f"{BOX}type", pa.int8()),
            (f"{BOX}num_lidar_points_in_box", pa.int64()),
            (f"{BOX}num_top_lidar_points_in_box", pa.int64()),
            *((f"{BOX}{part}.{axis}", pa.float64()) for part in ("speed", "acceleration") for axis in "xyz"),
            (f"{BOX}difficulty_level.detection", pa.int8()),
            (f"{BOX}difficulty_level.tracking", pa.int8()),
        ]
    ),
    "stats": pa.schema(
        [
            *_FRAME_KEYS,
            *((STATS + name, pa.string()) for name in ("time_of_day", "location", "weather")),
            *(
                (f"{STATS}{sensor}_object_counts.{part}", pa.list_(kind))
                for sensor in ("lidar", "camera")
                for part, kind in (("types", pa.int8()), ("counts", pa.int32()))
            ),
        ]
    ),
}
"""Component -> its columns, as the official classes print them."""

_MAX_KEY = 1 << 53
_BATCH = 8  # rows of range images held at once while looking for one


def read_images(file: Path, numbers: Sequence[int], column: str, channels: int) -> Dict[int, Optional[np.ndarray]]:
    """Range images of some rows.

    Args:
        file: the component.
        numbers: rows wanted, 0 = first of the file.
        column: name without its `.values` and `.shape`.
        channels: of each image.

    Returns:
        Row -> (H, W, channels) image, None where the file has a null.

    Cost: decodes every row group that holds a wanted row, a few rows at a time.

    Raises:
        CFlowError: the file cannot be read, or a cell is no image.
    """
    columns = [f"{column}.values", f"{column}.shape"]
    images: Dict[int, Optional[np.ndarray]] = {}
    with _open(file, columns, mapped) as parquet:
        check_columns(file, parquet.schema, columns)
        kinds = [parquet.schema.field(name).type for name in columns]
        if not (_is_list_of(kinds[0], pa.types.is_floating) and _is_list_of(kinds[1], pa.types.is_integer)):
            raise CFlowError(f"{file}: {columns} must be lists of floats and of integers, got {kinds[0]}, {kinds[1]}")
        end = 0
        for group, num_rows in enumerate(parquet.group_rows):
            number, end = end, end + num_rows
            if not any(number <= wanted < end for wanted in numbers):
                continue
            for batch in parquet.batches(group, columns, _BATCH):
                for values, shape in zip(*(batch.column(name) for name in columns)):
                    if number in numbers:
                        images[number] = _image(values, shape, channels, file)
                    number += 1
    missing = [number for number in numbers if number not in images]
    if missing:  # what the footer says of its row groups is not true
        raise CFlowError(f"{file} has fewer rows than it claims: row {missing[0]} is missing, copy it again")
    return images


def _open(file: Path, columns: Sequence[str], access: Callable[[Path], Any]) -> ParquetFile:
    """An open parquet file that has these columns."""
    try:
        parquet = ParquetFile(file, access(file))
    except FileNotFoundError:
        raise CFlowError(f"{file} is missing; download component {file.parent.name} of this segment") from None
    except OSError as error:
        raise CFlowError(f"cannot read {file}: {error}; it may be truncated, copy it again") from error
    names = parquet.names
    missing = [name for name in columns if name not in names]
    if missing:
        raise CFlowError(
            f"{file} lacks the columns {missing}; it has {shortened(names)}: is it component {file.parent.name}?"
        )
    return parquet


def read_columns(file: Path, columns: Sequence[str]) -> pa.Table:
    with _open(file, columns, ranged) as parquet:
        check_rows(file, sum(parquet.group_rows))
        return parquet.read(columns)


def numbers_of(table: pa.Table, column: str, file: Path) -> np.ndarray:
    """(rows,) numbers of a column that has no holes; a float column must be finite."""
    values = table.column(column)
    kind = values.type
    if values.null_count or not (pa.types.is_integer(kind) or pa.types.is_floating(kind)):
        raise CFlowError(f"{file}: {column} must hold a number in every row, got {kind} with {values.null_count} holes")
    array = values.to_numpy()
    if not np.isfinite(array).all():
        raise CFlowError(f"{file}: {column} holds values that are not finite")
    return array


def keys_of(table: pa.Table, column: str, file: Path) -> List[int]:
    """Whole numbers of a column; times in microseconds are within +-2^53."""
    array = numbers_of(table, column, file)
    if array.dtype.kind not in "iu" or (
        array.size and not -_MAX_KEY <= int(array.min()) <= int(array.max()) <= _MAX_KEY
    ):
        raise CFlowError(f"{file}: {column} must hold whole numbers up to 2^53, got {array.dtype}")
    keys: List[int] = array.tolist()
    return keys


def cell_of(table: pa.Table, column: str, row: int, file: Path) -> Optional[np.ndarray]:
    """(K,) float64 of a cell that is a number (K = 1) or a list of numbers; holes in it are NaN; None for no cell."""
    values = table.column(column)
    is_number = pa.types.is_integer(values.type) or pa.types.is_floating(values.type)
    if not is_number and not _is_list_of(values.type, pa.types.is_integer, pa.types.is_floating):
        raise CFlowError(f"{file}: {column} must be numbers or lists of numbers, got {values.type}")
    cell = values[row]
    if not cell.is_valid:
        return None
    return np.array([cell.as_py()] if is_number else cell.values.to_numpy(zero_copy_only=False), dtype=np.float64)


def matrix_of(values: Optional[np.ndarray], where: str) -> np.ndarray:
    """(4, 4) from 16 numbers, row by row."""
    if values is None or len(values) != 16:
        raise CFlowError(
            f"{where} must be 16 numbers, row by row, got {'nothing' if values is None else f'{len(values)}'}"
        )
    return values.reshape(4, 4)


def _is_list_of(kind: pa.DataType, *checks: Callable[[pa.DataType], bool]) -> bool:
    is_list = pa.types.is_list(kind) or pa.types.is_large_list(kind) or pa.types.is_fixed_size_list(kind)
    return bool(is_list and any(check(kind.value_type) for check in checks))


def _image(values: Any, shape: Any, channels: int, file: Path) -> Optional[np.ndarray]:
    """(H, W, channels) image of a list cell; None where the cell is null or empty."""
    if not values.is_valid or not shape.is_valid or not len(values.values) or not len(shape.values):
        return None
    flat, size = values.values.to_numpy(zero_copy_only=False), shape.values[:4].to_pylist()
    if len(size) != 3 or None in size or min(size) < 1 or size[2] != channels or flat.size != math.prod(size):
        raise CFlowError(f"{file}: a range image of shape (H, W, {channels}) was expected, got {size} for {flat.size}")
    if values.values.null_count:
        raise CFlowError(f"{file}: a range image has {values.values.null_count} empty pixels; copy it again")
    return flat.reshape(size)
