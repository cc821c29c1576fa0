"""One table of nuScenes' kind: a JSON list of flat rows, checked while it is parsed."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any, Collection, Dict, Iterator, List, Optional, Tuple

from cflow_torch.data.json_file import is_number, is_whole, parse_json, shown
from cflow_torch.data.paths import read_bytes
from cflow_torch.types import CFlowError

Row = Dict[str, Any]
# The fields that are read; every other field of the format may be absent.
FIELDS: Dict[str, Tuple[str, ...]] = {
    "scene": ("token", "name"),
    "sample": ("token", "timestamp", "scene_token"),
    "sensor": ("token", "channel", "modality"),
    "calibrated_sensor": ("token", "sensor_token", "translation", "rotation"),
    "sample_data": (
        *("token", "sample_token", "ego_pose_token", "calibrated_sensor_token"),
        *("timestamp", "is_key_frame", "filename", "prev", "next"),
    ),
    "ego_pose": ("token", "translation", "rotation"),
    "category": ("token", "name"),
    "instance": ("token", "category_token"),
    "sample_annotation": ("sample_token", "instance_token", "translation", "size", "rotation"),
}
_NUMBERS = {"translation": 3, "size": 3, "rotation": 4}
_MAX_TIME = ((1 << 63) - 1) // 1000  # microseconds, which become nanoseconds in an int64
MAX_TABLE_BYTES = 4 << 30  # the largest one known, sample_data of v1.0-trainval, has 1.2 GB
_BLOCK = 1 << 20  # bytes that are parsed at once; no row has more
_NEXT_ROW = re.compile(rb"\}[ \t\n\r]*,[ \t\n\r]*\{")


def read_table(folder: Path, table: str, key: str = "", values: Collection[str] = ()) -> List[Row]:
    """Rows of a table with the fields of `FIELDS`.

    Args:
        folder: of the version.
        table: name in `FIELDS`.
        key, values: only rows whose field `key` is one of `values`; no key = all rows.

    Cost: memory of the file, of the rows that are kept, and 30 MB.

    Raises:
        CFlowError: the file is missing, truncated, no list of rows, or a row lacks a field or has one of another type.
    """
    file = folder / f"{table}.json"
    names = FIELDS[table]

    def use(row: Row) -> Optional[Row]:  # called for each row as it is parsed, so that the rest is never held
        missing = [name for name in names if name not in row]
        if missing:
            raise CFlowError(
                f"{file}: a row lacks {missing}; it has {shown(sorted(row))}. Put the table {table} of the data set "
                "there"
            )
        if key and type(row[key]) is str and row[key] not in values:
            return None
        wrong = [name for name in names if not _fits(name, row[name])]
        if wrong:
            raise CFlowError(
                f"{file}: the field {wrong[0]} of a row is {shown(row[wrong[0]])}, not what the format says; "
                "copy the tables again"
            )
        return {name: row[name] for name in names}

    try:
        data = read_bytes(file, MAX_TABLE_BYTES)
    except FileNotFoundError:
        raise CFlowError(f"{file} is missing; copy all tables of the version") from None
    except OSError as error:
        raise CFlowError(f"cannot read {file} ({error}); copy it again") from error
    rows: List[Row] = []
    for block in _blocks(data, file):
        part = parse_json(block, file, use)
        kept = list(filter(None, part)) if isinstance(part, list) else [part]
        if not all(type(row) is dict for row in kept):
            raise CFlowError(f"{file} is no list of rows; copy the table again")
        rows += kept
    return rows


def _blocks(data: bytes, file: Path) -> Iterator[bytes]:
    """A list in pieces, each a list of whole rows: what is in one of them is forgotten before the next is parsed."""
    begin, opening = 0, b""
    while len(data) - begin > _BLOCK:
        end, last = begin + _BLOCK, None
        while last is None and end > begin:
            end = data.rfind(b"}", begin, end)
            last = _NEXT_ROW.match(data, end) if end >= 0 else None
        if last is None:
            raise CFlowError(f"{file} has a row of more than {_BLOCK} bytes; is it a table? Copy it again")
        yield opening + data[begin : end + 1] + b"]"
        begin, opening = last.end() - 1, b"["
    yield opening + data[begin:]


def _fits(name: str, value: Any) -> bool:
    if name in _NUMBERS:
        return isinstance(value, list) and len(value) == _NUMBERS[name] and all(map(is_number, value))
    if name == "timestamp":
        return is_whole(value, _MAX_TIME)
    return type(value) is (bool if name == "is_key_frame" else str)
