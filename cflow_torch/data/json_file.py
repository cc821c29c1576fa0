"""Read and write JSON files."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any, Callable

from cflow_torch.data.atomic import write_text
from cflow_torch.data.file_errors import file_errors
from cflow_torch.data.paths import PathLike, read_bytes


def read_json(file: Path, use: Callable[[dict[str, Any]], Any] | None = None) -> Any:
    """Read a JSON file in UTF-8, with or without a byte order mark.

    Each object is replaced by what `use` returns for it, inner objects first. Numbers may be NaN or infinite: we accept
    NaN and Infinity, which Python writes, and read 1e999 as infinity.
    """
    content = read_bytes(file)
    with file_errors(f"{file} as JSON"):
        return json.loads(content.decode("utf-8-sig"), object_hook=use)


def write_json(path: PathLike, value: Any) -> None:
    """Write a JSON file atomically. `json_ready` replaces values that JSON cannot hold."""
    write_text(path, json.dumps(json_ready(value), indent=1, allow_nan=False) + "\n")


def json_ready(value: Any) -> Any:
    """Replace values that JSON cannot hold: tuples by lists, NaN (a mean of no points) by null, infinity by text."""
    if isinstance(value, dict):
        return {str(key): json_ready(member) for key, member in value.items()}
    if isinstance(value, (list, tuple)):
        return [json_ready(member) for member in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None if math.isnan(value) else str(value)
    return value
