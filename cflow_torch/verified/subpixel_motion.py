"""Sub-pixel motion of pairs: slow objects, found by how well the centroids of small cubes meet.

Between two sweeps, the pixels of a slow object stay where they are, but the points within them shift. So the points are
put into cubes as high as a pixel is wide, and a grid of small shifts is tried. A static object must gain significantly
by a shift to become a moving one. Registration finds its motion to centimetres.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from cflow_torch.ops.chunks import CHUNK_ON_CPU
from cflow_torch.ops.indices import flat_nonzero, gather, lookup, scatter_count
from cflow_torch.verified.component_tree import Objects
from cflow_torch.verified.height_slices import HeightSlicedSweeps, count_slices
from cflow_torch.verified.voxel_centroids import UNITS, Voxels, meeting_weights, points_of_objects

# These thresholds are those of 0.3.0.
_SIDES = ((0, 1), (1, -1), (1, 0), (1, 1))  # (dy, dx), a pixel ahead; the opposite is behind
_BIAS_Z, _LEAST_BIAS = 3, 0.1  # a directional bias, standard deviations of noise, and as a share of the object's slices
_NUM_LAYERS = 16  # layers of cubes are told apart by this many numbers, then they repeat
_STEP, _REACH = 51, 3  # units (1/1024 m) between shifts that are tested; steps each way
_Z, _LEAST_GAIN, _LEAST_CUBES = 4.0, 0.05, 6  # significance; gain per cube, as a share of a perfect meeting; cubes
_BLOCK = 410  # units, side of the blocks that vote
_SIGMA = 0.07  # metres, of the weight of two centroids
_AROUND = 2  # pixels in which a cube meets others
_BEYOND = 2.0**11  # units: no cube meets another one so far away, and squares stay exact in float32
_SIDE = 2 * _REACH + 1  # shifts in x and in y
_MANY = 1 << 20  # more than blocks in a row
BYTES_PER_POINT = 560  # cubes and the 25 around each


def subpixel_motion(sweeps: HeightSlicedSweeps, objects: Objects, motion: Tensor, may_be_slow: Tensor) -> Tensor:
    """The motion of all objects, with that of slow objects of pairs.

    Args:
        sweeps: finest images; windows with history keep their motion.
        objects: G of them.
        motion: (G, 2) float64, (y, x), finest pixels per sweep interval; 0 = static.
        may_be_slow: (G,) bool, static objects that are tested; the other static ones stay static.

    Returns:
        (G, 2) float64, x and y, metres per sweep interval.

    Convention:
        Shifts are whole steps within a square. Ties: the smallest shift, then raster order. Of a static object that
        moves, a part may be static, such as a post next to a car: cubes in blocks of 0.4 m that lose by the shift are
        left out, and the rest is tested again.

    Cost: eight lookups for each pixel of objects that may be slow; for each cube of those that are biased 99 times 25.
    """
    flow = motion.flip(1) * sweeps.grid.pixel_size
    window = sweeps.pixels.window.index_select(0, objects.first)
    slow = may_be_slow & ~sweeps.has_history.index_select(0, window) & ~motion.any(1)
    if not bool(slow.any()):
        return flow
    slow &= _is_biased(sweeps, objects, slow)
    points = points_of_objects(sweeps, objects, slow, sweeps.grid.pixel_size, _NUM_LAYERS)
    cubes = _Cubes.of(Voxels(points, sweeps, _NUM_LAYERS), objects.count)
    best, moves = _best_shift(*cubes.gains(), cubes.count())
    cubes = cubes.without_static_parts(best, moves)
    best, moves = _best_shift(*cubes.gains(), cubes.count())
    shift = _shifts(best.device)[best] * (_STEP / UNITS) / sweeps.elapsed[:, 1].index_select(0, window)[:, None]
    return flow + shift.masked_fill(~moves[:, None], 0.0)


def _shifts(device: torch.device) -> Tensor:
    """(49, 2) float64, (x, y), all shifts in raster order, steps."""
    line = torch.arange(-_REACH, _REACH + 1, device=device).double()
    return torch.cartesian_prod(line, line).flip(1)


def _best_shift(gain: Tensor, square: Tensor, count: Tensor) -> tuple[Tensor, Tensor]:
    """The best shift of each object, (G,) int64, and whether its gain is significant, (G,) bool.

    Args:
        gain, square: (G, 49) float64, as `_Cubes.gains` gives them.
        count: (G,) int64, cubes of each object.
    """
    is_little = (gain < _LEAST_GAIN * count.double()[:, None]) | (count < _LEAST_CUBES)[:, None]
    value = (gain - _Z * square.sqrt()).masked_fill(is_little, 0)
    most = value.amax(1, keepdim=True)
    # The best one that comes first, from the smallest shift on.
    order = (_shifts(gain.device) ** 2).sum(1).sort(stable=True).indices
    place = torch.arange(len(order), device=order.device).double()
    first = torch.where((value == most).index_select(1, order), place, float(_SIDE**2)).amin(1).long()
    return order.index_select(0, first), most[:, 0] > 0


def _is_biased(sweeps: HeightSlicedSweeps, objects: Objects, wanted: Tensor) -> Tensor:
    """Find objects that match the other sweep better one pixel ahead than one pixel behind, or one pixel behind.

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
class _Cubes:
    """Cubes of t and t+1 of G objects.

    Args:
        owner: (K,) int64, object of each.
        place: (2, K) float64, centroid, units.
        to_go: (2, 25, K) float32, x and y, units from t to t+1: from the cube to those of the other sweep in the 5 x 5
            pixels around.
        unshifted: (K,) float64, weight that it meets without a shift.
        num_objects: G.
    """

    owner: Tensor
    place: Tensor
    to_go: Tensor
    unshifted: Tensor
    num_objects: int

    @classmethod
    def of(cls, voxels: Voxels, num_objects: int) -> _Cubes:
        """The voxels of t and t+1."""
        some = flat_nonzero(voxels.step < 2)
        window, step, part, owner, place = gather(
            some, voxels.window, voxels.step, voxels.part, voxels.owner, voxels.place
        )
        near = voxels.around(window * voxels.num_steps + 1 - step, part, place, _AROUND)
        to_go = torch.view_as_real(voxels.place.index_select(0, near.view(-1)).view_as(near) - place).permute(2, 0, 1)
        to_go = to_go.clamp(-_BEYOND, _BEYOND).mul_((2 * step - 1).double()).float()  # from t+1 all signs change
        return cls(owner, torch.view_as_real(place).t(), to_go, _meet(to_go, to_go.new_zeros((1, 2)))[0], num_objects)

    def count(self) -> Tensor:
        """(G,) int64, cubes of each object."""
        return scatter_count(self.owner, self.num_objects)

    def gains(self) -> tuple[Tensor, Tensor]:
        """(G, 49) float64 each: weight that cubes gain by each shift, and its square, summed over each object.

        Convention: a cube of t that is moved by the shift meets the nearest one of t+1, one of t+1 that is moved back
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

    def without_static_parts(self, shift: Tensor, wanted: Tensor) -> _Cubes:
        """The cubes of some objects, (G,) bool, in blocks that gain by the shift, (G,) int64, of their object."""
        some = flat_nonzero(wanted.index_select(0, self.owner))
        owner, place, to_go = self.owner[some], self.place.index_select(1, some), self.to_go.index_select(2, some)
        along = _shifts(owner.device)[shift].index_select(0, owner).mul_(_STEP).float()
        gain = _meet(to_go, along.t()[:, None]) - self.unshifted[some]
        row, col = torch.floor(place / _BLOCK).long()
        number = torch.unique((owner * _MANY + row) * _MANY + col, return_inverse=True)[1]
        gains = scatter_count(number, len(number), gain[0]).index_select(0, number)
        kept = flat_nonzero(gains > 0)
        return _Cubes(
            owner[kept],
            place.index_select(1, kept),
            to_go.index_select(2, kept),
            self.unshifted[some[kept]],
            self.num_objects,
        )


def _meet(to_go: Tensor, shift: Tensor) -> Tensor:
    """(C, K) float64 weight of what each cube meets at its shifts.

    Args:
        to_go: (2, 25, K) float32, as in `_Cubes`.
        shift: (C, 2) float32, x and y, units; or (2, 1, K), one for each cube.
    """
    shift = shift.t()[:, :, None, None] if shift.dim() == 2 else shift[:, :, None]
    x, y = (way - along for way, along in zip(to_go, shift))
    square = x.mul_(x).add_(y.mul_(y)).amin(1)
    index = square.div_(64).clamp_(max=2048).long()
    return meeting_weights(_SIGMA, to_go.device).index_select(0, index.view(-1)).view_as(square)
