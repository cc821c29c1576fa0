"""Tables of tracks: join them, filter them, write and read them as Parquet."""

from __future__ import annotations

from typing import Dict, Sequence

import numpy as np
import pyarrow as pa
from pyarrow import parquet

from cflow_torch.data.atomic import atomic_file
from cflow_torch.data.files import file_errors
from cflow_torch.data.paths import PathLike, as_path, read_bytes
from cflow_torch.types import CFlowError

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
    """Read a table that `write_tracks` wrote.

    Raises:
        CFlowError: the file does not exist, or is not a table of tracks.
    """
    path = as_path(path)
    with file_errors(path, "give a table that `cflow flow tracks=true` wrote"):
        table = parquet.read_table(pa.BufferReader(read_bytes(path)), use_threads=False)
    missing = sorted(COLUMNS.keys() - set(table.column_names))
    if missing:
        raise CFlowError(f"{path} lacks {', '.join(missing)}: give a table that `cflow flow tracks=true` wrote")
    return {name: table.column(name).to_numpy().astype(dtype) for name, dtype in COLUMNS.items()}
