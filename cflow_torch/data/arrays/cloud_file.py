"""Read and write files of one point cloud in the format of the suffix: x, y, z in metres, and other columns."""

from __future__ import annotations

import io
import re
from contextlib import suppress
from pathlib import Path
from typing import Any, Mapping, Sequence

import numpy as np
import pyarrow as pa
from pyarrow import feather, parquet

from cflow_torch.data.arrays import cloud_text
from cflow_torch.data.arrays.bin_layout import KITTI_COLUMNS, BinLayout, find_bin_layout
from cflow_torch.data.arrays.pcd import pcd_fields, pcd_viewpoint, pypcd4
from cflow_torch.data.arrays.ply import ply_bytes, ply_fields
from cflow_torch.data.atomic import atomic_file
from cflow_torch.data.column_names import AXES, check_no_poses, default_names, first_coordinate, with_axes
from cflow_torch.data.file_errors import file_errors, shortened
from cflow_torch.data.paths import PathLike, as_path, check_file, is_remote, read_bytes, suffix_of
from cflow_torch.tensors import resolution
from cflow_torch.types import CFlowError, check_array

SUFFIXES = (".npy", ".npz", ".bin", ".pcd", ".ply", ".feather", ".parquet")
"""Suffixes of clouds that are read and written. Texts (`cloud_text.SUFFIXES`), and `.gz` after any, are only read."""
_COARSEST = 1e-3  # metres
_LARGEST_POSE = 16  # numbers of an array that may be a pose
_MOST_CHANNELS = 16  # of an organised cloud, or of one that is transposed; more are the rows of an image
_MOST_COLUMNS = 64  # of a cloud with fewer points than columns; more are those of a cloud that is transposed
TABLES: dict[str, Any] = {  # suffix -> function that reads, and one that writes
    ".feather": (feather.read_table, feather.write_feather),
    ".parquet": (parquet.read_table, parquet.write_table),
}
_WIDER: dict[str, dict[Any, Any]] = {  # suffix -> types that the format lacks, and those that we write
    ".pcd": {np.bool_: np.uint8, np.float16: np.float32},
    ".ply": {np.bool_: np.uint8, np.float16: np.float32, np.int64: np.float64, np.uint64: np.float64},
    ".parquet": {np.float16: np.float32},
}
_CLOUD_KEYS = ("points", "lidar", "xyz", "pc")  # of an .npz file with more than one table


def read_cloud(path: PathLike, bin_columns: int | BinLayout | None = None) -> np.ndarray:
    """Read the positions of a point cloud.

    Args:
        path: file; its suffix tells the format (see Convention).
        bin_columns: numbers per point of a `.bin` file: 4 in KITTI, 5 in nuScenes; None = see `find_bin_layout`. A
            layout is used if the file fits it.

    Returns:
        (N, 3) in the precision of the file: float32 or float64; float16 and integers of up to 16 bits become float32,
        other integers float64. Integers are usually millimetres, which `read_as` converts.

    Convention:
        - `.npy`: (N, 3+) floats, columns x, y, z first; or a structured array with fields x, y, z.
        - `.npz`: arrays x, y, z; or one (N, 3+) array, called points, lidar, xyz or pc if there are several.
        - `.bin`: little-endian float32 or float64, `bin_columns` per point.
        - `.pcd` (extra `clouds`), `.ply`: fields x, y, z.
        - `.feather`, `.parquet`: columns x, y, z; without these names, the first three.
        - `.csv`, `.txt`, `.xyz`, `.pts`, `.asc`: a point per line, see `text_columns`.
        - any of these, compressed, with `.gz` after its suffix.
        Nothing is unpickled. `read_columns` reads the other columns.

    Raises:
        CFlowError: no such file, an unknown suffix, or a file that is truncated or has other contents.
    """
    return read_table(path, bin_columns)[0]


