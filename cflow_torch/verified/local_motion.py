"""Local motion: slow walkers beside a wall, in a hedge, in a crowd move within a component that stands.

With history a walker leaves its place by several pixels, and a paired test on its own pixels shows it. What stood still
so far is tested at a grid of small velocities, all at once, over squares as wide as a walker.
"""

from __future__ import annotations

from typing import List, NamedTuple, Tuple

import torch
import torch.nn.functional as F
from torch import Tensor

from cflow_torch.ops.indices import divide, flat_nonzero
from cflow_torch.ops.labeling import connected_components
from cflow_torch.verified.component_tree import Objects
from cflow_torch.verified.height_slices import NUM_SLICES, HeightSlicedSweeps
from cflow_torch.verified.local_evidence import Looks, at_newest, look, wins
from cflow_torch.verified.paired_test import VerifiedLevel, evidence_of

_STEP, _REACH = 0.1, 3  # metres per sweep interval between velocities; steps to the fastest one
_FASTEST = 0.25  # metres per interval: what is best at a velocity beyond may be a shadow that is faster still
_CELL = 0.3  # metres; won and lost are summed over 3 x 3 cells
_SEED_Z = 6  # standard deviations of noise that such a square must show
_LEAST_WON = 4  # slices; a square that wins fewer is not looked at
_Z = 4.0  # standard deviations of noise that a group as a whole is granted
_LOW = (1 << 32) - 1  # the lower half of a number that holds two counts
_UPRIGHT = 3  # height slices that it must have: rings of beams on a bonnet or a roof move as well


class _Best(NamedTuple):
    """What moves where at t+1, by cells of all windows.

    Args:
        side: finest pixels a side of a cell.
        best: (B, rows, cols) int64, number of the best velocity, -1 = none.
        z: (B, rows, cols) float64, its surplus in standard deviations of noise; 0 = none.
    """

    side: int
    best: Tensor
    z: Tensor

    def at(self, window: Tensor, row: Tensor, col: Tensor) -> Tensor:
        """(P,) float64: z at pixels, (P,) int64 each."""
        _, rows, cols = self.z.shape
        cell = (window * rows + divide(row, self.side)) * cols + divide(col, self.side)
        return self.z.view(-1).index_select(0, cell)

    def only(self, wanted: Tensor) -> _Best:
        """Those of some cells, (B, rows, cols) bool."""
        return _Best(self.side, self.best.masked_fill(~wanted, -1), self.z.masked_fill(~wanted, 0.0))


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
    found = look(sweeps, members)
    around = _find_best(sweeps, found, velocities)
    doubt = around.at(sweeps.window, sweeps.row, sweeps.col)
    seeds = around.only(around.z >= _SEED_Z)
    if not bool((seeds.best >= 0).any()):
        return objects, motion, doubt
    group, of_group = _groups(sweeps, found, velocities, seeds)
    candidates = velocities.index_select(0, of_group)
    won, lost = _wins_of_groups(sweeps, found, group, candidates)
    moves = (evidence_of(won, lost, _Z) > 0) & (_num_slices(sweeps, group, len(candidates)) >= _UPRIGHT)
    num_components = sum(level.level.num_components for level in levels)
    of_component = F.pad(candidates, (0, 0, num_components, 0)).index_copy_(0, objects.component, motion)
    objects = objects.split(group, moves, num_components)
    return objects, of_component.index_select(0, objects.component), doubt


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
    stands = torch.linalg.vector_norm(of_sensor, dim=1) * size < _STEP / 2
    return ((off > 1.05 * _STEP / size) | stands[:, None]) & (
        torch.linalg.vector_norm(velocities, dim=1) * size < _FASTEST
    )


def _cell(sweeps: HeightSlicedSweeps, some: Looks, velocity: Tensor, seeds: _Best) -> Tensor:
    """(L,) int64: cell, counted through all windows, where a velocity, (2,) float64, takes each pixel at t+1."""
    row, col = (divide(values, seeds.side) for values in at_newest(sweeps, some, velocity))
    _, rows, cols = seeds.best.shape
    return (some.window * rows + row) * cols + col


