"""Which points version 1 asks for: the official mask files, the mask a log brings, or the official rule."""

from __future__ import annotations

import re
import zipfile
from pathlib import Path

import numpy as np
import pyarrow as pa

from cflow_torch.data.arrow_file import FeatherFile
from cflow_torch.data.file_errors import file_errors
from cflow_torch.data.log import Log
from cflow_torch.types import CFlowError, Sweep, as_numpy

_MASK = re.compile(r"(?P<log>.+)/(?P<stamp>0|[1-9][0-9]{0,18})\.feather", re.ASCII)
_HALF_SIDE = 50.0  # metres; the official masks hold the points that are not ground with |x|, |y| <= 50


class MaskArchive:
    """The official evaluation masks: a zip of `<log>/<time stamp>.feather`, each one bool column.

    Args:
        file: the zip.

    Attributes:
        frames: log id -> time stamps that are evaluated.

    Raises:
        CFlowError: the file is no such zip.
    """

    def __init__(self, file: str | Path) -> None:
        self.file = Path(file)
        self.frames: dict[str, list[int]] = {}
        with file_errors(self.file):
            self._zip = zipfile.ZipFile(self.file)
        for match in map(_MASK.fullmatch, sorted(self._zip.namelist())):
            if match is not None:
                self.frames.setdefault(match["log"], []).append(int(match["stamp"]))
        if not self.frames:
            raise CFlowError(f"{self.file} holds no masks; it must hold <log>/<time stamp>.feather")

    def mask(self, log_id: str, timestamp: int) -> np.ndarray:
        """(N,) bool mask of a sweep.

        Raises:
            CFlowError: no mask for this sweep, or it cannot be read.
        """
        name = f"{log_id}/{timestamp}.feather"
        with file_errors(f"{self.file}: {name}"):
            file = FeatherFile(name, self._zip.read(name))
            columns = file.read(file.names).columns
        if len(columns) != 1 or not pa.types.is_boolean(columns[0].type) or columns[0].null_count:
            raise CFlowError(f"{self.file}: {name} must hold one bool column without empty values")
        return columns[0].to_numpy()


def point_mask(log: Log, index: int, sweep: Sweep, masks: MaskArchive | None = None) -> np.ndarray:
    """Points of a sweep that are evaluated.

    Args:
        log: may have a method `eval_mask(index)` that gives (N,) bool or None, as `HDF5Log` has.
        index: number of the sweep.
        sweep: the sweep.
        masks: official masks; they win.

    Returns:
        (N,) bool: the official mask, else the log's own, else the official rule: not ground, |x| and |y| <= 50 m.

    Raises:
        CFlowError: the mask has another number of rows than the sweep; neither mask nor ground is known.
    """
    points = as_numpy(sweep.points)
    mask = log_mask(log, index) if masks is None else masks.mask(log.log_id, log.timestamps[index])
    if mask is None:
        if sweep.is_ground is None:
            raise CFlowError(f"log {log.log_id} has neither masks nor ground: give the official masks, or its map")
        return (np.abs(points[:, :2]) <= _HALF_SIDE).all(axis=1) & ~as_numpy(sweep.is_ground)
    if mask.shape != (len(points),):
        name = f"{log.log_id}/{log.timestamps[index]}"
        raise CFlowError(f"evaluation mask of {name} has {len(mask)} rows, the sweep has {len(points)}")
    return mask


def log_mask(log: Log, index: int) -> np.ndarray | None:
    """(N,) bool evaluation mask that a log brings itself, None where it has none."""
    read = getattr(log, "eval_mask", None)
    return None if read is None else read(index)
