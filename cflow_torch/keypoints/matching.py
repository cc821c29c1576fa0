"""Matching of key points by normalised correlation, all windows at once (Sec. Matching keypoints).

The descriptors of a group of key points times those of its match candidates is one small matrix product of
counts. Few candidates come near the best of their key point; only those are looked at exactly.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import reduce
from typing import Iterable, Iterator, Sequence

import torch
import torch.nn.functional as F
from torch import Tensor

from cflow_torch.config import KeypointsConfig
from cflow_torch.keypoints.descriptors import KeyPoints
from cflow_torch.keypoints.match_candidates import chunks, pair, pairs_at_once
from cflow_torch.ops.indices import flat_nonzero
from cflow_torch.ops.segments import segment_amin

# The ratio rho is used to four decimals, so that the test is one of integers.
_RATIO_UNIT = 10_000
# Two pixels of a descriptor are one number, a + 128 b. With the halves of the other descriptor the other way round,
# (a + 128 b) (128 a' + b') = a b' + 128 (a a' + b b') + 128^2 b a': the count stands in the middle, 7 bits for at most
# 126 pixels, and half as many numbers are multiplied. Nothing is rounded: 1, 128 and 129 fit bfloat16 and TF32, which
# a matrix product may fall back to, and the sum fits float32. Longer descriptors are cut into strips.
_DIGIT_BITS = 7
_STRIP_NUMBERS = 63
_COUNT_BITS = 127 << _DIGIT_BITS
# Values count^2 / energy are float32 until the last decision; this is more than their rounding.
_ROUNDING = 2.0**-20
# So many are decided together; on a CPU `pairs_at_once` is less.
_CONTENDERS_AT_ONCE = 1 << 22


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
    """Best candidate of every key point.

    Args:
        index: (K,) int64, -1 = no candidate.
        count: (K,) int64, number of pixels that both have set.
        is_clear: (K,) bool, it passes the ratio test.
    """

    index: Tensor
    count: Tensor
    is_clear: Tensor


def match(pc0: KeyPoints, pc1: KeyPoints, reach: Tensor, config: KeypointsConfig) -> Matches:
    """Best match of every key point of t that passes the ratio test (Eq. descriptor_ncc, best_match).

    Args:
        pc0, pc1: key points of t and t+1.
        reach: (B,) float64, pixels, farthest match of each window.
        config: `ratio_threshold`, `max_memory`.

    Returns:
        The accepted matches.

    Convention:
        Scores are compared as count^2 / energy of the candidate, exactly. Ties: smallest distance, then smallest dy,
        then smallest dx. A match is accepted if R > rho R' holds for the second best R', on integers; equality does
        not hold, so a tie for the best is not accepted. Without a second candidate there is nothing to test.

    Cost: time (key points x match candidates) x L^2; memory a fixed number of pairs, plus L^2 bytes a point.
    """
    best = _best_candidates(pc0, pc1, reach, config)
    source = flat_nonzero(best.is_clear)
    target, count = best.index.index_select(0, source), best.count.index_select(0, source)
    dy = pc1.row.index_select(0, target) - pc0.row.index_select(0, source)
    dx = pc1.col.index_select(0, target) - pc0.col.index_select(0, source)
    energies = pc0.energy.index_select(0, source) * pc1.energy.index_select(0, target)
    return Matches(source, torch.stack((dy, dx), 1), count.double() / torch.sqrt(energies.double()))


def _best_candidates(source: KeyPoints, target: KeyPoints, reach: Tensor, config: KeypointsConfig) -> _Best:
    """Best candidate of every key point of `source`."""
    num_source = source.row.numel()
    index = torch.full((num_source,), -1, dtype=torch.int64, device=source.row.device)
    best = _Best(index, torch.zeros_like(index), torch.zeros_like(index, dtype=torch.bool))
    if num_source == 0 or target.row.numel() == 0:
        return best
    rho = round(config.ratio_threshold * _RATIO_UNIT)
    share = (_RATIO_UNIT / rho) ** 2
    num_pairs = pairs_at_once(reach.device, config.max_memory)
    parts = _contenders(source, target, reach, share, num_pairs)
    for of_source, of_target, count in _together(parts, min(num_pairs, _CONTENDERS_AT_ONCE)):
        energy = target.energy.index_select(0, of_target)
        square = count * count
        value = square.double() / energy  # tells any two different fractions apart
        top = value.new_zeros(num_source).scatter_reduce_(0, of_source, value, "amax")
        tied = flat_nonzero(value == top.index_select(0, of_source))
        p, q = of_source.index_select(0, tied), of_target.index_select(0, tied)
        dy = target.row.index_select(0, q) - source.row.index_select(0, p)
        dx = target.col.index_select(0, q) - source.col.index_select(0, p)
        order = ((dy * dy + dx * dx) * (1 << 17) + dy + (1 << 16)) * 2 + (dx > 0)  # only the sign is left open
        first = segment_amin(order, p, num_source, torch.iinfo(torch.int64).max)
        is_best = flat_nonzero(order == first.index_select(0, p))
        winner = tied.index_select(0, is_best)
        p, q = p.index_select(0, is_best), q.index_select(0, is_best)
        best.index.index_copy_(0, p, q)
        best.count.index_copy_(0, p, count.index_select(0, winner))
        best.is_clear.index_fill_(0, p, True)
        # The ratio test, of every rival: c1^2 E2 > rho^2 c2^2 E1.
        own = torch.zeros_like(index).index_copy_(0, p, winner).index_select(0, of_source)  # contender that is the best
        left = square.index_select(0, own) * energy * _RATIO_UNIT**2
        is_rival = (left <= square * energy.index_select(0, own) * rho**2).index_fill_(0, winner, False)
        best.is_clear.index_fill_(0, of_source.index_select(0, flat_nonzero(is_rival)), False)
    return best


def _contenders(
    source: KeyPoints, target: KeyPoints, reach: Tensor, share: float, num_pairs: int
) -> Iterator[tuple[Tensor, ...]]:
    """Pairs that come near the best of their key point; the others need no exact look.

    Args:
        source, target: key points of the same windows, at least one each.
        reach: (B,) float64, pixels.
        share: all pairs are found whose count^2 / energy is at least this share of the best one of their `source`.
        num_pairs: number of pairs that are looked at together.

    Yields:
        Key points of `source`, of `target` and counts, (N,) int64 each; all of a key point of `source` at once.
    """
    pairing = pair(source, target, reach)
    num_target = target.row.numel()
    members = pairing.member
    row0, col0 = (_padded(values, 0).int().index_select(0, members.flatten()) for values in (source.row, source.col))
    row0, col0 = row0.view(*members.shape, 1), col0.view(*members.shape, 1)
    row1, col1, energy1 = (_padded(values, 1) for values in (target.row.int(), target.col.int(), target.energy.float()))
    patch0, patch1 = _pack(source.patch, False), _pack(target.patch, True)
    offset = row0 * row0 + col0 * col0 - pairing.limit[:, None, None] - 1
    for groups, length in chunks(pairing, num_pairs):
        member = members[groups]
        shape = (member.shape[0], 1, length)
        slot = torch.arange(length, device=member.device)
        place = (pairing.first[groups, None] + slot).clamp_(max=pairing.candidate.numel() - 1)
        candidate = pairing.candidate.index_select(0, place.flatten())
        candidate.masked_fill_((slot >= pairing.count[groups, None]).flatten(), num_target)
        overlap = _overlap(patch0, member, patch1, candidate)

        # Out of reach the overlap becomes 0: dy^2 + dx^2 - limit - 1, term by term, is negative inside. The terms
        # may exceed 31 bits, their sum does not. Masks of bits are ten times faster than masks of truth values.
        row, col = row1.index_select(0, candidate).view(shape), col1.index_select(0, candidate).view(shape)
        inside = (row * row).addcmul_(col, col) + offset[groups]
        inside.addcmul_(row, row0[groups], value=-2).addcmul_(col, col0[groups], value=-2).bitwise_right_shift_(31)
        overlap.bitwise_and_(inside)
        value = overlap.float()
        value.mul_(value).div_(energy1.index_select(0, candidate).view(shape))
        threshold = value.amax(2, keepdim=True).mul_(share * (1 - _ROUNDING)).clamp_(min=2.0**-15)  # > 0
        place = flat_nonzero(value.ge_(threshold).bool())  # three times faster than value >= threshold

        of_member = place // length
        of_candidate = place - (of_member - of_member // member.shape[1]) * length
        count = overlap.flatten().index_select(0, place).long() >> _DIGIT_BITS
        yield member.flatten().index_select(0, of_member), candidate.index_select(0, of_candidate), count


def _together(parts: Iterable[tuple[Tensor, ...]], enough: int) -> Iterator[tuple[Tensor, ...]]:
    """The same, joined until there are enough."""
    waiting: list[tuple[Tensor, ...]] = []
    for part in parts:
        waiting.append(part)
        if sum(values[0].numel() for values in waiting) >= enough:
            yield tuple(map(torch.cat, zip(*waiting)))
            waiting = []
    if waiting:
        yield tuple(map(torch.cat, zip(*waiting)))


def _padded(values: Tensor, value: int) -> Tensor:
    """One more key point."""
    return F.pad(values, (0, 1), value=value)


def _pack(patch: Tensor, swapped: bool) -> tuple[Tensor, ...]:
    """(K, L^2) zeros and ones -> strips of them, (K + 1, N) uint8 each, two pixels in a number; the last row has none.

    Args:
        swapped: whether the first half of the pixels is the higher digit.
    """
    num_points, num_pixels = patch.shape
    half = -(-num_pixels // 2)
    num_strips = -(-half // _STRIP_NUMBERS)
    width = -(-half // num_strips)
    packed = patch.new_zeros((num_points + 1, num_strips * width))
    first, second = (1 << _DIGIT_BITS, 1) if swapped else (1, 1 << _DIGIT_BITS)
    torch.mul(patch[:, :half], first, out=packed[:-1, :half])
    packed[:-1, : num_pixels - half].add_(patch[:, half:], alpha=second)
    return tuple(strip.contiguous() for strip in packed.split(width, dim=1))


def _overlap(patch0: Sequence[Tensor], member: Tensor, patch1: Sequence[Tensor], candidate: Tensor) -> Tensor:
    """Number of pixels that both have set, times 128.

    Args:
        patch0, patch1: strips of the descriptors, as `_pack` makes them.
        member: (G, S) int64, rows of `patch0`.
        candidate: (G * C,) int64, rows of `patch1`.

    Returns:
        (G, S, C) int32.
    """
    num_groups, size = member.shape
    width = patch1[0].shape[1]
    right = torch.empty((candidate.numel(), width), dtype=torch.float32, device=member.device)  # new memory is slow
    product = right.new_empty((num_groups, size, candidate.numel() // num_groups))

    def of_strip(strip0: Tensor, strip1: Tensor) -> Tensor:
        left = strip0.index_select(0, member.flatten()).float().view(num_groups, size, -1)
        right.copy_(strip1.index_select(0, candidate))
        torch.bmm(left, right.view(num_groups, -1, width).transpose(1, 2), out=product)
        return product.int().bitwise_and_(_COUNT_BITS)

    return reduce(Tensor.add_, map(of_strip, patch0, patch1))
