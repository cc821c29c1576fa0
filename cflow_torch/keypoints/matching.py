"""Match key points by normalised correlation, all windows at once (Sec. Matching keypoints).

Most pixels of a descriptor are empty. So we do not multiply descriptors. For each set pixel of a key point of t, we add
a row of a table, which says which key points of a block of t+1 have this pixel, too. The sum counts the pixels that the
key point shares with each of the 64 key points of the block. Few of them score close to the best one; we compare only
those exactly.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Iterator

import torch
import torch.nn.functional as F
from torch import Tensor

from cflow_torch.config import KeypointsConfig
from cflow_torch.keypoints.match_candidates import BLOCK_SIZE, Blocks, KeyPoints, make_blocks, near_blocks
from cflow_torch.ops.chunks import chunks
from cflow_torch.ops.groups import Groups
from cflow_torch.ops.indices import flat_nonzero

# The ratio rho is used to four decimals, so that the ratio test compares integers.
_RATIO_UNIT = 10_000
# One float32 of the table stands for four key points of a block: float32 holds 24 bits exactly.
#
#     bits         0 ... 5   6 ... 11   12 ... 17   18 ... 23
#     key points   0 ... 15  16 ... 31  32 ... 47   48 ... 63   (one of them in each of the 16 columns)
#
# So we add at most 63 rows as float32. Then we split the digits into two int32 of two digits each, which have 12 bits
# for a digit. A descriptor has at most 51^2 = 2601 pixels, so we can add those.
_DIGIT_BITS = 6
_MOST_ROWS = (1 << _DIGIT_BITS) - 1
_EVEN_DIGITS = 63 + (63 << 12)
_COLUMNS = BLOCK_SIZE // 4
# Bound of the relative rounding error of count^2 / energy in float32, by which we find contenders.
_ROUNDING = 2.0**-20
# Pairs that we compare together. With 2^17 a CPU takes a tenth longer, because there are more calls.
_PAIRS_AT_ONCE_CPU = 1 << 19
_PAIRS_AT_ONCE_GPU = 1 << 22
_BYTES_PER_PAIR = 128
# Key points of t whose energies differ by less are compared together, those of other energies apart.
_ENERGY_STEP = 32


@dataclass(frozen=True)
class Matches:
    """Accepted matches, in order of the key points of t."""

    source: Tensor  # (M,) int64, key point of t
    shift: Tensor  # (M, 2) int64, (dy, dx) pixels to the key point of t+1
    score: Tensor  # (M,) float64, NCC of the two descriptors (Eq. descriptor_ncc)


@dataclass(frozen=True)
class Targets:
    """Key points of t+1 in N blocks of 64. We fill up a block with the first key point."""

    blocks: Blocks
    number: Tensor  # (N, 64) int64, key point; 0 where a block is filled up
    row: Tensor  # (N, 64) int32
    col: Tensor  # (N, 64) int32
    energy: Tensor  # (N, 64) float32; infinite, for a score of 0, where a block is filled up
    has_pixel: Tensor  # (N * (L^2 + 1), 16) float32, row b (L^2 + 1) + p: which key points of block b have pixel p


@dataclass(frozen=True)
class Bags:
    """Some key points of t, each with the blocks of t+1 near it. A bag is a key point and a block."""

    source: Tensor  # (S,) int64, key points of t
    of_source: Groups  # N bags in S groups
    block: Tensor  # (N,) int64, block of each bag


@dataclass(frozen=True)
class Pairs:
    """Pairs of a key point of t and one of t+1."""

    source: Tensor  # (P,) int64, key point of t
    target: Tensor  # (P,) int64, key point of t+1
    count: Tensor  # (P,) int64, pixels that are set in both descriptors

    def __getitem__(self, index: Tensor) -> Pairs:
        return Pairs(self.source[index], self.target[index], self.count[index])


def match(pc0: KeyPoints, pc1: KeyPoints, reach: Tensor, config: KeypointsConfig) -> Matches:
    """Find the best match of every key point of t and apply the ratio test (Eq. descriptor_ncc, best_match).

    `reach` is (B,) float64, pixels, the longest distance of a match in each window. We compare scores exactly, as
    count^2 / energy of the candidate. We accept the best match, of score R, if R > rho R' for the second-best score R',
    in integers, or if there is no second candidate. Ties: rejected.

    Cost: time (pairs of a key point and a candidate) x (energy of the key point); memory 2 L^2 bytes per key point.
    """
    ratio = round(config.ratio_threshold * _RATIO_UNIT)
    none = torch.zeros(0, dtype=torch.int64, device=reach.device)
    accepted = [Pairs(none, none, none)]
    if len(pc0) and len(pc1):
        targets = arrange_targets(pc1, config.patch_size**2)
        for bags in make_bags(pc0, targets.blocks, reach, config):
            count = shared_pixels(pc0, bags, targets)  # [N, 64]
            count *= is_within_reach(pc0, bags, targets, reach)
            contenders = find_contenders(bags, targets, count, ratio)
            accepted.append(contenders[passes_ratio_test(contenders, pc1.energy, ratio)])
    source = torch.cat([pairs.source for pairs in accepted])
    source, order = source.sort()
    target = torch.cat([pairs.target for pairs in accepted])[order]
    count = torch.cat([pairs.count for pairs in accepted])[order]
    shift = torch.stack((pc1.row[target] - pc0.row[source], pc1.col[target] - pc0.col[source]), 1)
    energies = pc0.energy[source] * pc1.energy[target]
    return Matches(source, shift, count.double() / energies.double().sqrt())


def arrange_targets(points: KeyPoints, num_pixels: int) -> Targets:
    """Arrange the key points of t+1 and their descriptors, of L^2 = `num_pixels`, by blocks."""
    blocks = make_blocks(points)
    number = blocks.arrange(torch.arange(len(points), device=points.row.device), 0)
    # The last row of each block is zero: it fills up the lists of set pixels of the key points of t.
    has_pixel = points.patch.new_empty((len(blocks), num_pixels + 1, _COLUMNS), dtype=torch.float32)
    has_pixel[:, -1] = 0
    for part in chunks(0, len(blocks), number.device, BLOCK_SIZE * num_pixels // 16):
        digits = points.patch.index_select(0, number[part].flatten()).view(-1, 4, _COLUMNS, num_pixels)
        packed = digits[:, 0].float()
        for digit in range(1, 4):
            packed.add_(digits[:, digit], alpha=1 << (digit * _DIGIT_BITS))
        has_pixel[part, :-1] = packed.transpose(1, 2)
    return Targets(
        blocks=blocks,
        number=number,
        row=blocks.arrange(points.row.int(), 0),
        col=blocks.arrange(points.col.int(), 0),
        energy=blocks.arrange(points.energy.float(), math.inf),
        has_pixel=has_pixel.flatten(0, 1),
    )


def make_bags(points: KeyPoints, blocks: Blocks, reach: Tensor, config: KeypointsConfig) -> Iterator[Bags]:
    """Yield the bags of all key points of t: as many at a time as we compare together."""
    num_pairs = _PAIRS_AT_ONCE_CPU if reach.device.type == "cpu" else _PAIRS_AT_ONCE_GPU
    if config.max_memory is not None:
        num_pairs = min(num_pairs, int(config.max_memory) // _BYTES_PER_PAIR)
    order = (points.energy // _ENERGY_STEP).argsort(stable=True)
    block, num_blocks = near_blocks(points, order, blocks, reach)
    part = (num_blocks.cumsum(0) - num_blocks) // max(1, num_pairs // BLOCK_SIZE)
    groups = Groups(part, int(part[-1]) + 1)
    num_sources, num_bags = torch.stack((groups.size(), groups.sum(num_blocks))).tolist()
    for source, number, near in zip(order.split(num_sources), num_blocks.split(num_sources), block.split(num_bags)):
        if near.numel() == 0:
            continue
        position = torch.arange(source.numel(), device=source.device)
        of_source = torch.repeat_interleave(position, number, output_size=near.numel())
        yield Bags(source, Groups(of_source, source.numel()), near)


def shared_pixels(points: KeyPoints, bags: Bags, targets: Targets) -> Tensor:
    """Count the pixels that the key point of each bag shares with those of its block: (N, 64) int32."""
    num_pixels = points.patch.shape[1]
    energy = points.energy[bags.source]
    most = int(energy.max())
    num_sums = -(-most // _MOST_ROWS)
    length = -(-most // num_sums)
    pixels = list_set_pixels(points.patch.index_select(0, bags.source), energy, length * num_sums)
    rows = pixels.index_select(0, bags.of_source.of_item)  # [N, length * num_sums]
    rows += bags.block[:, None].int() * (num_pixels + 1)
    sums = F.embedding_bag(rows.view(-1, length), targets.has_pixel, mode="sum").int().view(-1, num_sums, _COLUMNS)
    even = (sums & _EVEN_DIGITS).sum(1, dtype=torch.int32)  # [N, 16]
    odd = (sums >> _DIGIT_BITS & _EVEN_DIGITS).sum(1, dtype=torch.int32)
    return torch.cat((even & 0xFFF, odd & 0xFFF, even >> 12, odd >> 12), 1)


def list_set_pixels(patch: Tensor, energy: Tensor, length: int) -> Tensor:
    """List the ones of each row of (S, L^2) uint8: (S, length) int32, filled up with L^2. `energy` counts them."""
    num_points, num_pixels = patch.shape
    is_used = torch.arange(length, device=patch.device) < energy[:, None]
    start = torch.arange(0, patch.numel(), num_pixels, device=patch.device)[:, None]
    pixels = torch.zeros((num_points, length), dtype=torch.int64, device=patch.device)
    pixels.masked_scatter_(is_used, flat_nonzero(patch.bool())).sub_(start)
    return pixels.masked_fill_(~is_used, num_pixels).int()


def is_within_reach(points: KeyPoints, bags: Bags, targets: Targets, reach: Tensor) -> Tensor:
    """Tell which key points of the block of each bag are within reach of its key point: (N, 64) bool."""
    radius = reach[points.window[bags.source]]
    limit = (radius * radius).floor().clamp(max=torch.iinfo(torch.int32).max).int()[:, None]
    row = points.row[bags.source].int()[:, None]
    col = points.col[bags.source].int()[:, None]
    of_source = bags.of_source.of_item
    dy = targets.row.index_select(0, bags.block).sub_(row[of_source])
    dx = targets.col.index_select(0, bags.block).sub_(col[of_source])
    return dy.mul_(dy).addcmul_(dx, dx) <= limit[of_source]


def find_contenders(bags: Bags, targets: Targets, count: Tensor, ratio: int) -> Pairs:
    """Select the pairs whose count^2 / energy, in float32, is not clearly too small for the ratio test."""
    value = count.float()
    value.mul_(value).div_(targets.energy.index_select(0, bags.block))  # [N, 64]
    best = bags.of_source.max(value.amax(1), empty=0)
    share = (_RATIO_UNIT / ratio) ** 2 * (1 - _ROUNDING)
    threshold = bags.of_source.spread(best * share).clamp_(min=2.0**-15)  # > 0
    index = flat_nonzero(value >= threshold[:, None])
    bag = index // BLOCK_SIZE
    source = bags.source[bags.of_source.of_item[bag]]
    target = targets.number[bags.block[bag], index % BLOCK_SIZE]
    return Pairs(source, target, count.flatten()[index].long())


def passes_ratio_test(pairs: Pairs, energies: Tensor, ratio: int) -> Tensor:
    """Find the pairs that are better than `ratio` / 10^4 times all other pairs of their key point of t, (M,) int64.

    `energies`, (K,) int64, are those of the key points of t+1.
    """
    square = pairs.count * pairs.count
    energy = energies[pairs.target]
    value = square.double() / energy  # exact enough to tell any two different fractions apart
    number, of_source = torch.unique(pairs.source, return_inverse=True)
    of_source = Groups(of_source, number.numel())
    is_best = value == of_source.spread(of_source.max(value, empty=0))
    best = flat_nonzero(is_best)
    # If several are best, we take any of them: another one rejects it.
    best_of_source = torch.zeros_like(number).scatter_(0, of_source.of_item[best], best)
    best = best_of_source[of_source.of_item]
    # c1^2 / E1 > rho^2 c2^2 / E2
    is_beaten = square[best] * energy * _RATIO_UNIT**2 > square * energy[best] * ratio**2
    is_rival = ~is_beaten & (best != torch.arange(best.numel(), device=best.device))
    return best_of_source[flat_nonzero(~of_source.any(is_rival))]
