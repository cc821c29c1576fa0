"""Find the folders that are logs, and sort their files."""

from __future__ import annotations

import re
from collections import Counter
from pathlib import Path
from typing import Any, Callable, Sequence, TypeVar

from cflow_torch.data.paths import is_remote
from cflow_torch.errors import CFlowError

_T = TypeVar("_T")


def search(
    root: Path,
    find: Callable[[Path], Sequence[_T]],
    depth: int,
    what: str,
    is_passed: Callable[[Path], bool] = lambda folder: True,
) -> list[_T]:
    """Collect what `find` returns for `root` and the folders at most `depth` levels below it, by levels.

    We do not search below folders in which something is found, in hidden folders, or in folders for which `is_passed`
    is False. A root that is not a folder is a `CFlowError`, which says `what` to pass.
    """
    if not root.is_dir():
        raise CFlowError(f"{root} is not a folder; pass {what}")
    found: list[_T] = []
    level = [root]
    for _ in range(depth + 1):
        children_of = {folder: visible(folder) for folder in level}
        here = [(children, find(folder)) for folder, children in children_of.items() if children]
        found += [each for _, all_found in here for each in all_found]
        children = [child for children, all_found in here if not all_found for child in children]
        level = [child for child in children if is_passed(child) and child.is_dir()]
    return found


def find_folders(root: Path, is_log: Callable[[Path], bool], depth: int, what: str, **settings: Any) -> list[Path]:
    """Find the folders that are logs, sorted, see `search`."""
    return sorted(search(root, lambda folder: [folder] if is_log(folder) else [], depth, what, **settings))


def visible(folder: Path) -> list[Path]:
    """Return the files and folders in a folder that are not hidden; [] if it is a file, or of another user."""
    try:
        return [path for path in folder.iterdir() if path.name[0] != "."] if folder.is_dir() else []
    except PermissionError:
        if is_remote(folder):  # there are no credentials
            raise
        return []


def natural_key(name: str) -> tuple[Any, ...]:
    """Return a key for sorting that compares digits in names as numbers: 2 before 10."""
    return tuple((0, int(run), run) if run.isdecimal() else (1, 0, run) for run in re.findall(r"\d+|\D+", name))


def distinct_names(names: Sequence[str], above: Sequence[Sequence[str]]) -> list[str]:
    """Put names of parent folders (`above`, nearest first) in front of equal names, as many as it needs."""
    found = list(names)
    for depth in range(1, 1 + max(map(len, above), default=0)):
        counts = Counter(found)
        for k, parents in enumerate(above):
            if counts[found[k]] > 1:
                found[k] = "-".join([*parents[:depth][::-1], names[k]])
    return found
