"""Markdown tables of the benchmarks."""

from __future__ import annotations

from typing import Any, Mapping, Sequence


def markdown(rows: Sequence[Mapping[str, Any]]) -> str:
    """A table with a column per key; numbers have four digits, and missing values are empty."""
    columns = list(dict.fromkeys(key for row in rows for key in row))
    values = ([row.get(column, "") for column in columns] for row in rows)
    cells = [[f"{value:.4g}" if isinstance(value, float) else str(value) for value in row] for row in values]
    return "".join("| " + " | ".join(row) + " |\n" for row in (columns, ["---"] * len(columns), *cells))
