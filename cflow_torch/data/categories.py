"""The object categories of Argoverse 2, and the five meta classes of its scores."""

from __future__ import annotations

import numpy as np

from cflow_torch.types import CFlowError

CATEGORIES: tuple[str, ...] = (
    "NONE",
    "ANIMAL",
    "ARTICULATED_BUS",
    "BICYCLE",
    "BICYCLIST",
    "BOLLARD",
    "BOX_TRUCK",
    "BUS",
    "CONSTRUCTION_BARREL",
    "CONSTRUCTION_CONE",
    "DOG",
    "LARGE_VEHICLE",
    "MESSAGE_BOARD_TRAILER",
    "MOBILE_PEDESTRIAN_CROSSING_SIGN",
    "MOTORCYCLE",
    "MOTORCYCLIST",
    "OFFICIAL_SIGNALER",
    "PEDESTRIAN",
    "RAILED_VEHICLE",
    "REGULAR_VEHICLE",
    "SCHOOL_BUS",
    "SIGN",
    "STOP_SIGN",
    "STROLLER",
    "TRAFFIC_LIGHT_TRAILER",
    "TRUCK",
    "TRUCK_CAB",
    "VEHICULAR_TRAILER",
    "WHEELCHAIR",
    "WHEELED_DEVICE",
    "WHEELED_RIDER",
)
"""Names of the categories, in the order of their indices in labels (0 = background)."""

CATEGORY_INDEX: dict[str, int] = {name: index for index, name in enumerate(CATEGORIES)}

META_CLASSES: dict[str, tuple[str, ...]] = {
    "BACKGROUND": ("NONE",),
    "CAR": ("REGULAR_VEHICLE",),
    "OTHER_VEHICLES": (
        "ARTICULATED_BUS",
        "BOX_TRUCK",
        "BUS",
        "LARGE_VEHICLE",
        "RAILED_VEHICLE",
        "SCHOOL_BUS",
        "TRUCK",
        "TRUCK_CAB",
        "VEHICULAR_TRAILER",
    ),
    "PEDESTRIAN": ("OFFICIAL_SIGNALER", "PEDESTRIAN", "STROLLER", "WHEELCHAIR"),
    "WHEELED_VRU": ("BICYCLE", "BICYCLIST", "MOTORCYCLE", "MOTORCYCLIST", "WHEELED_DEVICE", "WHEELED_RIDER"),
}
"""Meta class -> its categories. Signs, cones, trailers of signs and animals have none and are not scored."""

META_NAMES: tuple[str, ...] = tuple(META_CLASSES)


_META_OF_CATEGORY = np.array(
    [next((index for index, names in enumerate(META_CLASSES.values()) if name in names), -1) for name in CATEGORIES]
)


def meta_class(category: np.ndarray) -> np.ndarray:
    """Return (N,) int64 indices into `META_NAMES` of (N,) categories 0 ... 30; -1 = it has no meta class."""
    if category.size and (category.min() < 0 or category.max() >= len(CATEGORIES)):
        raise CFlowError(
            f"category indices are 0 ... {len(CATEGORIES) - 1} (0 = background), got "
            f"{category.min()} ... {category.max()}; map other data sets to Argoverse 2 indices first"
        )
    return _META_OF_CATEGORY[category]
