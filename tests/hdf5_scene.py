"""Write scenes with random points in OpenSceneFlow's HDF5 layout."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Sequence

import numpy as np
import pytest

STAMPS = (1_533_279_682_150_532, 1_533_279_682_250_532, 1_533_279_682_350_532)  # microseconds


def write_scene(
    file: Path, stamps: Sequence[int] = STAMPS, growth: int = 0, masked: Any = None, **replaced: Any
) -> Path:
    """Write sweeps of 50 points, each with `growth` more than the one before; the last one has no flow.

    The sweeps `masked` have an evaluation mask, None = all but the last. `replaced` values go into sweep 0, None = left
    out."""
    h5py = pytest.importorskip("h5py")
    rng, last = np.random.default_rng(0), len(stamps) - 1
    with h5py.File(file, "w") as scene:
        for index, stamp in enumerate(stamps):
            count = 50 + growth * index
            pose = np.eye(4)
            pose[0, 3] = index
            values = {
                "lidar": rng.uniform(-60, 60, (count, 4)).astype(np.float32),
                "ground_mask": rng.random(count) < 0.3,
                "pose": pose,
            }
            if index < last:
                values["flow"] = rng.normal(size=(count, 3)).astype(np.float32)
                values["flow_is_valid"] = rng.random(count) < 0.9
                values["flow_category_indices"] = rng.integers(0, 30, count).astype(np.int8)
            if index in (range(last) if masked is None else masked):
                values["eval_mask"] = rng.random((count, 1)) < 0.5
            if index == 0:
                values.update(replaced)
            group = scene.create_group(str(stamp))
            for key, value in values.items():
                if value is not None:
                    group[key] = value
    return file
