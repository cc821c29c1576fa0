"""Point clouds in one file each, in the format of the suffix; only x, y, z in metres are read."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Mapping

import numpy as np
import pyarrow as pa
from pyarrow import feather, parquet

from cflow_torch.data.arrays.pcd import read_pcd, write_pcd
from cflow_torch.data.arrays.ply import read_ply, write_ply
from cflow_torch.data.atomic import atomic_file
from cflow_torch.data.files import file_errors, read_npy
from cflow_torch.data.paths import PathLike, as_path, read_bytes
from cflow_torch.types import CFlowError

SUFFIXES = (".npy", ".npz", ".bin", ".pcd", ".ply", ".feather", ".parquet")
KITTI_COLUMNS = 4  # x, y, z, reflectance
_AXES = ("x", "y", "z")
_CLOUD_KEYS = ("points", "lidar", "xyz", "pc")  # of an .npz file with more than one table


def read_cloud(path: PathLike, bin_columns: int = KITTI_COLUMNS) -> np.ndarray:
    """Read the positions of a point cloud.

    Args:
        path: the file; its suffix tells the format (see Convention).
        bin_columns: float32 numbers per point of a `.bin` file: 4 in KITTI, 5 in nuScenes.

    Returns:
        (N, 3) in the precision of the file: float32 or float64; float16 becomes float32.

    Convention:
        - `.npy`: (N, 3+) floats, columns x, y, z first; or a structured array with fields x, y, z.
        - `.npz`: arrays x, y, z; or one (N, 3+) array, called points, lidar, xyz or pc if there are several.
        - `.bin`: little-endian float32, `bin_columns` per point.
        - `.pcd` (extra `clouds`), `.ply`: fields x, y, z.
        - `.feather`, `.parquet`: columns x, y, z; without these names, the first three.
        Everything else in the file is ignored. Nothing is unpickled.

    Raises:
        CFlowError: no such file, an unknown suffix, or a file that is truncated or has other contents.
    """
    path = as_path(path)
    suffix = path.suffix.lower()
    if suffix not in SUFFIXES:
        raise CFlowError(f"{path} has suffix {suffix!r}; clouds are {', '.join(SUFFIXES)}")
    if suffix == ".bin":
        points = _read_bin(path, bin_columns)
    elif suffix in (".pcd", ".ply"):
        points = _from_fields(path, (read_pcd if suffix == ".pcd" else read_ply)(path))
    elif suffix in (".feather", ".parquet"):
        points = _read_table(path)
    else:
        points = _read_numpy(path)
    if points.dtype.kind != "f":
        raise CFlowError(f"{path} has {points.dtype} coordinates; they must be floating-point metres")
    points = points[:, :3].astype(np.float32 if points.dtype.itemsize < 8 else np.float64, copy=False)
    return points.astype(points.dtype.newbyteorder("="), copy=False)


def write_cloud(path: PathLike, points: np.ndarray) -> None:
    """Write a cloud in the format of the suffix, atomically.

    Args:
        path: file name with one of `SUFFIXES`.
        points: (N, 3) float32 or float64, metres. `.bin` files are always float32, with a reflectance of 0.

    Raises:
        CFlowError: an unknown suffix, or points of another shape.
    """
    path, points = as_path(path), np.asarray(points)
    suffix = path.suffix.lower()
    if suffix not in SUFFIXES:
        raise CFlowError(f"{path} has suffix {suffix!r}; clouds are {', '.join(SUFFIXES)}")
    if points.ndim != 2 or points.shape[1] != 3 or points.dtype not in (np.float32, np.float64):
        raise CFlowError(f"points have shape {points.shape} and dtype {points.dtype}; pass (N, 3) float32 or float64")
    fields = {axis: np.ascontiguousarray(points[:, k]) for k, axis in enumerate(_AXES)}
    if suffix in (".pcd", ".ply"):
        (write_pcd if suffix == ".pcd" else write_ply)(path, fields)
        return
    with atomic_file(path) as file:
        if suffix == ".bin":
            file.write(np.pad(points, ((0, 0), (0, 1))).astype("<f4").tobytes())
        elif suffix == ".npy":
            np.save(file, points)
        elif suffix == ".npz":
            np.savez(file, points=points)
        else:
            (feather.write_feather if suffix == ".feather" else parquet.write_table)(pa.table(fields), file)


def _read_bin(path: Path, columns: int) -> np.ndarray:
    with file_errors(path):
        data = read_bytes(path)
    if len(data) % (4 * columns):
        raise CFlowError(
            f"{path} has {len(data)} bytes, not a multiple of {4 * columns} ({columns} float32 per point): it is "
            "truncated, or has another number of columns (bin_columns: 4 in KITTI, 5 in nuScenes)"
        )
    return np.frombuffer(data, "<f4").reshape(-1, columns)


def _read_numpy(path: Path) -> np.ndarray:
    hint = "pass plain arrays, not pickled objects"
    if path.suffix.lower() == ".npz":
        with file_errors(path, hint), np.load(io.BytesIO(read_bytes(path)), allow_pickle=False) as arrays:
            if all(axis in arrays.files for axis in _AXES):
                return _from_fields(path, {axis: arrays[axis] for axis in _AXES})
            named = [name for name in arrays.files if name in _CLOUD_KEYS]
            found = [arrays[name] for name in named or arrays.files]
            tables = [array for array in found if array.ndim == 2 and array.shape[1] >= 3]
            if len(tables) != 1:
                has = ", ".join(arrays.files)[:200]
                need = f"x, y, z, or one (N, 3+) array, named {_CLOUD_KEYS[0]} if there are several"
                raise CFlowError(f"{path} has the arrays {has}; it needs {need}")
        (stored,) = tables
    else:
        stored = read_npy(path, hint)
    if stored.dtype.names is not None:
        return _from_fields(path, {name: stored[name] for name in stored.dtype.names})
    if stored.ndim != 2 or stored.shape[1] < 3:
        raise CFlowError(f"{path} has an array of shape {stored.shape}; it must be (N, 3+), columns x, y, z first")
    return stored


def _read_table(path: Path) -> np.ndarray:
    read = feather.read_table if path.suffix.lower() == ".feather" else parquet.read_table
    with file_errors(path):
        table = read(pa.BufferReader(read_bytes(path)), use_threads=False)
        table.validate(full=True)
    names = table.column_names
    chosen = _AXES if all(axis in names for axis in _AXES) else tuple(names[:3])
    columns = [table.column(names.index(name)) for name in chosen]
    if len(columns) < 3:
        raise CFlowError(f"{path} has the columns {names}; it needs x, y, z")
    if any(not pa.types.is_floating(column.type) or column.null_count for column in columns):
        raise CFlowError(f"{path}: {', '.join(chosen)} must be floating-point metres without empty entries")
    return np.stack([column.to_numpy() for column in columns], axis=1)


def _from_fields(path: Path, fields: Mapping[str, np.ndarray]) -> np.ndarray:
    columns = [fields[axis] for axis in _AXES if axis in fields]
    if len(columns) < 3:
        raise CFlowError(f"{path} has the fields {list(fields)}; it needs x, y, z")
    if len({column.shape for column in columns}) > 1 or columns[0].ndim != 1:
        raise CFlowError(f"{path}: x, y, z have shapes {[column.shape for column in columns]}; each must be (N,)")
    if any(column.dtype.kind not in "fiu" for column in columns):
        raise CFlowError(f"{path}: x, y, z have dtypes {[str(column.dtype) for column in columns]}, not numbers")
    return np.stack(columns, axis=1)
