"""Clusters by HDBSCAN in place of connected components (Table which_clustering_method); the rest is unchanged."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from cflow_torch.config import DenseConfig
from cflow_torch.dense.clustering import Clusters, keep_live
from cflow_torch.dense.projection import ProjectedSweeps
from cflow_torch.ops.segments import segment_amin
from cflow_torch.types import CFlowError


def find_dense_clusters(sweeps: ProjectedSweeps, config: DenseConfig) -> tuple[Clusters, Tensor, Tensor]:
    """Spatio-temporal clusters of the aggregated points (t+1, t, t-1, ...) by HDBSCAN on x, y, z.

    Args:
        sweeps: whose points have three axes.
        config: `min_cluster_size`.

    Returns:
        clusters: those with pixels at t+1 and before. Unlike components, clusters may share pixels.
        cluster_of_cell: (P,) int64, cluster of each point, M = none (HDBSCAN's noise included).
        cell_of_point: (P,) int64, 0 ... P - 1: every point is a cell of its own.

    Raises:
        CFlowError: the extra is not installed.

    Convention:
        Numbered by window, then by first pixel in raster order, then by HDBSCAN's label.

    Cost: N log N in points, on the CPU, window by window: a library's work, seconds for a full sweep pair.
    """
    batch, grid, pixel, positions = sweeps.batch, sweeps.grid, sweeps.pixel, sweeps.positions()
    window = batch.image // batch.num_steps
    num_pixels = batch.num_windows * batch.num_steps * grid.height * grid.width
    label = torch.full_like(pixel, -1)
    num_labels = 0
    for index in range(batch.num_windows):
        points = ((pixel < num_pixels) & (window == index)).nonzero()[:, 0]
        found = torch.from_numpy(hdbscan_labels(positions[:, points].t().cpu().numpy(), config.min_cluster_size))
        label[points] = torch.where(found >= 0, found + num_labels, found).to(label.device)
        num_labels += int(found.max()) + 1 if found.numel() else 0

    # Occupied pixels, once per cluster and sweep.
    member = (label >= 0).nonzero()[:, 0]
    key = torch.unique(label[member] * num_pixels + pixel[member])
    owner, place = key // num_pixels, key % num_pixels
    image, raster = place // (grid.height * grid.width), place % (grid.height * grid.width)

    # Name components by window (labels ascend with it), then by first pixel.
    first = segment_amin(raster, owner, num_labels, grid.height * grid.width)
    of_window = segment_amin(image // batch.num_steps, owner, num_labels, batch.num_windows)
    order = torch.sort(of_window * (grid.height * grid.width + 1) + first, stable=True).indices
    component = torch.empty_like(order).index_copy_(0, order, torch.arange(num_labels, device=order.device))
    clusters, number = keep_live(
        component[owner],
        num_labels,
        image // batch.num_steps,
        image % batch.num_steps,
        raster // grid.width,
        raster % grid.width,
    )
    of_point = torch.full_like(label, clusters.window.numel())
    of_point[member] = number[component[label[member]]]
    return clusters, of_point, torch.arange(of_point.numel(), device=of_point.device)


def hdbscan_labels(points: np.ndarray, min_cluster_size: int) -> np.ndarray:
    """HDBSCAN label of each point.

    Args:
        points: (N, 3) float64, metres.
        min_cluster_size: smallest cluster, points.

    Returns:
        (N,) int64, 0 ... L - 1, -1 = noise.

    Raises:
        CFlowError: the extra is not installed.
    """
    if len(points) <= min_cluster_size:  # too few for the library to build its tree
        return np.full(len(points), -1, dtype=np.int64)
    try:
        from hdbscan import HDBSCAN
    except ImportError:
        raise CFlowError("clustering='hdbscan' needs the hdbscan package: pip install hdbscan") from None
    return HDBSCAN(min_cluster_size=min_cluster_size).fit_predict(points).astype(np.int64)
