"""CorrelationFlow, the paper's dense method (Alg. general_correlation_flow): project, cluster, correlate, pool."""

from __future__ import annotations

import torch.nn.functional as F

from cflow_torch.dense.clustering import find_clusters
from cflow_torch.dense.coarse_to_fine import CoarseToFine, ProjectedSweeps
from cflow_torch.dense.correlation import correlate
from cflow_torch.dense.hdbscan import find_dense_clusters
from cflow_torch.dense.history import pool
from cflow_torch.dense.sectional_view import add_sectional_view
from cflow_torch.model import Motion
from cflow_torch.ops.indices import index_in_group
from cflow_torch.stages import stage


class CorrelationFlow(CoarseToFine):
    """The paper's dense method: windows in, flow out. It has no parameters, no buffers and no state.

    Args:
        config: a `DenseConfig`. `CorrelationFlow.from_preset` makes one from a preset.

    Examples:
        >>> from cflow_torch import CorrelationFlow, Sweep, Window
        >>> model = CorrelationFlow.from_preset("paper", pixel_size=0.1)
        >>> car = 0.1 * torch.cartesian_prod(torch.arange(45.0), torch.arange(18.0), torch.arange(15.0)) + 5.05
        >>> window = Window(pc0=Sweep(car), pc1=Sweep(car + torch.tensor([0.5, 0.0, 0.0])))
        >>> (result,) = model([window])
        >>> result.residual_flow[0]
        tensor([0.5000, 0.0000, 0.0000])
    """

    method = "dense"

    @property
    def num_axes(self) -> int:  # type: ignore[override]
        """Number of point coordinates that the settings need: 2 (x, y) or 3."""
        return 3 if self.config.sectional_view or self.config.clustering == "hdbscan" else 2

    def motion_at_scale(self, sweeps: ProjectedSweeps) -> Motion:
        """Estimate the motion of every cluster at one pixel size."""
        config = self.config
        with stage("cluster"):
            find = find_dense_clusters if config.clustering == "hdbscan" else find_clusters
            clusters, cluster_of_cell, cell_of_point = find(sweeps, config)
        with stage("correlate"):
            estimates = correlate(clusters, sweeps, config)
            if config.sectional_view:
                cluster_of_point = cluster_of_cell.index_select(0, cell_of_point)
                estimates = add_sectional_view(estimates, cluster_of_point, sweeps, config)
        with stage("pool"):
            return Motion(
                cluster_of_cell=cluster_of_cell,
                cell_of_point=cell_of_point,
                flow=F.pad(pool(estimates.per_interval(), estimates.available), (0, 0, 0, 1)),
                cluster_id=F.pad(index_in_group(clusters.window), (0, 1), value=-1),
                score=F.pad(estimates.newest_score(), (0, 1)),
            )
