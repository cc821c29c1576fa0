"""Clouds in text files: a point per line; x, y, z by the names above the numbers, else first."""

from __future__ import annotations

import re

import numpy as np
import pyarrow as pa
from pyarrow import csv

from cflow_torch.data.arrays.tables import is_number, split_line
from cflow_torch.data.column_names import distinct_names, role_of_name
from cflow_torch.types import CFlowError

SUFFIXES = (".csv", ".txt", ".xyz", ".pts", ".asc")
_AXES = ("x", "y", "z")
_HEADER = 20  # lines before the numbers, at most


def text_columns(content: bytes) -> dict[str, np.ndarray]:
    """Return the columns of numbers in a text, by name; those without a name are x, y, z, column_3, ...

    Numbers are separated by commas, semicolons (then a decimal may have a comma) or blanks. Names are those of the last
    line before the numbers, if each column has one. Empty numbers are NaN.
    """
    lines = content[: 1 << 16].decode("utf-8-sig", "replace").splitlines()[:_HEADER]
    counts = [sum(map(is_number, split_line(line))) for line in lines]
    start = next((k for k, count in enumerate(counts) if count >= 3), None)
    if start is None:
        raise CFlowError("it has no line of three or more numbers below its names; it needs x, y, z")
    named = next((k for k in reversed(range(start)) if re.search("[A-Za-z]", lines[k])), start)
    separator = next((mark for mark in ";," if mark in lines[start]), " ")
    if separator == " ":
        content = re.sub(rb"[ \t]+", b" ", content)
        content = re.sub(rb"(?m)^ | (?=\r?$)", b"", content)
    count = len(split_line(lines[start]))
    options = {
        "read_options": csv.ReadOptions(
            use_threads=False,
            skip_rows=named + 1 if named < start else start,
            column_names=[f"column_{k}" for k in range(count)],
        ),
        "parse_options": csv.ParseOptions(delimiter=separator),
        "convert_options": csv.ConvertOptions(decimal_point="," if separator == ";" and "," in lines[start] else "."),
    }
    table = csv.read_csv(pa.BufferReader(content), **options)
    columns = [column.to_numpy() for column in table.columns]
    names = _names(lines[named] if named < start else "", separator, count)
    return {name: values for name, values in zip(names, columns) if values.dtype.kind in "biuf"}


def _names(line: str, separator: str, count: int) -> list[str]:
    """Return the names of columns, of which x, y and z are called so."""
    words = re.sub(r'^[\s#/]+|["\s]+$', "", line)
    names = [name.strip(' "') for name in (words.split() if separator == " " else words.split(separator))]
    if len(names) != count or all(map(is_number, names)):
        return [*_AXES, *(f"column_{k}" for k in range(3, count))]
    if not set(_AXES) <= set(names):
        roles = [role_of_name(name) for name in names]
        names = [role if role in _AXES and roles.index(role) == k else names[k] for k, role in enumerate(roles)]
    return distinct_names(names)
