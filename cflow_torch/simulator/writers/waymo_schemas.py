"""The columns of Waymo's parquet files that the reader reads, as printed by the official classes."""

from __future__ import annotations

from typing import Any

import pyarrow as pa

from cflow_torch.data.waymo.parquet import (
    BOX,
    CALIBRATION,
    LASER,
    LIDAR,
    PIXEL_POSE,
    SEGMENT,
    TIME,
    TRACK,
    VEHICLE_POSE,
)

_IMAGE, _SHAPE, _TRANSFORM = pa.list_(pa.float32()), pa.list_(pa.int32(), 3), pa.list_(pa.float64(), 16)
_FRAME_KEYS: list[tuple[str, Any]] = [(SEGMENT, pa.string()), (TIME, pa.int64())]
SCHEMAS: dict[str, pa.Schema] = {
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
        ]
    ),
}
"""Component -> its columns."""
