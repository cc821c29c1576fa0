"""The two open submission formats, and how one estimated flow becomes the columns of a file."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Mapping

import numpy as np

from cflow_torch.types import Array, CFlowError, FlowResult, as_numpy

DYNAMIC_THRESHOLD = 0.05  # metres per sweep, the evaluation's threshold for dynamic points
LARGEST = float(np.finfo(np.float16).max)  # 65504 m
_FLOW = dict.fromkeys(("flow_tx_m", "flow_ty_m", "flow_tz_m"), "float16")


@dataclass(frozen=True)
class SubmissionVersion:
    """One submission format.

    Args:
        number: 1 or 3, as OpenSceneFlow numbers them.
        server: the leaderboard that accepts it.
        columns: column -> dtype, in the order in which they are written.
        is_masked: True: total flow (ego motion included) of the points of the evaluation mask, in the order of the
            mask. False: residual flow (motion of objects alone) of every point of the sweep.
    """

    number: int
    server: str
    columns: Mapping[str, str]
    is_masked: bool


VERSIONS: dict[int, SubmissionVersion] = {
    version.number: version
    for version in (
        SubmissionVersion(
            1, "Argoverse 2 scene flow 2023 (EvalAI challenge 2010, phase 4018)", {**_FLOW, "is_dynamic": "bool"}, True
        ),
        SubmissionVersion(3, "multi-dataset challenge 2026 (sceneflow.argoverse.org)", _FLOW, False),
    )
}


def get_version(number: Any) -> SubmissionVersion:
    """Return the format of this number.

    Raises:
        CFlowError: there is no such version.
    """
    if number not in VERSIONS:
        closed = "; version 2 (Argoverse 2, 2024) is closed and was removed" if number == 2 else ""
        raise CFlowError(f"version={number!r}: give one of {', '.join(map(str, VERSIONS))}{closed}")
    return VERSIONS[number]


def encode(
    version: SubmissionVersion, result: FlowResult, is_ground: Array | None = None, mask: np.ndarray | None = None
) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """Convert the flow of one frame to the columns of its file.

    Args:
        version: the format.
        result: flow of the N points of sweep t.
        is_ground: (N,) bool, True = ground; None = no point is ground.
        mask: (N,) bool, points to write. Required if `version.is_masked`, refused otherwise.

    Returns:
        Columns by name, in the order of the format (flow in metres until the next sweep, float16; `is_dynamic` bool),
        and (M,) float64, metres, the error of each row from rounding to float16.

    Convention:
        A residual flow is in the axes of t+1, as OpenSceneFlow writes it, and 0 for ground points. `is_dynamic` is
        True where the unrounded residual is 0.05 m or longer.

    Raises:
        CFlowError: the mask is missing or not allowed; a value is NaN, infinite or beyond float16.
    """
    if (mask is not None) != version.is_masked:
        need = "needs a mask" if version.is_masked else "contains every point: leave out the mask"
        raise CFlowError(f"submission version {version.number} {need}")
    residual = as_numpy(result.residual_flow).astype(np.float32)
    if mask is not None:
        keep = np.asarray(mask, dtype=bool)
        residual, flow = residual[keep], as_numpy(result.flow)[keep]
    else:
        flow = residual if is_ground is None else np.where(as_numpy(is_ground)[:, None], np.float32(0), residual)
    half, error = to_half(flow)
    columns = {
        **{f"flow_t{axis}_m": half[:, i] for i, axis in enumerate("xyz")},
        "is_dynamic": np.linalg.norm(residual, axis=1) >= np.float32(DYNAMIC_THRESHOLD),
    }
    return {name: columns[name] for name in version.columns}, error


def to_half(flow: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Round a flow to float16.

    Args:
        flow: (M, 3) of any float type, metres.

    Returns:
        (M, 3) float16, and (M,) float64, metres, the error of each row.

    Raises:
        CFlowError: a value is NaN, infinite, or larger than float16 can hold.
    """
    bad = ~(np.abs(flow) <= LARGEST).all(axis=1)
    if bad.any():
        raise CFlowError(f"the flow of {bad.sum()} points is NaN, infinite or beyond float16 ({LARGEST:g} m)")
    half = flow.astype(np.float16)
    return half, np.linalg.norm(half.astype(np.float64) - flow.astype(np.float64), axis=1)
