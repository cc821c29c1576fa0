"""Replacements of compiled packages that OpenSceneFlow imports, so that its unmodified files run on a CPU.

A module gets a replacement only if it cannot be imported. We wrote the replacements from the documented behaviour of
the originals; tests/scripts/test_benchmarks.py compares them with dense loops. Nearest neighbours come from a
k-d tree. In ties of distances another neighbour than on a GPU may win.
"""

from __future__ import annotations

import contextlib
import importlib
import io
import sys
import types
from functools import lru_cache, reduce
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

PADDING = 1e7  # ICP-Flow pads clouds with points at 1e8 m
_PAIRS_AT_ONCE = 1 << 22


@lru_cache(maxsize=128)
def _tree(points: bytes) -> Any:
    from scipy.spatial import cKDTree

    return cKDTree(np.frombuffer(points, np.float32).reshape(-1, 3), balanced_tree=False)


def _nearest(points: np.ndarray, target: np.ndarray) -> np.ndarray:
    """(N,) int64 index of the nearest of the (M, 3) target points to each of the (N, 3) points."""
    return _tree(np.ascontiguousarray(target, np.float32).tobytes()).query(points)[1]


def chamfer(pc0: Tensor, pc1: Tensor, distance0: Tensor, distance1: Tensor, index0: Tensor, index1: Tensor) -> None:
    """Write the squared distance from each point to the nearest one of the other cloud, and its index."""
    for start, target, distance, index in ((pc0, pc1, distance0, index0), (pc1, pc0, distance1, index1)):
        nearest = torch.from_numpy(_nearest(start.detach().numpy(), target.detach().numpy()))
        index.copy_(nearest)
        distance.copy_((start - target[nearest]).square().sum(1))


def chamfer_gradient(
    pc0: Tensor, pc1: Tensor, index0: Tensor, index1: Tensor, out0: Tensor, out1: Tensor, grad0: Tensor, grad1: Tensor
) -> None:
    """Write the gradient of `chamfer` into the last two arguments."""
    for start, target, index, out, own, other in (
        (pc0, pc1, index0.long(), out0, grad0, grad1),
        (pc1, pc0, index1.long(), out1, grad1, grad0),
    ):
        pull = 2 * out[:, None] * (start - target[index])
        own += pull
        other.index_add_(0, index, -pull)


