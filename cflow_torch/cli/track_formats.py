"""The forms of tracks that `cflow flow tracks=...` writes into the folder of a log, next to the table of tracks."""

from __future__ import annotations

from pathlib import Path
from typing import Callable, NamedTuple

from cflow_torch.applications.detection_files import (
    DETECTIONS_FILE,
    OPENPCDET_FILE,
    TRACKING_FILE,
    write_nuscenes,
    write_openpcdet,
)
from cflow_torch.applications.instance_files import (
    CLASSES,
    CLASSES_OF_READER,
    FRAMES_FILE,
    INSTANCES_FILE,
    write_drivestudio,
)
from cflow_torch.applications.kitti_tracks import write_kitti
from cflow_torch.applications.track_table import TRACKS_FILE, Table, write_mot
from cflow_torch.data.log import Log

_Writer = Callable[[Path, Table, Log, str], None]  # of the files in the folder of a log; the last one is its data set


class TrackFormat(NamedTuple):
    files: tuple[str, ...]
    write: _Writer


def _one_file(name: str, write: Callable[[Path, Table, Log], None]) -> TrackFormat:
    return TrackFormat((name,), lambda folder, table, log, _: write(folder / name, table, log))


def _write_drivestudio(folder: Path, table: Table, log: Log, data_set: str) -> None:
    write_drivestudio(folder, table, log, *CLASSES_OF_READER.get(data_set, CLASSES))


TRACK_FORMATS = {
    "mot": _one_file("mot.txt", write_mot),
    "kitti": _one_file("kitti.txt", write_kitti),
    "openpcdet": _one_file(OPENPCDET_FILE, write_openpcdet),
    "drivestudio": TrackFormat((INSTANCES_FILE, FRAMES_FILE), _write_drivestudio),
    "nuscenes": TrackFormat(
        (DETECTIONS_FILE, TRACKING_FILE), lambda folder, table, log, _: write_nuscenes(folder, table, log)
    ),
}
TRACK_FILES = {TRACKS_FILE, *(name for form in TRACK_FORMATS.values() for name in form.files)}
