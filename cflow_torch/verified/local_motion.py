"""Local motion: slow walkers beside a wall, in a hedge, in a crowd move within a component that stands.

With history a walker leaves its place by several pixels, and a paired test on its own pixels shows it. What stood still
so far is tested at a grid of small velocities, all at once, over squares as wide as a walker. A place that some sweep
could not see says nothing there: else shadows that pass over a wall would move it.
"""

from __future__ import annotations

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
_SEED_Z, _SEED_WON = 6, 12  # standard deviations of noise, and slices, that such a square must show
_Z = 4.0  # standard deviations of noise that a group as a whole is granted
_UPRIGHT = 3  # height slices that it must have: rings of beams on a bonnet or a roof move as well


class _Looks(NamedTuple):
    """L looks of pixels into other sweeps, as `looks` gives them, with what they find where the pixel stands.

    Args:
        pixel, other: (L,) int64.
        k: (L,) float64, sweep intervals from the pixel's sweep to the other one.
        to_newest: (L,) float64, sweep intervals from the pixel's sweep to t+1.
        own, here: (L,) uint8, slices of the pixel; those of them that are found, or cannot be seen, where it stands.
        found: (L,) uint8, those that are found.
    """

    pixel: Tensor
    other: Tensor
    k: Tensor
    to_newest: Tensor
    own: Tensor
    here: Tensor
    found: Tensor


def find_local_motion(
    objects: Objects, motion: Tensor, levels: List[VerifiedLevel], sweeps: HeightSlicedSweeps
) -> Tuple[Objects, Tensor]:
    """Groups of pixels that move within objects that stand, of windows with history.

    Args:
        objects: G of them.
        motion: (G, 2) float64, (y, x), finest pixels per sweep interval.
        levels: that the objects were chosen from.
        sweeps: finest images, P occupied pixels.

    Returns:
        The objects with the groups taken out of them as objects of their own, and the motion of all.

    Convention:
        Velocities are whole steps of 0.1 m per interval, at most 0.3 m long, in raster order; of equals the first. What
        a pixel wins or loses counts where its velocity takes it at t+1.

    Cost: 28 look-ups for each pixel at rest and sweep, and a range image of each sweep.
    """
    at_rest = ~F.pad(motion.any(1), (0, 1)).index_select(0, objects.of_pixel)
    has_history = ((sweeps.elapsed != 0).sum(1) > 1).index_select(0, sweeps.window)
    members = flat_nonzero(at_rest & has_history)
    if members.numel() == 0:
        return objects, motion
    velocities = _velocities(sweeps)
    found = _look(sweeps, members)
    best, z = _best_velocity(sweeps, found, velocities)
    if not bool((z > 0).any()):
        return objects, motion
    group, of_group = _groups(sweeps, found, velocities, best, z)
    count = of_group.numel()
    candidates = velocities.index_select(0, of_group)[:, None]
    won, lost = _wins_of_groups(sweeps, found, group, candidates[:, 0])
    moves = (evidence_of(won, lost, _Z) > 0) & (_num_slices(sweeps, group, count) >= _UPRIGHT)
    num_components = sum(level.level.num_components for level in levels)
    of_component = motion.new_zeros((num_components + count, 2))
    of_component[objects.component] = motion
    of_component[num_components:] = candidates[:, 0]
    objects = objects.split(group, moves, num_components)
    return objects, of_component.index_select(0, objects.component)


def _wins_of_groups(sweeps: HeightSlicedSweeps, found: _Looks, group: Tensor, motion: Tensor) -> Tuple[Tensor, Tensor]:
    """(H,) int64 each: what groups of pixels, (P,) int64, win and lose by their motions, (H, 2) float64."""
    own = group.index_select(0, found.pixel)
    member = flat_nonzero(own < len(motion))
    some, own = _Looks(*(values.index_select(0, member) for values in found)), own.index_select(0, member)
    counts = _wins(sweeps, some, motion.index_select(0, own).t())
    zeros = torch.zeros_like(motion[:, 0], dtype=torch.int64)
    won, lost = (zeros.index_add(0, own, count.long()) for count in counts)
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


def _look(sweeps: HeightSlicedSweeps, members: Tensor) -> _Looks:
    """What pixels, (K,) int64, find where they stand."""
    pixel, other = looks(sweeps, members)
    window, step, row, col = (
        values.index_select(0, pixel) for values in (sweeps.window, sweeps.step, sweeps.row, sweeps.col)
    )
    to_newest = sweeps.elapsed[window, step]
    k = to_newest - sweeps.elapsed[window, other]
    exists = flat_nonzero(k != 0)
    pixel, other, k, to_newest, window, row, col = (
        values.index_select(0, exists) for values in (pixel, other, k, to_newest, window, row, col)
    )
    own = sweeps.slices.index_select(0, pixel)
    found = own & sweeps.slices_at(window, other, row, col)
    here = found | (own & _hidden_slices(sweeps, pixel, other, flat_nonzero(found != own)))
    return _Looks(pixel, other, k, to_newest, own, here, found)


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


