"""Point clouds in the PCD format, read and written by pypcd4 (extra `clouds`)."""

from __future__ import annotations

import io
from typing import Any, Mapping

import numpy as np

from cflow_torch.data.atomic import atomic_file
from cflow_torch.data.paths import PathLike
from cflow_torch.errors import import_optional


def pcd_fields(content: bytes) -> dict[str, np.ndarray]:
    """Read a `.pcd` file of version 0.7: field -> (N,) array of the stated dtype; another file raises any exception.

    Organised clouds (HEIGHT above 1) are flattened row by row. Padding and fields of several values (COUNT above 1) are
    left out. VIEWPOINT is not applied, so points stay in their stored frame. NaN points stay.
    """
    cloud = _pypcd4().PointCloud.from_fileobj(io.BytesIO(content))
    header, table = cloud.metadata, np.atleast_1d(cloud.pc_data)
    if len(table) != header.width * header.height:
        raise ValueError(f"it has {len(table)} points, but its header states {header.width} x {header.height}")
    # pypcd4 names padding "#...", splits fields of several values, and mixes up those of compressed files.
    names = [name for name, count in zip(header.fields, header.count) if count == 1 and name[0] != "#"]
    # pypcd4 1.4 makes a two-dimensional table of a cloud without points.
    return {name: np.ascontiguousarray(table[name]).reshape(-1) for name in names}


def write_pcd(path: PathLike, fields: Mapping[str, np.ndarray]) -> None:
    """Write a binary cloud, atomically; field name without spaces -> (N,) float32, float64 or integers."""
    pypcd4 = _pypcd4()
    kinds = [values.dtype for values in fields.values()]
    cloud = pypcd4.PointCloud.from_points(list(fields.values()), list(fields), kinds)
    with atomic_file(path) as file:
        cloud.save(file, pypcd4.Encoding.BINARY)


def _pypcd4() -> Any:
    return import_optional("pypcd4", "PCD files need pypcd4: pip install pypcd4")
