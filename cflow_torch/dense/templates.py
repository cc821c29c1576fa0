"""Jobs of the correlation: each earlier sweep of each cluster is looked for in sweep t+1 of that cluster."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Optional

import torch
from torch import Tensor

from cflow_torch.dense.clustering import Clusters
from cflow_torch.dense.packing import Images
from cflow_torch.ops.indices import flat_nonzero
from cflow_torch.windows.collation import Batch


@dataclass(frozen=True)
class Jobs:
    """J pairs of a cluster and an earlier sweep that has pixels of it, by cluster, then by sweep, nearest first.

    Args:
        template: J images, the cluster in the earlier sweep; places count from the corner of its box.
        target: M images, the cluster at t+1, likewise.
        cluster: (J,) int64, cluster of each job.
        source: (J,) int64, its sweep: 0 = t, 1 = t-1, ...
        radius: (J,) float64, pixels, longest shift that is searched; None = half the box.
    """

    template: Images
    target: Images
    cluster: Tensor
    source: Tensor
    radius: Optional[Tensor]


def make_jobs(
    clusters: Clusters, batch: Batch, pixel_size: float, max_speed: Optional[float], slices: Optional[Tensor] = None
) -> Jobs:
    """All jobs of some clusters.

    Args:
        clusters: M clusters.
        batch: for the elapsed time of each sweep.
        pixel_size: metres, of the images of the clusters.
        max_speed: m/s; None = no bound.
        slices: (P,) uint8, height slices of each pixel of the clusters; None = there is one slice.
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
    cluster, source = jobs // num_sources, jobs % num_sources
    radius = None
    if max_speed is not None:
        seconds = batch.seconds[clusters.window[cluster], source + 1]
        radius = max_speed * seconds / torch.full_like(seconds, pixel_size) + 1
    return Jobs(
        Images(job_of_slot[slot], row[older], col[older], None if slices is None else slices[older]),
        Images(pixels.cluster[newest], row[newest], col[newest], None if slices is None else slices[newest]),
        cluster,
        source,
        radius,
    )
