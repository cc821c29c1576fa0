"""The object categories of Argoverse 2, and the five meta classes of its scores."""

from __future__ import annotations

import numpy as np

from cflow_torch.types import CFlowError

# Category -> its meta class. Animals, signs, sign trailers, bollards, cones and barrels have none.
_META_CLASS = {
    "NONE": "BACKGROUND",
    "ANIMAL": "",
    "ARTICULATED_BUS": "OTHER_VEHICLES",
    "BICYCLE": "WHEELED_VRU",
    "BICYCLIST": "WHEELED_VRU",
    "BOLLARD": "",
    "BOX_TRUCK": "OTHER_VEHICLES",
    "BUS": "OTHER_VEHICLES",
    "CONSTRUCTION_BARREL": "",
    "CONSTRUCTION_CONE": "",
    "DOG": "",
    "LARGE_VEHICLE": "OTHER_VEHICLES",
    "MESSAGE_BOARD_TRAILER": "",
    "MOBILE_PEDESTRIAN_CROSSING_SIGN": "",
    "MOTORCYCLE": "WHEELED_VRU",
    "MOTORCYCLIST": "WHEELED_VRU",
    "OFFICIAL_SIGNALER": "PEDESTRIAN",
    "PEDESTRIAN": "PEDESTRIAN",
    "RAILED_VEHICLE": "OTHER_VEHICLES",
    "REGULAR_VEHICLE": "CAR",
    "SCHOOL_BUS": "OTHER_VEHICLES",
    "SIGN": "",
    "STOP_SIGN": "",
    "STROLLER": "PEDESTRIAN",
    "TRAFFIC_LIGHT_TRAILER": "",
    "TRUCK": "OTHER_VEHICLES",
    "TRUCK_CAB": "OTHER_VEHICLES",
    "VEHICULAR_TRAILER": "OTHER_VEHICLES",
    "WHEELCHAIR": "PEDESTRIAN",
    "WHEELED_DEVICE": "WHEELED_VRU",
    "WHEELED_RIDER": "WHEELED_VRU",
}
CATEGORIES = tuple(_META_CLASS)
"""Names of the categories, in the order of their indices in labels (0 = background)."""

CATEGORY_INDEX = {name: index for index, name in enumerate(CATEGORIES)}

META_NAMES = ("BACKGROUND", "CAR", "OTHER_VEHICLES", "PEDESTRIAN", "WHEELED_VRU")
META_CLASSES = {meta: tuple(name for name in CATEGORIES if _META_CLASS[name] == meta) for meta in META_NAMES}
"""Meta class -> its categories."""

_META_OF_CATEGORY = np.array([META_NAMES.index(meta) if meta else -1 for meta in _META_CLASS.values()])


def meta_class(category: np.ndarray) -> np.ndarray:
    """Return the meta class of (N,) categories 0 ... 30 as (N,) int64 indices into `META_NAMES`; -1 = none."""
    if category.size and (category.min() < 0 or category.max() >= len(CATEGORIES)):
        raise CFlowError(
            f"category indices are 0 ... {len(CATEGORIES) - 1} (0 = background), got "
            f"{category.min()} ... {category.max()}; map other data sets to Argoverse 2 indices first"
        )
    return _META_OF_CATEGORY[category]
