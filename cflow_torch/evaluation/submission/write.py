"""Files of a submission folder, each whole or absent, and their zip: the same bytes every time."""

from __future__ import annotations

import json
import zipfile
from functools import partial
from pathlib import Path
from typing import Iterable, Mapping

import numpy as np
import pyarrow as pa
from pyarrow import feather

from cflow_torch.data.atomic import atomic_file
from cflow_torch.data.names import folder_in
from cflow_torch.data.paths import read_bytes
from cflow_torch.evaluation.submission.check import check_file
from cflow_torch.evaluation.submission.plan import Frame
from cflow_torch.evaluation.submission.versions import METADATA_FILE, SubmissionVersion

_EARLIEST = (1980, 1, 1, 0, 0, 0)  # the first time that a zip can hold


def write_frame(folder: str | Path, name: str, columns: Mapping[str, np.ndarray]) -> None:
    """Write one frame's file atomically.

    Args:
        folder: root of the submission.
        name: inside the archive, `<log>/<stem>.feather`.
        columns: what `encode` returned.

    Raises:
        CFlowError: the log's name cannot be a folder's.
    """
    log_id, _, stem = name.rpartition("/")
    file = folder_in(Path(folder), log_id, "the log") / stem
    table = pa.table({key: pa.array(values) for key, values in columns.items()})
    with atomic_file(file) as stream:
        feather.write_feather(table, stream)


def write_metadata(folder: str | Path, version: SubmissionVersion) -> None:
    """Write `metadata.json`, for versions that have one."""
    if version.metadata is not None:
        with atomic_file(Path(folder) / METADATA_FILE) as file:
            file.write((json.dumps(dict(version.metadata), indent=4) + "\n").encode())


def is_complete(folder: str | Path, frame: Frame, version: SubmissionVersion) -> bool:
    """Whether a frame's file is there already and passes every check."""
    return not check_file(frame.name, partial(read_bytes, Path(folder) / frame.name), frame.rows, version)


def pack(folder: str | Path, names: Iterable[str], file: str | Path, version: SubmissionVersion) -> None:
    """Zip the files of a submission folder, atomically.

    Args:
        folder: root of the submission.
        names: frames to take.
        file: the zip to write.
        version: its metadata file is added if it has one.

    Convention: entries sorted by name, dated 1980-01-01, mode 0644, deflated: the same files and the same zlib give
        the same bytes.

    Raises:
        OSError: a file is missing; then there is no zip.
    """
    folder = Path(folder)
    entries = sorted({*names, *([METADATA_FILE] if version.metadata is not None else [])})
    with atomic_file(file) as raw, zipfile.ZipFile(raw, "w", zipfile.ZIP_DEFLATED) as archive:
        for name in entries:
            entry = zipfile.ZipInfo(name, _EARLIEST)
            entry.compress_type = zipfile.ZIP_DEFLATED
            entry.create_system, entry.external_attr = 3, 0o100644 << 16
            archive.writestr(entry, (folder / name).read_bytes())
