"""De-skewing: points of objects that move go to the instant of their sweep, by the motion of their object.

A part that is measured a intervals after the instant of one sweep and b after that of a sweep k intervals later has
moved for k + b - a intervals. Motion that is seen is divided by the mean of that over k.
"""

from __future__ import annotations

from typing import List, Sequence

from cflow_torch.config import VerifiedConfig
from oracle.height_slices import SlicedSweeps, Vector
from oracle.rigid_registration import RigidMotion, find_pairs, register, rotate
from oracle.voxel_centroids import UNITS, Point, centroids, whole

LEAST_STRETCH = 0.75  # where the time between points is a smaller share of that between sweeps, it is not believed


def register_deskewed(
    points: Sequence[Point],
    start: Sequence[Vector],
    seen: Sequence[RigidMotion],
    sweeps: SlicedSweeps,
    config: VerifiedConfig,
) -> List[RigidMotion]:
    """The motion of every object per sweep interval; with more than two sweeps it is registered once more.

    Args:
        points: of the objects that move, of all sweeps, with times.
        start: of each object, (x, y) metres per interval, what the registration started from.
        seen: what it found.
        sweeps: the window.
        config: region and finest pixels.
    """
    stretch = stretch_of(points, seen, sweeps)
    divided = [motion._replace(flow=_divide(motion.flow, s)) for motion, s in zip(seen, stretch)]
    if len(sweeps.images) == 2:
        return divided
    sharp = deskew(points, divided, sweeps, config)
    again = register(sharp, [_divide(flow, s) for flow, s in zip(start, stretch)], sweeps)
    present = {point.owner for point in points}
    return [again[owner] if owner in present else motion for owner, motion in enumerate(divided)]


def stretch_of(points: Sequence[Point], seen: Sequence[RigidMotion], sweeps: SlicedSweeps) -> List[float]:
    """Of each object: sum of w k (k + late) over the sum of w k^2, over its pairs of voxels."""
    voxels, (x0, y0) = centroids(points, sweeps), sweeps.lower
    result = []
    for owner, motion in enumerate(seen):
        members = [voxel for voxel in voxels.values() if voxel.owner == owner]
        if not any(voxel.step == 1 for voxel in members):
            result.append(1.0)
            continue
        centre = (round((motion.centre[0] - x0) * UNITS), round((motion.centre[1] - y0) * UNITS))
        way = (motion.flow[0] * UNITS, motion.flow[1] * UNITS)
        pairs = find_pairs(members, voxels, sweeps, centre, way, motion.turn)
        times = [whole(pair.time * 16) / 16 for pair in pairs]
        total = sum(pair.weight * k * k for pair, k in zip(pairs, times))
        late = sum(pair.weight * k * pair.late for pair, k in zip(pairs, times))
        stretch = 1 + late / total if total > 0 else 1.0
        result.append(stretch if stretch >= LEAST_STRETCH else 1.0)
    return result


def deskew(
    points: Sequence[Point], motions: Sequence[RigidMotion], sweeps: SlicedSweeps, config: VerifiedConfig
) -> List[Point]:
    """Points where they were at the instant of their sweep; of those in one pixel, those of the first object."""
    x0, y0, _, x1, y1, _ = config.point_cloud_range
    moved, owner_of = [], {}  # type: List[Tuple[Tuple[int, int, int], Point]], Dict[Tuple[int, int, int], int]
    for point in points:
        motion, time = motions[point.owner], point.time
        since_t = sweeps.elapsed[1] - sweeps.elapsed[point.step]
        x, y = point.x - motion.flow[0] * time, point.y - motion.flow[1] * time
        arm_x = x - motion.centre[0] - motion.flow[0] * since_t
        arm_y = y - motion.centre[1] - motion.flow[1] * since_t
        turned_x, turned_y = rotate(-time * motion.turn, arm_x, arm_y)
        x, y = x + (turned_x - arm_x), y + (turned_y - arm_y)
        if x0 <= x <= x1 and y0 <= y <= y1:
            pixel = (point.step, int((y - y0) / sweeps.pixel_size), int((x - x0) / sweeps.pixel_size))
            owner_of[pixel] = min(owner_of.get(pixel, point.owner), point.owner)
            moved.append((pixel, point._replace(x=x, y=y)))
    return [point for pixel, point in moved if owner_of[pixel] == point.owner]


def _divide(flow: Vector, by: float) -> Vector:
    return flow[0] / by, flow[1] / by
