"""What each field of `Config` may be, in words, with values on both sides of every limit; and their order on the page.

The words are for scripts/config_reference.py. The values keep them honest: tests/test_config_reference.py gives each of
them to `Config`.
"""

from __future__ import annotations

import math
from typing import Any, Dict, NamedTuple, Tuple

from cflow_torch.checks import (
    CLUSTERINGS,
    CORRELATIONS,
    DENSIFIERS,
    HIGHEST_CLEARANCE,
    LABELINGS,
    LARGEST_BLOCK,
    LARGEST_PATCH,
    LARGEST_RATIO,
    LARGEST_Z,
    LONGEST,
    METHODS,
    MOST_SLICES,
    SHORTEST,
    SUBPIXELS,
)

INF, NAN = math.inf, math.nan


class Limits(NamedTuple):
    """Values of a setting.

    Args:
        text: what is allowed.
        good: values that `Config` takes, each with all other fields at their defaults.
        bad: values that it refuses.
    """

    text: str
    good: Tuple[Any, ...]
    bad: Tuple[Any, ...]


def _one_of(allowed: Tuple[Any, ...]) -> Limits:
    return Limits(", ".join(f"`{value}`" for value in allowed), allowed, ("another", None, 6))


def _positive(unit: str, may_be_none: bool = False, may_be_infinite: bool = True) -> Limits:
    text = f"number > 0, {unit}" + (", or null" if may_be_none else "")
    good = (1e-3, 1, 1e3, *([None] if may_be_none else []), *([INF] if may_be_infinite else []))
    return Limits(
        text, good, (0, -1.0, NAN, "1", *([] if may_be_none else [None]), *([] if may_be_infinite else [INF]))
    )


def _bounded(unit: str, or_zero: bool = False) -> Limits:
    good = (SHORTEST, 1, 1.5, LONGEST, *([0, 0.0] if or_zero else []))
    bad = (-1.0, 0.9 * SHORTEST, 2 * LONGEST, INF, NAN, "1", None, *([] if or_zero else [0]))
    return Limits(f"{'0, or ' * or_zero}{SHORTEST:g} to {LONGEST:g}, {unit}", good, bad)


_SWITCH = Limits("`true`, `false`", (True, False), (None, 0, 1, "true"))
_NEGATIVE = (-1, 1.5, True, None)

LIMITS: Dict[str, Limits] = {
    "method": _one_of(METHODS),
    "pixel_sizes": Limits(
        "numbers > 0, m, largest first", ((0.1,), (0.4, 0.2, 0.1)), ((), (0.1, 0.2), (0.1, 0.1), (0.0,), (INF,), 0.1)
    ),
    "num_history": Limits("whole number >= 0", (0, 1, 9), _NEGATIVE),
    "point_cloud_range": Limits(
        "six numbers, m; z may be infinite; with `proof` at most 3000 m a side",
        ((-1, -1, -INF, 1, 1, INF), (-1, -1, -1, 1, 1, 1)),
        ((-1, -1, 1, 1), (1, -1, -1, -1, 1, 1), (-INF, -1, -1, 1, 1, 1), (-1, -1, -1, 1, 1, NAN)),
    ),
    "ego_box": Limits(
        "four numbers, m, or null", (None, (-1, -1, 3, 1)), ((-1, -1, 3), (3, -1, -1, 1), (-INF, -1, 3, 1))
    ),
    "connectivity": _one_of((4, 8)),
    "max_extent": _positive("m"),
    "max_speed": _positive("m/s", may_be_none=True),
    "max_object": _positive("m", may_be_none=True),
    "zero_test": Limits(f"0.01 to {LARGEST_Z}, or null", (None, 0.01, LARGEST_Z), (0, 0.009, LARGEST_Z + 1, NAN)),
    "subpixel": _one_of(SUBPIXELS),
    "height_slices": Limits(f"0, or 2 to {MOST_SLICES}", (0, 2, MOST_SLICES), (1, MOST_SLICES + 1, *_NEGATIVE)),
    "slice_height": _bounded("m"),
    "proof": _SWITCH,
    "proof_z": Limits(f"0 to {LARGEST_Z}", (0, 1.5, LARGEST_Z), (-0.1, LARGEST_Z + 1, NAN, None, True)),
    "clearance": Limits(
        f"number > 0, at most {HIGHEST_CLEARANCE}, m, or null",
        (None, 1e-3, HIGHEST_CLEARANCE),
        (0, -1, HIGHEST_CLEARANCE + 1, NAN),
    ),
    "children": _SWITCH,
    "aperture": _SWITCH,
    "relocate": _SWITCH,
    "nudge": _SWITCH,
    "yaw": _SWITCH,
    "slow": _SWITCH,
    "keypoint_block": Limits(
        f"whole number, 0 to {LARGEST_BLOCK}", (0, 2, LARGEST_BLOCK), (LARGEST_BLOCK + 1, *_NEGATIVE)
    ),
    "sweep_interval": _bounded("s"),
    "use_timestamps": _SWITCH,
    "sectional_view": _SWITCH,
    "clustering": _one_of(CLUSTERINGS),
    "min_cluster_size": Limits("whole number >= 2", (2, 1000), (1, *_NEGATIVE)),
    "labeling": _one_of(LABELINGS),
    "correlation": _one_of(CORRELATIONS),
    "densify": _one_of(DENSIFIERS),
    "patch_size": Limits(f"odd, 1 to {LARGEST_PATCH}", (1, 11, LARGEST_PATCH), (10, LARGEST_PATCH + 2, *_NEGATIVE)),
    "ratio_threshold": Limits(f"1 to {LARGEST_RATIO}", (1, 1.02, LARGEST_RATIO), (0.99, LARGEST_RATIO + 0.01, NAN)),
    "gate_radius": _bounded("m per 0.1 s"),
    "mutual_check": _SWITCH,
    "second_best_distance": _bounded("pixels", or_zero=True),
    "max_memory": _positive("bytes", may_be_none=True, may_be_infinite=False),
}

GROUPS: Dict[str, Tuple[str, ...]] = {
    "What is computed, and where": (
        "method",
        "point_cloud_range",
        "ego_box",
        "pixel_sizes",
        "num_history",
        "max_speed",
        "sweep_interval",
        "use_timestamps",
    ),
    "Clusters": ("clustering", "connectivity", "max_extent", "max_object", "min_cluster_size"),
    "The dense method": ("sectional_view", "zero_test", "subpixel", "height_slices", "slice_height"),
    "Hypotheses and proof": (
        "proof",
        "proof_z",
        "clearance",
        "children",
        "aperture",
        "relocate",
        "nudge",
        "yaw",
        "slow",
        "keypoint_block",
    ),
    "Key points": (
        "densify",
        "patch_size",
        "ratio_threshold",
        "gate_radius",
        "mutual_check",
        "second_best_distance",
    ),
    "How it is computed": ("labeling", "correlation", "max_memory"),
}
