"""Submission archives: packed the same bytes every time, read from a zip or a folder alike."""

from __future__ import annotations

import zipfile
from functools import partial
from pathlib import Path
from typing import Callable, Dict, Iterable, Union

from cflow_torch.data.atomic import atomic_file
from cflow_torch.data.paths import read_bytes
from cflow_torch.data.zips import member_names, open_zip, read_member
from cflow_torch.evaluation.submission.versions import METADATA_FILE, SubmissionVersion
from cflow_torch.types import CFlowError

_EARLIEST = (1980, 1, 1, 0, 0, 0)  # the first time that a zip can hold


def pack(folder: Union[str, Path], names: Iterable[str], file: Union[str, Path], version: SubmissionVersion) -> None:
    """Zip the files of a submission folder, atomically.

    Args:
        folder: root of the submission.
        names: frames to take.
        file: the zip to write.
        version: its metadata file is added if it has one.

    Convention: entries sorted by name, dated 1980-01-01, mode 0644, deflated: the same files and the same zlib give
        the same bytes.

    Raises:
        CFlowError: a file is missing.
    """
    folder = Path(folder)
    entries = sorted({*names, *([METADATA_FILE] if version.metadata is not None else [])})
    missing = [name for name in entries if not (folder / name).is_file()]
    if missing:
        raise CFlowError(f"{folder} lacks {len(missing)} files, first {missing[0]}")
    with atomic_file(file) as raw, zipfile.ZipFile(raw, "w", zipfile.ZIP_DEFLATED) as archive:
        for name in entries:
            entry = zipfile.ZipInfo(name, _EARLIEST)
            entry.compress_type = zipfile.ZIP_DEFLATED
            entry.create_system, entry.external_attr = 3, 0o100644 << 16
            archive.writestr(entry, (folder / name).read_bytes())


def open_archive(path: Union[str, Path]) -> Dict[str, Callable[[int], bytes]]:
    """The files of a zip or folder.

    Args:
        path: the zip or folder. Hidden files of a folder are passed over: an interrupted writer leaves some, and
            `pack` takes none.

    Returns:
        Name -> function that reads the file, given the bytes that it may have at most; sorted by name. It raises
        `CFlowError` or `OSError`.

    Raises:
        CFlowError: neither a zip nor a folder.
    """
    path = Path(path)
    if path.is_dir():
        files = {file.relative_to(path): file for file in sorted(path.rglob("*")) if file.is_file()}
        return {
            name.as_posix(): partial(read_bytes, file)
            for name, file in files.items()
            if not any(part.startswith(".") for part in name.parts)
        }
    if not path.is_file():
        raise CFlowError(f"{path} does not exist; give a zip, or the folder that it is made from")
    archive = open_zip(path)
    return {name: partial(read_member, archive, name) for name in member_names(archive)}
