"""Disks that are full: one line names the file, what is there is whole, and the same run, begun again, ends
with the bytes of one that nothing disturbed."""

from __future__ import annotations

import errno
import os
from pathlib import Path
from typing import Any

import pytest
from small_fleet import command, run, tree

from cflow_torch.data import atomic


def fill(patch: pytest.MonkeyPatch, target: str) -> None:
    """Let files whose temporary path holds `target` meet a full disk."""
    replace = os.replace

    def refuse(old: Any, new: Any) -> None:
        if target in str(old):
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        replace(old, new)

    patch.setattr(atomic.os, "replace", refuse)


@pytest.mark.parametrize(
    "target", ["/.manifest.json.", "demo-0001/.manifest.json.", ".feather.", "/.shard-0-of-1.json."]
)
def test_a_disk_that_is_full_for_a_while(
    fleet: Path, single: dict[str, bytes], tmp_path: Path, capsys: pytest.CaptureFixture, target: str
) -> None:
    name = target.split("/")[-1].strip(".")
    with pytest.MonkeyPatch.context() as patch:
        fill(patch, target)
        if target == "/.manifest.json.":
            with pytest.raises(OSError, match=f"No space left on device: '{tmp_path / name}'"):
                run(fleet, tmp_path)
        else:
            report = run(fleet, tmp_path)
            told = "".join(message for _, message in report["failures"]) + capsys.readouterr().err
            assert "No space left on device" in told and name in told
            assert report["exit_status"] == 1
    assert tree(tmp_path).items() <= single.items()
    assert run(fleet, tmp_path)["exit_status"] == 0
    assert tree(tmp_path) == single


def test_an_output_that_cannot_be_written_is_one_line(
    fleet: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    (tmp_path / "file").write_text("mine")
    assert command(f"data.root={fleet}", f"output={tmp_path / 'file' / 'out'}") == 2
    assert "output=FOLDER" in capsys.readouterr().err and (tmp_path / "file").read_text() == "mine"
    fill(monkeypatch, ".config.yaml.")
    assert command(f"data.root={fleet}", f"output={tmp_path / 'out'}") == 2
    told = capsys.readouterr().err
    assert "No space left on device" in told and "output=" in told and "Traceback" not in told
