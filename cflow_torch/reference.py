"""The paper in plain NumPy loops: the oracle of the tests and the comparator of the benchmark.

Every function carries the label of the equation, algorithm or section of the paper that it writes down. Nothing
here is fast, batched or shared with the fast path; where the paper leaves something open (ties, borders, medians
of an even number), the docstring says what is done. All numbers are integers or float64, and every float
operation is elementwise in the written order, so that another implementation can reproduce each bit.

Order of reading: reference_flow -> coarse_to_fine -> general_correlation_flow (Alg. general_correlation_flow) ->
cluster (Alg. clustering) and scene_flow_1obj (Alg. scene_flow_1obj) -> scene_flow_in_1view (Alg. scene_flow_1view)
-> pool (Sec. leverage_past_pcs).
"""

from __future__ import annotations

import math
from collections import deque
from typing import Any, Dict, List, NamedTuple, Optional, Sequence, Tuple

import numpy as np
import torch

from cflow_torch.config import Config
from cflow_torch.types import CFlowError, FlowResult, Sweep, Window

# Rows and columns that an image covers: (first row, first column, height, width).
Box = Tuple[int, int, int, int]


class Cloud(NamedTuple):
    """One sweep after ego motion compensation.

    Attributes:
        points: (N, 3) float64, metres, frame of t+1; NaN for a point that was not finite.
        takes_part: (N,) bool, finite and not ground.
        steps: k, elapsed time to t+1 in sweep intervals: 1 for t, 2 for t-1 ...; 0 for t+1 itself.
        elapsed: seconds to t+1.
    """

    points: np.ndarray
    takes_part: np.ndarray
    steps: float
    elapsed: float


class Level(NamedTuple):
    """What one scale finds, one array per sweep m <= t, nearest first; rows in the order of the sweep's points.

    Attributes:
        flow: each (N, 3) float64, metres per sweep interval; 0 for points in no cluster.
        cluster_id: each (N,) int64, -1 for points in no cluster.
        score: each (N,) float64, NCC at the peak of the newest sweep; 0 for points in no cluster.
    """

    flow: List[np.ndarray]
    cluster_id: List[np.ndarray]
    score: List[np.ndarray]


# ---------------------------------------------------------------------------------------------- the whole method


def reference_flow(window: Window, config: Config) -> FlowResult:
    """Flow of every point of `window.pc0`, the dense method with history, scales and sectional view.

    Args:
        window: sweeps t-h ... t+1, taken as valid.
        config: settings; the fields `labeling`, `correlation`, `max_memory` choose engines and mean nothing here.

    Returns:
        `FlowResult` of CPU tensors, rows in the order of pc0.

    Raises:
        CFlowError: `method="keypoints"`, which the reference does not have yet.

    Cost: about one addition per (pixel of a cluster) x (pixel of its bounding box).

    Source: Alg. general_correlation_flow with Sec. leverage_past_pcs and the multi-scale strategy.
    """
    if config.method != "dense":
        raise CFlowError(f"method={config.method!r}: the reference does not have it yet, give method='dense'")
    clouds, cloud1 = compensate(window, config)
    residual_flow, cluster_id, score = coarse_to_fine(clouds, cloud1, config)
    # float32(p' - p); points that are not finite are NaN in p' and get 0
    pose_flow = np.nan_to_num(clouds[0].points - _points(window.pc0), nan=0.0).astype(np.float32)
    residual_flow = residual_flow.astype(np.float32)
    return FlowResult(
        residual_flow=torch.from_numpy(residual_flow),
        pose_flow=torch.from_numpy(pose_flow),
        flow=torch.from_numpy(pose_flow + residual_flow),
        cluster_id=torch.from_numpy(cluster_id),
        score=torch.from_numpy(score.astype(np.float32)),
        is_valid=torch.from_numpy(clouds[0].takes_part & in_range(clouds[0].points, config)),
    )


