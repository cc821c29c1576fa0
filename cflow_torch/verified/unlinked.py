"""Fast small objects: link components that have no pixels at t+1 with those that have no others.

An object that moves farther than its own size is a component of its own in each sweep. We link these components by
constant velocity: a component of t and one of t+1 give a velocity, and the older sweeps must have components where the
velocity puts them. The linked components are a node of the tree like any other.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from cflow_torch.ops.groups import Groups
from cflow_torch.ops.indices import flat_nonzero, floor_divide, gather, lazy_zeros, take_columns
from cflow_torch.verified.changed_pixels import ChangedPixels
from cflow_torch.ops.segments import masked_median
from cflow_torch.ops.labeling import label_together, padded_size
from cflow_torch.verified.component_tree import Components, NodeKind, Tree, _draw
from cflow_torch.verified.height_slices import HeightSlicedSweeps

_CELL = 0.8  # metres
_SAME = 0.7  # metres; how far a component may be from where the velocity puts it, and further ...
_SAME_SHARE = 0.05  # ... for each metre that the object has moved
_LARGEST = 8.0  # metres
_LIKE = 4.0  # ratio of numbers of pixels
_MOST_SPEED = 60.0
LEVEL = 1
DEBUG = {}
BLOCK = 0.4
LEAST_SHIFT = 0.3
WIDTH = 0.4
DIFFERENT = 0.5
RIVAL = 0
LEAST = 2
SHARE = 2


class _Parts(NamedTuple):
    """The pixels of an unlinked component in one sweep."""

    pixels: Groups  # the P pixels, grouped by part
    window: Tensor  # (Q,) int64
    step: Tensor  # (Q,) int64
    size: Tensor  # (Q,) int64, pixels
    centre: Tensor  # (2, Q) float64, (y, x), pixels


def link_unlinked(
    sweeps: HeightSlicedSweeps, components: Components, change: ChangedPixels, tree: Tree, max_speed: float | None
) -> Tree:
    parts = _parts(sweeps, components, change)
    if len(parts.step) == 0:
        return tree
    found, velocity = _links(sweeps, parts, _MOST_SPEED if max_speed is None else max_speed)  # [S, N] parts or -1
    if found.shape[1] == 0:
        return tree
    count = found.shape[1]
    # members: all pixels of the parts
    node, part = _pairs(found)
    # a part may be in several nodes; keep the first
    owner = Groups(part, len(parts.step)).min(node, empty=count)  # [Q]
    of_pixel = Groups(owner, count)
    groups = Groups(parts.pixels.spread(owner, none=count), count)  # P pixels by node
    has = groups.any(sweeps.pixels.step == 0) & groups.any(sweeps.pixels.step > 0)
    direction = velocity.t() / velocity.t().square().sum(0).sqrt().clamp(min=1e-9)  # [2, N]
    row_col = sweeps.pixels.row_col
    side = groups.spread(direction[1]) * row_col[0] - groups.spread(direction[0]) * row_col[1]
    width = groups.max(side, empty=-math.inf) - groups.min(side, empty=math.inf)
    has &= width * sweeps.grid.pixel_size >= WIDTH
    kept = flat_nonzero(has)
    groups = groups.select(kept)
    count = len(kept)
    member = flat_nonzero(groups.is_member)
    window = groups.max(sweeps.pixels.window, empty=0)
    hint = velocity[kept].t()
    none = Groups(torch.full_like(window, count), count)
    return Tree(
        pixel=torch.cat((tree.pixel, member)),
        members=tree.members.followed_by(groups[member]),
        children=tree.children.followed_by(none),
        kind=torch.cat((tree.kind, torch.full_like(window, NodeKind.UNLINKED))),
        window=torch.cat((tree.window, window)),
        travels=torch.cat((tree.travels, torch.zeros_like(window, dtype=torch.bool))),
        num_levels=tree.num_levels,
        hint=torch.cat((tree.hint, hint.t())),
    )


def _pairs(found: Tensor) -> tuple[Tensor, Tensor]:
    at = flat_nonzero(found >= 0)
    return at % found.shape[1], found.flatten()[at]


def _parts(sweeps: HeightSlicedSweeps, components: Components, change: ChangedPixels) -> _Parts:
    pixels = sweeps.pixels
    level = components.levels[LEVEL]
    unlinked = level.spread(~components.is_linked) & level.is_member
    has_history = sweeps.has_history.index_select(0, pixels.window)
    wanted = flat_nonzero(torch.where(has_history, change.is_missing, unlinked))
    block = max(1, round(BLOCK / sweeps.grid.pixel_size))
    height = -(-sweeps.grid.height // block)
    width = -(-sweeps.grid.width // block)
    row, col = floor_divide(take_columns(pixels.row_col, wanted), block)
    row = row + (pixels.window[wanted] * sweeps.num_steps + pixels.step[wanted]) * padded_size(height)
    image = _draw(row, col, sweeps.batch.num_windows * sweeps.num_steps, height, width)
    (labels,) = label_together([(image, 1)])
    label = torch.full((sweeps.num_pixels,), labels.num_components, device=row.device)
    label[wanted] = labels.of_pixel(row, col)
    parts = Groups(label, labels.num_components)
    size = parts.size()
    row_col = pixels.row_col
    first = parts.min(row_col, empty=1 << 40)
    last = parts.max(row_col, empty=-1)
    small = ((last - first).amax(0) * sweeps.grid.pixel_size <= _LARGEST) & (size >= LEAST)
    parts = parts.only(small)
    size = parts.size()
    total = parts.sum(row_col)
    return _Parts(
        parts, parts.max(pixels.window, empty=0), parts.max(pixels.step, empty=0), size, total.double() / size
    )


def _links(sweeps: HeightSlicedSweeps, parts: _Parts, max_speed: float) -> tuple[Tensor, Tensor]:
    """(S, N) parts of each step of each linked object, -1 = none."""
    grid = sweeps.grid
    s = sweeps.num_steps
    cell = max(1, round(_CELL / grid.pixel_size))
    rows = (grid.height - 1) // cell + 3
    cols = (grid.width - 1) // cell + 3
    num_images = sweeps.batch.num_windows * s
    image = lazy_zeros(num_images * rows * cols, torch.int32, parts.size.device)
    rc = (parts.centre / cell).floor().long() + 1
    number = torch.arange(1, len(parts.size) + 1, dtype=torch.int32, device=image.device)
    image[(parts.window * s + parts.step) * rows * cols + rc[0] * cols + rc[1]] = number

    def look(window, step, centre, reach):  # centre [2, ...] pixels -> [K.., R] parts, -1
        line = torch.arange(-reach, reach + 1, device=image.device)
        off = torch.cartesian_prod(line, line)  # [R, 2]
        rc = (centre / cell).floor().long() + 1
        r = rc[0][..., None] + off[:, 0]
        c = rc[1][..., None] + off[:, 1]
        ok = (r >= 0) & (r < rows) & (c >= 0) & (c < cols)
        index = (((window * s + step)[..., None] * rows + r) * cols + c) * ok
        return (image[index].long() - 1).masked_fill(~ok, -1)

    at_t = flat_nonzero(parts.step == 1)
    elapsed = sweeps.elapsed
    per_meter = 1 / grid.pixel_size
    firsts, others = [], []
    for other in (0, 2)[: s - 1]:
        apart = (sweeps.batch.seconds[:, other] - sweeps.batch.seconds[:, 1]).abs()
        farthest = max_speed * float(apart.max()) * per_meter
        near = look(parts.window[at_t], torch.full_like(at_t, other), parts.centre[:, at_t], math.ceil(farthest / cell))
        hyp = flat_nonzero(near >= 0)
        first = at_t[floor_divide(hyp, near.shape[1])]
        second = near.flatten()[hyp]
        dist = (parts.centre[:, second] - parts.centre[:, first]).square().sum(0).sqrt()
        limit = max_speed * apart[parts.window[first]] * per_meter + 1
        least = LEAST_SHIFT * per_meter
        ok = flat_nonzero((dist <= limit) & (dist >= least))
        firsts.append(first[ok])
        others.append(second[ok])
    first = torch.cat(firsts)
    other = torch.cat(others)
    window = parts.window[first]
    k = elapsed[window]  # [H, S]
    since = k - k[:, 1:2]
    at_other = since.gather(1, parts.step[other][:, None])[:, 0]
    velocity = (parts.centre[:, first] - parts.centre[:, other]) / at_other  # [2, H]
    centre = parts.centre[:, first][..., None] - velocity[..., None] * since  # [2, H, S]
    steps = torch.arange(s, device=first.device)
    given = (k != 0) | (steps == 0)
    lookat = look(window[:, None].expand_as(k), steps.expand_as(k), centre, 2)  # [H, S, 25]
    off = parts.centre[:, lookat.clamp(min=0)] - centre[..., None]
    d = off.square().sum(0).sqrt().masked_fill(lookat < 0, math.inf)
    best, which = d.min(2)  # [H, S]
    speed = velocity.square().sum(0).sqrt()[:, None]
    tol = _SAME * per_meter + _SAME_SHARE * speed * since.abs()
    hit = (best <= tol) & given
    hit[:, 1] = True
    found = torch.where(hit, lookat.gather(2, which[..., None])[..., 0], -1)
    found[:, 1] = first
    best[:, 1] = 0
    num = hit.sum(1) - 2
    num_given = given.sum(1) - 2
    enough = hit[:, 0] & (num * SHARE >= num_given)
    cost = (num_given - num) * 1000.0 + best.masked_fill(~hit, 0.0).sum(1)
    if s == 2:
        cost = speed[:, 0]
    kept = flat_nonzero(enough)
    found, cost, since, hit, num = found[kept], cost[kept], since[kept], hit[kept], num[kept]
    velocity = velocity[:, kept]
    # mutual best, then the first of equal ones
    is_best = torch.ones_like(cost, dtype=torch.bool)
    for part in (found[:, 1], found[:, 0]):
        groups = Groups(part, len(parts.size))
        is_best &= cost == groups.spread(groups.min(cost, empty=math.inf))
    kept = flat_nonzero(is_best & (cost < math.inf))
    groups = Groups(found[kept, 1], len(parts.size))
    kept = kept[groups.spread(groups.first()) == torch.arange(len(kept), device=kept.device)]
    found, since, hit = found[kept], since[kept], hit[kept]
    others = parts.centre[:, found.clamp(min=0)]  # [2, N, S]
    v = (parts.centre[:, found[:, 1]][..., None] - others) / since
    v = v.permute(1, 2, 0)
    hit[:, 1] = False
    v = v.masked_fill(~hit[..., None], 0.0)
    return found.t(), masked_median(v, hit)
