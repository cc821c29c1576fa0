"""Write scenes with random points in OpenSceneFlow's HDF5 layout."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Sequence

import numpy as np
import pytest

from cflow_torch.transforms import transform_points

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


def move_to_sensor(file: Path, ego_T_lidar: np.ndarray, is_stated: bool = False) -> None:
    """Move the points and the flow of a scene to the frame of a LiDAR; poses and ego motion stay those of the vehicle.

    Unless the extrinsics are stated, the scene is like OpenSceneFlow's of Argoverse 2: without them, float32 poses."""
    h5py, inverse = pytest.importorskip("h5py"), np.linalg.inv(ego_T_lidar)
    with h5py.File(file, "r+") as scene:
        del scene.attrs["ego_T_lidar"]
        if is_stated:
            scene.attrs["ego_T_lidar"] = ego_T_lidar
        for group in scene.values():
            group["lidar"][...] = transform_points(group["lidar"][()], inverse)
            if "flow" in group:
                group["flow"][...] = group["flow"][()].astype(np.float64) @ inverse[:3, :3].T
            if not is_stated:
                pose = group["pose"][()].astype(np.float32)
                del group["pose"]
                group["pose"] = pose
