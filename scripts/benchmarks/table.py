"""Tables of the benchmarks."""

from __future__ import annotations

from typing import Any, Sequence


def markdown(rows: Sequence[Sequence[Any]]) -> str:
    """A table: the header, then the rows; numbers with four digits."""
    cells = [[f"{value:.4g}" if isinstance(value, float) else str(value) for value in row] for row in rows]
    return "".join("| " + " | ".join(row) + " |\n" for row in (cells[0], ["---"] * len(cells[0]), *cells[1:]))
