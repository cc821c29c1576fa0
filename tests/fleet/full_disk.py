"""A disk that is full where a test wants it: by injection, which runs everywhere, or a small tmpfs of its own."""

from __future__ import annotations

import builtins
import errno
import os
import subprocess
from pathlib import Path
from typing import Any

import pytest

from cflow_torch.data import atomic

STEPS = ("open", "write", "flush", "fsync", "rename")


def _refuse() -> None:
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


class _Full:
    """An open file that takes everything but what `step` does.

    Args:
        file: the file.
        step: one of `STEPS`.
    """

    def __init__(self, file: Any, step: str) -> None:
        self._file, self._step = file, step

    def __getattr__(self, name: str) -> Any:
        return getattr(self._file, name)

    def __enter__(self) -> _Full:
        return self

    def __exit__(self, *_: Any) -> None:
        self._file.close()

    def write(self, data: Any) -> int:
        if self._step == "write":
            self._file.write(bytes(data)[:3])  # a part still finds room
            _refuse()
        return int(self._file.write(data))

    def flush(self) -> None:
        if self._step == "flush":
            _refuse()
        self._file.flush()


def fill(patch: pytest.MonkeyPatch, step: str, target: str, count: int = 1_000_000) -> None:
    """Let `count` files whose path holds `target` meet a full disk when the package writes them, at one of `STEPS`."""
    left = [count]
    descriptors = set()
    replace, fsync = os.replace, os.fsync

    def is_hit(path: Any) -> bool:
        if target not in str(path) or left[0] == 0:
            return False
        left[0] -= 1
        return True

    def open_(path: Any, mode: str = "r", *rest: Any, **more: Any) -> Any:
        if "x" not in mode or not is_hit(path):
            return builtins.open(path, mode, *rest, **more)
        if step == "open":
            _refuse()
        file = builtins.open(path, mode, *rest, **more)  # noqa: SIM115
        if step == "fsync":
            descriptors.add(file.fileno())
        return _Full(file, step)

    def fsync_(descriptor: int) -> None:
        if descriptor in descriptors:
            descriptors.remove(descriptor)
            _refuse()
        fsync(descriptor)

    def replace_(old: Any, new: Any) -> None:
        if is_hit(old):
            _refuse()
        replace(old, new)

    if step == "rename":
        patch.setattr(atomic.os, "replace", replace_)
    else:
        patch.setattr(atomic, "open", open_, raising=False)
        patch.setattr(atomic.os, "fsync", fsync_)


class SmallDisk:
    """A tmpfs on a folder.

    Args:
        folder: made; where it is mounted.
        options: of the mount, "size=3m" for example.
    """

    def __init__(self, folder: Path, options: str) -> None:
        self.folder = folder
        folder.mkdir()
        done = subprocess.run(["mount", "-t", "tmpfs", "-o", options, "tmpfs", folder], capture_output=True, text=True)
        if done.returncode:
            pytest.skip(f"no right to mount a tmpfs here: {done.stderr.strip()}")

    def change(self, options: str) -> None:
        """Mount it anew, with its contents."""
        subprocess.run(["mount", "-o", f"remount,{options}", self.folder], check=True)

    def __enter__(self) -> SmallDisk:
        return self

    def __exit__(self, *_: Any) -> None:
        subprocess.run(["umount", self.folder], check=True)
