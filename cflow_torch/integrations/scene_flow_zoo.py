"""CorrelationFlow as a model of SceneFlowZoo: `TorchFullFrameInputSequence` in, `TorchFullFrameOutputSequence` out."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor, nn

from cflow_torch.integrations.sequence import Frame, SequenceFlow, import_from
from cflow_torch.types import CFlowError
from cflow_torch.windows.ego_motion import rigid_transform

_HOW = (
    "SceneFlowZoo is no package; clone github.com/kylevedder/SceneFlowZoo, install its requirements, and run from its "
    "root folder or put that on PYTHONPATH"
)
_POSES = ("pc_poses_sensor_to_ego", "pc_poses_ego_to_global")


class CorrelationFlowModel(nn.Module):
    """What SceneFlowZoo's `ModelWrapper` asks of a model. No parameters, no buffers, nothing to train.

    Args:
        preset, ground, **settings: as for `SequenceFlow`, for example `num_history=3`.
        device: "auto" = that of the sequence; another one only computes there, the output comes back.

    Raises:
        CFlowError: an unknown setting or an invalid value.
    """

    def __init__(self, preset: str | None = None, device: Any = "auto", ground: str | None = None, **settings: Any):
        super().__init__()
        self.sequence_flow = SequenceFlow(preset, device, ground, **settings)

    def forward(self, forward_mode: Any, batched_sequence: Any, logger: Any = None) -> list[Any]:
        """Flow of a batch of sequences.

        Args:
            forward_mode: not used: there is no other way to run in training.
            batched_sequence: B `TorchFullFrameInputSequence`, K >= 2 sweeps each. Used are full_pc (K, PadN, 3),
                full_pc_mask (K, PadN), pc_poses_sensor_to_ego and pc_poses_ego_to_global (K, 4, 4), loader_type.
            logger: not used.

        Returns:
            B `TorchFullFrameOutputSequence`, on the device of their input. Causal loader: one flow, of sweep K - 2;
            the sweeps before it are history. Non-causal loader: K - 1 flows; the sweeps before i are history of i.

        Convention:
            ego_flows: (1 or K - 1, PadN, 3) float32, metres until the next sweep, residual (ego motion taken out), axes
                of the sweep's own points; 0 for points that take no part, NaN in padding rows.
            valid_flow_mask: float32 like the loader's masks: `full_pc_mask` as 0 and 1, NaN in padding rows. A 0
                outside the method's range is a prediction like any other.
            Padding rows are those with NaN in `full_pc_mask`.

        Raises:
            CFlowError: by the name of the field, for example "batched_sequence[0].full_pc_mask"; no SceneFlowZoo.
        """
        output_class = import_from("dataloaders", "TorchFullFrameOutputSequence", _HOW)
        read = [_read_sequence(sequence, f"batched_sequence[{i}]") for i, sequence in enumerate(batched_sequence)]
        flows = self.sequence_flow([frames for frames, _, _ in read], [first for _, first, _ in read])
        outputs = []
        for (_, first, valid), own in zip(read, flows):
            mask = valid[first:-1]
            ego_flows = torch.full((*mask.shape, 3), torch.nan, dtype=torch.float32, device=mask.device)
            ego_flows[~mask.isnan()] = torch.cat(own).to(mask.device)
            outputs.append(output_class(ego_flows=ego_flows, valid_flow_mask=mask.clone()))
        return outputs

    def loss_fn(self, input_batch: Any, model_res: Any) -> Any:
        """There is none: always a `CFlowError`."""
        raise CFlowError("there is nothing to train: set is_trainable = False in the config and run test_pl.py")


def register(name: str = "CorrelationFlow") -> None:
    """Make the model known to the checkout's `models.construct_model`, by the name that a config may then give.

    Raises:
        CFlowError: no SceneFlowZoo on the path.
    """
    import_from("models", "name_to_class_lookup", _HOW)[name.lower()] = CorrelationFlowModel


def _read_sequence(sequence: Any, name: str) -> tuple[list[Frame], int, Tensor]:
    """Sweeps without padding, first sweep that a flow is asked for, (K, PadN) mask: 1, 0, in padding rows NaN."""
    for field in ("full_pc", "full_pc_mask", *_POSES):
        if not isinstance(getattr(sequence, field, None), Tensor):
            raise CFlowError(f"{name}.{field} is no tensor: give a TorchFullFrameInputSequence")
    points, mask = sequence.full_pc, sequence.full_pc_mask
    if points.ndim != 3 or points.shape[2] != 3 or points.shape[0] < 2:
        raise CFlowError(f"{name}.full_pc has shape {tuple(points.shape)}: give (K, PadN, 3) metres, K of at least 2")
    if mask.shape != points.shape[:2]:
        given, shape = tuple(mask.shape), tuple(points.shape[:2])
        raise CFlowError(f"{name}.full_pc_mask has shape {given}: give {shape}, float with NaN in padding rows")
    is_row = ~torch.isnan(mask)
    poses = []
    for side in _POSES:
        pose = getattr(sequence, side).detach().cpu()
        if pose.shape != (len(points), 4, 4):
            raise CFlowError(f"{name}.{side} has shape {tuple(pose.shape)}: give ({len(points)}, 4, 4), one a sweep")
        poses.append([rigid_transform(matrix, f"{name}.{side}[{k}]") for k, matrix in enumerate(pose)])
    frames = [
        Frame(cloud[rows], part[rows] > 0, sensor_to_ego, ego_to_global)
        for cloud, part, rows, sensor_to_ego, ego_to_global in zip(points, mask, is_row, *poses)
    ]
    loader = getattr(getattr(sequence, "loader_type", None), "name", None)
    if loader not in ("CAUSAL", "NON_CAUSAL"):
        raise CFlowError(f"{name}.loader_type is {loader!r}: give LoaderType.CAUSAL or LoaderType.NON_CAUSAL")
    valid = (mask > 0).float().masked_fill(~is_row, torch.nan)
    return frames, len(frames) - 2 if loader == "CAUSAL" else 0, valid
