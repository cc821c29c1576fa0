"""A model for SceneFlowZoo: it takes `TorchFullFrameInputSequence` and returns `TorchFullFrameOutputSequence`."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from cflow_torch.errors import import_optional
from cflow_torch.integrations.sequence import SequenceFlow, SequenceSweep
from cflow_torch.transforms import rigid_transform
from cflow_torch.types import CFlowError, check_array

_NEED = (
    "SceneFlowZoo is not a package: clone github.com/kylevedder/SceneFlowZoo, install its requirements, and run from "
    "its root folder or add that to PYTHONPATH"
)


class CorrelationFlowModel(SequenceFlow):
    """A method with the interface that SceneFlowZoo's `ModelWrapper` expects. There is nothing to train.

    The arguments are those of `SequenceFlow`, for example `num_history=3`.
    """

    def forward(self, forward_mode: Any, batched_sequence: Any, logger: Any = None) -> list[Any]:
        """Estimate the flow of a batch of sequences.

        Args:
            forward_mode, logger: ignored.
            batched_sequence: B `TorchFullFrameInputSequence`, K >= 2 sweeps each. We use full_pc (K, PadN, 3),
                full_pc_mask (K, PadN; NaN = padding row), pc_poses_sensor_to_ego and pc_poses_ego_to_global
                (K, 4, 4), and loader_type.

        Returns:
            B `TorchFullFrameOutputSequence`, on the device of their input. A causal loader gets one flow, of sweep
            K - 2; a non-causal one gets K - 1 flows. The sweeps before a sweep are its history.
            ego_flows: (1 or K - 1, PadN, 3) float32, metres until the next sweep, residual (ego motion removed), in the
                axes of the sweep's own points; 0 where `full_pc_mask` is 0, NaN in padding rows.
            valid_flow_mask: (1 or K - 1, PadN) float32, `full_pc_mask` as 0 and 1, NaN in padding rows. A flow of 0
                outside the method's range is scored like any other.

        A `CFlowError` names a bad field ("batched_sequence[0].full_pc_mask").
        """
        output_class = import_optional("dataloaders", _NEED, "TorchFullFrameOutputSequence")
        read = [_read_sequence(sequence, f"batched_sequence[{i}]") for i, sequence in enumerate(batched_sequence)]
        flows = self.flows([frames for frames, _, _ in read], [first for _, first, _ in read])
        outputs = []
        for (_, first, valid), own in zip(read, flows):
            mask = valid[first:-1]
            ego_flows = torch.full((*mask.shape, 3), torch.nan, dtype=torch.float32, device=mask.device)
            ego_flows[~mask.isnan()] = torch.cat(own).to(mask.device)
            outputs.append(output_class(ego_flows=ego_flows, valid_flow_mask=mask.clone()))
        return outputs


def register(name: str = "CorrelationFlow") -> None:
    """Register the model with `models.construct_model` of SceneFlowZoo, so that a config can name it."""
    import_optional("models", _NEED, "name_to_class_lookup")[name.lower()] = CorrelationFlowModel


def _read_sequence(sequence: Any, name: str) -> tuple[list[SequenceSweep], int, Tensor]:
    """Return sweeps without padding, the index of the first one to estimate, and the (K, PadN) mask (1, 0, NaN)."""
    points = sequence.full_pc
    mask = sequence.full_pc_mask
    check_array(points, f"{name}.full_pc", (None, None, 3), "f", "(K, PadN, 3) floats, metres")
    if len(points) < 2:
        raise CFlowError(f"{name}.full_pc has shape {tuple(points.shape)}: give a K of at least 2")
    shape = tuple(points.shape[:2])
    check_array(mask, f"{name}.full_pc_mask", shape, "f", f"{shape} floats with NaN in padding rows")
    is_row = ~torch.isnan(mask)
    poses = []
    for side in ("pc_poses_sensor_to_ego", "pc_poses_ego_to_global"):
        pose = getattr(sequence, side)
        check_array(pose, f"{name}.{side}", (len(points), 4, 4), "f", f"({len(points)}, 4, 4) floats, one per sweep")
        poses.append([rigid_transform(matrix, f"{name}.{side}[{k}]") for k, matrix in enumerate(pose.detach().cpu())])
    frames = [
        SequenceSweep(cloud[rows], flags[rows] > 0, sensor_to_ego, ego_to_global)
        for cloud, flags, rows, sensor_to_ego, ego_to_global in zip(points, mask, is_row, *poses)
    ]
    valid = (mask > 0).float().masked_fill(~is_row, torch.nan)
    return frames, len(frames) - 2 if sequence.loader_type.name == "CAUSAL" else 0, valid
