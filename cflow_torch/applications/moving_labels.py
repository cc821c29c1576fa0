"""Write which points move as label files of SemanticKITTI, which evaluators of moving object segmentation read."""

from __future__ import annotations

from pathlib import Path
from typing import Iterable

import numpy as np

from cflow_torch.data.atomic import atomic_file
from cflow_torch.data.log import Log
from cflow_torch.data.paths import PathLike, as_path
from cflow_torch.types import FlowResult, as_numpy

UNLABELLED_CLASS = 0
STATIC_CLASS = 9
MOVING_CLASS = 251


def moving_classes(result: FlowResult) -> np.ndarray:
    """Return the class of each point of sweep t, (N,) int32.

    251 = it moves (`FlowResult.is_moving`), 9 = static. Points without an estimate, such as ground, are static.
    """
    return np.where(as_numpy(result.is_moving), MOVING_CLASS, STATIC_CLASS).astype(np.int32)


def write_moving_labels(folder: PathLike, log: Log, results: Iterable[tuple[int, FlowResult]]) -> None:
    """Write `folder/000000.label` ... for all sweeps of a log: a little-endian int32 class per point.

    Args:
        folder: `sequences/<sequence>/predictions` of the evaluators, created if it does not exist.
        log: the drive. Files have the numbers of its sweeps in the data set (`Log.frame_number`).
        results: (index, flow of sweep `index` to `index + 1`). In sweeps without a flow, such as the last one, all
            points have class 0, which the evaluators do not score.
    """
    folder = as_path(folder)
    without_flow = set(range(len(log.timestamps)))
    for index, result in results:
        without_flow.discard(index)
        _write(folder, log.frame_number(index), moving_classes(result))
    for index in sorted(without_flow):
        _write(folder, log.frame_number(index), np.full(len(log.sweep(index).points), UNLABELLED_CLASS))


def _write(folder: Path, frame: int, classes: np.ndarray) -> None:
    with atomic_file(folder / f"{frame:06d}.label") as file:
        file.write(classes.astype("<i4").tobytes())
