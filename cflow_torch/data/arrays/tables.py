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
from cflow_torch.data.paths import read_bytes, suffix_of

_FEWEST_NUMBERS = 7  # of a pose
_LETTERS = re.compile("[A-Za-z]")
COMMENTS = ("#", "%", "//")
"""Beginnings of lines that are no rows."""
MATRIX = tuple(f"m{k}" for k in range(16))
"""Names of the entries of a matrix, row by row or column by column; the last four may be missing."""
# Numbers in a list of a JSON file, and the role that the name of the list has -> endings of their names, else 0, 1, ...
_VECTORS: dict[Any, Sequence[Any]] = {(3, "x"): ("x", "y", "z"), (3, "qx"): ("roll", "pitch", "yaw")}


class Table(NamedTuple):
    """K rows of C numbers as texts, because times need 19 digits."""

    names: list[str]  # of the C columns; [] = they have none
    words: np.ndarray  # (K, C) texts of numbers; K and C are at least 1
    labels: list[str]  # the name of each row, such as that of a file; [] = unknown


def parse_table(content: bytes, path: Path) -> Table:
    """Read the table in a text file.

    Names are those that `start_of_rows` finds. Columns of dates become seconds, and empty words NaN. Other columns of
    texts are left out; one of distinct texts names the rows.
    """
    with file_errors(path, "every line must have the same number of numbers, in UTF-8"):
        lines = _poses_only([line.strip() for line in content.decode("utf-8-sig").splitlines() if line.strip()])
        start, names = start_of_rows(lines, _FEWEST_NUMBERS)
        rows = [split_line(line) for line in lines[start:] if not line.startswith(COMMENTS)]
        texts = [line for line in lines[:start] if _LETTERS.search(line) and not line.startswith(COMMENTS)]
        width = min(map(len, rows), default=0)
        is_uneven = any(any(row[width:]) for row in rows)  # a line may lack the comma at the end of others
        if not rows or is_uneven or (len(texts) > 1 and not names):
            raise ValueError("it is empty, or has text before its numbers" if start else "its lines differ in length")
        columns = list(map(_seconds_of_dates, zip(*rows)))
        kept = [k for k, column in enumerate(columns) if is_number(next(filter(None, column), ""))]
        others = [list(column) for k, column in enumerate(columns) if k not in kept]
        labels: list[str] = next((column for column in others if len(set(column)) == len(column)), [])
        if not kept:
            raise ValueError("it has no numbers")
        words = np.array([[word or "nan" for word in columns[k]] for k in kept], str).T
        words.astype(np.float64)  # raises the error
    return Table([names[k] for k in kept] if names else [], words, labels)


