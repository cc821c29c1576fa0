"""The groups of a command with their choices, and the names of all its settings."""

from __future__ import annotations

import re
from difflib import get_close_matches
from functools import lru_cache
from pathlib import Path
from typing import Any, Iterable, Iterator, Mapping

import yaml  # type: ignore[import-untyped]

import cflow_torch.configs
from cflow_torch.config import PRESETS, make_config

CONFIGS = Path(cflow_torch.configs.__path__[0])
PREFIXES = {"data": "data.", "engine": "engine.", "picture": ""}  # group -> prefix of its settings


def groups(command: str) -> dict[str, list[str]]:
    """Return the groups of a command and their choices: {"model": ["default", ...], ...}."""
    entries = _load(CONFIGS / f"{command}.yaml")["defaults"]
    names = [name for entry in entries if isinstance(entry, dict) for name in entry]
    return {name: list(PRESETS) if name == "model" else [file.stem for file in files(name)] for name in names}


def files(group: str) -> list[Path]:
    return sorted((CONFIGS / group).glob("*.yaml"))


def settings(command: str) -> list[str]:
    """Return the dotted names of all settings of a command and of all choices of its groups."""
    of_methods = [f"model.{name}" for preset in PRESETS for name in make_config(preset).as_dict()]
    return list(dict.fromkeys([*(name for name, _, _ in defaults(command)), *of_methods]))


def defaults(command: str, chosen: Mapping[str, Any] | None = None) -> Iterator[tuple[str, str, Any]]:
    """Yield the dotted name, the file and the default of each setting in configs/; `chosen` limits the choices."""
    found = [("", CONFIGS / f"{command}.yaml")]
    for group in groups(command):
        if group in PREFIXES:
            found += [(PREFIXES[group], f) for f in files(group) if chosen is None or chosen.get(group) == f.stem]
    for prefix, file in found:
        yield from ((prefix + name, file.stem, default) for name, default in own_settings(file).items())


def own_settings(file: Path) -> dict[str, Any]:
    """Return {dotted name: default} of the settings in a YAML file and in the files that it extends."""
    content, found = _load(file), {}
    for base in content.get("defaults", ()):
        if isinstance(base, str) and base not in ("_self_", "hydra"):
            found.update(own_settings(file.with_name(f"{base}.yaml")))
    for key, value in content.items():
        if isinstance(value, dict):
            found.update({f"{key}.{name}": own for name, own in value.items() if key != "hydra"})
        elif key != "defaults":
            found[key] = value
    return found


@lru_cache(maxsize=None)  # commands share files
def _load(file: Path) -> dict[str, Any]:
    """Read a YAML file without Hydra and OmegaConf: importing them takes longer than printing help."""
    loader = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
    return yaml.load(file.read_text(encoding="utf-8"), loader) or {}  # type: ignore[no-any-return]


def near(word: str, known: Iterable[str]) -> str:
    """Return the hint " (did you mean X?)", "" if no name is similar. We compare names with and without their group."""
    names = {form: name for name in known for form in (name.rpartition(".")[2], name)}
    found = get_close_matches(word, names, 1)
    return f" (did you mean {names[found[0]]}?)" if found else ""


def settings_help(command: str) -> str:
    """List the settings of a command for its help: those of its YAML file, and the choices of its groups."""
    text = (CONFIGS / f"{command}.yaml").read_text(encoding="utf-8")
    own = re.sub(r"^((defaults|hydra):.*\n( .*\n)+|#.*\n)", "", text, flags=re.MULTILINE).strip()
    lines = [*own.splitlines(), *(f"{group}={'|'.join(names)}" for group, names in groups(command).items())]
    return "\n  ".join(["\nsettings:", *lines, "data.NAME, model.NAME, ...: `cflow settings` lists them"]) + "\n"
