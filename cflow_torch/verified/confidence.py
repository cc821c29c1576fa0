"""How far the flow of a point can be trusted: counts that need no truth -> a probability (docs/verified.md).

What moves is trusted by how much worse its motion explains the sweeps when it is displaced: along a wall that slides or
a trunk of few points nothing gets worse. What stands still is trusted by the share of its neighbourhood that is found
again. What could not be linked to t+1 is trusted the less the more of it there is.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Sequence, Tuple

import torch
import torch.nn.functional as F
from torch import Tensor

from cflow_torch.ops.indices import divide, flat_nonzero
from cflow_torch.verified.component_tree import Objects
from cflow_torch.verified.height_slices import HeightSlicedSweeps, count_slices
from cflow_torch.verified.rigid_motion import RigidMotion

# Bounds of the bins and the probabilities, written by scripts/ablation/calibrate_confidence.py. Bins, in order: left
# out; unlinked, by `crowd`; still, by `share`, or where a local motion is likely by `doubt`; moving, by `margin`: pairs
# near, pairs far, with history near and far.
TABLE = json.loads(Path(__file__).with_name("confidence.json").read_text(encoding="utf-8"))
BLOCK = 1.6  # metres, sides of a neighbourhood


def confidence_of(
    sweeps: HeightSlicedSweeps, objects: Objects, rigid: RigidMotion, margin: Tensor, doubt: Tensor
) -> Tensor:
    """Probability that the motion of a pixel of t is right to 0.1 m per sweep interval.

    Args:
        sweeps: finest images, P occupied pixels.
        objects: G of them.
        rigid: their motion. Turns are not looked at: an object counts as it moves at its centre.
        margin: (G,) float64, of each motion, `Margin.z`.
        doubt: (P,) float64, how much speaks for a local motion around each pixel, standard deviations of noise.

    Returns:
        (P + 1,) float32; entry P is for points whose pixel was left out. Means nothing for pixels of other sweeps.

    Cost: one look-up for each pixel of t.
    """
    probabilities = torch.tensor(TABLE["probabilities"], dtype=torch.float32, device=sweeps.elapsed.device)
    return probabilities.index_select(0, F.pad(_bins(sweeps, objects, rigid, margin, doubt), (0, 1)))


def _bins(sweeps: HeightSlicedSweeps, objects: Objects, rigid: RigidMotion, margin: Tensor, doubt: Tensor) -> Tensor:
    """(P,) int64, place of each pixel in the table."""
    size = sweeps.grid.pixel_size
    motion = rigid.pixels_per_interval(size)
    moves = motion.any(1)
    number, found = _neighbourhood(sweeps, F.pad(motion, (0, 0, 0, 1)).index_select(0, objects.of_pixel))
    crowd, share = TABLE["crowd"], TABLE["share"]
    unlinked = 1 + _count([number >= bound for bound in crowd])
    still = 2 + len(crowd) + _count([10 * found >= bound * number for bound in share])
    num_doubts = _count([doubt >= bound for bound in TABLE["doubt"]])
    still = torch.where(num_doubts > 0, 2 + len(crowd) + len(share) + num_doubts, still)

    y, x = ((at.double() + 0.5) * size for at in (sweeps.row, sweeps.col))
    x, y = x + sweeps.grid.lower[0], y + sweeps.grid.lower[1]
    is_far = x * x + y * y >= float(TABLE["far"]) ** 2
    has_history = ((sweeps.elapsed != 0).sum(1) > 1).index_select(0, sweeps.window)
    kind = 2 * has_history.long() + is_far.long()
    first = 3 + len(crowd) + len(share) + len(TABLE["doubt"])
    num_margins = _count([margin >= bound for bound in TABLE["margin"]])
    moving = first + kind * (1 + len(TABLE["margin"])) + F.pad(num_margins, (0, 1))[objects.of_pixel]

    still = torch.where(objects.of_pixel == objects.count, unlinked, still)
    return torch.where(F.pad(moves, (0, 1)).index_select(0, objects.of_pixel), moving, still)


def _neighbourhood(sweeps: HeightSlicedSweeps, motion: Tensor) -> Tuple[Tensor, Tensor]:
    """Slices of t in the block around each pixel, and how many of them t+1 has where they move to.

    Args:
        sweeps: P pixels.
        motion: (P, 2) float64, (y, x) finest pixels per interval.

    Returns:
        (P,) int64 each.
    """
    side = max(1, round(BLOCK / sweeps.grid.pixel_size))
    height, width = -(-sweeps.grid.height // side), -(-sweeps.grid.width // side)
    block = (sweeps.window * height + divide(sweeps.row, side)) * width + divide(sweeps.col, side)
    source = flat_nonzero(sweeps.step == 1)
    window, row, col, own, at = (
        values.index_select(0, source) for values in (sweeps.window, sweeps.row, sweeps.col, sweeps.slices, block)
    )
    move = (motion.index_select(0, source) * sweeps.elapsed[window, 1][:, None] + 0.5).floor_().long()
    there = own & sweeps.slices_at(window, torch.zeros_like(window), row + move[:, 0], col + move[:, 1])
    sums = torch.zeros((2, sweeps.num_windows * height * width), dtype=torch.int64, device=block.device)
    for out, slices in zip(sums, (own, there)):
        out.index_add_(0, at, count_slices(slices).long())
    return sums[0].index_select(0, block), sums[1].index_select(0, block)


def _count(masks: Sequence[Tensor]) -> Tensor:
    """(K,) int64, in how many of some (K,) masks each element is set."""
    return torch.stack(list(masks)).sum(0)
