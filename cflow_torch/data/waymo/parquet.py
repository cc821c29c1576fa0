"""Access to Waymo's parquet files: columns with checks, and single range images out of large files."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Callable, Dict, Iterator, List, Optional, Sequence, Tuple

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

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
        end = 0
        for group in range(parquet.num_row_groups):
            number, end = end, end + parquet.metadata.row_group(group).num_rows
            if not any(number <= wanted < end for wanted in numbers):
                continue
            for batch in _batches(file, parquet, group, columns):
                for values, shape in zip(*(batch.column(name) for name in columns)):
                    if number in numbers:
                        images[number] = _image(values, shape, channels, file)
                    number += 1
    return images


def _open(file: Path, columns: Sequence[str], access: Callable[[Path], Any]) -> pq.ParquetFile:
    """An open parquet file that has these columns."""
    try:
        parquet = pq.ParquetFile(access(file), memory_map=True)
    except FileNotFoundError:
        raise CFlowError(f"{file} is missing; download component {file.parent.name} of this segment") from None
    except (pa.ArrowException, OSError, ValueError) as error:
        raise CFlowError(f"cannot read {file} as parquet: {error}; it may be truncated, copy it again") from error
    names = parquet.schema_arrow.names
    missing = [name for name in columns if name not in names]
    if missing:
        parquet.close()
        raise CFlowError(f"{file} lacks the columns {missing}; it has {names}: is it component {file.parent.name}?")
    return parquet


def read_columns(file: Path, columns: Sequence[str]) -> pa.Table:
    with _open(file, columns, ranged) as parquet:
        try:
            return parquet.read(columns=list(columns))
        except (pa.ArrowException, OSError, ValueError) as error:
            raise CFlowError(f"cannot read {file}: {error}; it may be damaged, copy it again") from error


def _batches(file: Path, parquet: pq.ParquetFile, group: int, columns: Sequence[str]) -> Iterator[pa.RecordBatch]:
    try:
        yield from parquet.iter_batches(batch_size=_BATCH, row_groups=[group], columns=list(columns))
    except (pa.ArrowException, OSError, ValueError) as error:
        raise CFlowError(f"cannot read {file}: {error}; it may be damaged, copy it again") from error


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


def matrix_of(values: Optional[Sequence[float]], where: str) -> np.ndarray:
    """(4, 4) from 16 numbers, row by row."""
    if values is None or len(values) != 16 or None in values:
        raise CFlowError(f"{where} must be 16 numbers, row by row, got {values}")
    return np.array(values, dtype=np.float64).reshape(4, 4)


def _image(values: Any, shape: Any, channels: int, file: Path) -> Optional[np.ndarray]:
    """(H, W, channels) image of a list cell; None where the cell is null or empty."""
    size = shape.as_py()
    if not values.is_valid or not size or len(values.values) == 0:
        return None
    flat = values.values.to_numpy(zero_copy_only=False)
    if len(size) != 3 or size[2] != channels or flat.size != np.prod(size):
        raise CFlowError(f"{file}: a range image of shape (H, W, {channels}) was expected, got {size} for {flat.size}")
    return flat.reshape(size)
