"""Zip archives: submissions that are checked, official masks; lists of frames."""

from __future__ import annotations

import io
import random
import struct
import zipfile
from pathlib import Path
from typing import Any, Dict, List

import numpy as np
import pyarrow as pa
from hypothesis import strategies as st
from pyarrow import feather

from cflow_torch import CFlowError
from cflow_torch.evaluation.submission.check import check_submission
from cflow_torch.evaluation.submission.masks import MaskArchive
from cflow_torch.evaluation.submission.plan import Frame
from cflow_torch.evaluation.submission.versions import get_version
from fuzzing.target import Target

_ROWS = 5
_FRAMES = [Frame(f"log-a/{position:010d}.feather", _ROWS) for position in (0, 5)]
_MASKS = [f"log-a/{stamp}.feather" for stamp in (315966265259836000, 315966265360032000)]
_NAMES = (
    *(
        "../../etc/passwd",
        "/etc/passwd",
        "C:\\boot.ini",
        "log-a\\0000000000.feather",
        "log-a/../x.feather",
        "CON",
        "nul.txt",
    ),
    *(
        "log-a/\0.feather",
        "log-a/0000000000.feather\0.txt",
        "",
        "/",
        "a/" * 500,
        "\u202egpj.exe",
        "log-a/²".encode().decode(),
    ),
    *(
        f"log-a/{'9' * 5000}.feather",
        "log-a/-1.feather",
        "log-b/0000000000.feather",
        "metadata.json",
        "log-a/0000000000.feather",
    ),
)


def _feather(columns: Dict[str, Any], compression: str) -> bytes:
    file = io.BytesIO()
    feather.write_feather(pa.table(columns), file, compression=compression)
    return file.getvalue()


def _frame(compression: str) -> bytes:
    flow = {f"flow_t{axis}_m": np.zeros(_ROWS, np.float16) for axis in "xyz"}
    return _feather({"is_valid": np.ones(_ROWS, bool), **flow}, compression)


def _mask(compression: str) -> bytes:
    return _feather({"mask": np.ones(_ROWS, bool)}, compression)


def _submission(compression: str, method: int) -> Dict[str, bytes]:
    return {"metadata.json": b'{"Is Supervised?": false}', **{frame.name: _frame(compression) for frame in _FRAMES}}


def _masks(compression: str, method: int) -> Dict[str, bytes]:
    return {name: _mask(compression) for name in _MASKS}


def _zip(members: Dict[str, bytes], method: int) -> bytes:
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", method) as archive:
        for name, data in members.items():
            archive.writestr(zipfile.ZipInfo(name, (1980, 1, 1, 0, 0, 0)), data, method)
    return file.getvalue()


def _seeds(members: Any) -> List[bytes]:
    kinds = (("uncompressed", zipfile.ZIP_STORED), ("uncompressed", zipfile.ZIP_DEFLATED), ("lz4", zipfile.ZIP_STORED))
    return [_zip(members(*kind), kind[1]) for kind in kinds]


def _crafted(members: Any) -> Any:
    whole = members("uncompressed", 0)
    return st.integers(0, (1 << 64) - 1).map(lambda number: _hostile_zip(dict(whole), random.Random(number)))


def _hostile_zip(members: Dict[str, bytes], chance: random.Random) -> bytes:
    """Members replaced, renamed, doubled, packed otherwise; then claims of the lists overwritten."""
    file = io.BytesIO()
    methods = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED, zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA)
    with zipfile.ZipFile(file, "w") as archive:
        for name, data in members.items():
            kind = chance.randrange(6)
            data = bytes(chance.choice((0, 10**4, 10**6))) if kind == 1 else b"[" * 10**5 if kind == 2 else data
            info = zipfile.ZipInfo(chance.choice(_NAMES) if kind == 3 else name)
            info.external_attr = chance.choice((0o100644, 0o120777, 0o010644)) << 16  # a file, a link, a pipe
            for _ in range(2 if kind == 4 else 1):
                archive.writestr(info, data, chance.choice(methods) if kind == 5 else zipfile.ZIP_DEFLATED)
        archive.comment = chance.choice((b"", b"", b"PK\5\6" + bytes(18), b"x" * 65535))
    made = bytearray(file.getvalue())
    for _ in range(chance.randrange(4)):
        _lie(made, chance)
    return bytes(made)


def _lie(made: bytearray, chance: random.Random) -> None:
    """Overwrite one field of a member's header, of the list or of its end."""
    marks = {
        b"PK\1\2": (6, 8, 10, 16, 20, 24, 28, 30, 38, 42),
        b"PK\3\4": (4, 6, 8, 14, 18, 22, 26, 28),
        b"PK\5\6": (8, 10, 12, 16, 20),
    }
    mark = chance.choice(list(marks))
    at = made.find(mark, chance.randrange(len(made)))
    if at >= 0:
        at += chance.choice(marks[mark])
        number = chance.choice((0, 1, 20, 99, 0x809, 65535, 10**6, 2**31 - 1, 2**32 - 1))
        field = struct.pack("<I", number)[: chance.choice((2, 4))]
        made[at : at + len(field)] = field


def _check(folder: Path) -> None:
    problems = check_submission(folder / "archive.zip", get_version(2), _FRAMES)
    if problems:
        raise CFlowError("\n".join(problems))


def _read_masks(folder: Path) -> None:
    masks = MaskArchive(folder / "masks.zip")
    try:
        for log_id, stamps in list(masks.frames.items())[:4]:
            for stamp in stamps[:4]:
                assert masks.mask(log_id, stamp).dtype == bool
    finally:
        masks.close()


_LIST = b"# frames\nlog-a/315966265259836000\nlog-a, 315966265360032000\nlog-b 7  # one more\n"
_MARKS = (
    b"PK\1\2",
    b"PK\3\4",
    b"PK\5\6",
    b"PK\6\6",
    b"PK\6\7",
    b"\xff\xff\xff\xff",
    *(name.encode() for name in _NAMES),
)
TARGETS = (
    Target(
        "zip-submission",
        "archive.zip",
        lambda: _seeds(_submission),
        _check,
        crafted=_crafted(_submission),
        tokens=_MARKS,
    ),
    Target("zip-masks", "masks.zip", lambda: _seeds(_masks), _read_masks, crafted=_crafted(_masks), tokens=_MARKS),
)
