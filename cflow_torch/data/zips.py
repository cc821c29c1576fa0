"""Zip archives from elsewhere: read member by member; nothing is ever written where an archive says."""

from __future__ import annotations

import zipfile
from pathlib import Path
from typing import List

from cflow_torch.types import CFlowError


def open_zip(path: Path) -> zipfile.ZipFile:
    """An archive.

    Raises:
        CFlowError: no such file, or no zip.
    """
    try:
        return zipfile.ZipFile(path)
    except Exception as error:  # a damaged zip makes zipfile raise nearly anything
        raise CFlowError(f"{path} cannot be read as a zip ({error}): copy or pack it again") from error


def read_member(archive: zipfile.ZipFile, name: str, limit: int) -> bytes:
    """What a member holds.

    Args:
        archive: from `open_zip`.
        name: of the member.
        limit: bytes that it may have at most.

    Raises:
        CFlowError: there is no such member, or it is larger, encrypted or damaged.
    """
    try:
        info = archive.getinfo(name)
        if info.file_size > limit:
            raise ValueError(f"it claims {info.file_size} bytes, up to {limit} are right here")
        with archive.open(info) as member:
            return member.read(info.file_size + 1)  # without a number it would unpack up to 2 GiB, whatever is claimed
    except Exception as error:  # a damaged zip makes zipfile raise nearly anything
        raise CFlowError(f"it cannot be read ({error})") from error


def member_names(archive: zipfile.ZipFile) -> List[str]:
    """Names of all members that are no folders, as stored, sorted; one that occurs twice is there twice."""
    return sorted(info.orig_filename for info in archive.infolist() if not info.filename.endswith("/"))
