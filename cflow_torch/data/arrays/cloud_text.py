"""Clouds in text files: a point per line; x, y, z by the names above the numbers, else first."""

from __future__ import annotations

import re
from decimal import Decimal
from typing import Any, Sequence

import numpy as np
import pyarrow as pa
from pyarrow import csv

from cflow_torch.data.arrays.tables import split_line, start_of_rows
from cflow_torch.data.column_names import AXES, check_no_poses, default_names, first_coordinate, with_axes
from cflow_torch.types import CFlowError

SUFFIXES = (".csv", ".txt", ".xyz", ".pts", ".asc")
_START = 1 << 16  # bytes that tell the columns
_NO_NUMBER = re.compile(rb"-?(?:nan\(\w*\)|1\.#\w+)", re.IGNORECASE)


def text_columns(content: bytes) -> dict[str, np.ndarray]:
    """Return the columns of numbers in a text, by name; those without a name are x, y, z, column_3, ...

    Numbers are separated by commas, semicolons (then a decimal may have a comma) or blanks. Names are those that
    `start_of_rows` finds. Empty numbers are NaN.
    """
    content = with_plain_nan(content)
    lines = [line.strip() for line in content[:_START].decode("utf-8-sig", "replace").splitlines()]
    start, names = start_of_rows(lines, len(AXES))
    if start == len(lines) or len(split_line(lines[start])) < len(AXES):
        raise CFlowError("it has no line of three or more numbers below its names; it needs x, y, z")
    first = lines[start]
    separator = next((mark for mark in ";," if mark in first), " ")
    if separator == " ":
        content = re.sub(rb"[ \t]+", b" ", content)
        content = re.sub(rb"(?m)^ | (?=\r?$)", b"", content)
    count = len(split_line(first))
    options = {
        "read_options": csv.ReadOptions(
            use_threads=False, skip_rows=start, column_names=[f"column_{k}" for k in range(count)]
        ),
        "parse_options": csv.ParseOptions(delimiter=separator),
        "convert_options": csv.ConvertOptions(decimal_point="," if separator == ";" and "," in first else "."),
    }
    table = csv.read_csv(pa.BufferReader(content), **options)
    columns = [column.to_numpy() for column in table.columns]
    if names:
        check_no_poses(names)
        names = with_axes(names)
    else:
        has_numbers = (
            columns[0].dtype.kind == "f" and np.isnan(columns[0][:1]).any()
        )  # of the columns, as pandas writes
        rows = slice(int(has_numbers), None)
        begin = first_coordinate([column[rows] for column in columns])
        columns = [column[rows] for column in columns[1:]] if begin else columns
        names = default_names(len(columns))
    return {name: values for name, values in zip(names, columns) if values.dtype.kind in "biuf"}


def with_plain_nan(content: bytes) -> bytes:
    """Return a text in which NaN and infinity are nan where programs on Windows write -nan(ind) or 1.#QNAN."""
    return _NO_NUMBER.sub(b"nan", content)


def numbers_of(words: Sequence[bytes], kind: np.dtype[Any]) -> np.ndarray:
    """Return the numbers in words, exactly. A word that is not a number is a ValueError.

    A number that the type does not have is an OverflowError that names it.
    """
    texts = np.array(words, np.bytes_)
    if kind.kind == "f":
        with np.errstate(over="ignore"):  # beyond float32, a number is infinite
            return texts.astype(kind)
    limits = np.iinfo(kind)
    try:
        numbers = texts.astype(np.int64)
        is_whole = (numbers >= limits.min) & (numbers <= limits.max)
    except (ValueError, OverflowError):  # 7.000000, or more than 63 bits
        try:
            numbers = np.array([Decimal(word.decode()) for word in words], object)
        except ArithmeticError as error:
            raise ValueError(f"a word of it is not a number of {kind.name}") from error
        is_whole = np.array([n.is_finite() and limits.min <= n <= limits.max and n == int(n) for n in numbers])
    if not is_whole.all():
        raise OverflowError(f"it has {words[int(is_whole.argmin())].decode()}, which is not a number of {kind.name}")
    return numbers.astype(kind)
