"""Local motion: slow walkers beside a wall, in a hedge, in a crowd move within a component that stands.

With history a walker leaves its place by several pixels, and a paired test on its own pixels shows it. What stood still
so far is tested at a grid of small velocities, all at once, over squares as wide as a walker. A place that some sweep
could not see says nothing there: else shadows that pass over a wall would move it.
"""

from __future__ import annotations

import math
from typing import List, NamedTuple, Tuple

import torch
import torch.nn.functional as F
from torch import Tensor

from cflow_torch.ops.indices import divide, flat_nonzero
from cflow_torch.ops.labeling import connected_components
from cflow_torch.verified.component_tree import Objects
from cflow_torch.verified.height_slices import NUM_SLICES, SLICE_HEIGHT, HeightSlicedSweeps, count_slices
from cflow_torch.verified.paired_test import VerifiedLevel, evidence_of, looks
from cflow_torch.verified.visibility import RangeImages

_STEP, _REACH = 0.1, 3  # metres per sweep interval between velocities; steps to the fastest one
_FASTEST = 0.25  # metres per interval: what is best at a velocity beyond may be a shadow that is faster still
_CELL = 0.3  # metres; won and lost are summed over 3 x 3 cells
_SEED_Z = 6  # standard deviations of noise that such a square must show
_LEAST_WON = 4  # slices; fewer are not looked at
_Z = 4.0  # standard deviations of noise that a group as a whole is granted
_UPRIGHT = 3  # height slices that it must have: rings of beams on a bonnet or a roof move as well


class _Looks(NamedTuple):
    """L looks of pixels into other sweeps, as `looks` gives them, with what they find where the pixel stands.

    Args:
        pixel: (L,) int64.
        way: (L,) int64, from which sweep to which: an index into the times of `_Ways`.
        start: (L,) int64, where the pixel stands in the other sweep, an index into the image of `_Ways`.
        own, here: (L,) uint8, slices of the pixel; those of them that are found, or cannot be seen, where it stands.
        found: (L,) uint8, those that are found.
    """

    pixel: Tensor
    way: Tensor
    start: Tensor
    own: Tensor
    here: Tensor
    found: Tensor

    def take(self, wanted: Tensor) -> _Looks:
        """Some of them, (K,) int64."""
        return _Looks(*(values.index_select(0, wanted) for values in self))


class _Ways(NamedTuple):
    """From which sweep to which looks go, and images with a free margin, so that no look leaves them.

    Args:
        k: (B * 2 S,) float64, sweep intervals from an older sweep m to t+1 (m = 0 ... S - 1), then from t+1 to m.
        to_newest: (B * 2 S,) float64, sweep intervals from the looking sweep to t+1.
        image: flat uint8, slices of all sweeps.
        width: pixels a row of it.
    """

    k: Tensor
    to_newest: Tensor
    image: Tensor
    width: int

    def offsets(self, velocity: Tensor) -> Tensor:
        """(B * 2 S,) int64, how far a velocity, (2,) float64, takes pixels in `image`."""
        down, right = (torch.floor(self.k * v + 0.5).long() for v in velocity)
        return down * self.width + right

    def wins(self, some: _Looks, offset: Tensor) -> Tuple[Tensor, Tensor]:
        """(L,) uint8 each: slices that are won and lost where each look, (L,) int64, is taken."""
        there = some.own & self.image.index_select(0, some.start + offset)
        return there & ~some.here, some.found & ~there


