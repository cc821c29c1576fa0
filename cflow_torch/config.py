"""The settings of each method, and the presets. A preset lists only the settings that it changes."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, fields, replace
from typing import Any, ClassVar, Optional, Sequence, Tuple, TypeVar

from cflow_torch.errors import CFlowError, near
from cflow_torch.setting import LIMIT, Settings, setting

Method = TypeVar("Method", bound="Config")


def _method(name: str) -> Any:
    return setting(name, "dense | keypoints | verified; a preset chooses it", choices=(name,))


def _check_space(sizes: tuple[float, ...], box: tuple[float, ...], own: tuple[float, ...] | None) -> None:
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
    if own is not None and (len(own) != 4 or not all(map(math.isfinite, own)) or own[0] >= own[2] or own[1] >= own[3]):
        raise CFlowError(f"ego_box={own}: give (x0, y0, x1, y1) in metres, finite, with x0 < x1 and y0 < y1, or None")


@dataclass(frozen=True)
class Config(Settings):
    """Settings that all methods have. Each method adds its own ones (`METHODS`). `make_config` makes all from a preset.

    An invalid value raises `CFlowError`. `cflow settings` lists the meaning and the bounds of every field.
    """

    NAMED_BY: ClassVar[str] = "method"

    method: str = _method("")
    pixel_sizes: Tuple[float, ...] = setting(
        (0.1,), "side s of a BEV pixel, metres, one per scale, coarse to fine (Eq. 3d_to_bev)"
    )
    point_cloud_range: Tuple[float, ...] = setting(
        (-35.0, -35.0, -math.inf, 35.0, 35.0, math.inf),
        "(x0, y0, z0, x1, y1, z1), metres, both ends included, frame of t+1; only z may be infinite",
    )
    ego_box: Optional[Tuple[float, ...]] = setting(
        None,
        "(x0, y0, x1, y1), metres, both ends included, frame of each sweep: the method ignores the points in this box, "
        "which are returns of the vehicle itself. None = it ignores none",
        kind=tuple,
        optional=True,
    )
    max_speed: Optional[float] = setting(
        None,
        "m/s: the search ends at displacements of max_speed * elapsed time + one pixel. None = the paper's search "
        "range, half of the cluster's bounding box",
        kind=float,
        optional=True,
        above=0,
    )
    sweep_interval: float = setting(
        0.1, "seconds between consecutive sweeps where time stamps are missing", low=1e-6, high=1e6
    )
    max_memory: Optional[float] = setting(
        None,
        "bytes of working memory that the method may plan with. None = half of a GPU's free memory, 512 MiB on a CPU",
        kind=float,
        optional=True,
        above=0,
        high=float(LIMIT),
        free=True,
    )

    def check(self) -> None:
        _check_space(self.pixel_sizes, self.point_cloud_range, self.ego_box)

    @classmethod
    def kinds(cls) -> dict[str, type[Config]]:
        return METHODS

    @classmethod
    def check_names(cls, names: Sequence[str]) -> None:
        """Raise a `CFlowError` if one of the names is not a setting of this method; name the method that has it."""
        own = [f.name for f in fields(cls)]
        for name in sorted(set(names) - set(own)):
            methods = [method for method, other in METHODS.items() if name in (f.name for f in fields(other))]
            if methods:
                raise CFlowError(
                    f"{name} is a setting of method {' and '.join(methods)}, not of {fields(cls)[0].default}: "
                    "leave it out, or choose another preset"
                )
        super().check_names(names)

    @property
    def num_history(self) -> int:
        """h, number of sweeps before t."""
        return 0

    @property
    def num_compared(self) -> int | None:
        """How many of the sweeps before t we compare with t+1; None = all of them."""
        return None

    @property
    def num_future(self) -> int:
        """Number of sweeps after t+1."""
        return 0

    @property
    def num_sweeps(self) -> int:
        """Number of sweeps of a window: the history, t, t+1 and the sweeps after it."""
        return self.num_history + 2 + self.num_future

    def replace(self: Method, **overrides: Any) -> Method:
        """Copy the settings with some fields changed. An unknown field raises a `CFlowError` that lists the fields."""
        if "pixel_size" in overrides:
            if "pixel_sizes" in overrides:
                raise CFlowError("pixel_size and pixel_sizes were both given: give one of them")
            overrides["pixel_sizes"] = (overrides.pop("pixel_size"),)
        self.check_names(list(overrides))
        return replace(self, **overrides)

    def as_dict(self) -> dict[str, Any]:
        """A plain dictionary for YAML or JSON, which `Config.of` reads."""
        return {k: list(v) if isinstance(v, tuple) else v for k, v in asdict(self).items()}


@dataclass(frozen=True)
class ClusteringConfig(Config):
    """Settings of the paper's clustering (its Alg. clustering), for the dense and the key-point method."""

    connectivity: int = setting(
        8, "4: pixels join along their sides, 8: also across their corners (Sec. clustering)", choices=(4, 8)
    )
    max_extent: float = setting(
        20.0,
        "d^max, metres: longer side of a component's bounding box above which it is eroded and labelled again "
        "(Alg. clustering)",
        above=0,
    )
    labeling: str = setting(
        "sparse",
        "engine of morphology and labelling: sparse (occupied pixels only) or kornia (dense images); the same result",
        choices=("sparse", "kornia"),
    )


