"""What differs between the settings of two runs."""

from __future__ import annotations

from typing import Any, Iterator, Mapping

from cflow_torch.config import PRESETS
from cflow_torch.data.file_errors import shortened
from cflow_torch.data.json_file import json_ready
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
        texts = [*_changed_presets(old, new), *texts]
        more = f" and {len(changed) - _SHOWN} more" if len(changed) > _SHOWN else ""
        why = f"{folder} has results of another run ({'; '.join(texts)}{more})"
        raise CFlowError(f"{why}: {remedy}, or give output=FOLDER")


def _changed_presets(old: dict[str, Any], new: dict[str, Any]) -> Iterator[str]:
    """Yield a text for each method in two flat dictionaries that has another preset than before."""
    for key in sorted(old.keys() & new.keys()):
        group, _, name = key.rpartition(".")
        if name == "pixel_sizes":  # all methods have it, and nothing else
            before, now = (
                nearest_preset({k[len(group) + 1 :]: v for k, v in settings.items() if k.startswith(f"{group}.")})
                for settings in (old, new)
            )
            if before != now:
                yield f"preset was {before}, is {now}"


def nearest_preset(method: Mapping[str, Any]) -> str | None:
    """Return the preset of the same method that differs in the fewest settings; None = no preset has this method."""
    given = json_ready(dict(method))

    def num_other(name: str) -> int:
        settings = json_ready(PRESETS[name].as_dict())
        return sum(given.get(key, value) != value for key, value in settings.items())

    names = [name for name, config in PRESETS.items() if config.method == given.get("method")]
    return min(names, key=num_other, default=None)
