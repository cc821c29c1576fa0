"""What differs between the settings of two runs."""

from __future__ import annotations

from typing import Any

from cflow_torch.data.file_errors import shortened
from cflow_torch.errors import CFlowError

_SHOWN = 5  # changed settings that a message lists


def flatten(value: Any, name: str = "") -> dict[str, Any]:
    """Flatten nested dictionaries into one. Keys are joined by dots. Lists are not flattened."""
    if not isinstance(value, dict):
        return {name: value}
    leaves: dict[str, Any] = {}
    for key, member in value.items():
        leaves.update(flatten(member, f"{name}.{key}" if name else str(key)))
    return leaves


def check_same_run(folder: Any, before: Any, now: Any, free: Any = ()) -> None:
    """Raise a `CFlowError`, which lists the changes, if `folder` has results of other settings. `free` may differ."""
    changes = describe_changes(before, now, free)
    if changes:
        why = f"{folder} has results of another run ({changes})"
        raise CFlowError(f"{why}: give overwrite=true, or output=FOLDER")


def describe_changes(before: Any, now: Any, ignored: Any = ()) -> str:
    """List the settings that differ between two nested dictionaries, as "key was A, is B; ..."; "" if none do.

    The keys `ignored`, joined by dots as in `flatten`, may differ.
    """
    old, new = flatten(before), flatten(now)
    changed = sorted(key for key in {*old, *new} - set(ignored) if old.get(key) != new.get(key))
    shown = "; ".join(f"{key} was {shortened(old.get(key))}, is {shortened(new.get(key))}" for key in changed[:_SHOWN])
    return shown + (f" and {len(changed) - _SHOWN} more" if len(changed) > _SHOWN else "")
