"""The dense method with OpenCV and NumPy and a loop over clusters, as you might write it by hand.

The benchmark compares this loop with `CorrelationFlow`. It does the same work, with history and scales but without
sectional view and `max_speed`. It is written to be fast: points in column-major order, one label image, pixels sorted
by label once, crops in float32. Results differ by rounding: `cv2.matchTemplate` computes float32 scores, which decide
ties of the argmax in another way.
"""

from __future__ import annotations

from typing import NamedTuple, Sequence

import cv2
import numpy as np
import torch

from cflow_torch import Config
from cflow_torch.types import FlowResult, Sweep, Window, as_numpy

_SQUARE = np.ones((3, 3), np.uint8)
# Smallest score that is an overlap. One common pixel scores 1 / sqrt(E_m E_w), above 1e-4 up to 10,000 pixels each;
# float32 noise of the Fourier transform stays below it.
_SMALLEST_SCORE = 1e-5


class Cloud(NamedTuple):
    """Active points of one sweep."""

    xy: np.ndarray  # (2, N) float64, metres, frame of t+1
    steps: float  # k, sweep intervals to t+1
    rows: np.ndarray  # (N,) int64, rows of these points in the sweep


def opencv_flow(window: Window, config: Config) -> FlowResult:
    """Estimate the flow of every point of `window.pc0`.

    All points must be finite, the sweeps t-h ... t+1 must have equal intervals, and the method must be dense with
    connected components. Other settings that the loop does not have are ignored.

    Cost: one `cv2.matchTemplate` per cluster, sweep and scale.
    """
    points0, moved0 = _compensate(window.pc0, window.pc1)
    clouds = [_cloud(window.pc0, moved0, 1.0, config)]
    for m, sweep in enumerate(window.pch[: config.num_history], 2):
        clouds.append(_cloud(sweep, _compensate(sweep, window.pc1)[1], float(m), config))
    cloud1 = _cloud(window.pc1, _columns(window.pc1), 0.0, config)
    flows: list[np.ndarray] = []
    for pixel_size in config.pixel_sizes:
        warped = [cloud._replace(xy=cloud.xy + cloud.steps * flow) for cloud, flow in zip(clouds, flows)] or clouds
        found, number, score = motion_at_scale(warped, cloud1, pixel_size, config)
        flows = [flow + step for flow, step in zip(flows, found)] or found

    rows, num_points = clouds[0].rows, moved0.shape[1]
    residual_flow = np.zeros((num_points, 3), np.float32)
    residual_flow[rows, :2] = flows[0].T
    pose_flow = np.empty((num_points, 3), np.float32)
    np.subtract(moved0.T, points0.T, out=pose_flow, casting="same_kind")
    cluster_id = np.full(num_points, -1, np.int64)
    cluster_id[rows] = number
    scores = np.zeros(num_points, np.float32)
    scores[rows] = score
    is_valid = np.zeros(num_points, bool)
    is_valid[rows] = True
    fields = (residual_flow, pose_flow, pose_flow + residual_flow, cluster_id, scores, is_valid)
    return FlowResult(*map(torch.from_numpy, fields))


def motion_at_scale(
    clouds: Sequence[Cloud], cloud1: Cloud, pixel_size: float, config: Config
) -> tuple[list[np.ndarray], np.ndarray, np.ndarray]:
    """One scale: project, cluster, correlate, pool. `clouds` are the sweeps t, t-1, ..., moved by the flow so far.

    Returns the flow of each of them, (2, N) float64 metres per sweep interval; the cluster, (N,) int32, -1 = none, and
    the score, (N,) float32, of the points of sweep t.
    """
    images, pixels = zip(*(project(cloud.xy, pixel_size, config) for cloud in (cloud1, *clouds)))
    of_pixel, boxes = find_clusters(images, pixel_size, config)
    estimates, scores, seen = _correlate(of_pixel, boxes, images, pixel_size)
    motion = np.zeros((2, len(scores) + 1))  # the last column is for points without cluster, number -1
    motion[:, :-1] = _pool(estimates / np.array([cloud.steps for cloud in clouds]), seen)
    numbers = [np.where(pixel >= 0, of_pixel.ravel().take(pixel), -1) for pixel in pixels[1:]]
    return [motion.take(number, 1) for number in numbers], numbers[0], np.append(scores, np.float32(0))[numbers[0]]


