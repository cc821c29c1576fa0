"""Reads the YAML files of configs/ as texts, with their comments: Hydra keeps the values only."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Iterator, List, NamedTuple, Tuple


class Key(NamedTuple):
    """One key of a YAML file.

    Args:
        name: with dots, `shard.index`.
        value: as it is written.
        comment: behind it, "" = none.
    """

    name: str
    value: str
    comment: str


def keys(file: Path) -> Iterator[Key]:
    """The keys of a YAML file with a value each; lists of `defaults` and what Hydra itself reads are left out."""
    above: List[Tuple[int, str]] = []
    pending = None
    for line in file.read_text(encoding="utf-8").split("\n"):
        found = re.match(r"( *)([\w/]+):(?: +(.*))?$", line)
        if not found:
            continue
        indent, name, rest = len(found[1]), found[2], found[3] or ""
        above = [(i, n) for i, n in above if i < indent]
        dotted = ".".join([*(n for _, n in above), name])
        value, _, comment = f" {rest}".partition(" # " if " # " in f" {rest}" else " #")
        value = value.strip()
        if dotted.split(".")[0] in ("defaults", "hydra"):
            above.append((indent, name))
            continue
        if value:
            # What stands behind the name of a group of keys is of all of them.
            yield Key(dotted, value, comment.strip() or (pending[1] if pending and pending[0] in dotted else ""))
        else:
            pending = (f"{dotted}.", comment.strip())
            above.append((indent, name))


def heading(file: Path) -> str:
    """The comment that a file begins with, on one line."""
    lines = []
    for line in file.read_text(encoding="utf-8").split("\n"):
        if not line.startswith("#"):
            break
        if not line.startswith("# @package"):
            lines.append(line.lstrip("# "))
    return " ".join(lines)


def bases(file: Path) -> List[str]:
    """`group=choice` of the list of defaults, and the files of the same folder that it goes on from."""
    found = []
    block = re.search(r"^defaults:\n((?:  .*\n)+)", file.read_text(encoding="utf-8"), re.M)
    for line in block[1].split("\n") if block else []:
        entry = re.match(r"  - (?:override /)?([\w/]+)(?:: (\w+))?$", line)
        if entry and entry[1] not in ("hydra", "_self_", "hydra/job_logging", "hydra/hydra_logging"):
            found.append(f"{entry[1]}={entry[2]}" if entry[2] else entry[1])
    return found


def sweeps(file: Path) -> List[str]:
    """`key=values` that an experiment sweeps over."""
    block = re.search(r"^    params:\n((?:      .*\n?)+)", file.read_text(encoding="utf-8"), re.M)
    lines = block[1].strip().split("\n") if block else []
    return [re.sub(r": +", "=", line.strip(), count=1).replace('"', "") for line in lines]