def _find_best(sweeps: HeightSlicedSweeps, found: Looks, velocities: Tensor) -> _Best:
    """Of each cell the best velocity of the 3 x 3 cells around; of equals the first cell.

    What is best in a cell counts only if it is believed, see `_is_of_walker`.
    """
    side = max(1, round(_CELL / sweeps.grid.pixel_size))
    shape = (sweeps.num_windows, -(-sweeps.grid.height // side), -(-sweeps.grid.width // side))
    own = _Best(
        side,
        torch.full(shape, -1, dtype=torch.int64, device=velocities.device),
        torch.zeros(shape, dtype=torch.float64, device=velocities.device),
    )
    best, best_z = own.best.view(-1), own.z.view(-1)
    for index, velocity in enumerate(velocities):
        won, lost = wins(sweeps, found, velocity)
        counts = (won.long() << 32) + lost  # both in one number: sums cost more than look-ups
        says = flat_nonzero((won | lost).bool())
        at = _cell(sweeps, found, velocity, own).index_select(0, says)
        sums = torch.zeros_like(best).index_add_(0, at, counts.index_select(0, says))
        sums = _sum_around(sums.view(shape)).view(-1)
        cell = flat_nonzero(sums >= _LEAST_WON << 32)
        sums = sums.index_select(0, cell)
        surplus, noise = ((sums >> 32) - (sums & _LOW)).double(), ((sums >> 32) + (sums & _LOW)).double()
        z = surplus / torch.sqrt(noise)
        better = flat_nonzero(z > best_z.index_select(0, cell))
        cell = cell.index_select(0, better)
        best.index_fill_(0, cell, index)
        best_z.index_copy_(0, cell, z.index_select(0, better))
    cell = flat_nonzero(best >= 0)
    window = divide(cell, shape[1] * shape[2])
    is_believed = _is_of_walker(sweeps, velocities)[window, best.index_select(0, cell)]
    cell = cell.index_select(0, flat_nonzero(~is_believed))
    best.index_fill_(0, cell, -1)
    best_z.index_fill_(0, cell, 0.0)
    z, place = F.max_pool2d(own.z[:, None], 3, 1, 1, return_indices=True)
    best = best.view(shape[0], -1).gather(1, place.view(shape[0], -1))
    return _Best(side, best.view(shape), z.view(shape))


def _sum_around(values: Tensor) -> Tensor:
    """(B, rows, cols): sums of the 3 x 3 elements around each."""
    rows = values.clone()
    rows[:, 1:] += values[:, :-1]
    rows[:, :-1] += values[:, 1:]
    around = rows.clone()
    around[:, :, 1:] += rows[:, :, :-1]
    around[:, :, :-1] += rows[:, :, 1:]
    return around


def _groups(sweeps: HeightSlicedSweeps, found: Looks, velocities: Tensor, seeds: _Best) -> Tuple[Tensor, Tensor]:
    """Pixels that win, with those around, by the velocity of the cell that it takes them to; joined cell by cell.

    Returns:
        group: (P,) int64 of each pixel, H = none.
        velocity: (H,) int64 of each group.

    Convention: of several velocities that of largest z takes a pixel, of equals the first.
    """
    best, z, count = seeds.best.view(-1), seeds.z.view(-1), len(velocities)
    occupied = flat_nonzero(best >= 0)
    component = torch.zeros_like(best).index_copy_(0, occupied, connected_components(seeds.best >= 0, occupied))
    name = torch.full_like(sweeps.pixel, -1)  # component * count + velocity, -1 = none
    strength = torch.zeros_like(name, dtype=torch.float64)
    for index in torch.unique(best.index_select(0, occupied)).tolist():
        cell = _cell(sweeps, found, velocities[index], seeds)
        near = flat_nonzero(best.index_select(0, cell) == index)
        some, cell = found.take(near), cell.index_select(0, near)
        is_stronger = z.index_select(0, cell) > strength.index_select(0, some.pixel)
        taken = flat_nonzero(is_stronger & (_gain_around(sweeps, some, velocities[index]) > 0))
        pixel, cell = some.pixel.index_select(0, taken), cell.index_select(0, taken)
        # Looks of one pixel are taken to one cell: all that write at one place write the same.
        strength.index_copy_(0, pixel, z.index_select(0, cell))
        name.index_copy_(0, pixel, component.index_select(0, cell) * count + index)
    names, group = torch.unique(F.pad(name, (1, 0), value=-1), return_inverse=True)  # -1 is there, the first one
    return (group[1:] - 1).remainder_(names.numel()), names[1:] % count


def _gain_around(sweeps: HeightSlicedSweeps, some: Looks, velocity: Tensor) -> Tensor:
    """(L,) int64: slices that a velocity, (2,) float64, wins less those that it loses, by all looks whose pixels it
    takes to one of the 3 x 3 pixels around that of each look at t+1."""
    won, lost = wins(sweeps, some, velocity)
    row, col = at_newest(sweeps, some, velocity)
    # One more row and column, which are empty: the last pixel of a row is not beside the first one of the next.
    height, width = sweeps.grid.height + 1, sweeps.grid.width + 1
    place, of_look = torch.unique((some.window * height + row) * width + col, return_inverse=True)
    gain = torch.zeros_like(place).index_add_(0, of_look, won.long() - lost.long())
    around = torch.zeros_like(gain)
    for offset in (down * width + right for down in (-1, 0, 1) for right in (-1, 0, 1)):
        at = torch.searchsorted(place, place + offset).clamp_(max=place.numel() - 1)
        around += gain.index_select(0, at) * (place.index_select(0, at) == place + offset)
    return around.index_select(0, of_look)


def _wins_of_groups(sweeps: HeightSlicedSweeps, found: Looks, group: Tensor, motion: Tensor) -> Tuple[Tensor, Tensor]:
    """(H,) int64 each: what groups of pixels, (P,) int64, win and lose by their motions, (H, 2) float64."""
    own = group.index_select(0, found.pixel)
    member = flat_nonzero(own < len(motion))
    some, own = found.take(member), own.index_select(0, member)
    counts = wins(sweeps, some, motion.index_select(0, own).t())
    zeros = torch.zeros_like(motion[:, 0], dtype=torch.int64)
    won, lost = (zeros.index_add(0, own, count.long()) for count in counts)
    return won, lost


def _num_slices(sweeps: HeightSlicedSweeps, group: Tensor, count: int) -> Tensor:
    """(H,) int64: height slices of each of `count` groups of pixels, (P,) int64."""
    has = torch.zeros((NUM_SLICES, count + 1), dtype=torch.bool, device=group.device)
    for index, of_slice in enumerate(has):
        of_slice.index_fill_(0, group.index_select(0, flat_nonzero((sweeps.slices & (1 << index)).bool())), True)
    return has.sum(0)[:count]
