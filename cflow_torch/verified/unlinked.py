"""Fast objects: link what changed in single sweeps by constant velocity.

An object that moves farther than its own size has other pixels in every sweep, and the components of the tree do not
link them. Here its pixels of one sweep are a part:

    sweep      t-2      t-1       t       t+1
    parts      [a]      [b]      [c]      [d]       c and d, or c and b, give a velocity; the other parts confirm it

The linked parts are a node of the tree, like any other. Its velocity is one of its motion candidates.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from cflow_torch.ops.groups import FAR, Groups
from cflow_torch.ops.indices import constant, flat_nonzero, floor_divide, gather, lazy_zeros, split_index, take_columns
from cflow_torch.ops.labeling import label_together, padded_size
from cflow_torch.ops.segments import masked_median
from cflow_torch.verified.changed_pixels import ChangedPixels
from cflow_torch.verified.component_tree import Components, NodeKind, Tree, draw_level
from cflow_torch.verified.height_slices import HeightSlicedSweeps

# We chose these values on simulated highways, seeds 820 and 821.
_GAP = 0.4  # metres; nearer pixels of a sweep are the same part
_LONGEST = 8.0  # metres, of a part
_CELL = 0.8  # metres, of the map of the parts; a cell holds one part
_NEAR = 2  # cells, around the place where the velocity puts a part
_FARTHEST = 0.7  # metres from that place to a part that confirms the velocity, ...
_FARTHER = 0.05  # ... and further for each metre that the object has moved
_FASTEST = 60.0  # m/s, if the settings have no bound
_SLOWEST = 0.3  # metres from part to part; slower objects have components of their own
_NARROWEST = 0.4  # metres; a thin line that moves along itself may be a part of a longer line


def link_unlinked(
    sweeps: HeightSlicedSweeps, components: Components, change: ChangedPixels, tree: Tree, max_speed: float | None
) -> Tree:
    """Add nodes for objects that move farther than their size.

    Args:
        max_speed: m/s; None = 60.

    Convention:
        Parts have the missing pixels of a sweep, and in pairs those of components that are not linked. A part of t
        takes its velocity from one part of t+1 or t-1. Other parts must lie where it puts them: at t+1, and in at least
        half of the older sweeps. Of velocities that share the part of t or of t+1, the one with the most
        sweeps wins, then the one with the smallest errors; in pairs, the slowest. A part belongs to its first node.

    Cost: one labelling of the changed pixels, and 25 lookups for each sweep and pair of near parts.
    """
    parts = _Parts.of(sweeps, components, change)
    if len(parts) == 0:
        return tree
    tracks = _best_tracks(_all_tracks(sweeps, parts, _FASTEST if max_speed is None else max_speed), len(parts))
    objects = _pixels_of(tracks, parts)
    kept = flat_nonzero(_are_wide(sweeps, objects, tracks.velocity))
    objects = objects.select(kept)
    member = flat_nonzero(objects.is_member)
    window = objects.max(sweeps.pixels.window, empty=0)
    no_parents = Groups(torch.full_like(window, objects.count), objects.count)
    return Tree(
        pixel=torch.cat((tree.pixel, member)),
        members=tree.members.followed_by(objects[member]),
        children=tree.children.followed_by(no_parents),
        kind=torch.cat((tree.kind, torch.full_like(window, NodeKind.UNLINKED))),
        window=torch.cat((tree.window, window)),
        travels=torch.cat((tree.travels, torch.zeros_like(window, dtype=torch.bool))),
        velocity=torch.cat((tree.velocity, tracks.velocity.index_select(0, kept))),
        num_levels=tree.num_levels,
    )


class _Parts(NamedTuple):
    """Q parts: pixels of one sweep that changed and lie together."""

    pixels: Groups  # the P pixels, grouped by part
    window: Tensor  # (Q,) int64
    step: Tensor  # (Q,) int64
    centre: Tensor  # (2, Q) float64, (y, x), finest pixels

    @classmethod
    def of(cls, sweeps: HeightSlicedSweeps, components: Components, change: ChangedPixels) -> _Parts:
        """Group the pixels. A part has at least two, and is at most `_LONGEST` long."""
        pixels = sweeps.pixels
        scale = components.levels[max(len(components.levels) - 3, 0)]  # the finest but one
        is_unlinked = scale.spread(~components.is_linked) & scale.is_member
        has_history = sweeps.has_history.index_select(0, pixels.window)
        changed = flat_nonzero(torch.where(has_history, change.is_missing, is_unlinked))
        image = pixels.window * sweeps.num_steps + pixels.step
        label, count = _label(sweeps, changed, image)
        parts = Groups(torch.full_like(image, count).index_copy_(0, changed, label), count)
        row_col = pixels.row_col
        extent = parts.max(row_col, empty=0) - parts.min(row_col, empty=FAR)  # [2, count]
        is_short = extent.amax(0) * sweeps.grid.pixel_size <= _LONGEST
        parts = parts.only(is_short & (parts.size() >= 2))
        window, step = split_index(parts.max(image, empty=0), sweeps.num_steps)
        return cls(parts, window, step, parts.sum(row_col).double() / parts.size())

    def __len__(self) -> int:
        return len(self.step)


def _label(sweeps: HeightSlicedSweeps, changed: Tensor, image: Tensor) -> tuple[Tensor, int]:
    """Label pixels of each sweep, (K,) int64, at a scale of `_GAP`: (K,) int64, and a number above the largest label.

    `image` is the sweep of each pixel of the list, counted through all windows.
    """
    block = max(1, round(_GAP / sweeps.grid.pixel_size))
    height = -(-sweeps.grid.height // block)
    width = -(-sweeps.grid.width // block)
    row, col = floor_divide(take_columns(sweeps.pixels.row_col, changed), block)
    row = row + image.index_select(0, changed) * padded_size(height)
    drawn = draw_level(row, col, sweeps.batch.num_windows * sweeps.num_steps, height, width)
    (blocks,) = label_together([(drawn, 1)])
    return blocks.of_pixel(row, col), blocks.num_components


class _Map:
    """A map of each sweep with a part in each cell; of several parts, any one."""

    def __init__(self, sweeps: HeightSlicedSweeps, parts: _Parts, farthest: float) -> None:
        grid = sweeps.grid
        self.cell = max(1, round(_CELL / grid.pixel_size))  # finest pixels
        # An empty border as wide as the farthest neighbours, so that they need no tests.
        self.border = max(_NEAR, math.ceil(farthest / self.cell))
        self._height = (grid.height - 1) // self.cell + 1 + 2 * self.border
        self._width = (grid.width - 1) // self.cell + 1 + 2 * self.border
        self._num_steps = sweeps.num_steps
        num_cells = sweeps.batch.num_windows * sweeps.num_steps * self._height * self._width
        number = torch.arange(1, len(parts) + 1, dtype=torch.int32, device=parts.step.device)
        place = self._place(parts.window, parts.step, parts.centre)
        self._part = lazy_zeros(num_cells, torch.int32, number.device).index_copy_(0, place, number)  # 0 = none

    def around(self, window: Tensor, step: Tensor, centre: Tensor, reach: int) -> tuple[Tensor, Tensor]:
        """Return the parts in the cells around places, (..., (2 reach + 1)^2), and whether there is one.

        `centre` is (2, ...), finest pixels, `window` and `step` are (...).
        """
        line = torch.arange(-reach, reach + 1, device=centre.device)
        offset = (line[:, None] * self._width + line).view(-1)  # [cells]
        place = self._place(window, step, centre)[..., None] + offset
        part = self._part.index_select(0, place.view(-1)).view_as(place)
        return (part - 1).clamp_(min=0).long(), part > 0

    def _place(self, window: Tensor, step: Tensor, centre: Tensor) -> Tensor:
        """Return the cells of places; the nearest cells for places outside of the region."""
        row, col = (centre / self.cell).floor_().long() + self.border
        row = row.clamp_(self.border, self._height - 1 - self.border)
        col = col.clamp_(self.border, self._width - 1 - self.border)
        return ((window * self._num_steps + step) * self._height + row) * self._width + col


@dataclass(frozen=True)
class _Tracks:
    """H velocities, each of a part of t, with the parts that confirm it."""

    part: Tensor  # (H, S) int64, the nearest part of each sweep; of t, the part itself
    is_found: Tensor  # (H, S) bool, the part is near enough
    error: Tensor  # (H,) float64, finest pixels, sum over the sweeps; in pairs, the displacement
    velocity: Tensor  # (H, 2) float64, (y, x), finest pixels per sweep interval, median over the parts

    def __getitem__(self, some: Tensor) -> _Tracks:
        return _Tracks(*gather(some, self.part, self.is_found, self.error, self.velocity))


def _all_tracks(sweeps: HeightSlicedSweeps, parts: _Parts, max_speed: float) -> _Tracks:
    """Follow the velocity from each part of t to each near part of t+1 and of t-1 through all sweeps."""
    seconds = (sweeps.batch.seconds - sweeps.batch.seconds[:, 1:2]).abs()  # [B, S], from t
    farthest = max_speed * seconds / sweeps.grid.pixel_size + 1
    cells = _Map(sweeps, parts, float(farthest[:, :3].max()))
    nearest = _SLOWEST / sweeps.grid.pixel_size
    pairs = [_pairs(parts, cells, step, farthest[:, step], nearest) for step in (0, 2)[: sweeps.num_steps - 1]]
    first = torch.cat([first for first, _ in pairs])  # [H], the part of t
    other = torch.cat([other for _, other in pairs])  # [H]
    window = parts.window.index_select(0, first)
    elapsed = sweeps.elapsed.index_select(0, window)  # [H, S]
    before_t = elapsed - elapsed[:, 1:2]
    begin = take_columns(parts.centre, first)  # [2, H]
    interval = before_t.gather(1, parts.step.index_select(0, other)[:, None])[:, 0]
    velocity = (begin - take_columns(parts.centre, other)) / interval  # [2, H]

    expected = begin[..., None] - velocity[..., None] * before_t  # [2, H, S]
    step = torch.arange(sweeps.num_steps, device=first.device).expand_as(before_t)
    part, is_part = cells.around(window[:, None].expand_as(before_t), step, expected, _NEAR)  # [H, S, 25]
    centre = take_columns(parts.centre, part.view(-1)).view(2, *part.shape)
    distance = (centre - expected[..., None]).square_().sum(0)
    square, index = distance.masked_fill_(~is_part, math.inf).min(2)  # [H, S]
    error = square.sqrt()
    part = part.gather(2, index[..., None])[..., 0]
    moved = velocity.square().sum(0).sqrt()[:, None] * before_t.abs()
    is_given = (elapsed != 0) | (step == 0)
    is_found = is_given & (error <= _FARTHEST / sweeps.grid.pixel_size + _FARTHER * moved)
    is_t = step == 1
    part = torch.where(is_t, first[:, None], part)
    is_found |= is_t

    is_confirmed = is_found[:, 0] & (2 * is_found[:, 2:].sum(1) >= is_given[:, 2:].sum(1))
    centre = take_columns(parts.centre, part.view(-1)).view(2, *part.shape)
    others = (begin[..., None] - centre) / before_t  # [2, H, S], undefined at t
    others = others.permute(1, 2, 0).masked_fill(~(is_found & ~is_t)[..., None], 0.0)
    num_lacking = (is_given & ~is_found).sum(1)
    error = error.masked_fill(~is_found | is_t, 0.0).sum(1) + num_lacking * float(1 << 20)
    error = torch.where(sweeps.has_history.index_select(0, window), error, moved[:, 0])
    tracks = _Tracks(part, is_found, error, masked_median(others, is_found & ~is_t))
    return tracks[flat_nonzero(is_confirmed)]


def _pairs(parts: _Parts, cells: _Map, step: int, farthest: Tensor, nearest: float) -> tuple[Tensor, Tensor]:
    """Pair each part of t with the parts of another sweep that are neither too near nor too far: (K,) int64 each.

    `farthest` is (B,) float64; both distances are in finest pixels.
    """
    of_t = flat_nonzero(parts.step == 1)
    window = parts.window.index_select(0, of_t)
    centre = take_columns(parts.centre, of_t)
    other, is_part = cells.around(window, torch.full_like(of_t, step), centre, cells.border)
    pair = flat_nonzero(is_part)
    first = of_t.index_select(0, floor_divide(pair, other.shape[1]))
    other = other.view(-1).index_select(0, pair)
    distance = (take_columns(parts.centre, first) - take_columns(parts.centre, other)).square().sum(0).sqrt()
    bound = farthest.index_select(0, parts.window.index_select(0, first))
    return gather(flat_nonzero((distance <= bound) & (distance >= nearest)), first, other)


def _best_tracks(tracks: _Tracks, num_parts: int) -> _Tracks:
    """Keep the tracks that are the best of their part of t and of their part of t+1. Ties: the first."""
    is_best = torch.ones_like(tracks.error, dtype=torch.bool)
    for step in (1, 0):
        same = Groups(tracks.part[:, step], num_parts)
        is_best &= tracks.error == same.spread(same.min(tracks.error, empty=math.inf))
    tracks = tracks[flat_nonzero(is_best)]
    same = Groups(tracks.part[:, 1], num_parts)
    first = same.spread(same.first())
    return tracks[flat_nonzero(first == torch.arange(len(first), device=first.device))]


def _pixels_of(tracks: _Tracks, parts: _Parts) -> Groups:
    """Group the P pixels by track, by way of their parts."""
    count = len(tracks.error)
    track = torch.arange(count, device=tracks.part.device)[:, None].expand_as(tracks.part)
    of_track = Groups(tracks.part.reshape(-1), len(parts)).where(tracks.is_found.view(-1))
    first_track = of_track.min(track.reshape(-1), empty=count)  # [Q]
    return Groups(parts.pixels.spread(first_track, none=count), count)


def _are_wide(sweeps: HeightSlicedSweeps, objects: Groups, velocity: Tensor) -> Tensor:
    """Tell which objects have pixels at t+1 and before, and are wide enough across their motion, (N,) bool."""
    pixels = sweeps.pixels
    speed = velocity.square().sum(1).sqrt().clamp(min=1)
    across = (velocity / speed[:, None]).flip(1) * constant((1.0, -1.0), torch.float64, speed.device)  # [N, 2]
    side = (objects.spread(across).t() * pixels.row_col).sum(0)
    width = objects.max(side, empty=-math.inf) - objects.min(side, empty=math.inf)
    is_linked = objects.any(pixels.step == 0) & objects.any(pixels.step > 0)
    return is_linked & (width * sweeps.grid.pixel_size >= _NARROWEST)
