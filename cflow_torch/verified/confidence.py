"""The margin of motions, and the confidence of the flow of each point (docs/verified.md).

The margin of a motion measures how much worse displaced copies of it explain the sweeps. An object with a low margin
is usually static, for example a wall that seems to slide or a trunk of few points.

A table gives each point a probability from counts that need no ground truth. For a moving object, the probability
depends on its margin. For a static point, it depends on the share of its neighbourhood that t+1 matches. A static point
next to a moving object has a lower probability, because the object may be larger than it seems. For a point in a
component without pixels at t+1, the probability falls with the number of occupied height slices around it.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor

from cflow_torch.ops.indices import constant, flat_nonzero, floor_divide, lookup, scatter_count, take_columns
from cflow_torch.verified.aperture import principal_axes
from cflow_torch.verified.component_tree import Objects
from cflow_torch.verified.height_slices import NUM_SLICES, HeightSlicedSweeps, Pixels, count_slices
from cflow_torch.verified.paired_test import count_wins
from cflow_torch.verified.rigid_motion import RigidMotion

# Bounds of the bins and the probabilities, written by scripts/ablation/calibrate_confidence.py. The order of the bins:
# left out; without correspondence at t+1, by `crowd`; static, by `share`; static next to a moving object; moving, by
# `margin`, for near and far points of pairs, then for near and far points of windows with history.
TABLE = json.loads(Path(__file__).with_name("confidence.json").read_text(encoding="utf-8"))
_BLOCK = 1.6  # metres, side of a neighbourhood
_DISPLACEMENT = 0.4  # metres per interval, along x and along y
_Z = 1.0  # standard deviations of noise by which a motion must exceed its displaced copies


class MotionMargin(NamedTuple):
    """The margins of G objects."""

    # (G,) float64. The motion matches this many more slices than its best displaced copy, in standard deviations of
    # noise. 0 = the motion is not better, or the object is static.
    z: Tensor
    # (G,) bool. True if z is at least 1, or if all of this holds: the object is not a line; slices won exceed slices
    # lost plus slices found in place; the motion is better than its displaced copies, or at least twice as long as the
    # displacement. Copies of so long a motion are far from static, too. A line needs z >= 1, because beams hit a rail
    # at positions that move with the vehicle.
    is_dynamic: Tensor


def motion_margin(sweeps: HeightSlicedSweeps, objects: Objects, rigid: RigidMotion) -> MotionMargin:
    """Return the margin of each object's motion.

    Cost: five lookups for each pixel of the moving objects and each sweep.
    """
    size, device = sweeps.grid.pixel_size, rigid.flow.device
    off = _DISPLACEMENT / size
    displaced = constant(((0, 0), (off, 0), (-off, 0), (0, off), (0, -off)), torch.float64, device)
    pixel = flat_nonzero(lookup(rigid.flow.any(1), objects.of_pixel))
    members, which = sweeps.pixels.take(pixel), objects.of_pixel.index_select(0, pixel)
    group, motion = _groups_of_one_motion(sweeps, members, which, rigid)
    wins = count_wins(sweeps, members, group, motion[:, None] + displaced)
    counts = torch.cat((wins.won[0] - wins.lost[0], wins.in_place[:, None]), 1)
    object_of_group = group.new_zeros(len(counts)).scatter_(0, group, which)
    counts = counts.new_zeros(objects.count, 6).index_add_(0, object_of_group, counts)
    surplus, in_place = counts[:, :5], counts[:, 5]
    gain, matched = (surplus[:, 0] - surplus[:, 1:].amax(1)).clamp(min=0), surplus[:, 0] + in_place
    z = gain / matched.clamp(min=1).double().sqrt()
    newest = flat_nonzero(members.step == 0)
    row_col = take_columns(members.row_col, newest)
    is_line, *_ = principal_axes(which.index_select(0, newest), row_col, objects.count, size)
    is_fast = rigid.flow.square().sum(1) >= (2 * _DISPLACEMENT) ** 2
    return MotionMargin(z, (z >= _Z) | ((gain > 0) | is_fast) & (surplus[:, 0] > in_place) & ~is_line)


def _groups_of_one_motion(
    sweeps: HeightSlicedSweeps, pixels: Pixels, which: Tensor, rigid: RigidMotion
) -> tuple[Tensor, Tensor]:
    """Group pixels by motion. Return the group of each pixel, (K,) int64, and the motion of each group.

    The pixels of an object are a group, except those that its rotation displaces by a pixel or more. Each of these is a
    group of its own, after the G objects. `which` is the object of each pixel, (K,) int64. The motion is
    (number of groups, 2) float64, (y, x), pixels per interval.
    """
    size, motion = sweeps.grid.pixel_size, rigid.pixels_per_interval(sweeps.grid.pixel_size)
    elapsed = sweeps.elapsed.index_select(0, pixels.window)
    since_t = elapsed[:, 1] - elapsed.gather(1, pixels.step[:, None])[:, 0]
    at_t = sweeps.grid.centre(pixels.row_col).flip(0) - rigid.flow.index_select(0, which).t() * since_t
    flow = rigid.flow_at(which, at_t).flip(1) / size
    rotates = flat_nonzero(((flow - motion.index_select(0, which)).abs() >= 1).any(1))
    group = which.index_copy(0, rotates, torch.arange(len(rotates), device=which.device) + len(motion))
    return group, torch.cat((motion, flow.index_select(0, rotates)))


def confidence_of(sweeps: HeightSlicedSweeps, objects: Objects, rigid: RigidMotion, margin: Tensor) -> Tensor:
    """Return the probability that the motion of a pixel of t is right to 0.1 m per sweep interval.

    `margin`, (G,) float64, is `MotionMargin.z`. Rotations are ignored: all pixels of an object move as its centre does.

    Returns:
        (P + 1,) float32; entry P is for points with no pixel in `sweeps`. Undefined for pixels of sweeps other than t.

    Cost: one lookup for each pixel of t, and nine for those that move.
    """
    device, of_t = margin.device, flat_nonzero(sweeps.pixels.step == 1)
    pixels, of_pixel = sweeps.pixels.take(of_t), objects.of_pixel.index_select(0, of_t)
    motion = lookup(rigid.pixels_per_interval(sweeps.grid.pixel_size), of_pixel)
    number, matched = _neighbourhood(sweeps, pixels, motion)
    crowd, share, bounds = (TABLE[name] for name in ("crowd", "share", "margin"))
    unlinked = 1 + _bin(number, crowd)
    moves = motion.any(1)
    tenths = constant(tuple(share), number.dtype, device)[:, None]
    static = 2 + len(crowd) + (10 * matched >= tenths * number).sum(0)
    around = sweeps.around(of_t.index_select(0, flat_nonzero(moves)), 1).view(-1)
    is_beside = torch.zeros(sweeps.num_pixels + 1, dtype=torch.bool, device=device).index_fill_(0, around, True)
    static.masked_fill_(is_beside.index_select(0, of_t), 3 + len(crowd) + len(share))

    y, x = sweeps.grid.centre(pixels.row_col)
    is_far = x * x + y * y >= float(TABLE["far"]) ** 2
    kind = 2 * sweeps.has_history.index_select(0, pixels.window) + is_far.long()
    first = 4 + len(crowd) + len(share)
    moving = first + kind * (1 + len(bounds)) + lookup(_bin(margin, bounds), of_pixel)

    static = torch.where(of_pixel == objects.count, unlinked, static)
    index = torch.where(moves, moving, static)
    probabilities = constant(tuple(TABLE["probabilities"]), torch.float32, device)
    left_out = probabilities[:1].repeat(sweeps.num_pixels + 1)
    return left_out.index_copy_(0, of_t, probabilities.index_select(0, index))


def _bin(values: Tensor, bounds: list[float]) -> Tensor:
    """Return how many of the ascending bounds each value reaches, (K,) int64."""
    return torch.bucketize(values, constant(tuple(bounds), values.dtype, values.device), right=True)


def _neighbourhood(sweeps: HeightSlicedSweeps, pixels: Pixels, motion: Tensor) -> tuple[Tensor, Tensor]:
    """Count the slices of t in the block of each of K pixels, and those that t+1 has at their target, (K,) int64 each.

    `motion`, (K, 2) float64, (y, x), finest pixels per interval, is the motion of each pixel.
    """
    side = max(1, round(_BLOCK / sweeps.grid.pixel_size))
    height, width = -(-sweeps.grid.height // side), -(-sweeps.grid.width // side)
    row, col = floor_divide(pixels.row_col, side)
    block = (pixels.window * height + row) * width + col
    elapsed = sweeps.elapsed[:, 1].index_select(0, pixels.window)
    shift = (motion.t() * elapsed + 0.5).floor_().long()
    offset = torch.add(shift[1], shift[0], alpha=sweeps.grid.width) - sweeps.grid.height * sweeps.grid.width  # t+1
    index = sweeps.or_outside(pixels.index + offset, pixels.row_col + shift)
    matched = pixels.slices & sweeps.image.index_select(0, index)
    both = count_slices(pixels.slices | matched << NUM_SLICES)
    sums = scatter_count(block, sweeps.batch.num_windows * height * width, both).index_select(0, block)
    return sums & 0xFFFFFFFF, sums >> 32
