"""JSON records beside results: written whole, strict, and compared setting by setting."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

from cflow_torch.data.atomic import atomic_file
from cflow_torch.data.file_errors import shortened

_SHOWN = 5  # differences that a message lists


def write_text(path: Path, text: str) -> None:
    """Write a text file atomically."""
    with atomic_file(path) as file:
        file.write(text.encode())


def json_ready(value: Any) -> Any:
    """What JSON can hold: lists for tuples; it has neither NaN nor infinity: NaN (no points) becomes null, infinity a
    text."""
    if isinstance(value, dict):
        return {str(key): json_ready(part) for key, part in value.items()}
    if isinstance(value, (list, tuple)):
        return [json_ready(part) for part in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None if math.isnan(value) else str(value)
    return value


def flatten(value: Any, name: str = "") -> dict[str, Any]:
    """Nested dictionaries as one, keys joined by dots; lists are values."""
    if not isinstance(value, dict):
        return {name: value}
    parts: list[dict[str, Any]] = [flatten(part, f"{name}.{key}" if name else str(key)) for key, part in value.items()]
    return {key: leaf for part in parts for key, leaf in part.items()}


def describe_changes(before: Any, now: Any, ignored: Any = ()) -> str:
    """ "key was A, is B; ..." of the settings that differ between two records; "" if none does.

    Args:
        before: nested dictionaries.
        now: the same, today.
        ignored: joined keys that may differ.
    """
    old, new = flatten(before), flatten(now)
    changed = sorted(key for key in {*old, *new} - set(ignored) if old.get(key) != new.get(key))
    shown = "; ".join(f"{key} was {shortened(old.get(key))}, is {shortened(new.get(key))}" for key in changed[:_SHOWN])
    return shown + (f" and {len(changed) - _SHOWN} more" if len(changed) > _SHOWN else "")
