"""The frames and the points that an archive must contain: frame lists, evaluation masks, and the official rules."""

from __future__ import annotations

import zipfile
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Iterable, Mapping, Sequence

import numpy as np

from cflow_torch.data.arrow_file import FeatherFile
from cflow_torch.data.file_errors import file_errors
from cflow_torch.data.log import Log
from cflow_torch.data.paths import is_timestamp, read_bytes, safe_name
from cflow_torch.evaluation.submission.archive import SubmissionVersion
from cflow_torch.types import CFlowError, Sweep, as_numpy

STRIDE = 5  # without masks, every fifth pair of a log is evaluated
_HALF_SIDE = 50.0  # metres; the official masks contain the points that are not ground with |x|, |y| <= 50


class MaskArchive:
    """The official evaluation masks: a zip of `<log>/<time stamp>.feather`, each with one bool column.

    `frames` maps log ids to the names of the sweeps that are evaluated.
    """

    def __init__(self, file: str | Path) -> None:
        self.file = Path(file)
        self.frames: dict[str, list[str]] = {}
        with file_errors(self.file):
            self._zip = zipfile.ZipFile(self.file)
        for path in map(PurePosixPath, sorted(self._zip.namelist())):
            if path.suffix == ".feather" and is_timestamp(path.stem):
                self.frames.setdefault(str(path.parent), []).append(path.stem)
        if not self.frames:
            raise CFlowError(f"{self.file} contains no masks: give a zip of <log>/<time stamp>.feather")

    def mask(self, log_id: str, sweep_name: str) -> np.ndarray:
        """Read the (N,) bool mask of a sweep; a missing or damaged one is a `CFlowError`."""
        name = f"{log_id}/{sweep_name}.feather"
        with file_errors(f"{self.file}: {name}"):
            file = FeatherFile(f"{self.file}: {name}", self._zip.read(name))
        if len(file.names) != 1:
            raise CFlowError(f"{self.file}: {name} must have one bool column, it has {file.names}")
        return file.vector(file.names[0], bool)


def point_mask(log: Log, index: int, sweep: Sweep, masks: MaskArchive | None = None) -> np.ndarray:
    """Return the (N,) bool mask of the points of sweep `index` that are evaluated.

    It is the official mask, else that of the log (`Log.eval_mask`), else the rule: no ground; |x|, |y| <= 50 m.
    """
    points = as_numpy(sweep.points)
    mask = log.eval_mask(index) if masks is None else masks.mask(log.log_id, log.sweep_name(index))
    if mask is None:
        if sweep.is_ground is None:
            raise CFlowError(f"log {log.log_id} has neither masks nor ground: give the official masks, or its map")
        return (np.abs(points[:, :2]) <= _HALF_SIDE).all(axis=1) & ~as_numpy(sweep.is_ground)
    if mask.shape != (len(points),):
        name = f"{log.log_id}/{log.sweep_name(index)}"
        raise CFlowError(f"evaluation mask of {name} has {len(mask)} rows, the sweep has {len(points)}")
    return mask


@dataclass(frozen=True)
class SubmittedFrame:
    """A frame to submit: the pair (index, index + 1) of a log."""

    log: Log
    index: int

    @property
    def name(self) -> str:
        """Return the path of the frame's file inside the archive."""
        return f"{self.log.log_id}/{self.log.sweep_name(self.index)}.feather"

    def count_rows(self, version: SubmissionVersion, masks: MaskArchive | None = None) -> int:
        """Count the rows that the file of the frame must have. This reads the sweep."""
        sweep = self.log.sweep(self.index)
        return int(point_mask(self.log, self.index, sweep, masks).sum()) if version.is_masked else len(sweep.points)


def plan_log(log: Log, listed: Mapping[str, Sequence[str]] | None = None) -> list[SubmittedFrame]:
    """List the frames of one log that a submission needs, in the order of time.

    `listed` maps log ids to the names of exactly the frames to submit. None = the sweeps that have an evaluation
    mask if the log has any, else the pairs 0, 5, 10 ... The last sweep is left out, because it has no successor;
    OpenSceneFlow writes no file for it either. A pair over a gap stays, because the server expects its file.
    """
    safe_name(log.log_id, "the log")
    pairs = range(len(log.timestamps) - 1)
    if listed is None:
        masked = [i for i in pairs if log.eval_mask(i) is not None]
        return [SubmittedFrame(log, i) for i in masked or pairs[::STRIDE]]
    wanted = set(listed.get(log.log_id, ()))
    for name in sorted(wanted - {log.sweep_name(i) for i in pairs}):
        raise CFlowError(
            f"{log.log_id}/{name} is listed, but is not a sweep of the log or is its last one, which has no flow"
        )
    return [SubmittedFrame(log, i) for i in pairs if log.sweep_name(i) in wanted]


def read_frame_list(file: str | Path) -> dict[str, list[str]]:
    """Read log id -> names of sweeps from a text file: one `<log>/<time stamp>` per line, # for comments."""
    file = Path(file)
    result: dict[str, list[str]] = {}
    with file_errors(file, "pass a text file of frames"):
        lines = read_bytes(file).decode("utf-8").splitlines()
    for number, line in enumerate(lines, 1):
        entry = line.partition("#")[0].strip()
        if not entry:
            continue
        log, _, stamp = entry.rpartition("/")
        if not log or not is_timestamp(stamp):
            raise CFlowError(f"{file}, line {number}: {entry!r} is not a frame; write <log>/<time stamp>")
        result.setdefault(log, []).append(stamp)
    return result


def require_logs(logs: Iterable[Log], listed: Mapping[str, Sequence[str]] | None) -> None:
    """Raise a `CFlowError` if two logs have the same name, or if a listed log is not in the data."""
    names = [log.log_id for log in logs]
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise CFlowError(f"several logs are called {', '.join(twice)}: their files would overwrite each other")
    missing = sorted(set(listed or ()) - set(names))
    if missing:
        raise CFlowError(f"{len(missing)} listed logs are not in the data: {', '.join(missing[:5])}")
