"""Point clouds in files of their own: pcd, ply, bin, npy, npz."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import List, Tuple

import numpy as np

from cflow_torch.data.arrays.pcd import read_pcd, write_pcd
from fuzzing.target import Target


def _pcd_seeds() -> List[bytes]:
    columns = {name: np.arange(4, dtype=np.float32) for name in "xyz"}
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "a.pcd"
        found = []
        for data in ("ascii", "binary", "binary_compressed"):
            write_pcd(file, columns, data=data)
            found.append(file.read_bytes())
    return found


TARGETS: Tuple[Target, ...] = (
    Target("pcd", "a.pcd", _pcd_seeds, lambda folder: read_pcd(folder / "a.pcd"), tokens=(b"POINTS", b"WIDTH")),
)