def find_local_motion(
    objects: Objects, motion: Tensor, levels: List[VerifiedLevel], sweeps: HeightSlicedSweeps
) -> Tuple[Objects, Tensor, Tensor]:
    """Groups of pixels that move within objects that stand, of windows with history.

    Args:
        objects: G of them.
        motion: (G, 2) float64, (y, x), finest pixels per sweep interval.
        levels: that the objects were chosen from.
        sweeps: finest images, P occupied pixels.

    Returns:
        The objects with the groups taken out of them as objects of their own; the motion of all; and (P,) float64, z of
        the best velocity around each pixel: where something stands, how likely that is wrong. 0 without history.

    Convention:
        Velocities are whole steps of 0.1 m per interval, at most 0.3 m long, in raster order; of equals the first. What
        a pixel wins or loses counts where its velocity takes it at t+1.

    Cost: 28 look-ups for each pixel at rest and sweep, and a range image of each sweep.
    """
    at_rest = ~F.pad(motion.any(1), (0, 1)).index_select(0, objects.of_pixel)
    has_history = ((sweeps.elapsed != 0).sum(1) > 1).index_select(0, sweeps.window)
    members = flat_nonzero(at_rest & has_history)
    if members.numel() == 0:
        return objects, motion, torch.zeros_like(sweeps.row, dtype=torch.float64)
    velocities = _velocities(sweeps)
    ways, found = _look(sweeps, members)
    best, z = _best_velocity(sweeps, ways, found, velocities)
    side, rows, cols = _shape(sweeps)
    doubt = z.view(-1).index_select(
        0, (sweeps.window * rows + divide(sweeps.row, side)) * cols + divide(sweeps.col, side)
    )
    z = z.masked_fill(z < _SEED_Z, 0.0)
    if not bool(z.any()):
        return objects, motion, doubt
    group, of_group = _groups(sweeps, ways, found, velocities, best, z)
    count = of_group.numel()
    candidates = velocities.index_select(0, of_group)[:, None]
    won, lost = _wins_of_groups(ways, found, group, candidates[:, 0])
    moves = (evidence_of(won, lost, _Z) > 0) & (_num_slices(sweeps, group, count) >= _UPRIGHT)
    num_components = sum(level.level.num_components for level in levels)
    of_component = motion.new_zeros((num_components + count, 2))
    of_component[objects.component] = motion
    of_component[num_components:] = candidates[:, 0]
    objects = objects.split(group, moves, num_components)
    return objects, of_component.index_select(0, objects.component), doubt


def _wins_of_groups(ways: _Ways, found: _Looks, group: Tensor, motion: Tensor) -> Tuple[Tensor, Tensor]:
    """(H,) int64 each: what groups of pixels, (P,) int64, win and lose by their motions, (H, 2) float64."""
    own = group.index_select(0, found.pixel)
    member = flat_nonzero(own < len(motion))
    some, own = found.take(member), own.index_select(0, member)
    k = ways.k.index_select(0, some.way)
    down, right = (torch.floor(k * v.index_select(0, own) + 0.5).long() for v in motion.unbind(1))
    zeros = torch.zeros_like(motion[:, 0], dtype=torch.int64)
    won, lost = (
        zeros.index_add(0, own, count_slices(slices).long()) for slices in ways.wins(some, down * ways.width + right)
    )
    return won, lost


def _num_slices(sweeps: HeightSlicedSweeps, group: Tensor, count: int) -> Tensor:
    """(H,) int64: height slices of each of `count` groups of pixels, (P,) int64."""
    has = torch.zeros((NUM_SLICES, count + 1), dtype=torch.bool, device=group.device)
    for index, of_slice in enumerate(has):
        of_slice.index_fill_(0, group.index_select(0, flat_nonzero((sweeps.slices & (1 << index)).bool())), True)
    return has.sum(0)[:count]


def _velocities(sweeps: HeightSlicedSweeps) -> Tensor:
    """(28, 2) float64, (y, x), finest pixels per sweep interval."""
    line = torch.arange(-_REACH, _REACH + 1, device=sweeps.elapsed.device)
    grid = torch.cartesian_prod(line, line)
    square = (grid * grid).sum(1)
    grid = grid.index_select(0, flat_nonzero((square > 0) & (square <= _REACH * _REACH)))
    return grid.double() * (_STEP / sweeps.grid.pixel_size)


def _is_of_walker(sweeps: HeightSlicedSweeps, velocities: Tensor) -> Tensor:
    """(B, 28) bool: which velocities are believed. What is best beyond `_FASTEST` may be a shadow that is faster still;
    rings of beams on a roof or a wall move as the sensor does."""
    size = sweeps.grid.pixel_size
    of_sensor = -sweeps.batch.origin[:, 1, :2].flip(1) / (sweeps.elapsed[:, 1] * size)[:, None]
    off = torch.linalg.vector_norm(velocities - of_sensor[:, None], dim=2)
    return (off > 1.05 * _STEP / size) & (torch.linalg.vector_norm(velocities, dim=1) * size < _FASTEST)


