"""Write a clean log in the form of its input: names, columns and types of its clouds, and a mask per sweep."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Callable, Mapping, NamedTuple

import numpy as np

from cflow_torch.applications.cleaning import CleanLog
from cflow_torch.data.arrays import ArraysLog
from cflow_torch.data.arrays.cloud_file import SUFFIXES, copy_rows
from cflow_torch.data.arrays.writer import POINTS_FOLDER, SweepSides, cloud_names, write_sides, write_sweep
from cflow_torch.data.atomic import new_folder
from cflow_torch.data.json_file import write_json
from cflow_torch.data.log import Log
from cflow_torch.data.npy_file import read_npy
from cflow_torch.data.paths import suffix_of
from cflow_torch.diagnosis.conventions import OF_POINTS, WORLD
from cflow_torch.types import CFlowError

REMOVED_FOLDER = "removed"
RECORD_FILE = "clean.json"  # what a folder was made by; one without it is not ours
_WRITE_AGAIN = "give overwrite=true to write this log again"


class Removed(NamedTuple):
    """Numbers of points of a log."""

    points: int  # of all sweeps
    moving: int  # removed because they move
    without_position: int  # removed because they are NaN in the log: missing returns, and those of the own vehicle

    def __str__(self) -> str:
        share = self.moving / max(self.points, 1)
        missing = f", and {self.without_position:,} without a position" if self.without_position else ""
        return f"removed {self.moving:,} of {self.points:,} points ({share:.2%}){missing}"


def write_clean_log(
    clean: CleanLog,
    log: Log,
    root: Path,
    suffix: str | None = None,
    record: Mapping[str, Any] | None = None,
    replace: bool = False,
) -> Removed:
    """Write a clean log to `root/<log_id>`, as `write_array_log` does, and `removed/NAME.npy` for each sweep.

    Args:
        clean: the clean log of `log`.
        log: the drive.
        root: parent folder, created if it does not exist.
        suffix: suffix of the clouds; None = `own_suffix`.
        record: content of `clean.json` in the folder, such as settings; None = it is not written.
        replace: replace an older folder when this one is complete; else an older one is a `CFlowError`.

    Convention: a mask has (N,) bool for the points of the sweep of `log`, True = not in the clean cloud. If the log is
        a folder of clouds with the same suffix, compressed or not, clouds keep their names, columns, types and
        VIEWPOINT, and the points their stored numbers: they are not de-skewed, and in the world's frame if they were.
        Otherwise, points are in the ego frame, as the log has them. All other readings, such as `read_as=inverted` or
        `points_feet`, are applied: read the output without them.
    """
    suffix = own_suffix(log) if suffix is None else suffix
    if suffix.lower() not in SUFFIXES:
        raise CFlowError(f"suffix={suffix}: give one of {', '.join(SUFFIXES)}")
    own = log.unwrapped
    viewpoint = _viewpoint(log, suffix)
    names = cloud_names(log)
    total = Removed(0, 0, 0)
    sides = {}
    with new_folder(root, log.log_id, replace) as folder:
        (folder / REMOVED_FOLDER).mkdir()
        for index, name in enumerate(names):
            file = folder / POINTS_FOLDER / f"{name}{suffix}"
            removed = clean.removed(index)
            moving = int(clean.moving(index).sum())
            total = Removed(
                total.points + len(removed),
                total.moving + moving,
                total.without_position + int(removed.sum()) - moving,
            )
            np.save(folder / REMOVED_FOLDER / f"{name}.npy", removed)
            sweep = clean.sweep(index)
            if isinstance(own, ArraysLog) and _keeps_form(log, suffix):
                copy_rows(own.files[index], file, ~removed, own.bin_layout)
            else:
                write_sweep(file, clean, index, sweep, viewpoint)
            sides[name] = SweepSides.of(sweep)
        write_sides(folder, log.log_id, sides, has_viewpoints=viewpoint is not None)
        if record is not None:
            write_json(folder / RECORD_FILE, record)
    return total


def own_suffix(log: Log) -> str:
    """Return the suffix of the log's own clouds, without `.gz`.

    It is `.npy` if the log is not a folder of clouds, or if we do not write their format, such as `.csv`.
    """
    own = log.unwrapped
    if not isinstance(own, ArraysLog):
        return ".npy"
    suffix = suffix_of(own.files[0])
    return suffix if suffix in SUFFIXES else ".npy"


def stored_masks(folder: Path, log: Log) -> Callable[[int], np.ndarray]:
    """Return a function that reads the mask of a sweep which `write_clean_log` wrote to `folder`."""
    names = cloud_names(log)

    def read(index: int) -> np.ndarray:
        file = folder / REMOVED_FOLDER / f"{names[index]}.npy"
        rows = len(log.sweep(index).points)
        mask = read_npy(file, _WRITE_AGAIN)
        if mask.shape != (rows,) or mask.dtype != bool:
            raise CFlowError(f"{file} has {mask.dtype} of shape {mask.shape}, its sweep {rows} points: {_WRITE_AGAIN}")
        return mask

    return read


def _keeps_form(log: Log, suffix: str) -> bool:
    """Test whether the numbers of points in the files of a folder of clouds can stay as they are."""
    own = log.unwrapped
    if not isinstance(own, ArraysLog) or suffix_of(own.files[0]) != suffix.lower():
        return False
    return np.array_equal(own.ego_T_lidar, np.eye(4)) and set(OF_POINTS).isdisjoint(log.readings)


def _viewpoint(log: Log, suffix: str) -> str | None:
    """Return the frame of the points in `.pcd` files whose VIEWPOINT has the pose, as the log has it; None = none."""
    if suffix.lower() != ".pcd" or not log.unwrapped.has_viewpoints:
        return None
    return "world" if WORLD in log.readings else "sensor"