def project(xy: np.ndarray, pixel_size: float, config: Config) -> tuple[np.ndarray, np.ndarray]:
    """(H, W) uint8 image of the occupied pixels and (N,) int64 raster index of every point, -1 outside the region."""
    x0, y0, _, x1, y1, _ = config.point_cloud_range
    width, height = int(np.floor((x1 - x0) / pixel_size)) + 1, int(np.floor((y1 - y0) / pixel_size)) + 1
    x, y = xy
    pixel = (np.floor((y - y0) / pixel_size) * width + np.floor((x - x0) / pixel_size)).astype(np.int64)
    inside = (x >= x0) & (x <= x1) & (y >= y0) & (y <= y1)
    image = np.zeros((height, width), np.uint8)
    if inside.all():
        image.ravel()[pixel] = 1
    else:
        image.ravel()[pixel[inside]] = 1
        pixel[~inside] = -1
    return image, pixel


def find_clusters(
    images: Sequence[np.ndarray], pixel_size: float, config: Config
) -> tuple[np.ndarray, list[list[int]]]:
    """Alg. clustering on (H, W) uint8 images, t+1 first: dilate and label; erode too large clusters and label again.

    Returns the cluster of every occupied pixel, (H, W) int32, -1 elsewhere and in components without pixels at t+1 or
    before, and the box of each of M clusters: top, left, height, width in pixels.
    """
    aggregated = images[0].copy()
    for image in images[1:]:
        aggregated |= image
    height, width = aggregated.shape
    # We find boxes from the occupied pixels, because connectedComponentsWithStats is six times slower than labelling.
    dilated = cv2.dilate(aggregated, _SQUARE)
    count, labels = cv2.connectedComponents(dilated, connectivity=config.connectivity)
    pixel = np.flatnonzero(aggregated.view(bool))
    label = labels.ravel()[pixel]
    first, top, left, last_row, last_col = _grouped(pixel, label, width)
    down = np.minimum(last_row + 1, height - 1) - np.maximum(top - 1, 0) + 1
    right = np.minimum(last_col + 1, width - 1) - np.maximum(left - 1, 0) + 1
    too_large = np.zeros(count, bool)
    too_large[label[first]] = np.maximum(down, right) * pixel_size > config.max_extent
    if too_large.any():
        # A 3 x 3 square of foreground is in one component, so all components can be eroded together.
        num_pieces, piece = cv2.connectedComponents(cv2.erode(dilated, _SQUARE), connectivity=config.connectivity)
        label = np.where(too_large[label], count + piece.ravel()[pixel], label)
        count += num_pieces

    at_t1 = images[0].ravel()[pixel].view(bool)
    before = np.zeros_like(at_t1)
    for image in images[1:]:
        before |= image.ravel()[pixel].view(bool)
    has_target, has_source = np.zeros((2, count), bool)
    has_target[label[at_t1]] = True
    has_source[label[before]] = True
    kept = (has_target & has_source)[label]
    pixel, label = pixel[kept], label[kept]

    first, top, left, last_row, last_col = _grouped(pixel, label, width)
    by_raster = np.argsort(first)
    number_of_label = np.empty(count, np.int32)
    number_of_label[label[first[by_raster]]] = np.arange(len(by_raster), dtype=np.int32)
    number = np.full((height, width), -1, np.int32)
    number.ravel()[pixel] = number_of_label[label]
    boxes = np.stack([top, left, last_row - top + 1, last_col - left + 1], 1)
    return number, boxes[by_raster].tolist()


def _grouped(pixel: np.ndarray, label: np.ndarray, width: int) -> tuple[np.ndarray, ...]:
    """Group raster indices by label: index of the first pixel, top, left, last row and last column, (G,) each.

    It sorts once, so that a group is a slice.
    """
    order = np.argsort(label, kind="stable")
    row, col = np.divmod(pixel[order], width)
    start = np.flatnonzero(np.diff(label[order], prepend=-1))
    smallest, largest = np.minimum.reduceat, np.maximum.reduceat
    boxes = smallest(row, start), smallest(col, start), largest(row, start), largest(col, start)
    return (order[start], *boxes)


