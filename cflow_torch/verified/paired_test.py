"""The paired test (McNemar's): candidate motions against "static", over all sweeps, in both time directions."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor

from cflow_torch.ops.indices import (
    constant,
    flat_nonzero,
    gather,
    members_of,
    scatter_count,
    split_index,
    take_columns,
)
from cflow_torch.verified.aperture import slides_along_itself
from cflow_torch.verified.component_tree import Nodes
from cflow_torch.verified.height_slices import NUM_SLICES, REACH, HeightSlicedSweeps, Pixels, count_slices

# Comparisons (pixel x sweep x candidate) at once; each needs about 64 bytes of temporaries.
_AT_ONCE_CPU, _AT_ONCE_GPU = 1 << 18, 1 << 24
_FAR = 2  # pixels in y or in x; for shifts of this length or more, absence is tested in 3 x 3 pixels
_NEAR_Z = 2.0  # factor of z for near counts, which are correlated, because one slice matches several neighbours
_COVERED = 65  # per cent
_CHANGED_Z = 4.0  # z for nodes of changed pixels
# The evidence must exceed 3 slices per sweep besides t and t+1, or a slice for every 8 pixels, whichever is less.
_LEAST_GAIN, _LEAST_SHARE = 3, 8


def verify(
    sweeps: HeightSlicedSweeps, nodes: Nodes, candidates: Tensor, num_levels: int, significance: float
) -> tuple[Tensor, Tensor]:
    """Return the candidate of each node that explains the sweeps best, if it is significant.

    Args:
        candidates: (N, C, 2) float64, (y, x), finest pixels per sweep interval.
        num_levels: L. Nodes of changed pixels have level L, and their z is `_CHANGED_Z`.
        significance: z of the paired test for all other nodes.

    Returns:
        motion: (N, 2) float64, (y, x), finest pixels per sweep interval; 0 = no candidate has enough evidence.
        evidence: (N,) int64, of that motion, sixteenths of a slice.
    """
    tested = flat_nonzero(candidates.flatten(1).any(1))  # other nodes are static and cost nothing
    some, node = members_of(tested, nodes.node, nodes.count)
    members = sweeps.pixels.take(nodes.pixel.index_select(0, some))
    level, travels, window, candidates_of = gather(tested, nodes.level, nodes.travels, nodes.window, candidates)
    wins = count_wins(sweeps, members, node, candidates_of)
    z = constant((_CHANGED_Z, significance), torch.float64, level.device)
    z = torch.where(level == num_levels, z[0], z[1])[:, None]
    factor = constant((1.0, _NEAR_Z), torch.float64, level.device)[:, None, None]
    evidence = evidence_of(wins.won, wins.lost, factor * z).sum(0)
    slides = slides_along_itself(sweeps, members, node, candidates_of, wins.is_covered & ~travels)
    num_more = sweeps.num_more.index_select(0, window)
    least = torch.minimum(16 * _LEAST_GAIN * num_more, 16 * scatter_count(node, len(tested)) // _LEAST_SHARE)
    evidence.masked_fill_(slides | (evidence <= least[:, None]), 0)
    motion, evidence = best_candidate(evidence, candidates_of)
    return (
        torch.zeros_like(candidates[:, 0]).index_copy_(0, tested, motion),
        torch.zeros_like(nodes.level).index_copy_(0, tested, evidence),
    )


def add_unchanged(sweeps: HeightSlicedSweeps, nodes: Nodes, motion: Tensor, num_levels: int) -> Nodes:
    """Complete moving nodes of changed pixels: add the pixels of the same object that did not change.

    The middle of a pedestrian is often occupied in the other sweeps as well, so only the outline has changed. If the
    pedestrian touches a wall, the middle belongs to the component of the wall.

    Args:
        motion: (N, 2) float64, (y, x), finest pixels per sweep interval; 0 = static.
        num_levels: L. Nodes of changed pixels have level L.

    Convention: we test the pixels around moving nodes of changed pixels, at most two rows and columns away. A pixel
        near several nodes is tested only for the first. It joins this node if the motion wins more slices than it loses
        in the tested pixels among the 3 x 3 around it.

    Cost: 25 lookups for each pixel of these nodes, and the paired test of the pixels around them.
    """
    grows = motion.any(1) & (nodes.level == num_levels)
    some = flat_nonzero(grows.index_select(0, nodes.node))
    if len(some) == 0:
        return nodes
    pixel, node = gather(some, nodes.pixel, nodes.node)
    near = sweeps.around(pixel, REACH)
    nearest = torch.full((sweeps.num_pixels + 1,), nodes.count, device=near.device)
    nearest.scatter_reduce_(0, near.view(-1), node.repeat_interleave(near.shape[1]), "amin")
    nearest.index_fill_(0, pixel, nodes.count)
    pixel = flat_nonzero(nearest[:-1] < nodes.count)
    node, each = nearest.index_select(0, pixel), torch.arange(len(pixel), device=near.device)
    wins = count_wins(sweeps, sweeps.pixels.take(pixel), each, motion.index_select(0, node)[:, None])
    surplus = torch.zeros_like(nearest).index_copy_(0, pixel, (wins.won - wins.lost)[0, :, 0])
    joins = flat_nonzero(surplus[sweeps.around(pixel, 1)].sum(1) > 0)
    pixel, node = gather(joins, pixel, node)
    return replace(nodes, pixel=torch.cat((nodes.pixel, pixel)), node=torch.cat((nodes.node, node)))


class Wins(NamedTuple):
    """Paired counts of M components with C candidate motions each."""

    # (2, M, C) int64, numbers of slices. Index 1 has the near counts: if the target is at least two pixels away, a
    # slice also counts as found if it is in the 3 x 3 pixels around a position.
    won: Tensor
    lost: Tensor
    # (2, M, 2) int64, numbers of slices. Last axis: slices of the other sweeps, then slices of t+1. First axis: all
    # slices, then those found in place, plus 2^32 for each one found in the 3 x 3 pixels around its position.
    of_static: Tensor

    @property
    def in_place(self) -> Tensor:
        """(M,) int64, slices that other sweeps have at the same position, for any motion."""
        return (self.of_static[1] & 0xFFFFFFFF).sum(1)

    @property
    def is_covered(self) -> Tensor:
        """(M,) bool: the other sweeps have `_COVERED` per cent of the slices of t+1 in the 3 x 3 pixels around the same
        position, or t+1 has that share of the slices of the other sweeps. The other sweeps are counted together."""
        total, near = self.of_static[0], self.of_static[1] >> 32
        return ((total > 0) & (near * 100 >= total * _COVERED)).any(1)


def count_wins(sweeps: HeightSlicedSweeps, members: Pixels, component: Tensor, candidates: Tensor) -> Wins:
    """Count the slices that each candidate motion wins and loses against "static".

    For each slice of a pixel, we check two positions in another sweep: the target of the motion, and the position of
    the pixel itself. The motion wins the slice if it is found only at the target, and loses it if it is found only in
    place; slices found at both or at neither are ignored. If the target is at least two pixels away in y or in x, "not
    found" means absent from all 3 x 3 pixels around the position. Otherwise a static surface would seem to leave its
    position, because beams sample it differently in each sweep. For the near counts of such targets, "found" means
    found in any of the 3 x 3 pixels, because the sparse points of far objects rarely hit the same pixels again.

    Args:
        members: K pixels of components.
        component: (K,) int64, component of each pixel.
        candidates: (M, C, 2) float64, (y, x) finest pixels per sweep interval, axes of ego1; C at least 1.

    Returns:
        The counts, summed over all sweeps m other than t+1. We look up slices of m in t+1, and slices of t+1 in m.

    Convention:
        The target is floor(k f + 0.5) pixels away, elementwise float64; k = elapsed intervals, negative from t+1 into
        the past. The slice found may belong to any component. Positions outside the image are empty, and so are the
        pixels around them. Sweeps that a window lacks are not counted. At most 2^31 - 1 slices of a component may be
        compared.

    Cost: K (S - 1) C lookups at most.
    """
    count, num_candidates, num_steps = len(candidates), candidates.shape[1], sweeps.num_steps
    area, device = sweeps.grid.height * sweeps.grid.width, component.device
    window = torch.zeros(count, dtype=torch.int64, device=device).scatter_(0, component, members.window)
    # The displacements have a row for every difference of steps from 1 - S to S - 1, R = (2 S - 1) M rows in all.
    k = sweeps.intervals.index_select(0, window)
    shift = (candidates.permute(2, 1, 0)[..., None] * k + 0.5).floor_().flatten(2)  # (2, C, R), pixels down and right
    side, shift = torch.maximum(*shift.abs()), shift.long()
    longest, is_given = side.amax(0), (k != 0).flatten()  # (R,) each; given = the window has both sweeps
    offset = torch.add(shift[1], shift[0], alpha=sweeps.grid.width)  # of flat indices
    # (C, R), first of the image bits that tell whether a slice is absent: the bits of the 3 x 3 pixels for shifts of at
    # least two pixels in y or in x, otherwise the bits of the pixel itself.
    absent_bit = (side >= _FAR).view(torch.uint8) * NUM_SLICES
    first = torch.sub(members.index, members.step, alpha=area)
    move = torch.add(members.step + (num_steps - 1), component, alpha=2 * num_steps - 1)
    at = members.row_col
    ends = constant((sweeps.grid.height - 1, sweeps.grid.width - 1), torch.int64, device)[:, None]
    border = torch.minimum(*torch.minimum(at, ends - at))
    table = torch.stack((component, first, move, border))
    # Slices lost, plus 2^32 times slices won, by each candidate. Then the near counts likewise, then `Wins.of_static`.
    sums = torch.zeros((2 * num_candidates + 2, 2 * count), dtype=torch.int64, device=device)
    size = max(1, (_AT_ONCE_CPU if device.type == "cpu" else _AT_ONCE_GPU) // num_candidates)
    # Every other sweep is compared with t+1, and t+1 with every other sweep.
    is_newest = constant(tuple(to == 0 for to in range(num_steps)), torch.bool, device)[:, None]
    comparisons = split_index(flat_nonzero((members.step == 0) != is_newest), len(component))
    for to, pixel in zip(*(of_all.split(size) for of_all in comparisons)):
        of, start, which, near_border = take_columns(table, pixel)
        start.add_(to, alpha=area)
        which -= to
        index = take_columns(offset, which).add_(start)
        leaves = flat_nonzero(near_border < longest.index_select(0, which))
        target = shift.index_select(2, which.index_select(0, leaves))
        target += take_columns(at, pixel.index_select(0, leaves))[:, None]
        index.index_copy_(1, leaves, sweeps.or_outside(take_columns(index, leaves), target))

        # (2, C, comparisons), the slices found in place, then at the target. `exact` looks in the pixel itself. `near`
        # looks where slices must be absent: in the pixel or, for far motions, in the 3 x 3 pixels around it.
        own = members.slices.index_select(0, pixel)
        in_place = sweeps.image.index_select(0, start).bitwise_and_(own * (1 + (1 << NUM_SLICES)))  # in both halves
        at_target = sweeps.image.index_select(0, index.view(-1)).view_as(index)
        exact = torch.stack((in_place.expand_as(at_target), at_target))
        near = (exact >> take_columns(absent_bit, which)).bitwise_and_(own)
        found, absent = torch.stack((exact, near)), own ^ near
        lost, won = found[:, 0] & absent[1], found[:, 1] & absent[0]
        given = own * is_given.index_select(0, which)
        counted = torch.cat(((won << NUM_SLICES | lost).flatten(0, 1), given[None], in_place[None]))
        sums.scatter_add_(1, torch.add(to > 0, of, alpha=2).expand(len(sums), -1), count_slices(counted))
    sums = sums.view(len(sums), count, 2)
    of_motion = sums[:-2].sum(2).view(2, num_candidates, count).transpose(1, 2)
    return Wins(of_motion >> 32, of_motion & 0xFFFFFFFF, sums[-2:])


def evidence_of(won: Tensor, lost: Tensor, z: float | Tensor) -> Tensor:
    """Return the evidence of each motion, (won - lost) - z sqrt(won + lost), in sixteenths of a slice.

    Args:
        won, lost: int64 of one shape, below 2^31.
        z: required standard deviations of noise, one for all or one each; 0 = every surplus counts.

    Returns:
        int64, same shape, rounded down; 0 = not significant.
    """
    surplus, noise = (won - lost).double(), torch.sqrt((won + lost).double())
    return (16 * (surplus - z * noise)).floor_().long().clamp_(min=0)


def best_candidate(evidence: Tensor, candidates: Tensor) -> tuple[Tensor, Tensor]:
    """Return the motion with the most evidence for each component, and its evidence, (M,) int64.

    The evidence is (M, C) int64, below 2^36 (C below 2^20). The candidates are (M, C, 2) float64, and the motion is
    (M, 2), 0 where no candidate has evidence. Ties: the first candidate.
    """
    num_candidates = evidence.shape[1]
    reverse = torch.arange(num_candidates - 1, -1, -1, device=evidence.device)
    key = (evidence * num_candidates + reverse).amax(1)  # keys of two candidates always differ
    most = torch.div(key, num_candidates, rounding_mode="floor")
    best = num_candidates - 1 - (key - most * num_candidates)
    motion = candidates.gather(1, best[:, None, None].expand(-1, 1, 2))[:, 0]
    return motion.masked_fill((most == 0)[:, None], 0.0), most
