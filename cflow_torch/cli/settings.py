"""What can stand behind a command: its groups with their choices, and every setting, read from the YAML files."""

from __future__ import annotations

from difflib import get_close_matches
from functools import lru_cache
from pathlib import Path
from typing import Any, Dict, Iterable, List, Tuple

from omegaconf import DictConfig, OmegaConf

import cflow_torch.configs
from cflow_torch.types import CFlowError

CONFIGS = Path(cflow_torch.configs.__path__[0])


def has_settings(command: str) -> bool:
    """Whether it takes SETTING=VALUE at all."""
    return (CONFIGS / f"{command}.yaml").is_file()


def groups(command: str) -> Dict[str, List[str]]:
    """The groups of a command, each with its choices: {"model": ["default", ...], ...}."""
    return {group: choices(group) for group, _ in _defaults(CONFIGS / f"{command}.yaml") if group}


def choices(group: str) -> List[str]:
    """Sorted names of what a group can be."""
    return sorted(file.stem for file in (CONFIGS / group).glob("*.yaml"))


def settings(command: str) -> Dict[str, Any]:
    """Every setting of a command in dotted form, with the default it has in one of the choices of its group."""
    found = _keys(CONFIGS / f"{command}.yaml", "")
    for group, names in groups(command).items():
        for name in names if group != "experiment" else ():  # what it adds is for the tables of the paper
            for key, value in _group_keys(group, name).items():
                found.setdefault(key, value)
    return found


def owners(command: str, key: str) -> List[str]:
    """The choices that bring a setting: ["picture=correlation"] for cluster; none if it stands in none."""
    return [
        f"{group}={name}"
        for group, names in groups(command).items()
        if group != "experiment"
        for name in names
        if key in _group_keys(group, name)
    ]


def check_shape(cfg: DictConfig, command: str) -> None:
    """Put values where settings refer to others (`${...}`), and refuse what has lost the shape that commands rely on.

    Raises:
        CFlowError: references in a circle; a group or a mapping that is none any more; a setting taken out.
        OmegaConfBaseException: a reference to what is not there.
    """
    try:
        OmegaConf.resolve(cfg)
    except RecursionError:
        raise CFlowError("settings refer to each other (${...}) in a circle, or are nested too deep") from None
    # A group whose files write at the top (picture, experiment) leaves no mapping of its own name.
    mappings = [group for group in groups(command) if not _load(CONFIGS / group / f"{choices(group)[0]}.yaml")[1]]
    _check_shape(cfg, _load(CONFIGS / f"{command}.yaml")[0], mappings, "")
    for group in mappings:
        if group != "model":  # what is not said of the method has a default
            _check_group(cfg[group], group)


def _check_group(given: DictConfig, group: str) -> None:
    """Refuse a group that lacks what each of its choices has."""
    files = [_load(CONFIGS / group / f"{choice}.yaml")[0] for choice in choices(group)]
    for key in sorted(set.intersection(*({str(key) for key in file} for file in files)) - {"defaults"}):
        if key not in given and not OmegaConf.is_missing(given, key):
            raise CFlowError(f"setting {group}.{key} was taken out: leave out ~{group}.{key}")


def _check_shape(given: DictConfig, known: DictConfig, mappings: Iterable[str], prefix: str) -> None:
    inner = {str(key): known._get_node(key) for key in known if key not in ("defaults", "hydra")}
    for key in {**inner, **dict.fromkeys(mappings)}:
        if key not in given and not OmegaConf.is_missing(given, key):
            raise CFlowError(f"setting {prefix}{key} was taken out: leave out ~{prefix}{key}")
        own, now = inner.get(key), given._get_node(key)
        if key in mappings or (isinstance(own, DictConfig) and not own._is_none()):
            if not isinstance(now, DictConfig) or now._is_none() or now._is_missing():
                raise CFlowError(f"{prefix}{key}={now} is no mapping: give its settings, {prefix}{key}.NAME=VALUE")
            if isinstance(own, DictConfig):
                _check_shape(now, own, (), f"{prefix}{key}.")


def near(word: str, known: Iterable[str]) -> str:
    """ " (did you mean X?)" for the most similar known word; "" if none is similar."""
    candidates = list(known)
    found = get_close_matches(word, candidates, 1)
    if not found and "." not in word:  # `pixel_sizes` instead of `model.pixel_sizes`
        found = get_close_matches(word, [name.rpartition(".")[2] for name in candidates], 1)
        found = [name for name in candidates if found and name.rpartition(".")[2] == found[0]][:1]
    return f" (did you mean {found[0]}?)" if found else ""


@lru_cache(maxsize=None)
def _load(file: Path) -> Tuple[DictConfig, bool]:
    """(content, whether its keys stand at the top whatever its folder)."""
    text = file.read_text(encoding="utf-8")
    return OmegaConf.create(text), "@package _global_" in text.splitlines()[0] if text else False  # type: ignore[return-value]


def _defaults(file: Path) -> List[Tuple[str, str]]:
    """(group, choice) of a defaults list; the group is "" for a file of the same folder."""
    result = []
    for entry in _load(file)[0].get("defaults", []):
        if isinstance(entry, str):
            result.append(("", entry))
            continue
        ((group, choice),) = entry.items()
        if not group.startswith("override "):
            result.append((group.lstrip("/"), str(choice)))
    return result


def _group_keys(group: str, name: str) -> Dict[str, Any]:
    """Settings that a choice of a group brings, those it is based on first."""
    file = CONFIGS / group / f"{name}.yaml"
    found: Dict[str, Any] = {}
    for other, base in _defaults(file):
        if not other and base != "_self_":
            found.update(_group_keys(group, base))
    found.update(_keys(file, "" if _load(file)[1] else f"{group}."))
    return found


def _keys(file: Path, prefix: str) -> Dict[str, Any]:
    def flat(node: DictConfig, prefix: str) -> Iterable[Tuple[str, Any]]:
        for key in node:
            value = node._get_node(key)
            if isinstance(value, DictConfig) and not value._is_none() and len(value):
                yield from flat(value, f"{prefix}{key!s}.")
            else:
                yield f"{prefix}{key!s}", None if value is None else value._value()

    return {
        key: value
        for key, value in flat(_load(file)[0], prefix)
        if not key.startswith("hydra.") and key.rpartition(".")[2] != "defaults" and not key.startswith("defaults")
    }
