"""The model that OpenSceneFlow's configuration names. It turns batches into residual flow, and has no weights."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import fields
from importlib import import_module
from pathlib import Path
from typing import Any, Mapping

import torch
from torch import Tensor, nn

from cflow_torch.config import WINDOW, Config, make_config
from cflow_torch.data.atomic import atomic_file
from cflow_torch.data.hdf5.frames import harness_pose_flow, residual_for_harness
from cflow_torch.diagnosis.inspection import Inspection
from cflow_torch.errors import warn
from cflow_torch.estimate import make_model
from cflow_torch.integrations.opensceneflow.batch import BatchSample, read_batch
from cflow_torch.transforms import rigid_transform
from cflow_torch.types import CFlowError, FlowResult


class CFlow(nn.Module):
    """A method with the interface of OpenSceneFlow's models. It has no parameters, no buffers and no layers.

    Args:
        num_frames: sweeps per window, h + 2, because the harness also counts t+1 and t. None = that of the preset: 6
            for "default", "offline" and "live", 2 for the others. If the harness passes fewer sweeps, we use
            those.
        ego_T_lidar: (4, 4) nested list or array that maps points to the frame whose poses the scenes store. None = the
            same frame. "auto" = recognise scenes of Argoverse 2, whose points are in the frame of up_lidar.
        output: "full" = flow of all rows of pc0, 0 where the method estimates none. "valid" = flow of the valid rows
            only, with their indices in "pc0_valid_point_idxes". Do not combine "valid" with the harness's setting
            iter_only, which ignores the indices.
        device: "auto" = that of the batch.
        voxel_size, grid_feature_size: ignored. The harness passes them.
        preset: as for `make_config`.
        **settings: settings of the method, which replace those of the preset. We ignore `num_history`, `num_future` and
            settings that the method does not have, and name them in a warning.

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
        preset: str | Config = "default",
        **settings: Any,
    ) -> None:
        super().__init__()
        config: Config = make_config(preset)
        names = ["pixel_size", *(f.name for f in fields(config) if f.name not in WINDOW)]
        unknown = [name for name in sorted(settings) if name not in names]
        if unknown:
            known = f"method {config.method!r} has {', '.join(names)} (history is set by num_frames)"
            warn(f"ignored settings: {', '.join(unknown)}; {known}")
        config = make_config(config, **{name: value for name, value in settings.items() if name in names})
        self.config = _with_history(config, num_frames)
        self.estimator = make_model(self.config, device)
        self._inspect = Inspection()
        if output not in ("full", "valid"):
            raise CFlowError(f"output={output!r}: give 'full' or 'valid'")
        self.output = output
        has_matrix = ego_T_lidar is not None and not (isinstance(ego_T_lidar, str) and ego_T_lidar == "auto")
        self.ego_T_lidar = rigid_transform(ego_T_lidar, "ego_T_lidar") if has_matrix else ego_T_lidar
        self.timer: Any = None
        with suppress(ImportError):  # the harness always has dztimer, and requires the attribute
            self.timer = import_module("dztimer").Timing()
        self._has_warned = False

    def forward(self, batch: Mapping[str, Any]) -> dict[str, list[Tensor]]:
        """Estimate the residual flow of every sample.

        Args:
            batch: B samples in any layout of the harness (`read_batch`). It is not modified.

        Returns:
            Lists of B tensors, on the device of the method:
            flow: (M, 3) float32, metres from t to t+1, axes of the frame of t+1. The harness adds it to pose_flow.
                With `ego_T_lidar`, it also corrects the error of the harness's own pose_flow.
            pc0_valid_point_idxes: (M,) int64, the rows of batch["pc0"] that `flow` belongs to.
            pose_flow: (N, 3) float32, T p - p of all rows of pc0, as the harness computes it.

        A `CFlowError` names a bad key of the batch.
        """
        samples = read_batch(batch, self.config.num_history, self.ego_T_lidar)
        self._check_history(samples)
        windows = [sample.window for sample in samples]
        results = self.estimator(windows)
        self._inspect(windows)
        with torch.no_grad(), torch.autocast(results[0].flow.device.type, enabled=False):
            outputs = [self._output(batch, b, *pair) for b, pair in enumerate(zip(samples, results))]
        return {key: [output[key] for output in outputs] for key in outputs[0]}

    def _output(self, batch: Mapping[str, Any], b: int, sample: BatchSample, result: FlowResult) -> dict[str, Tensor]:
        num_points = len(sample.rows0)  # the rows after these are ground points
        residual = result.residual_flow[:num_points]
        is_valid = result.is_valid[:num_points]
        device = residual.device
        points = batch["pc0"][b][:, :3].detach().to(device).float()
        rows = sample.rows0.to(device)
        if sample.T_lidar1_lidar0 is not None:
            residual = residual_for_harness(residual, points[rows], sample.T_ego1_ego0, sample.T_lidar1_lidar0)
        flow = torch.zeros_like(points).index_copy_(0, rows, residual)
        if self.output == "valid":
            rows = rows[is_valid]
        elif "gm0" in batch:  # without padding, the iter_only path expects a row for every point
            rows = torch.arange(len(points), device=device)
        pose_flow = harness_pose_flow(points, sample.T_ego1_ego0)
        return {"flow": flow[rows], "pose_flow": pose_flow, "pc0_valid_point_idxes": rows}

    def _check_history(self, samples: list[BatchSample]) -> None:
        """Warn once if the batches have less history than the settings."""
        num_history = self.config.num_history
        given = min(len(sample.window.pch) for sample in samples)
        if given < num_history and not self._has_warned:
            self._has_warned = True
            warn(
                f"num_frames={num_history + 2} needs {num_history} history sweeps, but the batch has {given}, and the "
                f"flow is estimated from those. Pass num_frames={num_history + 2} to the script as well (iter_only), "
                f"or set model.target.num_frames={given + 2}"
            )


def _with_history(config: Config, num_frames: Any) -> Config:
    if num_frames is None or (config.method == "keypoints" and num_frames == 2):
        return config
    if not isinstance(num_frames, int) or num_frames < 2 or config.method == "keypoints":
        raise CFlowError(f"num_frames={num_frames!r}: give an integer of at least 2; for key points, 2")
    return config.replace(num_history=num_frames - 2)


def write_null_checkpoint(file: str | Path, overwrite: bool = False) -> Path:
    """Write a checkpoint without weights, for example `cflow.ckpt`, and return its path.

    OpenSceneFlow's scripts require one. They use the stem of the file as a label of the output folder and of printed
    tables, and save.py stores its results under this name. A file that exists is a `CFlowError` unless you set
    `overwrite`, because it might contain weights.
    """
    # Plain containers only, so that `torch.load(weights_only=True)` reads it. We leave out `model.target`, because the
    # harness would prefer it to the settings on the command line.
    file = Path(file)
    if file.exists() and not overwrite:
        raise CFlowError(f"{file} exists already: give another name, or overwrite it (--overwrite)")
    cfg = {"model": {"name": file.stem}, "output": file.stem, "num_frames": 2}
    contents: dict[str, Any] = {
        "epoch": 0,
        "global_step": 0,
        "pytorch-lightning_version": "2.0.1",
        "state_dict": {},
        "hyper_parameters": {"cfg": cfg, "eval": True},
    }
    with atomic_file(file) as new:
        torch.save(contents, new)
    return file
