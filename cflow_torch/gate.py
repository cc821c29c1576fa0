"""Which key points of t and t+1 may match: those within the gate of each other.

Key points of t are grouped by small tiles of the image. The key points of t+1 that can lie within the gate of a tile
stand in a few runs of a list that is sorted by band of rows, then by column. Nothing is ever as large as all key points
times all key points.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Iterator, Tuple

import torch
from torch import Tensor

from cflow_torch.batch import Batch
from cflow_torch.config import Config
from cflow_torch.descriptors import KeyPoints
from cflow_torch.grid import Grid
from cflow_torch.ops.indices import flat_nonzero

# Side of a tile and height of a band in pixels, key points in a group.
_TILE = 24
_GROUP = 32
# Candidate lists are padded to the next of these lengths: steps of at most a quarter.
_LENGTHS = tuple(n << k for k in range(28) for n in (8, 10, 12, 14))
# Pairs (key point, candidate) that are looked at together: a CPU wants them in its cache, a GPU wants many.
_PAIRS_AT_ONCE_CPU = 1 << 17
_PAIRS_AT_ONCE_GPU = 1 << 26
# `gate_radius` is the distance that a match may cover in this time.
_GATE_SECONDS = 0.1


def gate(batch: Batch, grid: Grid, config: Config) -> Tensor:
    """(B,) float64, pixels: farthest match of each window, speed times the time from t to t+1."""
    seconds = batch.seconds[:, 1]
    size = torch.full_like(seconds, grid.pixel_size)  # a GPU would multiply by the reciprocal of a plain number
    reach = config.gate_radius * (seconds / torch.full_like(seconds, _GATE_SECONDS)) / size
    if config.max_speed is not None:
        reach = torch.minimum(reach, config.max_speed * seconds / size + 1)
    return reach


@dataclass(frozen=True)
class Pairing:
    """Groups of key points and what they may match.

    Args:
        member: (G, S) int64, key points of each group; padded with their number.
        candidate: (C,) int64, candidates of all groups one after the other.
        first, count: (G,) int64, which of them belong to a group.
        limit: (G,) int32, largest squared distance of a match, pixels.
    """

    member: Tensor
    candidate: Tensor
    first: Tensor
    count: Tensor
    limit: Tensor


def pair(source: KeyPoints, target: KeyPoints, reach: Tensor) -> Pairing:
    """Candidates among `target` of groups of `source`: all within reach of a group's tile, and a few more.

    Args:
        source, target: key points of the same windows, at least one each.
        reach: (B,) float64, pixels.

    Cost: linear in key points plus candidates.
    """
    tiles, member = _group(source)
    return _candidates(tiles, member, target, reach)


def chunks(pairing: Pairing, config: Config) -> Iterator[Tuple[Tensor, int]]:
    """Groups that are looked at together, and the length that their lists of candidates are padded to."""
    lengths = torch.tensor(_LENGTHS, device=pairing.count.device)
    step = torch.searchsorted(lengths, pairing.count)
    step, order = step.masked_fill_(pairing.count == 0, -1).sort(descending=True, stable=True)
    num_pairs = _PAIRS_AT_ONCE_GPU if order.is_cuda else _PAIRS_AT_ONCE_CPU
    if config.max_memory is not None:
        bytes_per_pair = 24 + 5 * config.patch_size**2 // _GROUP
        num_pairs = min(num_pairs, int(config.max_memory) // bytes_per_pair)
    steps, counts = torch.unique_consecutive(step, return_counts=True)
    first = 0
    for index, number in zip(steps.tolist(), counts.tolist()):
        if index >= 0:  # the others have no candidate
            at_once = max(1, num_pairs // (_LENGTHS[index] * _GROUP))
            for groups in order[first : first + number].split(at_once):
                yield groups, _LENGTHS[index]
        first += number


@dataclass(frozen=True)
class _Tiles:
    """Where each group of key points stands: (G,) int64 each, row and column of the tile's first pixel."""

    window: Tensor
    row: Tensor
    col: Tensor


def _group(points: KeyPoints) -> Tuple[_Tiles, Tensor]:
    """Groups of up to `_GROUP` key points of the same tile, (G, _GROUP) int64; padded with K."""
    tile = (points.window << 24) + (points.row // _TILE << 12) + points.col // _TILE
    tile, order = tile.sort(stable=True)
    position = torch.arange(tile.numel(), device=tile.device)
    rank = position - torch.searchsorted(tile, tile)
    starts = rank % _GROUP == 0
    group = starts.cumsum(0) - 1
    first = flat_nonzero(starts)
    members = torch.full((first.numel(), _GROUP), tile.numel(), dtype=torch.int64, device=tile.device)
    members.view(-1).scatter_(0, group * _GROUP + rank % _GROUP, order)
    tile = tile.index_select(0, first)
    return _Tiles(tile >> 24, (tile >> 12 & 0xFFF) * _TILE, (tile & 0xFFF) * _TILE), members


def _candidates(tiles: _Tiles, member: Tensor, points: KeyPoints, reach: Tensor) -> Pairing:
    """For every group the key points that may lie within reach of its tile (all that do, and a few more)."""
    key, order = _band_key(points.window, points.row // _TILE, points.col).sort()
    reach = reach.index_select(0, tiles.window)
    num_bands = min(int(reach.max()) // _TILE + 1, 1 << 11)
    band = torch.arange(-num_bands, num_bands + 1, device=key.device)
    gap = ((band.abs() - 1) * _TILE + 1).clamp(min=0)  # rows between the tile and the band
    square = (reach * reach)[:, None] - gap * gap
    half_width = square.clamp(min=0).sqrt().ceil().clamp(max=1 << 15).long() + 1
    bands = (tiles.row // _TILE)[:, None] + band
    begin = (tiles.col[:, None] - half_width).clamp(min=0)
    end = tiles.col[:, None] + _TILE + half_width
    window = tiles.window[:, None]
    start = torch.searchsorted(key, _band_key(window, bands, begin))
    length = (torch.searchsorted(key, _band_key(window, bands, end)) - start) * (square >= 0)
    count = length.sum(1)
    stop = length.flatten().cumsum(0)
    place = torch.repeat_interleave(start.flatten() - stop + length.flatten(), length.flatten())
    candidate = order.take(place + torch.arange(place.numel(), device=place.device))
    limit = (reach * reach).floor().clamp(max=torch.iinfo(torch.int32).max).int()
    return Pairing(member, candidate, count.cumsum(0) - count, count, limit)


def _band_key(window: Tensor, band: Tensor, col: Tensor) -> Tensor:
    """Sorts by window, band, column; bands may lie up to 2^12 below the image."""
    return (((window << 14) + band + (1 << 12)) << 17) + col
