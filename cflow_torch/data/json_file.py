"""JSON: read documents of data sets, write records next to results, and compare the settings in them."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any, Callable

from cflow_torch.data.atomic import write_text
from cflow_torch.data.files import file_errors, shortened
from cflow_torch.data.paths import PathLike, read_bytes

_SHOWN = 5  # differences that a message lists


def read_json(file: Path, use: Callable[[dict[str, Any]], Any] | None = None) -> Any:
    """Read a JSON file in UTF-8, with or without a byte order mark; `use` replaces each object, inner ones first.

    NaN and Infinity are accepted, as Python writes them; check the numbers where they must be finite (1e999 is
    infinite, too).
    """
    content = read_bytes(file)
    with file_errors(f"{file} as JSON"):
        return json.loads(content.decode("utf-8-sig"), object_hook=use)


def write_json(path: PathLike, value: Any) -> None:
    """Write a JSON file atomically; for what JSON cannot hold see `json_ready`."""
    write_text(path, json.dumps(json_ready(value), indent=1, allow_nan=False) + "\n")


def json_ready(value: Any) -> Any:
    """Replace what JSON cannot hold: tuples by lists, NaN (no points) by null, infinity by text."""
    if isinstance(value, dict):
        return {str(key): json_ready(member) for key, member in value.items()}
    if isinstance(value, (list, tuple)):
        return [json_ready(member) for member in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None if math.isnan(value) else str(value)
    return value


def flatten(value: Any, name: str = "") -> dict[str, Any]:
    """Flatten nested dictionaries into one, with keys joined by dots; lists are values."""
    if not isinstance(value, dict):
        return {name: value}
    leaves: dict[str, Any] = {}
    for key, member in value.items():
        leaves.update(flatten(member, f"{name}.{key}" if name else str(key)))
    return leaves


def describe_changes(before: Any, now: Any, ignored: Any = ()) -> str:
    """List the settings of two nested dictionaries that differ, as "key was A, is B; ..."; "" if none does.

    The keys `ignored`, in the form of `flatten`, may differ.
    """
    old, new = flatten(before), flatten(now)
    changed = sorted(key for key in {*old, *new} - set(ignored) if old.get(key) != new.get(key))
    shown = "; ".join(f"{key} was {shortened(old.get(key))}, is {shortened(new.get(key))}" for key in changed[:_SHOWN])
    return shown + (f" and {len(changed) - _SHOWN} more" if len(changed) > _SHOWN else "")
