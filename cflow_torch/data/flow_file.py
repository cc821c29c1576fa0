"""One flow result per file: feather columns, rows in the order of sweep t."""

from __future__ import annotations

from typing import Sequence

import numpy as np
import pyarrow as pa
import torch
from pyarrow import feather

from cflow_torch.data.atomic import atomic_file
from cflow_torch.data.feather_file import FeatherFile
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
            raise CFlowError(f"{name} was asked for, but this result has none: estimate it with proof=True")
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
    names = [f"{name}_t{axis}_m" for name in _VECTORS for axis in _AXES] + list(_SCALARS)
    path = as_path(path)
    try:
        file = FeatherFile(path)
        table = file.read([*names, *(name for name in ON_REQUEST if name in file.names)])
    except (OSError, CFlowError) as error:
        raise CFlowError(
            f"{path} is no flow file ({error}): give one that `cflow flow` wrote with all its contents"
        ) from error
    columns = {}
    for name in table.column_names:
        kind = table.column(name).type
        wanted = {"cluster_id": "int64", "is_valid": "bool"}.get(name, "floating point")
        right = pa.types.is_floating(kind) if wanted == "floating point" else str(kind) == wanted
        if not right or table.column(name).null_count:
            raise CFlowError(f"{path} is no flow file: {name} must be {wanted} in every row, got {kind}")
        columns[name] = table.column(name).to_numpy()
    vectors = {
        field: np.stack([columns.pop(f"{name}_t{axis}_m") for axis in _AXES], 1) for name, field in _VECTORS.items()
    }
    return FlowResult(**{name: torch.from_numpy(np.array(values)) for name, values in {**vectors, **columns}.items()})
