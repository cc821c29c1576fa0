"""The choices of each group, and the settings of each command with their limits."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path
from typing import Any, Dict, Iterable, Iterator, Mapping, Optional, Tuple

import cflow_torch.configs
from cflow_torch.cli.commands import DATA_SETTINGS, ENGINES, PICTURES, Command, own_fields
from cflow_torch.config import PRESETS
from cflow_torch.setting import Settings

FOLDER = Path(cflow_torch.configs.__path__[0])  # YAML files of data sets and experiments
_KINDS: dict[str, Iterable[str]] = {"model": PRESETS, "engine": ENGINES, "picture": PICTURES}
Limits = Optional[Mapping[str, Any]]  # see `setting.bounds`; None = only a reader or Hydra checks the value
_Named = Tuple[str, Limits]  # name of a setting, and its limits
# Dotted name -> limits by choice, such as "data=av2", that has the setting; "" = the command itself has it.
Known = Dict[str, Dict[str, Limits]]


def choices(group: str) -> list[str]:
    return list(_KINDS[group]) if group in _KINDS else [file.stem for file in files(group)]


def files(group: str) -> list[Path]:
    """Return the files of the choices of a group. Files `_*.yaml` are no choices; others extend them."""
    return sorted((FOLDER / group).glob("[!_]*.yaml"))


def known_settings(command: type[Command]) -> Known:
    """Return all settings of a command."""
    known: Known = {name: {"": limits} for name, limits in _of_class(command)}
    groups = command.groups()
    for choice, settings in _of_choices():
        if choice.partition("=")[0] in groups:
            for name, limits in settings:
                known.setdefault(name, {}).setdefault(choice, limits)
    return known


def free_names(command: type[Command]) -> list[str]:
    """Return the dotted names of the settings on whose values no result depends."""
    known = known_settings(command)
    return [name for name, owners in known.items() if any(limits and limits["free"] for limits in owners.values())]


def _of_class(kind: type[Settings], prefix: str = "") -> Iterator[_Named]:
    for f in own_fields(kind):
        if issubclass(f.metadata["kind"], Settings):
            yield from _of_class(f.metadata["kind"], f"{prefix}{f.name}.")
        else:
            yield f"{prefix}{f.name}", None if f.name == kind.NAMED_BY else f.metadata


def _of_choices() -> Iterator[tuple[str, Iterable[_Named]]]:
    """Yield each choice of the groups, and its settings."""
    for preset, config in PRESETS.items():
        yield f"model={preset}", _of_class(type(config), "model.")
    for engine, kind in ENGINES.items():
        yield f"engine={engine}", _of_class(kind, "engine.")
    for picture, of_picture in PICTURES.items():
        yield f"picture={picture}", _of_class(of_picture)
    for file in files("data"):
        yield f"data={file.stem}", [(f"data.{name}", DATA_SETTINGS.get(name)) for name in read_settings(file)]


@lru_cache(maxsize=None)
def read_settings(file: Path) -> Mapping[str, Any]:
    """Return the settings in the YAML file of a data set, and in the files that it extends, with their defaults."""
    import yaml  # type: ignore[import-untyped]  # takes 40 ms, which help does not need

    content: dict[str, Any] = yaml.safe_load(file.read_text(encoding="utf-8"))
    settings: dict[str, Any] = {}
    for base in content.pop("defaults", ()):
        settings.update(read_settings(file.with_name(f"{base}.yaml")))
    return {**settings, **content}
