"""Intermediate results of the paper's methods as plain arrays: scales, the correlation of one cluster, key points.

Occupancy images show sweep t in blue, t+1 in red, and pixels of both in a dark colour.

We record every scale of a run. For the correlation and the key points, we compute the finest scale a second time. The
presets default, offline and live weigh the motions of all scales together, so they have no such results.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from cflow_torch.config import Config, DenseConfig, KeypointsConfig
from cflow_torch.dense.clustering import find_clusters
from cflow_torch.dense.coarse_to_fine import ProjectedSweeps, project
from cflow_torch.dense.correlation import best_shifts
from cflow_torch.dense.templates import Images, make_pairs
from cflow_torch.estimate import make_model
from cflow_torch.keypoints.match_candidates import describe_keypoints, match_radius
from cflow_torch.keypoints.matching import match_keypoints
from cflow_torch.ops.cross_correlation import cross_correlate
from cflow_torch.ops.indices import flat_nonzero
from cflow_torch.types import CFlowError, FlowResult, Window
from cflow_torch.viz.panel import group_medians
from cflow_torch.viz.style import Axes

COLORS = {"sweep t": (79, 134, 217), "sweep t+1": (232, 96, 76), "both": (43, 33, 64)}


@dataclass(frozen=True)
class Occupancy:
    """Occupancy images of a pair of sweeps from above."""

    t: np.ndarray  # (H, W) bool, sweep t moved by the flow so far; row from y, column from x
    t1: np.ndarray  # (H, W) bool, sweep t+1
    lower: np.ndarray  # (2,) float64, metres, corner (x, y) of pixel (0, 0), frame of t+1
    pixel_size: float  # metres

    def rgb(self, fade: float = 0.0) -> np.ndarray:
        """(H, W, 3) uint8 RGB; white where neither sweep has a point."""
        image = np.full((*self.t.shape, 3), 255, np.uint8)
        for is_set, color in zip((self.t & ~self.t1, self.t1 & ~self.t, self.t & self.t1), COLORS.values()):
            image[is_set] = 255 * fade + (1 - fade) * np.array(color)
        return image

    def draw(self, axes: Axes, fade: float = 0.0, **settings: Any) -> None:
        """Draw the pixels at their positions in metres; `fade`, 0 ... 1, is how far the colours go towards white."""
        (height, width), (x, y) = self.t.shape, self.lower
        extent = (x, x + width * self.pixel_size, y, y + height * self.pixel_size)
        axes.imshow(self.rgb(fade), extent=extent, origin="lower", interpolation="nearest", **settings)


@dataclass(frozen=True)
class Scale:
    """One scale of a coarse-to-fine run."""

    sweeps: ProjectedSweeps  # the input of this scale: a batch of one window, warped by the flow of the coarser scales
    flow: np.ndarray  # (N, 3) float64, residual flow of the rows of pc0 after this scale, metres per sweep interval

    def seen(self) -> Occupancy:
        """The input of this scale: sweep t is moved by the flow of the coarser scales."""
        return _pair(self.sweeps)

    def result(self) -> Occupancy:
        """The result of this scale: sweep t is moved by `flow`."""
        batch = self.sweeps.batch
        flow = torch.zeros_like(batch.positions)
        flow[:, batch.rows[0]] = torch.from_numpy(self.flow).T[: len(flow)]
        return _pair(project(batch, flow, self.sweeps.grid))


@dataclass(frozen=True)
class ClusterCorrelation:
    """Normalised cross-correlation of one cluster between t and t+1, at the finest scale (Eq. norm_correlation)."""

    cluster_id: int  # as in `FlowResult`
    images: Occupancy  # template (t) and target (t+1): the pixels of the cluster in its box
    ncc: np.ndarray  # (H, W) float64, 0 ... 1, shift (dy, dx) at [dy + H // 2, dx + W // 2]; NaN = not searched
    shift: np.ndarray  # (2,) int64, (dy, dx) that the method chooses, pixels
    score: float  # NCC at that shift
    # (3,) float64, residual flow of the cluster, metres per sweep interval: the shift times the pixel size, combined
    # with the estimates from coarser scales and older sweeps.
    flow: np.ndarray


@dataclass(frozen=True)
class KeyPointMatches:
    """Key points of sweep t and the matches that the ratio test accepts, at the finest scale."""

    images: Occupancy  # occupancy of both sweeps
    key_points: np.ndarray  # (K, 2) float64, (x, y), metres, frame of t+1: the middle of the pixel of each key point
    start: np.ndarray  # (M, 2) float64, (x, y), metres, frame of t+1: key point of t of each match
    end: np.ndarray  # (M, 2) float64, (x, y), metres, frame of t+1: key point of t+1 of each match


def scales(window: Window, config: Config) -> tuple[list[Scale], FlowResult]:
    """Run a method of the paper on the CPU and return every scale, coarse to fine, and the result."""
    if config.method == "verified":
        raise _not_drawable(config, "scales one after the other", "paper")
    model: Any = make_model(config, "cpu")
    motion_at_scale = model.motion_at_scale
    seen: list[ProjectedSweeps] = []

    def record(sweeps: ProjectedSweeps) -> Any:
        flow = None if sweeps.flow is None else sweeps.flow.clone()  # the run adds to it in place
        seen.append(replace(sweeps, flow=flow))
        return motion_at_scale(sweeps)

    model.motion_at_scale = record
    (result,) = model([window])
    points = seen[0].batch.rows[0]
    so_far = [sweeps.flow for sweeps in seen if sweeps.flow is not None]
    flows = [F.pad(flow[:, points].T, (0, 3 - len(flow))) for flow in so_far] + [result.residual_flow.double()]
    return [Scale(sweeps, flow.numpy()) for sweeps, flow in zip(seen, flows)], result


@torch.inference_mode()
def cluster_correlation(window: Window, config: Config, cluster_id: int | None = None) -> ClusterCorrelation:
    """Run the dense method and return the correlation of one cluster, by default the one of `choose_cluster`."""
    if not isinstance(config, DenseConfig) or config.clustering != "components":
        raise _not_drawable(config, "correlation map per cluster", "paper")
    (*_, last), result = scales(window, config)
    of_point = result.cluster_id.numpy()
    cluster_id = choose_cluster(of_point, last.flow, cluster_id)
    if cluster_id is None:
        raise CFlowError("no cluster has points in both sweeps: there is no correlation to draw")
    sweeps = last.sweeps
    clusters, _, _ = find_clusters(sweeps, config)
    pairs = make_pairs(clusters, sweeps.batch, sweeps.grid.pixel_size, config.max_speed)
    shifts, scores = best_shifts(pairs, config.correlation, config.max_memory)
    pair = int(flat_nonzero((pairs.source == 0) & (pairs.cluster == cluster_id)))
    template = _image(pairs.template, pair, pairs.size[cluster_id])
    target = _image(pairs.target, cluster_id, pairs.size[cluster_id])
    first = clusters.first[cluster_id].flip(0).numpy()
    return ClusterCorrelation(
        cluster_id=cluster_id,
        images=Occupancy(
            t=template.numpy() > 0,
            t1=target.numpy() > 0,
            lower=np.array(sweeps.grid.lower[:2]) + sweeps.grid.pixel_size * first,
            pixel_size=sweeps.grid.pixel_size,
        ),
        ncc=_ncc_map(template, target, None if pairs.radius is None else pairs.radius[pair]).numpy(),
        shift=shifts[pair].numpy(),
        score=float(scores[pair]),
        flow=group_medians(np.where(of_point == cluster_id, 0, -1), last.flow)[1][0],
    )


def choose_cluster(of_point: np.ndarray, flow: np.ndarray, cluster_id: int | None = None) -> int | None:
    """Return the given cluster, else the one where points times length of median flow is largest; None = no cluster.

    `of_point` is the cluster of each point, (N,), -1 = none, and `flow` the residual flow of the points, (N, 3).
    """
    numbers, median, count = group_medians(of_point, flow)
    if cluster_id is None:
        return int(numbers[(np.linalg.norm(median, axis=1) * count).argmax()]) if len(numbers) else None
    if cluster_id not in numbers:
        last = f"the last is {numbers[-1]}" if len(numbers) else "there is none"
        raise CFlowError(
            f"cluster={cluster_id} is not a cluster that is in both sweeps: {last}; picture=clusters shows all"
        )
    return cluster_id


@torch.inference_mode()
def keypoint_matches(window: Window, config: Config) -> KeyPointMatches:
    """Run the key-point method and return its key points and matches."""
    if not isinstance(config, KeypointsConfig):
        raise _not_drawable(config, "key points", "keypoints")
    (*_, last), _ = scales(window, config)
    sweeps = last.sweeps
    pixel_size = sweeps.grid.pixel_size
    pc1, pc0 = (describe_keypoints(sweeps.occupancy[:, step], config.patch_size) for step in (0, 1))
    matches = match_keypoints(pc0, pc1, match_radius(sweeps.batch, pixel_size, config), config)
    images = last.seen()
    key_points = images.lower + (torch.stack((pc0.col, pc0.row), 1).numpy() + 0.5) * pixel_size
    start = key_points[matches.source.numpy()]
    return KeyPointMatches(images, key_points, start, start + matches.shift.flip(1).numpy() * pixel_size)


def _not_drawable(config: Config, what: str, preset: str) -> CFlowError:
    return CFlowError(f'method={config.method} has no {what}: give make_config("{preset}"), or model={preset}')


def _pair(sweeps: ProjectedSweeps) -> Occupancy:
    t1, t = sweeps.occupancy[0, :2].numpy()
    return Occupancy(t, t1, np.array(sweeps.grid.lower[:2]), sweeps.grid.pixel_size)


def _image(images: Images, number: int, size: Tensor) -> Tensor:
    """Return image `number`, (H, W) float32."""
    pixel = flat_nonzero(images.image == number)
    image = torch.zeros(size.tolist())
    image[images.row[pixel], images.col[pixel]] = 1
    return image


def _ncc_map(template: Tensor, target: Tensor, radius: Tensor | None) -> Tensor:
    """(H, W) float64, as `ClusterCorrelation.ncc`. The energy of the target is its correlation with ones.

    `radius` is the longest shift that is searched, pixels; None = no limit.
    """
    height, width = template.shape
    images = torch.zeros(3, 2 * height, 2 * width, dtype=torch.bool)
    images[:, :height, :width] = torch.stack((template, torch.ones_like(template), target))
    counts = cross_correlate(images, 2, torch.zeros(2, dtype=torch.int64)).round().double()
    dy, dx = (torch.arange(size) - size // 2 for size in (height, width))
    # The correlation wraps around, and half of each image is empty, so negative shifts are at the far end.
    overlap, in_window = counts[:, dy[:, None] % (2 * height), dx % (2 * width)]
    energies = in_window * template.double().sum()
    ncc = torch.where(energies > 0, overlap / energies.clamp(min=1).sqrt(), torch.zeros_like(overlap))
    if radius is not None:
        ncc[dy[:, None] ** 2 + dx**2 > radius**2] = torch.nan
    return ncc


def sweep_marks() -> list[Any]:
    """Return legend entries for the colours of the pixels."""
    from matplotlib.lines import Line2D

    colors = {name: "#{:02x}{:02x}{:02x}".format(*color) for name, color in COLORS.items()}
    return [Line2D([], [], marker="s", ls="", markersize=10, label=name, color=color) for name, color in colors.items()]
