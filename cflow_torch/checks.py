"""What settings may be: each by itself, and which go together. `Config` asks when it is made."""

from __future__ import annotations

import math
from typing import Any, Dict, Tuple

from cflow_torch.types import CFlowError

METHODS = ("dense", "keypoints")
CLUSTERINGS = ("components", "hdbscan")
LABELINGS = ("sparse", "kornia")
CORRELATIONS = ("fft", "conv")
SUBPIXELS = ("none", "parabola")
DENSIFIERS = ("components", "clusters", "nearest")
# Options of the dense method that are not in the paper (docs/beyond.md), and the value that turns each off.
DENSE_ONLY: Dict[str, Any] = {
    "max_object": None,
    "zero_test": None,
    "subpixel": "none",
    "height_slices": 0,
    "proof": False,
}
# What the proof does in its own way, and so must be left as it is.
NOT_WITH_PROOF: Dict[str, Any] = {
    "clustering": "components",
    "sectional_view": False,
    "zero_test": None,
    "subpixel": "none",
}
SWITCHES = (
    "sectional_view",
    "use_timestamps",
    "mutual_check",
    "proof",
    "children",
    "aperture",
    "relocate",
    "nudge",
    "yaw",
    "slow",
)
# The ratio test compares products of counts: 51^6 * (2 * 10^4)^2 still fits an int64.
LARGEST_PATCH = 51
LARGEST_RATIO = 2
# Nothing needs more, and (100 z)^2 times a count fits an int64.
LARGEST_Z = 1000
# m; heights above the ground are bounded, too.
HIGHEST_CLEARANCE = 1000
# Pixels a side; no region is wider, and an index still fits an int64.
LARGEST_BLOCK = 10**6
# Whole numbers stay below this: they are compared with tensors of int64 and of float64.
MOST = 2**53
# A byte holds the slices of a pixel.
MOST_SLICES = 8
# Seconds, metres, pixels of settings that quotients are made of: nothing is shorter or longer.
SHORTEST, LONGEST = 1e-6, 1e6
# m a side: squares of longer ways in 1/1024 m, weighted and summed by the proof, would not fit an int64.
WIDEST_PROOF = 3000


def check(config: Any) -> None:
    """Raises `CFlowError` unless a `Config` makes sense; its lists are tuples of floats already."""
    _check_values(config)
    if config.proof:
        _check_proof(config)
    if config.height_slices and config.clustering != "components":
        raise CFlowError(
            f"height_slices={config.height_slices} needs clustering='components', {config.clustering!r} was given: "
            "give height_slices=0"
        )
    if config.method == "keypoints" and config.num_history > 0:
        raise CFlowError(
            f"method='keypoints' matches one pair of sweeps, num_history={config.num_history} was given: "
            "give num_history=0, or method='dense'"
        )
    for name, off in DENSE_ONLY.items():
        if config.method == "keypoints" and getattr(config, name) != off:
            raise CFlowError(
                f"{name}={getattr(config, name)!r} is an option of the dense method, method='keypoints' was given: "
                f"give {name}={off!r}, or method='dense'"
            )


def _check_values(config: Any) -> None:
    for name, allowed in (
        ("method", METHODS),
        ("clustering", CLUSTERINGS),
        ("labeling", LABELINGS),
        ("correlation", CORRELATIONS),
        ("densify", DENSIFIERS),
        ("subpixel", SUBPIXELS),
        ("connectivity", (4, 8)),
    ):
        one_of(name, getattr(config, name), allowed)
    for name in SWITCHES:
        one_of(name, getattr(config, name), (True, False))
    _check_space(config.pixel_sizes, config.point_cloud_range)
    own = config.ego_box
    if own is not None and (len(own) != 4 or not all(map(math.isfinite, own)) or own[0] >= own[2] or own[1] >= own[3]):
        raise CFlowError(f"ego_box={own}: give (x0, y0, x1, y1) in metres, finite, with x0 < x1 and y0 < y1, or None")
    for name in ("num_history", "patch_size", "min_cluster_size", "height_slices", "keypoint_block"):
        _whole_number(name, getattr(config, name))
    if config.patch_size % 2 == 0 or config.patch_size > LARGEST_PATCH:
        raise CFlowError(
            f"patch_size={config.patch_size}: give an odd number of pixels of at most {LARGEST_PATCH}, for example 11"
        )
    _positive("max_extent", config.max_extent)
    for name in ("max_speed", "max_object", "clearance", "max_memory"):
        if getattr(config, name) is not None:
            _positive(name, getattr(config, name))
    if config.zero_test is not None:
        _positive("zero_test", config.zero_test)
        if not 0.01 <= config.zero_test <= LARGEST_Z:
            raise CFlowError(f"zero_test={config.zero_test}: give a number from 0.01 to {LARGEST_Z}, for example 1.5")
    if config.height_slices == 1 or config.height_slices > MOST_SLICES:
        raise CFlowError(f"height_slices={config.height_slices}: give 0 (off) or 2 to {MOST_SLICES}, for example 4")
    z = config.proof_z
    if isinstance(z, bool) or not isinstance(z, (int, float)) or not 0 <= z <= LARGEST_Z:
        raise CFlowError(f"proof_z={z!r}: give a number from 0 to {LARGEST_Z}, for example 2")
    if config.min_cluster_size < 2:
        raise CFlowError(f"min_cluster_size={config.min_cluster_size}: give a whole number of at least 2")
    _positive("ratio_threshold", config.ratio_threshold)
    if not 1 <= config.ratio_threshold <= LARGEST_RATIO:
        raise CFlowError(
            f"ratio_threshold={config.ratio_threshold}: give a number from 1 to {LARGEST_RATIO}, for example 1.1"
        )
    if config.clearance is not None and config.clearance > HIGHEST_CLEARANCE:
        raise CFlowError(f"clearance={config.clearance}: give at most {HIGHEST_CLEARANCE} m, for example 0.4, or None")
    if config.keypoint_block > LARGEST_BLOCK:
        raise CFlowError(f"keypoint_block={config.keypoint_block}: give at most {LARGEST_BLOCK} pixels, for example 2")
    if config.max_memory is not None and math.isinf(config.max_memory):
        raise CFlowError(f"max_memory={config.max_memory}: give a finite number of bytes, or None for no limit")
    for name in ("sweep_interval", "gate_radius", "slice_height", "second_best_distance"):
        value = getattr(config, name)
        if name == "second_best_distance" and value == 0:
            continue
        _positive(name, value)
        if not SHORTEST <= value <= LONGEST:
            raise CFlowError(f"{name}={value}: give a number from {SHORTEST:g} to {LONGEST:g}")


