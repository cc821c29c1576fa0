"""The paper in plain NumPy loops: the oracle of the tests and the comparator of the benchmark.

Every function carries the label of the equation, algorithm or section of the paper that it writes down. Nothing
here is fast, batched or shared with the fast path; where the paper leaves something open (ties, borders, medians
of an even number), the docstring says what is done. All numbers are integers or float64, and every float
operation is elementwise in the written order, so that another implementation can reproduce each bit.

Order of reading: reference_flow -> coarse_to_fine, here -> `dense` (Alg. general_correlation_flow) or `keypoints`
(Sec. CorrelationFlow-Keypoints). What they use: `sweeps` (ego motion), `pixels` (Eq. 3d_to_bev), `clustering`
(Alg. clustering), `pooling` (Sec. leverage_past_pcs), `descriptors` and `matching` (key points).

Beyond the paper: `peak` (test, fractions of a pixel), `proof` (motion by hypotheses and proof) and what it is made of:
`cells` (height slices), `low_columns` (ground that a mask left over), `levels` (components at several pixel sizes),
`candidates`, `judge`, `aperture` (lines that seem to slide along themselves), `tree` (which grouping wins),
`relocation`, `refinement`.
"""

from __future__ import annotations

from typing import Sequence, Tuple

import numpy as np
import torch

from cflow_torch.config import Config
from cflow_torch.types import FlowResult, Window
from oracle.aperture import principal_axis, slides_along_itself
from oracle.clustering import cluster, cluster_hdbscan, connected_components, dilate, erode
from oracle.dense import (
    general_correlation_flow,
    ncc_map,
    norm_correlation,
    overlap_and_energy,
    scene_flow_1obj,
    scene_flow_in_1view,
)
from oracle.descriptors import describe, detect_keypoints
from oracle.keypoints import correlation_flow_keypoints, gate, median_of_components, nearest_match
from oracle.levels import Components, components_at, equals_parent, parents
from oracle.low_columns import ground_heights, in_low_column
from oracle.matching import Match, match_keypoints, passes_ratio_test
from oracle.peak import beats_zero, coinciding, parabola
from oracle.pixels import (
    Box,
    bev_dims,
    bounding_box,
    in_range,
    longer_side,
    occupancy,
    project_bev,
    search_radius,
    slice_images,
)
from oracle.pooling import diamond_angle, median, median_direction, pool
from oracle.proof import prove_motion
from oracle.sweeps import Cloud, Level, compensate, ground_points, xyz
from oracle.tree import winners

__all__ = [
    "Box",
    "Cloud",
    "Components",
    "Level",
    "Match",
    "beats_zero",
    "bev_dims",
    "bounding_box",
    "cluster",
    "cluster_hdbscan",
    "coarse_to_fine",
    "coinciding",
    "compensate",
    "components_at",
    "connected_components",
    "correlation_flow_keypoints",
    "describe",
    "detect_keypoints",
    "diamond_angle",
    "dilate",
    "equals_parent",
    "erode",
    "gate",
    "general_correlation_flow",
    "ground_heights",
    "in_low_column",
    "in_range",
    "longer_side",
    "match_keypoints",
    "median",
    "median_direction",
    "median_of_components",
    "ncc_map",
    "nearest_match",
    "norm_correlation",
    "occupancy",
    "overlap_and_energy",
    "parents",
    "parabola",
    "passes_ratio_test",
    "pool",
    "principal_axis",
    "project_bev",
    "reference_flow",
    "scene_flow_1obj",
    "scene_flow_in_1view",
    "search_radius",
    "slides_along_itself",
    "winners",
    "slice_images",
]


def reference_flow(window: Window, config: Config) -> FlowResult:
    """Flow of every point of `window.pc0`, by the method that `config.method` names.

    Args:
        window: sweeps t-h ... t+1, taken as valid.
        config: settings; the fields `labeling`, `correlation`, `max_memory` choose engines and mean nothing here.

    Returns:
        `FlowResult` of CPU tensors, rows in the order of pc0.

    Cost: dense: about one addition per (pixel of a cluster) x (pixel of its bounding box). Key points: about L^2
        per pair of key points within the gate.

    Source: Alg. general_correlation_flow with Sec. leverage_past_pcs, or Sec. CorrelationFlow-Keypoints; both with
        the multi-scale strategy.
    """
    clouds, cloud1 = compensate(window, config)
    if config.proof:
        ground = [ground_points(window.pc0, clouds[0]), ground_points(window.pc1, cloud1)]
        level = prove_motion(clouds, cloud1, ground, config)
        residual_flow, cluster_id, score = level.flow[0], level.cluster_id[0], level.score[0]
        confidence = level.confidence
    else:
        residual_flow, cluster_id, score = coarse_to_fine(clouds, cloud1, config)
        confidence = None
    # float32(p' - p); points that are not finite are NaN in p' and get 0, as do those that float32 does not hold
    with np.errstate(over="ignore"):
        pose_flow = (clouds[0].points - xyz(window.pc0)).astype(np.float32)
    pose_flow = np.nan_to_num(pose_flow, nan=0.0, posinf=0.0, neginf=0.0)
    residual_flow = residual_flow.astype(np.float32)
    is_valid = clouds[0].takes_part & in_range(clouds[0].points, config)
    trust = None if confidence is None else np.where(is_valid, confidence[0], 0).astype(np.float32)
    return FlowResult(
        residual_flow=torch.from_numpy(residual_flow),
        pose_flow=torch.from_numpy(pose_flow),
        flow=torch.from_numpy(pose_flow + residual_flow),
        cluster_id=torch.from_numpy(cluster_id),
        score=torch.from_numpy(score.astype(np.float32)),
        is_valid=torch.from_numpy(is_valid),
        confidence=None if trust is None else torch.from_numpy(trust),
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
    at_one_scale = correlation_flow_keypoints if config.method == "keypoints" else general_correlation_flow
    flows = [np.zeros(cloud.points.shape) for cloud in clouds]
    for pixel_size in config.pixel_sizes:
        warped = [cloud._replace(points=cloud.points + cloud.steps * flow) for cloud, flow in zip(clouds, flows)]
        level = at_one_scale(warped, cloud1, pixel_size, config)
        flows = [flow + increment for flow, increment in zip(flows, level.flow)]
    return flows[0], level.cluster_id[0], level.score[0]
