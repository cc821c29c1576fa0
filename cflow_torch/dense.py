"""CorrelationFlow, dense (Alg. general_correlation_flow): compensate, project, cluster, correlate, pool, spread."""

from __future__ import annotations

from typing import Any, List, Sequence, Tuple

import torch
from torch import Tensor, nn

from cflow_torch.batch import Batch, make_batch, split_results
from cflow_torch.cluster import Clusters, cluster
from cflow_torch.config import Config, make_config
from cflow_torch.correlate import Images, best_shifts
from cflow_torch.grid import Grid
from cflow_torch.pool import pool
from cflow_torch.sectional import add_sectional_view
from cflow_torch.types import CFlowError, FlowResult, Window


class CorrelationFlow(nn.Module):
    """The paper's dense method: windows in, flow out. No parameters, no buffers, no state.

    Args:
        config: settings, see `Config`; `CorrelationFlow.from_preset` makes them from a preset.

    Example:
        >>> model = CorrelationFlow.from_preset("paper", pixel_size=0.2)
        >>> pc = torch.tensor([[10.0, 0.0, 1.0], [10.0, 0.5, 1.0], [10.5, 0.5, 1.0]])
        >>> result, = model([Window(pc0=Sweep(pc), pc1=Sweep(pc + torch.tensor([0.2, 0.0, 0.0])))])
        >>> result.residual_flow[0]
        tensor([0.2000, 0.0000, 0.0000])
    """

    def __init__(self, config: Config, device: Any = "auto") -> None:
        super().__init__()
        if config.method != "dense":
            raise CFlowError(f"CorrelationFlow is the dense method, got a config with method={config.method!r}")
        if config.clustering != "components":
            raise CFlowError("clustering='hdbscan' is not built yet: use clustering='components'")
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
        grids = [Grid(size, config.point_cloud_range[:3], config.point_cloud_range[3:]) for size in config.pixel_sizes]
        batch = make_batch(windows, config, grids[0], self.device)  # compensate
        flow = torch.zeros_like(batch.positions)
        cluster_id, score = _nothing(batch)
        for grid in grids:  # coarse to fine
            motion, cluster_id, score = flow_at_scale(batch, flow, grid, config)
            flow += motion
        return split_results(batch, flow[:, batch.source], cluster_id[batch.source], score[batch.source])


def flow_at_scale(batch: Batch, flow: Tensor, grid: Grid, config: Config) -> Tuple[Tensor, Tensor, Tensor]:
    """One pass of Alg. general_correlation_flow, over points warped by the flow so far.

    Args:
        batch: points of all windows.
        flow: (3, P) float64, metres per sweep interval, flow so far of every point of every sweep.
        grid: the BEV at this scale.
        config: settings.

    Returns:
        motion: (3, P) float64, what this scale adds.
        cluster_id: (P,) int64, counted from 0 in each window, -1 = none.
        score: (P,) float32.
    """
    # Warp: sweep m by (t+1-m) times the flow so far, then project.
    k = batch.elapsed.flatten()[batch.image]
    warped = batch.positions + k * flow
    inside = grid.contains(warped).nonzero()[:, 0]
    positions, image = warped[:, inside], batch.image[inside]
    pixel = grid.pixel(positions)
    occupancy = grid.occupancy(image, pixel, batch.num_windows * batch.num_steps)
    occupancy = occupancy.view(batch.num_windows, batch.num_steps, grid.height, grid.width)

    clusters = cluster(occupancy, grid.pixel_size, config)
    cluster_of_point = clusters.of_pixel[image // batch.num_steps * (grid.height * grid.width) + pixel]

    estimates, scores, available = correlate(clusters, batch, grid, config)
    if config.sectional_view:
        estimates = add_sectional_view(
            estimates, available, positions, cluster_of_point, image % batch.num_steps, grid.pixel_size, config
        )
    per_interval = estimates / batch.elapsed[clusters.window, 1:].clamp(min=1)[:, :, None]
    motion_of_cluster = pool(per_interval, available)
    newest = available.int().argmax(1, keepdim=True)
    score_of_cluster = scores.gather(1, newest)[:, 0]

    # Spread: every point takes the motion of its cluster.
    motion = torch.zeros_like(flow)
    cluster_id, score = _nothing(batch)
    member = (cluster_of_point >= 0).nonzero()[:, 0]
    cluster_of_member, point = cluster_of_point[member], inside[member]
    motion[:, point] = motion_of_cluster.t()[:, cluster_of_member]
    cluster_id[point] = clusters.id_in_window(cluster_of_member)
    score[point] = score_of_cluster[cluster_of_member]
    return motion, cluster_id, score


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
    row = pixels.row - clusters.first[pixels.cluster, 0]
    col = pixels.col - clusters.first[pixels.cluster, 1]
    older = (pixels.step > 0).nonzero()[:, 0]
    newest = (pixels.step == 0).nonzero()[:, 0]
    slot = pixels.cluster[older] * num_sources + pixels.step[older] - 1
    available = torch.zeros(num_clusters * num_sources, dtype=torch.bool, device=row.device)
    available[slot] = True
    jobs = available.nonzero()[:, 0]
    job_of_slot = torch.empty_like(available, dtype=torch.int64)
    job_of_slot[jobs] = torch.arange(jobs.numel(), device=row.device)
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
    )
    estimates = torch.zeros((num_clusters * num_sources, 3), dtype=torch.float64, device=row.device)
    estimates[jobs, :2] = shift.flip(1).double() * grid.pixel_size  # (dy, dx) -> (x, y)
    scores = torch.zeros(num_clusters * num_sources, dtype=torch.float32, device=row.device)
    scores[jobs] = job_score
    shape = (num_clusters, num_sources)
    return estimates.view(*shape, 3), scores.view(shape), available.view(shape)


def _nothing(batch: Batch) -> Tuple[Tensor, Tensor]:
    """Cluster -1 and score 0 for every point."""
    points = batch.image
    return torch.full_like(points, -1), torch.zeros(points.numel(), dtype=torch.float32, device=points.device)
