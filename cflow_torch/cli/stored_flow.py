"""The flow of pairs in the output of `cflow flow`."""

from __future__ import annotations

from functools import lru_cache
from typing import Any, Callable, Sequence

from cflow_torch.cli.commands import Clean, View
from cflow_torch.data.flow_file import ON_REQUEST, read_flow
from cflow_torch.data.json_file import read_json
from cflow_torch.data.log import Log
from cflow_torch.data.paths import as_path
from cflow_torch.errors import MissingFile
from cflow_torch.fleet.manifest import MANIFEST, frame_file
from cflow_torch.types import CFlowError, FlowResult


def stored_flow(folder: Any, needed: Sequence[str]) -> Callable[[Log, int], FlowResult]:
    """Return a function that reads the flow of a pair from the output of `cflow flow` and rejects incomplete files.

    Only the verified method has a confidence and P(moving): the files of others need not have them.
    """
    output = as_path(folder)
    if not output.is_dir():
        raise CFlowError(f"flow={folder} is not a folder: give the output of `cflow flow`")

    @lru_cache(maxsize=1)
    def needed_of(log_id: str) -> list[str]:
        method = method_of_flow(output, log_id) or {}
        return [name for name in needed if method.get("method") == "verified" or name not in ON_REQUEST]

    def read(log: Log, index: int) -> FlowResult:
        file = frame_file(output / log.log_id, log.timestamps[index])
        try:
            result = read_flow(file)
        except MissingFile:
            raise CFlowError(f"{file} is missing: run `cflow flow` again") from None
        missing = [name for name in needed_of(log.log_id) if getattr(result, name) is None]
        if missing:
            raise CFlowError(
                f"{file} lacks {', '.join(missing)}: run `cflow flow` again with contents=auto overwrite=true"
            )
        return result

    return read


def method_of_flow(folder: Any, log_id: str) -> dict[str, Any] | None:
    """Return the settings of the method that made the flow files of a log; None = they have no manifest."""
    manifest = as_path(folder) / log_id / MANIFEST
    return read_json(manifest).get("run", {}).get("method") if manifest.exists() else None


def interval_of_flow(cfg: Clean | View, log_id: str) -> float:
    """Return the seconds from sweep to sweep without time stamps: those of the stored flow, or of the model."""
    method = (cfg.flow is not None and method_of_flow(cfg.flow, log_id)) or {}
    return float(method.get("sweep_interval", cfg.model.sweep_interval))
