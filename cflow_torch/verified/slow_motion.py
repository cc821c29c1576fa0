"""Slow motion: of a pixel or less between two sweeps, which no count of pixels shows; verified on small cubes.

What nothing moved so far may still creep: a pedestrian, a car that starts. Between two sweeps its pixels stay, but the
points within them shift, and sloping sides show it only where heights are told apart finely. Two steps keep that
cheap. Pixels tell which objects lean to a side: more of them meet something a pixel ahead than a pixel behind. Of those
alone cubes are made, and small shifts are tested by how well the centroids meet, against no shift.
"""

from __future__ import annotations

from typing import Tuple

import torch
import torch.nn.functional as F
from torch import Tensor

from cflow_torch.ops.indices import flat_nonzero
from cflow_torch.ops.parabola import vertex
from cflow_torch.verified.component_tree import Objects
from cflow_torch.verified.height_slices import HeightSlicedSweeps, count_slices
from cflow_torch.verified.voxel_centroids import UNITS, Voxels, meeting_weights, points_of_objects

# Tried on sets that no part of this was made for.
_SIDES = ((0, 1), (1, -1), (1, 0), (1, 1))  # (dy, dx), a pixel ahead; the opposite is behind
_LEAN_Z = 3  # standard deviations of noise for a lean
_LEAST_LEAN = 0.1  # and it must be this share of the object's slices
_NUM_LAYERS = 16  # cubes are told apart by this many layers as high as a pixel is wide, then they repeat
_STEP, _REACH = 51, 3  # units (1/1024 m) between shifts that are tested; steps each way
_Z = 4.0  # standard deviations of noise that a shift is granted
_LEAST_GAIN = 0.05  # share of a perfect meeting that a shift must gain per cube
_LEAST_CUBES = 6
_BLOCK = 410  # units, side of the blocks that vote
_SIGMA = 0.07  # metres, of the weight of two centroids
_AROUND = 2  # pixels in which a cube looks for others
_BEYOND = 2.0**11  # units: no cube is looked for so far away, and squares stay exact in float32
BYTES_PER_POINT = 560  # cubes and the 25 around each


def slow_motion(sweeps: HeightSlicedSweeps, objects: Objects, wanted: Tensor) -> Tensor:
    """The motion of slow objects in windows of two sweeps; with history slow objects leave their pixels.

    Args:
        sweeps: finest images.
        objects: G of them.
        wanted: (G,) bool, objects that stood still so far; False = it is not looked at.

    Returns:
        (G, 2) float64, x and y, metres per sweep interval; 0 = no motion is significant.

    Convention:
        Shifts are whole steps within a square, in raster order; of equally good ones the first. Of an object that moves
        a part may stand still, such as a post beside a car: cubes in blocks of 0.4 m that lose by the shift are put
        aside, and the rest is tested again. The parabola through the gains beside the best shift adds half a step at
        most.

    Cost: eight look-ups a pixel of the objects wanted; of those that lean, 103 times 25 for each cube.
    """
    window = sweeps.window.index_select(0, objects.first)
    is_pair = (sweeps.elapsed != 0).sum(1) == 1
    wanted = wanted & is_pair.index_select(0, window)
    wanted = wanted & _leans(sweeps, objects, wanted)
    if not bool(wanted.any()):
        return torch.zeros((objects.count, 2), dtype=torch.float64, device=wanted.device)
    points = points_of_objects(sweeps, objects, wanted, sweeps.grid.pixel_size, _NUM_LAYERS)
    cubes = _Cubes(Voxels(points, sweeps, _NUM_LAYERS), objects.count)
    cubes.drop_static_parts(*cubes.best_shift())
    best, is_significant = cubes.best_shift()
    beside = torch.tensor(((0, 0), (-1, 0), (1, 0), (0, -1), (0, 1)), dtype=best.dtype, device=best.device) * _STEP
    middle, left, right, down, up = cubes.gains(best + beside[:, None])[0].unbind(1)
    offset = torch.stack((vertex(left, middle, right), vertex(down, middle, up)), 1)
    elapsed = sweeps.elapsed[:, 1].index_select(0, window)
    flow = (best + offset * _STEP) / UNITS / elapsed[:, None]
    return flow.masked_fill(~is_significant[:, None], 0.0) + 0.0  # + 0.0 turns -0.0 into 0.0


