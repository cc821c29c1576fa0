"""Matching of key points by normalised correlation, all windows at once (Sec. Matching keypoints).

The descriptors of a group of key points times those of its candidates within the gate is one small matrix product of
counts.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Tuple

import torch
import torch.nn.functional as F
from torch import Tensor

from cflow_torch.config import Config
from cflow_torch.descriptors import KeyPoints
from cflow_torch.gate import chunks, pair
from cflow_torch.ops.exact import exact_sqrt
from cflow_torch.ops.indices import flat_nonzero
from cflow_torch.ops.segments import segment_amin

# Longest descriptor for which float32 tells any two values count^2 / energy apart: (L^2)^3 < 2^23.
_FLOAT32_PATCH = 13
# The ratio rho is used to four decimals, so that the test is one of integers.
_RATIO_UNIT = 10_000


@dataclass(frozen=True)
class Matches:
    """Accepted matches, in order of the key points of t.

    Args:
        source: (M,) int64, key point of t.
        shift: (M, 2) int64, (dy, dx) pixels to its key point of t+1.
        score: (M,) float64, NCC of the two descriptors (Eq. descriptor_ncc).
    """

    source: Tensor
    shift: Tensor
    score: Tensor


@dataclass(frozen=True)
class _Best:
    """Best and second-best candidate of every key point; counts are squared.

    Args:
        index: (K,) int64, the best, -1 = no candidate.
        square: (K,) int64, its count^2.
        second_square, second_energy: (K,) int64, count^2 and energy of the second best; 0 and 1 = there is none.
    """

    index: Tensor
    square: Tensor
    second_square: Tensor
    second_energy: Tensor


def match(pc0: KeyPoints, pc1: KeyPoints, reach: Tensor, config: Config) -> Matches:
    """Best match of every key point of t that passes the ratio test (Eq. descriptor_ncc, best_match).

    Args:
        pc0, pc1: key points of t and t+1.
        reach: (B,) float64, pixels, farthest match of each window.
        config: `ratio_threshold`, `second_best_distance`, `mutual_check`, `max_memory`.

    Returns:
        The accepted matches.

    Convention:
        Scores are compared as count^2 / energy of the candidate, exactly. Ties: smallest distance, then smallest dy,
        then smallest dx. A match is accepted if R > rho R' holds for the second best R', on integers; equality does
        not hold, so a tie for the best is not accepted (unless `second_best_distance` leaves its rival out). Without a
        second candidate there is nothing to test.

    Cost: time (key points x candidates within the gate) x L^2; memory a fixed number of pairs, plus L^2 bytes a point.
    """
    best = _best_candidates(pc0, pc1, reach, config, config.second_best_distance)
    found = flat_nonzero(best.index >= 0)
    partner, square = best.index.index_select(0, found), best.square.index_select(0, found)
    rho = round(config.ratio_threshold * _RATIO_UNIT)
    first = square * best.second_energy.index_select(0, found) * _RATIO_UNIT**2
    second = best.second_square.index_select(0, found) * pc1.energy.index_select(0, partner) * rho**2
    accepted = first > second
    if config.mutual_check:
        back = _best_candidates(pc1, pc0, reach, config, 0.0, backward=True)
        accepted &= back.index.index_select(0, partner) == found
    kept = flat_nonzero(accepted)
    source, target, square = (values.index_select(0, kept) for values in (found, partner, square))
    dy = pc1.row.index_select(0, target) - pc0.row.index_select(0, source)
    dx = pc1.col.index_select(0, target) - pc0.col.index_select(0, source)
    energies = pc0.energy.index_select(0, source) * pc1.energy.index_select(0, target)
    count = square.double().sqrt().round()  # a whole number, whatever the last bit of the root
    score = count / exact_sqrt(energies.double())
    return Matches(source, torch.stack((dy, dx), 1), score)


def _best_candidates(
    source: KeyPoints, target: KeyPoints, reach: Tensor, config: Config, apart: float, backward: bool = False
) -> _Best:
    """The two best candidates of every key point of `source`; `backward`: ties look at shifts from target to source."""
    num_source, num_target = source.row.numel(), target.row.numel()
    index = torch.full((num_source + 1,), -1, dtype=torch.int64, device=source.row.device)
    square, second_square = torch.zeros_like(index), torch.zeros_like(index)
    second_energy = torch.ones_like(index)
    if num_source > 0 and num_target > 0:
        pairing = pair(source, target, reach)
        from_ends, to_ends = _with_padding(source), _with_padding(target)
        for groups, length in chunks(pairing, config):
            member = pairing.member.index_select(0, groups)
            slot = torch.arange(length, device=groups.device)
            place = pairing.first.index_select(0, groups)[:, None] + slot
            candidate = pairing.candidate.take(place.clamp(max=pairing.candidate.numel() - 1))
            candidate.masked_fill_(slot >= pairing.count.index_select(0, groups)[:, None], num_target)
            limit = pairing.limit.index_select(0, groups)
            found = _score_pairs(from_ends, member, to_ends, candidate, limit, config.patch_size, apart, backward)
            at = member.flatten()  # padding writes to the entry behind the last, which is cut off
            for whole, part in zip((index, square, second_square, second_energy), found):
                whole.scatter_(0, at, part)
    return _Best(*(values[:num_source] for values in (index, square, second_square, second_energy)))


def _score_pairs(
    source: KeyPoints,
    member: Tensor,
    target: KeyPoints,
    candidate: Tensor,
    limit: Tensor,
    patch_size: int,
    apart: float,
    backward: bool,
) -> Tuple[Tensor, Tensor, Tensor, Tensor]:
    """Best and second best of each group's members among its candidates.

    Args:
        source, target: key points, with one more without any pixel set at the end, for padding.
        member: (G, S) int64, key points of each group.
        candidate: (G, C) int64, candidates of each group.
        limit: (G,) int32, largest squared distance, pixels.

    Returns:
        index, square, second_square, second_energy as in `_Best`, (G * S,) each.
    """
    dtype = torch.float32 if patch_size <= _FLOAT32_PATCH else torch.float64
    patch0 = source.patch.index_select(0, member.flatten()).view(*member.shape, -1).float()
    patch1 = target.patch.index_select(0, candidate.flatten()).view(*candidate.shape, -1).float()
    value = torch.bmm(patch0, patch1.transpose(1, 2)).to(dtype)  # counts: exact at any precision of the product
    energy = target.energy.take(candidate)
    value.mul_(value).div_(energy.to(dtype)[:, None, :])  # 0 for padding, which has no pixel set

    row0, col0 = source.row.take(member).int(), source.col.take(member).int()
    row1, col1 = target.row.take(candidate).int(), target.col.take(candidate).int()
    value.masked_fill_(_squared_distance(row0, col0, row1, col1) > limit[:, None, None], 0)
    best = value.amax(2, keepdim=True)

    # Ties, and where the best stands.
    tied = flat_nonzero((value == best).logical_and_(best > 0))
    length = candidate.shape[1]
    of_member = tied // length
    of_candidate = of_member // member.shape[1] * length + tied % length
    dy = row1.take(of_candidate).long() - row0.take(of_member)
    dx = col1.take(of_candidate).long() - col0.take(of_member)
    if backward:
        dy, dx = -dy, -dx
    order = ((dy * dy + dx * dx) * (1 << 17) + dy + (1 << 16)) * 2 + (dx > 0)  # length and dy leave only the sign open
    first = segment_amin(order, of_member, member.numel(), torch.iinfo(torch.int64).max)
    is_best = flat_nonzero(order == first.index_select(0, of_member))
    winner, of_member, of_candidate = (values.index_select(0, is_best) for values in (tied, of_member, of_candidate))

    index = torch.full((member.numel(),), -1, dtype=torch.int64, device=member.device)
    index.scatter_(0, of_member, candidate.take(of_candidate))
    square = torch.zeros_like(index).scatter_(0, of_member, _count(value.take(winner), energy.take(of_candidate)))

    value.view(-1).index_fill_(0, winner, 0)
    if apart > 0:
        row_best, col_best = (x.take(index.clamp(min=0)).int().view_as(member) for x in (target.row, target.col))
        near = _squared_distance(row_best, col_best, row1, col1) < math.ceil(apart * apart)
        value.masked_fill_(near, 0)
    second, place = value.max(2)
    second_energy = energy.gather(1, place)
    second_square = _count(second, second_energy)
    second_energy.masked_fill_(second_square == 0, 1)
    return index, square, second_square.flatten(), second_energy.flatten()


def _count(value: Tensor, energy: Tensor) -> Tensor:
    """count^2 from count^2 / energy: rounding is undone, the result is a whole number."""
    return (value * energy).round_().long()


def _squared_distance(row0: Tensor, col0: Tensor, row1: Tensor, col1: Tensor) -> Tensor:
    """(G, S, C) int32 from (G, S) and (G, C)."""
    dy = row1[:, None, :] - row0[:, :, None]
    dx = col1[:, None, :] - col0[:, :, None]
    return dy.mul_(dy).addcmul_(dx, dx)


def _with_padding(points: KeyPoints) -> KeyPoints:
    """One more key point, without any pixel set: it coincides with nothing."""
    window, row, col = (F.pad(values, (0, 1)) for values in (points.window, points.row, points.col))
    # An energy of 0 would make 0 / 0 of its scores.
    return KeyPoints(window, row, col, F.pad(points.patch, (0, 0, 0, 1)), F.pad(points.energy, (0, 1), value=1))
