"""JSON documents, with one error for what is wrong with them."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, Callable

from cflow_torch.data.file_errors import file_errors
from cflow_torch.data.paths import read_bytes


def read_json(file: Path) -> Any:
    """What is in a JSON file.

    Convention: UTF-8, with or without a byte order mark. NaN and Infinity are numbers, as Python writes them: whoever
        needs finite ones checks, since 1e999 is infinite too.

    Raises:
        CFlowError: not UTF-8, or no JSON.
        OSError: as `read_bytes`.
    """
    return parse_json(read_bytes(file), file)


def parse_json(data: bytes, file: Any, use: Callable[[dict[str, Any]], Any] | None = None) -> Any:
    """What a text says.

    Args:
        data: the text.
        file: where it is from, for the message.
        use: called with each object, inner ones first; what it returns takes the object's place.

    Raises:
        CFlowError: not UTF-8, or no JSON; and what `use` raises.
    """
    with file_errors(f"{file} as JSON"):
        return json.loads(data.decode("utf-8-sig"), object_hook=use)
