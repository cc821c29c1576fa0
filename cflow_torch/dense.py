"""CorrelationFlow, dense (Alg. general_correlation_flow): compensate, project, cluster, correlate, pool, spread."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, List, Optional, Sequence, Tuple

import torch
import torch.nn.functional as F
from torch import Tensor, nn
from torch.profiler import record_function

from cflow_torch.batch import Batch, make_batch, split_results, split_windows
from cflow_torch.cluster import Clusters, cluster
from cflow_torch.config import Config, make_config
from cflow_torch.correlate import Images, best_shifts
from cflow_torch.density import cluster_by_density
from cflow_torch.grid import Grid
from cflow_torch.ops.indices import flat_nonzero
from cflow_torch.pool import pool
from cflow_torch.sectional import add_sectional_view
from cflow_torch.types import CFlowError, FlowResult, Window


class CorrelationFlow(nn.Module):
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

    def __init__(self, config: Config, device: Any = "auto") -> None:
        super().__init__()
        if not isinstance(config, Config):
            raise CFlowError(f"config is {type(config).__name__}: give a Config, or use CorrelationFlow.from_preset")
        if config.method != "dense":
            raise CFlowError(f"method={config.method!r} is not built yet: use method='dense'")
        self.config = config
        self.device = device

    @classmethod
    def from_preset(cls, preset: str = "default", device: Any = "auto", **overrides: Any) -> CorrelationFlow:
        """The method with the settings of a preset, some fields replaced.

        Raises:
            CFlowError: unknown preset or field, invalid value.
        """
        return cls(make_config(preset, **overrides), device)

    @torch.no_grad()
    def forward(self, windows: Sequence[Window]) -> List[FlowResult]:
        """Flow t -> t+1 for the points of every window's pc0.

        Args:
            windows: B windows; numbers of points, sweeps and extents may differ.

        Returns:
            B results, each independent of the other windows.

        Raises:
            CFlowError: bad input, see `make_batch`.
        """
        config = self.config
        lower, upper = config.point_cloud_range[:3], config.point_cloud_range[3:]
        grids = [Grid(size, lower, upper) for size in config.pixel_sizes]
        results: List[FlowResult] = []
        for part in split_windows(windows, config, grids[-1]):
            results += self._flow(part, grids)
        return results

    def _flow(self, windows: Sequence[Window], grids: Sequence[Grid]) -> List[FlowResult]:
        """The paper on one page: compensate, then at every scale project, cluster, correlate, pool, spread."""
        with torch.inference_mode():  # a tenth faster than no_grad: the work is many small operations
            with record_function("compensate"):
                batch = make_batch(windows, self.config, grids[0], self.device)
            motion = motion_at_scale(batch, None, grids[0], self.config)
            flow = motion.flow.index_select(0, motion.cluster)
            for grid in grids[1:]:  # coarse to fine
                motion = motion_at_scale(batch, flow, grid, self.config)
                flow = flow + motion.flow.index_select(0, motion.cluster)
        # Outside of inference mode: results are ordinary tensors, which a training loop may use.
        with record_function("spread"):
            cluster_id = motion.cluster_id.index_select(0, motion.cluster)
            score = motion.score.index_select(0, motion.cluster)
            return split_results(batch, flow, cluster_id, score)


@dataclass(frozen=True)
class Motion:
    """What one scale found. Entry M stands for "no cluster": motion 0, id -1, score 0.

    Args:
        cluster: (P,) int32 or int64, cluster of every point, M = none.
        flow: (M + 1, 3) float64, metres per sweep interval, axes of ego1.
        cluster_id: (M + 1,) int64, number of the cluster counted from 0 in its window.
        score: (M + 1,) float32.
    """

    cluster: Tensor
    flow: Tensor
    cluster_id: Tensor
    score: Tensor


def motion_at_scale(batch: Batch, flow: Optional[Tensor], grid: Grid, config: Config) -> Motion:
    """One pass of Alg. general_correlation_flow, over points warped by the flow so far.

    Args:
        batch: points of all windows.
        flow: (P, 3) float64, metres per sweep interval, flow so far of every point of every sweep; None = no flow yet.
        grid: the BEV at this scale.
        config: settings.

    Returns:
        What this scale adds.
    """
    with record_function("project"):
        positions, takes_part = batch.positions, None
        if flow is not None:  # sweep m moves by (t+1-m) times the flow so far
            k = batch.elapsed.flatten().index_select(0, batch.image)
            positions = positions + k * flow.t()
            takes_part = grid.contains(positions)
        occupancy, pixel = grid.project(positions, batch.image, batch.num_windows * batch.num_steps, takes_part)
    with record_function("cluster"):
        if config.clustering == "hdbscan":
            clusters, cluster_of_point = cluster_by_density(batch, positions, pixel, grid, config)
        else:
            occupancy = occupancy.unflatten(0, (batch.num_windows, batch.num_steps))
            clusters, of_pixel = cluster(occupancy, grid.pixel_size, config)
            cluster_of_point = of_pixel.index_select(0, pixel)
    with record_function("correlate"):
        estimates, scores, available = correlate(clusters, batch, grid, config)
        if config.sectional_view:
            step = batch.image % batch.num_steps
            estimates = add_sectional_view(
                estimates, available, positions, cluster_of_point, step, grid.pixel_size, config
            )
    with record_function("pool"):
        per_interval = estimates / batch.elapsed[clusters.window, 1:].clamp(min=1)[:, :, None]
        newest = available.int().argmax(1, keepdim=True)
        return Motion(
            cluster=cluster_of_point,
            flow=F.pad(pool(per_interval, available) + 0.0, (0, 0, 0, 1)),  # + 0.0 turns -0.0 into 0.0
            cluster_id=F.pad(clusters.id_in_window(), (0, 1), value=-1),
            score=F.pad(scores.gather(1, newest)[:, 0], (0, 1)),
        )


def correlate(clusters: Clusters, batch: Batch, grid: Grid, config: Config) -> Tuple[Tensor, Tensor, Tensor]:
    """Displacement m -> t+1 of every cluster for every earlier sweep m (Alg. scene_flow_1view, view = BEV).

    Args:
        clusters: as made by `cluster`.
        batch: for the elapsed time of each sweep.
        grid: the BEV.
        config: `max_speed`, `correlation`.

    Returns:
        estimates: (M, S - 1, 3) float64, metres m -> t+1, nearest sweep first; z is 0.
        scores: (M, S - 1) float32.
        available: (M, S - 1) bool, False = the cluster has no pixel in that sweep.
    """
    num_clusters, num_sources = clusters.window.numel(), batch.num_steps - 1
    pixels = clusters.pixels
    row = pixels.row - clusters.first[:, 0].index_select(0, pixels.cluster)
    col = pixels.col - clusters.first[:, 1].index_select(0, pixels.cluster)
    older, newest = flat_nonzero(pixels.step > 0), flat_nonzero(pixels.step == 0)
    slot = (pixels.cluster * num_sources + pixels.step - 1).index_select(0, older)
    available = torch.zeros(num_clusters * num_sources, dtype=torch.bool, device=row.device).index_fill_(0, slot, True)
    jobs = flat_nonzero(available)
    job_of_slot = torch.empty_like(available, dtype=torch.int64)
    job_of_slot.scatter_(0, jobs, torch.arange(jobs.numel(), device=row.device))
    cluster_of_job, source_of_job = jobs // num_sources, jobs % num_sources

    radius = None
    if config.max_speed is not None:
        seconds = batch.seconds[clusters.window[cluster_of_job], source_of_job + 1]
        size = torch.full_like(seconds, grid.pixel_size)
        radius = config.max_speed * seconds / size + 1
    shift, job_score = best_shifts(
        Images(job_of_slot[slot], row[older], col[older]),
        Images(pixels.cluster[newest], row[newest], col[newest]),
        cluster_of_job,
        clusters.size,
        radius,
        config.correlation,
        config.max_memory,
    )
    estimates = torch.zeros((num_clusters * num_sources, 3), dtype=torch.float64, device=row.device)
    estimates[jobs, :2] = shift.flip(1).double() * grid.pixel_size  # (dy, dx) -> (x, y)
    scores = torch.zeros(num_clusters * num_sources, dtype=torch.float32, device=row.device)
    scores[jobs] = job_score
    shape = (num_clusters, num_sources)
    return estimates.view(*shape, 3), scores.view(shape), available.view(shape)
