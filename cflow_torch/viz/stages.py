"""What the method sees on its way, as plain arrays: scales, the correlation of one cluster, key points and matches.

Nothing is computed anew here: a run of the model is watched, and the stage functions of the package are asked again.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import List, Optional, Tuple

import numpy as np
import torch
from torch import Tensor

from cflow_torch.config import Config, DenseConfig, KeypointsConfig
from cflow_torch.dense.clustering import find_clusters
from cflow_torch.dense.correlation import correlate
from cflow_torch.dense.projection import project
from cflow_torch.dense.templates import Images, make_pairs
from cflow_torch.keypoints.descriptors import describe
from cflow_torch.keypoints.match_candidates import match_radius
from cflow_torch.keypoints.matching import match
from cflow_torch.ops.cross_correlation import cross_correlate
from cflow_torch.ops.indices import flat_nonzero
from cflow_torch.types import CFlowError, FlowResult, Window
from cflow_torch.viz.panel import group_medians
from cflow_torch.viz.watch import Occupancy, Step, watch


@dataclass(frozen=True)
class Scale:
    """One step from coarse to fine.

    Args:
        before: what this scale sees: sweep t moved by the flow of the coarser ones.
        after: the same pixels, sweep t moved by the flow that includes this scale's.
        flow_before, flow_after: (N, 3) float64, residual flow of the rows of pc0 so far, metres per sweep interval.
        cluster_id: (N,) int64, clusters of this scale, -1 = none.
    """

    before: Occupancy
    after: Occupancy
    flow_before: np.ndarray
    flow_after: np.ndarray
    cluster_id: np.ndarray


@dataclass(frozen=True)
class ClusterCorrelation:
    """Normalised cross-correlation of one cluster between t and t+1, at the finest scale (Eq. norm_correlation).

    Args:
        cluster_id: as in `FlowResult`.
        images: template (t) and target (t+1): the pixels of the cluster in its box.
        ncc: (H, W) float64 of each shift (dy, dx) at [dy + H // 2, dx + W // 2], 0 ... 1; NaN = not searched.
        shift: (2,) float64, (dy, dx) that the method takes, pixels.
        score: NCC at that shift.
        flow: (3,) float64, flow of the cluster at this scale, metres per sweep interval: the shift times the pixel
            size where there is no history.
        total: (3,) float64, the same with what the coarser scales found, in the median of its points.
    """

    cluster_id: int
    images: Occupancy
    ncc: np.ndarray
    shift: np.ndarray
    score: float
    flow: np.ndarray
    total: np.ndarray


@dataclass(frozen=True)
class KeyPointMatches:
    """Key points of both sweeps and the matches that the ratio test accepts, at the finest scale.

    Args:
        images: occupancy.
        key_points, key_points1: (K, 2) int64, (row, col), sweep t and t+1.
        source: (M,) int64, key point of t of each match.
        shift: (M, 2) int64, (dy, dx), pixels.
        score: (M,) float64, NCC of the descriptors.
    """

    images: Occupancy
    key_points: np.ndarray
    key_points1: np.ndarray
    source: np.ndarray
    shift: np.ndarray
    score: np.ndarray


def scales(window: Window, config: Config) -> Tuple[List[Scale], FlowResult]:
    """Every scale of a run, coarse to fine, and the run's result.

    Raises:
        CFlowError: the method has no scales one after the other, or bad input.
    """
    steps, result = watch(window, config)
    found = []
    for step in steps:
        points = step.sweeps.batch.sources[0].points
        after = step.flow_after()
        before = torch.zeros_like(after) if step.flow is None else step.flow
        of_point = step.motion.cluster_id.index_select(0, step.motion.cluster(points))
        found.append(
            Scale(
                before=step.occupancy(before),
                after=step.occupancy(after),
                flow_before=_rows(before, points),
                flow_after=_rows(after, points),
                cluster_id=of_point.numpy(),
            )
        )
    return found, result


def cluster_correlation(window: Window, config: Config, cluster_id: Optional[int] = None) -> ClusterCorrelation:
    """The correlation of one cluster of a dense run.

    Args:
        window: sweeps.
        config: `method="dense"`, clusters by components.
        cluster_id: as in `FlowResult`; None = the most conspicuous mover: of the clusters seen in t, the one with most
            pixels times metres of motion, all scales together.

    Raises:
        CFlowError: a method without such a map, no such cluster, or bad input.
    """
    if not isinstance(config, DenseConfig) or config.clustering != "components":
        raise CFlowError(
            f"method={config.method}: only the dense method with clusters by "
            'components has a correlation map per cluster: give make_config("paper"), or model=paper'
        )
    (*_, last), _ = watch(window, config)
    sweeps, grid = project(last.sweeps.batch, last.flow, last.sweeps.grid), last.sweeps.grid
    clusters, _, _ = find_clusters(sweeps, config)
    pairs = make_pairs(clusters, sweeps.batch, grid.pixel_size, config.max_speed)
    estimates = correlate(clusters, sweeps, config)

    of_pair = flat_nonzero(pairs.source == 0)
    available = pairs.cluster.index_select(0, of_pair)
    if available.numel() == 0:
        raise CFlowError("no cluster has points in both sweeps: there is no correlation to draw")
    total = _total_flow(last, clusters.window.numel())
    if cluster_id is None:
        length = total[available].norm(dim=1)
        pixels = pairs.template.energy(pairs.cluster.numel()).index_select(0, of_pair)
        chosen = int((length * pixels).argmax())
    elif cluster_id in available:
        chosen = int((available == cluster_id).nonzero())
    else:
        raise CFlowError(
            f"cluster_id={cluster_id}: no such cluster has points in both sweeps. There are {clusters.window.numel()}; "
            "cluster_id of a FlowResult tells which point is in which"
        )
    number = int(available[chosen])
    size, first = clusters.size[number], clusters.first[number]
    template = _draw(pairs.template, int(of_pair[chosen]), size)
    target = _draw(pairs.target, number, size)
    ncc = _ncc_map(template, target, config.correlation)
    if pairs.radius is not None:
        dy, dx = (torch.arange(n) - n // 2 for n in ncc.shape)
        reach = pairs.radius[of_pair[chosen]]
        ncc[dy[:, None] ** 2 + dx**2 > reach * reach] = torch.nan
    lower = np.array(grid.lower[:2]) + grid.pixel_size * first.flip(0).numpy()
    shift = (estimates.displacement[number, 0, :2] / grid.pixel_size).flip(0).numpy()
    return ClusterCorrelation(
        cluster_id=number,
        images=Occupancy(template.numpy() > 0, target.numpy() > 0, lower, grid.pixel_size),
        ncc=ncc.numpy(),
        shift=shift,
        score=float(estimates.score[number, 0]),
        flow=last.motion.flow[number].numpy(),
        total=total[number].numpy(),
    )


def keypoint_matches(window: Window, config: Config) -> KeyPointMatches:
    """Key points and matches of a run.

    Raises:
        CFlowError: another method, or bad input.
    """
    if not isinstance(config, KeypointsConfig):
        raise CFlowError(f'method={config.method}: key points are matched by make_config("keypoints"), model=keypoints')
    (*_, last), _ = watch(window, config)
    sweeps = project(last.sweeps.batch, last.flow, last.sweeps.grid)
    pc1, pc0 = (describe(sweeps.occupancy[:, step], config.patch_size) for step in (0, 1))
    matches = match(pc0, pc1, match_radius(sweeps.batch, sweeps.grid.pixel_size, config), config)
    return KeyPointMatches(
        images=last.occupancy(last.flow),
        key_points=torch.stack((pc0.row, pc0.col), 1).numpy(),
        key_points1=torch.stack((pc1.row, pc1.col), 1).numpy(),
        source=matches.source.numpy(),
        shift=matches.shift.numpy(),
        score=matches.score.numpy(),
    )


def _rows(flow: Tensor, points: slice) -> np.ndarray:
    """(N, 3) float64 of (A, P)."""
    rows = np.zeros((points.stop - points.start, 3))
    rows[:, : len(flow)] = flow[:, points].numpy().T
    return rows


def _total_flow(step: Step, num_clusters: int) -> Tensor:
    """(M, 3) float64, median flow of the points of t in each cluster, all scales so far together; 0 without points."""
    points = step.sweeps.batch.sources[0].points
    cluster = step.motion.cluster(points).numpy().astype(np.int64)
    cluster[cluster == num_clusters] = -1
    median, _ = group_medians(cluster, _rows(step.flow_after(), points))
    total = torch.zeros(num_clusters, 3, dtype=torch.float64)
    total[np.unique(cluster[cluster >= 0])] = torch.from_numpy(median)
    return total


def _draw(images: Images, number: int, size: Tensor) -> Tensor:
    """(H, W) float32, one of a set of images."""
    pixel = flat_nonzero(images.image == number)
    image = torch.zeros(size.tolist())
    image[images.row[pixel], images.col[pixel]] = 1
    return image


def _ncc_map(template: Tensor, target: Tensor, engine: str) -> Tensor:
    """(H, W) float64, as `ClusterCorrelation.ncc`. A window of ones over the target counts its pixels."""
    height, width = template.shape
    images = torch.zeros(3, 2 * height, 2 * width)
    images[:, :height, :width] = torch.stack((template, torch.ones_like(template), target))
    counts = cross_correlate(images, 2, torch.zeros(2, dtype=torch.int64), engine).round().double()
    # Half of the images is free: negative shifts stand at the far end.
    dy, dx = ((torch.arange(n) - n // 2) % (2 * n) for n in (height, width))
    overlap, in_window = counts[:, dy[:, None], dx]
    energies = in_window * template.double().sum()
    return torch.where(energies > 0, overlap / energies.clamp(min=1).sqrt(), torch.zeros_like(overlap))