@dataclass(frozen=True)
class _WithHistory(Config):
    num_history: int = setting(  # type: ignore[assignment]
        0, "h, number of sweeps before t (Sec. leverage_past_pcs)", low=0
    )
    correlation: str = setting(
        "fft", "engine of the correlation: fft or conv (conv2d); the same result", choices=("fft", "conv")
    )


@dataclass(frozen=True)
class DenseConfig(_WithHistory, ClusteringConfig):
    """Settings of `CorrelationFlow`, the paper's dense method. The defaults are the paper's baseline."""

    method: str = _method("dense")
    sectional_view: bool = setting(False, "also estimate f_z in the X-Z view along the heading (Alg. scene_flow_1obj)")
    clustering: str = setting(
        "components",
        "components (Alg. clustering) or hdbscan in their place (Table which_clustering_method; seconds per pair)",
        choices=("components", "hdbscan"),
    )
    min_cluster_size: int = setting(20, "hdbscan: smallest cluster, points of all sweeps together", low=2)


@dataclass(frozen=True)
class KeypointsConfig(ClusteringConfig):
    """Settings of `CorrelationFlowKeypoints`, the paper's key-point variant, which matches one pair of sweeps."""

    method: str = _method("keypoints")
    densify: str = setting(
        "components",
        "source of the flow of a point: components (median of the matches in its connected component of I_t), "
        "clusters (median of the matches in its cluster of Alg. clustering) or nearest (nearest match)",
        choices=("components", "clusters", "nearest"),
    )
    # The ratio test compares products of counts, and 51^6 * (2 * 10^4)^2 still fits an int64.
    patch_size: int = setting(11, "side L of a descriptor, odd number of pixels", low=1, high=51)
    ratio_threshold: float = setting(1.1, "rho of the ratio test, used to four decimals", low=1, high=2)
    gate_radius: float = setting(
        3.0, "farthest match, metres per 0.1 s between the sweeps (3 = 30 m/s)", low=1e-6, high=1e6
    )

    def check(self) -> None:
        super().check()
        if self.patch_size % 2 == 0:
            raise CFlowError(f"patch_size={self.patch_size}: give an odd number of pixels, for example 11")


