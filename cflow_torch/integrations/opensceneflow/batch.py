"""Windows from the batches of OpenSceneFlow (the harness), in every layout of its scripts, checked key by key."""

from __future__ import annotations

from typing import Any, Mapping, NamedTuple

import numpy as np
import torch
from torch import Tensor

from cflow_torch.data.hdf5.frames import harness_motion, recognized_extrinsics
from cflow_torch.transforms import relative_transform, rigid_transform
from cflow_torch.types import CFlowError, Sweep, Window, check_array, check_points


class BatchSample(NamedTuple):
    """One pair of sweeps of a batch, with its history."""

    # Points that are finite and not ground, with the poses of their frame. If the batch has all points of t, as
    # "origin_pc0", the ground points of t follow the points of pc0 and are masked.
    window: Window
    rows0: Tensor  # (K,) int64, rows of batch["pc0"] that are in `window.pc0`
    T_ego1_ego0: np.ndarray  # (4, 4) float32, ego motion that the harness computes from the stored poses
    # (4, 4) float64, motion of the frame of the points; None = `T_ego1_ego0` is that motion.
    T_lidar1_lidar0: np.ndarray | None


def read_batch(batch: Mapping[str, Any], num_history: int, ego_T_lidar: Any = None) -> list[BatchSample]:
    """Read the samples of a batch. The batch is not modified.

    Args:
        batch: as the harness collates it. For each sweep i of 0 and 1: "pc{i}" (B, N, 3) or a list of B (N, 3),
            "pose{i}" (B, 4, 4) or a list of B (4, 4), optionally "gm{i}" (B, N), True = ground. For history, nearest
            first: "pch1", "poseh1", "gmh1", "pch2", ... "origin_pc0" (B, N, 3), all points of t, gives the ground.
            `ego_T_lidar="auto"` also reads "timestamp".
        num_history: maximum number of history sweeps; the batch may have fewer.
        ego_T_lidar: (4, 4); None = identity; "auto" = `recognized_extrinsics` of the sweep.

    Convention:
        We apply a ground mask with as many rows as its sweep has points. If only its non-ground rows are as many as the
        points, the harness has already removed the ground of this sweep.
        Rows with NaN are ignored: they are padding, or beams without a return. We never read "flow" and other truth. A
        `CFlowError` names the key of a value that is missing, has a wrong shape, or is not a rigid motion.
    """
    history = [f"h{i}" for i in range(1, num_history + 1) if f"pch{i}" in batch]
    _entry(batch, "pose0", 0)
    return [_sample(batch, b, history, ego_T_lidar) for b in range(len(batch["pose0"]))]


def _sample(batch: Mapping[str, Any], b: int, history: list[str], ego_T_lidar: Any) -> BatchSample:
    extrinsics = _extrinsics(batch, b, ego_T_lidar)
    names = ("0", "1", *history)
    clouds, rows = zip(*(_points(batch, b, name) for name in names))
    poses = [rigid_transform(_entry(batch, f"pose{name}", b), f"batch['pose{name}'][{b}]") for name in names]
    lidar_poses = poses if extrinsics is None else [pose @ extrinsics for pose in poses]
    sweeps = [Sweep(points, None, pose) for points, pose in zip(clouds, lidar_poses)]
    ground = _ground_of_t(batch, b).to(clouds[0])
    if len(ground):
        is_ground = torch.arange(len(clouds[0]) + len(ground), device=ground.device) >= len(clouds[0])
        whole = Sweep(torch.cat((clouds[0], ground)), is_ground, lidar_poses[0])
        # At the start of a scene the harness repeats t as history. Models skip copies only if they stay equal to t.
        for i, (points, pose) in enumerate(zip(clouds, poses)):
            if torch.equal(points, clouds[0]) and np.array_equal(pose, poses[0]):
                sweeps[i] = whole
    T_ego1_ego0 = harness_motion(_entry(batch, "pose0", b), _entry(batch, "pose1", b))
    T_lidar1_lidar0 = None if extrinsics is None else relative_transform(lidar_poses[1], lidar_poses[0])
    return BatchSample(Window(sweeps[0], sweeps[1], tuple(sweeps[2:])), rows[0], T_ego1_ego0, T_lidar1_lidar0)


def _points(batch: Mapping[str, Any], b: int, name: str) -> tuple[Tensor, Tensor]:
    """Select the points of one sweep that are finite and not ground; return them and their rows."""
    key = f"pc{name}"
    points = _entry(batch, key, b)
    check_points(points, f"batch['{key}'][{b}]")
    keep = points[:, :3].isfinite().all(dim=1)
    mask_key = f"gm{name}"
    if mask_key in batch:
        is_ground = _mask(batch, mask_key, b)
        if is_ground.numel() == points.shape[0]:
            keep = keep & ~is_ground.to(points.device)
        elif int((~is_ground).sum()) != points.shape[0]:
            found = f"{is_ground.numel()} rows, {int((~is_ground).sum())} of them not ground"
            raise CFlowError(f"batch['{mask_key}'][{b}] has {found}, but {key} has {len(points)} points")
    rows = keep.nonzero()[:, 0]
    return points[:, :3].index_select(0, rows), rows


def _ground_of_t(batch: Mapping[str, Any], b: int) -> Tensor:
    """Return the (K, 3) ground points of t, which the harness has removed from pc0; none if the batch lacks them."""
    if "origin_pc0" in batch and "gm0" in batch:
        points = _entry(batch, "origin_pc0", b)
        is_ground = _mask(batch, "gm0", b)
        if len(points) == is_ground.numel():
            points = points[is_ground.to(points.device), :3]
            return points[points.isfinite().all(dim=1)]
    return torch.zeros((0, 3))


def _mask(batch: Mapping[str, Any], key: str, b: int) -> Tensor:
    mask: Tensor = _entry(batch, key, b)
    check_array(mask, f"batch['{key}'][{b}]", (None,), "b", "(N,) bool, True = ground")
    return mask


def _extrinsics(batch: Mapping[str, Any], b: int, ego_T_lidar: Any) -> np.ndarray | None:
    """Return the (4, 4) float64 ego_T_lidar of a sample; None = identity."""
    if not isinstance(ego_T_lidar, str):
        return None if ego_T_lidar is None else rigid_transform(ego_T_lidar, "ego_T_lidar")
    if "timestamp" not in batch or "gm0" not in batch:
        return None  # training batches have no ground and no masks
    is_ground = _mask(batch, "gm0", b)
    points = _entry(batch, "origin_pc0" if "origin_pc0" in batch else "pc0", b)
    stamp = _entry(batch, "timestamp", b)
    stamp = str(stamp.item() if isinstance(stamp, Tensor) else stamp)
    if is_ground.numel() != len(points) or not stamp.isdigit():
        return None
    found = recognized_extrinsics(int(stamp), points.cpu().numpy(), is_ground.cpu().numpy())
    return None if np.array_equal(found, np.eye(4)) else found


def _entry(batch: Mapping[str, Any], key: str, b: int) -> Any:
    """Return sample b of a key, whose value is a tensor with a batch dimension or a list."""
    if key not in batch:
        raise CFlowError(f"the batch has no '{key}', which the method needs; it has {', '.join(map(str, batch))}")
    try:
        return batch[key][b]
    except (IndexError, TypeError, KeyError):
        shape = f" of shape {tuple(batch[key].shape)}" if isinstance(batch[key], Tensor) else ""
        raise CFlowError(f"batch['{key}'] is {type(batch[key]).__name__}{shape}: give one entry per sample") from None
