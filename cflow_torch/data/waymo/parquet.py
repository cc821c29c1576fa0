"""Access to Waymo's parquet files: columns with checks, and single range images out of large files."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Collection, Sequence, Tuple

import numpy as np
import pyarrow.parquet as pq

from cflow_torch.data.files import check_columns, file_errors
from cflow_torch.data.paths import source_for_mmap, source_for_random_access
from cflow_torch.types import CFlowError
from cflow_torch.windows.ego_motion import rigid_transform

SEGMENT, TIME, LASER, TRACK = (
    f"key.{name}" for name in ("segment_context_name", "frame_timestamp_micros", "laser_name", "laser_object_id")
)
"""Key columns."""

LIDAR, PIXEL_POSE = "[LiDARComponent].range_image_return", "[LiDARPoseComponent].range_image_return1"
CALIBRATION, BOX = "[LiDARCalibrationComponent].", "[LiDARBoxComponent]."
VEHICLE_POSE = "[VehiclePoseComponent].world_from_vehicle.transform"
"""Prefixes of the columns that we read, and one complete name."""

_BATCH = 8  # rows of range images in memory at once during the search for one
Key = Tuple[int, int]  # frame time in microseconds, laser


class Component:
    """The file `<split>/<tag>/<segment>.parquet` of a segment, opened when it is needed."""

    def __init__(self, segment: Path, tag: str) -> None:
        self.file = segment.parent.parent / tag / segment.name
        self._hint = f"download component {tag} of this segment"
        self._row_of: dict[Key, int] = {}

    def rows(self, columns: Sequence[str]) -> list[dict[str, Any]]:
        """Read some columns of all rows."""
        with file_errors(self.file, self._hint):
            parquet = pq.ParquetFile(source_for_random_access(self.file))
            check_columns(self.file, parquet.schema_arrow.names, columns, self._hint)
            return list(parquet.read(list(columns), use_threads=False).to_pylist())

    def rows_by(self, key: str, wanted: Sequence[int], columns: Sequence[str]) -> dict[int, list[Any]]:
        """Read some columns of the rows with the wanted values of a key column, by that value."""
        rows = {row[key]: [row[name] for name in columns] for row in self.rows((key, *columns))}
        missing = [value for value in wanted if value not in rows]
        if missing:
            raise CFlowError(f"{self.file} has no row with {key} {missing[0]}; copy it again")
        return {value: rows[value] for value in wanted}

    def frame_lasers(self) -> Collection[Key]:
        """Return the frame time (microseconds) and laser of every row."""
        if not self._row_of:
            self._row_of = {(row[TIME], row[LASER]): index for index, row in enumerate(self.rows((TIME, LASER)))}
        return self._row_of

    def images(self, keys: Sequence[Key], column: str, channels: int) -> dict[Key, np.ndarray | None]:
        """Read range images, (H, W, channels), by frame time and laser; None if the cell is null or empty.

        Give `column` without `.values` or `.shape`. Cost: decodes every row group that holds a wanted row, a few rows
        at a time.
        """
        missing = [key for key in keys if key not in self.frame_lasers()]
        if missing:
            raise CFlowError(f"{self.file} has no row for frame {missing[0][0]}, laser {missing[0][1]}; copy it again")
        rows, columns = [self._row_of[key] for key in keys], [TIME, LASER, f"{column}.values", f"{column}.shape"]
        images: dict[Key, np.ndarray | None] = {}
        with file_errors(self.file, self._hint):
            parquet = pq.ParquetFile(source_for_mmap(self.file))
            check_columns(self.file, parquet.schema_arrow.names, columns, self._hint)
            ends = np.cumsum([parquet.metadata.row_group(k).num_rows for k in range(parquet.num_row_groups)])
            groups = np.unique(np.searchsorted(ends, rows, side="right")).tolist()
            for batch in parquet.iter_batches(_BATCH, groups, columns, use_threads=False):
                for time, laser, values, shape in zip(*(batch.column(name) for name in columns)):
                    key = (time.as_py(), laser.as_py())
                    if key in keys:
                        images[key] = _image(values, shape, channels)
        return images


def matrix_of(values: Any, where: str) -> np.ndarray:
    """Return a (4, 4) float64 rigid motion from 16 numbers, row by row."""
    if values is None or len(values) != 16:
        raise CFlowError(f"{where} must have 16 numbers, row by row, got {0 if values is None else len(values)}")
    return rigid_transform(np.reshape(values, (4, 4)), where)


def _image(values: Any, shape: Any, channels: int) -> np.ndarray | None:
    """Return the (H, W, channels) image of a list cell; None if the cell is null or empty."""
    if not values.is_valid or not shape.is_valid or not len(values.values) or not len(shape.values):
        return None
    size, flat = shape.as_py(), values.values
    if len(size) != 3 or size[2] != channels or flat.null_count:
        raise ValueError(f"a range image must be (H, W, {channels}) without nulls, got {size}, {flat.null_count} nulls")
    return np.asarray(flat.to_numpy().reshape(size))