@dataclass(frozen=True)
class VerifiedConfig(_WithHistory):
    """Settings of `VerifiedFlow`, which verifies motion candidates of all scales at the finest pixels."""

    method: str = _method("verified")
    num_future: int = setting(  # type: ignore[assignment]
        0,
        "number of sweeps after t+1, for recordings. They decide the motion of an object that is seen in more than "
        "twice as many of them as of the sweeps before t. The method then takes twice the time",
        low=0,
    )
    num_compared: Optional[int] = setting(  # type: ignore[assignment]
        None,
        "how many of the sweeps before t the method compares with t+1: the farthest, the nearest, and others evenly "
        "between them; likewise of those after t+1. None = all of them",
        kind=int,
        optional=True,
        low=1,
    )
    max_object_length: Optional[float] = setting(
        25.0,
        "metres: a component that is longer than this at t+1 moves only if both of its ends move (trams, trains). "
        "None = a component of any length may move",
        optional=True,
        above=0,
    )
    significance: float = setting(
        1.5,
        "z: a motion must explain the sweeps better than no motion by this many standard deviations of noise",
        low=0,
        high=1000,
    )
    min_height: Optional[float] = setting(
        0.4,
        "metres: where the ground is known, the method ignores pixels that rise less than this above the ground around "
        "them, unless a higher pixel is near. In the end, their points next to a moving object move with it. None = it "
        "ignores none",
        optional=True,
        above=0,
        high=1000,
    )

    def check(self) -> None:
        super().check()
        blocks = [size / self.pixel_sizes[-1] for size in self.pixel_sizes]
        if any(math.isinf(block) or abs(block - round(block)) > 1e-6 for block in blocks):
            raise CFlowError(
                f"pixel_sizes={self.pixel_sizes}: the verified method (presets default, offline and live) takes "
                "whole multiples of the finest size: give for example (0.4, 0.2, 0.1)"
            )


WINDOW = ("num_history", "num_future")  # the settings that choose the sweeps of a window

METHODS: dict[str, type[Config]] = {"dense": DenseConfig, "keypoints": KeypointsConfig, "verified": VerifiedConfig}

_REGION = (-76.8, -76.8, -math.inf, 76.8, 76.8, math.inf)
_HARNESS_REGION = (-51.2, -51.2, -math.inf, 51.2, 51.2, math.inf)
_DEFAULT: dict[str, Any] = {
    "num_history": 4,
    "pixel_sizes": (0.4, 0.2, 0.1),
    "point_cloud_range": _REGION,
    "max_speed": 60.0,
}
PRESETS: dict[str, Config] = {
    "default": VerifiedConfig(**_DEFAULT),
    "offline": VerifiedConfig(**{**_DEFAULT, "num_future": 4}),
    "live": VerifiedConfig(**{**_DEFAULT, "num_compared": 2, "point_cloud_range": _HARNESS_REGION}),
    "paper": DenseConfig(),
    # Chosen on the simulated seeds 200 ... 209: docs/method.md.
    "keypoints": KeypointsConfig(
        densify="clusters",
        patch_size=41,
        ratio_threshold=1.02,
        gate_radius=2.0,
        point_cloud_range=_HARNESS_REGION,
    ),
    "paper_keypoints": KeypointsConfig(),
}


def make_config(preset: str | Config = "default", **settings: Any) -> Config:
    """Make the settings of a preset, with some fields replaced.

    Args:
        preset: a name of `PRESETS`: "default", "offline" or "live" (`VerifiedFlow`), "paper" (`CorrelationFlow`),
            "keypoints" or "paper_keypoints" (`CorrelationFlowKeypoints`). Or a `Config`, whose fields are replaced.
        **settings: any field of the settings; `pixel_size=0.1` is short for `pixel_sizes=(0.1,)`.

    Returns:
        A checked `DenseConfig`, `KeypointsConfig` or `VerifiedConfig`.

    Raises:
        CFlowError: an unknown preset or field (the message lists the fields), or an invalid value.
    """
    for name in ("method", "config"):
        if name in settings:
            raise CFlowError(
                f"there is no {name}=: preset= says the method, too: give one of {', '.join(map(repr, PRESETS))}, or "
                "the result of make_config"
            )
    if not isinstance(preset, Config):
        if not isinstance(preset, str) or preset not in PRESETS:
            hint = near(str(preset), PRESETS)
            known = ", ".join(map(repr, PRESETS))
            raise CFlowError(f"preset={preset!r}{hint}: give one of {known}, or the result of make_config")
        preset = PRESETS[preset]
    return preset.replace(**settings)