def read_table(path: PathLike, bin_columns: int | BinLayout | None = None) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Read the positions and the other columns of a cloud at once, see `read_cloud` and `read_columns`."""
    path = as_path(path)
    with file_errors(path, _hint(path)):
        fields = _read(path, bin_columns)
        points = np.stack(_positions(fields), axis=1)
        check_array(points, "its cloud", (None, 3), "fiu", "(N,) numbers each for x, y and z, metres")
    precision = np.float64 if np.result_type(points, np.float32) == np.float64 else np.float32
    others = {}
    for name, values in fields.items():
        kind = values.dtype
        if name.lower() not in AXES and values.shape == (len(points),) and kind.kind in "biuf" and kind.itemsize <= 8:
            others[name] = values.astype(kind.newbyteorder("="), copy=False)
    return points.astype(precision, copy=False), others


def read_columns(path: PathLike, bin_columns: int | BinLayout | None = None) -> dict[str, np.ndarray]:
    """Read the other columns of a cloud, name -> (N,) bool, integers or floats as stored; errors as `read_cloud`.

    Columns without a name (`.bin` files, plain arrays) are called column_3, column_4, ... We leave out texts, objects
    and columns of several numbers per point.
    """
    return read_table(path, bin_columns)[1]


def in_single(points: np.ndarray) -> np.ndarray:
    """Return points as float32, unless this type holds them by millimetres only, as in a map's frame."""
    if points.dtype == np.float32:
        return points
    farthest = float(np.abs(points[np.isfinite(points)]).max(initial=0))
    return points if resolution(np.dtype(np.float32), farthest) > _COARSEST else points.astype(np.float32)


def write_cloud(
    path: PathLike,
    points: np.ndarray,
    columns: Mapping[str, np.ndarray] | None = None,
    viewpoint: Sequence[float] | None = None,
) -> None:
    """Write a cloud in the format of the suffix, atomically.

    Args:
        path: file name with one of `SUFFIXES`.
        points: (N, 3) float32 or float64, metres. `.bin` files are always float32, with a reflectance of 0 if there are
            no columns.
        columns: name -> (N,) bool, integers or floats, as `read_columns` returns them. None = only x, y, z.
        viewpoint: of `.pcd` files, x, y, z and quaternion w, x, y, z of the sensor; None = not set.

    Convention:
        `.npy` files with named columns are structured arrays. A type that a format lacks becomes the next larger one:
        bool becomes uint8, float16 float32, and integers of 64 bits become float64 in `.ply`. A character that is not
        allowed in a name becomes "_".

    Raises:
        CFlowError: an unknown suffix, or points or columns of another shape.
    """
    path, points = as_path(path), np.asarray(points)
    named: dict[str, Any] = dict(columns or {})
    suffix = _checked_suffix(path, path.suffix.lower())
    check_array(points, "points", (None, 3), "f", "(N, 3) floats, metres")
    for name, values in named.items():
        check_array(values, f"column {name}", (len(points),), "biuf", f"({len(points)},) numbers, one per point")
    fields = {}
    for name, values in (*zip(AXES, points.T), *named.items()):
        allowed = re.sub("[^!-~]", "_", name) if suffix in (".pcd", ".ply") else name
        fields[allowed] = np.ascontiguousarray(values, _WIDER.get(suffix, {}).get(values.dtype.type, values.dtype))
    if [*AXES, *named] == default_names(3 + len(named)):
        points, named = np.column_stack([points, *named.values()]), {}
    with atomic_file(path) as file:
        if suffix == ".pcd":
            _write_pcd(file, fields, viewpoint)
        elif suffix == ".ply":
            file.write(ply_bytes(fields))
        elif suffix == ".bin":
            table = np.column_stack([points, *named.values()])
            padding = max(0, KITTI_COLUMNS - table.shape[1])
            file.write(np.pad(table, ((0, 0), (0, padding))).astype("<f4").tobytes())
        elif suffix == ".npy":
            kind = np.dtype([(name, values.dtype) for name, values in fields.items()])
            np.save(file, np.rec.fromarrays(list(fields.values()), dtype=kind) if named else points)
        elif suffix == ".npz":
            np.savez(file, points=points, **named)
        else:
            TABLES[suffix][1](pa.table(fields), file)


