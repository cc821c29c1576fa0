"""CorrelationFlow, dense (Alg. general_correlation_flow): compensate, project, cluster, correlate, pool, spread."""

from __future__ import annotations

from typing import List, Optional, Sequence, Tuple

import torch
import torch.nn.functional as F
from torch import Tensor
from torch.profiler import record_function

from cflow_torch.config import Config
from cflow_torch.dense.clustering import Clusters, cluster
from cflow_torch.dense.displacement import displacements, is_longer
from cflow_torch.dense.hdbscan import cluster_by_density
from cflow_torch.dense.height import slices_of_pixels
from cflow_torch.dense.history import pool
from cflow_torch.dense.sectional_view import add_sectional_view
from cflow_torch.dense.templates import make_jobs
from cflow_torch.model import CoarseToFine, Motion, project, warp
from cflow_torch.types import FlowResult, Window
from cflow_torch.verified.method import prove_motion
from cflow_torch.windows.bev_grid import Grid
from cflow_torch.windows.collation import Batch


class CorrelationFlow(CoarseToFine):
    """The paper's dense method: windows in, flow out. No parameters, no buffers, no state.

    Args:
        config: settings, see `Config`; `CorrelationFlow.from_preset` makes them from a preset.

    Example:
        >>> from cflow_torch import CorrelationFlow, Sweep, Window
        >>> model = CorrelationFlow.from_preset("paper", pixel_size=0.1)
        >>> car = 0.1 * torch.cartesian_prod(torch.arange(45.0), torch.arange(18.0), torch.arange(15.0)) + 5.05
        >>> window = Window(pc0=Sweep(car), pc1=Sweep(car + torch.tensor([0.5, 0.0, 0.0])))
        >>> (result,) = model([window])
        >>> result.residual_flow[0]
        tensor([0.5000, 0.0000, 0.0000])
    """

    method = "dense"

    def _flow(self, windows: Sequence[Window], grids: Sequence[Grid], device: torch.device) -> List[FlowResult]:
        # The proof has its scales within: one pass at the finest pixels.
        return super()._flow(windows, grids[-1:] if self.config.proof else grids, device)

    def motion_at_scale(self, batch: Batch, flow: Optional[Tensor], grid: Grid) -> Motion:
        """One pass of Alg. general_correlation_flow, over points warped by the flow so far."""
        config = self.config
        if config.proof:
            return prove_motion(batch, grid, config)
        occupancy, place = project(batch, flow, grid)
        positions = batch.positions
        needs_xyz = config.sectional_view or config.clustering == "hdbscan"
        if flow is not None and needs_xyz:  # more than the pixels
            positions = torch.cat(
                (positions[:, : batch.num_newest], warp(batch, flow, slice(batch.num_newest, None))), 1
            )
        with record_function("cluster"):
            if config.clustering == "hdbscan":
                clusters, of_place = cluster_by_density(batch, positions, place, grid, config)
                place = torch.arange(place.numel(), device=place.device)  # clusters may share pixels
            else:
                clusters, of_place = cluster(occupancy, grid.pixel_size, config)
        with record_function("correlate"):
            slices = None
            if config.height_slices > 0:  # warping changes z in the sectional view only
                slices = slices_of_pixels(batch, positions[2], place, clusters, grid, config)
            estimates, scores, available = correlate(clusters, batch, grid, config, slices)
            if config.sectional_view:
                step = batch.image % batch.num_steps
                of_point = of_place.index_select(0, place)
                estimates = add_sectional_view(estimates, available, positions, of_point, step, grid.pixel_size, config)
                if config.max_object is not None:  # nor along its heading, nor up
                    is_still = is_longer(clusters, config.max_object, grid.pixel_size)
                    estimates = estimates.masked_fill(is_still[:, None, None], 0.0)
        with record_function("pool"):
            per_interval = estimates / batch.elapsed[clusters.window, 1:].clamp(min=1)[:, :, None]
            newest = available.int().argmax(1, keepdim=True)
            return Motion(
                of_place=of_place,
                place=place,
                flow=F.pad(pool(per_interval, available) + 0.0, (0, 0, 0, 1)),  # + 0.0 turns -0.0 into 0.0
                cluster_id=F.pad(clusters.id_in_window(), (0, 1), value=-1),
                score=F.pad(scores.gather(1, newest)[:, 0], (0, 1)),
            )


def correlate(
    clusters: Clusters, batch: Batch, grid: Grid, config: Config, slices: Optional[Tensor] = None
) -> Tuple[Tensor, Tensor, Tensor]:
    """Displacement m -> t+1 of every cluster for every earlier sweep m (Alg. scene_flow_1view, view = BEV).

    Args:
        clusters: as made by `cluster`.
        batch: for the elapsed time of each sweep.
        grid: the BEV.
        config: `max_speed`, `max_object`, `zero_test`, `subpixel`, `height_slices`, `correlation`.
        slices: as `slices_of_pixels` gives them; None = one slice.

    Returns:
        estimates: (M, S - 1, 3) float64, metres m -> t+1, nearest sweep first; z is 0.
        scores: (M, S - 1) float32.
        available: (M, S - 1) bool, False = the cluster has no pixel in that sweep.
    """
    jobs = make_jobs(clusters, batch, grid.pixel_size, config.max_speed, slices)
    is_still = None
    if config.max_object is not None:
        is_still = is_longer(clusters, config.max_object, grid.pixel_size)
    shift, score = displacements(jobs.template, jobs.target, jobs.cluster, clusters.size, jobs.radius, is_still, config)
    shape = (clusters.window.numel(), batch.num_steps - 1)
    estimates = torch.zeros((*shape, 3), dtype=torch.float64, device=shift.device)
    scores = torch.zeros(shape, dtype=torch.float32, device=shift.device)
    available = torch.zeros(shape, dtype=torch.bool, device=shift.device)
    where = jobs.cluster, jobs.source
    estimates[jobs.cluster, jobs.source, :2] = shift.flip(1).double() * grid.pixel_size  # (dy, dx) -> (x, y)
    scores[where] = score
    available[where] = True
    return estimates, scores, available