def start_of_rows(lines: Sequence[str], fewest: int) -> tuple[int, list[str]]:
    """Return the index of the first row of a table, and the names of its columns.

    Rows have as many words as the middle line: numbers and empty words, or texts and at least so many numbers. Names
    are in the last line above with one for each column, also if it is a comment (`COMMENTS`); [] = there is none.
    Lines that repeat a word, such as a unit, come last.
    """
    plain = [line for line in lines if line and not line.startswith(COMMENTS)]
    width = len(split_line(plain[len(plain) // 2])) if plain else 0
    start = len(lines)
    for k, line in enumerate(lines):
        words = split_line(line)
        count = sum(is_number(_seconds_of_dates([word])[0]) for word in words)
        is_row = count + words.count("") == width or count >= fewest
        if is_row and len(words) == width and not line.startswith(COMMENTS):
            start = k
            break
    ends_empty = start < len(lines) and split_line(lines[start])[-1] == ""
    found = []
    for line in filter(_LETTERS.search, reversed(lines[:start])):
        header = line.lstrip("#%/ ")
        names = re.split("[,;]" if re.search("[,;]", header) else r"\s+", header)
        names += [""] * (ends_empty and len(names) == width - 1)  # each row ends with a comma
        found += [[name.strip(' "') for name in names]] * (len(names) == width)
    return start, min(found, key=lambda names: len(set(names)) < width, default=[])


def _seconds_of_dates(column: Sequence[str]) -> Sequence[str]:
    """Return a column of times of day, with or without dates, as seconds with decimals; others as they are."""
    is_other = is_number(column[0]) or re.search("[a-z]", column[0])  # names of files contain dates, too
    times = None if is_other else nanoseconds_of_dates(column)
    return column if times is None else [f"{Decimal(time).scaleb(-9):f}" for time in times]


def read_numbers(path: Path) -> np.ndarray:
    """Read a table without names, (K, C) float64."""
    with file_errors(path):
        return parse_table(read_bytes(path), path).words.astype(np.float64)


def _poses_only(lines: list[str]) -> list[str]:
    """Leave out edges of a g2o graph, and the three numbers above each matrix of a trajectory of Open3D.

    The id of a vertex becomes a part of its name: it may be a number of the pose, or a key, but not a time.
    """
    vertices = [re.sub(r"\s+", "_", line, count=1) for line in lines if line.startswith("VERTEX_SE3")]
    counts = [len(split_line(line)) for line in lines[:5]]
    return vertices or ([line for k, line in enumerate(lines) if k % 5] if counts == [3, 4, 4, 4, 4] else lines)


def tables_of_values(content: bytes, path: Path) -> Iterator[Table]:
    """Yield what may be a table in a JSON, YAML or .npz file: lists, and objects whose members are alike, outer first.

    Numbers of a row are named by their keys, joined by dots. A list, nested or not, of 12 or 16 numbers is a matrix. A
    list of three or four is a vector if the name of the list says so.
    """
    value = _value_of(content, path)
    for labels, members in (*_series(value), ([], [value])):
        rows = [dict(_numbers_of(member, "")) for member in members]
        names = max(rows, key=len, default={}).keys()
        if not names or 2 * sum(row.keys() == names for row in rows) <= len(rows):
            continue
        # Without a name, the first text in a row is its name.
        fields = [list(member.values()) if isinstance(member, dict) else [] for member in members]
        texts = labels or [next((each for each in row if isinstance(each, str)), "") for row in fields]
        words = np.array([[row.get(name, "nan") for name in names] for row in rows], str)
        yield Table(list(names), words, texts if len({*texts, ""}) > len(texts) else [])


def _value_of(content: bytes, path: Path) -> Any:
    """Return the lists, dictionaries and Decimals in a file. Nothing is unpickled."""
    kind = suffix_of(path)
    with file_errors(f"{path} as {kind[1:]}"):
        if kind == ".npz":
            with np.load(io.BytesIO(content), allow_pickle=False) as archive:
                return {name: _as_decimals(archive[name].tolist()) for name in archive.files}
        text = content.decode("utf-8-sig")
        if kind in (".yaml", ".yml"):
            documents = list(yaml.load_all(text, getattr(yaml, "CBaseLoader", yaml.BaseLoader)))
            return _as_decimals(documents[0] if len(documents) == 1 else documents)
        parse = partial(json.loads, parse_float=Decimal, parse_int=Decimal)
        try:
            value = None if kind == ".jsonl" else parse(text)
        except json.JSONDecodeError as error:
            if not error.msg.startswith("Extra data"):
                raise
            value = None
        return _of_lines(list(map(parse, text.splitlines()))) if value is None else value


def _of_lines(values: list[Any]) -> Any:
    """Return the values of lines as a list, but objects of distinct keys as one object."""
    keys = [key for value in values if isinstance(value, dict) for key in value]
    are_parts = len(values) > 1 and len(set(keys)) == len(keys) and all(isinstance(value, dict) for value in values)
    return {key: member for value in values for key, member in value.items()} if are_parts else values


def _as_decimals(value: Any) -> Any:
    """Return nested lists and dictionaries with Decimals in place of numbers and their texts."""
    if isinstance(value, dict):
        return {key: _as_decimals(member) for key, member in value.items()}
    if isinstance(value, list):
        return [_as_decimals(member) for member in value]
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
    """Yield the names and numbers of a row, see `tables_of_values`."""
    numbers = _numbers(value)
    if isinstance(value, Decimal):
        yield name, str(value)
    elif numbers:
        kind = len(numbers), role_of_name(f"{name}.x")
        ends = MATRIX if len(numbers) in (12, 16) else _VECTORS.get(kind, range(len(numbers)))
        yield from ((f"{name}.{end}".lstrip("."), str(number)) for end, number in zip(ends, numbers))
    elif isinstance(value, dict):
        parts = [(key, _numbers(member)) for key, member in value.items()]
        rotations = [numbers for _, numbers in parts if len(numbers) == 9]
        positions = [numbers for key, numbers in parts if (len(numbers), role_of_name(f"{key}.x")) == (3, "x")]
        if len(rotations) == len(positions) == 1:  # the rows of a matrix
            rows = [(*rotations[0][3 * k : 3 * k + 3], positions[0][k]) for k in range(3)]
            value = {key: member for (key, numbers), member in zip(parts, value.values()) if len(numbers) not in (3, 9)}
            value["matrix"] = [number for row in rows for number in row]
        for key, member in value.items():
            yield from _numbers_of(member, f"{name}.{key}" if name else key)


def split_line(line: str) -> list[str]:
    """Return the words between commas or semicolons, of which some are empty, or between blanks.

    Between commas, only numbers are split at blanks.
    """
    decimal = line.replace(",", ".") if ";" in line else line  # as some languages write numbers
    plain = re.sub(r"(\d[-/.]\d\d) (?=\d\d:)", r"\1T", decimal.replace('"', ""))  # a date and its time are one word
    if "[" in plain or "]" in plain:  # as NumPy prints matrices
        return re.split(r"[\s,;\[\]]+", plain.strip(" \t,;[]"))
    cells = re.split(r"\s*[,;]\s*", plain.strip())
    pieces = [cell.split() for cell in cells]
    are_split = [len(cells) == 1 or (len(each) > 1 and all(map(is_number, each))) for each in pieces]
    return [word for cell, each, is_split in zip(cells, pieces, are_split) for word in (each if is_split else [cell])]


def is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return "_" not in word  # which Python allows
