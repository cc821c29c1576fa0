"""Relinking: what moves farther than it is long leaves no pixels that touch between two sweeps, so it is no component.

Far away a fast car shows its rear alone, which next sweep is metres off. What is linked to nothing is joined in each
sweep by itself; the things of sweep t are carried to those of its neighbours in time, and one that is found again in
two of three sweeps moves.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import NamedTuple, Tuple

import torch
import torch.nn.functional as F
from torch import Tensor

from cflow_torch.config import VerifiedConfig
from cflow_torch.ops.chunks import chunks
from cflow_torch.ops.indices import divide, flat_nonzero, split_index
from cflow_torch.ops.labeling import connected_components
from cflow_torch.ops.segments import bounding_boxes, segment_amin
from cflow_torch.ops.spans import spans
from cflow_torch.verified.component_tree import Objects
from cflow_torch.verified.height_slices import NUM_SLICES, HeightSlicedSweeps, count_slices

_CELL = 0.8  # metres; pixels in cells that touch are one thing
_LEAST, _LONGEST = 4, 12.0  # slices, metres in y and in x, of a thing
_OTHERS = (0, 2, 3)  # steps, ascending, in which a thing of t is looked for: t+1, t-1, t-2
_FOUND, _IN_SWEEPS = 60, 2  # per cent of its slices that must be found, and in how many of them


class _Things(NamedTuple):
    """K things, each of one sweep, in the order of their first pixels in the list.

    Args:
        pixel: (Q,) int64, positions of their pixels in the list, thing after thing.
        start, number: (K,) int64, where in `pixel` those of each begin, and how many they are.
        window, step: (K,) int64.
        first, last: (K, 2) int64, (row, col), corners of its box.
        slices: (K,) int64, how many it has.
    """

    pixel: Tensor
    start: Tensor
    number: Tensor
    window: Tensor
    step: Tensor
    first: Tensor
    last: Tensor
    slices: Tensor


def relink(
    objects: Objects, motion: Tensor, sweeps: HeightSlicedSweeps, config: VerifiedConfig
) -> Tuple[Objects, Tensor]:
    """Fast things of windows with history, found again in other sweeps.

    Args:
        objects: G of them; pixels of none are looked at.
        motion: (G, 2) float64, (y, x), finest pixels per sweep interval.
        sweeps: finest images, P occupied pixels.
        config: `max_speed`, `sweep_interval`.

    Returns:
        The objects with those things, as they are seen in all four sweeps, as objects of their own; the motion of all.

    Convention:
        A thing has four slices at least and a box of 12 m at most. Of a thing at t and one at t+1 or t-1, the
        differences of the first corners, of the last corners and of the middles of their boxes are candidates, in this
        order; by the other thing, in the order of the list. A slice is found if one of the 3 x 3 pixels where the
        motion takes it has it and is linked to nothing. The candidate that finds most in all three sweeps counts, of
        equals the first, if in two sweeps it finds 60 per cent. Pixels of other sweeps within a pixel of such a place
        go with the thing; where several claim one, the first thing has it.

    Cost: for each thing of t as many look-ups of its pixels as there are things beside it.
    Source: not in the paper.
    """
    lone = flat_nonzero((objects.of_pixel == objects.count) & (sweeps.step <= max(_OTHERS)))
    if sweeps.num_steps < 3 or lone.numel() == 0:
        return objects, motion
    rest = _only(sweeps, lone)
    things = _join(rest)
    source, velocity = _candidates(things, rest, config)
    found = _find(rest, things, source, velocity)
    is_found = (100 * found >= _FOUND * things.slices.index_select(0, source)[:, None]).sum(1) >= _IN_SWEEPS
    total = found.sum(1).masked_fill_(~is_found, 0)
    most = torch.zeros_like(things.slices).scatter_reduce_(0, source, total, "amax")
    is_best = flat_nonzero((total > 0) & (total == most.index_select(0, source)))
    best = segment_amin(is_best, source.index_select(0, is_best), most.numel(), source.numel())
    moving = flat_nonzero(best < source.numel())
    if moving.numel() == 0:
        return objects, motion
    velocity = velocity.index_select(0, best.index_select(0, moving))
    group = lone.new_full((sweeps.pixel.numel(),), moving.numel())
    group.index_copy_(0, lone, _claim(rest, things, moving, velocity))
    offset = int(objects.component.amax()) + 1 if objects.count else 0
    of_component = F.pad(velocity, (0, 0, offset, 0)).index_copy_(0, objects.component, motion)
    objects = objects.split(group, torch.ones_like(moving, dtype=torch.bool), offset)
    return objects, of_component.index_select(0, objects.component)


def _only(sweeps: HeightSlicedSweeps, some: Tensor) -> HeightSlicedSweeps:
    """The images of some pixels, (K,) int64; points are where they were."""
    pixel, window, step, row, col, slices = (
        values.index_select(0, some)
        for values in (sweeps.pixel, sweeps.window, sweeps.step, sweeps.row, sweeps.col, sweeps.slices)
    )
    image = torch.zeros_like(sweeps.image).index_copy_(0, pixel, slices)
    return replace(sweeps, image=image, pixel=pixel, window=window, step=step, row=row, col=col, slices=slices)


def _join(rest: HeightSlicedSweeps) -> _Things:
    """The things of each sweep."""
    side = max(1, round(_CELL / rest.grid.pixel_size))
    height, width = -(-rest.grid.height // side), -(-rest.grid.width // side)
    image = rest.window * rest.num_steps + rest.step
    cell = (image * height + divide(rest.row, side)) * width + divide(rest.col, side)
    occupancy = torch.zeros((rest.num_windows * rest.num_steps, height, width), dtype=torch.bool, device=cell.device)
    occupancy.view(-1).index_fill_(0, cell, True)
    cells = flat_nonzero(occupancy.view(-1))
    component = torch.zeros_like(occupancy, dtype=torch.int64).view(-1)
    component.index_copy_(0, cells, connected_components(occupancy, cells))
    _, thing = torch.unique(component.index_select(0, cell), return_inverse=True)
    thing, pixel = thing.sort(stable=True)
    row, col, step, window, slices = (
        values.index_select(0, pixel) for values in (rest.row, rest.col, rest.step, rest.window, rest.slices)
    )
    num_things = int(thing[-1]) + 1
    count = torch.bincount(thing, minlength=num_things)
    start = count.cumsum(0) - count
    first, size = bounding_boxes(row, col, thing, num_things)
    num_slices = torch.zeros_like(count).index_add_(0, thing, count_slices(slices).long())
    is_thing = flat_nonzero((num_slices >= _LEAST) & (size.amax(1) * rest.grid.pixel_size <= _LONGEST))
    is_thing = is_thing.index_select(0, pixel.index_select(0, start.index_select(0, is_thing)).argsort())
    window, step = (values.index_select(0, start.index_select(0, is_thing)) for values in (window, step))
    start, count, first, size, num_slices = (
        values.index_select(0, is_thing) for values in (start, count, first, size, num_slices)
    )
    return _Things(pixel, start, count, window, step, first, first + size - 1, num_slices)


def _candidates(things: _Things, rest: HeightSlicedSweeps, config: VerifiedConfig) -> Tuple[Tensor, Tensor]:
    """(C,) int64 things of t, and (C, 2) float64, (y, x), pixels per sweep interval."""
    speed = math.inf if config.max_speed is None else config.max_speed
    fastest = speed * config.sweep_interval / rest.grid.pixel_size
    at_t, beside = flat_nonzero(things.step == 1), flat_nonzero((things.step == 0) | (things.step == 2))
    sources, velocities = [at_t[:0]], [rest.elapsed.new_zeros((0, 2))]
    for some in chunks(0, at_t.numel(), at_t.device, 8 * max(beside.numel(), 1)):  # all pairs may be many
        is_pair = things.window.index_select(0, at_t[some])[:, None] == things.window.index_select(0, beside)
        source, target = split_index(flat_nonzero(is_pair.view(-1)), max(beside.numel(), 1))
        source, target = at_t[some].index_select(0, source), beside.index_select(0, target)
        elapsed = rest.elapsed.index_select(0, things.window.index_select(0, source))
        intervals = elapsed[:, 1] - elapsed.gather(1, things.step.index_select(0, target)[:, None])[:, 0]
        first, last = (at.index_select(0, target) - at.index_select(0, source) for at in (things.first, things.last))
        way = torch.stack((2 * first, 2 * last, first + last), 1).double() / 2
        velocity = (way / intervals[:, None, None]).flatten(0, 1) + 0.0  # no -0.0
        kept = flat_nonzero((velocity * velocity).sum(1) <= fastest * fastest)
        sources.append(source.repeat_interleave(3).index_select(0, kept))
        velocities.append(velocity.index_select(0, kept))
    return torch.cat(sources), torch.cat(velocities)


def _looks(
    rest: HeightSlicedSweeps, things: _Things, source: Tensor, velocity: Tensor, other: int
) -> Tuple[Tensor, Tensor, Tensor, Tensor]:
    """Pixels of things, (C,) int64, taken to another sweep: of each look its candidate and its pixel in the list, and
    the row and the column where it ends."""
    count = things.number.index_select(0, source)
    candidate = torch.arange(source.numel(), device=source.device).repeat_interleave(count)
    pixel = things.pixel.index_select(0, spans(things.start.index_select(0, source), count))
    elapsed = rest.elapsed.index_select(0, things.window.index_select(0, source))
    move = torch.floor(velocity * (elapsed[:, 1] - elapsed[:, other])[:, None] + 0.5).long()
    down, right = move.index_select(0, candidate).unbind(1)
    return candidate, pixel, rest.row.index_select(0, pixel) + down, rest.col.index_select(0, pixel) + right


def _find(rest: HeightSlicedSweeps, things: _Things, source: Tensor, velocity: Tensor) -> Tensor:
    """(C, 3) int64, slices of each candidate's thing that are found in each of the other sweeps."""
    others = _OTHERS[: rest.num_steps - 1]
    found = torch.zeros((len(others), source.numel()), dtype=torch.int64, device=source.device)
    for some in chunks(0, source.numel(), source.device, 64):
        for counts, other in zip(found, others):
            candidate, pixel, row, col = _looks(rest, things, source[some], velocity[some], other)
            step = torch.full_like(pixel, other)
            place = rest.index(rest.window.index_select(0, pixel), step, row, col)
            seen = rest.with_around.index_select(0, place) >> NUM_SLICES
            shared = count_slices(rest.slices.index_select(0, pixel) & seen)
            counts[some].index_add_(0, candidate, shared.long())
    return found.t()


def _claim(rest: HeightSlicedSweeps, things: _Things, moving: Tensor, velocity: Tensor) -> Tensor:
    """(K,) int64: of each pixel of the list the first of M things that it goes with, M = none.

    Args:
        moving: (M,) int64, which things.
        velocity: (M, 2) float64.
    """
    count = things.number.index_select(0, moving)
    own = things.pixel.index_select(0, spans(things.start.index_select(0, moving), count))
    group = torch.arange(moving.numel(), device=own.device)
    claims, pixels = [group.repeat_interleave(count)], [own]
    for other in _OTHERS[: rest.num_steps - 1]:
        candidate, pixel, row, col = _looks(rest, things, moving, velocity, other)
        window, step = rest.window.index_select(0, pixel), torch.full_like(pixel, other)
        for down in (-1, 0, 1):
            for right in (-1, 0, 1):
                pixels.append(rest.number_at(rest.index(window, step, row + down, col + right)))
                claims.append(candidate)
    return segment_amin(torch.cat(claims), torch.cat(pixels), rest.pixel.numel() + 1, moving.numel())[:-1]
