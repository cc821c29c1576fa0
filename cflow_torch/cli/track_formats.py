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
from cflow_torch.applications.instance_files import FRAMES_FILE, INSTANCES_FILE, write_drivestudio
from cflow_torch.applications.kitti_tracks import KITTI_FILE, write_kitti
from cflow_torch.applications.track_table import MOT_FILE, TRACKS_FILE, Table, write_mot
from cflow_torch.data.log import Log


class TrackFormat(NamedTuple):
    files: tuple[str, ...]
    write: Callable[[Path, Table, Log, str], None]  # into the folder of a log; the last argument is its data set


TRACK_FORMATS = {
    "mot": TrackFormat((MOT_FILE,), write_mot),
    "kitti": TrackFormat((KITTI_FILE,), write_kitti),
    "openpcdet": TrackFormat((OPENPCDET_FILE,), write_openpcdet),
    "drivestudio": TrackFormat((INSTANCES_FILE, FRAMES_FILE), write_drivestudio),
    "nuscenes": TrackFormat((DETECTIONS_FILE, TRACKING_FILE), write_nuscenes),
}
TRACK_FILES = {TRACKS_FILE, *(name for form in TRACK_FORMATS.values() for name in form.files)}