def _look(sweeps: HeightSlicedSweeps, members: Tensor) -> Tuple[_Ways, _Looks]:
    """What pixels, (K,) int64, find where they stand."""
    num_steps, elapsed, grid = sweeps.num_steps, sweeps.elapsed, sweeps.grid
    longest = float(elapsed.abs().amax()) * _REACH * _STEP / grid.pixel_size
    margin = math.ceil(longest) + 1
    image = sweeps.image[:-1].view(-1, grid.height, grid.width)
    image = F.pad(image, (margin, margin, margin, margin))
    ways = _Ways(
        torch.cat((elapsed, -elapsed), 1).view(-1),
        torch.cat((elapsed, torch.zeros_like(elapsed)), 1).view(-1),
        image.view(-1),
        image.shape[2],
    )

    pixel, other = looks(sweeps, members)
    window, step = (values.index_select(0, pixel) for values in (sweeps.window, sweeps.step))
    way = window * (2 * num_steps) + torch.where(step > 0, step, num_steps + other)
    exists = flat_nonzero(ways.k.index_select(0, way))
    pixel, other, window, way = (values.index_select(0, exists) for values in (pixel, other, window, way))
    row, col = (values.index_select(0, pixel) for values in (sweeps.row, sweeps.col))
    start = ((window * num_steps + other) * image.shape[1] + row + margin) * image.shape[2] + col + margin
    own = sweeps.slices.index_select(0, pixel)
    found = own & ways.image.index_select(0, start)
    here = found | (own & _hidden_slices(sweeps, pixel, other, flat_nonzero(found != own)))
    return ways, _Looks(pixel, way, start, own, here, found)


def _hidden_slices(sweeps: HeightSlicedSweeps, pixel: Tensor, other: Tensor, asked: Tensor) -> Tensor:
    """(L,) uint8: slices that the other sweep cannot see where the pixel of a look stands; 0 where not `asked` (K,)."""
    pixel_size, (lower_x, lower_y) = sweeps.grid.pixel_size, sweeps.grid.lower[:2]
    images, hidden = RangeImages(sweeps), torch.zeros_like(pixel, dtype=torch.uint8)
    pixel, other = pixel.index_select(0, asked), other.index_select(0, asked)
    window, row, col = (values.index_select(0, pixel) for values in (sweeps.window, sweeps.row, sweeps.col))
    x, y = (col.double() + 0.5) * pixel_size + lower_x, (row.double() + 0.5) * pixel_size + lower_y
    first = torch.floor(sweeps.lowest / SLICE_HEIGHT).index_select(0, pixel)
    slices = torch.zeros_like(pixel, dtype=torch.uint8)
    for index in range(NUM_SLICES):
        # Of the heights that share this slice, the lowest that the pixel may have.
        height = first + (index - first).remainder(NUM_SLICES) + 0.5
        slices |= images.hide(window, other, x, y, height * SLICE_HEIGHT).to(torch.uint8) << index
    return hidden.index_copy_(0, asked, slices)


def _landing(
    sweeps: HeightSlicedSweeps, ways: _Ways, some: _Looks, velocity: Tensor, side: int
) -> Tuple[Tensor, Tensor, Tensor]:
    """(L,) int64 each: window, row and col of the cell where a velocity takes each pixel at t+1, kept in the image.

    Args:
        side: finest pixels a side of a cell.
    """
    window, row, col = (values.index_select(0, some.pixel) for values in (sweeps.window, sweeps.row, sweeps.col))
    down, right = (torch.floor(ways.to_newest * v + 0.5).long().index_select(0, some.way) for v in velocity)
    row, col = (row + down).clamp_(0, sweeps.grid.height - 1), (col + right).clamp_(0, sweeps.grid.width - 1)
    return window, divide(row, side), divide(col, side)


