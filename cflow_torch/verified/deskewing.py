"""De-skewing of objects that move: their points go to the instant of their sweep, by their own motion.

A LiDAR that turns meets an object not once per sweep interval but when it comes round to it. A part that is measured
a intervals after the instant of one sweep and b after that of a sweep k intervals later has moved for k + b - a
intervals between the two; the same holds for a sweep after t+1, whose k is negative. So the motion that is seen is too
long, by the same factor for all that lies in one direction. Divided by it, it takes every point to the instant of its
sweep. There an object is sharp, also where two LiDARs met it at different times, and two objects that were stretched
differently agree.
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
from cflow_torch.verified.rigid_registration import register, stretch_of
from cflow_torch.verified.voxel_centroids import ObjectPoints


def register_deskewed(
    points: ObjectPoints, sweeps: HeightSlicedSweeps, start: Tensor, seen: RigidMotion
) -> RigidMotion:
    """The motion of objects per sweep interval, from the motion that is seen and the times of points.

    Args:
        points: of the objects that move, of all sweeps. Without times all is as it is seen.
        sweeps: finest images.
        start: (G, 2) float64, x and y, metres per sweep interval, what the registration started from.
        seen: what it found.

    Returns:
        The motion. Of more than two sweeps the points are de-skewed and registered once more, from the start divided by
        the same factor. Of pairs the motion is divided only: smooth sides, once they are sharp, slide towards the
        pattern of the beams, which goes with the vehicle, and no third sweep holds them.

    Convention: times of 0 change nothing, to the last bit.

    Cost: twice that of `register`, and a sort of the points.
    """
    if points.time is None:
        return seen
    stretch = stretch_of(points, sweeps, seen)[:, None]
    divided = RigidMotion(seen.flow / stretch, seen.turn, seen.centre)
    is_pair = (sweeps.elapsed != 0).sum(1) == 1
    points = points.take(~is_pair.index_select(0, points.window))
    again = register(*deskew(points, sweeps, divided), start / stretch)
    is_again = torch.bincount(points.owner, minlength=len(start)) > 0
    return RigidMotion(
        torch.where(is_again[:, None], again.flow, divided.flow),
        torch.where(is_again, again.turn, divided.turn),
        torch.where(is_again[:, None], again.centre, divided.centre),
    )


def deskew(
    points: ObjectPoints, sweeps: HeightSlicedSweeps, rigid: RigidMotion
) -> Tuple[ObjectPoints, HeightSlicedSweeps]:
    """Points of objects where they were at the instant of their sweep.

    Args:
        points: of G objects, with times.
        sweeps: finest images.
        rigid: motion of the objects, which pass and turn in proportion to time.

    Returns:
        The points, and sweeps whose occupied pixels are those where the points lie now; their images stay as they were.

    Convention: points that leave the region are left out. Where objects meet in a pixel, the points of the first of
    them stay. Points whose time is 0 stay exactly where they are.

    Cost: a sort of the points.
    """
    assert points.time is not None
    grid, num_steps, owner = sweeps.grid, sweeps.num_steps, points.owner
    time, image = points.time.double(), points.window * num_steps + points.step
    flow, centre = rigid.flow.index_select(0, owner).t(), rigid.centre.index_select(0, owner).t()
    # The centre is that of t; at the instant of another sweep it has moved on.
    since_t = (sweeps.elapsed[:, 1:2] - sweeps.elapsed).flatten().index_select(0, image)
    position = points.position - flow * time
    arm_x, arm_y = (position - centre - flow * since_t).unbind(0)
    x, y = rotate(-time * rigid.turn.index_select(0, owner), arm_x, arm_y)
    position = position + torch.stack((x - arm_x, y - arm_y))

    inside = flat_nonzero(grid.contains(position))
    position, image = position.index_select(1, inside), image.index_select(0, inside)
    place = grid.pixel_of_image(position, image, sweeps.num_windows * num_steps).long()
    pixel, number = torch.unique(place, return_inverse=True)
    moved = replace(points.at(inside), position=position, pixel=number)
    first = segment_amin(moved.owner, number, pixel.numel(), len(rigid.turn)).index_select(0, number)
    of_image, within = split_index(pixel, grid.height * grid.width)
    window, step = split_index(of_image, num_steps)
    row, col = split_index(within, grid.width)
    slices = torch.zeros_like(pixel, dtype=torch.uint8)  # nobody asks
    drawn = replace(sweeps, pixel=pixel, window=window, step=step, row=row, col=col, slices=slices)
    return moved.take(moved.owner == first), drawn