def _check_space(sizes: Tuple[float, ...], box: Tuple[float, ...]) -> None:
    if not sizes or any(not 0 < s < math.inf for s in sizes) or any(a <= b for a, b in zip(sizes, sizes[1:])):
        raise CFlowError(
            f"pixel_sizes={sizes}: give at least one positive size in metres, strictly coarse to fine, "
            "for example (0.4, 0.2, 0.1)"
        )
    if len(box) != 6 or any(math.isnan(v) for v in box) or any(a >= b for a, b in zip(box[:3], box[3:])):
        raise CFlowError(
            f"point_cloud_range={box}: give (x0, y0, z0, x1, y1, z1) in metres with x0 < x1, y0 < y1, z0 < z1"
        )
    if any(math.isinf(v) for v in (box[0], box[1], box[3], box[4])):
        raise CFlowError(f"point_cloud_range={box}: give finite x and y bounds; only z may be infinite")


def _check_proof(config: Any) -> None:
    mend = "give proof=False too, or start from preset='paper'"
    x0, y0, _, x1, y1, _ = config.point_cloud_range
    if max(x1 - x0, y1 - y0) > WIDEST_PROOF:
        raise CFlowError(
            f"point_cloud_range={config.point_cloud_range}: with proof=True (as in preset='default') a side is at "
            f"most {WIDEST_PROOF} m: give less; else {mend}"
        )
    blocks = [size / config.pixel_sizes[-1] for size in config.pixel_sizes]
    if any(math.isinf(block) or abs(block - round(block)) > 1e-6 for block in blocks):
        raise CFlowError(
            f"pixel_sizes={config.pixel_sizes}: with proof=True (as in preset='default') give whole multiples of the "
            f"finest one, for example (0.4, 0.2, 0.1); else {mend}"
        )
    for name, value in NOT_WITH_PROOF.items():
        if getattr(config, name) != value:
            raise CFlowError(f"{name}={getattr(config, name)!r} does not go with proof=True: {mend}")
    if config.height_slices not in (0, 4):
        raise CFlowError(f"height_slices={config.height_slices}: proof=True knows 0 and 4; else {mend}")


def one_of(name: str, value: Any, allowed: Tuple[Any, ...]) -> None:
    """Raises `CFlowError` unless a setting is one of those allowed, in type too."""
    if not any(type(value) is type(a) and value == a for a in allowed):
        raise CFlowError(f"{name}={value!r}: give one of {', '.join(repr(a) for a in allowed)}")


def floats(name: str, values: Any) -> Tuple[float, ...]:
    """Any list of numbers as a tuple."""
    try:
        return tuple(float(v) for v in values)
    except (TypeError, ValueError, OverflowError):
        raise CFlowError(f"{name}={values!r}: give a list of numbers") from None


def _whole_number(name: str, value: Any) -> None:
    if isinstance(value, bool) or not isinstance(value, int) or not 0 <= value < MOST:
        raise CFlowError(f"{name}={value!r}: give a whole number of at least 0 and below 2^53")


def _positive(name: str, value: Any) -> None:
    is_number = isinstance(value, float) or (isinstance(value, int) and not isinstance(value, bool) and value < MOST)
    if not is_number or not value > 0:
        raise CFlowError(f"{name}={value!r}: give a positive number, a whole one below 2^53")
