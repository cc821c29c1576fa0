"""Disks that are full or shared: one line names the file, what is there is whole, and the same run, begun again, ends
with the bytes of one that nothing disturbed."""

from __future__ import annotations

import builtins
import errno
import os
import subprocess
from pathlib import Path
from typing import Any, Dict

import pytest
from small_fleet import command, frames, run, tree

from cflow_torch.data import atomic
from cflow_torch.data.atomic import remove_stale


class Full:
    """An open file that takes three bytes of what is written into it."""

    def __init__(self, file: Any) -> None:
        self._file = file

    def __getattr__(self, name: str) -> Any:
        return getattr(self._file, name)

    def __enter__(self) -> Full:
        return self

    def __exit__(self, *_: Any) -> None:
        self._file.close()

    def write(self, data: Any) -> int:
        self._file.write(bytes(data)[:3])
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def fill(patch: pytest.MonkeyPatch, target: str, count: int = 1_000_000) -> None:
    """Let `count` files whose temporary path holds `target` meet a full disk."""
    left = [count]

    def open_(path: Any, mode: str = "r", *rest: Any, **more: Any) -> Any:
        file = builtins.open(path, mode, *rest, **more)  # noqa: SIM115
        if "x" not in mode or target not in str(path) or not left[0]:
            return file
        left[0] -= 1
        return Full(file)

    patch.setattr(atomic, "open", open_, raising=False)


@pytest.mark.parametrize(
    "target", ["/.manifest.json.", "demo-0001/.manifest.json.", ".feather.", "/.shard-0-of-1.json."]
)
def test_a_disk_that_is_full_for_a_while(
    fleet: Path, single: Dict[str, bytes], tmp_path: Path, capsys: pytest.CaptureFixture, target: str
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
            assert report["exit_status"] == 1 and report["is_written"] == ("shard" not in target)
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
    assert "No space left on device" in told and "output=FOLDER" in told and "Traceback" not in told


# Other writers


def test_a_run_that_begins_beside_this_one_costs_no_frame(
    fleet: Path, single: Dict[str, bytes], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It takes the temporary file of a frame for that of a dead run, and removes it."""
    replace, robbed = os.replace, []

    def replace_robbed(old: Any, new: Any) -> None:
        if not robbed and Path(new).suffix == ".feather":
            robbed.extend(remove_stale(Path(new).parent, {Path(new).name}))
        replace(old, new)

    monkeypatch.setattr(atomic.os, "replace", replace_robbed)
    assert run(fleet, tmp_path)["exit_status"] == 0
    assert len(robbed) == 1 and tree(tmp_path) == single


def test_what_dead_runs_left_is_removed(fleet: Path, single: Dict[str, bytes], tmp_path: Path) -> None:
    run(fleet, tmp_path)
    file = frames(tmp_path)[0]
    file.unlink()
    ended = subprocess.Popen(["true"])
    ended.wait()
    for place, process in ((file, 1), (tmp_path / "x", ended.pid), (tmp_path / "reports" / "x", ended.pid)):
        left = atomic.temporary_name(place.name).replace(f"-{os.getpid()}-", f"-{process}-")
        place.with_name(left).write_bytes(b"half")
    run(fleet, tmp_path)
    assert tree(tmp_path) == single and not list((tmp_path / "reports").glob(".*"))
