"""Refinement: from motions in pixels to rigid motions in centimetres, with rotation and times of points."""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from torch import Tensor

from cflow_torch.ops.indices import flat_nonzero, lazy_zeros, lookup, take_columns
from cflow_torch.ops.segments import segment_amin
from cflow_torch.verified.component_tree import Components, Objects
from cflow_torch.verified.height_slices import HeightSlicedSweeps, Pixels
from cflow_torch.verified.rigid_motion import RigidMotion, rotate
from cflow_torch.verified.rigid_registration import LAYER_HEIGHT, MOST_TIME, NUM_LAYERS, VoxelPairs
from cflow_torch.verified.subpixel_motion import subpixel_motion
from cflow_torch.verified.voxel_centroids import ObjectPoints, points_of_objects


def refine(
    sweeps: HeightSlicedSweeps, components: Components, objects: Objects, motion: Tensor, longest: float | None
) -> tuple[RigidMotion, RigidMotion]:
    """Return the final motion of objects.

    Args:
        sweeps: finest images.
        components: among them those of the objects.
        objects: G of them.
        motion: (G, 2) float64, (y, x), finest pixels per sweep interval.
        longest: metres; static objects longer than this at t+1 stay static. None = no bound.

    Returns:
        The motion in metres, and the apparent motion between the images, which differs if points have times.
    """
    # A static object of a pair is a whole component; copies of points are objects only if they move.
    length = lookup(components.length, objects.component.clamp(max=components.count))
    start = subpixel_motion(sweeps, objects, motion, length <= (math.inf if longest is None else longest))
    points = points_of_objects(sweeps, objects, start.any(1), LAYER_HEIGHT, NUM_LAYERS, MOST_TIME)
    return register_deskewed(points, sweeps, start)


def register_deskewed(
    points: ObjectPoints, sweeps: HeightSlicedSweeps, start: Tensor
) -> tuple[RigidMotion, RigidMotion]:
    """Return the motion of objects per sweep interval, by registration and the times of points.

    Args:
        points: points of the objects that move, as `VoxelPairs` takes them.
        sweeps: finest images.
        start: (G, 2) float64, x and y, metres per sweep interval, from which registration starts.

    Returns:
        The motion, and the apparent motion, which registration finds. Without times, both are equal. With times, the
        motion is the apparent motion divided by `VoxelPairs.stretch`. In windows with history, we then de-skew the
        points and register them again, from the start divided by the same factor. In pairs we do not, because de-skewed
        smooth surfaces would slide along the pattern of the beams, and only a third sweep can prevent that.

    Convention: times of 0 give the same bits as no times.

    Cost: that of two registrations, and a sort of the points.
    """
    pairs = VoxelPairs(points, sweeps, len(start))
    apparent = pairs.register(start)
    if points.time is None:
        return apparent, apparent
    stretch = pairs.stretch(apparent)[:, None]
    divided = RigidMotion(apparent.flow / stretch, apparent.rotation, apparent.centre)
    is_pair = ~sweeps.has_history
    points = points.take(~is_pair.index_select(0, sweeps.pixels.window.index_select(0, points.pixel)))
    again = VoxelPairs(*deskew(points, sweeps, divided), len(start)).register(start / stretch)
    is_again = torch.bincount(points.object_id, minlength=len(start)) > 0
    deskewed = RigidMotion(
        torch.where(is_again[:, None], again.flow, divided.flow),
        torch.where(is_again, again.rotation, divided.rotation),
        torch.where(is_again[:, None], again.centre, divided.centre),
    )
    return deskewed, apparent


def deskew(
    points: ObjectPoints, sweeps: HeightSlicedSweeps, rigid: RigidMotion
) -> tuple[ObjectPoints, HeightSlicedSweeps]:
    """Move the points of objects to their positions at the instant of their sweep.

    Args:
        points: of G objects, with times.
        sweeps: finest images.
        rigid: motion of the objects, whose translation and rotation are proportional to time.

    Returns:
        The points, and sweeps whose occupied pixels are those of the moved points; the images are unchanged.

    Convention: points that leave the region are dropped. If several objects share a pixel, only the points of the first
    one are kept. Points whose time is 0 do not move.

    Cost: a sort of the points.
    """
    assert points.time is not None
    grid, num_steps, object_id = sweeps.grid, sweeps.num_steps, points.object_id
    time, (window, step) = points.time.double(), take_columns(sweeps.pixels.table[1:3], points.pixel)
    flow, centre = (torch.view_as_complex(values.index_select(0, object_id)) for values in (rigid.flow, rigid.centre))
    # The centre is that at t; at the instant of another sweep, it has moved.
    image = torch.add(step, window, alpha=num_steps)
    since_t = (sweeps.elapsed[:, 1:2] - sweeps.elapsed).flatten().index_select(0, image)
    at_instant = torch.complex(*points.position[:2]) - flow * time
    arm = at_instant - centre - flow * since_t
    at_instant = at_instant + (rotate(-time * rigid.rotation.index_select(0, object_id), arm) - arm)
    position = torch.cat((torch.view_as_real(at_instant).t(), points.position[2:]))

    inside = flat_nonzero(grid.contains(position[:2]))
    position, image = take_columns(position, inside), image.index_select(0, inside)
    index = grid.pixel_of_image(position, image, sweeps.batch.num_windows * num_steps).long()
    pixel, number = torch.unique(index, return_inverse=True)
    moved = replace(points.at(inside), position=position, pixel=number)
    first = segment_amin(moved.object_id, number, pixel.numel(), len(rigid.rotation)).index_select(0, number)
    slices = torch.zeros_like(pixel, dtype=torch.uint8)  # unused by registration
    pixels = Pixels.of(pixel, slices, grid, num_steps)
    rank = lazy_zeros(len(sweeps.rank), torch.int32, pixel.device)
    rank.scatter_(0, pixel, torch.arange(1, len(pixel) + 1, dtype=torch.int32, device=pixel.device))
    drawn = replace(sweeps, pixels=pixels, rank=rank)
    return moved.take(moved.object_id == first), drawn
