"""The three methods in plain NumPy, one window at a time: the oracle of the tests.

What the paper describes carries the label of its equation, algorithm or section. Nothing here is fast, batched or
shared with the fast path; where the paper leaves something open (ties, borders, medians of an even number), the
docstring says what is done.

Order of reading: reference_flow, here -> `dense` (Alg. general_correlation_flow), `keypoints` (Sec.
CorrelationFlow-Keypoints) or `verified` (ours). What they use: `sweeps` (ego motion), `pixels` (Eq. 3d_to_bev),
`clustering` (Alg. clustering).

Parts of the verified method, in its order: `height_slices`, `changed_pixels`, `component_tree`, `candidates`,
`paired_test`, `aperture`, `registration`, `confidence`.
"""

from __future__ import annotations

from typing import Sequence

import numpy as np
import torch

from cflow_torch.config import Config
from cflow_torch.types import FlowResult, Window
from oracle.dense import general_correlation_flow, ncc_map
from oracle.keypoints import correlation_flow_keypoints, match_keypoints
from oracle.pixels import in_range, occupancy, project_bev
from oracle.sweeps import Cloud, PointMotion, compensate, ground_points, xyz
from oracle.verified import verified_flow

__all__ = ["compensate", "in_range", "match_keypoints", "ncc_map", "occupancy", "project_bev", "reference_flow"]


def reference_flow(window: Window, config: Config) -> FlowResult:
    """Flow of every point of `window.pc0`, by the method of the settings, as CPU tensors.

    The settings `labeling`, `correlation` and `max_memory` choose engines and are ignored here.
    """
    clouds, cloud1 = compensate(window, config)
    if config.method == "verified":
        found = verified_flow(clouds, cloud1, ground_points(window.pc0, clouds[0]), config)  # type: ignore[arg-type]
    else:
        found = coarse_to_fine(clouds, cloud1, config)
    is_valid = clouds[0].is_active & in_range(clouds[0].points, config)
    # Points that are not finite are NaN in p' and get 0, as do those that float32 does not hold.
    with np.errstate(over="ignore"):
        pose_flow = (clouds[0].points - xyz(window.pc0)).astype(np.float32)
    pose_flow = np.nan_to_num(pose_flow, nan=0.0, posinf=0.0, neginf=0.0)
    residual_flow = found.flow[0].astype(np.float32)
    confidence, moving = (
        None if values is None else torch.from_numpy(np.where(is_valid, values, 0).astype(np.float32))
        for values in (found.confidence, found.moving)
    )
    return FlowResult(
        residual_flow=torch.from_numpy(residual_flow),
        pose_flow=torch.from_numpy(pose_flow),
        flow=torch.from_numpy(pose_flow + residual_flow),
        cluster_id=torch.from_numpy(found.cluster_id),
        score=torch.from_numpy(found.score.astype(np.float32)),
        is_valid=torch.from_numpy(is_valid),
        confidence=confidence,
        moving=moving,
    )


def coarse_to_fine(clouds: Sequence[Cloud], cloud1: Cloud, config: Config) -> PointMotion:
    """Multi-scale strategy: estimate, translate the clouds by the flow so far, repeat with finer pixels.

    Returns:
        Flow, the sum over the scales; cluster and score of the finest scale.

    Convention:
        Every sweep m <= t is warped, by k times its flow so far (k = intervals to t+1); t+1 never is. A point that
        leaves the range by being warped gets nothing from that scale.
    """
    at_one_scale = correlation_flow_keypoints if config.method == "keypoints" else general_correlation_flow
    flows = [np.zeros(cloud.points.shape) for cloud in clouds]
    for pixel_size in config.pixel_sizes:
        warped = [cloud._replace(points=cloud.points + cloud.intervals * flow) for cloud, flow in zip(clouds, flows)]
        found = at_one_scale(warped, cloud1, pixel_size, config)  # type: ignore[operator]
        flows = [flow + increment for flow, increment in zip(flows, found.flow)]
    return found._replace(flow=flows)
