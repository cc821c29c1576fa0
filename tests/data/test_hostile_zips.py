"""Zips that lie about sizes, unpack without an end, or hold a million members; lists of frames."""

from __future__ import annotations

import io
import struct
import tracemalloc
import zipfile
import zlib
from pathlib import Path
from typing import Callable, Dict, List

import numpy as np
import pyarrow as pa
import pytest
from pyarrow import feather

from cflow_torch import CFlowError
from cflow_torch.data.zips import MAX_DIRECTORY_BYTES, member_names, open_zip, read_member
from cflow_torch.evaluation.submission.check import check_submission
from cflow_torch.evaluation.submission.masks import MaskArchive
from cflow_torch.evaluation.submission.plan import MAX_LIST_BYTES, Frame, read_frame_list
from cflow_torch.evaluation.submission.versions import get_version

NAME = "log/315966265259836000.feather"
FRAMES = [Frame(NAME, 5)]
BOMB = 1 << 27


def mask_file() -> bytes:
    file = io.BytesIO()
    feather.write_feather(pa.table({"mask": np.ones(5, bool)}), file, compression="uncompressed")
    return file.getvalue()


def zipped(members: List, method: int = zipfile.ZIP_DEFLATED) -> bytes:
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", method, compresslevel=1) as archive:
        for name, data in members:
            archive.writestr(zipfile.ZipInfo(name), data, method)
    return file.getvalue()


def with_field(data: bytes, mark: bytes, at: int, field: bytes) -> bytes:
    """Overwrite a field in every record of a kind."""
    made, start = bytearray(data), data.find(mark)
    while start >= 0:
        made[start + at : start + at + len(field)] = field
        start = data.find(mark, start + 1)
    return bytes(made)


def claiming(data: bytes, size: int) -> bytes:
    """A zip whose members say that they have this size, in the list and before each."""
    field = struct.pack("<I", size)
    return with_field(with_field(data, b"PK\1\2", 24, field), b"PK\3\4", 22, field)


def encrypted(data: bytes) -> bytes:
    return with_field(with_field(data, b"PK\1\2", 8, b"\1\0"), b"PK\3\4", 6, b"\1\0")


MEMBERS: Dict[str, Callable[[], bytes]] = {
    "a bomb": lambda: zipped([(NAME, bytes(BOMB))]),
    "a bomb that claims little": lambda: claiming(zipped([(NAME, bytes(BOMB))]), 100),
    "a claim of 4 GiB": lambda: claiming(zipped([(NAME, b"x")]), (1 << 32) - 2),
    "bzip2": lambda: zipped([(NAME, mask_file())], zipfile.ZIP_BZIP2),
    "lzma": lambda: zipped([(NAME, mask_file())], zipfile.ZIP_LZMA),
    "unknown method": lambda: with_field(zipped([(NAME, mask_file())]), b"PK\1\2", 10, b"\x63\0"),
    "encrypted": lambda: encrypted(zipped([(NAME, mask_file())])),
    "wrong sum": lambda: with_field(zipped([(NAME, mask_file())]), b"PK\1\2", 16, b"1234"),
    "elsewhere": lambda: with_field(zipped([(NAME, mask_file())]), b"PK\1\2", 42, b"\xff\xff\xff\x7f"),
    "end of the name": lambda: zipped([(NAME + "#.txt", mask_file())]).replace(b"#", b"\0"),
    "no name": lambda: zipped([("", b"")]),
    "nothing": lambda: b"",
    "no list": lambda: zipped([(NAME, mask_file())])[:-30],
    "name that is no text": lambda: with_field(
        with_field(zipped([(NAME, mask_file())]), b"PK\1\2", 8, b"\0\x08"), b"PK\1\2", 46, b"\xff\xfe"
    ),
}


@pytest.mark.parametrize("kind", sorted(MEMBERS))
def test_hostile_members(kind: str, tmp_path: Path) -> None:
    (tmp_path / "a.zip").write_bytes(MEMBERS[kind]())
    tracemalloc.start()
    with pytest.raises(CFlowError, match=r"a\.zip"):
        MaskArchive(tmp_path / "a.zip").mask("log", 315966265259836000)
    problems = check_submission(tmp_path / "a.zip", get_version(1), FRAMES)
    most = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert problems and all("\n" not in line for line in problems)
    assert most < 16 << 20, kind


@pytest.mark.parametrize("claim", [100, 1 << 20])
def test_a_member_gives_no_more_than_it_claims(claim: int, tmp_path: Path) -> None:
    """Also where the sum of what it claims is right: the rest is never unpacked."""
    data = claiming(zipped([(NAME, bytes(BOMB))]), claim)
    crc = struct.pack("<I", zlib.crc32(bytes(claim)))
    data = with_field(with_field(data, b"PK\1\2", 16, crc), b"PK\3\4", 14, crc)
    (tmp_path / "a.zip").write_bytes(data)
    tracemalloc.start()
    with open_zip(tmp_path / "a.zip") as archive:
        assert read_member(archive, NAME, claim) == bytes(claim)
        with pytest.raises(CFlowError, match=f"up to {claim - 1}"):
            read_member(archive, NAME, claim - 1)
    assert tracemalloc.get_traced_memory()[1] < 16 << 20
    tracemalloc.stop()


