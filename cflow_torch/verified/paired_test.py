"""The paired test: candidate motions of components against standing still, over all sweeps, both ways (McNemar's)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Tuple

import torch
import torch.nn.functional as F
from torch import Tensor

from cflow_torch.config import VerifiedConfig
from cflow_torch.ops.indices import flat_nonzero
from cflow_torch.verified.aperture import slides_along_itself
from cflow_torch.verified.component_tree import Level
from cflow_torch.verified.height_slices import NUM_SLICES, HeightSlicedSweeps, count_slices

# Look-ups (pixel x sweep x candidate) done at once: their temporaries take about 64 bytes each.
_LOOKS_ON_CPU = 1 << 18
_LOOKS_ON_GPU = 1 << 24
_FAR = 2  # pixels, in y or in x
_FARTHER, _STILL_THERE = 4, 97  # pixels, per cent


@dataclass(frozen=True)
class VerifiedLevel:
    """A level and the best motion of each of its M components.

    Args:
        level: the components.
        motion: (M, 2) float64, (y, x), finest pixels per sweep interval; 0 = none is significant.
        evidence: (M,) int64, of that motion, sixteenths of a slice.
        score: as in `Candidates`.
    """

    level: Level
    motion: Tensor
    evidence: Tensor
    score: Tensor


def verify(
    level: Level, motion: Tensor, score: Tensor, sweeps: HeightSlicedSweeps, config: VerifiedConfig
) -> VerifiedLevel:
    """The candidate of each component that explains the sweeps best, if it does so significantly.

    Args:
        level: M components.
        motion, score: as in `Candidates`.
        sweeps: finest images.
        config: `significance`, `thorough`.
    """
    tested = (motion != 0).any(2).any(1) & ~level.too_long
    evidence = evidence_of(*count_wins(sweeps, level.component, motion, tested), config.significance)
    if config.thorough:
        asked = tested & ~level.travels
        owner = torch.where(F.pad(asked, (0, 1)).index_select(0, level.component), level.component, tested.numel())
        evidence = evidence.masked_fill(slides_along_itself(sweeps, owner, motion), 0)
    best, most = best_candidate(evidence, motion)
    stands = is_found_where_it_stands(sweeps, level.component, best)
    return VerifiedLevel(level, best.masked_fill(stands[:, None], 0.0), most.masked_fill(stands, 0), score)


def count_wins(
    sweeps: HeightSlicedSweeps, component: Tensor, candidates: Tensor, tested: Tensor
) -> Tuple[Tensor, Tensor]:
    """Paired counts of candidate motions against standing still.

    A slice of a pixel is won by a motion if another sweep has it where the motion takes the pixel and not where the
    pixel is; it is lost the other way round. Slices found in both places, or in neither, say nothing. A motion of two
    pixels or more finds a slice "not" in a place only if none of the 3 x 3 pixels there has it: beams meet a side at
    other places in each sweep, and a side that stands must not look as if it had left.

    Args:
        sweeps: finest images and their P occupied pixels.
        component: (P,) int64, component of each occupied pixel, M = none.
        candidates: (M, C, 2) float64, (y, x) finest pixels per sweep interval, axes of ego1; C at least 1.
        tested: (M,) bool, False = its counts are 0 and cost nothing.

    Returns:
        won, lost: (M, C) int64 slices, summed over all sweeps m before t+1: m looks at t+1, t+1 looks at m.

    Convention:
        A pixel is taken by floor(k f + 0.5) pixels, elementwise float64; k = elapsed intervals, negative from t+1 into
        the past. What it meets counts whatever component it is of. A place outside the image has nothing, nor has any
        of the pixels around it. Sweeps that a window lacks are empty: no counts.
        Fewer than 2^31 slices of a component may be compared.

    Cost: P (S - 1) C look-ups at most, of the pixels of tested components only.
    """
    (count, num_candidates, _), num_steps = candidates.shape, sweeps.num_steps
    pixel, other = looks(sweeps, flat_nonzero(F.pad(tested, (0, 1)).index_select(0, component)))
    sums = torch.zeros(count * num_candidates, dtype=torch.int64, device=component.device)
    column = torch.arange(num_candidates, device=component.device)
    window = F.pad(torch.zeros_like(tested, dtype=torch.int64), (0, 1)).scatter_(0, component, sweeps.window)
    chosen, number = flat_nonzero(tested), tested.cumsum(0) - 1
    elapsed = sweeps.elapsed.index_select(0, window.index_select(0, chosen))
    moves = moves_of(elapsed, candidates.index_select(0, chosen))
    is_far = moves.abs().amax(2) >= _FAR
    counts_of = _counts_of(component.device)
    at_once = _LOOKS_ON_CPU if component.device.type == "cpu" else _LOOKS_ON_GPU
    size = max(1, at_once // num_candidates)
    for some, step in zip(pixel.split(size), other.split(size)):
        window, row, col, of_some = (
            values.index_select(0, some) for values in (sweeps.window, sweeps.row, sweeps.col, component)
        )
        way = way_of(sweeps.step.index_select(0, some), step, num_steps)
        which = number.index_select(0, of_some) * (2 * num_steps) + way
        seen = sweeps.with_around.index_select(0, sweeps.index(window, step, row, col))
        own = sweeps.slices.index_select(0, some)
        here, near_here = own & seen, own & (seen >> NUM_SLICES)
        seen = sweeps.at_moved(sweeps.with_around, window, step, row, col, moves, which)
        far = is_far.index_select(0, which)
        won = seen & torch.where(far, (own & ~near_here)[:, None], (own & ~here)[:, None])
        lost = here[:, None] & ~torch.where(far, seen >> NUM_SLICES, seen)
        counts = counts_of.index_select(0, (won | lost << NUM_SLICES).view(-1).int())
        sums.index_add_(0, (of_some[:, None] * num_candidates + column).view(-1), counts)
    sums = sums.view(count, num_candidates)
    return sums >> 32, sums & 0xFFFFFFFF


def moves_of(elapsed: Tensor, motion: Tensor) -> Tensor:
    """(T * 2 S, C, 2) int64, whole pixels that motions, (T, C, 2) float64 per sweep interval, lead from each sweep to
    t+1, then from t+1 to each. elapsed: (T, S) float64, intervals."""
    k = torch.cat((elapsed, -elapsed), 1)[:, :, None, None]
    return (motion[:, None] * k + 0.5).floor_().long().flatten(0, 1)


def way_of(step: Tensor, other: Tensor, num_steps: int) -> Tensor:
    """(L,) int64: which of the 2 S ways of `moves_of` leads from a sweep to the other; one of the two is t+1."""
    return torch.where(other > 0, num_steps + other, step)


def _counts_of(device: torch.device) -> Tensor:
    """(256,) int64: set bits of the lower half of a byte times 2^32, plus those of its upper half. Both counts are in
    one number because sums cost more than look-ups."""
    byte = torch.arange(256, dtype=torch.uint8, device=device)
    return (count_slices(byte & 15).long() << 32) + count_slices(byte >> NUM_SLICES).long()


def is_found_where_it_stands(sweeps: HeightSlicedSweeps, component: Tensor, motion: Tensor) -> Tensor:
    """Which components have not moved as a whole, because nearly all of them is still where it was: a wall beside which
    somebody walks.

    Args:
        sweeps: finest images and their P occupied pixels.
        component: (P,) int64, component of each occupied pixel, M = none.
        motion: (M, 2) float64, (y, x) finest pixels per sweep interval.

    Returns:
        (M,) bool: of the slices in looks that the motion takes at least four pixels, in y or in x, at least 97 per cent
        are found within a pixel of where they stand. False without such looks.

    Cost: a look-up for each pixel and sweep of what moves.
    """
    moves = motion.any(1)
    pixel, other = looks(sweeps, flat_nonzero(F.pad(moves, (0, 1)).index_select(0, component)))
    owner, window = component.index_select(0, pixel), sweeps.window.index_select(0, pixel)
    k = sweeps.elapsed[window, sweeps.step.index_select(0, pixel)] - sweeps.elapsed[window, other]
    move = (motion.index_select(0, owner) * k[:, None] + 0.5).floor_().abs().amax(1)
    far = flat_nonzero(move >= _FARTHER)
    pixel, other, owner, window = (values.index_select(0, far) for values in (pixel, other, owner, window))
    row, col, own = (values.index_select(0, pixel) for values in (sweeps.row, sweeps.col, sweeps.slices))
    near = sweeps.with_around.index_select(0, sweeps.index(window, other, row, col)) >> NUM_SLICES
    zeros = torch.zeros_like(motion[:, 0], dtype=torch.int64)
    total, found = (zeros.index_add(0, owner, count_slices(slices).long()) for slices in (own, own & near))
    return (total > 0) & (100 * found >= _STILL_THERE * total)


def looks(sweeps: HeightSlicedSweeps, member: Tensor) -> Tuple[Tensor, Tensor]:
    """(L,) int64 each: pixels that look at another sweep, and the sweep. Some (K,) int64 pixels are members."""
    step = sweeps.step.index_select(0, member)
    older = member.index_select(0, flat_nonzero(step > 0))
    newest = member.index_select(0, flat_nonzero(step == 0))
    every = torch.arange(1, sweeps.num_steps, device=member.device)
    pixel = torch.cat((older, newest.repeat(every.numel())))
    return pixel, torch.cat((torch.zeros_like(older), every.repeat_interleave(newest.numel())))


def evidence_of(won: Tensor, lost: Tensor, z: float) -> Tensor:
    """What each motion explains beyond noise: (won - lost) - z sqrt(won + lost), in sixteenths of a slice.

    Args:
        won, lost: int64 of one shape, below 2^31.
        z: standard deviations that noise is granted; 0 = every surplus counts.

    Returns:
        int64, same shape, rounded down; 0 = not significant.
    """
    surplus, noise = (won - lost).double(), torch.sqrt((won + lost).double())
    return (16 * (surplus - z * noise)).floor_().long().clamp_(min=0)


def best_candidate(evidence: Tensor, candidates: Tensor) -> Tuple[Tensor, Tensor]:
    """The motion of each component that has most evidence.

    Args:
        evidence: (M, C) int64, below 2^36 (C below 2^20), as `evidence_of` gives it.
        candidates: (M, C, 2) float64.

    Returns:
        motion: (M, 2) float64; 0 where no candidate has any.
        evidence: (M,) int64, of that motion.

    Convention: of equal candidates the first.
    """
    num_candidates = evidence.shape[1]
    reverse = torch.arange(num_candidates - 1, -1, -1, device=evidence.device)
    key = (evidence * num_candidates + reverse).amax(1)  # no two candidates have the same
    most = torch.div(key, num_candidates, rounding_mode="floor")
    best = num_candidates - 1 - (key - most * num_candidates)
    motion = candidates.gather(1, best[:, None, None].expand(-1, 1, 2))[:, 0]
    return motion.masked_fill((most == 0)[:, None], 0.0), most