def copy_rows(source: PathLike, target: PathLike, is_kept: np.ndarray, layout: BinLayout | None = None) -> None:
    """Write some points of a cloud to another file of the same suffix, with names, types and order of its columns.

    Args:
        source, target: files of one of `SUFFIXES`; the source may also end in `.gz`.
        is_kept: (N,) bool, for every point of `source`.
        layout: of `.bin` files; None = see `find_bin_layout`.

    Convention: arrays of another length in `.npz` files are copied as they are. VIEWPOINT of `.pcd` files stays. They
        become binary, and lose fields of several values. `.ply` files become binary, and keep only their vertices,
        without lists.

    Raises:
        CFlowError: the source cannot be read, or has another number of points.
    """
    source, target = as_path(source), as_path(target)
    suffix = _checked_suffix(source, suffix_of(source))
    if target.suffix.lower() != suffix:
        raise CFlowError(f"{target} is not of the format of {source}: give a name that ends in {suffix}")
    with file_errors(source, _hint(source)):
        content = read_bytes(source)
        number = len(_positions(_read(source, layout))[0])
        if number != len(is_kept):
            raise CFlowError(f"it has {number} points, and the mask {len(is_kept)}: give both of one sweep")
    with atomic_file(target) as file:
        if suffix in (".feather", ".parquet"):
            read, write = TABLES[suffix]
            write(read(pa.BufferReader(content), use_threads=False).filter(pa.array(is_kept)), file)
        elif suffix == ".npy":
            np.save(file, _by_rows(np.load(io.BytesIO(content), allow_pickle=False))[is_kept])
        elif suffix == ".npz":
            arrays: Any = _plain_arrays(content).items()
            np.savez(file, **{k: v[is_kept] if v.shape[:1] == is_kept.shape else v for k, v in arrays})
        elif suffix == ".bin":
            file.write(_layout_of(content, layout).rows(content, is_kept))
        elif suffix == ".ply":
            file.write(ply_bytes({name: values[is_kept] for name, values in ply_fields(content).items()}))
        else:
            fields = {name: values[is_kept] for name, values in pcd_fields(content).items()}
            _write_pcd(file, fields, pcd_viewpoint(content))


def _write_pcd(file: Any, fields: Mapping[str, np.ndarray], viewpoint: Any) -> None:
    pcd = pypcd4()
    kinds = [values.dtype for values in fields.values()]
    cloud = pcd.PointCloud.from_points(list(fields.values()), list(fields), kinds)
    if viewpoint is not None:
        cloud.metadata.viewpoint = tuple(map(float, viewpoint))
    cloud.save(file, pcd.Encoding.BINARY)


def _checked_suffix(path: Path, suffix: str, allowed: Sequence[str] = SUFFIXES) -> str:
    if suffix not in allowed:
        raise CFlowError(f"{path} has suffix {suffix!r}; clouds are {', '.join(allowed)}")
    return suffix


def _hint(path: Path) -> str:
    return "pass plain arrays, not pickled objects" if path.suffix.lower() in (".npy", ".npz") else "copy it again"


def _positions(fields: Mapping[str, np.ndarray]) -> list[np.ndarray]:
    if not set(AXES) <= set(fields):
        fields = {name.lower(): values for name, values in fields.items()}  # X, Y, Z
    if not set(AXES) <= set(fields):
        raise CFlowError(f"it has {list(fields)}; it needs x, y, z")
    return [fields[axis] for axis in AXES]


def _read(path: Path, bin_columns: int | BinLayout | None) -> Mapping[str, np.ndarray]:
    """Read all columns by name; those without a name are x, y, z, column_3, ..."""
    suffix = _checked_suffix(path, suffix_of(path), (*SUFFIXES, *cloud_text.SUFFIXES))
    content = read_bytes(path)
    if suffix in cloud_text.SUFFIXES:
        return cloud_text.text_columns(content)
    if suffix in (".pcd", ".ply"):
        return (pcd_fields if suffix == ".pcd" else ply_fields)(content)
    if suffix in (".feather", ".parquet"):
        return _table_columns(TABLES[suffix][0], content)
    if suffix == ".npz":
        return _archive_columns(content)
    if suffix == ".npy":
        return _array_columns(np.load(io.BytesIO(content), allow_pickle=False))
    layout = _layout_of(content, bin_columns)
    if len(content) % layout.step:
        raise CFlowError(
            f"it has {len(content)} bytes, not a multiple of {layout.step} ({layout}): it is truncated, or has another "
            "number of columns (data.bin_columns=4 in KITTI, 5 in nuScenes)"
        )
    return _array_columns(layout.table(content))


def _layout_of(content: bytes, expected: int | BinLayout | None) -> BinLayout:
    if isinstance(expected, BinLayout):
        return expected if expected.fits(content) else find_bin_layout(content)
    return find_bin_layout(content, expected)


