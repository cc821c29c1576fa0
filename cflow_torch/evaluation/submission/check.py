"""Is this archive what the leaderboard takes? Every problem, one line each."""

from __future__ import annotations

import json
from collections import Counter
from pathlib import Path
from typing import Any, Dict, List, Mapping, Sequence, Set, Union

import numpy as np

from cflow_torch.data.arrow_file import shortened
from cflow_torch.data.feather_file import FeatherFile
from cflow_torch.data.json_file import parse_json
from cflow_torch.evaluation.submission.archive import Contents
from cflow_torch.evaluation.submission.plan import Frame
from cflow_torch.evaluation.submission.versions import METADATA_FILE, SubmissionVersion
from cflow_torch.types import CFlowError

_DTYPES = {"halffloat": "float16", "float": "float32", "double": "float64"}  # Arrow's names -> NumPy's


def check_submission(path: Union[str, Path], version: SubmissionVersion, expected: Sequence[Frame]) -> List[str]:
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
        contents = Contents(path)
    except CFlowError as error:
        return [str(error)]
    try:
        return _check(contents, version, {frame.name: frame.rows for frame in expected})
    finally:
        contents.close()


def check_file(name: str, data: bytes, rows: int, version: SubmissionVersion) -> List[str]:
    """All problems of one frame's file.

    Args:
        name: to begin each line with.
        data: contents of the file.
        rows: that it must have.
        version: the format.
    """
    try:
        file = FeatherFile(name, data)
    except CFlowError as error:
        return [f"{name}: no feather file ({_one_line(error)})"]
    problems = []
    present = [column for column in version.columns if column in file.names]
    missing = [column for column in version.columns if column not in file.names]
    foreign = [column for column in file.names if column not in version.columns]
    twice = [column for column, count in Counter(file.names).items() if count > 1]
    if missing:
        problems.append(f"{name}: column {', '.join(missing)} is missing, it has {shortened(', '.join(file.names))}")
    if foreign:
        foreign_names, allowed = shortened(", ".join(foreign)), ", ".join(version.columns)
        problems.append(f"{name}: column {foreign_names} does not belong, allowed: {allowed}")
    if twice:
        return [*problems, f"{name}: column {shortened(', '.join(twice))} occurs more than once"]
    if file.num_rows != rows:
        of = "points of the evaluation mask" if version.rows == "masked" else "points of the sweep"
        problems.append(f"{name}: {file.num_rows} rows, expected {rows} ({of})")
    try:
        columns = {column: file.read([column]).column(0) for column in present}
    except CFlowError as error:
        return [*problems, f"{name}: no feather file ({_one_line(error)})"]
    for column, values in columns.items():
        dtypes = version.columns[column]
        dtype = _DTYPES.get(str(values.type), str(values.type))
        if dtype not in dtypes:
            problems.append(f"{name}: column {column} is {dtype}, expected {' or '.join(dtypes)}")
        elif values.null_count:
            problems.append(f"{name}: column {column} has {values.null_count} empty values")
        elif dtype != "bool":
            bad = int((~np.isfinite(values.to_numpy())).sum())
            if bad:
                problems.append(f"{name}: column {column} has {bad} values that are NaN or infinite")
    return problems


def _check(contents: Contents, version: SubmissionVersion, expected: Dict[str, int]) -> List[str]:
    allowed = {*expected, *([METADATA_FILE] if version.metadata is not None else [])}
    prefix = _wrapper(contents.names, allowed)
    problems = (
        [f"everything lies in a folder {prefix!r}: zip what is inside it, not the folder itself"] if prefix else []
    )
    names = [name[len(prefix) :] for name in contents.names]
    problems += [f"{name!r}: occurs {count} times in the zip" for name, count in Counter(names).items() if count > 1]
    logs = {name.rpartition("/")[0] for name in expected}
    problems += [_foreign(name, version, logs) for name in sorted(set(names) - allowed)]
    present = set(names)
    for name in sorted(expected):
        if name not in present:
            problems.append(f"{name}: missing frame")
            continue
        try:
            problems += check_file(name, contents.read(prefix + name, expected[name]), expected[name], version)
        except CFlowError as error:
            problems.append(f"{name}: {_one_line(error)}")
    if version.metadata is not None:
        problems += _check_metadata(contents, prefix + METADATA_FILE, version.metadata)
    return problems


def _wrapper(names: Sequence[str], allowed: Set[str]) -> str:
    """Name, with a slash, of the one folder that holds everything, where taking it away makes names right; else ""."""
    folders = {name.partition("/")[0] + "/" for name in names}
    if len(folders) != 1 or allowed & set(names):
        return ""
    folder = folders.pop()
    return folder if any(name[len(folder) :] in allowed for name in names) else ""


def _foreign(name: str, version: SubmissionVersion, logs: Set[str]) -> str:
    """What is wrong with a name that is not expected."""
    if _is_unsafe(name):
        return f"{name!r}: unsafe name (absolute, with '..', a backslash or a control character)"
    log_id, _, file = name.rpartition("/")
    if not log_id or not file.endswith(".feather"):
        return f"{name}: does not belong into a version {version.number} archive"
    if log_id not in logs:
        return f"{name}: extra frame, of a log that is not expected"
    if not version.is_stem(file[: -len(".feather")]):
        stem = "position of sweep t in ten digits" if version.naming == "position" else "time stamp of sweep t"
        return f"{name}: wrong name, expected <log>/<{stem}>.feather"
    return f"{name}: extra frame, not expected"


def _check_metadata(contents: Contents, name: str, required: Mapping[str, Any]) -> List[str]:
    if name not in contents.names:
        return [f"{METADATA_FILE}: missing, it must hold {json.dumps(dict(required))}"]
    try:
        values = parse_json(contents.read(name), METADATA_FILE)
    except CFlowError as error:  # a file that cannot be read as well
        return [f"{METADATA_FILE}: no JSON ({_one_line(error)})"]
    return [
        f"{METADATA_FILE}: must hold {json.dumps(key)} as true or false"
        for key, value in required.items()
        if not isinstance(values, dict) or not isinstance(values.get(key), type(value))
    ]


def _is_unsafe(name: str) -> bool:
    parts = name.split("/")
    return (
        name.startswith("/")
        or "\\" in name
        or ":" in parts[0]
        or any(part in ("..", ".", "") for part in parts)
        or not name.isprintable()
    )


def _one_line(error: BaseException) -> str:
    return " ".join(str(error).split())
