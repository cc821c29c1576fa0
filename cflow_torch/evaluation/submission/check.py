"""Is this archive what the leaderboard takes? Every problem, one line each."""

from __future__ import annotations

import json
import zipfile
from functools import partial
from pathlib import Path
from typing import Any, Callable, Mapping, Sequence

import numpy as np

from cflow_torch.data.arrow_file import FeatherFile
from cflow_torch.data.file_errors import file_errors
from cflow_torch.data.json_file import parse_json
from cflow_torch.data.paths import read_bytes
from cflow_torch.evaluation.submission.plan import Frame
from cflow_torch.evaluation.submission.versions import METADATA_FILE, SubmissionVersion
from cflow_torch.types import CFlowError

_DTYPES = {"halffloat": "float16", "float": "float32", "double": "float64"}  # Arrow's names -> NumPy's


def check_submission(path: str | Path, version: SubmissionVersion, expected: Sequence[Frame]) -> list[str]:
    """Compare an archive with what it must hold.

    Args:
        path: zip, or the folder that it is made from.
        version: the format.
        expected: every frame that must be there, and no other.

    Returns:
        All problems, one line each, that names the file and what is wrong; empty if there is none. Nothing is ever
        extracted.

    Convention: order of columns is free. Ground rows are not compared with 0, and values only for being finite: any
        finite flow is a valid submission.
    """
    try:
        files = open_archive(path)
    except CFlowError as error:
        return [str(error)]
    rows = {frame.name: frame.rows for frame in expected}
    if version.metadata is not None:
        rows[METADATA_FILE] = 0
    problems = [f"{name!r}: does not belong into this archive" for name in sorted(set(files) - set(rows))]
    for name in sorted(rows):
        if name in files:
            problems += check_file(name, files[name], rows[name], version)
        else:
            problems.append(f"{name}: missing")
    return problems


def open_archive(path: str | Path) -> dict[str, Callable[[], bytes]]:
    """The files of a zip or folder.

    Args:
        path: the zip or folder. Hidden files of a folder are passed over: an interrupted writer leaves some, and
            `pack` takes none.

    Returns:
        Name -> function that reads the file.

    Raises:
        CFlowError: neither a zip nor a folder.
    """
    path = Path(path)
    if path.is_dir():
        files = {file.relative_to(path): file for file in sorted(path.rglob("*")) if file.is_file()}
        return {
            name.as_posix(): partial(read_bytes, file)
            for name, file in files.items()
            if not any(part.startswith(".") for part in name.parts)
        }
    if not path.is_file():
        raise CFlowError(f"{path} does not exist; give a zip, or the folder that it is made from")
    with file_errors(path):
        archive = zipfile.ZipFile(path)
    return {name: partial(archive.read, name) for name in archive.namelist() if not name.endswith("/")}


def check_file(name: str, read: Callable[[], bytes], rows: int, version: SubmissionVersion) -> list[str]:
    """All problems of one frame's file, or of the metadata.

    Args:
        name: inside of the archive.
        read: gives the contents.
        rows: number of rows that it must have.
        version: the format.
    """
    try:
        with file_errors(name):  # a damaged zip makes zipfile raise nearly anything
            data = read()
            if name == METADATA_FILE:
                problems = _check_metadata(parse_json(data, name), version.metadata or {})
            else:
                problems = _check_frame(FeatherFile(name, data), rows, version)
    except CFlowError as error:
        problems = [f"cannot be read ({' '.join(str(error).split())[:400]})"]
    return [f"{name}: {problem}" for problem in problems]


def _check_frame(file: FeatherFile, rows: int, version: SubmissionVersion) -> list[str]:
    problems = []
    if set(file.names) != set(version.columns):
        problems.append(f"columns are {', '.join(file.names)}, expected {', '.join(version.columns)}")
    if file.num_rows != rows:
        problems.append(f"{file.num_rows} rows, expected {rows}")
    for column, dtypes in version.columns.items():
        if column in file.names:
            problems += _check_values(column, file.read([column]).column(0), dtypes)
    return problems


def _check_values(column: str, values: Any, dtypes: Sequence[str]) -> list[str]:
    dtype = _DTYPES.get(str(values.type), str(values.type))
    if dtype not in dtypes:
        return [f"column {column} is {dtype}, expected {' or '.join(dtypes)}"]
    if values.null_count:
        return [f"column {column} has {values.null_count} empty values"]
    bad = int((~np.isfinite(values.to_numpy())).sum())
    return [f"column {column} has {bad} values that are NaN or infinite"] if bad else []


def _check_metadata(values: Any, required: Mapping[str, Any]) -> list[str]:
    return [
        f"must hold {json.dumps(key)} as true or false"
        for key, value in required.items()
        if not isinstance(values, dict) or not isinstance(values.get(key), type(value))
    ]
