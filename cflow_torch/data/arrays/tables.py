"""Tables of numbers in text files, with or without names of the columns, and in JSON, YAML and .npz files."""

from __future__ import annotations

import io
import json
import re
from decimal import Decimal
from functools import partial
from pathlib import Path
from typing import Any, Iterator, NamedTuple, Sequence

import numpy as np
import yaml  # type: ignore[import-untyped]

from cflow_torch.data.arrays.stamps import nanoseconds_of_dates
from cflow_torch.data.column_names import role_of_name
from cflow_torch.data.file_errors import file_errors
from cflow_torch.data.folders import natural_key
from cflow_torch.data.paths import read_bytes

_FEWEST_NUMBERS = 7  # of a pose
COMMENTS = ("#", "%", "//")
"""Beginnings of lines that are no rows."""
MATRIX = tuple(f"m{k}" for k in range(12))
"""Names of the entries of the upper three rows of a matrix, row by row."""
_VECTORS = {  # numbers in a list of a JSON file, and a role that the name of the list has -> endings of their names
    (3, "x"): (".x", ".y", ".z"),
    (4, "qx"): (".0", ".1", ".2", ".3"),
    (3, "qx"): (".roll", ".pitch", ".yaw"),
}


class Table(NamedTuple):
    """K rows of C numbers as texts, because times need 19 digits."""

    names: list[str]  # of the C columns; [] = they have none
    words: np.ndarray  # (K, C) texts of numbers; K and C are at least 1
    labels: list[str]  # the name of each row, such as that of a file; [] = unknown


