"""What differs between the settings of two runs."""

from __future__ import annotations

from typing import Any

from cflow_torch.data.file_errors import shortened
from cflow_torch.errors import CFlowError

OVERWRITE = "give overwrite=true"
_SHOWN = 5  # changed settings that a message lists


def flatten(value: Any, name: str = "") -> dict[str, Any]:
    """Flatten nested dictionaries into one. Keys are joined by dots. Lists are not flattened."""
    if not isinstance(value, dict):
        return {name: value}
    leaves: dict[str, Any] = {}
    for key, member in value.items():
        leaves.update(flatten(member, f"{name}.{key}" if name else str(key)))
    return leaves


def check_same_run(folder: Any, before: Any, now: Any, free: Any = (), remedy: str = OVERWRITE) -> None:
    """Raise a `CFlowError`, which lists the changes, if `folder` has results of other settings.

    The settings are nested dictionaries; the keys `free`, joined by dots as in `flatten`, may differ.
    """
    old, new = flatten(before), flatten(now)
    changed = sorted(key for key in {*old, *new} - set(free) if old.get(key) != new.get(key))
    if changed:
        texts = [f"{key} was {shortened(old.get(key))}, is {shortened(new.get(key))}" for key in changed[:_SHOWN]]
        more = f" and {len(changed) - _SHOWN} more" if len(changed) > _SHOWN else ""
        why = f"{folder} has results of another run ({'; '.join(texts)}{more})"
        raise CFlowError(f"{why}: {remedy}, or give output=FOLDER")
