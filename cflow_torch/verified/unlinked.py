"""Fast objects: link what changed in single sweeps by constant velocity.

An object that moves farther than its own size has other pixels in every sweep, and the components of the tree do not
link them. Here its pixels of one sweep are a part:

    sweep      t-2      t-1       t       t+1
    parts      [a]      [b]      [c]      [d]       c and d, or c and b, give a velocity; the other parts confirm it

In a pair, a part is an unmatched component of t or of t+1, and no sweep confirms its velocity. So it goes with the
nearest part of like size. The linked parts are a node of the tree, like any other. Its velocity is one of its motion
candidates.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from cflow_torch.ops.groups import FAR, Groups
from cflow_torch.ops.indices import constant, divide, flat_nonzero, gather, lazy_zeros, split_index, take_columns
from cflow_torch.ops.medians import masked_median
from cflow_torch.verified.columns import Pixels
from cflow_torch.verified.component_tree import Components, NodeKind, Tree
from cflow_torch.verified.height_slices import HeightSlicedSweeps
from cflow_torch.verified.paired_test import count_wins
from cflow_torch.verified.unmatched import are_unmatched, find_unmatched

# We chose these values on simulated highways, seeds 820 and 821.
_LONGEST = 8.0  # metres, of a part
_CELL = 0.8  # metres, of the map of the parts; a cell holds one part
_NEAR = 2  # cells, around the place where a velocity puts a part
_REACH = 8  # cells; objects that move farther from sweep to sweep are not linked
_ERROR = 0.7  # metres from that place to a part that confirms the velocity, at most, ...
_ERROR_SHARE = 0.05  # ... and further for each metre that the object has moved
_FASTEST = 60.0  # m/s, if the settings have no bound
_LEAST_MOVE = 0.5  # of the length of a part; a shorter motion leaves its pixels linked
_LEAST_SIZE = 16  # of an unmatched component in a pair; smaller ones are mostly static (`confidence.json`)
_LIKE = 2  # in a pair, the larger of two parts has at most this many times as many pixels as the other
_NARROWEST = 0.4  # metres; a thin line that moves along itself may be a part of a longer line


def link_unlinked(sweeps: HeightSlicedSweeps, components: Components, tree: Tree, max_speed: float | None) -> Tree:
    """Add nodes for objects that move farther than their size.

    Args:
        max_speed: m/s; None = 60.

    Convention:
        Parts have the pixels of a sweep that are missing, or of which every other sweep lacks a slice. A part of t
        takes its velocity from one part of t+1 or t-1. Other parts must lie where it puts them: at t+1, and at t-1 or
        in at least half of the older sweeps.
        Of the velocities of a part of t, or of t+1, the one with the smallest errors wins; a sweep without a part has
        the largest error. In a pair, parts are unmatched components, and the lowest velocity wins. A part belongs to
        its first node. The velocity of a node must win more slices near its targets than it loses.

    Cost: 578 lookups for each part of t (289 in a pair), 25 for each sweep and pair of near parts.
    """
    parts = _Parts.of(sweeps, components)
    if len(parts) == 0:
        return tree
    tracks = _tracks(sweeps, parts, _FASTEST if max_speed is None else max_speed)
    objects = _pixels_of(tracks, parts)
    pixels = sweeps.pixels[parts.pixel]
    is_broad = _are_broad(sweeps, pixels, objects, tracks.velocity)
    kept = flat_nonzero(is_broad & _are_found(sweeps, pixels, objects, tracks.velocity))
    objects = objects.select(kept)
    member = flat_nonzero(objects.is_member)
    return tree.with_nodes(
        pixel=parts.pixel.index_select(0, member),
        members=objects[member],
        window=objects.max(pixels.window, empty=0),
        kind=NodeKind.UNLINKED,
        linked_velocity=tracks.velocity.index_select(0, kept),
    )


class _Parts(NamedTuple):
    """Parts: pixels of one sweep that may be fast and lie together. There are Q parts of K pixels."""

    pixel: Tensor  # (K,) int64, positions in the list of pixels
    by_part: Groups  # these K pixels, grouped by part
    window: Tensor  # (Q,) int64
    step: Tensor  # (Q,) int64
    centre: Tensor  # (2, Q) float64, (y, x), finest pixels
    length: Tensor  # (Q,) int64, finest pixels, longer side of the bounding box

    @classmethod
    def of(cls, sweeps: HeightSlicedSweeps, components: Components) -> _Parts:
        """Select the parts of at least two pixels that are at most `_LONGEST` long."""
        pixel = components.fast
        parts = components.parts
        if sweeps.batch.has_pairs:
            unmatched, of_pairs = _unmatched_of_pairs(sweeps, components)
            pixel = torch.cat((pixel, unmatched))
            parts = parts.followed_by(of_pairs)
        pixels = sweeps.pixels[pixel]
        extent = parts.max(pixels.row_col, empty=0) - parts.min(pixels.row_col, empty=FAR)  # [2, count]
        length = extent.amax(0) + 1
        kept = flat_nonzero((length * sweeps.grid.pixel_size <= _LONGEST) & (parts.size() >= 2))
        parts = parts.select(kept)
        image = parts.max(pixels.window * sweeps.num_steps + pixels.step, empty=0)
        window, step = split_index(image, sweeps.num_steps)
        centre = parts.sum(pixels.row_col).double() / parts.size()
        return cls(pixel, parts, window, step, centre, length.index_select(0, kept))

    def __len__(self) -> int:
        return len(self.step)


def _unmatched_of_pairs(sweeps: HeightSlicedSweeps, components: Components) -> tuple[Tensor, Groups]:
    """Return the pixels of large unmatched components of pairs, (K,) int64, and group them by component and sweep."""
    is_of_pair = ~sweeps.has_history.index_select(0, sweeps.pixels.window)
    index = flat_nonzero(is_of_pair)
    pixels = sweeps.pixels[index]  # all of t+1 or t
    is_unmatched = are_unmatched(sweeps, pixels, 1 - pixels.step)
    found = find_unmatched(sweeps, components, index, pixels, is_unmatched, 1)
    large = flat_nonzero(found.size >= _LEAST_SIZE)
    component = found.component[large]
    return index.index_select(0, large), component.select(component.nonempty())


class _Map:
    """A map of each sweep with a part in each cell; of several parts, the last one."""

    def __init__(self, sweeps: HeightSlicedSweeps, parts: _Parts) -> None:
        self._side = sweeps.grid.whole_pixels(_CELL)  # finest pixels
        # A border as wide as the farthest neighbours, so that they need no tests.
        self._lattice = sweeps.grid.lattice(self._side, border=_REACH)
        self._num_steps = sweeps.num_steps
        num_cells = sweeps.batch.num_windows * sweeps.num_steps * self._lattice.area
        number = torch.arange(1, len(parts) + 1, dtype=torch.int32, device=parts.step.device)
        cell = self._cell_of(parts.window, parts.step, parts.centre)
        self._part = lazy_zeros(num_cells, torch.int32, number.device)  # 0 = none
        self._part.scatter_reduce_(0, cell, number, "amax")

    def around(self, window: Tensor, step: Tensor, centre: Tensor, reach: int) -> tuple[Tensor, Tensor]:
        """Return the parts in the cells around places, (..., (2 reach + 1)^2), and whether there is one.

        `centre` is (2, ...), finest pixels, `window` and `step` are (...).
        """
        cell = self._cell_of(window, step, centre)[..., None] + self._lattice.square(reach, centre.device)[:, 0]
        part = self._part.index_select(0, cell.view(-1)).view_as(cell)
        return (part - 1).clamp_(min=0).long(), part > 0

    def _cell_of(self, window: Tensor, step: Tensor, centre: Tensor) -> Tensor:
        """Return the cells of places; the nearest cells for places outside of the region."""
        row, col = divide(centre, self._side).floor_().long()
        row = row.clamp_(0, self._lattice.height - 1)
        col = col.clamp_(0, self._lattice.width - 1)
        return self._lattice.cell(window * self._num_steps + step, row, col)


@dataclass(frozen=True)
class _Tracks:
    """N velocities, each of a part of t, with the parts that confirm it."""

    part: Tensor  # (N, S) int64, the nearest part of each sweep; of t, the part itself
    is_found: Tensor  # (N, S) bool, the part is near enough
    velocity: Tensor  # (N, 2) float64, (y, x), finest pixels per sweep interval, median over the parts


def _tracks(sweeps: HeightSlicedSweeps, parts: _Parts, max_speed: float) -> _Tracks:
    """Follow the velocity from each part of t to each near part of t+1 and of t-1, and keep the best velocities."""
    cells = _Map(sweeps, parts)
    of_t, other = _pairs(sweeps, parts, cells, max_speed)  # [H] each
    window = parts.window.index_select(0, of_t)
    before_t = sweeps.elapsed.index_select(0, window) - 1  # [H, S], sweep intervals to t
    interval = before_t.gather(1, parts.step.index_select(0, other)[:, None])[:, 0]
    centre = take_columns(parts.centre, of_t)
    velocity = (centre - take_columns(parts.centre, other)) / interval  # [2, H]
    expected = centre[..., None] - velocity[..., None] * before_t  # [2, H, S]
    part, error = _follow(parts, cells, of_t, expected)  # [H, S] each
    moved = velocity.square().sum(0).sqrt()[:, None] * before_t.abs()  # [H, S]
    is_found, cost = _judge(sweeps, window, error, moved)
    kept = flat_nonzero(_are_best(cost, part, len(parts)))
    part, is_found, before_t = gather(kept, part, is_found, before_t)
    return _Tracks(part, is_found, _median_velocity(parts, part, is_found, before_t))


def _judge(sweeps: HeightSlicedSweeps, window: Tensor, error: Tensor, moved: Tensor) -> tuple[Tensor, Tensor]:
    """Tell which sweeps confirm H velocities, and what these cost.

    Args:
        window: (H,) int64.
        error: (H, S) float64, finest pixels, from where the velocity puts the part to the nearest part of each sweep.
        moved: (H, S) float64, finest pixels, how far the part moves between t and each sweep.

    Returns:
        is_found: (H, S) bool, the nearest part is near enough.
        cost: (H,) float64, the lowest is the best: the sum of the squares of errors, as parts of the largest error that
            confirms the velocity, each at most 1. In a pair, all errors are 0, and the cost is the distance. It is
            infinite without a part at t+1, or with none at t-1 and in less than half of the older sweeps.
    """
    is_given = sweeps.is_given.index_select(0, window)
    limit = _ERROR / sweeps.grid.pixel_size + _ERROR_SHARE * moved
    is_found = is_given & (error <= limit)
    is_in_half = 2 * is_found[:, 2:].sum(1) >= is_given[:, 2:].sum(1)
    is_confirmed = is_found[:, 0] & (is_found[:, 2:3].any(1) | is_in_half)
    cost = moved[:, 0] * ~sweeps.has_history.index_select(0, window)
    # One after the other: sweeps that the window lacks would change the last bits of a sum over a row.
    for of_sweep in ((error / limit).square().clamp(max=1.0) * is_given).unbind(1):
        cost = cost + of_sweep
    return is_found, cost.masked_fill(~is_confirmed, math.inf)


def _follow(parts: _Parts, cells: _Map, of_t: Tensor, expected: Tensor) -> tuple[Tensor, Tensor]:
    """Find the nearest part of each sweep to where a velocity puts a part of t, and its distance, (H, S) each.

    `of_t` is (H,), and `expected`, (2, H, S), finest pixels, is where the velocity puts the part. In t, the nearest
    part is the part itself, and the distance is 0. Without a part near, the distance is infinite.
    """
    step = torch.arange(expected.shape[2], device=of_t.device).expand(expected.shape[1:])
    window = parts.window.index_select(0, of_t)[:, None].expand_as(step)
    part, is_part = cells.around(window, step, expected, _NEAR)  # [H, S, 25]
    square = (_centres(parts, part) - expected[..., None]).square_().sum(0).masked_fill_(~is_part, math.inf)
    nearest, index = square.min(2)  # [H, S]
    part = part.gather(2, index[..., None])[..., 0]
    part[:, 1] = of_t
    nearest[:, 1] = 0.0
    return part, nearest.sqrt_()


def _median_velocity(parts: _Parts, part: Tensor, is_found: Tensor, before_t: Tensor) -> Tensor:
    """Return the median of the velocities between the part of t and the parts found in other sweeps, (H, 2) float64."""
    centre = _centres(parts, part)  # [2, H, S]
    velocity = ((centre[..., 1:2] - centre) / before_t).permute(1, 2, 0)  # undefined at t
    is_counted = is_found & (before_t != 0)
    return masked_median(velocity.masked_fill(~is_counted[..., None], 0.0), is_counted)


def _centres(parts: _Parts, part: Tensor) -> Tensor:
    """(2, ...) float64, centres of parts, (...)."""
    return take_columns(parts.centre, part.reshape(-1)).view(2, *part.shape)


def _pairs(sweeps: HeightSlicedSweeps, parts: _Parts, cells: _Map, max_speed: float) -> tuple[Tensor, Tensor]:
    """Pair each part of t with the parts of t+1 and of t-1 that are neither too near nor too far: (H,) int64 each."""
    of_t = flat_nonzero(parts.step == 1)
    steps = ((0,), (2,)) if sweeps.num_steps > 2 else ((0,),)
    step = constant(steps, torch.int64, of_t.device).expand(-1, len(of_t))
    window = parts.window.index_select(0, of_t).expand_as(step)
    centre = take_columns(parts.centre, of_t)
    other, is_part = cells.around(window, step, centre[:, None].expand(2, *step.shape), _REACH)  # [steps, of t, 289]
    distance = (_centres(parts, other) - centre[:, None, :, None]).square_().sum(0).sqrt_()
    seconds = (sweeps.batch.seconds - sweeps.batch.seconds[:, 1:2]).abs()[window, step]
    farthest = divide(max_speed * seconds, sweeps.grid.pixel_size) + 1
    nearest = _LEAST_MOVE * parts.length.index_select(0, of_t)
    is_pair = is_part & (distance <= farthest[..., None]) & (distance >= nearest[:, None])
    if sweeps.batch.has_pairs:
        is_pair &= _are_alike(sweeps, parts, of_t, other)
    pair = flat_nonzero(is_pair)
    at, _ = split_index(pair, other.shape[2])
    return of_t.repeat(len(steps)).index_select(0, at), other.view(-1).index_select(0, pair)


def _are_alike(sweeps: HeightSlicedSweeps, parts: _Parts, of_t: Tensor, other: Tensor) -> Tensor:
    """Tell which other parts, (..., N, M), are of like size as N parts of t, if the window is a pair. Else all are."""
    size = parts.by_part.size()
    size_at_t = size.index_select(0, of_t)[:, None]
    size = size.index_select(0, other.view(-1)).view_as(other)
    is_like = (size <= _LIKE * size_at_t) & (size_at_t <= _LIKE * size)
    return is_like | sweeps.has_history.index_select(0, parts.window.index_select(0, of_t))[:, None]


def _are_best(cost: Tensor, part: Tensor, num_parts: int) -> Tensor:
    """Tell which tracks, (H,), have the lowest cost of their part of t and of their part of t+1. Ties: the first."""
    is_best = cost < math.inf
    for step in (1, 0):
        same = Groups(part[:, step], num_parts)
        is_best &= cost == same.spread(same.min(cost, empty=math.inf))
    same = Groups(part[:, 1], num_parts).where(is_best)
    first = same.spread(same.first(), none=-1)
    return first == torch.arange(len(first), device=first.device)


def _pixels_of(tracks: _Tracks, parts: _Parts) -> Groups:
    """Group the K pixels of the parts by track."""
    count = len(tracks.part)
    track = torch.arange(count, device=tracks.part.device)[:, None].expand_as(tracks.part)
    of_track = Groups(tracks.part.reshape(-1), len(parts)).where(tracks.is_found.reshape(-1))
    first_track = of_track.min(track.reshape(-1), empty=count)  # [Q]
    return Groups(parts.by_part.spread(first_track, none=count), count)


def _are_broad(sweeps: HeightSlicedSweeps, pixels: Pixels, objects: Groups, velocity: Tensor) -> Tensor:
    """Tell which objects are wide enough across their motion, (N,) bool."""
    speed = velocity.square().sum(1).sqrt().clamp(min=1)
    across = (velocity / speed[:, None]).flip(1) * constant((1.0, -1.0), torch.float64, speed.device)  # [N, 2]
    side = (objects.spread(across).t() * pixels.row_col).sum(0)
    width = objects.max(side, empty=-math.inf) - objects.min(side, empty=math.inf)
    return width * sweeps.grid.pixel_size >= _NARROWEST


def _are_found(sweeps: HeightSlicedSweeps, pixels: Pixels, objects: Groups, velocity: Tensor) -> Tensor:
    """Tell which objects win more slices near their targets than they lose, (N,) bool.

    The exact test of their velocities follows (`verify`). This one rejects most links between plants, whose long boxes
    would otherwise be correlated.
    """
    member = flat_nonzero(objects.is_member)
    near = count_wins(sweeps, pixels[member], objects[member], velocity[:, None]).near
    return (near.won > near.lost)[:, 0]
