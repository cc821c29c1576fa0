"""The points of groups that move: what their motion is refined with."""

from __future__ import annotations

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

from cflow_torch.ops.indices import flat_nonzero, split_index
from cflow_torch.verified.height_slices import NUM_SLICES, slice_of
from cflow_torch.windows.collation import Batch


@dataclass(frozen=True)
class MovingPoints:
    """N points of G groups, in any order; the points of a pixel have one group.

    Args:
        group: (N,) int64.
        window, step: (N,) int64, which sweep: step 0 = t+1, 1 = t, ...
        pixel: (N,) int64, number of its occupied pixel, 0 ... P - 1.
        part: (N,) int64, height slice, 0 ... 3 (or as many as `moving_points` was asked for).
        position: (2, N) float64, x and y, metres, frame of t+1; inside the region.
    """

    group: Tensor
    window: Tensor
    step: Tensor
    pixel: Tensor
    part: Tensor
    position: Tensor

    def take(self, index: Tensor) -> MovingPoints:
        """Some of them, (K,) int64."""
        group, window, step, pixel, part = (
            values.index_select(0, index) for values in (self.group, self.window, self.step, self.pixel, self.part)
        )
        return MovingPoints(group, window, step, pixel, part, self.position.index_select(1, index))


def moving_points(
    batch: Batch,
    place: Tensor,
    pixel_of_place: Tensor,
    group: Tensor,
    num_groups: int,
    slice_height: float,
    num_slices: int = NUM_SLICES,
) -> MovingPoints:
    """Points of all sweeps whose pixel has a group.

    Args:
        batch: with three axes.
        place: (points,) int64, flat place in the images of every point, the last one = nowhere.
        pixel_of_place: (Q,) int32 or int64, number of the occupied pixel at each place, P = none.
        group: (P,) int64, group of each occupied pixel, `num_groups` = none.
        num_groups: G.
        slice_height: metres.
        num_slices: a power of 2.

    Returns:
        In the order of the batch.

    Convention: slice floor(z / slice_height) mod num_slices, a true division in float64.

    Cost: two look-ups a point, the rest for those that are kept.
    """
    has_group = F.pad(group < num_groups, (0, 1))
    pixel = pixel_of_place.index_select(0, place)
    rows = flat_nonzero(has_group.index_select(0, pixel))
    pixel = pixel.index_select(0, rows).long()
    x, y, z = batch.positions.index_select(1, rows).unbind(0)
    window, step = split_index(batch.image.index_select(0, rows).long(), batch.num_steps)
    part = slice_of(z, slice_height, num_slices).long()
    return MovingPoints(group.index_select(0, pixel), window, step, pixel, part, torch.stack((x, y)))
