"""The names of all settings, the choices of each group, and the nearest name to a mistyped one."""

from __future__ import annotations

from dataclasses import fields
from difflib import get_close_matches
from pathlib import Path
from typing import Any, Iterable, Iterator

import cflow_torch.configs
from cflow_torch.cli.commands import ENGINES, PICTURES, Command
from cflow_torch.config import PRESETS
from cflow_torch.setting import Settings

FOLDER = Path(cflow_torch.configs.__path__[0])  # YAML files of data sets and experiments
_KINDS: dict[str, Iterable[str]] = {"model": PRESETS, "engine": ENGINES, "picture": PICTURES}


def choices(group: str) -> list[str]:
    return list(_KINDS[group]) if group in _KINDS else [file.stem for file in files(group)]


def files(group: str) -> list[Path]:
    return sorted((FOLDER / group).glob("*.yaml"))


def setting_names(command: type[Command]) -> dict[str, list[str]]:
    """Return the dotted names of all settings of a command, each with the choices that have it, such as "data=av2"."""
    names: dict[str, list[str]] = {name: [] for name in own_names(command)}
    of_groups = command.groups()
    for choice, name in _names_of_choices():
        if choice.partition("=")[0] in of_groups and choice not in names.setdefault(name, []):
            names[name].append(choice)
    return names


def own_names(kind: type[Settings], prefix: str = "") -> Iterator[str]:
    """Yield the dotted names of the settings of a class."""
    for f in fields(kind):  # type: ignore[arg-type]
        of_kind = f.metadata.get("kind", object)
        if issubclass(of_kind, Settings):
            yield from own_names(of_kind, f"{prefix}{f.name}.")
        elif "kind" in f.metadata:
            yield f"{prefix}{f.name}"


def _names_of_choices() -> Iterator[tuple[str, str]]:
    """Yield (choice, dotted name of one of its settings)."""
    for preset, config in PRESETS.items():
        yield from ((f"model={preset}", f"model.{f.name}") for f in fields(config))
    for engine, kind in ENGINES.items():
        yield from ((f"engine={engine}", name) for name in own_names(kind, "engine."))
    for picture, kind in PICTURES.items():
        yield from ((f"picture={picture}", name) for name in own_names(kind))
    for file in files("data"):
        yield from ((f"data={file.stem}", f"data.{name}") for name in names_in(file))


def names_in(file: Path) -> Iterator[str]:
    """Yield the keys of `read_settings`, by the text alone: reading YAML takes longer than printing help."""
    for line in file.read_text(encoding="utf-8").splitlines():
        if line.startswith("  - "):  # a file that this one extends
            yield from names_in(file.with_name(f"{line[4:].strip()}.yaml"))
        elif line[:1].isalpha() and not line.startswith("defaults:"):
            yield line.partition(":")[0]


def read_settings(file: Path) -> dict[str, Any]:
    """Return the settings in the YAML file of a data set, and in the files that it extends, with their defaults."""
    import yaml  # type: ignore[import-untyped]

    content: dict[str, Any] = yaml.safe_load(file.read_text(encoding="utf-8"))
    settings: dict[str, Any] = {}
    for base in content.pop("defaults", ()):
        settings.update(read_settings(file.with_name(f"{base}.yaml")))
    return {**settings, **content}


def near(word: str, known: Iterable[str]) -> str:
    """Return the hint " (did you mean X?)", "" if no name is similar. We compare names with and without their group."""
    names = {form: name for name in known for form in (name.rpartition(".")[2], name)}
    similar = get_close_matches(word, names, 1)
    return f" (did you mean {names[similar[0]]}?)" if similar else ""
