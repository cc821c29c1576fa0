"""Clusters by HDBSCAN in place of connected components (Table which_clustering_method)."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from cflow_torch.config import DenseConfig
from cflow_torch.dense.clustering import Clusters, Pixels
from cflow_torch.dense.coarse_to_fine import ProjectedSweeps
from cflow_torch.errors import import_optional
from cflow_torch.ops.indices import renumber
from cflow_torch.ops.segments import bounding_boxes, segment_amin


def find_dense_clusters(sweeps: ProjectedSweeps, config: DenseConfig) -> tuple[Clusters, Tensor, Tensor]:
    """Cluster the points of all sweeps of each window (t+1, t, t-1, ...) by HDBSCAN on x, y, z.

    Returns:
        clusters: M clusters, each with pixels at t+1 and before, in order of window, then of first pixel in raster
            order, then of HDBSCAN's label. Unlike components, clusters may share pixels.
        cluster_of_cell: (P,) int64, cluster of each point, M = none (HDBSCAN's noise included).
        cell_of_point: (P,) int64, 0 ... P - 1: every point is a cell of its own.

    Cost: N log N in points, on the CPU, window by window; seconds for a full pair of sweeps.
    """
    batch, grid, pixel, positions = sweeps.batch, sweeps.grid, sweeps.pixel, sweeps.positions()
    area, num_cells = grid.height * grid.width, sweeps.occupancy.numel()
    window = batch.image // batch.num_steps
    label = torch.full_like(pixel, -1)
    num_labels = 0
    for index in range(batch.num_windows):
        points = ((pixel < num_cells) & (window == index)).nonzero()[:, 0]
        found = torch.from_numpy(_labels(positions[:, points].t().cpu().numpy(), config.min_cluster_size))
        label[points] = torch.where(found >= 0, found + num_labels, found).to(label.device)
        num_labels += int(found.max()) + 1 if found.numel() else 0

    # Occupied pixels, each once per label and sweep.
    member = (label >= 0).nonzero()[:, 0]
    key = torch.unique(label[member] * num_cells + pixel[member])
    label_of_pixel, image, raster = key // num_cells, key % num_cells // area, key % area
    step = image % batch.num_steps
    steps_seen = torch.zeros((num_labels, batch.num_steps), dtype=torch.bool, device=key.device)
    steps_seen[label_of_pixel, step] = True
    kept = (steps_seen[:, 0] & steps_seen[:, 1:].any(1)).nonzero()[:, 0]
    # Labels ascend with the window.
    first = segment_amin(raster + image // batch.num_steps * area, label_of_pixel, num_labels, num_cells)
    kept = kept[first[kept].argsort(stable=True)]
    cluster_of_label = renumber(kept, num_labels)

    is_kept = cluster_of_label[label_of_pixel] < len(kept)
    label_of_pixel, step, raster = cluster_of_label[label_of_pixel[is_kept]], step[is_kept], raster[is_kept]
    pixels = Pixels(label_of_pixel, step, raster // grid.width, raster % grid.width)
    boxes = bounding_boxes(pixels.row, pixels.col, label_of_pixel, len(kept))
    clusters = Clusters(first[kept] // area, *boxes, pixels)
    return clusters, cluster_of_label[label], torch.arange(len(label), device=label.device)


def _labels(points: np.ndarray, min_cluster_size: int) -> np.ndarray:
    """(N,) int64 label of each of (N, 3) points: 0 ... L - 1, -1 = noise."""
    if len(points) <= min_cluster_size:  # the library cannot build its tree from so few points
        return np.full(len(points), -1, dtype=np.int64)
    hdbscan = import_optional("hdbscan", "clustering='hdbscan' needs the hdbscan package: pip install hdbscan")
    return hdbscan.HDBSCAN(min_cluster_size=min_cluster_size).fit_predict(points).astype(np.int64)
