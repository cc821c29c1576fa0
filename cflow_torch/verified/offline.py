"""Sweeps after t+1, for whoever may wait: they decide on what no sweep before t shows.

What comes out from behind something, or stands in the first window of a log, has no past: with t and t+1 alone it is a
pair. Its future shows it as often as a past would. Where there is a past, sweeps after t+1 add nothing (they were tried
beside it and in place of it), so the motion is estimated twice, with the past and with the future, and each component
of t takes one of the two.
"""

from __future__ import annotations

from typing import Callable, Tuple

import torch
import torch.nn.functional as F
from torch import Tensor

from cflow_torch.config import VerifiedConfig
from cflow_torch.ops.indices import flat_nonzero, split_index
from cflow_torch.verified.component_tree import find_components
from cflow_torch.verified.height_slices import HeightSlicedSweeps
from cflow_torch.verified.rigid_motion import TurningMotion
from cflow_torch.windows.bev_grid import Grid
from cflow_torch.windows.collation import Batch


def motion_of_both_sides(
    batch: Batch, estimate: Callable[[Batch], TurningMotion], grid: Grid, config: VerifiedConfig
) -> TurningMotion:
    """The motion t -> t+1 by the sweeps before t; of components that none of them shows, by those after t+1.

    Args:
        batch: all sweeps.
        estimate: the method for the sweeps of one side.
        grid: the finest BEV.
        config: of the components.

    Returns:
        A motion for the points of t. In each window the clusters of the second estimate are numbered after those of the
        first.

    Convention: windows without sweeps after t+1 keep the first estimate.

    Cost: that of two estimates and of the components of one level.
    """
    is_future = (batch.elapsed < 0).any(0)
    if not bool(is_future.any()):
        return estimate(batch)
    is_pair = torch.arange(batch.num_steps, device=is_future.device) < 2
    past, future = batch.take_steps(~is_future), batch.take_steps(is_future | is_pair)
    lacks, window = lacks_past(past, grid, config)
    has_future = (batch.elapsed < 0).any(1)
    return _join(estimate(past), estimate(future), lacks & has_future.index_select(0, window), window, batch)


def lacks_past(batch: Batch, grid: Grid, config: VerifiedConfig) -> Tuple[Tensor, Tensor]:
    """Points of t whose component at the coarsest pixel size has no pixel in any sweep before t.

    Args:
        batch: without sweeps after t+1.
        grid, config: as for `motion_of_both_sides`.

    Returns:
        (N,) bool, True also for points of no component, and (N,) int64, their window.
    """
    sweeps = HeightSlicedSweeps.of(batch, grid, config.min_height)
    level = find_components(sweeps, round(config.pixel_sizes[0] / grid.pixel_size), False, config)
    shown = level.component.index_select(0, flat_nonzero(sweeps.step > 1))
    has_past = torch.zeros(level.num_components + 1, dtype=torch.bool, device=shown.device).index_fill_(0, shown, True)
    has_past[-1:] = False
    of_pixel = F.pad(has_past.index_select(0, level.component), (0, 1))
    window, step = split_index(batch.image.long(), batch.num_steps)
    at_t = flat_nonzero(step == 1)
    pixel = sweeps.number.index_select(0, sweeps.place.index_select(0, at_t))
    return ~of_pixel.index_select(0, pixel), window.index_select(0, at_t)


def _join(
    first: TurningMotion, second: TurningMotion, takes_second: Tensor, window: Tensor, batch: Batch
) -> TurningMotion:
    """Two motions of the same N points of t, one for each point.

    Args:
        first, second: of L and M clusters; the result has L + 1 + M, as L stays "none".
        takes_second: (N,) bool.
        window: (N,) int64.
        batch: of these points.
    """
    at_t = slice(batch.num_newest, batch.num_newest + window.numel())
    # Ids go on where those of the first end.
    num_ids = torch.zeros(batch.num_windows, dtype=torch.int64, device=window.device)
    num_ids.scatter_reduce_(0, window, first.cluster_id.index_select(0, first.cluster(at_t)) + 1, "amax")
    before = torch.zeros_like(second.cluster_id).scatter_(0, second.cluster(at_t).long(), num_ids[window])
    ids = torch.where(second.cluster_id < 0, second.cluster_id, second.cluster_id + before)
    place = torch.where(takes_second, second.place[at_t] + first.of_place.numel(), first.place[at_t])
    pairs = {
        name: (getattr(first, name), getattr(second, name)) for name in ("flow", "score", "confidence", "turn", "centre")
    }
    return TurningMotion(
        of_place=torch.cat((first.of_place, second.of_place + first.cluster_id.numel())),
        place=F.pad(place, (batch.num_newest, 0)),
        cluster_id=torch.cat((first.cluster_id, ids)),
        **{name: torch.cat(both) for name, both in pairs.items()},
    )
