"""Tables of tracks: join them, filter them, write and read them as Parquet, and write them as text for other tools."""

from __future__ import annotations

from io import StringIO
from typing import Dict, Sequence

import numpy as np
import pyarrow as pa
from pyarrow import parquet

from cflow_torch.applications.moving_groups import pose_of
from cflow_torch.data.atomic import atomic_file, write_text
from cflow_torch.data.file_errors import check_columns, file_errors
from cflow_torch.data.log import Log, known_poses
from cflow_torch.data.paths import PathLike, as_path, read_bytes
from cflow_torch.transforms import transform_each, transform_points, upright_poses
from cflow_torch.types import CENTRE, SIZE, VELOCITY, vectors

Table = Dict[str, np.ndarray]
TRACKS_FILE = "tracks.parquet"  # next to the flow files of a log
MOT_FILE = "mot.txt"
_INTEGERS = ("sweep", "timestamp_ns", "id", "num_moving", "cluster_id", "num_points")
_FLOATS = (*CENTRE, *VELOCITY, "velocity_std", *SIZE, "heading", "age", "confidence")
COLUMNS = {
    **dict.fromkeys(_INTEGERS, np.int64),
    **dict.fromkeys(_FLOATS, np.float64),
    "is_moving": np.bool_,
    "is_confirmed": np.bool_,
    "class": np.str_,
}


KITTI_NAMES = {"car": "Car", "pedestrian": "Pedestrian", "cyclist": "Cyclist", "truck": "Truck"}
"""Class of a track -> name in KITTI and OpenPCDet, in the order of OpenPCDet's labels 1, 2, 3, 4."""
_CORNERS = np.array([(x, y, z) for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)])


def join_tables(tables: Sequence[Table]) -> Table:
    """Concatenate tables. Without tables, all columns are empty."""
    return {
        name: np.concatenate([np.zeros(0, dtype), *(table[name] for table in tables)]).astype(dtype)
        for name, dtype in COLUMNS.items()
    }


def confirmed(table: Table) -> Table:
    """Keep all rows of each track that is confirmed in any sweep, also the earlier rows."""
    is_kept = np.isin(table["id"], table["id"][table["is_confirmed"]])
    return {name: values[is_kept] for name, values in table.items()}


def write_tracks(path: PathLike, table: Table) -> None:
    """Write the table of `track` as Parquet, atomically."""
    with atomic_file(path) as file:
        parquet.write_table(pa.table(dict(table)), file)


def read_tracks(path: PathLike) -> Table:
    """Read a table that `write_tracks` wrote; a missing file, or one without its columns, is a `CFlowError`."""
    path = as_path(path)
    hint = "give a table that `cflow flow tracks=true` wrote"
    with file_errors(path, hint):
        table = parquet.read_table(pa.BufferReader(read_bytes(path)), use_threads=False)
    check_columns(path, table.column_names, list(COLUMNS), hint)
    return {name: table.column(name).to_numpy().astype(dtype) for name, dtype in COLUMNS.items()}


def write_mot(folder: PathLike, table: Table, log: Log, data_set: str = "") -> None:
    """Write tracks as `folder/mot.txt` of the MOT Challenge 3D: lines `frame,id,-1,-1,-1,-1,confidence,x,y,z`.

    Frames and ids count from 1; x, y, z is the centre of the box, metres in the world; confidence is 1 where the method
    has none. The log and its data set are ignored.
    """
    columns = (table["sweep"] + 1, table["id"] + 1, score_of(table))
    _write_lines(
        as_path(folder) / MOT_FILE,
        "%d,%d,-1,-1,-1,-1,%.3f,%.3f,%.3f,%.3f",
        *columns,
        table["x"],
        table["y"],
        table["z"],
    )


def score_of(table: Table) -> np.ndarray:
    """Return the mean confidence of the track of each row, (R,) float64; 1 where the method has none."""
    _, track = np.unique(table["id"], return_inverse=True)
    confidence = np.nan_to_num(table["confidence"], nan=1.0)
    return (np.bincount(track, confidence) / np.bincount(track))[track]


def boxes_in_sweeps(table: Table, log: Log) -> tuple[np.ndarray, np.ndarray]:
    """Return centres, (R, 3) metres, and headings, (R,) radians, in the frame of the points of each row's sweep."""
    sweeps, row = np.unique(table["sweep"], return_inverse=True)
    T_ego_world = np.linalg.inv(poses_of(log, sweeps.tolist()))[row]
    direction = np.stack([np.cos(table["heading"]), np.sin(table["heading"])], 1)
    ahead = np.einsum("nij,nj->ni", T_ego_world[:, :2, :2], direction)
    return transform_each(vectors(table, CENTRE), T_ego_world), np.arctan2(ahead[:, 1], ahead[:, 0])


def poses_of(log: Log, sweeps: Sequence[int]) -> np.ndarray:
    """Return (K, 4, 4) float64 `T_world_ego` of some sweeps. The points are only read if poses come with them."""
    known = known_poses(log)
    poses = [pose_of(log.sweep(sweep)) if known is None else known[sweep] for sweep in sweeps]
    return np.reshape(poses, (-1, 4, 4))


def box_corners(centre: np.ndarray, heading: np.ndarray, size: np.ndarray) -> np.ndarray:
    """Return the corners of upright boxes, (R, 8, 3) metres. Their order is that of x, y, z; the last changes fastest.

    Args:
        centre: (R, 3) metres.
        heading: (R,) radians.
        size: (R, 3) length, width, height, metres.
    """
    boxes = upright_poses(np.concatenate([heading[:, None], centre], 1))
    corners = [transform_points(_CORNERS * sides, box) for sides, box in zip(size, boxes)]
    return np.stack(corners) if corners else np.zeros((0, 8, 3))


def _write_lines(path: PathLike, form: str, *columns: np.ndarray) -> None:
    text = StringIO()
    np.savetxt(text, np.stack(columns, 1), form)
    write_text(as_path(path), text.getvalue())
