"""Match key points by normalised correlation, all windows at once (Sec. Matching keypoints).

One small matrix product counts the pixels that each key point of a group shares with each match candidate of the
group. Few candidates score close to the best one of a key point; we compare only those exactly.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import reduce
from typing import Iterable, Iterator, Sequence

import torch
import torch.nn.functional as F
from torch import Tensor

from cflow_torch.config import KeypointsConfig
from cflow_torch.keypoints.match_candidates import KeyPoints, chunks, pair, pairs_at_once
from cflow_torch.ops.indices import flat_nonzero, gather

# The ratio rho is used to four decimals, so that the ratio test compares integers.
_RATIO_UNIT = 10_000
# We pack two pixels of a descriptor into one number, a + 128 b, and two of the other descriptor into 128 a' + b'. The
# product is a b' + 128 (a a' + b b') + 128^2 b a', so the count is the middle digit. It has 7 bits, enough for 126
# pixels. Packing halves the number of multiplications. Nothing is rounded: 1, 128 and 129 fit bfloat16 and TF32, which
# matrix products may fall back to, and the sum fits float32. We cut longer descriptors into strips.
_DIGIT_BITS = 7
_STRIP_NUMBERS = 63
_COUNT_BITS = 127 << _DIGIT_BITS
# Bound of the relative rounding error of count^2 / energy in float32, by which we find contenders.
_ROUNDING = 2.0**-20
# Contenders that we compare exactly at once; on a CPU `pairs_at_once` is less.
_CONTENDERS_AT_ONCE = 1 << 22


@dataclass(frozen=True)
class Matches:
    """Accepted matches, in order of the key points of t."""

    source: Tensor  # (M,) int64, key point of t
    shift: Tensor  # (M, 2) int64, (dy, dx) pixels to the key point of t+1
    score: Tensor  # (M,) float64, NCC of the two descriptors (Eq. descriptor_ncc)


def match(pc0: KeyPoints, pc1: KeyPoints, reach: Tensor, config: KeypointsConfig) -> Matches:
    """Find the best match of every key point of t and apply the ratio test (Eq. descriptor_ncc, best_match).

    `reach` is (B,) float64, pixels, the longest distance of a match in each window. We compare scores exactly, as
    count^2 / energy of the candidate. We accept the best match, of score R, if R > rho R' for the second-best score R',
    in integers, or if there is no second candidate. Ties: rejected.

    Cost: time (pairs of a key point and a candidate) x L^2; memory a fixed number of pairs, plus L^2 bytes per point.
    """
    num_source = pc0.row.numel()
    accepted = [torch.zeros((3, 0), dtype=torch.int64, device=reach.device)]
    rho = round(config.ratio_threshold * _RATIO_UNIT)
    num_pairs = pairs_at_once(reach.device, config.max_memory)
    parts = _contenders(pc0, pc1, reach, (_RATIO_UNIT / rho) ** 2, num_pairs)
    for source, target, count in _join(parts, min(num_pairs, _CONTENDERS_AT_ONCE)):
        energy, square = pc1.energy.index_select(0, target), count * count
        value = square.double() / energy  # exact enough to tell any two different fractions apart
        top = value.new_zeros(num_source).scatter_reduce_(0, source, value, "amax")
        tied = flat_nonzero(value == top.index_select(0, source))
        p = source.index_select(0, tied)
        best_of_point = torch.zeros_like(pc0.row).scatter_(0, p, tied)  # any of a tie, which the ratio test rejects
        best = tied.index_select(0, flat_nonzero(tied == best_of_point.index_select(0, p)))
        p = source.index_select(0, best)
        # The ratio test against every other contender: c1^2 E2 > rho^2 c2^2 E1.
        rivalled = best_of_point.index_select(0, source)
        best_square, best_energy = gather(rivalled, square, energy)
        is_rival = best_square * energy * _RATIO_UNIT**2 <= square * best_energy * rho**2
        rivals = flat_nonzero(is_rival.index_fill_(0, best, False))
        is_clear = torch.ones_like(pc0.row, dtype=torch.bool).index_fill_(0, source.index_select(0, rivals), False)
        best = best.index_select(0, flat_nonzero(is_clear.index_select(0, p)))
        accepted.append(torch.stack(gather(best, source, target, count)))
    source, target, count = torch.cat(accepted, 1)
    source, by_source = source.sort()
    target, count = gather(by_source, target, count)
    energies = pc0.energy.index_select(0, source) * pc1.energy.index_select(0, target)
    (row0, col0), (row1, col1) = gather(source, pc0.row, pc0.col), gather(target, pc1.row, pc1.col)
    return Matches(source, torch.stack((row1 - row0, col1 - col0), 1), count.double() / torch.sqrt(energies.double()))


def _contenders(
    source: KeyPoints, target: KeyPoints, reach: Tensor, share: float, num_pairs: int
) -> Iterator[tuple[Tensor, ...]]:
    """Yield pairs of key points of `source` and `target`, and their counts, (N,) int64 each.

    We keep a pair if its count^2 / energy is at least `share` times the largest one of the same key point of `source`.
    All pairs of a key point of `source` come in the same tensors.
    """
    if source.row.numel() == 0 or target.row.numel() == 0:
        return
    pairing = pair(source, target, reach)
    num_target = target.row.numel()
    members = pairing.member
    # An additional last key point pads the groups and the lists of candidates.
    row0, col0 = gather(members.flatten(), *(F.pad(values.int(), (0, 1)) for values in (source.row, source.col)))
    row0, col0 = row0.view(*members.shape, 1), col0.view(*members.shape, 1)
    row1, col1, energy1 = (F.pad(values, (0, 1), value=1) for values in (target.row, target.col, target.energy))
    row1, col1, energy1 = row1.int(), col1.int(), energy1.float()
    patch0, patch1 = _pack(source.patch, False), _pack(target.patch, True)
    offset = row0 * row0 + col0 * col0 - pairing.limit[:, None, None] - 1
    for groups, length in chunks(pairing, num_pairs):
        member = members[groups]
        shape = (member.shape[0], 1, length)
        slot = torch.arange(length, device=member.device)
        index = (pairing.first[groups, None] + slot).clamp_(max=pairing.candidate.numel() - 1)
        candidate = pairing.candidate.index_select(0, index.flatten())
        candidate.masked_fill_((slot >= pairing.count[groups, None]).flatten(), num_target)
        overlap = _overlap(patch0, member, patch1, candidate)

        # Clear the overlap of pairs out of reach. dy^2 + dx^2 - limit - 1 is negative within reach; its terms may
        # exceed 31 bits, their sum does not. Masks of bits are ten times faster than bool masks.
        row, col = row1.index_select(0, candidate).view(shape), col1.index_select(0, candidate).view(shape)
        inside = (row * row).addcmul_(col, col) + offset[groups]
        inside.addcmul_(row, row0[groups], value=-2).addcmul_(col, col0[groups], value=-2).bitwise_right_shift_(31)
        overlap.bitwise_and_(inside)
        value = overlap.float()
        value.mul_(value).div_(energy1.index_select(0, candidate).view(shape))
        threshold = value.amax(2, keepdim=True).mul_(share * (1 - _ROUNDING)).clamp_(min=2.0**-15)  # > 0
        index = flat_nonzero(value.ge_(threshold).bool())  # three times faster than value >= threshold

        of_member = index // length
        of_candidate = index - (of_member - of_member // member.shape[1]) * length
        count = overlap.flatten().index_select(0, index).long() >> _DIGIT_BITS
        yield member.flatten().index_select(0, of_member), candidate.index_select(0, of_candidate), count


def _join(parts: Iterable[tuple[Tensor, ...]], enough: int) -> Iterator[tuple[Tensor, ...]]:
    """Concatenate consecutive parts until each result has `enough` elements."""
    waiting: list[tuple[Tensor, ...]] = []
    for one in parts:
        waiting.append(one)
        if sum(len(values) for values, *_ in waiting) >= enough:
            yield tuple(map(torch.cat, zip(*waiting)))
            waiting = []
    if waiting:
        yield tuple(map(torch.cat, zip(*waiting)))


def _pack(patch: Tensor, swapped: bool) -> tuple[Tensor, ...]:
    """Pack (K, L^2) zeros and ones into strips, (K + 1, N) uint8 each, two pixels in a number; the last row is zero.

    If `swapped`, the first half of the pixels is the higher digit.
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
    """Count the pixels that are set in both descriptors, times 128: (G, S, C) int32.

    The descriptors are strips of `_pack`; `member` (G, S) and `candidate` (G * C,) are their rows.
    """
    num_groups, size = member.shape
    width = patch1[0].shape[1]
    right = torch.empty((candidate.numel(), width), dtype=torch.float32, device=member.device)  # allocated once
    product = right.new_empty((num_groups, size, candidate.numel() // num_groups))

    def of_strip(strip0: Tensor, strip1: Tensor) -> Tensor:
        left = strip0.index_select(0, member.flatten()).float().view(num_groups, size, -1)
        right.copy_(strip1.index_select(0, candidate))
        torch.bmm(left, right.view(num_groups, -1, width).transpose(1, 2), out=product)
        return product.int().bitwise_and_(_COUNT_BITS)

    return reduce(Tensor.add_, map(of_strip, patch0, patch1))
