"""What may come of a hostile file: a result, or the project's one error."""

from __future__ import annotations

from pathlib import Path

from cflow_torch import CFlowError
from fuzzing.target import Target

RESULT, REFUSED = "result", "refused"


def outcome(target: Target, folder: Path, data: bytes) -> str:
    """Have the target's reader read the bytes.

    Returns:
        RESULT or REFUSED (a CFlowError that says something).

    Raises:
        Exception: anything else that the reader raised: a finding.
    """
    (folder / target.file).write_bytes(data)
    try:
        target.read(folder)
    except CFlowError as error:
        if not str(error).strip():
            raise AssertionError("a CFlowError without a word") from error
        return REFUSED
    return RESULT
