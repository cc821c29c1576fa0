"""Local motion: slow walkers beside a wall, in a hedge, in a crowd move within a component that stands.

With history a walker leaves its place by several pixels, and a paired test on its own pixels shows it. What stood still
so far is tested at a grid of small velocities, all at once, over squares as wide as a walker; where one of them seems
to fit, at a finer grid.
"""

from __future__ import annotations

from typing import List, NamedTuple, Tuple

import torch
import torch.nn.functional as F
from torch import Tensor

from cflow_torch.ops.indices import divide, flat_nonzero, split_index
from cflow_torch.ops.labeling import connected_components
from cflow_torch.ops.segments import segment_amin
from cflow_torch.verified.component_tree import Objects
from cflow_torch.verified.height_slices import NUM_SLICES, HeightSlicedSweeps
from cflow_torch.verified.local_cells import Cells
from cflow_torch.verified.local_evidence import Looks, look, try_all
from cflow_torch.verified.paired_test import VerifiedLevel, evidence_of

_STEP, _REACH = 0.1, 3  # metres per sweep interval between velocities; steps to the fastest one
_FINER = 2  # parts of a step, where something seems to move: in five intervals half a step is 0.25 m
_SUSPECT_Z = 2  # standard deviations of noise that seem to
_FASTEST = 0.25  # metres per interval: what is best at a velocity beyond may be a shadow that is faster still
_SEED_Z = 6  # standard deviations of noise that such a square must show
_LEAST_WON = 16  # slices; a square that wins fewer is not looked at: it cannot show four standard deviations
_Z = 4.0  # standard deviations of noise that a group as a whole is granted
_UPRIGHT = 3  # height slices that it must have: rings of beams on a bonnet or a roof move as well


