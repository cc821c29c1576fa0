"""Submission formats, versions 1 and 3: encode a flow as a file, and write, zip and check files.

Files are written whole or not at all. The same files give the same bytes (with the same zlib).
"""

from __future__ import annotations

import zipfile
from functools import partial
from pathlib import Path
from typing import Any, Callable, Iterable, Mapping, NamedTuple

import numpy as np
import pyarrow as pa
from pyarrow import feather

from cflow_torch.data.arrow_file import FeatherFile
from cflow_torch.data.atomic import atomic_file
from cflow_torch.data.file_errors import file_errors, shortened
from cflow_torch.data.paths import read_bytes
from cflow_torch.types import Array, CFlowError, FlowResult, as_numpy, vector_columns

DYNAMIC_THRESHOLD = 0.05  # metres per sweep, the evaluation's threshold for dynamic points
LARGEST = float(np.finfo(np.float16).max)  # 65504 m
_FLOW = dict.fromkeys(vector_columns("flow"), "float16")
_EARLIEST = (1980, 1, 1, 0, 0, 0)  # the first time that a zip can store


class SubmissionVersion(NamedTuple):
    """One submission format."""

    number: int  # 1 or 3, as OpenSceneFlow numbers them
    server: str  # the leaderboard that accepts it
    columns: Mapping[str, str]  # column -> dtype, in order
    # True: total flow (ego motion included) of the points of the evaluation mask, in the order of the mask. False:
    # residual flow (motion of objects alone) of every point of the sweep.
    is_masked: bool


VERSIONS: dict[int, SubmissionVersion] = {
    1: SubmissionVersion(
        1, "Argoverse 2 scene flow 2023 (EvalAI challenge 2010, phase 4018)", {**_FLOW, "is_dynamic": "bool"}, True
    ),
    3: SubmissionVersion(3, "multi-dataset challenge 2026 (sceneflow.argoverse.org)", _FLOW, False),
}


def get_version(number: Any) -> SubmissionVersion:
    """Return the format of this number; if there is none, raise a `CFlowError`."""
    if number not in VERSIONS:
        closed = "; version 2 (Argoverse 2, 2024) is closed and was removed" if number == 2 else ""
        raise CFlowError(f"version={number!r}: give one of {', '.join(map(str, VERSIONS))}{closed}")
    return VERSIONS[number]


def encode(
    version: SubmissionVersion, result: FlowResult, is_ground: Array | None = None, mask: np.ndarray | None = None
) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """Convert the flow of one frame to the columns of its file; also return the (M,) float64 rounding errors, metres.

    Args:
        version: the format.
        result: flow of the N points of sweep t; values that are NaN, infinite or beyond float16 are a `CFlowError`.
        is_ground: (N,) bool, True = ground; None = no point is ground.
        mask: (N,) bool, the points to write if the version has a mask; None for other versions.

    Convention:
        The flow is float16 metres until the next sweep. A residual flow is in the axes of t+1, as OpenSceneFlow writes
        it, and 0 for ground points. `is_dynamic` is True where the unrounded residual is 0.05 m or longer.
    """
    residual = as_numpy(result.residual_flow).astype(np.float32)
    if mask is not None:
        keep = np.asarray(mask, dtype=bool)
        residual = residual[keep]
        flow = as_numpy(result.flow)[keep]
    else:
        flow = residual if is_ground is None else np.where(as_numpy(is_ground)[:, None], np.float32(0), residual)
    bad = ~(np.abs(flow) <= LARGEST).all(axis=1)
    if bad.any():
        raise CFlowError(f"the flow of {bad.sum()} points is NaN, infinite or beyond float16 ({LARGEST:g} m)")
    half = flow.astype(np.float16)
    error = np.linalg.norm(half.astype(np.float64) - flow.astype(np.float64), axis=1)
    is_dynamic = np.linalg.norm(residual, axis=1) >= np.float32(DYNAMIC_THRESHOLD)
    columns = {**dict(zip(_FLOW, half.T)), "is_dynamic": is_dynamic}
    return {name: columns[name] for name in version.columns}, error


