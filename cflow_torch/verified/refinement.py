"""Refinement: the motion of objects from whole pixels to centimetres, with turns and slow motion."""

from __future__ import annotations

from typing import List, Tuple

import torch
import torch.nn.functional as F
from torch import Tensor

from cflow_torch.verified.component_tree import Objects
from cflow_torch.verified.deskewing import register_deskewed
from cflow_torch.verified.height_slices import HeightSlicedSweeps
from cflow_torch.verified.paired_test import VerifiedLevel
from cflow_torch.verified.rigid_motion import RigidMotion
from cflow_torch.verified.rigid_registration import register
from cflow_torch.verified.slow_motion import slow_motion
from cflow_torch.verified.subpixel_shift import shift_between_pixels
from cflow_torch.verified.voxel_centroids import points_of_objects


def refine(
    objects: Objects, motion: Tensor, levels: List[VerifiedLevel], sweeps: HeightSlicedSweeps
) -> Tuple[RigidMotion, RigidMotion]:
    """The final motion of objects.

    Args:
        objects: G of them.
        motion: (G, 2) float64, (y, x), finest pixels per sweep interval.
        levels: that the objects were chosen from: what is too long does not creep.
        sweeps: finest images.

    Returns:
        The motion in metres; and the motion that the images show, which differs where points have times of their own.
    """
    moves = motion.any(1)
    too_long = F.pad(torch.cat([level.level.too_long for level in levels]), (0, 1))
    too_long = too_long.index_select(0, objects.component.clamp(max=too_long.numel() - 1))  # parts of them are not
    points, slow = points_of_objects(sweeps, objects, moves), torch.zeros_like(motion)
    is_pair = (sweeps.elapsed != 0).sum(1) == 1
    if bool(is_pair.any()):  # with history slow objects leave their pixels, and one of many sweeps would decide
        slow = slow_motion(sweeps, objects, ~moves & ~too_long)
        motion = shift_between_pixels(points.take(is_pair.index_select(0, points.window)), sweeps, motion)
    points = points.take(motion.any(1).index_select(0, points.owner))
    start = motion.flip(1) * sweeps.grid.pixel_size
    seen = register(points, sweeps, start)
    seen = RigidMotion(torch.where(slow.any(1, keepdim=True), slow, seen.flow), seen.turn, seen.centre)
    return register_deskewed(points, sweeps, start, seen), seen


def as_found(motion: Tensor, sweeps: HeightSlicedSweeps) -> Tuple[RigidMotion, RigidMotion]:
    """The same without refinement."""
    rigid = RigidMotion.translation(motion.flip(1) * sweeps.grid.pixel_size)
    return rigid, rigid