def _shape(sweeps: HeightSlicedSweeps) -> Tuple[int, int, int]:
    """Finest pixels a side of a cell, rows and columns of cells."""
    side = max(1, round(_CELL / sweeps.grid.pixel_size))
    return side, -(-sweeps.grid.height // side), -(-sweeps.grid.width // side)


def _best_velocity(sweeps: HeightSlicedSweeps, ways: _Ways, found: _Looks, velocities: Tensor) -> Tuple[Tensor, Tensor]:
    """Of each cell, (B, rows, cols): the best velocity within a cell of it, int64, and its z, 0 = none is believed."""
    side, rows, cols = _shape(sweeps)
    shape = (sweeps.num_windows, rows, cols)
    best_z = torch.zeros(shape, dtype=torch.float64, device=velocities.device).view(-1)
    best = torch.zeros_like(best_z, dtype=torch.int64)
    for index, velocity in enumerate(velocities):
        won, lost = ways.wins(found, ways.offsets(velocity).index_select(0, found.way))
        some = flat_nonzero((won | lost).bool())
        window, row, col = _landing(sweeps, ways, found.take(some), velocity, side)
        # Both counts in one number, won * 2^16 + lost, with a free margin of a cell.
        counts = (count_slices(won.index_select(0, some)).int() << 16) + count_slices(lost.index_select(0, some))
        sums = torch.zeros((sweeps.num_windows, rows + 2, cols + 2), dtype=torch.int32, device=counts.device)
        sums.view(-1).index_add_(0, (window * (rows + 2) + row + 1) * (cols + 2) + col + 1, counts)
        sums = sums[:, :-2] + sums[:, 1:-1] + sums[:, 2:]
        sums = (sums[:, :, :-2] + sums[:, :, 1:-1] + sums[:, :, 2:]).view(-1)
        at = flat_nonzero(sums >= _LEAST_WON << 16)
        sums = sums.index_select(0, at)
        won, lost = (sums >> 16).double(), (sums & 0xFFFF).double()
        z = (won - lost) / torch.sqrt(won + lost)
        better = flat_nonzero(z > best_z.index_select(0, at))
        best_z.index_copy_(0, at.index_select(0, better), z.index_select(0, better))
        best.index_fill_(0, at.index_select(0, better), index)
    is_wanted = _is_of_walker(sweeps, velocities).gather(1, best.view(sweeps.num_windows, -1)).view(-1)
    best_z = best_z.masked_fill(~is_wanted, 0.0).view(sweeps.num_windows, 1, rows, cols)
    around, place = F.max_pool2d(best_z, 3, 1, 1, return_indices=True)
    best = best.view(sweeps.num_windows, -1).gather(1, place.view(sweeps.num_windows, -1))
    return best.view(shape), around.view(shape)


def _groups(
    sweeps: HeightSlicedSweeps, ways: _Ways, found: _Looks, velocities: Tensor, best: Tensor, z: Tensor
) -> Tuple[Tensor, Tensor]:
    """Pixels that win by the velocity of the cell that it takes them to, with the pixels around; joined cell by cell.

    Returns:
        group: (P,) int64 of each pixel, H = none.
        velocity: (H,) int64 of each group.
    """
    side, rows, cols = _shape(sweeps)
    height, width, num_pixels = sweeps.grid.height, sweeps.grid.width, sweeps.pixel.numel()
    occupied = flat_nonzero(z > 0)
    component = torch.full((z.numel(),), -1, dtype=torch.int64, device=z.device)
    component[occupied] = connected_components(z > 0, occupied)
    taken = torch.zeros(num_pixels, dtype=torch.int64, device=z.device)  # 1 + component * velocities + velocity
    strength = torch.zeros(num_pixels, dtype=torch.float64, device=z.device)
    for index in torch.unique(best[z > 0]).tolist():
        window, row, col = _landing(sweeps, ways, found, velocities[index], side)
        cell = (window * rows + row) * cols + col
        near = flat_nonzero((best.view(-1).index_select(0, cell) == index) & (z.view(-1).index_select(0, cell) > 0))
        some, cell = found.take(near), cell.index_select(0, near)
        won, lost = map(count_slices, ways.wins(some, ways.offsets(velocities[index]).index_select(0, some.way)))
        # Fine place at t+1, by look; its 3 x 3 pixels together.
        window, row, col = _landing(sweeps, ways, some, velocities[index], 1)
        fine = (window * height + row) * width + col
        places, fine = torch.unique(fine, return_inverse=True)
        gain = torch.zeros(places.numel() + 1, dtype=torch.int64, device=z.device)
        gain.index_add_(0, fine, won.long() - lost.long())
        around = torch.zeros_like(gain[:-1])
        for offset in [down * width + right for down in (-1, 0, 1) for right in (-1, 0, 1)]:
            at = torch.searchsorted(places, places + offset).clamp_(max=places.numel() - 1)
            around += gain.index_select(0, at) * (places.index_select(0, at) == places + offset)
        wins = flat_nonzero((around > 0).index_select(0, fine))
        pixel, cell = some.pixel.index_select(0, wins), cell.index_select(0, wins)
        value = z.view(-1).index_select(0, cell)
        better = flat_nonzero(value > strength.index_select(0, pixel))
        pixel, cell, value = (values.index_select(0, better) for values in (pixel, cell, value))
        strength.index_copy_(0, pixel, value)
        taken.index_copy_(0, pixel, 1 + component.index_select(0, cell) * len(velocities) + index)
    names, group = torch.unique(taken, return_inverse=True)
    if int(names[0]) > 0:  # every pixel has one
        return group, (names - 1) % len(velocities)
    return torch.where(group == 0, names.numel() - 1, group - 1), (names[1:] - 1) % len(velocities)
