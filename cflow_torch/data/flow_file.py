"""Flow files: the result of one window as a feather file, with rows in the order of sweep t."""

from __future__ import annotations

from typing import Sequence

import numpy as np
import pyarrow as pa
import torch
from pyarrow import feather

from cflow_torch.data.arrow_file import FeatherFile
from cflow_torch.data.atomic import atomic_file
from cflow_torch.data.file_errors import file_errors
from cflow_torch.data.paths import PathLike, as_path, is_remote, read_bytes
from cflow_torch.errors import MissingFile
from cflow_torch.types import VECTORS, Array, CFlowError, FlowResult, as_numpy, vector_columns

CONTENTS = (*VECTORS, "cluster_id", "score", "is_valid")
ON_REQUEST = ("confidence", "moving")  # written only if you name it
POINTS = "points"  # the same; the columns x, y, z
TRACK_ID = "track_id"  # added by `add_track_ids`
_FIELDS = (*CONTENTS, *ON_REQUEST, TRACK_ID)
_COLUMNS = {name: vector_columns(name) if name in VECTORS else [name] for name in _FIELDS}
_DTYPES = {"cluster_id": np.int64, "is_valid": bool, TRACK_ID: np.int64}


def write_flow(
    path: PathLike, result: FlowResult, contents: Sequence[str] = CONTENTS, points: Array | None = None
) -> None:
    """Write a result to `path`, atomically.

    Args:
        path: file name, by convention `<log id>/<time stamp of sweep t>.feather`.
        result: flow of one window.
        contents: names in `CONTENTS` and `ON_REQUEST`, and `POINTS`. Without pose flow and total flow, which follow
            from the residual flow and the poses, a file is about 17 times smaller.
        points: (N, 3+) of sweep t, metres, needed only for the content "points".

    Convention:
        Columns flow_t{x,y,z}_m (total), residual_t{x,y,z}_m, pose_t{x,y,z}_m float32 in metres and in the axes of
        ego1, cluster_id int64, score, confidence and moving float32, is_valid bool. x, y, z are float32, in
        metres and in the ego frame of t.
        If you name a field that the result lacks, or points without passing them, that is a `CFlowError`.
    """
    columns = result.columns()
    if POINTS in contents:
        if points is None or len(points) != len(result.residual_flow):
            raise CFlowError("the content points needs the points of sweep t, a row per row of the flow: pass points=")
        columns.update(zip("xyz", as_numpy(points)[:, :3].astype(np.float32).T))
    names = [column for name in contents for column in ("xyz" if name == POINTS else _COLUMNS.get(name, [name]))]
    if not columns.keys() >= set(names):
        lacking = ", ".join(sorted(set(names) - columns.keys()))
        raise CFlowError(f"this result has no {lacking}: estimate it with preset default or offline, or leave it out")
    with atomic_file(path) as file:
        feather.write_feather(pa.table({name: columns[name] for name in names}), file)


def add_track_ids(path: PathLike, track_id: np.ndarray) -> None:
    """Add the column `track_id` to a flow file, or replace it: (N,) int64, the track of each point, -1 = none."""
    table = FeatherFile(as_path(path)).table
    if TRACK_ID in table.column_names:
        table = table.drop([TRACK_ID])
    with atomic_file(path) as file:
        feather.write_feather(table.append_column(TRACK_ID, pa.array(track_id.astype(np.int64))), file)


def has_track_ids(path: PathLike) -> bool:
    """Test whether a flow file has the column `track_id`. Of a local file, only the footer is read."""
    path = as_path(path)
    with file_errors(path):
        source = pa.BufferReader(read_bytes(path)) if is_remote(path) else pa.memory_map(str(path))
        with source:
            return TRACK_ID in pa.ipc.open_file(source).schema.names


def read_flow(path: PathLike) -> FlowResult:
    """Read a result that `write_flow` wrote. Fields that the file lacks are None.

    A file that cannot be read or is not a flow file is a `CFlowError`.
    """
    path = as_path(path)
    fields = {}
    try:
        file = FeatherFile(path)
        for name, columns in _COLUMNS.items():
            if set(columns) & set(file.names):
                values = file.matrix(columns, _DTYPES.get(name, np.float32))
                fields[VECTORS.get(name, name)] = torch.from_numpy(values if name in VECTORS else values[:, 0])
        if not fields:
            raise CFlowError(f"its columns are {', '.join(file.names)}")
    except MissingFile:
        raise
    except CFlowError as error:
        raise CFlowError(f"{path} is not a flow file ({error}): pass one that `cflow flow` wrote") from error
    return FlowResult.of(fields)
