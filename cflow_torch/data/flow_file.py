"""One flow result per file: feather columns, rows in the order of sweep t."""

from __future__ import annotations

from typing import Sequence

import numpy as np
import pyarrow as pa
import torch
from pyarrow import feather

from cflow_torch.data.arrow_file import FeatherFile, bools, floats, integers
from cflow_torch.data.atomic import atomic_file
from cflow_torch.data.paths import Place, as_path
from cflow_torch.types import CFlowError, FlowResult

_VECTORS = {"flow": "flow", "residual": "residual_flow", "pose": "pose_flow"}  # name in the file -> field
_SCALARS = ("cluster_id", "score", "is_valid")
_AXES = "xyz"
CONTENTS = (*_VECTORS, *_SCALARS)
ON_REQUEST = ("confidence",)  # what a file has only if it is named


def write_flow(path: Place, result: FlowResult, contents: Sequence[str] = CONTENTS) -> None:
    """Write a result to `path`, atomically.

    Args:
        path: file name, by convention `<log id>/<time stamp of sweep t>.feather`.
        result: flow of one window.
        contents: what of it, names of `CONTENTS` and `ON_REQUEST`. The pose flow, and with it the total flow, follow
            from the poses; without these two a file has about a seventeenth of the size.

    Convention:
        Columns flow_t{x,y,z}_m (total), residual_t{x,y,z}_m, pose_t{x,y,z}_m float32 in metres and in the axes of
        ego1, cluster_id int64, score and confidence float32, is_valid bool.

    Raises:
        CFlowError: the result has no confidence, and it was asked for.
    """
    columns = {}
    for name in contents:
        given = getattr(result, _VECTORS.get(name, name))
        if given is None:
            raise CFlowError(f"{name} was asked for, but this result has none: estimate it with preset default or fast")
        values = given.detach().cpu().numpy()
        if name in _VECTORS:
            columns.update({f"{name}_t{axis}_m": values[:, i] for i, axis in enumerate(_AXES)})
        else:
            columns[name] = values
    with atomic_file(path) as file:
        feather.write_feather(pa.table({name: pa.array(values) for name, values in columns.items()}), file)


def read_flow(path: Place) -> FlowResult:
    """Read what `write_flow` wrote.

    Raises:
        CFlowError: the file is missing, cannot be reached, is truncated, or was not written with all contents.
    """
    path = as_path(path)
    try:
        file = FeatherFile(path)
        names = [*_SCALARS, *(name for name in ON_REQUEST if name in file.names)]
        axes = {name: [f"{name}_t{axis}_m" for axis in _AXES] for name in _VECTORS}
        table = file.read([*(column for columns in axes.values() for column in columns), *names])
        read = {"cluster_id": integers, "is_valid": bools}
        values = {name: read[name](table, name, path) for name in names if name in read}
        values.update({name: floats(table, [name], path, np.float32)[:, 0] for name in names if name not in read})
        values.update({_VECTORS[name]: floats(table, columns, path, np.float32) for name, columns in axes.items()})
    except CFlowError as error:
        raise CFlowError(
            f"{path} is no flow file ({error}): give one that `cflow flow` wrote with all its contents"
        ) from error
    return FlowResult(**{name: torch.from_numpy(np.array(array)) for name, array in values.items()})