def _correlate(
    of_pixel: np.ndarray, boxes: list[list[int]], images: Sequence[np.ndarray], pixel_size: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The loop: shifts (2, M, K) in metres, scores (M,) of the newest sweep, and mask (M, K) of sweeps with pixels."""
    num_clusters, num_clouds = len(boxes), len(images) - 1
    shifts = np.zeros((2, num_clusters, num_clouds))
    scores = np.zeros(num_clusters, np.float32)
    seen = np.zeros((num_clusters, num_clouds), bool)
    for m in range(num_clouds):
        present = of_pixel[images[m + 1].view(bool)]
        seen[present[present >= 0], m] = True
    for i, (top, left, height, width) in enumerate(boxes):
        crop = slice(top, top + height), slice(left, left + width)
        own = of_pixel[crop] == i
        target = (images[0][crop] & own).astype(np.float32)
        newest = True
        for m in np.flatnonzero(seen[i]).tolist():
            template = (images[m + 1][crop] & own).astype(np.float32)
            low_y, high_y, low_x, high_x = height // 2, height - 1 - height // 2, width // 2, width - 1 - width // 2
            padded = cv2.copyMakeBorder(target, low_y, high_y, low_x, high_x, cv2.BORDER_CONSTANT)
            score = cv2.matchTemplate(padded, template, cv2.TM_CCORR_NORMED)
            _, peak, _, (x, y) = cv2.minMaxLoc(score)
            if peak > _SMALLEST_SCORE:
                shifts[:, i, m] = (x - low_x) * pixel_size, (y - low_y) * pixel_size
                scores[i] = min(peak, 1.0) if newest else scores[i]
            newest = False
    return shifts, scores, seen


def _pool(estimates: np.ndarray, seen: np.ndarray) -> np.ndarray:
    """Sec. leverage_past_pcs: pool (2, M, K) estimates, nearest sweep first, where `seen` (M, K) is True -> (2, M)."""
    single = np.take_along_axis(estimates, seen.argmax(1)[None, :, None], 2)[..., 0]
    if seen.shape[1] == 1:
        return single
    x, y = np.where(seen, estimates, 0.0)
    length = np.sqrt(x * x + y * y)
    oriented = length > 0
    unit = np.divide((x, y), length, out=np.zeros_like(estimates), where=oriented)
    mean = unit.sum(2)
    nearest = np.take_along_axis(unit, oriented.argmax(1)[None, :, None], 2)[..., 0]
    mean = np.where((mean == 0).all(0), nearest, mean)[..., None]
    angle = np.arctan2(mean[0] * unit[1] - mean[1] * unit[0], mean[0] * unit[0] + mean[1] * unit[1])
    order = np.argsort(np.where(oriented, angle, np.inf), axis=1, kind="stable")
    low, high = (np.take_along_axis(unit, np.take_along_axis(order, i, 1)[None], 2)[..., 0] for i in _middle(oriented))
    both = low + high  # the direction half-way between the middle two
    norm = np.sqrt((both * both).sum(0))
    direction = np.where(norm > 0, both / np.where(norm > 0, norm, 1.0), low)
    ordered = np.sort(np.where(seen, length, np.inf), axis=1)
    low, high = (np.take_along_axis(ordered, i, 1)[:, 0] for i in _middle(seen))
    return np.where(seen.sum(1) == 1, single, (low + high) / 2 * direction)


def _middle(mask: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Indices (M, 1) of the middle one or two among the sorted masked entries of each row."""
    count = mask.sum(1, keepdims=True)
    return np.maximum(count - 1, 0) // 2, np.minimum(count // 2, mask.shape[1] - 1)


def _cloud(sweep: Sweep, moved: np.ndarray, steps: float, config: Config) -> Cloud:
    """The points of a sweep that are not ground and inside the region; `moved` (3, N) in the frame of t+1."""
    x0, y0, z0, x1, y1, z1 = config.point_cloud_range
    x, y, z = moved
    is_active = (x >= x0) & (x <= x1) & (y >= y0) & (y <= y1) & (z >= z0) & (z <= z1)
    if sweep.is_ground is not None:
        is_active &= ~as_numpy(sweep.is_ground)
    rows = np.flatnonzero(is_active)
    return Cloud(moved[:2].take(rows, 1), steps, rows)


def _compensate(sweep: Sweep, sweep1: Sweep) -> tuple[np.ndarray, np.ndarray]:
    """All points (3, N) float64, in the frame of their sweep and in the frame of t+1."""
    points = _columns(sweep)
    if sweep.pose is None:
        return points, points
    matrix = np.linalg.inv(as_numpy(sweep1.pose)) @ as_numpy(sweep.pose)
    rotation, translation = matrix[:3, :3, None], matrix[:3, 3:]
    # We avoid a product of large matrices, after which the threads of BLAS spin for tens of milliseconds.
    moved = rotation[:, 0] * points[0]
    moved += rotation[:, 1] * points[1]
    moved += rotation[:, 2] * points[2]
    moved += translation
    return points, moved


def _columns(sweep: Sweep) -> np.ndarray:
    return np.ascontiguousarray(as_numpy(sweep.points)[:, :3].T, dtype=np.float64)