def coarse_to_fine(clouds: Sequence[Cloud], cloud1: Cloud, config: Config) -> Tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Multi-scale strategy: estimate, translate the clouds by the flow so far, repeat with finer pixels.

    Args:
        clouds: sweeps m = t, t-1, ... nearest first.
        cloud1: sweep t+1.
        config: settings.

    Returns:
        For the points of sweep t: residual flow (N, 3) float64, the sum over the scales; cluster_id (N,) int64 and
        score (N,) float64 of the finest scale.

    Convention:
        Every sweep m <= t is warped, by k times its flow so far (k = steps to t+1); t+1 never is. A point that
        leaves the range by being warped gets nothing from that scale.
    """
    flows = [np.zeros(cloud.points.shape) for cloud in clouds]
    for pixel_size in config.pixel_sizes:
        warped = [cloud._replace(points=cloud.points + cloud.steps * flow) for cloud, flow in zip(clouds, flows)]
        level = general_correlation_flow(warped, cloud1, pixel_size, config)
        flows = [flow + increment for flow, increment in zip(flows, level.flow)]
    return flows[0], level.cluster_id[0], level.score[0]


def general_correlation_flow(clouds: Sequence[Cloud], cloud1: Cloud, pixel_size: float, config: Config) -> Level:
    """Alg. general_correlation_flow: cluster, find the motion of each cluster, assign it to the cluster's points.

    Args:
        clouds: sweeps m = t, t-1, ... nearest first.
        cloud1: sweep t+1.
        pixel_size: s in metres.
        config: settings.

    Returns:
        Flow, cluster and score of every point of every sweep m <= t.
    """
    # Partition the aggregation of all sweeps into clusters.
    sweeps = [cloud1, *clouds]
    height, width = bev_dims(config, pixel_size)
    inside = [cloud.takes_part & in_range(cloud.points, config) for cloud in sweeps]
    pixels = [project_bev(cloud.points[keep], config, pixel_size) for cloud, keep in zip(sweeps, inside)]
    if config.clustering == "hdbscan":
        members = cluster_hdbscan([cloud.points[keep] for cloud, keep in zip(sweeps, inside)], pixels, config)
    else:
        images = [occupancy(pixel, (0, 0, height, width)) for pixel in pixels]
        clusters = cluster(images, pixel_size, config.max_extent, config.connectivity)
        members = [clusters[pixel[:, 0], pixel[:, 1]] for pixel in pixels]
    cluster_ids = []
    for cloud, keep, member in zip(sweeps, inside, members):
        ids = np.full(len(cloud.points), -1, dtype=np.int64)
        ids[keep] = member
        cluster_ids.append(ids)

    flows = [np.zeros(cloud.points.shape) for cloud in clouds]
    scores = [np.zeros(len(cloud.points)) for cloud in clouds]
    for i in range(max(int(ids.max(initial=-1)) for ids in cluster_ids) + 1):
        # The cluster's scene flow: one estimate per sweep that has points of it, nearest first.
        members = [ids == i for ids in cluster_ids]
        points = [cloud.points[member] for cloud, member in zip(sweeps, members)]
        box = bounding_box([project_bev(p, config, pixel_size) for p in points])
        estimates, peaks = [], []
        for cloud, points_m in zip(clouds, points[1:]):
            if len(points_m) == 0:
                continue
            reach = search_radius(config, cloud.elapsed, pixel_size)
            flow, peak = scene_flow_1obj(points_m, points[0], box, reach, pixel_size, config)
            estimates.append(flow / cloud.steps)
            peaks.append(peak)
        cluster_flow = pool(estimates)
        # Assign it to the cluster's points.
        for m, member in enumerate(members[1:]):
            flows[m][member] = cluster_flow
            scores[m][member] = peaks[0]
    return Level(flows, cluster_ids[1:], scores)


# ------------------------------------------------------------------------------------------------------ input


def compensate(window: Window, config: Config) -> Tuple[List[Cloud], Cloud]:
    """Eq. def_scene_flow: every sweep in the frame of t+1, by inv(pose1) @ pose.

    Returns:
        Sweeps m = t, t-1, ..., nearest first, at most `config.num_history` before t; and sweep t+1.

    Convention:
        A sweep that repeats a newer one (same points, same pose) is dropped; k of the others still counts places
        in the window. Without poses the points already lie in the frame of t+1. Elapsed times are those of the
        time stamps if all sweeps have one, else steps times `sweep_interval`.
    """
    sweeps = [window.pc0, *window.pch[: config.num_history]]
    has_stamps = all(sweep.timestamp_ns is not None for sweep in [window.pc1, *sweeps])
    clouds: List[Cloud] = []
    for m, sweep in enumerate(sweeps):
        if any(_is_repeat(sweep, newer) for newer in sweeps[:m]):
            continue
        steps, elapsed = float(m + 1), (m + 1) * config.sweep_interval
        if has_stamps:
            elapsed_ns = int(window.pc1.timestamp_ns) - int(sweep.timestamp_ns)  # type: ignore[arg-type]
            first_ns = int(window.pc1.timestamp_ns) - int(window.pc0.timestamp_ns)  # type: ignore[arg-type]
            elapsed = elapsed_ns / 1e9
            if config.use_timestamps:
                steps = elapsed_ns / first_ns
        clouds.append(Cloud(_in_frame_of(window.pc1, sweep), _takes_part(sweep), steps, elapsed))
    return clouds, Cloud(_points(window.pc1), _takes_part(window.pc1), 0.0, 0.0)


def _in_frame_of(sweep1: Sweep, sweep: Sweep) -> np.ndarray:
    points = _points(sweep)
    finite = np.isfinite(points).all(axis=1)
    moved = np.full(points.shape, np.nan)
    if sweep.pose is None:
        moved[finite] = points[finite]
        return moved
    matrix = np.linalg.inv(_matrix(sweep1.pose)) @ _matrix(sweep.pose)  # T_ego1_ego
    x, y, z = points[finite].T
    for axis in range(3):
        rotation, translation = matrix[axis, :3], matrix[axis, 3]
        moved[finite, axis] = ((rotation[0] * x + rotation[1] * y) + rotation[2] * z) + translation
    return moved


def _is_repeat(sweep: Sweep, newer: Sweep) -> bool:
    if (sweep.pose is None) != (newer.pose is None):
        return False
    same_pose = sweep.pose is None or np.array_equal(_matrix(sweep.pose), _matrix(newer.pose))
    return same_pose and np.array_equal(_matrix(sweep.points), _matrix(newer.points), equal_nan=True)


def _takes_part(sweep: Sweep) -> np.ndarray:
    finite = np.isfinite(_points(sweep)).all(axis=1)
    if sweep.is_ground is None:
        return finite
    return finite & ~_matrix(sweep.is_ground).astype(bool)


def _points(sweep: Sweep) -> np.ndarray:
    return _matrix(sweep.points)[:, :3]


def _matrix(values: Any) -> np.ndarray:
    """The door: a float64 array from an array or a tensor on any device."""
    if isinstance(values, torch.Tensor):
        values = values.detach().cpu().double().numpy()
    return np.array(values, dtype=np.float64)


# ------------------------------------------------------------------------------------------- points and pixels


def in_range(points: np.ndarray, config: Config) -> np.ndarray:
    """(N,) bool: which points (N, 3) lie in `point_cloud_range`, both ends included. NaN does not."""
    low, high = np.array(config.point_cloud_range[:3]), np.array(config.point_cloud_range[3:])
    return np.all((points >= low) & (points <= high), axis=1)


def project_bev(points: np.ndarray, config: Config, pixel_size: float) -> np.ndarray:
    """Eq. 3d_to_bev: u = floor((p - p_minus) / s). (N, 3) metres -> (N, 2) int64, row from y, column from x."""
    x0, y0 = config.point_cloud_range[:2]
    column = np.floor((points[:, 0] - x0) / pixel_size)
    row = np.floor((points[:, 1] - y0) / pixel_size)
    return np.stack([row, column], axis=1).astype(np.int64)


def bev_dims(config: Config, pixel_size: float) -> Tuple[int, int]:
    """Eq. bev_dims: (H, W) of the BEV image, with the + 1."""
    x0, y0, _, x1, y1, _ = config.point_cloud_range
    return math.floor((y1 - y0) / pixel_size) + 1, math.floor((x1 - x0) / pixel_size) + 1


def bounding_box(pixels: Sequence[np.ndarray]) -> Box:
    """The smallest box that holds all pixels of the given (N, 2) lists; at least one pixel must be there."""
    every = np.concatenate(list(pixels))
    (row, column), (last_row, last_column) = every.min(axis=0), every.max(axis=0)
    return int(row), int(column), int(last_row - row + 1), int(last_column - column + 1)


def occupancy(pixels: np.ndarray, box: Box) -> np.ndarray:
    """Binary image of the box: True where at least one of the pixels (N, 2) lies (text below Eq. bev_dims)."""
    row, column, height, width = box
    image = np.zeros((height, width), dtype=bool)
    for r, c in pixels.tolist():
        image[r - row, c - column] = True
    return image


# ------------------------------------------------------------------------------------------- Sec. clustering


def dilate(image: np.ndarray) -> np.ndarray:
    """Dilation with a 3 x 3 square of ones, clipped at the border: every foreground pixel paints its square."""
    result = np.zeros_like(image)
    for r, c in np.argwhere(image).tolist():
        result[max(r - 1, 0) : r + 2, max(c - 1, 0) : c + 2] = True
    return result


def erode(image: np.ndarray) -> np.ndarray:
    """Erosion with a 3 x 3 square of ones: a pixel stays if its whole square is foreground.

    Convention: pixels outside the image are ignored; the border itself does not erode.
    """
    result = np.zeros_like(image)
    for r, c in np.argwhere(image).tolist():
        result[r, c] = image[max(r - 1, 0) : r + 2, max(c - 1, 0) : c + 2].all()
    return result


def connected_components(image: np.ndarray, connectivity: int) -> Tuple[np.ndarray, int]:
    """Breadth-first labelling of a binary image.

    Args:
        image: (H, W) bool.
        connectivity: 4 (orthogonal neighbours) or 8 (diagonal ones too).

    Returns:
        (H, W) int64 labels, 0 = background, 1 ... n in raster order of each component's first pixel; and n.
    """
    steps = [(-1, 0), (0, -1), (0, 1), (1, 0)]
    if connectivity == 8:
        steps += [(-1, -1), (-1, 1), (1, -1), (1, 1)]
    height, width = image.shape
    labels = np.zeros(image.shape, dtype=np.int64)
    count = 0
    for seed in np.argwhere(image).tolist():
        if labels[seed[0], seed[1]]:
            continue
        count += 1
        labels[seed[0], seed[1]] = count
        queue = deque([seed])
        while queue:
            r, c = queue.popleft()
            for dr, dc in steps:
                i, j = r + dr, c + dc
                if 0 <= i < height and 0 <= j < width and image[i, j] and not labels[i, j]:
                    labels[i, j] = count
                    queue.append([i, j])
    return labels, count


def cluster(images: Sequence[np.ndarray], pixel_size: float, max_extent: float, connectivity: int) -> np.ndarray:
    """Alg. clustering: spatio-temporal clusters as connected components of the aggregated image.

    Args:
        images: occupancy (H, W) bool of sweep t+1, then of sweeps t, t-1, ...
        pixel_size: s in metres.
        max_extent: d^max in metres.
        connectivity: 4 or 8.

    Returns:
        (H, W) int64: cluster of every pixel that some sweep occupies, -1 elsewhere and in clusters without a pixel
        at t+1 or without a pixel before it. Numbered 0 ... M-1 in raster order of the first occupied pixel.

    Convention: a component is measured dilated, as the longer side of its box in pixels times s; exactly d^max is
        not too large. An oversized component is eroded and labelled again once, whatever size results.
    """
    aggregated = np.logical_or.reduce(images)
    labels, count = connected_components(dilate(aggregated), connectivity)

    # Validation of the connected components.
    total = count
    for component, box in _boxes(labels).items():
        if max(box[2], box[3]) * pixel_size > max_extent:
            eroded = erode(labels == component)
            labels[labels == component] = 0
            parts, count = connected_components(eroded, connectivity)
            labels[eroded] = parts[eroded] + total
            total += count

    # Number the components that can move: a pixel at t+1 and a pixel before.
    at_t1 = set(labels[images[0]].tolist())
    before = {label for image in images[1:] for label in labels[image].tolist()}
    numbers: Dict[int, int] = {}
    result = np.full(labels.shape, -1, dtype=np.int64)
    for r, c in np.argwhere(aggregated).tolist():
        label = int(labels[r, c])
        if label in at_t1 and label in before:
            result[r, c] = numbers.setdefault(label, len(numbers))
    return result


def cluster_hdbscan(points: Sequence[np.ndarray], pixels: Sequence[np.ndarray], config: Config) -> List[np.ndarray]:
    """HDBSCAN of the aggregated points in place of Alg. clustering (Table which_clustering_method).

    Args:
        points: (N, 3) float64 of sweep t+1, then of sweeps t, t-1, ...
        pixels: (N, 2) their BEV pixels (row, column).
        config: `min_cluster_size`.

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


