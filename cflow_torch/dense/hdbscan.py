"""Clusters by HDBSCAN in place of connected components (Table which_clustering_method)."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from cflow_torch.config import DenseConfig
from cflow_torch.dense.clustering import Clusters, Pixels
from cflow_torch.dense.coarse_to_fine import ProjectedSweeps
from cflow_torch.errors import import_optional
from cflow_torch.ops.indices import draw, flat_nonzero, renumber, split_index
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
    num_steps = sweeps.batch.num_steps
    label, num_labels = _label_points(sweeps, config.min_cluster_size)
    pixels = _occupied_pixels(sweeps, label)
    # Labels ascend with the window.
    area = sweeps.grid.height * sweeps.grid.width
    window_and_pixel = pixels.image // num_steps * area + pixels.raster
    first = segment_amin(window_and_pixel, pixels.label, num_labels, sweeps.occupancy.numel())
    step = pixels.image % num_steps
    kept = flat_nonzero(draw(pixels.label[step == 0], num_labels) & draw(pixels.label[step > 0], num_labels))
    kept = kept[first[kept].argsort(stable=True)]
    cluster_of_label = renumber(kept, num_labels)

    cluster = cluster_of_label[pixels.label]
    is_kept = cluster < len(kept)
    row, col = split_index(pixels.raster[is_kept], sweeps.grid.width)
    members = Pixels(cluster=cluster[is_kept], step=step[is_kept], row=row, col=col)
    top_left, size = bounding_boxes(row, col, members.cluster, len(kept))
    clusters = Clusters(window=first[kept] // area, first=top_left, size=size, pixels=members)
    return clusters, cluster_of_label[label], torch.arange(len(label), device=label.device)


def _label_points(sweeps: ProjectedSweeps, min_cluster_size: int) -> tuple[Tensor, int]:
    """Cluster the points window by window: label of each point, (P,) int64, -1 = noise, and the number of labels."""
    batch = sweeps.batch
    positions = sweeps.positions()
    window = batch.image // batch.num_steps
    is_inside = sweeps.pixel < sweeps.occupancy.numel()
    label = torch.full_like(sweeps.pixel, -1)
    num_labels = 0
    for index in range(batch.num_windows):
        points = flat_nonzero(is_inside & (window == index))
        found = torch.from_numpy(_labels(positions[:, points].t().cpu().numpy(), min_cluster_size))
        label[points] = torch.where(found >= 0, found + num_labels, found).to(label.device)
        num_labels += int(found.max()) + 1 if len(found) else 0
    return label, num_labels


class _LabelledPixels(NamedTuple):
    """Occupied pixels, each once per label and sweep, in order of label, image and raster; (Q,) int64 each."""

    label: Tensor
    image: Tensor  # window * num_steps + step
    raster: Tensor  # row * W + column


def _occupied_pixels(sweeps: ProjectedSweeps, label: Tensor) -> _LabelledPixels:
    """Return the pixels of the labelled points; `label` is (P,) int64, -1 = none."""
    member = flat_nonzero(label >= 0)
    num_cells = sweeps.occupancy.numel()
    label_and_cell = torch.unique(label[member] * num_cells + sweeps.pixel[member])
    label_of_pixel, cell = split_index(label_and_cell, num_cells)
    return _LabelledPixels(label_of_pixel, *split_index(cell, sweeps.grid.height * sweeps.grid.width))


def _labels(points: np.ndarray, min_cluster_size: int) -> np.ndarray:
    """(N,) int64 label of each of (N, 3) points: 0 ... L - 1, -1 = noise."""
    if len(points) <= min_cluster_size:  # the library cannot build its tree from so few points
        return np.full(len(points), -1, dtype=np.int64)
    hdbscan = import_optional("hdbscan", "clustering='hdbscan' needs the hdbscan package: pip install hdbscan")
    return hdbscan.HDBSCAN(min_cluster_size=min_cluster_size).fit_predict(points).astype(np.int64)
