"""Template/target pairs: each earlier sweep of each cluster is looked for in sweep t+1 of that cluster."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from cflow_torch.dense.clustering import Clusters
from cflow_torch.ops.indices import flat_nonzero
from cflow_torch.windows.collation import Batch


@dataclass(frozen=True)
class Images:
    """A set of small binary images, given by their set pixels.

    Args:
        image: (P,) int64, image of each pixel.
        row, col: (P,) int64, place inside the image, from 0.
    """

    image: Tensor
    row: Tensor
    col: Tensor

    def take(self, wanted: Tensor) -> Images:
        """Some of N images, numbered anew from 0. Args: wanted: (N,) bool."""
        pixel = flat_nonzero(wanted.index_select(0, self.image))
        image = (wanted.cumsum(0) - 1).index_select(0, self.image.index_select(0, pixel))
        return Images(image, self.row.index_select(0, pixel), self.col.index_select(0, pixel))

    def energy(self, num_images: int) -> Tensor:
        """(N,) int64, number of set pixels of each image."""
        return torch.bincount(self.image, minlength=num_images)


@dataclass(frozen=True)
class TemplatePairs:
    """J pairs of a template and its target, by cluster, then by sweep, nearest first.

    Args:
        template: J images, a cluster in an earlier sweep; places count from the corner of the cluster's box.
        target: M images, each cluster at t+1, likewise.
        cluster: (J,) int64, cluster of each pair, so its target.
        source: (J,) int64, sweep of its template: 0 = t, 1 = t-1, ...
        size: (M, 2) int64, height and width of each cluster's box, which are those of its images.
        radius: (J,) float64, pixels, longest shift that is searched; None = half the box.
    """

    template: Images
    target: Images
    cluster: Tensor
    source: Tensor
    size: Tensor
    radius: Tensor | None = None


def make_pairs(clusters: Clusters, batch: Batch, pixel_size: float | Tensor, max_speed: float | None) -> TemplatePairs:
    """All pairs of some clusters.

    Args:
        clusters: M clusters.
        batch: for the elapsed time of each sweep.
        pixel_size: metres, of the images of the clusters: one, or (M,) float64.
        max_speed: m/s; None = no bound.
    """
    num_clusters, num_sources = clusters.window.numel(), batch.num_steps - 1
    pixels = clusters.pixels
    row = pixels.row - clusters.first[:, 0].index_select(0, pixels.cluster)
    col = pixels.col - clusters.first[:, 1].index_select(0, pixels.cluster)
    older, newest = flat_nonzero(pixels.step > 0), flat_nonzero(pixels.step == 0)
    slot = (pixels.cluster * num_sources + pixels.step - 1).index_select(0, older)
    available = torch.zeros(num_clusters * num_sources, dtype=torch.bool, device=row.device).index_fill_(0, slot, True)
    pairs = flat_nonzero(available)
    pair_of_slot = torch.empty_like(available, dtype=torch.int64)
    pair_of_slot.scatter_(0, pairs, torch.arange(pairs.numel(), device=row.device))
    cluster, source = pairs // num_sources, pairs % num_sources
    radius = None
    if max_speed is not None:
        seconds = batch.seconds[clusters.window[cluster], source + 1]
        size = pixel_size[cluster] if isinstance(pixel_size, Tensor) else torch.full_like(seconds, pixel_size)
        radius = max_speed * seconds.abs() / size + 1
    return TemplatePairs(
        Images(pair_of_slot[slot], row[older], col[older]),
        Images(pixels.cluster[newest], row[newest], col[newest]),
        cluster,
        source,
        clusters.size,
        radius,
    )
