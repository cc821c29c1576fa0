"""Which files an archive must hold, and how many rows each."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Iterable, Mapping, Sequence

from cflow_torch.data.log import Log
from cflow_torch.data.names import is_timestamp, safe_name
from cflow_torch.data.paths import read_bytes
from cflow_torch.evaluation.submission.masks import MaskArchive, log_mask, point_mask
from cflow_torch.evaluation.submission.versions import SubmissionVersion
from cflow_torch.types import CFlowError

STRIDE = 5  # every fifth pair of a log is evaluated


@dataclass(frozen=True)
class Frame:
    """One file that an archive must hold.

    Args:
        name: inside the archive, `<log>/<stem>.feather`.
        rows: number of its rows.
    """

    name: str
    rows: int


@dataclass(frozen=True)
class PlannedFrame:
    """A frame and where its flow comes from: the pair (index, index + 1) of a log."""

    log: Log
    index: int
    name: str

    def expect(self, version: SubmissionVersion, masks: MaskArchive | None = None) -> Frame:
        """The file this frame becomes; reads the sweep.

        Raises:
            CFlowError: the sweep or its mask cannot be read.
        """
        sweep = self.log.sweep(self.index)
        if version.rows == "masked":
            return Frame(self.name, int(point_mask(self.log, self.index, sweep, masks).sum()))
        return Frame(self.name, len(sweep.points))


def plan_log(
    log: Log, version: SubmissionVersion, listed: Mapping[str, Sequence[int]] | None = None
) -> list[PlannedFrame]:
    """Frames of one log that a submission needs, in the order of time.

    Args:
        log: one drive.
        version: the format.
        listed: log id -> time stamps of exactly the frames to submit (a frame list, or a mask archive's `frames`).

    Convention:
        Without a list: the sweeps that carry an evaluation mask where the format goes by masks and the log has any
        (the last sweep left out: it has no successor, and OpenSceneFlow writes no file for it either), else the pairs
        0, 5, 10 ... Names by position count sweeps of the log from 0.

    Raises:
        CFlowError: a listed time stamp is not in the log, or is its last; the log's name is no folder name.
    """
    safe_name(log.log_id, "the log")
    pairs = range(len(log.timestamps) - 1)
    if listed is not None:
        indices = [_position(log, stamp) for stamp in sorted(set(listed.get(log.log_id, ())))]
    else:
        by_mask = version.frames == "evaluated"
        indices = [i for i in pairs if by_mask and log_mask(log, i) is not None] or list(pairs[::STRIDE])
    return [PlannedFrame(log, i, version.file_name(log.log_id, i, log.timestamps[i])) for i in indices]


def read_frame_list(file: str | Path) -> dict[str, list[int]]:
    """A list of frames: plain text, one `<log>/<time stamp>` a line, # for comments.

    Returns:
        Log id -> time stamps.

    Raises:
        CFlowError: the file is no text, cannot be read, or a line is no frame.
    """
    file = Path(file)
    try:
        lines = read_bytes(file).decode("utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise CFlowError(f"{file} cannot be read as a text file of frames ({error})") from error
    result: dict[str, list[int]] = {}
    for number, line in enumerate(lines, 1):
        entry = line.partition("#")[0].strip()
        if not entry:
            continue
        log, _, stamp = entry.rpartition("/")
        if not log or not is_timestamp(stamp):
            raise CFlowError(f"{file}, line {number}: {entry!r} is no frame; write <log>/<time stamp>")
        result.setdefault(log, []).append(int(stamp))
    return result


def require_logs(logs: Iterable[Log], listed: Mapping[str, Sequence[int]] | None) -> None:
    """Refuse two logs of one name, and a list that names logs which are not there.

    Raises:
        CFlowError: as said.
    """
    names = [log.log_id for log in logs]
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise CFlowError(f"several logs are called {', '.join(twice)}: their files would overwrite each other")
    missing = sorted(set(listed or ()) - set(names))
    if missing:
        raise CFlowError(f"{len(missing)} listed logs are not in the data: {', '.join(missing[:5])}")


def _position(log: Log, timestamp: int) -> int:
    stamps = list(log.timestamps)
    if timestamp not in stamps[:-1]:
        raise CFlowError(f"{log.log_id}/{timestamp} is listed but is no sweep of the log, or its last: it has no flow")
    return stamps.index(timestamp)
