"""Find the folders that are logs, and sort their files."""

from __future__ import annotations

import re
from contextlib import suppress
from itertools import islice
from pathlib import Path
from typing import Any, Callable, Iterator, Sequence, TypeVar

from cflow_torch.data.paths import is_remote, read_bytes
from cflow_torch.errors import CFlowError

_T = TypeVar("_T")
_OF_FLOW, _OF_CLEAN = "manifest.json", "clean.json"  # records in folders of results; the second are logs, too
_OURS = b'"cflow_torch"'  # what a record of ours contains
_LONGEST_CHAIN = 16  # folders, each alone in the one before; links may make it endless


def search(
    root: Path,
    find: Callable[[Path], Sequence[_T]],
    depth: int,
    what: str,
    is_passed: Callable[[Path], bool] = lambda folder: True,
) -> list[_T]:
    """Collect what `find` returns for `root` and the folders at most `depth` levels below it, by levels.

    We do not search below folders in which something is found, in hidden folders, in folders of flow that we computed,
    or in folders for which `is_passed` is False. Clean logs that we wrote count only if there are no others. A chain of
    folders below the root, each alone, costs no depth. A root that is a file is a `CFlowError`, which says `what` to
    pass, unless `find` returns something for it.
    """
    if not root.is_dir():
        of_file = list(find(root)) if root.is_file() else []
        if not of_file:
            raise CFlowError(f"{root} is not a folder; pass {what}")
        return of_file
    found: list[_T] = []
    clean: list[_T] = []
    for level in levels(root, depth):
        for folder, inside in level:
            record = "" if folder == root else record_in(inside)
            here = find(folder) if inside and record != _OF_FLOW else []
            (clean if record else found).extend(here)
            inside[:] = [] if here or record else filter(is_passed, inside)
    return found or clean


def levels(root: Path, depth: int) -> Iterator[list[tuple[Path, list[Path]]]]:
    """Yield the paths of each level, and what is visible in each: the root, then what is in it, and so on.

    There are `depth` levels below the root. Levels with one folder do not count until a level has another number of
    folders. In a file, nothing is visible. As with `os.walk`, we do not go on to paths that the caller takes out of
    these lists.
    """
    paths, num_free = [root], _LONGEST_CHAIN
    while depth >= 0:
        level = [(path, visible(path)) for path in paths]
        folders = islice((path for _, inside in level for path in inside if path.is_dir()), 2)
        if num_free > 0 and len(list(folders)) == 1:
            num_free = num_free - 1
        else:
            depth = depth - 1
            num_free = 0
        yield level
        paths = [path for _, inside in level for path in inside]


def find_folders(root: Path, is_log: Callable[[Path], bool], depth: int, what: str, **settings: Any) -> list[Path]:
    """Find the folders that are logs, sorted, see `search`."""
    return sorted(search(root, lambda folder: [folder] if is_log(folder) else [], depth, what, **settings))


def record_in(files: Sequence[Path]) -> str:
    """Return the name of the record among the files of a folder of results that we wrote; "" = it is none of ours."""
    for path in files:
        with suppress(OSError, CFlowError):  # of another user
            if path.name in (_OF_FLOW, _OF_CLEAN) and path.is_file() and _OURS in read_bytes(path):
                return path.name
    return ""


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
