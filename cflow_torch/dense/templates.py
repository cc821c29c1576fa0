"""A template is a cluster in an earlier sweep. We search for it in its target, the same cluster at t+1."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from cflow_torch.dense.clustering import Clusters
from cflow_torch.ops.indices import draw, flat_nonzero, gather, renumber, split_index
from cflow_torch.windows.collation import Batch


@dataclass(frozen=True)
class Images:
    """A set of small binary images, given by their set pixels."""

    image: Tensor  # (P,) int64, image of each pixel
    row: Tensor  # (P,) int64, in the image, from 0
    col: Tensor  # (P,) int64, in the image, from 0


@dataclass(frozen=True)
class TemplatePairs:
    """J pairs of a template and its target, in order of cluster, then of sweep, nearest sweep first."""

    # J images, each of a cluster in an earlier sweep. Rows and columns count from the corner of the cluster's box.
    template: Images
    target: Images  # M images, one of each cluster at t+1. Rows and columns count from the same corner
    cluster: Tensor  # (J,) int64, cluster of each pair, which is also the index of its target
    source: Tensor  # (J,) int64, sweep of the template: 0 = t, 1 = t-1, ...
    size: Tensor  # (M, 2) int64, height and width of each cluster's box, and so of its images
    radius: Tensor | None = None  # (J,) float64, pixels, longest shift that is searched; None = half the box
    pixel: Tensor | None = None  # (P,) int64, index of each template pixel into `Clusters.pixels`; None = unknown


def make_pairs(clusters: Clusters, batch: Batch, pixel_size: float | Tensor, max_speed: float | None) -> TemplatePairs:
    """Make a pair for every cluster and every earlier sweep in which it has pixels.

    `pixel_size` is in metres, one for all M clusters or (M,) float64. `max_speed` is in m/s; with None, we
    search shifts of up to half the box.
    """
    pixels = clusters.pixels
    num_sources = batch.num_steps - 1
    num_slots = len(clusters.window) * num_sources  # a slot for every cluster and earlier sweep
    first = clusters.first.index_select(0, pixels.cluster)
    row = pixels.row - first[:, 0]
    col = pixels.col - first[:, 1]
    older = flat_nonzero(pixels.step > 0)
    newest = flat_nonzero(pixels.step == 0)
    slot = (pixels.cluster * num_sources + pixels.step - 1).index_select(0, older)
    pairs = flat_nonzero(draw(slot, num_slots))
    cluster, source = split_index(pairs, num_sources)
    radius = None
    if max_speed is not None:
        seconds = batch.seconds[clusters.window[cluster], source + 1].abs()
        # A tensor in both cases, see `divide`.
        side = pixel_size[cluster] if isinstance(pixel_size, Tensor) else torch.full_like(seconds, pixel_size)
        radius = max_speed * seconds / side + 1  # one for rounding
    return TemplatePairs(
        template=Images(renumber(pairs, num_slots).index_select(0, slot), *gather(older, row, col)),
        target=Images(*gather(newest, pixels.cluster, row, col)),
        cluster=cluster,
        source=source,
        size=clusters.size,
        radius=radius,
        pixel=older,
    )