@pytest.mark.parametrize("end", ["plain", "comment", "64 bits", "64 bits, told place"])
def test_a_list_of_members_that_is_too_long(end: str, tmp_path: Path) -> None:
    """400,000 members in 19 MB would take 300 MB to list; refused by the claimed size of the list, wherever it is."""
    entry = b"PK\1\2" + bytes(42)
    count = MAX_DIRECTORY_BYTES // len(entry) + 1
    size, data = count * len(entry), entry * count
    if end.startswith("64"):
        record = b"PK\6\6" + struct.pack("<QHHLLQQQQ", 44, 45, 45, 0, 0, count, count, size, 0)
        between = b"" if end == "64 bits" else bytes(30)
        data += record + between + b"PK\6\7" + struct.pack("<LQL", 0, len(data), 1)
        data += b"PK\5\6" + struct.pack("<HHHHLLH", 0, 0, 0xFFFF, 0xFFFF, 0xFFFFFFFF, 0xFFFFFFFF, 0)
    else:
        comment = b"x" * 500 if end == "comment" else b""
        data += b"PK\5\6" + struct.pack("<HHHHLLH", 0, 0, count % 65536, count % 65536, size, 0, len(comment)) + comment
    (tmp_path / "a.zip").write_bytes(data)
    tracemalloc.start()
    with pytest.raises(CFlowError, match=f"{size} bytes, up to"):
        open_zip(tmp_path / "a.zip")
    assert tracemalloc.get_traced_memory()[1] < 1 << 20
    tracemalloc.stop()


def test_members_with_large_numbers_and_comments_are_read(tmp_path: Path) -> None:
    """Ends with a comment that looks like another end, and lists of 64 bits."""
    for comment in (b"", b"PK", b"x" * 65535):
        with zipfile.ZipFile(tmp_path / "a.zip", "w") as archive:
            with archive.open(NAME, "w", force_zip64=True) as member:
                member.write(mask_file())
            archive.comment = comment
        with open_zip(tmp_path / "a.zip") as archive:
            assert member_names(archive) == [NAME] and read_member(archive, NAME, 10**6) == mask_file()


def test_masks_that_are_there_twice(tmp_path: Path) -> None:
    with pytest.warns(UserWarning, match="Duplicate"):
        (tmp_path / "a.zip").write_bytes(zipped([(NAME, mask_file()), (NAME, mask_file())]))
    with pytest.raises(CFlowError, match="twice"):
        MaskArchive(tmp_path / "a.zip")


@pytest.mark.parametrize("stem", ["\u00b2", "9" * 5000, "007", "-1", "\u0661"])
def test_names_of_masks_that_are_no_time_stamps(stem: str, tmp_path: Path) -> None:
    (tmp_path / "a.zip").write_bytes(zipped([(NAME, mask_file()), (f"log/{stem}.feather", mask_file())]))
    archive = MaskArchive(tmp_path / "a.zip")
    assert archive.frames == {"log": [315966265259836000]}


def test_a_frame_far_larger_than_its_rows_is_not_read(tmp_path: Path) -> None:
    """Also in a folder: thousands of frames of 256 MiB would take hours."""
    (tmp_path / "folder/log").mkdir(parents=True)
    (tmp_path / "folder" / NAME).write_bytes(bytes(2 << 20))
    (tmp_path / "a.zip").write_bytes(zipped([(NAME, bytes(2 << 20))]))
    for name in ("folder", "a.zip"):
        (problem,) = check_submission(tmp_path / name, get_version(1), FRAMES)
        assert "up to 1048896 are right here" in problem


@pytest.mark.parametrize("depth", [100, 500_000])
def test_deep_metadata(depth: int, tmp_path: Path) -> None:
    (tmp_path / "a.zip").write_bytes(zipped([("metadata.json", b"[" * depth + b"]" * depth)]))
    (problem,) = check_submission(tmp_path / "a.zip", get_version(2), [])
    assert problem.startswith("metadata.json")


def test_lists_of_frames(tmp_path: Path) -> None:
    file = tmp_path / "frames.txt"
    file.write_text("".join(f"log {stamp}\n" for stamp in range(200_000)))
    assert len(read_frame_list(file)["log"]) == 200_000, "in a second, not in an hour"
    for text, complaint in (("log " + "9" * 5000, "no frame"), ("log ²", "no frame"), ("log 1\nlog 1", "twice")):
        file.write_text(text, encoding="utf-8")
        with pytest.raises(CFlowError, match=complaint):
            read_frame_list(file)
    with open(file, "wb") as large:
        large.truncate(MAX_LIST_BYTES + 1)
    with pytest.raises(CFlowError, match="up to"):
        read_frame_list(file)
    file.write_bytes(b"log 1\xff\n")
    with pytest.raises(CFlowError, match="list of frames"):
        read_frame_list(file)
