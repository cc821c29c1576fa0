"""Finding logs under a folder."""

from __future__ import annotations

from pathlib import Path
from typing import Callable

from cflow_torch.types import CFlowError

Test = Callable[[Path], bool]


def find_folders(root: Path, is_log: Test, depth: int, what: str, is_passed: Test = lambda folder: True) -> list[Path]:
    """Folders that are a log, `root` among them. Nothing below a log is looked at.

    Args:
        root: where to begin.
        is_log: whether a folder is one.
        depth: levels below `root` that are looked at.
        what: what to give instead, for the error.
        is_passed: whether to look into a folder; hidden ones never are.

    Returns:
        Sorted folders; empty if there are none.

    Raises:
        CFlowError: `root` is no folder.
    """
    if not root.is_dir():
        raise CFlowError(f"{root} is no folder; give {what}")
    found: list[Path] = []
    level = [root]
    for _ in range(depth + 1):
        logs = {folder for folder in level if is_log(folder)}
        found += logs
        children = (child for folder in level if folder not in logs for child in folder.iterdir())
        level = [c for c in children if not c.name.startswith(".") and is_passed(c) and c.is_dir()]
    return sorted(found)
