"""Local motion: slow walkers beside a wall, in a hedge, in a crowd move within a component that stands.

With history a walker leaves its place by several pixels, and a paired test on its own pixels shows it. What stood still
so far is tested at a grid of small velocities, all at once, over squares as wide as a walker.
"""

from __future__ import annotations

import math
from typing import List, NamedTuple, Tuple

import torch
import torch.nn.functional as F
from torch import Tensor

from cflow_torch.ops.indices import divide, flat_nonzero, split_index
from cflow_torch.ops.labeling import connected_components
from cflow_torch.ops.segments import segment_amin
from cflow_torch.verified.component_tree import Objects
from cflow_torch.verified.height_slices import NUM_SLICES, HeightSlicedSweeps
from cflow_torch.verified.local_evidence import Looks, Trials, look, try_all
from cflow_torch.verified.paired_test import VerifiedLevel, evidence_of

_STEP, _REACH = 0.1, 3  # metres per sweep interval between velocities; steps to the fastest one
_FASTEST = 0.25  # metres per interval: what is best at a velocity beyond may be a shadow that is faster still
_CELL = 0.3  # metres; won and lost are summed over 3 x 3 cells
_SEED_Z = 6  # standard deviations of noise that such a square must show
_LEAST_WON = 4  # slices; a square that wins fewer is not looked at
_Z = 4.0  # standard deviations of noise that a group as a whole is granted
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

    def cell(self, window: Tensor, row: Tensor, col: Tensor) -> Tensor:
        """The cell of pixels, counted through all windows; int64 of one shape."""
        _, rows, cols = self.z.shape
        return (window * rows + divide(row, self.side)) * cols + divide(col, self.side)

    def at(self, window: Tensor, row: Tensor, col: Tensor) -> Tensor:
        """(P,) float64: z at pixels, (P,) int64 each."""
        return self.z.view(-1).index_select(0, self.cell(window, row, col))

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

    Cost: 28 look-ups for each pixel at rest and sweep that finds something new, or is near to what does; a range image
    of each sweep.
    """
    at_rest = ~F.pad(motion.any(1), (0, 1)).index_select(0, objects.of_pixel)
    has_history = ((sweeps.elapsed != 0).sum(1) > 1).index_select(0, sweeps.window)
    members = flat_nonzero(at_rest & has_history)
    if members.numel() == 0:
        return objects, motion, torch.zeros_like(sweeps.row, dtype=torch.float64)
    velocities = _velocities(sweeps)
    found = look(sweeps, members)
    side = max(1, round(_CELL / sweeps.grid.pixel_size))
    tried = try_all(sweeps, found.take(_near_winners(sweeps, found, velocities, side)), velocities)
    around = _find_best(sweeps, tried, velocities, side)
    doubt = around.at(sweeps.window, sweeps.row, sweeps.col)
    seeds = around.only(around.z >= _SEED_Z)
    if not bool((seeds.best >= 0).any()):
        return objects, motion, doubt
    group, of_group = _groups(sweeps, tried, seeds)
    candidates = velocities.index_select(0, of_group)
    moves = (evidence_of(*_wins_of_groups(tried, group, of_group), _Z) > 0) & (
        _num_slices(sweeps, group, len(candidates)) >= _UPRIGHT
    )
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


def _near_winners(sweeps: HeightSlicedSweeps, found: Looks, velocities: Tensor, side: int) -> Tensor:
    """(K,) int64: looks that may count in a cell that wins enough. Few find anything new; of these alone it is asked
    first where they are taken."""
    new = found.take(flat_nonzero(found.own & ~found.here))
    sums = _sums_around(sweeps, try_all(sweeps, new, velocities), side)
    wins = (sums >= _LEAST_WON << 16).any(0)
    farthest = float(sweeps.elapsed.abs().amax()) * _REACH * _STEP / sweeps.grid.pixel_size
    reach = int(farthest / side) + 2
    near = wins[:, None].float()
    for size in ((2 * reach + 1, 1), (1, 2 * reach + 1)):
        near = F.max_pool2d(near, size, 1, (size[0] // 2, size[1] // 2))
    _, _, rows, cols = near.shape
    row, col = divide(found.row, side) + 1, divide(found.col, side) + 1
    return flat_nonzero(near.view(-1).index_select(0, (found.window * rows + row) * cols + col))


def _sums_around(sweeps: HeightSlicedSweeps, tried: Trials, side: int) -> Tensor:
    """(V, B, rows + 2, cols + 2) int32, won * 2^16 + lost in the 3 x 3 cells around each; of the free cells around the
    images it means nothing."""
    says = flat_nonzero(tried.won | tried.lost)
    look, velocity = split_index(says, tried.won.shape[1])
    row, col, won, lost = (
        values.view(-1).index_select(0, says) for values in (tried.row, tried.col, tried.won, tried.lost)
    )
    rows, cols = (-(-size // side) + 2 for size in (sweeps.grid.height, sweeps.grid.width))
    image = velocity * sweeps.num_windows + tried.looks.window.index_select(0, look)
    cell = (image * rows + divide(row, side) + 1) * cols + divide(col, side) + 1
    counts = (won.int() << 16) + lost
    shape = (tried.won.shape[1], sweeps.num_windows, rows, cols)
    sums = torch.zeros(math.prod(shape), dtype=torch.int32, device=cell.device)
    for offset in (down * cols + right for down in (-1, 0, 1) for right in (-1, 0, 1)):
        sums.index_add_(0, cell + offset, counts)
    return sums.view(shape)


def _find_best(sweeps: HeightSlicedSweeps, tried: Trials, velocities: Tensor, side: int) -> _Best:
    """Of each cell the best velocity of the 3 x 3 cells around; of equals the first cell.

    What is best in a cell counts only if it is believed, see `_is_of_walker`.
    """
    sums = _sums_around(sweeps, tried, side)
    asked = flat_nonzero(sums[:, :, 1:-1, 1:-1] >= _LEAST_WON << 16)
    shape = (sweeps.num_windows, sums.shape[2] - 2, sums.shape[3] - 2)
    velocity, cell = split_index(asked, math.prod(shape))
    line, col = split_index(cell, shape[2])
    window, row = split_index(line, shape[1])
    counts = sums[velocity, window, row + 1, col + 1]
    won, lost = counts >> 16, counts & 0xFFFF
    z = (won - lost).double() / torch.sqrt((won + lost).double())
    most = z.new_zeros(math.prod(shape)).scatter_reduce_(0, cell, z, "amax")
    is_best = (z > 0) & (z == most.index_select(0, cell))
    first = segment_amin(torch.where(is_best, velocity, len(velocities)), cell, most.numel(), len(velocities))
    is_believed = _is_of_walker(sweeps, velocities)[window, velocity]
    chosen = flat_nonzero(is_best & (velocity == first.index_select(0, cell)) & is_believed)
    cell, best, best_z = cell.index_select(0, chosen), torch.full_like(first, -1), torch.zeros_like(most)
    best.index_copy_(0, cell, velocity.index_select(0, chosen))
    best_z.index_copy_(0, cell, z.index_select(0, chosen))
    best_z, place = F.max_pool2d(best_z.view(shape)[:, None], 3, 1, 1, return_indices=True)
    best = best.view(shape[0], -1).gather(1, place.view(shape[0], -1))
    return _Best(side, best.view(shape), best_z.view(shape))


def _groups(sweeps: HeightSlicedSweeps, tried: Trials, seeds: _Best) -> Tuple[Tensor, Tensor]:
    """Pixels that win, with those around, by the velocity of the cell that it takes them to; joined cell by cell.

    Returns:
        group: (P,) int64 of each pixel, H = none.
        velocity: (H,) int64 of each group.

    Convention: of several velocities that of largest z takes a pixel, of equals the first.
    """
    best, z, count = seeds.best.view(-1), seeds.z.view(-1), tried.won.shape[1]
    occupied = flat_nonzero(best >= 0)
    component = torch.zeros_like(best).index_copy_(0, occupied, connected_components(seeds.best >= 0, occupied))
    cell = seeds.cell(tried.looks.window[:, None], tried.row, tried.col)
    is_there = best.index_select(0, cell.view(-1)).view_as(cell) == torch.arange(count, device=cell.device)
    near = flat_nonzero(is_there)
    look, velocity = split_index(near, count)
    cell = cell.view(-1).index_select(0, near)
    taken = flat_nonzero(_gain_around(sweeps, tried, near) > 0)
    cell, velocity = cell.index_select(0, taken), velocity.index_select(0, taken)
    pixel = tried.looks.pixel.index_select(0, look.index_select(0, taken))
    # Looks of one pixel are taken to one cell by a velocity: all of them say the same.
    strength = z.index_select(0, cell)
    most = torch.zeros_like(sweeps.pixel, dtype=torch.float64).scatter_reduce_(0, pixel, strength, "amax")
    strongest = flat_nonzero(strength == most.index_select(0, pixel))
    pixel, cell, velocity = (values.index_select(0, strongest) for values in (pixel, cell, velocity))
    first = segment_amin(velocity, pixel, sweeps.pixel.numel(), count)
    chosen = flat_nonzero(velocity == first.index_select(0, pixel))
    pixel, cell, velocity = (values.index_select(0, chosen) for values in (pixel, cell, velocity))
    name = torch.full_like(sweeps.pixel, -1)  # component * count + velocity, -1 = none
    name.index_copy_(0, pixel, component.index_select(0, cell) * count + velocity)
    names, group = torch.unique(F.pad(name, (1, 0), value=-1), return_inverse=True)  # -1 is there, the first one
    return (group[1:] - 1).remainder_(names.numel()), names[1:] % count


def _gain_around(sweeps: HeightSlicedSweeps, tried: Trials, some: Tensor) -> Tensor:
    """(K,) int64: slices won less those lost by all of some looks under velocities, (K,) int64 into the (L, V) trials,
    that take their pixels to one of the 3 x 3 pixels around that of each at t+1, by the same velocity."""
    look, velocity = split_index(some, tried.won.shape[1])
    row, col, won, lost = (
        values.view(-1).index_select(0, some) for values in (tried.row, tried.col, tried.won, tried.lost)
    )
    # One more row and column, which are empty: the last pixel of a row is not beside the first one of the next.
    height, width = sweeps.grid.height + 1, sweeps.grid.width + 1
    image = velocity * sweeps.num_windows + tried.looks.window.index_select(0, look)
    place, of_look = torch.unique((image * height + row) * width + col, return_inverse=True)
    gain = torch.zeros_like(place).index_add_(0, of_look, won.long() - lost.long())
    around = torch.zeros_like(gain)
    for offset in (down * width + right for down in (-1, 0, 1) for right in (-1, 0, 1)):
        at = torch.searchsorted(place, place + offset).clamp_(max=place.numel() - 1)
        around += gain.index_select(0, at) * (place.index_select(0, at) == place + offset)
    return around.index_select(0, of_look)


def _wins_of_groups(tried: Trials, group: Tensor, velocity: Tensor) -> Tuple[Tensor, Tensor]:
    """(H,) int64 each: what groups of pixels, (P,) int64, win and lose by their velocities, (H,) int64."""
    own = group.index_select(0, tried.looks.pixel)
    member = flat_nonzero(own < velocity.numel())
    own = own.index_select(0, member)
    of_own = velocity.index_select(0, own)
    zeros = torch.zeros_like(velocity)
    won, lost = (zeros.index_add(0, own, counts[member, of_own].long()) for counts in (tried.won, tried.lost))
    return won, lost


def _num_slices(sweeps: HeightSlicedSweeps, group: Tensor, count: int) -> Tensor:
    """(H,) int64: height slices of each of `count` groups of pixels, (P,) int64."""
    has = torch.zeros((NUM_SLICES, count + 1), dtype=torch.bool, device=group.device)
    for index, of_slice in enumerate(has):
        of_slice.index_fill_(0, group.index_select(0, flat_nonzero((sweeps.slices & (1 << index)).bool())), True)
    return has.sum(0)[:count]
