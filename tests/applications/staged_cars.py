"""Box-shaped cars before a wall, with exact flow by hand."""

from __future__ import annotations

from typing import Any, Sequence

import numpy as np
import torch

from cflow_torch import FlowResult, Sweep
from cflow_torch.data.log import Log

INTERVAL_NS = 100_000_000
SIZE = (4.5, 1.9, 1.2)  # metres; cars have the size that is typical, so that it does not matter which sides are seen
_BODY = np.stack(np.meshgrid(*map(np.linspace, (0, 0, 0), SIZE, (20, 9, 7))), -1).reshape(-1, 3)
_WALL = np.stack(np.meshgrid(np.arange(-10, 30, 0.2), [12.0], np.arange(0, 3, 0.2)), -1).reshape(-1, 3)


class Staged(Log):
    """Box-shaped cars with exact flow, before a wall.

    Args:
        paths: (K, T, 2) x, y of the corner of each car at each sweep; NaN = hidden.
        poses: (T, 4, 4) of the vehicle, None = no poses.
    """

    def __init__(self, paths: Any, poses: Any = None) -> None:
        self.paths, self.poses, self.log_id = np.asarray(paths, float), poses, "staged"
        self.timestamps = [INTERVAL_NS * (1 + index) for index in range(self.paths.shape[1])]

    def world(self, index: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Points, their residual flow in the world, their car (-1 = the wall)."""
        points, flow, car = [_WALL], [np.zeros_like(_WALL)], [np.full(len(_WALL), -1)]
        for number, path in enumerate(self.paths):
            if np.isfinite(path[index]).all():
                points.append(self._body(number) + [*path[index], 0])
                after = path[min(index + 1, len(path) - 1)]
                step = np.nan_to_num(after - path[index]) if np.isfinite(after).all() else path[index] - path[index - 1]
                flow.append(np.zeros_like(_BODY) + [*step, 0])
                car.append(np.full(len(_BODY), number))
        return np.concatenate(points), np.concatenate(flow), np.concatenate(car)

    def middle(self, car: int) -> np.ndarray:
        """(T, 2) x, y of the middle of a car at each sweep."""
        return self.paths[car] + self._body(car)[:, :2].mean(0)

    def _body(self, car: int) -> np.ndarray:
        """Points of a car relative to its corner, turned to where it drives."""
        path = self.paths[car][np.isfinite(self.paths[car]).all(1)]
        x, y = (path[-1] - path[0]) / max(1e-9, np.linalg.norm(path[-1] - path[0]))
        turn = np.array([[x, y, 0], [-y, x, 0], [0, 0, 1]])
        return _BODY @ (turn if x or y else np.eye(3))

    def sweep(self, index: int) -> Sweep:
        points = self.world(index)[0]
        pose = None if self.poses is None else self.poses[index]
        if pose is not None:
            points = (points - pose[:3, 3]) @ pose[:3, :3]
        return Sweep(points.astype(np.float32), None, pose, self.timestamps[index])

    def result(self, index: int, confidence: float = 0.9) -> FlowResult:
        _, flow, car = self.world(index)
        if self.poses is not None:
            flow = flow @ self.poses[index + 1][:3, :3]
        values = {"residual_flow": torch.from_numpy(flow).float(), "cluster_id": torch.from_numpy(car + 1)}
        values["is_valid"] = torch.ones(len(car), dtype=torch.bool)
        return FlowResult.of({**values, "confidence": torch.full((len(car),), confidence)})

    def results(self) -> list[tuple[int, FlowResult]]:
        return [(index, self.result(index)) for index in range(len(self) - 1)]


def straight(start: Sequence[float], step: Sequence[float], count: int = 12) -> np.ndarray:
    return np.asarray(start, float) + np.arange(count)[:, None] * np.asarray(step, float)
