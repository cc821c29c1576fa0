"""One flow result per file: feather columns, rows in the order of sweep t."""

from __future__ import annotations

import numpy as np
import pyarrow as pa
import torch
from pyarrow import feather

from cflow_torch.data.atomic import atomic_file
from cflow_torch.data.paths import Place, as_path, whole
from cflow_torch.types import CFlowError, FlowResult

_VECTORS = {"flow": "flow", "residual_flow": "residual", "pose_flow": "pose"}
_AXES = "xyz"


def write_flow(path: Place, result: FlowResult) -> None:
    """Write a result to `path`, atomically.

    Args:
        path: file name, by convention `<log id>/<time stamp of sweep t>.feather`.
        result: flow of one window.

    Convention:
        Columns flow_t{x,y,z}_m (total), residual_t{x,y,z}_m, pose_t{x,y,z}_m float32 in metres and in the axes of
        ego1, cluster_id int64, score float32, is_valid bool.
    """
    arrays = result.numpy()
    columns = {
        f"{name}_t{axis}_m": arrays[field][:, i] for field, name in _VECTORS.items() for i, axis in enumerate(_AXES)
    }
    columns.update({name: arrays[name] for name in ("cluster_id", "score", "is_valid")})
    with atomic_file(path) as file:
        feather.write_feather(pa.table({name: pa.array(values) for name, values in columns.items()}), file)


def read_flow(path: Place) -> FlowResult:
    """Read what `write_flow` wrote.

    Raises:
        CFlowError: the file is missing, cannot be reached, is truncated, or lacks a column.
    """
    try:
        table = feather.read_table(whole(as_path(path)), memory_map=False)
        vectors = {
            field: np.stack([table[f"{name}_t{axis}_m"].to_numpy() for axis in _AXES], 1)
            for field, name in _VECTORS.items()
        }
        scalars = {name: table[name].to_numpy() for name in ("cluster_id", "score", "is_valid")}
    except (OSError, pa.ArrowException, KeyError) as error:
        raise CFlowError(f"{path} is no flow file ({error}): give a file that `cflow flow` wrote") from error
    return FlowResult(**{name: torch.from_numpy(np.array(values)) for name, values in {**vectors, **scalars}.items()})