def _leans(sweeps: HeightSlicedSweeps, objects: Objects, wanted: Tensor) -> Tensor:
    """Which objects meet more of the other sweep a pixel ahead than a pixel behind, or the other way round.

    Args:
        sweeps: of pairs; other steps are not looked at.
        objects: G of them.
        wanted: (G,) bool; of the others the answer is False.

    Returns:
        (G,) bool: in one of four directions ahead and behind differ by (a - b)^2 >= z^2 (a + b) and by a 10th of the
        slices that the object has, where a slices are met ahead only and b behind only, both sweeps together: for t+1
        ahead is the opposite side.
    """
    is_wanted = F.pad(wanted, (0, 1)).index_select(0, objects.of_pixel)
    pixel = flat_nonzero(is_wanted & (sweeps.step < 2))
    window, step, row, col, own, owner = (
        values.index_select(0, pixel)
        for values in (sweeps.window, sweeps.step, sweeps.row, sweeps.col, sweeps.slices, objects.of_pixel)
    )
    sign = 2 * step - 1

    def count(slices: Tensor) -> Tensor:
        sums = torch.zeros(objects.count, dtype=torch.int64, device=slices.device)
        return sums.index_add_(0, owner, count_slices(slices).long())

    size, answer = count(own), torch.zeros_like(wanted)
    for dy, dx in _SIDES:
        ahead, behind = (
            own & sweeps.slices_at(window, 1 - step, row + way * dy, col + way * dx) for way in (sign, -sign)
        )
        a, b = count(ahead & ~behind), count(behind & ~ahead)
        answer |= ((a - b) * (a - b) >= _LEAN_Z**2 * (a + b)) & ((a - b).abs() >= _LEAST_LEAN * size) & (size > 0)
    return answer


class _Cubes:
    """Cubes of t and t+1 of G objects, and what they gain by a shift."""

    def __init__(self, voxels: Voxels, num_objects: int) -> None:
        cube = flat_nonzero(voxels.step < 2)
        window, step, part, x, y, self._owner = (
            values.index_select(0, cube)
            for values in (voxels.window, voxels.step, voxels.part, voxels.x, voxels.y, voxels.owner)
        )
        self._num_objects = num_objects
        near = voxels.around(window, 1 - step, part, x, y, _AROUND)
        # What a shift from t to t+1 leaves to go: seen from t+1 all signs change.
        sign = (2 * step - 1).double()
        self._x, self._y = (
            values.index_select(0, near.view(-1)).view_as(near).sub_(own).clamp_(-_BEYOND, _BEYOND).mul_(sign).float()
            for values, own in ((voxels.x, x), (voxels.y, y))
        )
        self._place = torch.stack((x, y))
        self._weight = meeting_weights(_SIGMA, x.device)
        self._at_rest = self._meet(x.new_zeros((1, 2)))

    def best_shift(self) -> Tuple[Tensor, Tensor]:
        """The best shift of each object, (G, 2) float64 (x, y), units, and whether it is significant, (G,) bool; False
        = the shift is 0. Of equally good ones the first in raster order."""
        line = torch.arange(-_REACH, _REACH + 1, device=self._x.device).double() * _STEP
        shifts = torch.stack((line.repeat(len(line)), line.repeat_interleave(len(line))), 1)
        gain, square = self.gains(shifts[:, None])
        count = torch.bincount(self._owner, minlength=self._num_objects)[:, None]
        value = gain - _Z * square.sqrt()
        value.masked_fill_((gain < _LEAST_GAIN * count) | (count < _LEAST_CUBES), 0)
        most, best = value.max(1)
        is_significant = most > 0
        return shifts.index_select(0, best).masked_fill(~is_significant[:, None], 0), is_significant

    def gains(self, shifts: Tensor) -> Tuple[Tensor, Tensor]:
        """(G, C) float64 each: weight that cubes gain by a shift, and its square, summed over each object.

        Args:
            shifts: (C, G or 1, 2) float64, (x, y), units, from t to t+1.

        Convention: a cube of t that is moved by the shift looks for the nearest one of t+1, one of t+1 that is moved
            back for the nearest of t, among those in the 5 x 5 pixels around it.
        """
        sums = torch.zeros((2, len(shifts), self._num_objects), dtype=torch.float64, device=shifts.device)
        for total, square, shift in zip(sums[0], sums[1], shifts):
            gain = self._meet(shift if len(shift) == 1 else shift.index_select(0, self._owner)) - self._at_rest
            total.index_add_(0, self._owner, gain)
            square.index_add_(0, self._owner, gain * gain)
        return sums[0].t(), sums[1].t()

    def drop_static_parts(self, shift: Tensor, is_significant: Tensor) -> None:
        """Put aside the cubes of blocks that do not gain by the shift of their object, and all of other objects.

        Args:
            shift: (G, 2) float64, as for `gains`.
            is_significant: (G,) bool.
        """
        self._take(is_significant.index_select(0, self._owner))
        gain = self._meet(shift.index_select(0, self._owner)) - self._at_rest
        block = torch.floor(self._place / _BLOCK).long()
        key = torch.cat((self._owner[None], block)).t()
        number = torch.unique(key, dim=0, return_inverse=True)[1]
        self._take(torch.zeros_like(gain).index_add_(0, number, gain).index_select(0, number) > 0)

    def _take(self, wanted: Tensor) -> None:
        kept = flat_nonzero(wanted)
        self._x, self._y, self._place = (values.index_select(1, kept) for values in (self._x, self._y, self._place))
        self._owner, self._at_rest = (values.index_select(0, kept) for values in (self._owner, self._at_rest))

    def _meet(self, shift: Tensor) -> Tensor:
        """(K,) float64 weight of what each cube meets at its shift, (K or 1, 2)."""
        x, y = (values - along.float() for values, along in zip((self._x, self._y), shift.unbind(1)))
        square = x.mul_(x).add_(y.mul_(y)).amin(0)
        return self._weight.index_select(0, (square / 64).long().clamp_(max=2048)) / 256
