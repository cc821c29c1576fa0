"""Clusters by HDBSCAN in place of connected components (Table which_clustering_method)."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from cflow_torch.config import DenseConfig
from cflow_torch.dense.clustering import ClusterPixels, Clusters, cluster_boxes
from cflow_torch.dense.coarse_to_fine import ProjectedSweeps
from cflow_torch.errors import import_optional
from cflow_torch.ops.groups import FAR, Groups
from cflow_torch.ops.indices import flat_nonzero, split_index
from cflow_torch.windows.bev_grid import LONGEST_SIDE


def find_dense_clusters(sweeps: ProjectedSweeps, config: DenseConfig) -> tuple[Clusters, Tensor, Tensor]:
    """Cluster the points of all sweeps of each window (t+1, t, t-1, ...) by HDBSCAN on x, y, z.

    Returns:
        clusters: M clusters, each with pixels at t+1 and before, in order of window, then of first pixel in raster
            order, then of HDBSCAN's label. Unlike components, clusters may share pixels.
        cluster_of_cell: (P,) int64, cluster of each point, M = none (HDBSCAN's noise included).
        cell_of_point: (P,) int64, 0 ... P - 1: every point is a cell of its own.

    Cost: N log N in points, on the CPU, window by window; seconds for a full pair of sweeps.
    """
    labels = _label_points(sweeps, config.min_cluster_size)
    pixels = _occupied_pixels(sweeps, labels)
    kept = _linked(pixels)
    clusters = pixels.labels.select(kept)
    top_left, size = cluster_boxes(clusters, torch.stack((pixels.row, pixels.col)))
    is_kept = clusters.is_member
    result = Clusters(
        window=pixels.window[clusters.first()],
        first=top_left,
        size=size,
        pixels=ClusterPixels(
            cluster=clusters.of_item[is_kept],
            step=pixels.step[is_kept],
            row=pixels.row[is_kept],
            col=pixels.col[is_kept],
        ),
    )
    return result, labels.select(kept).of_item, torch.arange(len(sweeps.pixel), device=sweeps.pixel.device)


def _label_points(sweeps: ProjectedSweeps, min_cluster_size: int) -> Groups:
    """Cluster the points window by window: P points, noise in no group. Labels ascend with the window."""
    positions = sweeps.positions()
    window = sweeps.batch.image // sweeps.batch.num_steps
    is_inside = sweeps.pixel < sweeps.occupancy.numel()
    label = torch.full_like(sweeps.pixel, -1)
    num_labels = 0
    for index in range(sweeps.batch.num_windows):
        points = flat_nonzero(is_inside & (window == index))
        of_window = torch.from_numpy(_labels(positions[:, points].t().cpu().numpy(), min_cluster_size))
        label[points] = torch.where(of_window >= 0, of_window + num_labels, -1).to(label.device)
        num_labels += int(of_window.max()) + 1 if len(of_window) else 0
    return Groups(label, num_labels).where(label >= 0)


class _LabelledPixels(NamedTuple):
    """Occupied pixels, each once per label and sweep, in order of label, sweep and raster."""

    labels: Groups  # of Q pixels
    window: Tensor  # (Q,) int64
    step: Tensor  # (Q,) int64
    row: Tensor  # (Q,) int64
    col: Tensor  # (Q,) int64


def _occupied_pixels(sweeps: ProjectedSweeps, labels: Groups) -> _LabelledPixels:
    """Return the pixels of the labelled points."""
    members = flat_nonzero(labels.is_member)
    num_cells = sweeps.occupancy.numel()
    label_and_cell = torch.unique(labels.of_item[members] * num_cells + sweeps.pixel[members])
    label, cell = split_index(label_and_cell, num_cells)
    image_row, col = split_index(cell, sweeps.grid.width)
    image, row = split_index(image_row, sweeps.grid.height)
    window, step = split_index(image, sweeps.batch.num_steps)
    return _LabelledPixels(Groups(label, labels.count), window, step, row, col)


def _linked(pixels: _LabelledPixels) -> Tensor:
    """Return the labels with pixels at t+1 and before, (M,) int64, in order of window, then of first pixel."""
    is_newest = pixels.step == 0
    linked = flat_nonzero(pixels.labels.any(is_newest) & pixels.labels.any(~is_newest))
    raster = (pixels.window * LONGEST_SIDE + pixels.row) * LONGEST_SIDE + pixels.col
    first = pixels.labels.min(raster, empty=FAR)[linked]
    return linked[first.argsort(stable=True)]


def _labels(points: np.ndarray, min_cluster_size: int) -> np.ndarray:
    """(N,) int64 label of each of (N, 3) points: 0 ... L - 1, -1 = noise."""
    if len(points) <= min_cluster_size:  # the library cannot build its tree from so few points
        return np.full(len(points), -1, dtype=np.int64)
    hdbscan = import_optional(
        "hdbscan", "clustering='hdbscan' needs the hdbscan package (extra hdbscan): pip install hdbscan"
    )
    return hdbscan.HDBSCAN(min_cluster_size=min_cluster_size).fit_predict(points).astype(np.int64)