def parse_table(content: bytes, path: Path) -> Table:
    """Read the table in a text file.

    Names are those of the last line before the numbers, also if it is a comment (`COMMENTS`). They are empty if this
    line does not have one name for each column. Columns of dates become seconds. Other columns of texts are left out;
    one of distinct texts names the rows.
    """
    with file_errors(path, "every line must have the same number of numbers"):
        lines = [line.strip() for line in content.decode("utf-8-sig").splitlines() if line.strip()]
        lines = _poses_only(lines)
        plain = [line for line in lines if not line.startswith(COMMENTS)]
        usual = len(split_line(plain[len(plain) // 2])) if plain else 0
        start = next((k for k, line in enumerate(lines) if _is_row(split_line(line), usual)), len(lines))
        header = lines[start - 1].lstrip("#%/") if start else ""
        names = re.split("[,;]", header) if re.search("[,;]", header) else header.split()
        rows = [split_line(line) for line in lines[start:] if not line.startswith(COMMENTS)]
        has_text = not all(line.startswith(COMMENTS) for line in lines[: max(start - 1, 0)])
        if has_text or len(set(map(len, rows))) != 1:
            raise ValueError("it is empty, or has text before its numbers" if start else "its lines differ in length")
        words = np.array(list(map(_seconds_of_dates, zip(*rows))), str).T
        columns = [column for column, word in enumerate(words[0]) if is_number(word)]
        texts = [words[:, column].tolist() for column in range(words.shape[1]) if column not in columns]
        labels: list[str] = next((column for column in texts if len(set(column)) == len(column)), [])
        names = [names[column] for column in columns] if len(names) == words.shape[1] else []
        words = words[:, columns]
        words.astype(np.float64)  # raises the error
    return Table(names, words, labels)


def _seconds_of_dates(column: Sequence[str]) -> Sequence[str]:
    """Return a column of times of day, with or without dates, as seconds with decimals; others as they are."""
    times = nanoseconds_of_dates(column) if ":" in column[0] else None
    return column if times is None else [f"{Decimal(time).scaleb(-9):f}" for time in times]


def read_numbers(path: Path) -> np.ndarray:
    """Read a table without names, (K, C) float64."""
    with file_errors(path):
        return parse_table(read_bytes(path), path).words.astype(np.float64)


def _poses_only(lines: list[str]) -> list[str]:
    """Leave out edges of a g2o graph, and the three numbers above each matrix of a trajectory of Open3D."""
    vertices = [line for line in lines if line.startswith("VERTEX_SE3")]
    counts = [len(split_line(line)) for line in lines[:5]]
    return vertices or ([line for k, line in enumerate(lines) if k % 5] if counts == [3, 4, 4, 4, 4] else lines)


def tables_of_values(content: bytes, path: Path) -> Iterator[Table]:
    """Yield what may be a table in a JSON, YAML or .npz file: lists, and objects whose members are alike, outer first.

    Numbers of a row are named by their keys, joined by dots. A list, nested or not, of 12 or 16 numbers is a matrix, by
    rows, or by columns if these end in 0, 0, 0, 1. A list of three or four is a vector if the name of the list says so.
    """
    value = _value_of(content, path)
    for labels, members in (*_series(value), ([], [value])):
        table = table_of(members, labels)
        if table is not None:
            yield table


def table_of(members: Sequence[Any], labels: Sequence[str] = ()) -> Table | None:
    """Return the table whose rows are members that are mostly alike, see `tables_of_values`; None = they are not."""
    rows = [dict(_numbers_of(member, "")) for member in members]
    names = max(rows, key=len, default={}).keys()
    if not names or 2 * sum(row.keys() == names for row in rows) <= len(rows):
        return None
    texts = list(labels) or [_text_of(member) for member in members]
    words = [[row.get(name, "nan") for name in names] for row in rows]
    return Table(list(names), np.array(words, str), texts if len({*texts, ""}) > len(texts) else [])


def _value_of(content: bytes, path: Path) -> Any:
    """Return the lists, dictionaries and Decimals in a file. Nothing is unpickled."""
    kind = path.suffix.lower()
    with file_errors(f"{path} as {kind[1:]}"):
        if kind == ".npz":
            with np.load(io.BytesIO(content), allow_pickle=False) as archive:
                return {name: as_decimals(archive[name].tolist()) for name in archive.files}
        text = content.decode("utf-8-sig")
        if kind in (".yaml", ".yml"):
            documents = list(yaml.load_all(text, getattr(yaml, "CBaseLoader", yaml.BaseLoader)))
            return as_decimals(documents[0] if len(documents) == 1 else documents)
        parse = partial(json.loads, parse_float=Decimal, parse_int=Decimal)
        return list(map(parse, text.splitlines())) if kind == ".jsonl" else parse(text)


def as_decimals(value: Any) -> Any:
    """Return nested lists and dictionaries with Decimals in place of numbers and their texts."""
    if isinstance(value, dict):
        return {key: as_decimals(member) for key, member in value.items()}
    if isinstance(value, list):
        return [as_decimals(member) for member in value]
    return Decimal(str(value)) if is_number(str(value)) else value


def _series(value: Any) -> Iterator[tuple[list[str], list[Any]]]:
    """Yield the lists in a JSON value with the names of their members: [] = these have none."""
    if isinstance(value, list):
        yield [], value
    elif isinstance(value, dict):
        keys = sorted(value, key=natural_key)
        yield keys, [value[key] for key in keys]
        columns = {key: list(each.values()) if isinstance(each, dict) else each for key, each in value.items()}
        columns = {key: each for key, each in columns.items() if isinstance(each, list) and len(each) > 1}
        longest = max(map(len, columns.values()), default=0)
        columns = {key: each for key, each in columns.items() if len(each) == longest}
        if len(columns) > 1:  # a table by columns
            yield [], [dict(zip(columns, row)) for row in zip(*columns.values())]
    for member in value.values() if isinstance(value, dict) else value if isinstance(value, list) else ():
        if isinstance(member, (dict, list)) and not _numbers(member):
            yield from _series(member)


def _numbers(value: Any) -> list[Decimal]:
    """Return the numbers of a list, nested or not; [] = it holds anything else."""
    flat: list[Decimal] = []
    for member in value if isinstance(value, list) else ():
        inner = [member] if isinstance(member, Decimal) else _numbers(member)
        if not inner or len(flat) > 16:
            return []
        flat += inner
    return flat


def _numbers_of(value: Any, name: str) -> Iterator[tuple[str, str]]:
    """Yield the names and numbers of a row, see `tables_of_json`."""
    numbers = _numbers(value)
    if isinstance(value, Decimal):
        yield name, str(value)
    elif len(numbers) in (12, 16):
        matrix = np.array(numbers).reshape(-1, 4)
        is_by_columns = len(matrix) == 4 and matrix[:, 3].tolist() == [0, 0, 0, 1] != matrix[3].tolist()
        prefix = f"{name}." if name else ""
        yield from zip(
            [prefix + each for each in MATRIX], map(str, (matrix.T if is_by_columns else matrix)[:3].ravel())
        )
    elif numbers:
        fitting = [
            ends
            for (count, role), ends in _VECTORS.items()
            if count == len(numbers) and role_of_name(f"{name}.x") == role
        ]
        ends = fitting[0] if fitting else [f".{k}" for k in range(len(numbers))]
        yield from ((name + end, str(number)) for end, number in zip(ends, numbers))
    elif isinstance(value, dict):
        for key, member in value.items():
            yield from _numbers_of(member, f"{name}.{key}" if name else key)


def _text_of(value: Any) -> str:
    texts = [each for each in value.values() if isinstance(each, str)] if isinstance(value, dict) else []
    return texts[0] if texts else ""


def split_line(line: str) -> list[str]:
    decimal = line.replace(",", ".") if ";" in line else line  # as some languages write numbers
    decimal = re.sub(r"[\[\]]", " ", decimal).strip()  # as NumPy prints matrices
    decimal = re.sub(r"(\d[-/.]\d\d) (?=\d\d:)", r"\1T", decimal)  # a date and its time are one word
    return re.split(r"[\s,;]+", decimal.rstrip(",; "))


def _is_row(words: Sequence[str], usual: int) -> bool:
    """Test whether words are as many as usual in a table, and a row of numbers, or a pose with a few texts."""
    num_numbers = sum(map(is_number, words))
    return len(words) == usual and (num_numbers == len(words) or num_numbers >= _FEWEST_NUMBERS)


def is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True
