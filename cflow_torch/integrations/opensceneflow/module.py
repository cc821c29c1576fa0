"""The class that the harness's configuration names: batches in, residual flow out."""

from __future__ import annotations

import warnings
from contextlib import suppress
from dataclasses import fields
from importlib import import_module
from typing import Any, Mapping

import numpy as np
import torch
from torch import Tensor, nn

from cflow_torch.config import WINDOW, Config, make_config
from cflow_torch.data.hdf5.frames import harness_pose_flow, residual_for_harness
from cflow_torch.estimate import make_model
from cflow_torch.integrations.opensceneflow.batch import Sample, read_batch
from cflow_torch.types import CFlowError, FlowResult
from cflow_torch.windows.ego_motion import rigid_transform

OUTPUTS = ("full", "valid")


class SilentTimer:
    """Stands in for `dztimer.Timing`, the stop watch of the harness, where that is absent: measures nothing."""

    def __getitem__(self, key: int) -> SilentTimer:
        """Any step, however deep."""
        return self

    def start(self, *args: Any, **kwargs: Any) -> None:
        """Nothing."""

    stop = print = start


class CFlow(nn.Module):
    """A method as OpenSceneFlow calls a model. No parameters, no buffers, no layers.

    Args:
        num_frames: sweeps per window as the harness counts them, t+1 and t included: h + 2. None = the preset's, 6 for
            "default", 4 for "fast", 2 for the others. If the harness gives fewer, fewer are used.
        ego_T_lidar: (4, 4) nested list or array, coordinates of the points to the frame whose poses the scenes store;
            None = the same frame; "auto" = recognise scenes of Argoverse 2, whose points lie in the frame of up_lidar.
        output: "full" = flow of all rows of pc0, 0 where the method says nothing (both paths of the harness);
            "valid" = only of rows that took part, by "pc0_valid_point_idxes" (not with iter_only, which ignores those).
        device: "auto" = that of the batch.
        voxel_size, grid_feature_size: taken, because the harness wants and gives them; without effect.
        preset, method: as in `make_config`; "default" if neither is given.
        **settings: any field of the method's settings but `num_history` and `num_future`; those not given are the
            preset's. Others, of another method for example, are named in a warning and have no effect.

    Raises:
        CFlowError: invalid settings.

    Source: Alg. general_correlation_flow; Sec. CorrelationFlow-Keypoints.
    """

    def __init__(
        self,
        num_frames: int | None = None,
        ego_T_lidar: Any = None,
        output: str = "full",
        device: Any = "auto",
        voxel_size: Any = None,
        grid_feature_size: Any = None,
        preset: str | None = None,
        method: str | None = None,
        **settings: Any,
    ) -> None:
        super().__init__()
        config: Config = make_config(preset, method)
        names = ["pixel_size", *(f.name for f in fields(config) if f.name not in ("method", *WINDOW))]
        unknown = [name for name in sorted(settings) if name not in names]
        if unknown:
            known = f"method={config.method!r} has {', '.join(names)} (history is set by num_frames)"
            warnings.warn(f"settings without effect: {', '.join(unknown)}; {known}", stacklevel=2)
        config = config.replace(**{name: value for name, value in settings.items() if name in names})
        self.config = _with_history(config, num_frames)
        self.estimator = make_model(self.config, device)
        if output not in OUTPUTS:
            raise CFlowError(f"output={output!r}: give one of {', '.join(map(repr, OUTPUTS))}")
        self.output = output
        self.ego_T_lidar = _extrinsics(ego_T_lidar)
        self.timer: Any = SilentTimer()
        with suppress(ImportError):
            self.timer = import_module("dztimer").Timing()
        self._said_short = False

    def forward(self, batch: Mapping[str, Any]) -> dict[str, list[Tensor]]:
        """Residual flow of every sample.

        Args:
            batch: any of the harness's layouts, see `read_batch`; B samples. Not modified.

        Returns:
            Lists of B tensors, on the device of the method:
            flow: (M, 3) float32, metres from t to t+1, axes of the frame of t+1: what the harness adds to pose_flow.
                With `ego_T_lidar` it holds, beside the motion of objects, what the harness's own pose_flow lacks.
            pc0_valid_point_idxes: (M,) int64, the rows of batch["pc0"] that `flow` is for.
            pose_flow: (N, 3) float32, T p - p of all rows of pc0, as the harness computes it.
            pc1_valid_point_idxes: (M1,) int64; pc0_points_lst: (M, 3), pc1_points_lst: (M1, 3), for losses.

        Raises:
            CFlowError: a bad batch; the message names the key.
        """
        num_history = self.config.num_history
        samples = read_batch(batch, num_history, self.ego_T_lidar)
        self._say_short(samples, num_history)
        results = self.estimator([sample.window for sample in samples])
        with torch.no_grad(), torch.autocast(results[0].flow.device.type, enabled=False):
            answers = [self._answer(batch, b, *pair) for b, pair in enumerate(zip(samples, results))]
        return {key: [answer[key] for answer in answers] for key in answers[0]}

    def _answer(self, batch: Mapping[str, Any], b: int, sample: Sample, result: FlowResult) -> dict[str, Tensor]:
        """The output of one sample."""
        pc0, pc1 = batch["pc0"][b][:, :3], batch["pc1"][b][:, :3]
        residual = result.residual_flow
        device = residual.device
        points, rows = pc0.detach().to(device).float(), sample.rows0.to(device)
        if sample.T_lidar1_lidar0 is not None:
            residual = residual_for_harness(residual, points[rows], sample.T_ego1_ego0, sample.T_lidar1_lidar0)
        flow = torch.zeros_like(points).index_copy_(0, rows, residual)
        if self.output == "valid":
            rows = rows[result.is_valid]
        elif "gm0" in batch:  # no padding: the harness's second path expects a row for every point
            rows = torch.arange(len(pc0), device=device)
        rows1 = sample.rows1.to(device)
        return {
            "flow": flow[rows],
            "pose_flow": harness_pose_flow(points, sample.T_ego1_ego0),
            "pc0_valid_point_idxes": rows,
            "pc1_valid_point_idxes": rows1,
            "pc0_points_lst": pc0.to(device)[rows],
            "pc1_points_lst": pc1.to(device)[rows1],
        }

    def _say_short(self, samples: list[Sample], num_history: int) -> None:
        """Once: the harness gives less history than asked for."""
        given = min(len(sample.window.pch) for sample in samples)
        if given < num_history and not self._said_short:
            self._said_short = True
            warnings.warn(
                f"num_frames={num_history + 2} asks for {num_history} history sweeps, the batch has {given}: the flow "
                f"is estimated from those; pass num_frames={num_history + 2} to the script as well (iter_only), or set "
                f"model.target.num_frames={given + 2}",
                stacklevel=3,
            )


def _with_history(config: Config, num_frames: Any) -> Config:
    if num_frames is None or (config.method == "keypoints" and num_frames == 2):
        return config
    if not isinstance(num_frames, int) or num_frames < 2 or config.method == "keypoints":
        raise CFlowError(f"num_frames={num_frames!r}: give a whole number of at least 2; for key points, 2")
    return config.replace(num_history=num_frames - 2)


def _extrinsics(ego_T_lidar: Any) -> Any:
    """None, "auto", or a checked (4, 4) float64."""
    if ego_T_lidar is None or (isinstance(ego_T_lidar, str) and ego_T_lidar == "auto"):
        return ego_T_lidar
    try:  # Hydra gives lists of a type of its own
        rows = np.array([[float(value) for value in row] for row in ego_T_lidar])
    except (TypeError, ValueError):
        raise CFlowError(f"ego_T_lidar={ego_T_lidar!r}: give 'auto', null, or a (4, 4) matrix") from None
    return rigid_transform(rows, "ego_T_lidar")
