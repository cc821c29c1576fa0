"""A street of three sweeps with a known flow: a moving car, a wall and the ground."""

from __future__ import annotations

import numpy as np
import torch
from scenes import pose

from cflow_torch import FlowResult, Sweep
from cflow_torch.data.log import FlowLabels

CAR, WALL, FLOOR = slice(0, 20), slice(20, 40), slice(40, 50)
CAR_FLOW = np.array([0.6, 0.3, 0.0], np.float32)
STEP = 2.0  # metres that the ego vehicle drives between sweeps
START = 1_700_000_000_000_000_000  # nanoseconds
FAR = 5e6  # metres: where cities lie in map coordinates


class Street:
    """Three sweeps of a moving car, a wall and the ground; the last pair has no labels."""

    log_id = "street"
    timestamps = [START + i * 100_000_000 for i in range(3)]

    def __init__(self, has_labels: bool = True, has_poses: bool = True, start: int | None = START) -> None:
        self.has_labels, self.has_poses, self.start = has_labels, has_poses, start

    def sweep(self, index: int) -> Sweep:
        points = np.random.default_rng(index).uniform(-5, 5, (51, 3)).astype(np.float32)
        points[50] = np.nan
        is_ground = np.zeros(51, bool)
        is_ground[FLOOR] = True
        stamp = None if self.start is None else self.start + index * 100_000_000
        T_world_ego = pose(FAR + STEP * index, FAR, 0.0) if self.has_poses else None
        return Sweep(points, is_ground, T_world_ego, stamp)

    def labels(self, index: int) -> FlowLabels | None:
        if not self.has_labels or index == 1:
            return None
        result = result_of()
        is_valid = np.ones(51, bool)
        is_valid[WALL] = False
        return FlowLabels(result.flow.numpy() * np.float32(1.0), np.zeros(51, np.uint8), is_valid)


def result_of(speed: float = 1.0) -> FlowResult:
    residual = torch.zeros(51, 3)
    residual[CAR] = torch.from_numpy(CAR_FLOW) * speed
    pose_flow = torch.tensor([-STEP, 0.0, 0.0]).repeat(51, 1)
    cluster = torch.full((51,), -1)
    cluster[CAR], cluster[WALL] = 3, 5
    ones = torch.ones(51)
    return FlowResult(residual, pose_flow, residual + pose_flow, cluster, ones, ones > 0)
