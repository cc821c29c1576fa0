"""The kinds of scene by name."""

from __future__ import annotations

from typing import Callable

import numpy as np

from cflow_torch.simulator.car_park import build_car_park
from cflow_torch.simulator.crossing import build_crossing
from cflow_torch.simulator.highway import build_highway
from cflow_torch.simulator.narrow import build_narrow
from cflow_torch.simulator.scene import Scene
from cflow_torch.simulator.street import build_street
from cflow_torch.types import CFlowError

SCENES: dict[str, Callable[[np.random.Generator], Scene]] = {
    "street": build_street,
    "highway": build_highway,
    "crossing": build_crossing,
    "narrow": build_narrow,
    "car_park": build_car_park,
}


def get_scene(name: str) -> Callable[[np.random.Generator], Scene]:
    """What builds the scene called `name` from a random generator.

    Raises:
        CFlowError: there is none of that name.
    """
    if name not in SCENES:
        raise CFlowError(f"scene {name!r} does not exist; choose one of {', '.join(sorted(SCENES))}")
    return SCENES[name]
