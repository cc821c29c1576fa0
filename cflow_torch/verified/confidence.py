"""The margin of motions, and the confidence of the flow of each point (docs/verified.md).

The margin of a motion says how much worse it explains the sweeps when it is displaced. Along a wall that seems to slide
nothing gets worse, and a trunk of few points fits many positions: what fits as well when displaced is static.

Counts that need no truth give every point a probability, from a table. A moving object is trusted by its margin, a
static one by the share of its neighbourhood that is matched, and less beside a moving object, which may be larger than
it seems. What could not be linked to t+1 is trusted the less the more of it there is.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from cflow_torch.ops.indices import constant, flat_nonzero, floor_divide, gather, lookup, scatter_count
from cflow_torch.verified.aperture import principal_axes
from cflow_torch.verified.component_tree import Objects
from cflow_torch.verified.height_slices import NUM_SLICES, HeightSlicedSweeps, Pixels, count_slices
from cflow_torch.verified.paired_test import count_wins
from cflow_torch.verified.rigid_motion import RigidMotion

# Bounds of the bins and the probabilities, written by scripts/ablation/calibrate_confidence.py. Bins, in order: left
# out; unlinked, by `crowd`; static, by `share`; static beside a moving object; moving, by `margin`: pairs near, pairs
# far, with history near and far.
TABLE = json.loads(Path(__file__).with_name("confidence.json").read_text(encoding="utf-8"))
_BLOCK = 1.6  # metres, sides of a neighbourhood
_DISPLACEMENT = 0.4  # metres per interval, along x and along y
_Z = 1.0  # standard deviations of noise by which a motion must be better than displaced


class MotionMargin(NamedTuple):
    """The margins of G objects.

    Args:
        z: (G,) float64, slices matched by the motion less those matched by the best displaced one, in standard
            deviations of noise; 0 = it is not better, or the object is static.
        is_dynamic: (G,) bool, it moves: z is at least 1, or the object is not a line, more of it is matched by the
            motion than where it is, and the motion is better than displaced ones or at least twice the displacement,
            because then the displaced ones move as well. Lines need z: beams meet a rail at positions that move.
    """

    z: Tensor
    is_dynamic: Tensor


def motion_margin(sweeps: HeightSlicedSweeps, objects: Objects, rigid: RigidMotion) -> MotionMargin:
    """The margin of each object.

    Args:
        sweeps: finest images.
        objects: G of them.
        rigid: their motion.

    Cost: five lookups for each pixel of the moving objects and each sweep.
    """
    size, device = sweeps.grid.pixel_size, rigid.flow.device
    off = _DISPLACEMENT / size
    displaced = constant(((0, 0), (off, 0), (-off, 0), (0, off), (0, -off)), torch.float64, device)
    pixel = flat_nonzero(lookup(rigid.flow.any(1), objects.of_pixel))
    members, which = sweeps.pixels.take(pixel), objects.of_pixel.index_select(0, pixel)
    group, motion = _groups_of_one_motion(sweeps, members, which, rigid)
    wins = count_wins(sweeps, members, group, motion[:, None] + displaced)
    counts = torch.cat((wins.won - wins.lost, wins.in_place[:, None]), 1)
    object_of_group = torch.zeros_like(wins.in_place).scatter_(0, group, which)
    counts = torch.zeros(objects.count, 6, dtype=torch.int64, device=device).index_add_(0, object_of_group, counts)
    surplus, in_place = counts[:, :5], counts[:, 5]
    gain, matched = (surplus[:, 0] - surplus[:, 1:].amax(1)).clamp(min=0), surplus[:, 0] + in_place
    z = gain / matched.clamp(min=1).double().sqrt()
    newest = flat_nonzero(members.step == 0)
    component, row, col = gather(newest, which, members.row, members.col)
    is_line, *_ = principal_axes(component, row, col, objects.count, size)
    is_fast = rigid.flow.square().sum(1) >= (2 * _DISPLACEMENT) ** 2
    return MotionMargin(z, (z >= _Z) | ((gain > 0) | is_fast) & (surplus[:, 0] > in_place) & ~is_line)


def _groups_of_one_motion(
    sweeps: HeightSlicedSweeps, pixels: Pixels, which: Tensor, rigid: RigidMotion
) -> tuple[Tensor, Tensor]:
    """Groups of pixels that share a motion: the pixels of an object, but those that its rotation takes a pixel
    farther are groups of their own.

    Args:
        sweeps: finest images.
        pixels: K pixels of objects.
        which: (K,) int64, object of each.
        rigid: motion of the G objects.

    Returns:
        group: (K,) int64, of each pixel.
        motion: (G + groups, 2) float64, (y, x), pixels per interval.
    """
    size, motion = sweeps.grid.pixel_size, rigid.pixels_per_interval(sweeps.grid.pixel_size)
    elapsed = sweeps.elapsed.index_select(0, pixels.window)
    since_t = elapsed[:, 1] - elapsed.gather(1, pixels.step[:, None])[:, 0]
    (y, x), (flow_x, flow_y) = sweeps.grid.centre(pixels.row_col), rigid.flow.index_select(0, which).unbind(1)
    flow_x, flow_y = rigid.flow_at(which, x - flow_x * since_t, y - flow_y * since_t)  # by where the pixel was at t
    flow = torch.stack((flow_y, flow_x), 1) / size
    rotates = flat_nonzero(((flow - motion.index_select(0, which)).abs() >= 1).any(1))
    group = which.index_copy(0, rotates, torch.arange(len(rotates), device=which.device) + len(motion))
    return group, torch.cat((motion, flow.index_select(0, rotates)))


def confidence_of(sweeps: HeightSlicedSweeps, objects: Objects, rigid: RigidMotion, margin: Tensor) -> Tensor:
    """Probability that the motion of a pixel of t is right to 0.1 m per sweep interval.

    Args:
        sweeps: finest images, P occupied pixels.
        objects: G of them.
        rigid: their motion. Rotations are ignored: an object counts as if it moved as its centre does.
        margin: (G,) float64, of each motion, `MotionMargin.z`.

    Returns:
        (P + 1,) float32; entry P is for points whose pixel was left out. Undefined for pixels of other sweeps.

    Cost: one lookup for each pixel of t, and nine for those that move.
    """
    pixels, size, device = sweeps.pixels, sweeps.grid.pixel_size, margin.device
    motion = rigid.pixels_per_interval(size)
    number, matched = _neighbourhood(sweeps, lookup(motion, objects.of_pixel))
    crowd, share, bounds = (TABLE[name] for name in ("crowd", "share", "margin"))
    unlinked = 1 + _bin(number, crowd)
    moves = lookup(motion.any(1), objects.of_pixel)
    tenths = constant(tuple(share), number.dtype, device)[:, None]
    static = 2 + len(crowd) + (10 * matched >= tenths * number).sum(0)
    static.masked_fill_(_is_beside(sweeps, moves), 3 + len(crowd) + len(share))

    y, x = sweeps.grid.centre(pixels.row_col)
    is_far = x * x + y * y >= float(TABLE["far"]) ** 2
    kind = 2 * sweeps.has_history.index_select(0, pixels.window) + is_far.long()
    first = 4 + len(crowd) + len(share)
    moving = first + kind * (1 + len(bounds)) + lookup(_bin(margin, bounds), objects.of_pixel)

    static = torch.where(objects.of_pixel == objects.count, unlinked, static)
    index = torch.where(moves, moving, static)
    probabilities = constant(tuple(TABLE["probabilities"]), torch.float32, device)
    return torch.cat((probabilities.index_select(0, index), probabilities[:1]))


def _is_beside(sweeps: HeightSlicedSweeps, moves: Tensor) -> Tensor:
    """(P,) bool: whether one of the 3 x 3 pixels around each pixel moves in the same sweep. `moves` is (P,) bool."""
    around = sweeps.around(flat_nonzero(moves), 1).view(-1)
    return F.pad(torch.zeros_like(moves), (0, 1)).index_fill_(0, around, True)[:-1]


def _bin(values: Tensor, bounds: list[float]) -> Tensor:
    """(K,) int64, how many of the ascending bounds each value reaches."""
    return torch.bucketize(values, constant(tuple(bounds), values.dtype, values.device), right=True)


def _neighbourhood(sweeps: HeightSlicedSweeps, motion: Tensor) -> tuple[Tensor, Tensor]:
    """Slices of t in the block around each pixel, and how many of them t+1 has where they move to.

    Args:
        sweeps: P pixels.
        motion: (P, 2) float64, (y, x) finest pixels per interval.

    Returns:
        (P,) int64 each.
    """
    pixels, side = sweeps.pixels, max(1, round(_BLOCK / sweeps.grid.pixel_size))
    height, width = -(-sweeps.grid.height // side), -(-sweeps.grid.width // side)
    block = (pixels.window * height + floor_divide(pixels.row, side)) * width + floor_divide(pixels.col, side)
    source = flat_nonzero(pixels.step == 1)
    of_t, block_of_t = pixels.take(source), block.index_select(0, source)
    elapsed = sweeps.elapsed[:, 1].index_select(0, of_t.window)
    shift = (motion.index_select(0, source).t() * elapsed + 0.5).floor_().long()
    offset = torch.add(shift[1], shift[0], alpha=sweeps.grid.width) - sweeps.grid.height * sweeps.grid.width  # t+1
    index = sweeps.or_outside(of_t.index + offset, of_t.table[3:] + shift)
    matched = of_t.slices & sweeps.image.index_select(0, index)
    both = count_slices(of_t.slices | matched << NUM_SLICES)
    sums = scatter_count(block_of_t, sweeps.batch.num_windows * height * width, both).index_select(0, block)
    return sums & 0xFFFFFFFF, sums >> 32
