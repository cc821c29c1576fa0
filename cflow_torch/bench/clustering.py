"""The clustering stage alone: occupancy images -> clusters with boxes, finest scale, one window."""

from __future__ import annotations

import time
from typing import Any, Dict, Tuple

import numpy as np

from cflow_torch.bench.opencv_loop import dilate_and_label, find_clusters
from cflow_torch.bench.timing import alternate, median_ratio, summary, synchronise
from cflow_torch.config import Config
from cflow_torch.dense.clustering import cluster
from cflow_torch.dense.hdbscan import hdbscan_labels
from cflow_torch.types import CFlowError, Window
from cflow_torch.windows.bev_grid import Grid
from cflow_torch.windows.collation import Batch, make_batch


def measure_clustering(window: Window, config: Config, repeats: int, why_no_opencv: str, device: Any) -> Dict[str, Any]:
    """The stage against OpenCV.

    Args:
        window: sweeps.
        config: settings of the dense method.
        repeats: timed runs of each, in turn.
        why_no_opencv: why OpenCV is not measured; "" = it is.
        device: of the fast path; OpenCV runs on the CPU in any case.

    Returns:
        "fast" (dilate, label, erode, label again, number), "opencv" (the same by `find_clusters`), "opencv_over_fast",
        "dilate_and_label" (two bare calls of OpenCV on the image of all sweeps), "dilate_and_label_over_fast". What was
        not measured is a text.
    """
    if config.method != "dense":
        none = "no clustering"
        return {"fast": none, "opencv": none, "dilate_and_label": none}
    grid, batch = _batch(window, config, device)
    occupancy, _ = grid.project(batch.positions, batch.image, batch.num_steps, batch.takes_part)
    images = [image.byte().cpu().numpy() for image in occupancy]
    aggregated = np.bitwise_or.reduce(images)

    def fast() -> None:
        cluster(occupancy[None], grid.pixel_size, config)
        synchronise(occupancy)

    if why_no_opencv:
        (times,) = alternate([fast], repeats)
        return {"fast": summary(times), "opencv": why_no_opencv, "dilate_and_label": why_no_opencv}
    times, loop_times, bare_times = alternate(
        [
            fast,
            lambda: find_clusters(images, grid.pixel_size, config),
            lambda: dilate_and_label(aggregated, config.connectivity),
        ],
        repeats,
    )
    return {
        "fast": summary(times),
        "opencv": summary(loop_times),
        "opencv_over_fast": median_ratio(times, loop_times),
        "dilate_and_label": summary(bare_times),
        "dilate_and_label_over_fast": median_ratio(times, bare_times),
    }


def measure_hdbscan(window: Window, config: Config) -> Any:
    """Seconds of HDBSCAN on the points of all sweeps that take part, once; a text where it is not installed."""
    _, batch = _batch(window, config.replace(clustering="hdbscan"), "cpu")  # which needs z
    points = np.ascontiguousarray(batch.positions[:, batch.takes_part].t().numpy())
    try:
        hdbscan_labels(points[: 5 * config.min_cluster_size], config.min_cluster_size)  # compiled and imported
        start = time.perf_counter()
        hdbscan_labels(points, config.min_cluster_size)
    except CFlowError:
        return "hdbscan is not installed"
    return time.perf_counter() - start


def _batch(window: Window, config: Config, device: Any) -> Tuple[Grid, Batch]:
    x0, y0, z0, x1, y1, z1 = config.point_cloud_range
    grid = Grid(config.pixel_sizes[-1], (x0, y0, z0), (x1, y1, z1))
    return grid, make_batch([window], config, grid, device)
