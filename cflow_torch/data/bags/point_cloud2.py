"""Messages of type sensor_msgs/PointCloud2 as arrays: any layout of fields, padding, byte order, several rows."""

from __future__ import annotations

from typing import Any

import numpy as np

_TYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}  # PointField.datatype
_TIME_FIELDS = ("t", "time", "timestamp", "offset_time", "time_stamp")
_UNITS = (1.0, 1e-3, 1e-6, 1e-9)  # seconds
_SHORTEST, _LONGEST = 0.005, 5.0  # duration of a sweep in seconds: a factor of 1000, so that only one unit fits


def points_and_times(message: Any, stamp_ns: int) -> tuple[np.ndarray, np.ndarray | None]:
    """Return the points of a cloud, without "no return" points, which are not finite or at the origin.

    Args:
        message: PointCloud2 as rosbags reads it.
        stamp_ns: time of the sweep.

    Returns:
        (N, 3) float64 metres in the frame of the message; (N,) float64 seconds after the stamp, see `seconds_after`,
        None = unknown.

    Raises:
        ValueError: no fields x, y, z, an unknown type, or less data than the message states.
    """
    fields = {field.name: field for field in message.fields}
    names = [*"xyz", *[name for name in _TIME_FIELDS if name in fields][:1]]
    missing = [name for name in names if name not in fields]
    if missing:
        raise ValueError(f"the cloud lacks the fields {missing}; it has {list(fields)}")
    table, points, kept = _returns(message, names)
    times = seconds_after(table[names[3]][kept], stamp_ns) if len(names) > 3 else None
    return points[kept], times


def other_columns(message: Any) -> dict[str, np.ndarray]:
    """Return the other fields of the points that `points_and_times` returns: name -> (N,) numbers as stored."""
    single = [field.name for field in message.fields if field.count <= 1 and field.datatype in _TYPES]
    names = [name for name in single if name not in ("", "x", "y", "z")]
    table, _, kept = _returns(message, [*"xyz", *names])
    return {name: table[name][kept].astype(table[name].dtype.newbyteorder("=")) for name in names}


def _returns(message: Any, names: list[str]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the structured (N,) rows of a cloud, their (N, 3) float64 points, and (N,) bool, False = no return."""
    fields = {field.name: field for field in message.fields}
    order = ">" if message.is_bigendian else "<"
    kinds = [order + _TYPES[fields[name].datatype] for name in names]
    offsets, step = [fields[name].offset for name in names], message.point_step
    kind = np.dtype({"names": names, "formats": kinds, "offsets": offsets, "itemsize": step})
    row_step = message.row_step or message.width * step
    rows = np.frombuffer(message.data, np.uint8, message.height * row_step).reshape(message.height, row_step)
    table = np.ascontiguousarray(rows[:, : message.width * step]).view(kind).reshape(-1)
    points = np.stack([table[axis] for axis in "xyz"], axis=1).astype(np.float64)
    return table, points, np.isfinite(points).all(axis=1) & (points != 0).any(axis=1)


def seconds_after(values: np.ndarray, stamp_ns: int) -> np.ndarray | None:
    """Convert the times of points to seconds after the stamp of their sweep.

    Args:
        values: (N,) as stored, of any unit.
        stamp_ns: time of the sweep.

    Returns:
        (N,) float64; None if they are all equal, or if no unit gives the duration of a sweep.

    Convention: the unit, from seconds to nanoseconds, is the one in which they span 5 ms to 5 s. Values of at most 5 s
    count from the stamp, larger ones from 1970. If the latter are more than 5 s away from the stamp, they come from
    another clock, and we assume that the first shot was at the stamp.
    """
    if not len(values):
        return None
    first = values.min()
    span = float(values.max() - first)
    unit = next((unit for unit in _UNITS if _SHORTEST <= span * unit < _LONGEST), None)
    if unit is None:
        return None
    start = float(first) * unit
    if abs(start) > _LONGEST:
        start = (int(first) * round(unit * 1e9) if first.dtype.kind in "iu" else round(start * 1e9)) - stamp_ns
        start = start * 1e-9 if abs(start) <= _LONGEST * 1e9 else 0.0
    since: np.ndarray = (values - first).astype(np.float64) * unit + start
    return since