def write_frame(folder: str | Path, name: str, columns: Mapping[str, np.ndarray]) -> None:
    """Write the columns of one frame atomically to a submission folder; `name` is `<log>/<time stamp>.feather`."""
    with atomic_file(Path(folder) / name) as file:
        feather.write_feather(pa.table(dict(columns)), file)


def is_complete(folder: str | Path, name: str, rows: int, version: SubmissionVersion) -> bool:
    """Return whether the file of a frame exists, has this number of rows, and passes `check_submission`."""
    return not _check_file(name, partial(read_bytes, Path(folder) / name), rows, version)


def write_zip(folder: str | Path, names: Iterable[str], file: str | Path) -> None:
    """Zip the named files of a submission folder, atomically. If one is missing, no zip is written.

    Entries are sorted by name, dated 1980-01-01, mode 0644, deflated. So the same files and the same zlib give the same
    bytes.
    """
    with atomic_file(file) as raw, zipfile.ZipFile(raw, "w", zipfile.ZIP_DEFLATED) as archive:
        for name in sorted(set(names)):
            entry = zipfile.ZipInfo(name, _EARLIEST)
            entry.compress_type = zipfile.ZIP_DEFLATED
            entry.create_system = 3
            entry.external_attr = 0o100644 << 16
            archive.writestr(entry, (Path(folder) / name).read_bytes())


def check_submission(path: str | Path, version: SubmissionVersion, expected: Mapping[str, int]) -> list[str]:
    """Check an archive and return all problems, one line each. Nothing is extracted.

    Args:
        path: a zip, or the folder that it is made from. Hidden files of a folder are skipped, because an interrupted
            writer leaves some and `write_zip` leaves them out.
        version: the format.
        expected: name -> number of rows of each file. The archive must contain exactly these files.

    Convention: the order of columns is free. Values are only checked for being finite. Ground rows are not compared
        with 0, because any finite flow is a valid submission.
    """
    try:
        files = _open_archive(Path(path))
    except CFlowError as error:
        return [str(error)]
    problems = [f"{name!r}: does not belong in this archive" for name in sorted(set(files) - set(expected))]
    for name, rows in sorted(expected.items()):
        problems += _check_file(name, files[name], rows, version) if name in files else [f"{name}: missing"]
    return problems


def _open_archive(path: Path) -> dict[str, Callable[[], bytes]]:
    """Return name -> function that reads the file, of a zip or a folder."""
    if path.is_dir():
        names = [file.relative_to(path) for file in path.rglob("*") if file.is_file()]
        visible = [name for name in names if not any(part.startswith(".") for part in name.parts)]
        return {name.as_posix(): partial(read_bytes, path / name) for name in visible}
    with file_errors(path, "give a zip, or the folder that it is made from"):
        archive = zipfile.ZipFile(path)
    return {name: partial(archive.read, name) for name in archive.namelist() if not name.endswith("/")}


def _check_file(name: str, read: Callable[[], bytes], rows: int, version: SubmissionVersion) -> list[str]:
    """List all problems of the file of one frame, one line each."""
    try:
        with file_errors(name):  # a damaged zip makes zipfile raise nearly anything
            file = FeatherFile(name, read())
            columns = {each: file.table.column(each) for each in version.columns if each in file.names}
            dtypes = {each: np.dtype(column.type.to_pandas_dtype()) for each, column in columns.items()}
    except CFlowError as error:
        return [f"{name}: cannot be read ({shortened(error)})"]
    problems = []
    if set(file.names) != set(version.columns):
        problems.append(f"columns are {', '.join(file.names)}, expected {', '.join(version.columns)}")
    if file.num_rows != rows:
        problems.append(f"{file.num_rows} rows, expected {rows}")
    for column, values in columns.items():
        if dtypes[column] != version.columns[column]:
            problems.append(f"column {column} is {dtypes[column]}, expected {version.columns[column]}")
        elif values.null_count:
            problems.append(f"column {column} has {values.null_count} empty values")
        elif not np.isfinite(values.to_numpy()).all():
            bad = int((~np.isfinite(values.to_numpy())).sum())
            problems.append(f"column {column} has {bad} values that are NaN or infinite")
    return [f"{name}: {problem}" for problem in problems]
