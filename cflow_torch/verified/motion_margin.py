"""The margin of motions: does an object move, or does it only seem to?

The margin is the result of the paired test for the whole node of an object: how much better the motion explains the
sweeps than "static", in standard deviations of noise. An object may be a remnant of its node, whose other pixels follow
another motion. A remnant often has pixels in a few sweeps only, so it would have no margin of its own.

In a pair, a slow object still covers most of its position, and a sparse surface is hit at other positions in every
sweep. There, we compare the motion with copies of it, displaced by 0.4 m.

If the copies explain the sweeps as well, two kinds of objects have no margin: a line may be a rail, which beams hit at
positions that move with the vehicle; and with history, a large surface that loses a few slices stays where it is.

A table tells how often objects of a margin, a speed and a distance move (docs/verified.md). If they hardly ever do, the
object is static.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from cflow_torch.ops.groups import Groups
from cflow_torch.ops.indices import constant, flat_nonzero
from cflow_torch.verified.aperture import principal_axes
from cflow_torch.verified.columns import Pixels
from cflow_torch.verified.comparisons import count_in_place
from cflow_torch.verified.component_tree import Tree
from cflow_torch.verified.confidence import TABLE, Bins, bin_of
from cflow_torch.verified.height_slices import HeightSlicedSweeps
from cflow_torch.verified.paired_test import Counts, count_wins
from cflow_torch.verified.rigid_motion import RigidMotion
from cflow_torch.verified.selection import Objects

_DISPLACEMENT = 0.4  # metres per interval, along x and along y
_COPIES_Z = 1.0  # standard deviations of noise by which a motion must exceed its displaced copies
# P(moving) of slow and fast objects, in pairs, then with history; an object that is less likely to move is static. A
# wrong motion of a fast object is a large error.
_LEAST_LIKELY = (0.05, 0.15, 0.02, 0.04)


class MotionMargin(NamedTuple):
    """What the margins of G objects tell."""

    bin: Tensor  # (G,) int64, bin of the tables (`Bins`)
    is_dynamic: Tensor  # (G,) bool, the object moves


def motion_margin(sweeps: HeightSlicedSweeps, tree: Tree, objects: Objects, rigid: RigidMotion) -> MotionMargin:
    """Find which objects move, by the margins of their motions.

    Convention: an object moves if P(moving) of its bin is at least `_LEAST_LIKELY`.

    Cost: seven lookups for each pixel of the nodes with a motion and each sweep.
    """
    speed = torch.linalg.vector_norm(rigid.flow, dim=1)  # [G], metres per sweep interval
    is_fast = speed >= float(TABLE["fast"])
    is_far = rigid.centre.square().sum(1) >= float(TABLE["far"]) ** 2
    has_history = sweeps.has_history.index_select(0, objects.window)
    margin = _margins(sweeps, tree, objects, rigid, is_fast)
    row = 4 * has_history + 2 * is_far + is_fast
    bins = Bins.moving + row * Bins.num_margins + bin_of(margin, TABLE["margin"])

    moving = constant(tuple(TABLE["moving"]), torch.float32, bins.device).index_select(0, bins)
    least = constant(_LEAST_LIKELY, torch.float32, bins.device).index_select(0, 2 * has_history + is_fast)
    return MotionMargin(bins, moving >= least)


def _margins(sweeps: HeightSlicedSweeps, tree: Tree, objects: Objects, rigid: RigidMotion, is_fast: Tensor) -> Tensor:
    """Return the margin of each motion, (G,) float64; `is_fast` is (G,) bool.

    Convention: the surplus of a motion is the slices that it wins minus those that it loses, near counts. The margin is
        the surplus, in a pair and for a slow object minus that of the best displaced copy. Its unit is the root of the
        slices won plus those lost, times the root of the number of other sweeps: what seems to move by mistake does so
        in all of them. If the surplus exceeds that of the best copy by less than `_COPIES_Z` standard deviations, the
        margin is 0 for lines, and with history for objects of which other sweeps have as many slices in place.
    """
    pixel, of_object = _list_pixels(tree, objects, rigid.flow.any(1))
    pixels = sweeps.pixels[pixel]  # [K]
    num_others = 1 + sweeps.num_more.index_select(0, objects.window)  # [G], sweeps
    has_history = num_others > 1
    near = _test_with_copies(sweeps, pixels, of_object, rigid)
    surplus = near.surplus()  # [G, 5]
    noise = (near.won + near.lost)[:, 0].clamp(min=1).double().sqrt()
    over_static = surplus[:, 0] / noise
    over_copies = (surplus[:, 0] - surplus[:, 1:].amax(1)) / noise
    stays = has_history & (surplus[:, 0] <= count_in_place(sweeps, pixels, of_object).found)
    has_no_margin = (over_copies < _COPIES_Z) & (stays | _are_lines(sweeps, pixels, of_object))
    margin = torch.where(is_fast | has_history, over_static, over_copies)
    return margin.masked_fill(has_no_margin, 0.0) / num_others.double().sqrt()


def _list_pixels(tree: Tree, objects: Objects, is_listed: Tensor) -> tuple[Tensor, Groups]:
    """List the pixels of the nodes of some objects, (G,) bool; of an object that is not a node, its own pixels.

    A is the number of members of all nodes, and P' that of pixels.

    Returns:
        pixel: (K,) int64, positions in the list of pixels.
        of_object: the K pixels, grouped by object.
    """
    of_member = tree.members.spread(objects.by_node.first(), none=objects.count)  # [A], G = none
    is_no_node = objects.by_object.spread(~objects.by_node.is_member)  # [P']
    of_pixel = objects.by_object.where(is_no_node).of_item  # [P']
    of_object = Groups(torch.cat((of_member, of_pixel)), objects.count)
    listed = flat_nonzero(of_object.spread(is_listed))
    every = torch.cat((tree.pixel, torch.arange(len(of_pixel), device=of_pixel.device)))
    return every.index_select(0, listed), of_object[listed]


def _test_with_copies(sweeps: HeightSlicedSweeps, pixels: Pixels, of_object: Groups, rigid: RigidMotion) -> Counts:
    """Return how many slices of K pixels the motion of each object wins and loses, near counts, (G, 1 + 4) each.

    After its own motion come four copies of it, displaced along x and along y.

    Convention: rotations are ignored: all pixels of an object move as its centre does.
    """
    off = _DISPLACEMENT / sweeps.grid.pixel_size
    offsets = constant(((0, 0), (off, 0), (-off, 0), (0, off), (0, -off)), torch.float64, pixels.slices.device)
    motion = rigid.pixels_per_interval(sweeps.grid.pixel_size)  # [G, 2]
    return count_wins(sweeps, pixels, of_object, motion[:, None] + offsets).near


def _are_lines(sweeps: HeightSlicedSweeps, pixels: Pixels, of_object: Groups) -> Tensor:
    """Tell which objects are lines at t+1, (G,) bool, from their K pixels."""
    newest = flat_nonzero(pixels.step == 0)
    return principal_axes(of_object[newest], pixels[newest].row_col, sweeps.grid.pixel_size).is_line
