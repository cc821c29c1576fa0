"""Zip archives from elsewhere: opened and read within bounds; nothing is ever written where an archive says."""

from __future__ import annotations

import os
import zipfile
from pathlib import Path
from typing import IO, List

from cflow_torch.types import CFlowError

MAX_DIRECTORY_BYTES = 1 << 24  # of the list of members: 100,000 names of 168 bytes; a submission has at most 10,000
_END, _LOCATOR, _END64 = b"PK\x05\x06", b"PK\x06\x07", b"PK\x06\x06"
_TAIL = (1 << 16) + 22 + 20 + 56  # bytes in which the end of the list lies: a comment, three records
_METHODS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)  # the others unpack without a bound


def open_zip(path: Path) -> zipfile.ZipFile:
    """An archive whose list of members fits into memory.

    Raises:
        CFlowError: no such file, no zip, or a list that is too long.
    """
    try:
        with open(path, "rb") as file:
            claimed = _directory_bytes(file)
        if claimed > MAX_DIRECTORY_BYTES:
            raise CFlowError(f"{path}: the list of members has {claimed} bytes, up to {MAX_DIRECTORY_BYTES} are read")
        return zipfile.ZipFile(path)
    except CFlowError:
        raise
    except Exception as error:  # a damaged zip makes zipfile raise nearly anything
        raise CFlowError(f"{path} cannot be read as a zip ({error}): copy or pack it again") from error


def read_member(archive: zipfile.ZipFile, name: str, limit: int) -> bytes:
    """What a member holds.

    Args:
        archive: from `open_zip`.
        name: of the member.
        limit: bytes that it may have at most.

    Raises:
        CFlowError: there is no such member, or two; it is larger, encrypted, packed with something else than deflate,
            or damaged.
    """
    try:
        info = archive.getinfo(name)
        if info.file_size > limit:
            raise CFlowError(f"it claims {info.file_size} bytes, up to {limit} are right here")
        if info.compress_type not in _METHODS:
            raise CFlowError(f"it is packed by method {info.compress_type}: pack it with deflate")
        with archive.open(info) as member:
            return member.read(info.file_size + 1)  # without a number it would unpack up to 2 GiB, whatever is claimed
    except CFlowError:
        raise
    except KeyError:
        raise CFlowError("there is none") from None
    except Exception as error:  # a damaged zip makes zipfile raise nearly anything
        raise CFlowError(f"it cannot be read ({error})") from error


def member_names(archive: zipfile.ZipFile) -> List[str]:
    """Names of all members that are no folders, as stored, sorted; one that occurs twice is there twice."""
    return sorted(info.orig_filename for info in archive.infolist() if not info.filename.endswith("/"))


def _directory_bytes(file: IO[bytes]) -> int:
    """What the end of a zip claims as the size of its list of members; the largest, where there are several claims."""
    size = file.seek(0, os.SEEK_END)
    file.seek(max(size - _TAIL, 0))
    tail = file.read(_TAIL)
    plain = tail[-22:-18] == _END and tail[-2:] == b"\0\0"
    at = len(tail) - 22 if plain else tail.rfind(_END)
    if at < 0:
        return 0
    claims = [int.from_bytes(tail[at + 12 : at + 16], "little")]
    if at >= 20 and tail[at - 20 : at - 16] == _LOCATOR:  # of the record for archives beyond 4 GiB
        told = int.from_bytes(tail[at - 12 : at - 4], "little")
        for place in (told, size - len(tail) + at - 20 - 56):
            if 0 <= place <= size:
                file.seek(place)
                record = file.read(56)
                if record[:4] == _END64:
                    claims = [claim for claim in claims if claim != 0xFFFFFFFF] + [
                        int.from_bytes(record[40:48], "little")
                    ]
    return max(claims)
