"""Every setting of the method in one frozen, validated dataclass, and the presets."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, fields, replace
from typing import Any, Dict, Optional, Tuple

from cflow_torch.checks import check, floats, one_of
from cflow_torch.types import CFlowError


@dataclass(frozen=True)
class Config:
    """Settings of CorrelationFlow. Checked when made; an invalid value raises `CFlowError`.

    Args:
        method: "dense": one motion for every cluster, by correlation (Alg. general_correlation_flow), or "keypoints":
            matches of key points, spread over components (Sec. CorrelationFlow-Keypoints).
        pixel_sizes: side s of a BEV pixel in metres, one per scale, coarse to fine (Eq. 3d_to_bev).
        num_history: h, number of sweeps before t that are used (Sec. leverage_past_pcs).
        point_cloud_range: (x0, y0, z0, x1, y1, z1) in metres, both ends included, in the frame of t+1.
        ego_box: (x0, y0, x1, y1) in metres, both ends included, in every sweep's own frame: points in it are returns of
            the vehicle itself and take no part, as ground. They stand still in that frame, so without it they move as
            the vehicle does. None = there are none.
        connectivity: 4: pixels join along their sides, 8: also across their corners (Sec. clustering).
        max_extent: d^max in metres: longer side of a component's bounding box above which it is eroded
            and labelled again (Alg. clustering).
        max_speed: a displacement longer than max_speed * elapsed time + one pixel is not searched.
            None = the paper's search range, half of the cluster's bounding box. With `proof` it bounds candidates, with
            a pixel of their own pixel size; what places, refines or creeps may add some decimetres.
        max_object: a cluster whose pixels at t+1 have a bounding box with a side of more metres than this does not
            move, see docs/beyond.md. None = any may. With `proof` it has the score of the coarser component around it,
            or 0.
        zero_test: z: a shift is kept if the pixels that coincide by it only (b) are significantly more than those that
            coincide without it only (c): b > c and (b - c)^2 >= z^2 (b + c). 0.01 ... 1000, used to two decimals.
            None = every shift is kept.
        subpixel: "none" or "parabola": the peak of the correlation to fractions of a pixel, at most half a pixel away,
            by the parabola through the counts beside it; a peak at no shift stays there.
        height_slices: number of height slices n, 2 ... 8: points coincide only if their slices floor(z / slice_height)
            mod n do, z in the frame of t+1. Clusters stay those of the BEV. 0 = one slice for all heights.
        slice_height: height of a slice, metres.
        proof: candidate motions of components at all `pixel_sizes` at once, judged against no motion at the finest one,
            in four height slices, instead of coarse to fine, see docs/beyond.md. `pixel_sizes` must be whole multiples
            of the finest. The options from here to `keypoint_block` are parts of it and mean nothing without it.
        proof_z: standard deviations of luck that a motion must exceed to be proved.
        clearance: pixels that stand out of the ground around them by less than this many metres are left out, where
            ground is known. None = none are.
        children: also components that are not dilated, as parts of the finest ones.
        aperture: lines that seem to slide along themselves do not move.
        relocate: pairs of sweeps: place moving groups between the pixels, on four grids.
        nudge: pairs of sweeps: move large moving groups by 0.05 m at most where their centroids meet better.
        yaw: refine the motion of moving groups and let them turn.
        slow: pairs of sweeps: look for motion of a pixel or less in groups that nothing moved, on small cubes.
        keypoint_block: k; key points of t and t+1 are matched at pixels of k x k finest ones, and what they say of a
            component is one of its candidates; `patch_size` and the settings of key points that follow it count.
            0 = they are not asked.
        sweep_interval: seconds between consecutive sweeps where time stamps are missing.
        use_timestamps: divide a history estimate by elapsed time (in sweep intervals t -> t+1) instead of steps.
        sectional_view: also estimate f_z in the X-Z view along the heading (Alg. scene_flow_1obj).
        clustering: "components": connected components (Alg. clustering), or "hdbscan" in their place (Table
            which_clustering_method; extra hdbscan, seconds per pair).
        min_cluster_size: hdbscan: smallest cluster, points of all sweeps together.
        labeling: engine of morphology and labelling, "sparse" (occupied pixels only) or "kornia" (dense image).
        correlation: engine of the correlation, "fft" or "conv". Engines give the same bits.
        densify: key points: where a point takes its flow from: "components" (median of the matches in its connected
            component of I_t), "clusters" (the same, components of Alg. clustering: dilated, split at `max_extent`) or
            "nearest" (nearest match).
        patch_size: key points: side L of a descriptor, odd number of pixels, at most 51.
        ratio_threshold: key points: rho of the ratio test, 1 ... 2, used to four decimals.
        gate_radius: key points: farthest match, metres per 0.1 s between the sweeps (3 = 30 m/s).
        mutual_check: key points: also ask that a match is the best one seen from t+1.
        second_best_distance: key points: pixels; the second best of the ratio test lies at least this far from the
            best. 0 = the paper's, any other key point.
        max_memory: bytes of working memory that the method may plan with; None = no limit.
    """

    method: str = "dense"
    pixel_sizes: Tuple[float, ...] = (0.1,)
    num_history: int = 0
    point_cloud_range: Tuple[float, ...] = (-35.0, -35.0, -math.inf, 35.0, 35.0, math.inf)
    ego_box: Optional[Tuple[float, ...]] = None
    connectivity: int = 8
    max_extent: float = 20.0
    max_speed: Optional[float] = None
    max_object: Optional[float] = None
    zero_test: Optional[float] = None
    subpixel: str = "none"
    height_slices: int = 0
    slice_height: float = 0.5
    proof: bool = False
    proof_z: float = 1.5
    clearance: Optional[float] = None
    children: bool = False
    aperture: bool = False
    relocate: bool = False
    nudge: bool = False
    yaw: bool = False
    slow: bool = False
    keypoint_block: int = 0
    sweep_interval: float = 0.1
    use_timestamps: bool = False
    sectional_view: bool = False
    clustering: str = "components"
    min_cluster_size: int = 20
    labeling: str = "sparse"
    correlation: str = "fft"
    densify: str = "components"
    patch_size: int = 11
    ratio_threshold: float = 1.1
    gate_radius: float = 3.0
    mutual_check: bool = False
    second_best_distance: float = 0.0
    max_memory: Optional[int] = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "pixel_sizes", floats("pixel_sizes", self.pixel_sizes))
        object.__setattr__(self, "point_cloud_range", floats("point_cloud_range", self.point_cloud_range))
        if self.ego_box is not None:
            object.__setattr__(self, "ego_box", floats("ego_box", self.ego_box))
        check(self)

    def replace(self, **overrides: Any) -> Config:
        """A copy with some fields changed; an unknown field raises `CFlowError` that lists the fields."""
        return replace(self, **_known(overrides))

    def as_dict(self) -> Dict[str, Any]:
        """Plain dictionary, field by field, ready for YAML or JSON."""
        return {k: list(v) if isinstance(v, tuple) else v for k, v in asdict(self).items()}


# What each preset changes in `Config`'s defaults. Those are the paper's base row: s = 0.1 m, BEV, h = 0.
PRESETS: Dict[str, Dict[str, Any]] = {
    "paper": {},
    # What pays of docs/beyond.md; region of the main harness.
    "default": {
        "num_history": 4,
        "pixel_sizes": (0.4, 0.2, 0.1),
        "point_cloud_range": (-51.2, -51.2, -math.inf, 51.2, 51.2, math.inf),
        "max_speed": 40.0,
        "max_object": 25.0,
        "proof": True,
        "clearance": 0.4,
        "children": True,
        "aperture": True,
        "relocate": True,
        "yaw": True,
        "slow": True,
        "use_timestamps": True,
        # Cheap key points: they only propose.
        "keypoint_block": 2,
        "patch_size": 21,
        "ratio_threshold": 1.02,
    },
    # Two older sweeps, one scale, and of docs/beyond.md what costs little.
    "fast": {
        "num_history": 2,
        "point_cloud_range": (-51.2, -51.2, -math.inf, 51.2, 51.2, math.inf),
        "max_speed": 40.0,
        "max_object": 25.0,
        "proof": True,
        "clearance": 0.4,
        "use_timestamps": True,
    },
    # Best mean of scripts/keypoint_settings.py on its synthetic set; region of the main harness.
    "keypoints": {
        "method": "keypoints",
        "densify": "clusters",
        "patch_size": 41,
        "ratio_threshold": 1.02,
        "gate_radius": 2.0,
        "point_cloud_range": (-51.2, -51.2, -math.inf, 51.2, 51.2, math.inf),
    },
}


def make_config(preset: str = "default", **overrides: Any) -> Config:
    """The settings of a preset with some fields replaced.

    Args:
        preset: "default", "fast", "keypoints" or "paper". With `method="keypoints"` every preset but "paper" means
            "keypoints".
        **overrides: any field of `Config`; `pixel_size=0.1` is short for `pixel_sizes=(0.1,)`.

    Returns:
        A checked `Config`.

    Raises:
        CFlowError: unknown preset, unknown field (the message lists the fields), invalid value.
    """
    one_of("preset", preset, tuple(PRESETS))
    if overrides.get("method") == "keypoints" and preset != "paper":  # history and scales are for the dense method
        preset = "keypoints"
    return Config(**PRESETS[preset]).replace(**overrides)


def _known(overrides: Dict[str, Any]) -> Dict[str, Any]:
    overrides = dict(overrides)
    if "pixel_size" in overrides:
        if "pixel_sizes" in overrides:
            raise CFlowError("pixel_size and pixel_sizes were both given: give one of them")
        overrides["pixel_sizes"] = (overrides.pop("pixel_size"),)
    names = [f.name for f in fields(Config)]
    unknown = sorted(set(overrides) - set(names))
    if unknown:
        raise CFlowError(f"unknown setting {', '.join(unknown)}: the fields are {', '.join(['pixel_size', *names])}")
    return overrides
