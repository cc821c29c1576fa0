"""Files of calibration in KITTI's form: a line `KEY: numbers` for each matrix."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Mapping

import numpy as np

from cflow_torch.data.file_errors import file_errors
from cflow_torch.data.paths import read_bytes
from cflow_torch.transforms import as_matrix, rigid_transform
from cflow_torch.types import CFlowError

CAMERA_KEYS = ("Tr", "Tr_velo_to_cam", "Tr_velo_cam")
"""Names of `T_cam0_lidar` in KITTI's odometry, raw and tracking sets."""


def read_calibration(file: Path) -> dict[str, np.ndarray]:
    """Read lines `KEY: numbers` as key -> (K,) float64. Lines without numbers (the time of calibration) are ignored."""
    found = {}
    with file_errors(file):
        for line in read_bytes(file).decode("utf-8").splitlines():
            key, *words = line.replace(":", " ", 1).split() or [""]
            try:
                found[key] = np.array(words, np.float64)
            except ValueError:
                continue
    return found


def transform(values: Mapping[str, np.ndarray], file: Any, *names: str) -> np.ndarray:
    """Return the (4, 4) float64 rigid transform of a calibration.

    `names` are alternative names of a line with 12 numbers, or two names of lines with 9 and 3 numbers, joined by a
    space. A line with 9 numbers alone is a rotation. Without such lines, a `CFlowError` names the `file`.
    """
    for name in names:
        parts = [values[key] for key in name.split() if key in values]
        sizes = [len(part) for part in parts]
        if len(parts) == len(name.split()) and sizes in ([12], [9], [9, 3]):
            numbers = parts[0].reshape(3, -1)
            shift = numbers[:, 3] if sizes == [12] else (*parts[1:], np.zeros(3))[0]
            return rigid_transform(as_matrix(numbers[:, :3], shift), f"{name} of {file}")
    raise CFlowError(f"{file} has no line {' or '.join(names)}; it has {', '.join(values)}; copy it again")