def _array_columns(array: np.ndarray) -> dict[str, np.ndarray]:
    array = _by_rows(array)
    if array.dtype.names is not None:
        return {name: array[name] for name in array.dtype.names}
    if not _is_table(array.shape):
        raise CFlowError(f"it has an array of shape {array.shape}; it must be (N, 3+), columns x, y, z first")
    columns = list(array.T)
    columns = columns[first_coordinate(columns) :]
    return dict(zip(default_names(len(columns)), columns))


def names_in_table(path: Path) -> list[str]:
    """Return the names of the columns of a `.feather` or `.parquet` file, without its rows; [] = unknown."""
    if is_remote(path):  # we would copy the whole file
        return []
    with suppress(CFlowError), file_errors(path), open(check_file(path), "rb") as file:
        is_parquet = suffix_of(path) == ".parquet"
        schema = parquet.read_schema(file) if is_parquet else pa.ipc.open_file(file).schema
        return list(schema.names)
    return []


def may_be_cloud(shape: Sequence[int]) -> bool:
    """Test whether an array of numbers may be a cloud by its shape, not an image, a map, or a column of labels."""
    return len(shape) == 3 or _is_transposed(shape) or _is_table(shape)


def _is_table(shape: Sequence[int]) -> bool:
    return len(shape) == 2 and 3 <= shape[1] <= max(_MOST_COLUMNS, shape[0])


def _is_transposed(shape: Sequence[int]) -> bool:
    return len(shape) == 2 and 3 <= shape[0] <= _MOST_CHANNELS and shape[1] > _MOST_COLUMNS


def _by_rows(array: np.ndarray) -> np.ndarray:
    """Return an organised cloud, (H, W), (H, W, C) or (C, H, W), or a transposed one, (C, N), with a row per point."""
    num_axes = 1 if array.dtype.names is not None else 2
    if num_axes == 2 and _is_transposed(array.shape):
        return array.T
    if array.ndim == num_axes + 1 == 3 and 3 <= len(array) <= _MOST_CHANNELS < array.shape[2]:
        array = np.moveaxis(array, 0, -1)
    return array.reshape(-1, *array.shape[-1:][: num_axes - 1]) if array.ndim == num_axes + 1 else array


def _plain_arrays(content: bytes) -> dict[str, np.ndarray]:
    """Read the arrays of an .npz file, organised ones with a row per point. Pickled objects in it stay unread."""
    arrays = {}
    with np.load(io.BytesIO(content), allow_pickle=False) as archive:
        for name in archive.files:
            with suppress(ValueError):
                arrays[name] = archive[name]
    largest = max(arrays.values(), key=lambda array: array.size, default=np.zeros(0))  # the cloud
    grid = largest.shape[:2] if largest.ndim == 3 else None
    return {k: v.reshape(-1, *v.shape[2:]) if v.shape[:2] == grid else v for k, v in arrays.items()}


def _archive_columns(content: bytes) -> dict[str, np.ndarray]:
    """Return the columns of the cloud in an .npz file."""
    arrays = _plain_arrays(content)
    if set(AXES) <= set(arrays):
        return arrays
    tables = {name: array for name, array in arrays.items() if array.ndim == 2 and array.shape[1] >= 3}
    named = [array for name, array in tables.items() if name in _CLOUD_KEYS]
    named = named or [array for array in tables.values() if array.size > _LARGEST_POSE] or list(tables.values())
    if len(named) != 1:
        need = f"x, y, z, or one (N, 3+) array, named {_CLOUD_KEYS[0]} if there are several"
        raise CFlowError(f"it has the arrays {shortened(list(arrays))}; pass plain arrays {need}")
    return {**_array_columns(named[0]), **arrays}


def _table_columns(read: Any, content: bytes) -> dict[str, np.ndarray]:
    table = read(pa.BufferReader(content), use_threads=False)
    table.validate(full=True)
    check_no_poses(table.column_names)
    names = with_axes(table.column_names)
    if not set(AXES) <= set(names):
        begin = first_coordinate([column.to_numpy() for column in table.columns])
        names = [*names[:begin], *AXES, *names[begin + 3 :]][: table.num_columns]
    table = table.rename_columns(names)
    if any(table.column(axis).null_count for axis in AXES if axis in table.column_names):
        raise CFlowError("x, y, z must not have empty entries")
    kinds = (pa.types.is_floating, pa.types.is_integer, pa.types.is_boolean)
    return {
        name: column.to_numpy()
        for name, column in zip(table.column_names, table.columns)
        if any(is_kind(column.type) for is_kind in kinds)
    }
