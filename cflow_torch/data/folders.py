"""Find the folders that are logs, and sort their files."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any, Callable

from cflow_torch.errors import CFlowError

Test = Callable[[Path], bool]


def find_folders(root: Path, is_log: Test, depth: int, what: str, is_passed: Test = lambda folder: True) -> list[Path]:
    """Find the folders that are logs, sorted: `root` itself, or folders at most `depth` levels below it.

    We do not search inside logs, hidden folders, or folders for which `is_passed` is False. A root that is not a folder
    is a `CFlowError`, which says `what` to pass.
    """
    if not root.is_dir():
        raise CFlowError(f"{root} is not a folder; pass {what}")
    found: list[Path] = []
    level = [root]
    for _ in range(depth + 1):
        logs = {folder for folder in level if is_log(folder)}
        found += logs
        children = (child for folder in level if folder not in logs for child in folder.iterdir())
        level = [c for c in children if not c.name.startswith(".") and is_passed(c) and c.is_dir()]
    return sorted(found)


def natural_key(name: str) -> tuple[Any, ...]:
    """Return a key for sorting that compares digits in names as numbers: 2 before 10."""
    return tuple((0, int(run), run) if run.isdecimal() else (1, 0, run) for run in re.findall(r"\d+|\D+", name))
