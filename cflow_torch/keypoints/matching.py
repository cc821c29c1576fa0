"""Match key points by normalised correlation, all windows at once (Sec. Matching keypoints).

Most pixels of a descriptor are empty. So we do not multiply descriptors. For each set pixel of a key point of t, we add
a row of a table, which says which key points of a block of t+1 have this pixel, too. The sum counts the pixels that the
key point shares with each of the 64 key points of the block. Few of them score close to the best one; we compare only
those exactly.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Iterator, NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from cflow_torch.config import KeypointsConfig
from cflow_torch.keypoints.match_candidates import (
    BLOCK_SIZE,
    KeypointBlocks,
    KeyPoints,
    Patches,
    make_blocks,
    near_blocks,
)
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
class KeypointMatches:
    """Accepted matches, in order of the key points of t."""

    source: Tensor  # (M,) int64, key point of t
    shift: Tensor  # (M, 2) int64, (dy, dx) pixels to the key point of t+1
    score: Tensor  # (M,) float64, NCC of the two descriptors (Eq. descriptor_ncc)


@dataclass(frozen=True)
class Targets:
    """Key points of t+1 in N blocks of 64. We fill up a block with the first key point."""

    blocks: KeypointBlocks
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


class Pairs(NamedTuple):
    """Pairs of a key point of t and one of t+1."""

    source: Tensor  # (P,) int64, key point of t
    target: Tensor  # (P,) int64, key point of t+1
    shared: Tensor  # (P,) int64, pixels that are set in both descriptors

    def at(self, index: Tensor) -> Pairs:
        """Select pairs, (K,) int64."""
        return Pairs(self.source[index], self.target[index], self.shared[index])


def match_keypoints(pc0: KeyPoints, pc1: KeyPoints, reach: Tensor, config: KeypointsConfig) -> KeypointMatches:
    """Find the best match of every key point of t and apply the ratio test (Eq. descriptor_ncc, best_match).

    `reach` is (B,) float64, pixels, the longest distance of a match in each window. We compare scores exactly, as
    count^2 / energy of the candidate. We accept the best match, of score R, if R > rho R' for the second-best score R',
    in integers, or if there is no second candidate. Ties: rejected.

    Cost: time (pairs of a key point and a candidate) x (energy of the key point); memory L^2 bytes per key point of
    t+1.
    """
    ratio = round(config.ratio_threshold * _RATIO_UNIT)
    accepted = [Pairs(*torch.zeros((3, 0), dtype=torch.int64, device=reach.device))]
    if len(pc0) and len(pc1):
        targets = arrange_targets(pc1)
        for bags in make_bags(pc0, targets.blocks, reach, config):
            count = shared_pixels(pc0, bags, targets)  # [N, 64]
            count *= is_within_reach(pc0, bags, targets, reach)
            contenders = find_contenders(bags, targets, count, ratio)
            accepted.append(contenders.at(passes_ratio_test(contenders, pc1.energy, ratio)))
    pairs = Pairs(*(torch.cat(column) for column in zip(*accepted)))
    return _matches(pairs.at(pairs.source.argsort()), pc0, pc1)


def _matches(pairs: Pairs, pc0: KeyPoints, pc1: KeyPoints) -> KeypointMatches:
    """Return the shifts and scores of accepted pairs."""
    source, target, shared = pairs
    dy = pc1.row[target] - pc0.row[source]
    dx = pc1.col[target] - pc0.col[source]
    energies = pc0.energy[source] * pc1.energy[target]
    return KeypointMatches(
        source=source,
        shift=torch.stack((dy, dx), 1),
        score=shared.double() / energies.double().sqrt(),
    )


def arrange_targets(points: KeyPoints) -> Targets:
    """Arrange the key points of t+1 and their descriptors by blocks."""
    blocks = make_blocks(points)
    number = blocks.arrange(torch.arange(len(points), device=points.row.device), 0)
    return Targets(
        blocks=blocks,
        number=number,
        row=blocks.arrange(points.row.int(), 0),
        col=blocks.arrange(points.col.int(), 0),
        energy=blocks.arrange(points.energy.float(), math.inf),
        has_pixel=_pixel_table(points.patches, number),
    )


def _pixel_table(patches: Patches, number: Tensor) -> Tensor:
    """Return `Targets.has_pixel` of the key points of N blocks, (N, 64) int64."""
    # The last row of each block is zero: it fills up the lists of set pixels of the key points of t.
    table = torch.empty((len(number), patches.num_pixels + 1, _COLUMNS), device=number.device)
    table[:, -1] = 0
    for part in chunks(0, len(number), number.device, BLOCK_SIZE * patches.num_pixels // 16):
        digits = patches[number[part].flatten()].view(-1, 4, _COLUMNS, patches.num_pixels)
        packed = digits[:, 0].float()  # [blocks, 16, L^2]
        for digit in range(1, 4):
            packed.add_(digits[:, digit], alpha=1 << (digit * _DIGIT_BITS))
        table[part, :-1] = packed.transpose(1, 2)
    return table.flatten(0, 1)


def make_bags(points: KeyPoints, blocks: KeypointBlocks, reach: Tensor, config: KeypointsConfig) -> Iterator[Bags]:
    """Yield the bags of all key points of t: as many at a time as we compare together."""
    order = (points.energy // _ENERGY_STEP).argsort(stable=True)
    block, num_blocks = near_blocks(points, order, blocks, reach)
    part = (num_blocks.cumsum(0) - num_blocks) // _bags_at_once(reach.device, config)
    parts = Groups(part, int(part[-1]) + 1)
    num_sources, num_bags = torch.stack((parts.size(), parts.sum(num_blocks))).tolist()
    columns = (order.split(num_sources), num_blocks.split(num_sources), block.split(num_bags))
    for source, blocks_of_source, near in zip(*columns):
        if near.numel() > 0:
            position = torch.arange(source.numel(), device=source.device)
            of_source = torch.repeat_interleave(position, blocks_of_source, output_size=near.numel())
            yield Bags(source, Groups(of_source, source.numel()), near)


def _bags_at_once(device: torch.device, config: KeypointsConfig) -> int:
    """Return how many bags we compare together."""
    num_pairs = _PAIRS_AT_ONCE_CPU if device.type == "cpu" else _PAIRS_AT_ONCE_GPU
    if config.max_memory is not None:
        num_pairs = min(num_pairs, int(config.max_memory) // _BYTES_PER_PAIR)
    return max(1, num_pairs // BLOCK_SIZE)


def shared_pixels(points: KeyPoints, bags: Bags, targets: Targets) -> Tensor:
    """Count the pixels that the key point of each bag shares with those of its block: (N, 64) int32."""
    pixels = list_set_pixels(points.patches[bags.source], points.energy[bags.source])
    num_sums, num_sources, length = pixels.shape
    # Copying rows of one flat table is faster than selecting along the second axis.
    first = torch.arange(0, num_sums * num_sources, num_sources, device=pixels.device)[:, None]
    rows = pixels.flatten(0, 1).index_select(0, (first + bags.of_source.of_item).flatten())
    rows = rows.view(num_sums, -1, length)  # [sums, N, length], pixels
    rows += bags.block[:, None].int() * (points.patches.num_pixels + 1)  # rows of `has_pixel`
    sums = F.embedding_bag(rows.view(-1, length), targets.has_pixel, mode="sum")
    return _total_of_digits(sums.int().view(num_sums, -1, _COLUMNS))


def _total_of_digits(sums: Tensor) -> Tensor:
    """Add up sums of rows of `has_pixel`, (sums, N, 16) int32, and split the digits: (N, 64) int32."""
    even = (sums & _EVEN_DIGITS).sum(0, dtype=torch.int32)  # [N, 16]
    odd = (sums.sum(0, dtype=torch.int32) - even) >> _DIGIT_BITS
    return torch.cat((even & 0xFFF, odd & 0xFFF, even >> 12, odd >> 12), 1)


def list_set_pixels(patch: Tensor, energy: Tensor) -> Tensor:
    """List the ones of each row of (S, L^2) uint8 in a few parts of equal length: (parts, S, length) int32.

    `energy`, (S,) int64, counts them. The lists are filled up with L^2. A part has at most 63 ones.
    """
    num_points, num_pixels = patch.shape
    most = int(energy.max())
    num_parts = -(-most // _MOST_ROWS)
    length = -(-most // num_parts)
    start = torch.arange(0, patch.numel(), num_pixels, device=patch.device)[:, None]
    pixels = (start + num_pixels).repeat(1, num_parts * length)
    is_used = torch.arange(num_parts * length, device=patch.device) < energy[:, None]
    pixels.masked_scatter_(is_used, flat_nonzero(patch.view(torch.bool))).sub_(start)
    return pixels.int().view(num_points, num_parts, length).transpose(0, 1).contiguous()


def is_within_reach(points: KeyPoints, bags: Bags, targets: Targets, reach: Tensor) -> Tensor:
    """Tell which key points of the block of each bag are within reach of its key point: (N, 64) bool."""
    radius = reach[points.window[bags.source]]
    limit = (radius * radius).floor().clamp(max=torch.iinfo(torch.int32).max).int()
    of_source = bags.of_source.of_item
    row = points.row[bags.source].int()[of_source]
    col = points.col[bags.source].int()[of_source]
    dy = targets.row.index_select(0, bags.block).sub_(row[:, None])
    dx = targets.col.index_select(0, bags.block).sub_(col[:, None])
    return dy.mul_(dy).addcmul_(dx, dx) <= limit[of_source, None]


def find_contenders(bags: Bags, targets: Targets, count: Tensor, ratio: int) -> Pairs:
    """Select the pairs whose count^2 / energy, in float32, is not clearly too small for the ratio test."""
    value = count.float()
    value.mul_(value).div_(targets.energy.index_select(0, bags.block))  # [N, 64]
    best = bags.of_source.max(value.amax(1), empty=0)
    share = (_RATIO_UNIT / ratio) ** 2 * (1 - _ROUNDING)
    threshold = bags.of_source.spread(best * share).clamp_(min=2.0**-15)  # > 0
    index = flat_nonzero(value >= threshold[:, None])
    bag = index // BLOCK_SIZE
    return Pairs(
        source=bags.source[bags.of_source.of_item[bag]],
        target=targets.number[bags.block[bag], index % BLOCK_SIZE],
        shared=count.flatten()[index].long(),
    )


def passes_ratio_test(pairs: Pairs, energies: Tensor, ratio: int) -> Tensor:
    """Find the pairs that are better than `ratio` / 10^4 times all other pairs of their key point of t, (M,) int64.

    `energies`, (K,) int64, are those of the key points of t+1.
    """
    square = pairs.shared * pairs.shared
    energy = energies[pairs.target]
    number, source = torch.unique(pairs.source, return_inverse=True)
    of_source = Groups(source, number.numel())
    best_of_source = _best_of_groups(square.double() / energy, of_source)
    best = best_of_source[source]  # pair with which each pair competes
    # c1^2 / E1 > rho^2 c2^2 / E2
    is_beaten = square[best] * energy * _RATIO_UNIT**2 > square * energy[best] * ratio**2
    is_rival = ~is_beaten & (best != torch.arange(best.numel(), device=best.device))
    return best_of_source[flat_nonzero(~of_source.any(is_rival))]


def _best_of_groups(value: Tensor, groups: Groups) -> Tensor:
    """Return a pair with the largest value of each group, (G,) int64, all of which have pairs.

    `value`, (P,) float64, is count^2 / energy, exact enough to tell any two different fractions apart. If several are
    best, we take any of them, because another one rejects it.
    """
    best = flat_nonzero(value == groups.spread(groups.max(value, empty=0)))
    of_group = torch.zeros(groups.count, dtype=torch.int64, device=value.device)
    return of_group.scatter_(0, groups.of_item[best], best)
