"""Key points, their descriptors, and match candidates: the key points of t+1 within a radius of a key point of t.

We group the key points of t by small tiles of the image. The key points of t+1 are sorted by band of rows, then by
column, so those within the radius of a group are a few ranges of this list. No tensor ever holds all pairs of key
points of t and t+1.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Iterator

import torch
import torch.nn.functional as F
from torch import Tensor

from cflow_torch.config import KeypointsConfig
from cflow_torch.ops.indices import concat_ranges, flat_nonzero, gather, index_in_group, split_index
from cflow_torch.ops.morphology import erode_cross
from cflow_torch.windows.collation import Batch

# Rows and columns of a tile, rows of a band, key points in a group. We tried several tiles and bands for groups of 16.
# These give the fewest pairs (key point, candidate): on the AV2 pair, 1.55 times the number within the radius. Groups
# of 8 have fewer pairs, but fetch twice as many descriptors per pair.
_TILE_ROWS, _TILE_COLS = 12, 64
_BAND = 4
_GROUP = 16
# Pairs that we compare together. They should fit the cache of a CPU; a GPU needs many.
_PAIRS_AT_ONCE_CPU = 1 << 17
_PAIRS_AT_ONCE_GPU = 1 << 26
_BYTES_PER_PAIR = 64
# Lists of candidates that we compare together are padded to the longest one, rounded up to a multiple of this.
_LENGTH_STEP = 8
# `gate_radius` is the longest distance of a match between sweeps that are this many seconds apart.
_GATE_SECONDS = 0.1


@dataclass(frozen=True)
class KeyPoints:
    """Key points of one sweep of every window, in order of window, row and column."""

    pixel: Tensor  # (K,) int64, flat indices into the images, ascending
    window: Tensor  # (K,) int64
    row: Tensor  # (K,) int64, row in the image of the window
    col: Tensor  # (K,) int64, column in the image of the window
    patch: Tensor  # (K, L * L) uint8, zeros and ones
    energy: Tensor  # (K,) int64, number of ones, at least 1


def detect(occupancy: Tensor) -> Tensor:
    """Find the key points of (..., H, W) bool images: set pixels at distance 1 from the background or the outside."""
    return occupancy & ~erode_cross(occupancy)


def describe(images: Tensor, patch_size: int) -> KeyPoints:
    """Find the key points of one sweep per window, and describe each by the L x L pixels around it (Sec. Descriptor).

    The images are (B, H, W) bool; patches are zero outside. Cost: K L^2 bytes, written one row of a patch at a time.
    """
    pixel = flat_nonzero(detect(images))
    line, col = split_index(pixel, images.shape[2])
    window, row = split_index(line, images.shape[1])
    half = patch_size // 2
    padded = F.pad(images.byte(), (half, half, half, half))
    _, height, width = padded.shape
    runs = padded.flatten().unfold(0, patch_size, 1)  # a view: `patch_size` pixels, starting at each pixel
    first = (window * height + row) * width + col
    rows = (first[:, None] + torch.arange(patch_size, device=images.device) * width).flatten()
    patches = runs.index_select(0, rows).view(-1, patch_size * patch_size)
    # A sum over the patches would write them again as integers, so we take differences of running sums of the images.
    sums = F.pad(padded.flatten().cumsum(0, dtype=torch.int32), (1, 0))
    energy = (sums[patch_size:] - sums[:-patch_size]).index_select(0, rows).view(-1, patch_size).sum(1)
    return KeyPoints(pixel, window, row, col, patches, energy)


def match_radius(batch: Batch, pixel_size: float, config: KeypointsConfig) -> Tensor:
    """(B,) float64, pixels: longest distance of a match in each window, by `gate_radius` and `max_speed`."""
    seconds = batch.seconds[:, 1]
    size = torch.full_like(seconds, pixel_size)  # a GPU would multiply by the reciprocal of a Python number
    reach = config.gate_radius * (seconds / torch.full_like(seconds, _GATE_SECONDS)) / size
    if config.max_speed is not None:
        reach = torch.minimum(reach, config.max_speed * seconds / size + 1)
    return reach


@dataclass(frozen=True)
class Pairing:
    """Groups of key points and their match candidates. The groups with the most candidates come first."""

    member: Tensor  # (G, S) int64, key points of each group, padded with the number of key points
    candidate: Tensor  # (C,) int64, candidates of all groups, one group after the other
    first: Tensor  # (G,) int64, start of the range of `candidate` that belongs to each group
    count: Tensor  # (G,) int64, length of that range
    limit: Tensor  # (G,) int32, largest squared distance of a match, pixels


def pair(source: KeyPoints, target: KeyPoints, reach: Tensor) -> Pairing:
    """Group the key points of `source`, and find the candidates of each group: all key points of `target` within
    `reach`, (B,) float64 pixels, of a key point of the group, and some farther ones."""
    key, order = _band_key(target.window, target.row // _BAND, target.col).sort()
    groups = _group(source)
    window = source.window.take(groups[:, :1])
    member = torch.where(groups == source.row.numel(), groups[:, :1], groups)
    (top, bottom), (left, right) = (
        values.take(member).aminmax(dim=1, keepdim=True) for values in (source.row, source.col)
    )
    reach = reach.take(window)
    num_bands = min((2 * int(reach.max()) + _TILE_ROWS) // _BAND + 2, 1 << 13)
    band = (top - reach.long()).clamp_(min=0) // _BAND + torch.arange(num_bands, device=key.device)
    gap = torch.maximum(top - (band * _BAND + _BAND - 1), band * _BAND - bottom).clamp_(min=0)
    square = reach * reach - gap * gap
    half_width = square.clamp(min=0).sqrt().ceil().clamp(max=1 << 15).long()
    start = torch.searchsorted(key, _band_key(window, band, (left - half_width).clamp(min=0)))
    end = torch.searchsorted(key, _band_key(window, band, right + half_width + 1))
    length = (end - start).mul_(square >= 0)
    candidate = order.index_select(0, concat_ranges(start.flatten(), length.flatten()))
    limit = (reach * reach).floor().clamp(max=torch.iinfo(torch.int32).max - 1).int()[:, 0]
    count = length.sum(1)
    first = count.cumsum(0) - count
    count, order = count.sort(descending=True)
    groups, first, limit = gather(order, groups, first, limit)
    return Pairing(groups, candidate, first, count, limit)


def pairs_at_once(device: torch.device, max_memory: float | None) -> int:
    """Number of pairs (key point, candidate) that we compare together."""
    number = _PAIRS_AT_ONCE_CPU if device.type == "cpu" else _PAIRS_AT_ONCE_GPU
    return number if max_memory is None else min(number, int(max_memory) // _BYTES_PER_PAIR)


def chunks(pairing: Pairing, num_pairs: int) -> Iterator[tuple[slice, int]]:
    """Yield ranges of groups that we compare together, and the length to which we pad their lists of candidates."""
    counts = pairing.count.tolist()
    begin = 0
    while begin < len(counts) and counts[begin] > 0:  # the remaining groups have no candidate
        length = -(-counts[begin] // _LENGTH_STEP) * _LENGTH_STEP
        end = begin + max(1, num_pairs // (length * _GROUP))
        yield slice(begin, end), length
        begin = end


def _group(points: KeyPoints) -> Tensor:
    """(G, _GROUP) int64, groups of key points of one tile each, in order of columns; padded with K."""
    tile = (points.window << 24) + (points.row // _TILE_ROWS << 12) + points.col // _TILE_COLS
    tile, order = ((tile << 16) + points.col).sort(stable=True)
    tile >>= 16
    slot = index_in_group(tile) % _GROUP
    group = (slot == 0).cumsum(0) - 1
    member = torch.full((int(group[-1]) + 1, _GROUP), tile.numel(), dtype=torch.int64, device=tile.device)
    member.view(-1).scatter_(0, group * _GROUP + slot, order)
    return member


def _band_key(window: Tensor, band: Tensor, col: Tensor) -> Tensor:
    """A key that sorts by window, band, column. Bands may lie up to 2^13 below the image."""
    return (((window << 16) + band) << 17) + col