def histogram(first: Tensor, second: Tensor, *bounds_and_sizes: Any) -> Tensor:
    """Count the differences first - second of all pairs of points in bins, (B, X, Y, Z) float32.

    Args:
        first, second: (B, N, 4), (B, M, 4) float32: x, y, z, and whether the row is a point (> 0).
        bounds_and_sizes: least x, y, z; greatest x, y, z (excluded); number of bins in x, y, z; size of a mini-batch.
    """
    numbers = np.array([float(value) for value in bounds_and_sizes], np.float32)
    low, high, sizes = numbers[:3], numbers[3:6], numbers[6:9].astype(np.int64)
    votes = np.zeros((len(first), int(sizes.prod())), np.float32)
    for total, *clouds in zip(votes, first.numpy(), second.numpy()):
        starts, ends = (cloud[cloud[:, 3] > 0, :3] for cloud in clouds)
        ends = ends[np.argsort(ends[:, 2], kind="stable")]
        # Only points of similar height can be in a bin. The margin covers the rounding of the difference.
        begin = np.searchsorted(ends[:, 2], starts[:, 2] - high[2] - 1e-3)
        count = np.searchsorted(ends[:, 2], starts[:, 2] - low[2] + 1e-3) - begin
        for rows in np.array_split(np.arange(len(starts)), 1 + int(count.sum()) // _PAIRS_AT_ONCE):
            each = np.repeat(rows, count[rows])
            rank = np.arange(len(each)) - np.repeat(np.cumsum(count[rows]) - count[rows], count[rows])
            difference = starts[each] - ends[begin[each] + rank]
            difference = difference[((difference >= low) & (difference < high)).all(1)]
            cell = np.floor((difference - low) / (high - low) * sizes.astype(np.float32)).astype(np.int64)
            flat = (cell[:, 0] * sizes[1] + cell[:, 1]) * sizes[2] + cell[:, 2]
            total += np.bincount(flat[flat < len(total)], minlength=len(total))
    return torch.from_numpy(votes).reshape(len(first), *sizes.tolist())


class Neighbours(NamedTuple):
    """Squared distances, indices and points of the nearest neighbours."""

    dists: Tensor
    idx: Tensor
    knn: Tensor


def knn_points(p1: Tensor, p2: Tensor, lengths1: Any = None, lengths2: Any = None, **settings: Any) -> Neighbours:
    """Find the nearest point of `p2` to each point of `p1`; padded rows of `p1` have the distance 0 and the index 0.

    Both are (B, N, 3) float32, padded with coordinates of 1e8, which tell the lengths. `K` must be 1.
    """
    if settings.get("K", 1) != 1:
        raise NotImplementedError("this replacement finds one neighbour")
    index = torch.zeros(p1.shape[:2], dtype=torch.int64)
    is_point = p1.abs().amax(2) < PADDING
    for rows, start, target, found in zip(is_point.numpy(), p1.numpy(), p2.numpy(), index.numpy()):
        known = np.flatnonzero(np.abs(target).max(1) < PADDING)
        if len(known) and rows.any():
            found[rows] = known[_nearest(start[rows], target[known])]
    nearest = torch.gather(p2, 1, index[:, :, None].expand(-1, -1, 3))
    distance = torch.where(is_point, (p1 - nearest).square().sum(2), torch.zeros(()))
    return Neighbours(distance[:, :, None], index[:, :, None], nearest[:, :, None])


def weighted_mean(x: Tensor, weight: Tensor | None = None, eps: float = 1e-9) -> Tensor:
    """(B, 1, D) mean of (B, N, D) with (B, N) weights."""
    weights = torch.ones_like(x[:, :, :1]) if weight is None else weight[:, :, None].to(x)
    return (x * weights).sum(1, keepdim=True) / weights.sum(1, keepdim=True).clamp(min=eps)


def euler_angles(matrix: Tensor, convention: str) -> Tensor:
    """(B, 3) angles a, b, c in radians of (B, 3, 3) rotations Rz(a) Ry(b) Rx(c). The convention must be "ZYX"."""
    yaw, roll = (torch.atan2(matrix[:, row, column], matrix[:, of, of]) for row, column, of in ((1, 0, 0), (2, 1, 2)))
    return torch.stack([yaw, torch.asin((-matrix[:, 2, 0]).clamp(-1, 1)), roll], 1)


def distance_transform(
    image: Tensor, mask: Tensor, spacing: Any, largest: float, weight: float, iterations: int
) -> Tensor:
    """Compute the metres to the nearest cell where the (1, 1, X, Y, Z) mask is 0; FastGeodis approximates them.

    The image is ignored, because its weight must be 0.
    """
    from scipy.ndimage import distance_transform_edt

    return torch.from_numpy(distance_transform_edt(mask[0, 0].numpy() != 0, spacing)).float()[None, None]


def _not_available(*arguments: Any, **settings: Any) -> None:
    raise RuntimeError("this compiled extension is not available on a CPU")


_VOXELS = ("dynamic_voxelize_forward", "hard_voxelize_forward")
_VOXELS += ("dynamic_point_to_voxel_forward", "dynamic_point_to_voxel_backward")
REPLACEMENTS: dict[str, dict[str, Any]] = {  # module -> what the harness imports from it
    "torchvision": {
        "transforms": types.SimpleNamespace(
            Compose=lambda steps: lambda data: reduce(lambda value, step: step(value), steps, data)
        ),
    },
    "wandb": {"finish": lambda: None},
    "fire": {},
    "chamfer3D": {"forward": chamfer, "backward": chamfer_gradient},
    "hist": {"hist": histogram},
    "FastGeodis": {"generalised_geodesic3d": distance_transform},
    "mmcv": dict.fromkeys(_VOXELS, _not_available),
    "pytorch3d": {},
    "pytorch3d.transforms": {"matrix_to_euler_angles": euler_angles},
    "pytorch3d.ops": {"knn_points": knn_points},
    "pytorch3d.ops.utils": {
        "eyes": lambda size, count, **settings: torch.eye(size, **settings).repeat(count, 1, 1),
        "wmean": weighted_mean,
        "is_pointclouds": lambda clouds: False,
        "convert_pointclouds_to_tensor": lambda clouds: (clouds, clouds.new_full(clouds.shape[:1], clouds.shape[1])),
    },
    "pytorch3d.structures": {},
    "pytorch3d.structures.utils": {},
}


def add_replacements() -> None:
    """Replace every module that cannot be imported. Lightning comes first, because it looks for the real ones."""
    with contextlib.suppress(ImportError):
        import lightning.pytorch  # noqa: F401
    for old, new in (("NaN", "nan"), ("in1d", "isin")):  # removed in NumPy 2.0 and 2.4
        if not hasattr(np, old):
            setattr(np, old, getattr(np, new))
    for name, contents in REPLACEMENTS.items():
        try:
            importlib.import_module(name)
        except (ImportError, RuntimeError):  # RuntimeError: a torchvision of another torch
            module = sys.modules[name] = types.ModuleType(name)
            module.__dict__.update(contents)
            module.__path__ = []  # type: ignore[attr-defined]
            package, _, last = name.rpartition(".")
            if package:
                setattr(sys.modules[package], last, module)


def load_models(root: Path) -> Any:
    """Return the module `src.models` of a checkout; it lacks the models whose packages are missing."""
    add_replacements()
    if str(root) not in sys.path:
        sys.path.insert(0, str(root))
    sys.dont_write_bytecode = True  # in the checkout
    with contextlib.redirect_stdout(io.StringIO()):  # warnings about models that we do not use
        return importlib.import_module("src.models")
