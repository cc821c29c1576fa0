"""Point clouds in one file each, in the format of the suffix: x, y, z in metres, and other columns on request."""

from __future__ import annotations

import io
import re
from pathlib import Path
from typing import Any, Mapping

import numpy as np
import pyarrow as pa
from pyarrow import feather, parquet

from cflow_torch.data.arrays.pcd import read_pcd, write_pcd
from cflow_torch.data.arrays.ply import read_ply, write_ply
from cflow_torch.data.atomic import atomic_file
from cflow_torch.data.files import file_errors, read_npy
from cflow_torch.data.paths import PathLike, as_path, read_bytes
from cflow_torch.types import CFlowError, check_array

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
        Nothing is unpickled. `read_columns` reads the other columns.

    Raises:
        CFlowError: no such file, an unknown suffix, or a file that is truncated or has other contents.
    """
    path = as_path(path)
    points, _ = _read(path, bin_columns, False)
    if points.dtype.kind != "f":
        raise CFlowError(f"{path} has {points.dtype} coordinates; they must be floating-point metres")
    points = points[:, :3].astype(np.float32 if points.dtype.itemsize < 8 else np.float64, copy=False)
    return points.astype(points.dtype.newbyteorder("="), copy=False)


def read_columns(path: PathLike, bin_columns: int = KITTI_COLUMNS) -> dict[str, np.ndarray]:
    """Read the other columns of a point cloud, such as intensity, ring and time.

    Args:
        path: a file that `read_cloud` reads.
        bin_columns: as in `read_cloud`.

    Returns:
        Name -> (N,) bool, integers or floats as stored. Columns without a name, those of `.bin` files and of plain
        arrays, are called column_3, column_4, ...

    Convention:
        Texts, objects and columns of several numbers per point are left out.

    Raises:
        CFlowError: as in `read_cloud`.
    """
    points, columns = _read(as_path(path), bin_columns, True)
    kept = {}
    for name, values in columns.items():
        kind = values.dtype
        if name not in _AXES and values.shape == (len(points),) and kind.kind in "biuf" and kind.itemsize <= 8:
            kept[name] = values.astype(kind.newbyteorder("="), copy=False)
    return kept


def write_cloud(path: PathLike, points: np.ndarray, columns: Mapping[str, np.ndarray] | None = None) -> None:
    """Write a cloud in the format of the suffix, atomically.

    Args:
        path: file name with one of `SUFFIXES`.
        points: (N, 3) float32 or float64, metres. `.bin` files are always float32, with a reflectance of 0 if there are
            no columns.
        columns: name -> (N,) bool, integers or floats, as `read_columns` returns them. None = only x, y, z.

    Convention:
        `.npy` files with named columns are structured arrays. A type that a format lacks becomes the next larger one:
        bool becomes uint8, float16 float32, and integers of 64 bits become float64 in `.ply`. A character that is not
        allowed in a name becomes "_".

    Raises:
        CFlowError: an unknown suffix, or points or columns of another shape.
    """
    path, points = as_path(path), np.asarray(points)
    named: dict[str, Any] = dict(columns or {})
    suffix = path.suffix.lower()
    if suffix not in SUFFIXES:
        raise CFlowError(f"{path} has suffix {suffix!r}; clouds are {', '.join(SUFFIXES)}")
    if points.ndim != 2 or points.shape[1] != 3 or points.dtype not in (np.float32, np.float64):
        raise CFlowError(f"points have shape {points.shape} and dtype {points.dtype}; pass (N, 3) float32 or float64")
    for name, values in named.items():
        check_array(values, f"column {name}", (len(points),), "biuf", f"({len(points)},) numbers, one per point")
    fields = {axis: np.ascontiguousarray(points[:, k]) for k, axis in enumerate(_AXES)}
    fields.update({_storable_name(name, suffix): _storable(values, suffix) for name, values in named.items()})
    if list(named) == _unnamed(3 + len(named)):
        points, named = np.column_stack([points, *named.values()]), {}
    if suffix in (".pcd", ".ply"):
        (write_pcd if suffix == ".pcd" else write_ply)(path, fields)
        return
    with atomic_file(path) as file:
        if suffix == ".bin":
            table = np.column_stack([points, *named.values()])
            padding = max(0, KITTI_COLUMNS - table.shape[1])
            file.write(np.pad(table, ((0, 0), (0, padding))).astype("<f4").tobytes())
        elif suffix == ".npy":
            np.save(file, _structured(fields) if named else points)
        elif suffix == ".npz":
            np.savez(file, points=points, **named)
        else:
            (feather.write_feather if suffix == ".feather" else parquet.write_table)(pa.table(fields), file)


def _read(path: Path, bin_columns: int, with_columns: bool) -> tuple[np.ndarray, Mapping[str, np.ndarray]]:
    """Return (N, 3) positions and all columns by name, if they are wanted, else any of them."""
    suffix = path.suffix.lower()
    if suffix not in SUFFIXES:
        raise CFlowError(f"{path} has suffix {suffix!r}; clouds are {', '.join(SUFFIXES)}")
    if suffix == ".bin":
        return _split(_read_bin(path, bin_columns))
    if suffix in (".pcd", ".ply"):
        return _from_fields(path, (read_pcd if suffix == ".pcd" else read_ply)(path))
    if suffix in (".feather", ".parquet"):
        return _read_table(path, with_columns)
    return _read_numpy(path, with_columns)


def _unnamed(count: int) -> list[str]:
    """Names of the columns after z of an array without names, which has `count` columns."""
    return [f"column_{k}" for k in range(3, count)]


def _split(table: np.ndarray) -> tuple[np.ndarray, Mapping[str, np.ndarray]]:
    return table[:, :3], dict(zip(_unnamed(table.shape[1]), table.T[3:]))


def _structured(fields: Mapping[str, np.ndarray]) -> np.ndarray:
    """(N,) structured array of the fields."""
    table = np.zeros(len(fields["x"]), [(name, values.dtype) for name, values in fields.items()])
    for name, values in fields.items():
        table[name] = values
    return table


def _storable_name(name: str, suffix: str) -> str:
    return re.sub("[^!-~]", "_", name) if suffix in (".pcd", ".ply") else name


def _storable(values: np.ndarray, suffix: str) -> np.ndarray:
    """The values in a type that the format has."""
    kind: Any = values.dtype
    if suffix in (".pcd", ".ply") and kind == np.bool_:
        kind = np.uint8
    elif suffix in (".pcd", ".ply", ".parquet") and kind == np.float16:
        kind = np.float32
    elif suffix == ".ply" and kind in (np.int64, np.uint64):
        kind = np.float64
    return np.ascontiguousarray(values, kind)


def _read_bin(path: Path, columns: int) -> np.ndarray:
    with file_errors(path):
        data = read_bytes(path)
    if len(data) % (4 * columns):
        raise CFlowError(
            f"{path} has {len(data)} bytes, not a multiple of {4 * columns} ({columns} float32 per point): it is "
            "truncated, or has another number of columns (bin_columns: 4 in KITTI, 5 in nuScenes)"
        )
    return np.frombuffer(data, "<f4").reshape(-1, columns)


def _read_numpy(path: Path, with_columns: bool) -> tuple[np.ndarray, Mapping[str, np.ndarray]]:
    hint = "pass plain arrays, not pickled objects"
    others: dict[str, np.ndarray] = {}
    if path.suffix.lower() == ".npz":
        with file_errors(path, hint), np.load(io.BytesIO(read_bytes(path)), allow_pickle=False) as arrays:
            if with_columns:
                others = _readable(arrays)
            if all(axis in arrays.files for axis in _AXES):
                return _from_fields(path, {**others, **{axis: arrays[axis] for axis in _AXES}})
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
    points, columns = _split(stored)
    return points, {**columns, **others}


def _readable(arrays: Any) -> dict[str, np.ndarray]:
    """The arrays of an .npz file that are not pickled objects, which may be next to the points."""
    found = {}
    for name in arrays.files:
        try:
            found[name] = arrays[name]
        except ValueError:
            continue
    return found


def _read_table(path: Path, with_columns: bool) -> tuple[np.ndarray, Mapping[str, np.ndarray]]:
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
    others = [name for name in names if with_columns and name not in chosen and _is_number(table.field(name).type)]
    return np.stack([column.to_numpy() for column in columns], axis=1), {
        name: table.column(name).to_numpy() for name in others
    }


def _is_number(kind: Any) -> bool:
    return bool(pa.types.is_floating(kind) or pa.types.is_integer(kind) or pa.types.is_boolean(kind))


def _from_fields(path: Path, fields: Mapping[str, np.ndarray]) -> tuple[np.ndarray, Mapping[str, np.ndarray]]:
    columns = [fields[axis] for axis in _AXES if axis in fields]
    if len(columns) < 3:
        raise CFlowError(f"{path} has the fields {list(fields)}; it needs x, y, z")
    if len({column.shape for column in columns}) > 1 or columns[0].ndim != 1:
        raise CFlowError(f"{path}: x, y, z have shapes {[column.shape for column in columns]}; each must be (N,)")
    if any(column.dtype.kind not in "fiu" for column in columns):
        raise CFlowError(f"{path}: x, y, z have dtypes {[str(column.dtype) for column in columns]}, not numbers")
    return np.stack(columns, axis=1), fields