def _boxes(labels: np.ndarray) -> Dict[int, Box]:
    """Bounding box of every component of a label image."""
    pixels: Dict[int, List[List[int]]] = {}
    for r, c in np.argwhere(labels).tolist():
        pixels.setdefault(int(labels[r, c]), []).append([r, c])
    return {label: bounding_box([np.array(members)]) for label, members in pixels.items()}


# --------------------------------------------------------------------------------- scene flow of one object


def scene_flow_1obj(
    points_m: np.ndarray,
    points_1: np.ndarray,
    box: Box,
    reach: Optional[float],
    pixel_size: float,
    config: Config,
) -> Tuple[np.ndarray, float]:
    """Alg. scene_flow_1obj: motion of one object from sweep m to sweep t+1.

    Args:
        points_m: (N, 3) float64, the object at m, frame of t+1.
        points_1: (K, 3) float64, the object at t+1.
        box: BEV pixels of the object in all sweeps.
        reach: longest displacement searched in the BEV, pixels; None = no limit.
        pixel_size: s in metres.
        config: settings (`sectional_view`, `point_cloud_range`).

    Returns:
        f_{m -> t+1} (3,) float64 in metres (z = 0 without the sectional view), and the NCC score of the BEV.

    Convention:
        The heading is (f_x, f_y) / norm, which are cos and sin of theta without trigonometry; (1, 0) for an object
        that stands still. The pixels of the sectional view start at the origin of the frame of t+1, its image is
        the box of both sweeps, its row comes from z.
    """
    template = occupancy(project_bev(points_m, config, pixel_size), box)
    target = occupancy(project_bev(points_1, config, pixel_size), box)
    (f_x, f_y), score = scene_flow_in_1view(template, target, pixel_size, reach)
    if not config.sectional_view:
        return np.array([f_x, f_y, 0.0]), score

    norm = math.sqrt(f_x * f_x + f_y * f_y)
    cos, sin = (f_x / norm, f_y / norm) if norm > 0 else (1.0, 0.0)
    translated = points_m + np.array([f_x, f_y, 0.0])
    sections = []
    for points in (translated, points_1):
        x_along = cos * points[:, 0] + sin * points[:, 1]
        row, column = np.floor(points[:, 2] / pixel_size), np.floor(x_along / pixel_size)
        sections.append(np.stack([row, column], axis=1).astype(np.int64))
    section_box = bounding_box(sections)
    template, target = (occupancy(section, section_box) for section in sections)
    (f_along, f_z), _ = scene_flow_in_1view(template, target, pixel_size)
    return np.array([f_x + f_along * cos, f_y + f_along * sin, f_z]), score


