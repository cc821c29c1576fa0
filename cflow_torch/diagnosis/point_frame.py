"""Recognise points that are not x, y, z in metres, not near the vehicle, or whose z axis does not point up."""

from __future__ import annotations

from itertools import combinations
from typing import Iterable

import numpy as np

from cflow_torch.diagnosis.conventions import READINGS, UNITS
from cflow_torch.diagnosis.stillness import cell_keys
from cflow_torch.ground.segmentation import find_ground, ground_side, has_ground
from cflow_torch.transforms import rotations_about
from cflow_torch.types import Array, as_numpy

_FEWEST = 100  # points
# Extent of the middle nine tenths of the points, in the units of the points. Clouds in metres have 5 to 200.
_SMALLEST, _WIDE, _LARGEST, _MILLIMETRES = 2.0, 200.0, 1000.0, 10_000.0
# Metres; a LiDAR has more than a twentieth of its points nearer than this. On the drives that we have, up to 9 m.
_FAR, _NOT_NEAR = 50.0, 20.0
_MOST_POINTS = 20_000
_NEAR = 30.0  # metres
# Metres of a sensor above the ground: cars have 1.5 to 2, trucks up to 4. If another unit is likely, only cars count.
_LOWEST_SENSOR, _HIGHEST_SENSOR, _HIGHEST_ON_CAR = 1.1, 4.3, 2.75
_FLAT = 0.6  # of a cloud with z up, the extent in z is less than this part of that in x or y
_TALL = {  # readings of clouds that are flat in y or x, not in z
    "points_camera": "a camera's axes (x right, y down, z forward)",
    "points_opengl": "y up (x right, z backward)",
    "points_z_first": "z in the first column (z, x, y)",
}
_FULL = 0.95  # least share of a turn that azimuths of a cloud span
_TILTS = range(15, 60, 15)  # degrees; without them, ground is found up to a tilt of 14
_LEAST_TILT = 5.0  # degrees; roads rise by less within 30 m
# Part of the tilt by which one sweep may differ from others, and share of the sweeps that must not: robots and people
# tilt a sensor for a moment, and indoors other surfaces may be taken for ground.
_TILT_APART, _AGREEING = 0.5, 0.75
# Most cells of the plane show one surface, so heights differ by less there than this part of their extent: in 0.32 of
# the cells and more, but those of random numbers in 0.02. Intensities from 0 to 1 have no extent, and those of a byte,
# as rings, have few values.
_SIDE, _FEWEST_IN_CELL, _APART, _LEAST_SMOOTH = 0.5, 5, 0.1, 0.2
_LEAST_HEIGHT, _OF_A_BYTE = 1.0, 256
MOST_COLUMNS = 16


def frame_problem(points: Array) -> tuple[str, str]:
    """Return the value of `read_as` that corrects a sweep, and what is wrong with it; both "" if nothing is wrong.

    A few points far from the others do not matter. `tilt_problem` tells a tilt. Cost: 10 ms.
    """
    positions = _sampled(points)
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
        heights = _heights_if(positions, "centimetres", "inches") if unit == "centimetres" else ""
        unit, why = ("inches", f" ({heights})") if heights else (unit, "")
        return f"points_{unit}", f"{spans}: they seem to be in {unit}{why}, give points in metres"
    if widest >= _WIDE and _NOT_NEAR <= nearest < widest / 2:
        return "points_decimetres", f"{spans}, few less than {nearest:.0f} m away: they seem to be in decimetres"
    if max(widest, farthest) < _SMALLEST:
        if _SMALLEST <= widest * UNITS["kilometres"] < _LARGEST:
            return "points_kilometres", f"{spans}: they seem to be in kilometres, give points in metres"
        return "", f"{spans}: are they in metres?"
    if _is_spherical(positions):
        return "points_spherical", "the columns seem to be range, azimuth and elevation: give x, y, z in metres"
    if nearest >= _FAR:
        where = f"the points lie around x = {middle[0]:.6g} m, y = {middle[1]:.6g} m"
        return "", f"{where}: give points in the frame of the LiDAR or of the vehicle, not of a map"
    side = ground_side(positions)
    if side < 0:
        return "points_upside_down", "z seems to point down, because nearly all points lie below the ground: " + _UP
    is_tall = extent[2] > _FLAT * max(extent[0], extent[1]) and min(extent[:2]) < _FLAT * extent[2]
    heights = _heights_if(positions, "metres", "feet") if side > 0 and low[2] < -_HIGHEST_SENSOR else ""
    if heights:
        return "points_feet", f"{heights}: give points in metres"
    for reading, axes in _TALL.items() if is_tall and side == 0 else ():
        if _has_ground_as(reading, positions):
            return reading, f"the points seem to have {axes}: {_UP}"
    return "", ""


def column_problem(columns: Array) -> str:
    """Return which columns of a sweep, (N, C), seem to be x, y and z, among 16; "" = the first three, or unknown.

    Together, they have ground, and heights that are alike nearby. Cost: 10 ms; 0.1 s if the first three have not.
    """
    if columns.shape[1] < 4 or len(columns) < _FEWEST:
        return ""
    step = len(columns) // _MOST_POINTS + 1
    table = as_numpy(columns[::step])[:, :MOST_COLUMNS].astype(np.float64)
    table[:, ~np.isfinite(table).any(axis=0)] = 0  # one position for all points counts as missing
    table = table[np.isfinite(table).all(axis=1)]
    if _smoothness(table[:, :3]) > _LEAST_SMOOTH:
        return ""
    known = [k for k, column in enumerate(table.T) if len(np.unique(column)) > _OF_A_BYTE]
    chosen = [three for three in combinations(known, 3) if _smoothness(table[:, three]) > _LEAST_SMOOTH]
    if not chosen:
        return ""
    lowest = table.min(axis=0)  # a range, which may look like x or y, is never negative
    found = max(chosen, key=lambda three: (lowest[[*three[:2]]] < 0).sum())  # ties: the first
    named = "{}, {} and {}".format(*(k + 1 for k in found))
    return f"x, y and z seem to be in columns {named}: give these three first, and then others such as intensity"


