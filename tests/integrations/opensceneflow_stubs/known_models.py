"""Models whose scores are known, in the harness's form: to check the harness, the data and the checker themselves."""

from __future__ import annotations

from typing import Any, Dict, List

import torch
from torch import Tensor, nn


class _Timer:
    """Takes the harness's calls, measures nothing."""

    def __getitem__(self, key: int) -> _Timer:
        return self

    def start(self, name: str = "") -> None:
        """Nothing."""

    def stop(self) -> None:
        """Nothing."""

    def print(self, **settings: Any) -> None:
        """Nothing."""


class Zero(nn.Module):
    """Nothing moves but the ego vehicle."""

    def __init__(self, **settings: Any) -> None:
        super().__init__()
        self.timer = _Timer()
        self.settings = settings

    def residual(self, batch: Dict[str, Any]) -> Tensor:
        """(N, 3) float32 for the points that are not ground."""
        return torch.zeros_like(batch["pc0"][0])

    def forward(self, batch: Dict[str, Any]) -> Dict[str, List[Tensor]]:
        return {"flow": [self.residual(batch)]}


class Truth(Zero):
    """The ground truth, which the batch holds."""

    def residual(self, batch: Dict[str, Any]) -> Tensor:
        T = _motion(batch)
        points = batch["pc0"][0]
        return batch["flow"][0][~batch["gm0"][0]] - (points @ T[:3, :3].T + T[:3, 3] - points)


class StaticWorld(Zero):
    """Nothing moves but the LiDAR, at `ego_T_lidar` on the vehicle whose poses the scene stores."""

    def residual(self, batch: Dict[str, Any]) -> Tensor:
        E = torch.tensor([list(row) for row in self.settings["ego_T_lidar"]], dtype=torch.float64)
        T = _motion(batch).double()
        difference = torch.linalg.inv(E) @ T @ E - T
        points = batch["pc0"][0].double()
        return (points @ difference[:3, :3].T + difference[:3, 3]).float()


class Raises(Zero):
    """A model with a fault."""

    def residual(self, batch: Dict[str, Any]) -> Tensor:
        raise ValueError("a fault in the model")


class NotANumber(Zero):
    """A model whose every answer is NaN, which the harness leaves out of its scores."""

    def residual(self, batch: Dict[str, Any]) -> Tensor:
        return torch.full_like(batch["pc0"][0], float("nan"))


def _motion(batch: Dict[str, Any]) -> Tensor:
    """(4, 4) float32 T_ego1_ego0 by the harness's own rule, which turns rounding of float32 poses into 0.2 mm."""
    from src.models.basic import cal_pose0to1

    return cal_pose0to1(batch["pose0"][0], batch["pose1"][0])
