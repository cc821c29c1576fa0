"""Files of a submission: written whole or not at all, packed into the same bytes every time, and checked."""

from __future__ import annotations

import zipfile
from functools import partial
from pathlib import Path
from typing import Any, Callable, Iterable, Mapping

import numpy as np
import pyarrow as pa
from pyarrow import feather

from cflow_torch.data.arrow_file import FeatherFile
from cflow_torch.data.atomic import atomic_file
from cflow_torch.data.files import file_errors, shortened
from cflow_torch.data.names import safe_name
from cflow_torch.data.paths import read_bytes
from cflow_torch.evaluation.submission.formats import SubmissionVersion
from cflow_torch.types import CFlowError

_EARLIEST = (1980, 1, 1, 0, 0, 0)  # the first time that a zip can store
_DTYPES = {"halffloat": "float16", "float": "float32", "double": "float64"}  # Arrow's names -> NumPy's


def write_frame(folder: str | Path, name: str, columns: Mapping[str, np.ndarray]) -> None:
    """Write the file of one frame atomically.

    Args:
        folder: root of the submission.
        name: inside the archive, `<log>/<time stamp>.feather`.
        columns: what `encode` returned.

    Raises:
        CFlowError: the log's name cannot be a folder's.
    """
    log_id, _, stem = name.rpartition("/")
    file = Path(folder) / safe_name(log_id, "the log") / stem
    table = pa.table({key: pa.array(values) for key, values in columns.items()})
    with atomic_file(file) as stream:
        feather.write_feather(table, stream)


def is_complete(folder: str | Path, name: str, rows: int, version: SubmissionVersion) -> bool:
    """Check that the file of a frame exists already, has this number of rows, and passes every other check."""
    return not _check_file(name, partial(read_bytes, Path(folder) / name), rows, version)


def pack(folder: str | Path, names: Iterable[str], file: str | Path) -> None:
    """Zip the files of a submission folder, atomically.

    Args:
        folder: root of the submission.
        names: frames to take.
        file: the zip to write.

    Convention: entries are sorted by name, dated 1980-01-01, mode 0644, deflated. So the same files and the same zlib
        give the same bytes.

    Raises:
        OSError: a file is missing. No zip is written then.
    """
    with atomic_file(file) as raw, zipfile.ZipFile(raw, "w", zipfile.ZIP_DEFLATED) as archive:
        for name in sorted(set(names)):
            entry = zipfile.ZipInfo(name, _EARLIEST)
            entry.compress_type = zipfile.ZIP_DEFLATED
            entry.create_system, entry.external_attr = 3, 0o100644 << 16
            archive.writestr(entry, (Path(folder) / name).read_bytes())


def check_submission(path: str | Path, version: SubmissionVersion, expected: Mapping[str, int]) -> list[str]:
    """Compare an archive with what it must contain. Nothing is extracted.

    Args:
        path: a zip, or the folder that it is made from. Hidden files of a folder are skipped: an interrupted writer
            leaves some, and `pack` takes none.
        version: the format.
        expected: name -> number of rows of every file that the archive must contain. It may contain no other.

    Returns:
        All problems, one line each, with the name of the file and what is wrong; empty if there are none.

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
    """Name -> function that reads the file, of a zip or a folder."""
    if path.is_dir():
        files = {file.relative_to(path): file for file in sorted(path.rglob("*")) if file.is_file()}
        return {
            name.as_posix(): partial(read_bytes, file)
            for name, file in files.items()
            if not any(folder.startswith(".") for folder in name.parts)
        }
    if not path.is_file():
        raise CFlowError(f"{path} does not exist: give a zip, or the folder that it is made from")
    with file_errors(path):
        archive = zipfile.ZipFile(path)
    return {name: partial(archive.read, name) for name in archive.namelist() if not name.endswith("/")}


def _check_file(name: str, read: Callable[[], bytes], rows: int, version: SubmissionVersion) -> list[str]:
    """All problems of the file of one frame, one line each."""
    try:
        with file_errors(name):  # a damaged zip makes zipfile raise nearly anything
            problems = _check_table(FeatherFile(name, read()), rows, version)
    except CFlowError as error:
        problems = [f"cannot be read ({shortened(error)})"]
    return [f"{name}: {problem}" for problem in problems]


def _check_table(file: FeatherFile, rows: int, version: SubmissionVersion) -> list[str]:
    problems = []
    if set(file.names) != set(version.columns):
        problems.append(f"columns are {', '.join(file.names)}, expected {', '.join(version.columns)}")
    if file.num_rows != rows:
        problems.append(f"{file.num_rows} rows, expected {rows}")
    for column, dtype in version.columns.items():
        if column in file.names:
            problems += _check_values(column, file.read([column]).column(0), dtype)
    return problems


def _check_values(column: str, values: Any, expected: str) -> list[str]:
    dtype = _DTYPES.get(str(values.type), str(values.type))
    if dtype != expected:
        return [f"column {column} is {dtype}, expected {expected}"]
    if values.null_count:
        return [f"column {column} has {values.null_count} empty values"]
    bad = int((~np.isfinite(values.to_numpy())).sum())
    return [f"column {column} has {bad} values that are NaN or infinite"] if bad else []
