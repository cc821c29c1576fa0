"""Submission archives: packed the same bytes every time, read from a zip or a folder alike."""

from __future__ import annotations

import zipfile
from pathlib import Path
from typing import Dict, Iterable, List, Union

from cflow_torch.data.atomic import atomic_file
from cflow_torch.data.zips import member_names, open_zip, read_member
from cflow_torch.evaluation.submission.versions import METADATA_FILE, SubmissionVersion
from cflow_torch.types import CFlowError

_ROW_BYTES, _OTHER_BYTES = 64, 1 << 20  # a row has four columns of at most 8 bytes; metadata take some kilobytes
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


class Contents:
    """The files of a zip or folder, by name.

    Args:
        path: the zip or folder. Hidden files of a folder are passed over (an interrupted writer leaves some, and
            `pack` takes none); those of a zip are not.

    Attributes:
        names: of all files, sorted; a name that a zip holds twice occurs twice.

    Raises:
        CFlowError: neither a zip nor a folder.
    """

    def __init__(self, path: Union[str, Path]) -> None:
        self.path = Path(path)
        self.names: List[str]
        self._files: Dict[str, Path] = {}
        self._zip = None
        if self.path.is_dir():
            for file in self.path.rglob("*"):
                parts = file.relative_to(self.path).parts
                if file.is_file() and not any(part.startswith(".") for part in parts):
                    self._files["/".join(parts)] = file
            self.names = sorted(self._files)
            return
        if not self.path.is_file():
            raise CFlowError(f"{self.path} does not exist; give a zip, or the folder that it is made from")
        self._zip = open_zip(self.path)
        self.names = member_names(self._zip)

    def read(self, name: str, rows: int = 0) -> bytes:
        """Contents of a file.

        Args:
            name: of the file.
            rows: that it should have; one that is far too large for them is not read.

        Raises:
            CFlowError: it cannot be read, or is far too large.
        """
        limit = _OTHER_BYTES + _ROW_BYTES * rows
        if self._zip is not None:
            return read_member(self._zip, name, limit)
        try:
            size = self._files[name].stat().st_size
            if size > limit:
                raise CFlowError(f"it has {size} bytes, up to {limit} are right here")
            return self._files[name].read_bytes()
        except (OSError, KeyError) as error:
            raise CFlowError(f"cannot be read ({error})") from error

    def close(self) -> None:
        """Close the zip."""
        if self._zip is not None:
            self._zip.close()
