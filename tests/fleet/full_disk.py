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

STEPS = ("write", "fsync", "rename")


def fill(patch: pytest.MonkeyPatch, step: str, target: str, count: int = 1_000_000) -> None:
    """Let `count` files whose temporary path holds `target` meet a full disk, at one of `STEPS`."""
    left, descriptors = [count], set()
    replace, fsync = os.replace, os.fsync

    def refuse_if(is_hit: bool) -> None:
        if is_hit and left[0] > 0:
            left[0] -= 1
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    class Full:
        """An open file that takes three bytes."""

        def __init__(self, file: Any) -> None:
            self.file = file

        def __getattr__(self, name: str) -> Any:
            return getattr(self.file, name)

        def __enter__(self) -> Full:
            return self

        def __exit__(self, *_: Any) -> None:
            self.file.close()

        def write(self, data: Any) -> int:
            if left[0] > 0:
                self.file.write(bytes(data)[:3])
            refuse_if(True)
            return int(self.file.write(data))

    def open_(path: Any, mode: str = "r", *rest: Any, **more: Any) -> Any:
        file = builtins.open(path, mode, *rest, **more)  # noqa: SIM115
        if "x" not in mode or target not in str(path):
            return file
        descriptors.add(file.fileno())
        return Full(file) if step == "write" else file

    def fsync_(descriptor: int) -> None:
        if descriptor in descriptors:
            descriptors.remove(descriptor)
            refuse_if(step == "fsync")
        fsync(descriptor)

    def replace_(old: Any, new: Any) -> None:
        refuse_if(step == "rename" and target in str(old))
        replace(old, new)

    patch.setattr(atomic, "open", open_, raising=False)
    patch.setattr(atomic.os, "fsync", fsync_)
    patch.setattr(atomic.os, "replace", replace_)


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
