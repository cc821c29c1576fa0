"""One table of nuScenes' kind: a JSON list of flat rows, checked while it is parsed."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, Collection, Dict, List, Optional, Tuple

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
_TYPES = {"timestamp": int, "is_key_frame": bool}  # all others are text


def read_table(folder: Path, table: str, key: str = "", values: Collection[str] = ()) -> List[Row]:
    """Rows of a table with the fields of `FIELDS`.

    Args:
        folder: of the version.
        table: name in `FIELDS`.
        key, values: only rows whose field `key` is one of `values`; no key = all rows.

    Raises:
        CFlowError: the file is missing, truncated, no list of rows, or a row lacks a field or has one of another type.
    """
    file = folder / f"{table}.json"
    names = FIELDS[table]

    def use(row: Row) -> Optional[Row]:  # called for each row as it is parsed, so that the rest is never held
        missing = [name for name in names if name not in row]
        if missing:
            raise CFlowError(
                f"{file}: a row lacks {missing}; it has {sorted(row)[:12]}. Put the table {table} of the data set there"
            )
        if key and row[key] not in values:
            return None
        wrong = [name for name in names if not _fits(name, row[name])]
        if wrong:
            raise CFlowError(
                f"{file}: the field {wrong[0]} of a row is {row[wrong[0]]!r:.80}, not what the format says; "
                "copy the tables again"
            )
        return {name: row[name] for name in names}

    try:
        rows = json.loads(read_bytes(file), object_hook=use)
    except CFlowError:
        raise
    except FileNotFoundError:
        raise CFlowError(f"{file} is missing; copy all tables of the version") from None
    except (OSError, ValueError, RecursionError) as error:
        raise CFlowError(f"cannot read {file} as JSON: {error}; it may be truncated, copy it again") from error
    if not isinstance(rows, list) or any(not isinstance(row, (dict, type(None))) for row in rows):
        raise CFlowError(f"{file} is no list of rows; copy the table again")
    return [row for row in rows if row is not None]


def _fits(name: str, value: Any) -> bool:
    if name in _NUMBERS:
        numbers = isinstance(value, list) and len(value) == _NUMBERS[name]
        return numbers and all(isinstance(v, (int, float)) and not isinstance(v, bool) for v in value)
    return type(value) is _TYPES.get(name, str)