def _smoothness(positions: np.ndarray) -> float:
    """Return the share of the cells in which points, (N, 3) float64, show one surface; 0 = they have no ground."""
    positions = positions[(np.abs(positions) < _WIDE).all(axis=1)]
    if len(positions) < _FEWEST:
        return 0.0
    low, high = np.quantile(positions[:, 2], (0.05, 0.95))
    if high - low < _LEAST_HEIGHT or not has_ground(positions):
        return 0.0
    cell = cell_keys(np.floor(positions * (1, 1, 0) / _SIDE).astype(np.int64))
    order = np.lexsort((positions[:, 2], cell))
    _, start, count = np.unique(cell[order], return_index=True, return_counts=True)
    start, count = start[count >= _FEWEST_IN_CELL], count[count >= _FEWEST_IN_CELL]
    height = positions[order, 2]
    apart = height[start + count * 3 // 4] - height[start + count // 4]
    return float((apart < _APART * (high - low)).mean()) if len(apart) else 0.0


def tilt_problem(sweeps: Iterable[Array]) -> str:
    """Return by how much the sensor is tilted, and how to level it, if most sweeps agree; "" = it is level or unknown.

    Sweeps without ground do not agree.

    Args:
        sweeps: points of each, (N, 3+), without a `frame_problem`. If the first one is level, others are not read.

    Cost: 10 ms a sweep; 30 ms if no ground is found.
    """
    tilts: list[np.ndarray] = []
    for points in sweeps:
        positions = _sampled(points)
        tilt = _tilt_of(positions) if len(positions) >= _FEWEST else None
        if not tilts and (tilt is None or np.hypot(*tilt) < _LEAST_TILT):
            return ""
        tilts.append(np.full(2, np.nan) if tilt is None else tilt)
    if not tilts:
        return ""
    about_x, about_y = usual = np.nanmedian(tilts, axis=0)
    size = float(np.hypot(*usual))
    are_near = np.linalg.norm(tilts - usual, axis=1) <= _TILT_APART * size
    if size < _LEAST_TILT or are_near.mean() < _AGREEING:
        return ""
    turns = [f"{angle:+.0f} about {name}" for angle, name in ((about_y, "y"), (about_x, "x")) if 3 * abs(angle) > size]
    level = f"turn it by {' and '.join(turns)}"
    return f"the sensor seems to be tilted by about {size:.0f} degrees ({level}): {_UP} (data.ego_T_lidar)"


def _sampled(points: Array) -> np.ndarray:
    """Return up to 20,000 finite positions of a sweep, (N, 3) float64."""
    step = max(1, -(-len(points) // _MOST_POINTS))
    positions = as_numpy(points[::step])[:, :3].astype(np.float64)
    return positions[np.isfinite(positions).all(axis=1)]  # type: ignore[no-any-return]


def _heights_if(positions: np.ndarray, unit: str, other: str) -> str:
    """Return how high the sensor is above the ground in two units if only the other one is usual; "" = else."""
    ground = _near_ground(UNITS.get(unit, 1.0) * positions)
    height = -float(np.median(ground[:, 2])) if len(ground) else 0.0
    changed = UNITS[other] / UNITS.get(unit, 1.0) * height
    is_usual = _LOWEST_SENSOR < height < _HIGHEST_SENSOR or not _LOWEST_SENSOR < changed < _HIGHEST_ON_CAR
    return "" if is_usual else f"the sensor is {height:.1f} m above the ground in {unit}, {changed:.1f} m in {other}"


def _near_ground(positions: np.ndarray) -> np.ndarray:
    return positions[find_ground(positions, "grid") & (np.hypot(*positions[:, :2].T) < _NEAR)]  # type: ignore[no-any-return]


def _is_spherical(positions: np.ndarray) -> bool:
    """Test whether columns are a range, an azimuth of a whole turn, and an elevation."""
    low, high = np.quantile(positions, (0.001, 0.999), axis=0)
    for turn in (2 * np.pi, 360.0):
        is_turn = _FULL * turn <= high[1] - low[1] <= 1.001 * turn and max(-low[1], high[1]) <= 1.001 * turn
        if is_turn and low[0] >= 0 and max(-low[2], high[2]) <= turn / 4:
            return _has_ground_as("points_spherical", positions)
    return False


def _has_ground_as(reading: str, positions: np.ndarray) -> bool:
    convert = READINGS[reading].of_points
    return convert is not None and ground_side(convert(positions)) > 0


def _tilt_of(positions: np.ndarray) -> np.ndarray | None:
    """Return the degrees about x and y that level the ground near the sensor, (2,) float64; None = there is none.

    If there is no ground, we turn the points until they have some.
    """
    for axis, turn in ((0, 0), *((axis, sign * turn) for axis in (1, 0) for sign in (1, -1) for turn in _TILTS)):
        turned = positions @ rotations_about(axis, np.radians(turn)).T
        if turn and not has_ground(turned):
            continue
        ground = _near_ground(turned)
        if len(ground) < _FEWEST:
            continue
        plane, *_ = np.linalg.lstsq(np.column_stack([ground[:, :2], np.ones(len(ground))]), ground[:, 2], rcond=None)
        along_x, along_y = np.degrees(np.arctan(plane[:2]))
        return np.array(((axis == 0) * turn - along_y, (axis == 1) * turn + along_x))
    return None


_UP = "give points with z up"
