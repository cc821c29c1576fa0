"""Tables of tracks: join them, filter them, write and read them as Parquet, and write them as text for other tools."""

from __future__ import annotations

from typing import Dict, Sequence

import numpy as np
import pyarrow as pa
from pyarrow import parquet

from cflow_torch.data.atomic import atomic_file, write_text
from cflow_torch.data.files import check_columns, file_errors
from cflow_torch.data.log import Log
from cflow_torch.data.paths import PathLike, as_path, read_bytes
from cflow_torch.types import as_numpy

Table = Dict[str, np.ndarray]
TRACKS_FILE = "tracks.parquet"  # next to the flow files of a log
_INTEGERS = ("sweep", "timestamp_ns", "id", "num_moving", "cluster_id", "num_points")
_FLOATS = ("x", "y", "z", "vx", "vy", "vz", "velocity_std", "length", "width", "height", "heading", "age", "confidence")
COLUMNS = {
    **dict.fromkeys(_INTEGERS, np.int64),
    **dict.fromkeys(_FLOATS, np.float64),
    "is_moving": np.bool_,
    "is_confirmed": np.bool_,
}


def join_tables(tables: Sequence[Table]) -> Table:
    """Concatenate tables. Without tables, all columns are empty."""
    return {
        name: np.concatenate([np.zeros(0, dtype), *(table[name] for table in tables)]).astype(dtype)
        for name, dtype in COLUMNS.items()
    }


def confirmed(table: Table) -> Table:
    """Keep all rows of tracks that are confirmed at some time, including the rows before."""
    is_kept = np.isin(table["id"], table["id"][table["is_confirmed"]])
    return {name: values[is_kept] for name, values in table.items()}


def write_tracks(path: PathLike, table: Table) -> None:
    """Write the table of `track` as Parquet, atomically."""
    with atomic_file(path) as file:
        parquet.write_table(pa.table(dict(table)), file)


def read_tracks(path: PathLike) -> Table:
    """Read a table that `write_tracks` wrote; a missing or another file is a `CFlowError`."""
    path = as_path(path)
    hint = "give a table that `cflow flow tracks=true` wrote"
    with file_errors(path, hint):
        table = parquet.read_table(pa.BufferReader(read_bytes(path)), use_threads=False)
    check_columns(path, table.column_names, list(COLUMNS), hint)
    return {name: table.column(name).to_numpy().astype(dtype) for name, dtype in COLUMNS.items()}


def write_mot(path: PathLike, table: Table, log: Log) -> None:
    """Write tracks as text of the MOT Challenge 3D: lines `frame,id,-1,-1,-1,-1,confidence,x,y,z`.

    Frames and ids count from 1; x, y, z is the centre of the box, metres in the world; confidence is 1 where the method
    has none. The log is not used.
    """
    confidence = np.where(np.isnan(table["confidence"]), 1.0, table["confidence"])
    rows = zip(table["sweep"] + 1, table["id"] + 1, confidence, *(table[axis] for axis in "xyz"))
    lines = (
        f"{frame},{number},-1,-1,-1,-1,{sure:.3f},{x:.3f},{y:.3f},{z:.3f}" for frame, number, sure, x, y, z in rows
    )
    write_text(as_path(path), "".join(line + "\n" for line in lines))


def write_kitti(path: PathLike, table: Table, log: Log) -> None:
    """Write tracks as text of KITTI's tracking benchmark, with poses from the log: a line of 18 columns per row.

    Frames and ids count from 0; the type is Misc, because tracks have no class; unknown columns are -1. The camera is
    at the origin of the ego frame of the sweep, looks to +x, and has KITTI's axes: x to the right, y down, z ahead. The
    position is the middle of the lower face of the box.

    Source: development kit of the KITTI tracking benchmark (2012).
    """
    lines = []
    for index in np.unique(table["sweep"]).tolist():
        rows = {name: values[table["sweep"] == index] for name, values in table.items()}
        pose = log.sweep(index).pose
        T_ego_world = np.eye(4) if pose is None else np.linalg.inv(as_numpy(pose, np.float64))
        centre = np.stack([rows[axis] for axis in "xyz"], 1) @ T_ego_world[:3, :3].T + T_ego_world[:3, 3]
        ahead = np.stack([np.cos(rows["heading"]), np.sin(rows["heading"])]).T @ T_ego_world[:2, :2].T
        x, y, z = -centre[:, 1], rows["height"] / 2 - centre[:, 2], centre[:, 0]
        rotation = _wrapped(-np.arctan2(ahead[:, 1], ahead[:, 0]) - np.pi / 2)
        alpha = _wrapped(rotation - np.arctan2(x, z))
        score = np.where(np.isnan(rows["confidence"]), 1.0, rows["confidence"])
        size = (rows["height"], rows["width"], rows["length"])
        for number, angle, *numbers in zip(rows["id"], alpha, *size, x, y, z, rotation, score):
            box = " ".join(f"{value:.6f}" for value in numbers)
            lines.append(f"{index} {number} Misc -1 -1 {angle:.6f} -1 -1 -1 -1 {box}\n")
    write_text(as_path(path), "".join(lines))


def _wrapped(angle: np.ndarray) -> np.ndarray:
    """Angles in -pi ... pi."""
    return np.arctan2(np.sin(angle), np.cos(angle))
