"""Margin: how much worse a motion explains the sweeps when it is displaced (docs/verified.md).

Along a wall that slides nothing gets worse, and a trunk of few points fits many places. What could as well be displaced
has not been seen to move.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from cflow_torch.ops.indices import flat_nonzero
from cflow_torch.verified.aperture import principal_axes
from cflow_torch.verified.component_tree import Objects
from cflow_torch.verified.height_slices import HeightSlicedSweeps
from cflow_torch.verified.paired_test import count_wins
from cflow_torch.verified.rigid_motion import RigidMotion

_DISPLACEMENT = 0.4  # metres per interval, along x and along y
_NOWHERE = 1e7  # pixels, outside every image
_Z = 1.0  # standard deviations of noise by which a motion must be better than displaced


class Margin(NamedTuple):
    """The margins of G objects.

    Args:
        z: (G,) float64, slices found by the motion less those found by the best displaced one, in standard deviations
            of noise; 0 = it is not better, or the object stands.
        moves: (G,) bool, whether that shows that it moves: it is better by one standard deviation, or is better at all
            and has left the place where it was, and is no line: a rail seems to leave its place as well.
    """

    z: Tensor
    moves: Tensor


def margin_of(sweeps: HeightSlicedSweeps, objects: Objects, rigid: RigidMotion) -> Margin:
    """The margin of each object.

    Args:
        sweeps: finest images, P occupied pixels.
        objects: G of them.
        rigid: their motion. Turns are not looked at: an object counts as it moves at its centre.

    Cost: six look-ups for each pixel of what moves and each sweep.
    """
    size = sweeps.grid.pixel_size
    motion, off = rigid.pixels_per_interval(size), _DISPLACEMENT / size
    ways = [[0.0, 0.0], [off, 0.0], [-off, 0.0], [0.0, off], [0.0, -off], [_NOWHERE, _NOWHERE]]
    candidates = motion[:, None] + torch.tensor(ways, dtype=torch.float64, device=motion.device)
    won, lost = count_wins(sweeps, objects.of_pixel, candidates, motion.any(1))
    surplus, stays = won - lost, lost[:, 5]  # who moves out of the image loses all that is found where it stands
    gain, found = (surplus[:, 0] - surplus[:, 1:5].amax(1)).clamp(min=0), surplus[:, 0] + stays
    z = torch.where(gain > 0, gain.double() / found.double().sqrt(), 0.0)
    newest = flat_nonzero((sweeps.step == 0) & (objects.of_pixel < objects.count))
    owner, row, col = (values.index_select(0, newest) for values in (objects.of_pixel, sweeps.row, sweeps.col))
    is_line, _, _ = principal_axes(owner, row, col, objects.count, size)
    return Margin(z, (z >= _Z) | ((gain > 0) & (surplus[:, 0] > stays) & ~is_line))
