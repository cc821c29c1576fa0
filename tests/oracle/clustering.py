"""Oracle of Sec. clustering: Alg. clustering by SciPy's morphology and labelling, and HDBSCAN in its place."""

from __future__ import annotations

from typing import Sequence

import numpy as np
from scipy import ndimage

from cflow_torch.config import DenseConfig
from oracle.pixels import bounding_box

SQUARE = np.ones((3, 3), dtype=bool)


def cluster(images: Sequence[np.ndarray], pixel_size: float, max_extent: float, connectivity: int) -> np.ndarray:
    """Find spatio-temporal clusters as connected components of the aggregated image (Alg. clustering).

    Args:
        images: occupancy (H, W) bool of sweep t+1, then of sweeps t, t-1, ...
        max_extent: d^max in metres.

    Returns:
        (H, W) int64: cluster of every pixel that some sweep occupies, -1 elsewhere and in clusters without a pixel
        at t+1 or without a pixel before it. Numbered 0 ... M-1 in raster order of the first occupied pixel.

    Convention: a component is measured dilated, as the longer side of its box in pixels times s; exactly d^max is
        not too large. An oversized component is eroded and labelled again once, whatever size results.
    """
    aggregated = np.logical_or.reduce(images)
    neighbours = ndimage.generate_binary_structure(2, connectivity // 4)
    labels, total = ndimage.label(ndimage.binary_dilation(aggregated, SQUARE), neighbours)

    # Validation of the connected components. Pixels outside the image are ignored: its border does not erode.
    for component in range(1, 1 + total):
        _, _, height, width = bounding_box([np.argwhere(labels == component)])
        if max(height, width) * pixel_size > max_extent:
            eroded = ndimage.binary_erosion(labels == component, SQUARE, border_value=1)
            labels[labels == component] = 0
            parts, count = ndimage.label(eroded, neighbours)
            labels[eroded] = parts[eroded] + total
            total += count

    # Number the components that can move: a pixel at t+1 and a pixel before.
    at_t1 = set(labels[images[0]].tolist())
    before = {label for image in images[1:] for label in labels[image].tolist()}
    numbers: dict[int, int] = {}
    result = np.full(labels.shape, -1, dtype=np.int64)
    for r, c in np.argwhere(aggregated).tolist():
        label = int(labels[r, c])
        if label in at_t1 and label in before:
            result[r, c] = numbers.setdefault(label, len(numbers))
    return result


def cluster_hdbscan(
    points: Sequence[np.ndarray], pixels: Sequence[np.ndarray], config: DenseConfig
) -> list[np.ndarray]:
    """Cluster the aggregated points by HDBSCAN in place of Alg. clustering (Table which_clustering_method).

    Args:
        points: (N, 3) float64 of sweep t+1, then of sweeps t, t-1, ...
        pixels: (N, 2) their BEV pixels (row, column).

    Returns:
        Per sweep (N,) int64, cluster of every point, -1 for noise and for clusters without a point at t+1 or without
        one before it. Numbered in raster order of the first pixel; clusters that share it by label.
    """
    from hdbscan import HDBSCAN

    aggregated = np.concatenate(points)
    labels = np.full(len(aggregated), -1)
    if len(aggregated) > config.min_cluster_size:
        labels = HDBSCAN(min_cluster_size=config.min_cluster_size).fit_predict(aggregated)
    of_sweep = np.split(labels, np.cumsum([len(p) for p in points])[:-1])
    live = [i for i in range(labels.max(initial=-1) + 1) if i in of_sweep[0] and any(i in m for m in of_sweep[1:])]
    first = {i: min(tuple(p) for m, pixel in zip(of_sweep, pixels) for p in pixel[m == i].tolist()) for i in live}
    numbers = {label: number for number, label in enumerate(sorted(live, key=lambda i: (first[i], i)))}
    return [np.array([numbers.get(label, -1) for label in m.tolist()], dtype=np.int64) for m in of_sweep]
