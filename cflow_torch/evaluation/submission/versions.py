"""The three submission formats as data: columns, rows, flow, file names, metadata."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Mapping

from cflow_torch.types import CFlowError

METADATA_FILE = "metadata.json"
_FLOW = ("flow_tx_m", "flow_ty_m", "flow_tz_m")


@dataclass(frozen=True)
class SubmissionVersion:
    """One format.

    Args:
        number: 1, 2 or 3.
        server: whose leaderboard takes it.
        columns: column -> accepted dtypes; the first is the one written.
        flow: "total" (ego motion included) or "residual" (motion of objects alone).
        rows: "masked": the points of the evaluation mask, in its order; "all": every point of the sweep.
        frames: "evaluated": those that have an evaluation mask, where a log has masks; "every 5th": always the pairs
            0, 5, 10 ... (which the former also falls back to).
        naming: stem of a frame's file: "timestamp" of sweep t, or "position" of sweep t in its log, ten digits.
        metadata: contents of metadata.json at the root; None = no such file may be there.
    """

    number: int
    server: str
    columns: Mapping[str, tuple[str, ...]]
    flow: str
    rows: str
    frames: str
    naming: str
    metadata: Mapping[str, Any] | None = None

    def file_name(self, log_id: str, index: int, timestamp: int) -> str:
        """Name of a frame's file inside the archive."""
        return f"{log_id}/{index:010d}.feather" if self.naming == "position" else f"{log_id}/{timestamp}.feather"


VERSIONS: dict[int, SubmissionVersion] = {
    1: SubmissionVersion(
        number=1,
        server="Argoverse 2 scene flow 2023 (EvalAI challenge 2010, phase 4018)",
        columns={**dict.fromkeys(_FLOW, ("float16",)), "is_dynamic": ("bool",)},
        flow="total",
        rows="masked",
        frames="evaluated",
        naming="timestamp",
    ),
    2: SubmissionVersion(
        number=2,
        server="Argoverse 2 scene flow 2024 (EvalAI challenge 2210, phase 4396; closed)",
        columns={"is_valid": ("bool",), **dict.fromkeys(_FLOW, ("float16", "float32", "float64"))},
        flow="residual",
        rows="all",
        frames="every 5th",
        naming="position",
        metadata={"Is Supervised?": False},
    ),
    3: SubmissionVersion(
        number=3,
        server="multi-dataset challenge 2026 (sceneflow.argoverse.org)",
        columns=dict.fromkeys(_FLOW, ("float16",)),
        flow="residual",
        rows="all",
        frames="evaluated",
        naming="timestamp",
    ),
}


def get_version(number: Any) -> SubmissionVersion:
    """A format by its number.

    Raises:
        CFlowError: there is no such version.
    """
    if number not in VERSIONS:
        raise CFlowError(f"submission versions are {', '.join(map(str, VERSIONS))}, got {number!r}")
    return VERSIONS[number]
