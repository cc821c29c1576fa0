"""Sub-pixel motion of pairs: small shifts, tested by how well the centroids of small cells meet.

Between two sweeps, the pixels of a slow object stay where they are, and those of a fast one tell its motion to a pixel.
The points within the pixels shift all the same. So the points are put into small cells, and a grid of shifts around the
motion so far is tried. An object that was static must gain significantly by its shift; its cells are cubes as high as a
pixel is wide, because its sloping sides show a small shift best. The cells of a moving object are as high as a slice:
the rings of beams on its hood would hold lower ones back.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from cflow_torch.ops.chunks import CHUNK_ON_CPU
from cflow_torch.ops.cross_correlation import parabola_vertex
from cflow_torch.ops.indices import flat_nonzero, gather, lookup, scatter_count
from cflow_torch.verified.component_tree import Objects
from cflow_torch.verified.height_slices import SLICE_HEIGHT, HeightSlicedSweeps, count_slices
from cflow_torch.verified.voxel_centroids import UNITS, Voxels, meeting_weights, points_of_objects

# The thresholds of slow objects are those of 0.3.0. The cells of moving objects were chosen on the Argoverse 2 pair, on
# KITTI 0000 and on the pair under a crown.
_SIDES = ((0, 1), (1, -1), (1, 0), (1, 1))  # (dy, dx), a pixel ahead; the opposite is behind
_BIAS_Z, _LEAST_BIAS = 3, 0.1  # a directional bias, standard deviations of noise, and as a share of the object's slices
_NUM_LAYERS = 16  # layers of cells are told apart by this many numbers, then they repeat
_STEP, _REACH = 51, 3  # units (1/1024 m) between shifts that are tested; steps each way
_Z, _LEAST_GAIN, _LEAST_CELLS = 4.0, 0.05, 6  # significance; gain per cell, as a share of a perfect meeting; cells
_BLOCK = 410  # units, side of the blocks that vote
_SIGMA = 0.07  # metres, of the weight of two centroids
_AROUND = 2  # pixels in which a cell meets others
_BEYOND = 2.0**11  # units: no cell meets another one so far away, and squares stay exact in float32
_SIDE = 2 * _REACH + 1  # shifts in x and in y
_MANY = 1 << 20  # more than blocks in a row
BYTES_PER_POINT = 560  # cells and the 25 around each


def subpixel_motion(sweeps: HeightSlicedSweeps, objects: Objects, motion: Tensor, may_be_slow: Tensor) -> Tensor:
    """The motion of the objects of pairs, to centimetres.

    Args:
        sweeps: finest images; windows with history keep their motion.
        objects: G of them.
        motion: (G, 2) float64, (y, x), finest pixels per sweep interval; 0 = static.
        may_be_slow: (G,) bool, static objects that are tested; the other static ones stay static.

    Returns:
        (G, 2) float64, x and y, metres per sweep interval.

    Convention:
        Shifts are whole steps within a square. Ties: the smallest shift, then raster order. Of a static object that
        moves, a part may be static, such as a post beside a car: cells in blocks of 0.4 m that lose by the shift are
        left out, and the rest is tested again. The parabola through the gains beside the best shift adds half a step at
        most.

    Cost: eight look-ups for each pixel of objects that may be slow; for each cell of those that are biased or move,
    50 to 99 times 25.
    """
    flow = motion.flip(1) * sweeps.grid.pixel_size
    window = sweeps.pixels.window.index_select(0, objects.first)
    is_pair, moves = ~sweeps.has_history.index_select(0, window), motion.any(1)
    slow = may_be_slow & is_pair & ~moves
    slow &= _is_biased(sweeps, objects, slow)
    wanted = slow | (moves & is_pair)
    if not bool(wanted.any()):
        return flow
    elapsed = sweeps.elapsed[:, 1].index_select(0, window)[:, None]
    height = torch.full_like(flow[:, 0], sweeps.grid.pixel_size).masked_fill_(moves, SLICE_HEIGHT)
    points = points_of_objects(sweeps, objects, wanted, height, _NUM_LAYERS)
    cells = _Cells.of(Voxels(points, sweeps, _NUM_LAYERS), flow * elapsed * UNITS)
    gain, square = cells.gains()
    best, is_known = _best_shift(gain, square, cells.count(), slow)
    cells = cells.without_static_parts(best, slow & is_known)
    again, square = cells.gains()
    gain = torch.where(slow[:, None], again, gain)
    best, is_known = _best_shift(gain, torch.where(slow[:, None], square, 0.0), cells.count(), slow)
    shift = torch.stack((_vertex(gain, best, 1), _vertex(gain, best, _SIDE)), 1) + _shifts(best.device)[best]
    return flow + (shift * (_STEP / UNITS) / elapsed).masked_fill(~(is_known & wanted)[:, None], 0.0)


def _shifts(device: torch.device) -> Tensor:
    """(49, 2) float64, (x, y), all shifts in raster order, steps."""
    line = torch.arange(-_REACH, _REACH + 1, device=device).double()
    return torch.cartesian_prod(line, line).flip(1)


def _best_shift(gain: Tensor, square: Tensor, count: Tensor, slow: Tensor) -> tuple[Tensor, Tensor]:
    """The best shift of each object, (G,) int64, and whether it counts, (G,) bool: a slow object must gain
    significantly.

    Args:
        gain, square: (G, 49) float64, as `_Cells.gains` gives them.
        count: (G,) int64, cells of each object.
        slow: (G,) bool.
    """
    least = torch.where(slow, _LEAST_GAIN * count.double(), -1.0)[:, None]
    value = gain - _Z * slow.double()[:, None] * square.sqrt()
    value = value.masked_fill(slow[:, None] & ((gain < least) | (count < _LEAST_CELLS)[:, None]), 0)
    most = value.amax(1, keepdim=True)
    # The best one that comes first, from the smallest shift on.
    order = (_shifts(gain.device) ** 2).sum(1).sort(stable=True).indices
    place = torch.arange(len(order), device=order.device).double()
    first = torch.where((value == most).index_select(1, order), place, float(_SIDE**2)).amin(1).long()
    return order.index_select(0, first), (most[:, 0] > 0) | ~slow


def _vertex(gain: Tensor, best: Tensor, stride: int) -> Tensor:
    """(G,) float64, steps: top of the parabola through the gains at the best shift and beside it; 0 at the edge.

    Args:
        gain: (G, 49) float64.
        best: (G,) int64.
        stride: from one shift to the next, 1 = in x, 7 = in y.
    """
    line = best if stride == 1 else torch.div(best, stride, rounding_mode="floor")
    at_edge = (line % _SIDE == 0) | (line % _SIDE == _SIDE - 1)
    beside = torch.stack((best - stride, best, best + stride), 1).clamp_(0, _SIDE**2 - 1)
    return parabola_vertex(*gain.gather(1, beside).unbind(1)).masked_fill(at_edge, 0.0)


def _is_biased(sweeps: HeightSlicedSweeps, objects: Objects, wanted: Tensor) -> Tensor:
    """Which objects match more of the other sweep a pixel ahead than a pixel behind, or the other way round.

    Args:
        sweeps: of pairs; other steps are ignored.
        objects: G of them.
        wanted: (G,) bool; of the others the answer is False.

    Returns:
        (G,) bool: in one of four directions ahead and behind differ by (a - b)^2 >= z^2 (a + b) and by a 10th of the
        slices that the object has, where a slices are matched ahead only and b behind only, both sweeps together: for
        t+1 ahead is the opposite side.
    """
    pixels = sweeps.pixels
    some = flat_nonzero(lookup(wanted, objects.of_pixel) & (pixels.step < 2))
    owner, asked = objects.of_pixel.index_select(0, some), pixels.take(some)
    sides = torch.tensor(_SIDES, device=owner.device)
    offset = torch.cat((sides, -sides)) * (2 * asked.step - 1)[:, None, None]  # (K, 8, 2)
    row, col = asked.row[:, None] + offset[..., 0], asked.col[:, None] + offset[..., 1]
    place = sweeps.index(asked.window[:, None], 1 - asked.step[:, None], row, col)
    own = asked.slices[:, None]
    seen = own & sweeps.image.index_select(0, place.view(-1)).view_as(place)
    ahead, behind = seen[:, : len(sides)], seen[:, len(sides) :]
    counts = count_slices(torch.cat((ahead & ~behind, behind & ~ahead, own), 1)).long()
    sums = scatter_count(owner, objects.count, counts.t())
    a, b = sums[:-1].view(2, len(sides), -1)
    far = (a - b) * (a - b) >= _BIAS_Z**2 * (a + b)
    return (far & ((a - b).abs() >= _LEAST_BIAS * sums[-1])).any(0) & (sums[-1] > 0)


@dataclass(frozen=True)
class _Cells:
    """Cells of t and t+1 of G objects.

    Args:
        owner: (K,) int64, object of each.
        place: (2, K) float64, centroid, units.
        to_go: (2, 25, K) float32, x and y, units from t to t+1: from where the motion takes the cell to the cells of
            the other sweep in the 5 x 5 pixels around.
        unshifted: (K,) float64, weight that it meets without a shift.
        num_objects: G.
    """

    owner: Tensor
    place: Tensor
    to_go: Tensor
    unshifted: Tensor
    num_objects: int

    @classmethod
    def of(cls, voxels: Voxels, given: Tensor) -> _Cells:
        """The cells of voxels, of objects with a given motion, (G, 2) float64, x and y, units from t to t+1."""
        cell = flat_nonzero(voxels.step < 2)
        window, step, part, owner = gather(cell, voxels.window, voxels.step, voxels.part, voxels.owner)
        sign, place = (2 * step - 1).double(), voxels.place.index_select(1, cell)  # seen from t+1 all signs change
        target = place + sign * given.index_select(0, owner).t()
        near = voxels.around(window * voxels.num_steps + 1 - step, part, target, _AROUND)
        to_go = voxels.place.index_select(1, near.view(-1)).view(2, *near.shape)
        to_go = to_go.sub_(target[:, None]).clamp_(-_BEYOND, _BEYOND).mul_(sign).float()
        return cls(owner, place, to_go, _meet(to_go, to_go.new_zeros((1, 2)))[0], len(given))

    def count(self) -> Tensor:
        """(G,) int64, cells of each object."""
        return scatter_count(self.owner, self.num_objects)

    def gains(self) -> tuple[Tensor, Tensor]:
        """(G, 49) float64 each: weight that cells gain by each shift, and its square, summed over each object.

        Convention: a cell of t that is moved by the shift meets the nearest one of t+1, one of t+1 that is moved back
            the nearest of t, among those in the 5 x 5 pixels around it.
        """
        sums = []
        for some in (_shifts(self.owner.device) * _STEP).split(self._at_once()):
            gain = _meet(self.to_go, some.float()) - self.unshifted
            both = scatter_count(self.owner, self.num_objects, torch.cat((gain, gain * gain)))
            sums.append(both.view(2, len(some), -1))
        gain, square = torch.cat(sums, 1)
        return gain.t(), square.t()

    def _at_once(self) -> int:
        """Shifts that are tested together: on a CPU as many as stay in the cache."""
        if self.owner.device.type != "cpu":
            return _SIDE**2
        return max(1, min(_SIDE**2, CHUNK_ON_CPU // max(1, self.to_go[0].numel())))

    def without_static_parts(self, shift: Tensor, wanted: Tensor) -> _Cells:
        """The cells of some objects, (G,) bool, in blocks that gain by the shift, (G,) int64, of their object."""
        some = flat_nonzero(wanted.index_select(0, self.owner))
        owner, place, to_go = self.owner[some], self.place.index_select(1, some), self.to_go.index_select(2, some)
        along = _shifts(owner.device)[shift].index_select(0, owner).mul_(_STEP).float()
        gain = _meet(to_go, along.t()[:, None]) - self.unshifted[some]
        row, col = torch.floor(place / _BLOCK).long()
        number = torch.unique((owner * _MANY + row) * _MANY + col, return_inverse=True)[1]
        gains = scatter_count(number, len(number), gain[0]).index_select(0, number)
        kept = flat_nonzero(gains > 0)
        return _Cells(
            owner[kept],
            place.index_select(1, kept),
            to_go.index_select(2, kept),
            self.unshifted[some[kept]],
            self.num_objects,
        )


def _meet(to_go: Tensor, shift: Tensor) -> Tensor:
    """(C, K) float64 weight of what each cell meets at its shifts.

    Args:
        to_go: (2, 25, K) float32, as in `_Cells`.
        shift: (C, 2) float32, x and y, units; or (2, 1, K), one for each cell.
    """
    shift = shift.t()[:, :, None, None] if shift.dim() == 2 else shift[:, :, None]
    x, y = (way - along for way, along in zip(to_go, shift))
    square = x.mul_(x).add_(y.mul_(y)).amin(1)
    index = square.div_(64).clamp_(max=2048).long()
    return meeting_weights(_SIGMA, to_go.device).index_select(0, index.view(-1)).view_as(square) / 256
