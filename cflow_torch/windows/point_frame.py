"""Recognise points that are not in metres, not near the vehicle, or whose z axis does not point up."""

from __future__ import annotations

import numpy as np

from cflow_torch.ground.segmentation import has_ground, is_upside_down
from cflow_torch.types import Array, as_numpy
from cflow_torch.windows.readings import AXES, CAMERA

_FEWEST = 100  # points
# Extent of the middle nine tenths of the points, in the units of the points. Clouds in metres have 5 to 200.
_SMALLEST, _LARGEST, _MILLIMETRES = 2.0, 1000.0, 10_000.0
_FAR = 50.0  # metres; a LiDAR has more than a twentieth of its points nearer than this
_MOST_POINTS = 20_000
_FLAT = 0.6  # of a cloud with z up, the extent in z is less than this part of that in x or y


def frame_problem(points: Array) -> tuple[str, str]:
    """Return the value of `read_as` that corrects a sweep, and what is wrong with it; both "" if nothing is wrong.

    A few points far from the others do not matter. Cost: 10 ms; 30 ms if no ground is found.
    """
    step = max(1, -(-len(points) // _MOST_POINTS))
    positions = as_numpy(points[::step])[:, :3].astype(np.float64)
    positions = positions[np.isfinite(positions).all(axis=1)]
    if len(positions) < _FEWEST:
        return "", ""
    low, middle, high = np.quantile(positions, (0.05, 0.5, 0.95), axis=0)
    extent = high - low
    widest = float(extent[:2].max())
    farthest = float(np.abs(middle[:2]).max())
    nearest = float(np.quantile(np.hypot(positions[:, 0], positions[:, 1]), 0.05))
    spans = f"nine tenths of the points span {widest:.4g} m"
    if widest >= _LARGEST:
        unit = "millimetres" if widest >= _MILLIMETRES else "centimetres"
        return f"points_{unit}", f"{spans}: they seem to be in {unit}, give points in metres"
    if max(widest, farthest) < _SMALLEST:
        return "", f"{spans}: are they in metres?"
    if nearest >= _FAR:
        where = f"the points lie around x = {middle[0]:.6g} m, y = {middle[1]:.6g} m"
        return "", f"{where}: give points in the frame of the LiDAR or of the vehicle, not of a map"
    if is_upside_down(positions):
        return "points_upside_down", "z seems to point down, because nearly all points lie below the ground: " + _UP
    is_tall = extent[2] > _FLAT * max(extent[0], extent[1]) and extent[1] < _FLAT * max(extent[0], extent[2])
    if is_tall and not has_ground(positions) and has_ground(positions @ AXES[CAMERA].T):
        return "points_camera", "the points seem to have a camera's axes (x right, y down, z forward): " + _UP
    return "", ""


_UP = "give points with z up"
