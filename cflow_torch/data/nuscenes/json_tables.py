"""One table of nuScenes' kind: a JSON list of flat rows, checked while it is parsed."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Collection, Dict, List, Optional, Tuple

from cflow_torch.data.file_errors import file_errors, shortened
from cflow_torch.data.json_file import parse_json
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
        *("sample_token", "ego_pose_token", "calibrated_sensor_token"),
        *("timestamp", "is_key_frame", "filename"),
    ),
    "ego_pose": ("token", "translation", "rotation"),
    "category": ("token", "name"),
    "instance": ("token", "category_token"),
    "sample_annotation": ("sample_token", "instance_token", "translation", "size", "rotation"),
}


def read_table(folder: Path, table: str, key: str = "", values: Collection[str] = ()) -> List[Row]:
    """Rows of a table with the fields of `FIELDS`.

    Args:
        folder: of the version.
        table: name in `FIELDS`.
        key, values: only rows whose field `key` is one of `values`; no key = all rows.

    Cost: memory of twice the file, and of the rows that are kept.

    Raises:
        CFlowError: the file is missing, truncated, no list of rows, or a row lacks a field.
    """
    file = folder / f"{table}.json"
    names = FIELDS[table]

    def use(row: Row) -> Optional[Row]:  # called for each row as it is parsed, so that the rest is never held
        missing = [name for name in names if name not in row]
        if missing:
            raise CFlowError(f"{file}: a row lacks {missing}; it has {shortened(sorted(row))}. Copy the table again")
        return {name: row[name] for name in names} if not key or row[key] in values else None

    with file_errors(file, "copy all tables of the version"):
        rows = parse_json(read_bytes(file), file, use)
    kept = [row for row in rows if row is not None] if isinstance(rows, list) else [rows]
    if not isinstance(rows, list) or not all(type(row) is dict for row in kept):
        raise CFlowError(f"{file} is no list of rows; copy the table again")
    return kept