def _wins(sweeps: HeightSlicedSweeps, some: _Looks, velocity: Tensor) -> Tuple[Tensor, Tensor]:
    """(L,) uint8 each: slices that a velocity, (2,) or (2, L) float64, wins and loses in each look."""
    window, row, col = (values.index_select(0, some.pixel) for values in (sweeps.window, sweeps.row, sweeps.col))
    down, right = (torch.floor(some.k * v + 0.5).long() for v in velocity)
    there = some.own & sweeps.slices_at(window, some.other, row + down, col + right)
    return count_slices(there & ~some.here), count_slices(some.found & ~there)


def _cell(sweeps: HeightSlicedSweeps, some: _Looks, velocity: Tensor, side: int, cols: int) -> Tensor:
    """(L,) int64: row * cols + col of the cell where a velocity takes each pixel at t+1, kept inside the image."""
    row, col = (values.index_select(0, some.pixel) for values in (sweeps.row, sweeps.col))
    down, right = (torch.floor(some.to_newest * v + 0.5).long() for v in velocity)
    row, col = (row + down).clamp_(0, sweeps.grid.height - 1), (col + right).clamp_(0, sweeps.grid.width - 1)
    return divide(row, side) * cols + divide(col, side)


def _shape(sweeps: HeightSlicedSweeps) -> Tuple[int, int, int]:
    """Finest pixels a side of a cell, rows and columns of cells."""
    side = max(1, round(_CELL / sweeps.grid.pixel_size))
    return side, -(-sweeps.grid.height // side), -(-sweeps.grid.width // side)


def _best_velocity(sweeps: HeightSlicedSweeps, found: _Looks, velocities: Tensor) -> Tuple[Tensor, Tensor]:
    """Of each cell, (B, rows, cols): the velocity of the best seed within a cell of it, int64, and its z, 0 = none."""
    side, rows, cols = _shape(sweeps)
    window = sweeps.window.index_select(0, found.pixel)
    shape = (sweeps.num_windows, 1, rows, cols)
    best_z = torch.zeros(shape, dtype=torch.float64, device=velocities.device)
    best = torch.zeros(shape, dtype=torch.int64, device=velocities.device)
    for index, velocity in enumerate(velocities):
        counts = _wins(sweeps, found, velocity)
        cell = _cell(sweeps, found, velocity, side, cols) + window * (rows * cols)
        sums = torch.zeros((2, best.numel()), dtype=torch.float32, device=cell.device)
        for out, count in zip(sums, counts):
            some = flat_nonzero(count)
            out.index_add_(0, cell.index_select(0, some), count.index_select(0, some).float())
        won, lost = (F.avg_pool2d(out.view(shape), 3, 1, 1, divisor_override=1).double() for out in sums)
        surplus, noise = won - lost, won + lost
        is_seed = (won >= _SEED_WON) & (surplus > 0) & (surplus * surplus >= _SEED_Z**2 * noise)
        z = torch.where(is_seed, surplus / torch.sqrt(noise), torch.zeros_like(won))
        best = torch.where(z > best_z, index, best)
        best_z = torch.maximum(z, best_z)
    is_wanted = _is_of_walker(sweeps, velocities).gather(1, best.view(sweeps.num_windows, -1)).view(shape)
    best_z = best_z.masked_fill(~is_wanted, 0.0)
    spread, place = F.max_pool2d(best_z, 3, 1, 1, return_indices=True)
    best = best.view(sweeps.num_windows, -1).gather(1, place.view(sweeps.num_windows, -1))
    return best.view(-1, rows, cols), spread.view(-1, rows, cols)


def _groups(
    sweeps: HeightSlicedSweeps, found: _Looks, velocities: Tensor, best: Tensor, z: Tensor
) -> Tuple[Tensor, Tensor]:
    """Pixels that win by the velocity of the cell that it takes them to, with the pixels around; joined cell by cell.

    Returns:
        group: (P,) int64 of each pixel, H = none.
        velocity: (H,) int64 of each group.
    """
    side, rows, cols = _shape(sweeps)
    # One more row and column, which are empty: the last pixel of a row is not beside the first one of the next.
    height, width, num_pixels = sweeps.grid.height, sweeps.grid.width + 1, sweeps.pixel.numel()
    window = sweeps.window.index_select(0, found.pixel)
    occupied = flat_nonzero(z > 0)
    component = torch.full((z.numel(),), -1, dtype=torch.int64, device=z.device)
    component[occupied] = connected_components(z > 0, occupied)
    taken = torch.zeros(num_pixels, dtype=torch.int64, device=z.device)  # 1 + component * velocities + velocity
    strength = torch.zeros(num_pixels, dtype=torch.float64, device=z.device)
    for index in torch.unique(best[z > 0]).tolist():
        cell = _cell(sweeps, found, velocities[index], side, cols) + window * (rows * cols)
        near = flat_nonzero((best.view(-1).index_select(0, cell) == index) & (z.view(-1).index_select(0, cell) > 0))
        some = _Looks(*(values.index_select(0, near) for values in found))
        cell = cell.index_select(0, near)
        won, lost = _wins(sweeps, some, velocities[index])
        # Fine place at t+1, by look; its 3 x 3 pixels together.
        fine = _cell(sweeps, some, velocities[index], 1, width) + window.index_select(0, near) * ((height + 1) * width)
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
