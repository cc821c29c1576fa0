"""Flow files: the result of one window as a feather file, with rows in the order of sweep t."""

from __future__ import annotations

from typing import Sequence

import numpy as np
import pyarrow as pa
import torch
from pyarrow import feather

from cflow_torch.data.arrow_file import FeatherFile
from cflow_torch.data.atomic import atomic_file
from cflow_torch.data.paths import PathLike, as_path
from cflow_torch.types import VECTORS, CFlowError, FlowResult, vector_columns

CONTENTS = (*VECTORS, "cluster_id", "score", "is_valid")
ON_REQUEST = ("confidence", "moving")  # written only if you name it
_COLUMNS = {name: vector_columns(name) if name in VECTORS else [name] for name in (*CONTENTS, *ON_REQUEST)}


def write_flow(path: PathLike, result: FlowResult, contents: Sequence[str] = CONTENTS) -> None:
    """Write a result to `path`, atomically.

    Args:
        path: file name, by convention `<log id>/<time stamp of sweep t>.feather`.
        result: flow of one window.
        contents: names in `CONTENTS` and `ON_REQUEST`. A file without pose flow and total flow is about 17 times
            smaller. You can compute both from the residual flow and the poses.

    Convention:
        Columns flow_t{x,y,z}_m (total), residual_t{x,y,z}_m, pose_t{x,y,z}_m float32 in metres and in the axes of
        ego1, cluster_id int64, score, confidence and moving float32, is_valid bool.
        If you name a field that the result lacks, that is a `CFlowError`.
    """
    columns = result.columns()
    names = [column for name in contents for column in _COLUMNS.get(name, [name])]
    if not columns.keys() >= set(names):
        lacking = ", ".join(sorted(set(names) - columns.keys()))
        raise CFlowError(f"this result has no {lacking}: estimate it with preset default or offline, or leave it out")
    with atomic_file(path) as file:
        feather.write_feather(pa.table({name: columns[name] for name in names}), file)


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
                values = file.matrix(columns, {"cluster_id": np.int64, "is_valid": bool}.get(name, np.float32))
                fields[VECTORS.get(name, name)] = torch.from_numpy(values if name in VECTORS else values[:, 0])
        if not fields:
            raise CFlowError(f"its columns are {', '.join(file.names)}")
    except CFlowError as error:
        raise CFlowError(f"{path} is not a flow file ({error}): pass one that `cflow flow` wrote") from error
    return FlowResult.of(fields)