def scene_flow_in_1view(
    template: np.ndarray, target: np.ndarray, pixel_size: float, reach: Optional[float] = None
) -> Tuple[Tuple[float, float], float]:
    """Alg. scene_flow_1view: the displacement with the highest NCC score, Eq. displacement_in_bev.

    Args:
        template: (H, W) bool, image of sweep m, at least one pixel.
        target: (H, W) bool, image of sweep t+1 of the same box.
        pixel_size: s in metres.
        reach: longest displacement searched, pixels; None = no limit.

    Returns:
        (column displacement, row displacement) in metres, and the NCC score there.

    Convention:
        Scores are compared as c^2 / E_w, the square of Eq. norm_correlation without its constant factor. Ties:
        smallest norm, then smallest row displacement, then smallest column displacement.
    """
    overlap, window_energy = overlap_and_energy(template, target)
    height, width = template.shape
    rank = np.zeros((height, width))
    np.divide(overlap * overlap, window_energy, out=rank, where=window_energy > 0)
    candidates = []
    for u_y, u_x in np.ndindex(height, width):
        dy, dx = u_y - height // 2, u_x - width // 2
        if reach is None or dx * dx + dy * dy <= reach * reach:
            candidates.append((-rank[u_y, u_x], dx * dx + dy * dy, dy, dx))
    _, _, dy, dx = min(candidates)
    scores = norm_correlation(overlap, int(template.sum()), window_energy)
    return (dx * pixel_size, dy * pixel_size), float(scores[dy + height // 2, dx + width // 2])


def search_radius(config: Config, elapsed: float, pixel_size: float) -> Optional[float]:
    """Longest displacement in pixels: max_speed * elapsed / s + one pixel; None = the paper's, half of the box."""
    if config.max_speed is None:
        return None
    return config.max_speed * elapsed / pixel_size + 1


def ncc_map(template: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Eq. norm_correlation: R[u_y, u_x] for every pixel u, (H, W) float64 in [0, 1], 0 for an empty neighbourhood."""
    overlap, window_energy = overlap_and_energy(template, target)
    return norm_correlation(overlap, int(template.sum()), window_energy)


def norm_correlation(overlap: np.ndarray, template_energy: int, window_energy: np.ndarray) -> np.ndarray:
    """Eq. norm_correlation from its three counts: c / sqrt(E_m E_w), 0 where a count is 0."""
    energy = template_energy * window_energy
    scores = np.zeros(energy.shape)
    np.divide(overlap, np.sqrt(energy), out=scores, where=energy > 0)
    return scores


def overlap_and_energy(template: np.ndarray, target: np.ndarray) -> Tuple[np.ndarray, np.ndarray]:
    """Numerator and right-hand energy of Eq. norm_correlation; both are counts, the images being binary.

    Args:
        template: (H, W) bool, I_m.
        target: (H, W) bool, I_{t+1}; pixels outside it are 0.

    Returns:
        Two (H, W) int64 maps over u: the number of template pixels that fall on a target pixel when the template's
        corner lies at u - floor(size / 2), and the number of target pixels in that H x W neighbourhood.
    """
    height, width = template.shape
    half_h, half_w = height // 2, width // 2
    counts = target.astype(np.int32)
    overlap = np.zeros((height, width), dtype=np.int32)
    for r, c in np.argwhere(template).tolist():
        # Template pixel (r, c) lies at (u_y - half_h + r, u_x - half_w + c): the target moved by (half - pixel).
        down, right = half_h - r, half_w - c
        overlap[max(down, 0) : height + down, max(right, 0) : width + right] += counts[
            max(-down, 0) : height - down, max(-right, 0) : width - right
        ]
    energy = np.zeros((height, width), dtype=np.int32)
    for i, j in np.argwhere(target).tolist():
        # Target pixel (i, j) is in the neighbourhood of u if u - half <= pixel < u - half + size.
        bottom, right = i + half_h, j + half_w
        energy[max(bottom - height + 1, 0) : bottom + 1, max(right - width + 1, 0) : right + 1] += 1
    return overlap.astype(np.int64), energy.astype(np.int64)


# ------------------------------------------------------------------------------- Sec. leverage_past_pcs


def pool(estimates: Sequence[np.ndarray]) -> np.ndarray:
    """Sec. leverage_past_pcs: median of the magnitudes and of the orientations, separately.

    Args:
        estimates: each (3,) float64, an estimate of f_{t -> t+1}, nearest sweep first; at least one.

    Returns:
        (3,) float64; z is the median of the z components.

    Convention:
        One estimate is returned as it is. Even number: the mean of the middle two. Estimates of length 0 count
        among the magnitudes, but have no orientation; if none has one the result is (0, 0). The median orientation
        is taken about the circular mean; opposite estimates that cancel it are ordered about the nearest one.
    """
    if len(estimates) == 1:
        return np.array(estimates[0], dtype=np.float64)
    magnitudes, directions = [], []
    for f_x, f_y, _ in (estimate.tolist() for estimate in estimates):
        magnitude = math.sqrt(f_x * f_x + f_y * f_y)
        magnitudes.append(magnitude)
        if magnitude > 0:
            directions.append((f_x / magnitude, f_y / magnitude))
    magnitude = median(magnitudes)
    u_x, u_y = median_direction(directions) if directions else (0.0, 0.0)
    return np.array([magnitude * u_x, magnitude * u_y, median([float(estimate[2]) for estimate in estimates])])


def median(values: Sequence[float]) -> float:
    """Median; of an even number the mean of the middle two."""
    ordered = sorted(values)
    middle = len(ordered) // 2
    if len(ordered) % 2 == 1:
        return ordered[middle]
    return (ordered[middle - 1] + ordered[middle]) / 2


def median_direction(directions: Sequence[Tuple[float, float]]) -> Tuple[float, float]:
    """Angular median of unit vectors about their circular mean; of an even number the bisector of the middle two.

    Convention: equal angles keep the given order; middle two that are exactly opposite give the first of them.
    """
    mean_x, mean_y = 0.0, 0.0
    for u_x, u_y in directions:
        mean_x, mean_y = mean_x + u_x, mean_y + u_y
    if mean_x == 0 and mean_y == 0:
        mean_x, mean_y = directions[0]
    ordered = sorted(directions, key=lambda u: diamond_angle(mean_x, mean_y, u[0], u[1]))
    middle = len(ordered) // 2
    if len(ordered) % 2 == 1:
        return ordered[middle]
    first, second = ordered[middle - 1], ordered[middle]
    w_x, w_y = first[0] + second[0], first[1] + second[1]
    norm = math.sqrt(w_x * w_x + w_y * w_y)
    return (w_x / norm, w_y / norm) if norm > 0 else first


def diamond_angle(mean_x: float, mean_y: float, u_x: float, u_y: float) -> float:
    """Angle of u from the mean, counter-clockwise, in (-2, 2] instead of (-pi, pi]: monotone, no trigonometry."""
    along = mean_x * u_x + mean_y * u_y
    across = mean_x * u_y - mean_y * u_x
    size = abs(along) + abs(across)
    if size == 0:  # only if the mean underflows
        return 0.0
    if along >= 0:
        return across / size
    return 2 - across / size if across >= 0 else -2 - across / size
