"""How far apart the numbers of a type are far from the origin, and where that is too coarse for flow."""

from __future__ import annotations

import math
from typing import Any, Sequence

import numpy as np
import torch

from cflow_torch.config import Config
from cflow_torch.types import CFlowError, Window

# A position may be off by half of what lies between two numbers. Points are told apart to half of the finest pixel ...
_OF_A_PIXEL = 0.5
# ... and a pose, which moves all of them, to so many metres.
COARSEST_POSE = 0.01


def resolution(dtype: Any, distance: float) -> float:
    """Difference between neighbouring numbers of a type.

    Args:
        dtype: floating-point type of NumPy or torch; any other holds what it holds without loss: 0.
        distance: from 0, in the unit of the answer.

    Returns:
        A power of two, in the unit of `distance`; 0 for distance 0.
    """
    if isinstance(dtype, torch.dtype):
        epsilon = torch.finfo(dtype).eps if dtype.is_floating_point else 0.0
    else:
        epsilon = float(np.finfo(dtype).eps) if np.issubdtype(dtype, np.floating) else 0.0
    return math.ldexp(epsilon, math.frexp(distance)[1] - 1) if distance else 0.0


def check_resolution(windows: Sequence[Window], config: Config) -> None:
    """Refuse points whose type cannot tell the finest pixels apart at the far end of the region.

    Args:
        windows: checked otherwise.
        config: `point_cloud_range`, `pixel_sizes`.

    Raises:
        CFlowError: for example float32 in a frame whose origin is 10,000 km away, where it holds whole metres.

    Cost: looks at types only, at no point.
    """
    bounds = config.point_cloud_range
    farthest = max(abs(bound) for bound in (*bounds[:2], *bounds[3:5]))
    for window in windows:
        sweeps = [("pc0", window.pc0), ("pc1", window.pc1), *((f"pch{i}", s) for i, s in enumerate(window.pch, 1))]
        for name, sweep in sweeps:
            step = resolution(sweep.points.dtype, farthest)
            if step > _OF_A_PIXEL * config.pixel_sizes[-1]:
                raise CFlowError(
                    f"{name} is {sweep.points.dtype}, which at {farthest:g} m (the far end of point_cloud_range) only "
                    f"holds multiples of {step:g} m, too coarse for pixels of {config.pixel_sizes[-1]:g} m: give "
                    "points of a wider type, or a frame whose origin is nearer (point_cloud_range and poses with it), "
                    "or larger pixel_sizes"
                )
