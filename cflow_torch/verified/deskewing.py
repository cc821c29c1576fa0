"""De-skewing of objects that move: their points are moved to the instant of their sweep, by their own motion.

A LiDAR that turns meets an object not once per sweep interval but when it comes round to it. Of two instants one
interval apart the object is seen at 0 + a and at 1 + b: it has moved for 1 + b - a intervals, and so each of its parts.
What was estimated from the places where it was seen is too long by that factor. Divided by it, the motion takes every
point back to the instant of its sweep; there the object is sharp, also where two LiDARs met it at different times, and
is registered.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Tuple

import torch
from torch import Tensor

from cflow_torch.ops.indices import flat_nonzero, split_index
from cflow_torch.ops.segments import segment_amin
from cflow_torch.verified.height_slices import HeightSlicedSweeps
from cflow_torch.verified.rigid_motion import RigidMotion, rotate
from cflow_torch.verified.voxel_centroids import ObjectPoints

_LEAST_STRETCH = 0.5  # below it, an object was met again so soon that its motion is hardly seen


def stretch_of(points: ObjectPoints, sweeps: HeightSlicedSweeps, num_objects: int) -> Tensor:
    """By what factor the time between the sightings of each object is longer than that between the sweeps.

    Args:
        points: of objects, with times.
        sweeps: finest images.
        num_objects: G.

    Returns:
        (G,) float64: sum of (k + b - a_k) over the earlier sweeps that see the object, over the sum of k; k intervals
        lie between the sweeps, a_k and b are the mean times of the object's points in the earlier sweep and in t+1. At
        least 0.5; 1 for an object that t+1 or all the others do not see.
    """
    if points.time is None:
        return torch.ones(num_objects, dtype=torch.float64, device=points.owner.device)
    num_steps = sweeps.num_steps
    at = points.owner * num_steps + points.step
    sums = torch.zeros(num_objects * num_steps, dtype=torch.float64, device=at.device)
    sums.index_add_(0, at, points.time.double())
    count = torch.bincount(at, minlength=num_objects * num_steps).view(num_objects, num_steps)
    mean = sums.view(num_objects, num_steps) / count.clamp(min=1)
    window = torch.zeros(num_objects, dtype=torch.int64, device=at.device).scatter_(0, points.owner, points.window)
    elapsed = sweeps.elapsed.index_select(0, window)
    is_seen = ((count > 0) & (count[:, :1] > 0)).double()
    between = elapsed * is_seen
    late = ((mean[:, :1] - mean) * is_seen).sum(1)
    total = between.sum(1)
    return torch.where(total > 0, ((total + late) / total).clamp(min=_LEAST_STRETCH), torch.ones_like(total))


def deskew(
    points: ObjectPoints, sweeps: HeightSlicedSweeps, rigid: RigidMotion
) -> Tuple[ObjectPoints, HeightSlicedSweeps]:
    """Points of objects where they were at the instant of their sweep.

    Args:
        points: of G objects, with times.
        sweeps: finest images.
        rigid: motion of the objects, which passes and turns in proportion to time.

    Returns:
        The points, and sweeps in whose pixels they lie now. Points that leave the region are left out.

    Convention: where objects meet in a pixel, the points of the first of them stay. Points whose time is 0 stay exactly
        where they are.

    Cost: a sort of the points.
    """
    if points.time is None:
        return points, sweeps
    grid, num_steps, owner = sweeps.grid, sweeps.num_steps, points.owner
    time = points.time.double()
    # The centre is that of t: at the instant of the sweep it has moved on by what lies between.
    since_t = (sweeps.elapsed[:, 1:2] - sweeps.elapsed).flatten().index_select(0, points.window * num_steps + points.step)
    flow, centre = rigid.flow.index_select(0, owner).t(), rigid.centre.index_select(0, owner).t()
    position = points.position - flow * time
    arm_x, arm_y = (position - centre - flow * since_t).unbind(0)
    x, y = rotate(-time * rigid.turn.index_select(0, owner), arm_x, arm_y)
    position = position + torch.stack((x - arm_x, y - arm_y))

    inside = flat_nonzero(grid.contains(position))
    points, position = points.at(inside), position.index_select(1, inside)
    image = points.window * num_steps + points.step
    place = grid.pixel_of_image(position, image, sweeps.num_windows * num_steps).long()
    pixel, number = torch.unique(place, return_inverse=True)
    first = segment_amin(points.owner, number, pixel.numel(), rigid.turn.numel())
    kept = flat_nonzero(first.index_select(0, number) == points.owner)
    moved = replace(points, position=position, pixel=number).at(kept)
    of_image, within = split_index(pixel, grid.height * grid.width)
    window, step = split_index(of_image, num_steps)
    row, col = split_index(within, grid.width)
    slices = torch.zeros_like(pixel, dtype=torch.uint8)
    return moved, replace(sweeps, pixel=pixel, window=window, step=step, row=row, col=col, slices=slices)