class _Best(NamedTuple):
    """What moves where at t+1, by cells of all windows.

    Args:
        best: (B, rows, cols) int64, number of the best velocity, -1 = none.
        z: (B, rows, cols) float64, its surplus in standard deviations of noise; 0 = none.
    """

    best: Tensor
    z: Tensor


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
        a pixel wins or loses counts where its velocity takes it at t+1. Squares that show two standard deviations are
        tested again, at steps of 0.05 m.

    Cost: 28 look-ups for each pixel at rest and sweep that finds something new, or is near to what does; 112 for the
    few near such a square; a range image of each sweep.
    """
    at_rest = ~F.pad(motion.any(1), (0, 1)).index_select(0, objects.of_pixel)
    has_history = ((sweeps.elapsed != 0).sum(1) > 1).index_select(0, sweeps.window)
    members, no_doubt = flat_nonzero(at_rest & has_history), torch.zeros_like(sweeps.row, dtype=torch.float64)
    if members.numel() == 0:
        return objects, motion, no_doubt
    found, cells = look(sweeps, members), Cells(sweeps, _velocities(sweeps))
    suspects = flat_nonzero(_try_everywhere(sweeps, found, cells).z.view(-1) >= _SUSPECT_Z)
    if suspects.numel() == 0:
        return objects, motion, no_doubt
    cells = Cells(sweeps, _velocities(sweeps, _FINER))
    found, trials, around = _try_at(sweeps, found, suspects, cells)
    doubt = around.z.view(-1).index_select(0, cells.own(sweeps.window, sweeps.row, sweeps.col))
    is_seed = around.z >= _SEED_Z
    if not bool(is_seed.any()):
        return objects, motion, doubt
    seeds = _Best(around.best.masked_fill(~is_seed, -1), around.z.masked_fill(~is_seed, 0.0))
    group, of_group = _groups(sweeps, found, trials, seeds, cells)
    candidates = cells.velocities.index_select(0, of_group)
    is_significant = evidence_of(*_wins_of_groups(found, trials, group, of_group), _Z) > 0
    moves = is_significant & (_num_slices(sweeps, group, len(candidates)) >= _UPRIGHT)
    num_components = sum(level.level.num_components for level in levels)
    of_component = F.pad(candidates, (0, 0, num_components, 0)).index_copy_(0, objects.component, motion)
    objects = objects.split(group, moves, num_components)
    return objects, of_component.index_select(0, objects.component), doubt


def _velocities(sweeps: HeightSlicedSweeps, parts: int = 1) -> Tensor:
    """(V, 2) float64, (y, x), finest pixels per sweep interval: 28, or 112 of half a step."""
    reach = _REACH * parts
    line = torch.arange(-reach, reach + 1, device=sweeps.elapsed.device)
    grid = torch.cartesian_prod(line, line)
    square = (grid * grid).sum(1)
    grid = grid.index_select(0, flat_nonzero((square > 0) & (square <= reach * reach)))
    return grid.double() * (_STEP / parts / sweeps.grid.pixel_size)


def _is_of_walker(sweeps: HeightSlicedSweeps, velocities: Tensor) -> Tensor:
    """(B, V) bool: which velocities are believed. What is best beyond `_FASTEST` may be a shadow that is faster still;
    rings of beams on a roof or a wall move as the sensor does."""
    size = sweeps.grid.pixel_size
    of_sensor = -sweeps.batch.origin[:, 1, :2].flip(1) / (sweeps.elapsed[:, 1] * size)[:, None]
    off = torch.linalg.vector_norm(velocities - of_sensor[:, None], dim=2)
    stands = torch.linalg.vector_norm(of_sensor, dim=1) * size < _STEP / 2
    return ((off > 1.05 * _STEP / size) | stands[:, None]) & (
        torch.linalg.vector_norm(velocities, dim=1) * size < _FASTEST
    )


def _try_everywhere(sweeps: HeightSlicedSweeps, found: Looks, cells: Cells) -> _Best:
    """The best velocity of each cell."""
    sums = _sums_of_winners(sweeps, found, cells)
    asked = flat_nonzero(sums >= _LEAST_WON)
    gain = sums.index_select(0, asked)
    found, place, is_near = _looks_near(found, asked, cells)
    _, lost = try_all(sweeps, found, cells.velocities)
    loses = flat_nonzero(is_near & lost.bool())
    place, losses = (values.view(-1).index_select(0, loses) for values in (place, lost))
    cells.add_around(sums, place, -losses.int())
    loss = gain - sums.index_select(0, asked)
    return _find_best(sweeps, asked, gain, loss, cells)


def _try_at(
    sweeps: HeightSlicedSweeps, found: Looks, some: Tensor, cells: Cells
) -> Tuple[Looks, Tuple[Tensor, Tensor], _Best]:
    """The best velocity of some cells, (R,) int64; the looks that may count there, and what every velocity wins and
    loses in them."""
    count, num_cells = len(cells.velocities), some.numel()
    is_near = torch.zeros(cells.count, dtype=torch.bool, device=some.device)
    is_near.index_fill_(0, (some[:, None] + cells.within_reach()).view(-1), True)
    found = found.take(flat_nonzero(is_near.index_select(0, cells.own(found.window, found.row, found.col))))
    won, lost = try_all(sweeps, found, cells.velocities)
    number = torch.full((cells.count,), num_cells, device=some.device)
    number.index_copy_(0, some, torch.arange(num_cells, device=some.device))
    counted = flat_nonzero(won | lost)
    velocity, cell = split_index(cells.at_newest(found).view(-1).index_select(0, counted).long(), cells.count)
    gain, loss = sums = torch.zeros((2, count * (num_cells + 1)), dtype=torch.int32, device=some.device)
    for offset in cells.around():
        at = velocity * (num_cells + 1) + number.index_select(0, cell + offset)
        for out, counts in zip(sums, (won, lost)):
            out.index_add_(0, at, counts.view(-1).index_select(0, counted).int())
    velocity, own = split_index(flat_nonzero(gain >= _LEAST_WON), num_cells + 1)
    is_asked = flat_nonzero(own < num_cells)
    velocity, own = velocity.index_select(0, is_asked), own.index_select(0, is_asked)
    asked = velocity * (num_cells + 1) + own
    gain, loss = gain.index_select(0, asked), loss.index_select(0, asked)
    best = _find_best(sweeps, velocity * cells.count + some.index_select(0, own), gain, loss, cells)
    return found, (won, lost), best


def _sums_of_winners(sweeps: HeightSlicedSweeps, found: Looks, cells: Cells) -> Tensor:
    """(V * all cells,) int32, slices won in the 3 x 3 cells around each. Few looks find anything new."""
    new = found.take(flat_nonzero(found.own & ~found.here))
    won, _ = try_all(sweeps, new, cells.velocities)
    wins = flat_nonzero(won)
    place, won = (values.view(-1).index_select(0, wins) for values in (cells.at_newest(new), won))
    sums = torch.zeros(len(cells.velocities) * cells.count, dtype=torch.int32, device=won.device)
    cells.add_around(sums, place, won.int())
    return sums


def _looks_near(found: Looks, asked: Tensor, cells: Cells) -> Tuple[Looks, Tensor, Tensor]:
    """The looks that some velocity takes beside a cell that is asked about, (A,) int64 into (V, all cells); where each
    velocity takes them, as of `at_newest`; and (L, V) bool, whether that is beside such a cell."""
    is_near = torch.zeros(len(cells.velocities) * cells.count, dtype=torch.bool, device=asked.device)
    for offset in cells.around():
        is_near.index_fill_(0, asked + offset, True)
    place = cells.at_newest(found)
    near = is_near.index_select(0, place.view(-1)).view_as(place)
    kept = flat_nonzero(near.any(1))
    return found.take(kept), place.index_select(0, kept), near.index_select(0, kept)


def _find_best(sweeps: HeightSlicedSweeps, asked: Tensor, gain: Tensor, loss: Tensor, cells: Cells) -> _Best:
    """Of each cell the best velocity of the 3 x 3 cells around; of equals the first cell.

    What is best in a cell counts only if it is believed, see `_is_of_walker`.

    Args:
        asked: (A,) int64, velocity * count + cell.
        gain, loss: (A,) int32, slices that the velocity wins and loses there.
    """
    count, is_free = len(cells.velocities), cells.is_free().view(-1)
    velocity, at = split_index(asked, cells.count)
    z = (gain - loss).double() / torch.sqrt((gain + loss).double())
    z.masked_fill_(is_free.index_select(0, at), 0.0)
    most = z.new_zeros(cells.count).scatter_reduce_(0, at, z, "amax")
    is_best = (z > 0) & (z == most.index_select(0, at))
    first = segment_amin(torch.where(is_best, velocity, count), at, cells.count, count)
    is_believed = _is_of_walker(sweeps, cells.velocities)[divide(at, cells.count // sweeps.num_windows), velocity]
    chosen = flat_nonzero(is_best & (velocity == first.index_select(0, at)) & is_believed)
    at, best, best_z = at.index_select(0, chosen), torch.full_like(first, -1), torch.zeros_like(most)
    best.index_copy_(0, at, velocity.index_select(0, chosen))
    best_z.index_copy_(0, at, z.index_select(0, chosen))
    best_z, place = F.max_pool2d(best_z.view(cells.shape)[:, None], 3, 1, 1, return_indices=True)
    best = best.view(len(best_z), -1).gather(1, place.view(len(best_z), -1)).view(cells.shape)
    is_free = is_free.view(cells.shape)
    return _Best(best.masked_fill_(is_free, -1), best_z[:, 0].masked_fill_(is_free, 0.0))


def _groups(
    sweeps: HeightSlicedSweeps, found: Looks, trials: Tuple[Tensor, Tensor], seeds: _Best, cells: Cells
) -> Tuple[Tensor, Tensor]:
    """Pixels that win, with those around, by the velocity of the cell that it takes them to; joined cell by cell.

    Returns:
        group: (P,) int64 of each pixel, H = none.
        velocity: (H,) int64 of each group.

    Convention: of several velocities that of largest z takes a pixel, of equals the first.
    """
    best, z, count = seeds.best.view(-1), seeds.z.view(-1), len(cells.velocities)
    occupied = flat_nonzero(best >= 0)
    component = torch.zeros_like(best).index_copy_(0, occupied, connected_components(seeds.best >= 0, occupied))
    cell = cells.at_newest(found) % cells.count
    is_there = best.index_select(0, cell.view(-1)).view_as(cell) == torch.arange(count, device=cell.device)
    near = flat_nonzero(is_there)
    near = near.index_select(0, flat_nonzero(_gain_around(sweeps, found, trials, near, cells) > 0))
    look, velocity = split_index(near, count)
    cell, pixel = cell.view(-1).index_select(0, near), found.pixel.index_select(0, look)
    # Looks of one pixel are taken to one cell by a velocity: all of them say the same.
    strength = z.index_select(0, cell)
    most = torch.zeros_like(sweeps.pixel, dtype=torch.float64).scatter_reduce_(0, pixel, strength, "amax")
    is_strongest = strength == most.index_select(0, pixel)
    first = segment_amin(torch.where(is_strongest, velocity, count), pixel, sweeps.pixel.numel(), count)
    chosen = flat_nonzero(is_strongest & (velocity == first.index_select(0, pixel)))
    pixel, cell, velocity = (values.index_select(0, chosen) for values in (pixel, cell, velocity))
    name = torch.full_like(sweeps.pixel, -1)  # component * count + velocity, -1 = none
    name.index_copy_(0, pixel, component.index_select(0, cell) * count + velocity)
    names, group = torch.unique(F.pad(name, (1, 0), value=-1), return_inverse=True)  # -1 is there, the first one
    return (group[1:] - 1).remainder_(names.numel()), names[1:] % count


def _gain_around(
    sweeps: HeightSlicedSweeps, found: Looks, trials: Tuple[Tensor, Tensor], some: Tensor, cells: Cells
) -> Tensor:
    """(K,) int64: slices won less those lost by all of some looks under velocities, (K,) int64 into (L, V), that take
    their pixels to one of the 3 x 3 pixels around that of each at t+1, by the same velocity."""
    look, velocity = split_index(some, len(cells.velocities))
    window, step, row, col = (
        values.index_select(0, look) for values in (found.window, found.step, found.row, found.col)
    )
    k = sweeps.elapsed[window, step][:, None]
    down, right = torch.floor(cells.velocities.index_select(0, velocity) * k + 0.5).long().unbind(1)
    # More rows and columns, as the last cells may reach beyond the image, and an empty one: the last pixel of a row is
    # not beside the first one of the next.
    height, width = sweeps.grid.height + cells.side, sweeps.grid.width + cells.side
    image = velocity * sweeps.num_windows + window
    place, of_look = torch.unique((image * height + row + down) * width + col + right, return_inverse=True)
    won, lost = (counts.view(-1).index_select(0, some).long() for counts in trials)
    gain = torch.zeros_like(place).index_add_(0, of_look, won - lost)
    around = torch.zeros_like(gain)
    for offset in (down * width + right for down in (-1, 0, 1) for right in (-1, 0, 1)):
        at = torch.searchsorted(place, place + offset).clamp_(max=place.numel() - 1)
        around += gain.index_select(0, at) * (place.index_select(0, at) == place + offset)
    return around.index_select(0, of_look)


def _wins_of_groups(
    found: Looks, trials: Tuple[Tensor, Tensor], group: Tensor, velocity: Tensor
) -> Tuple[Tensor, Tensor]:
    """(H,) int64 each: what groups of pixels, (P,) int64, win and lose by their velocities, (H,) int64."""
    own = group.index_select(0, found.pixel)
    member = flat_nonzero(own < velocity.numel())
    own = own.index_select(0, member)
    of_own = velocity.index_select(0, own)
    won, lost = (torch.zeros_like(velocity).index_add_(0, own, counts[member, of_own].long()) for counts in trials)
    return won, lost


def _num_slices(sweeps: HeightSlicedSweeps, group: Tensor, count: int) -> Tensor:
    """(H,) int64: height slices of each of `count` groups of pixels, (P,) int64."""
    has = torch.zeros((NUM_SLICES, count + 1), dtype=torch.bool, device=group.device)
    for index, of_slice in enumerate(has):
        of_slice.index_fill_(0, group.index_select(0, flat_nonzero((sweeps.slices & (1 << index)).bool())), True)
    return has.sum(0)[:count]
