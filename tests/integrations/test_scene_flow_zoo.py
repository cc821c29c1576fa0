"""CorrelationFlowModel with SceneFlowZoo's inputs. That is not a package, so we replace its data classes."""

from __future__ import annotations

import sys
from dataclasses import dataclass, field, replace
from enum import Enum
from types import ModuleType
from typing import Any, Sequence

import numpy as np
import pytest
import torch
from scenes import needs_gpu
from torch import Tensor
from turning_drive import SETTINGS, drive, expected, relative_to, speeds

from cflow_torch import CFlowError, Sweep
from cflow_torch.integrations.scene_flow_zoo import CorrelationFlowModel, register

NAN = float("nan")


class LoaderType(Enum):
    CAUSAL = 0
    NON_CAUSAL = 1


@dataclass
class TorchFullFrameInputSequence:
    """Replacement of the class of this name, with the fields that a model for point clouds can read (float32)."""

    full_pc: Tensor  # (K, PadN, 3), NaN in padding rows
    full_pc_mask: Tensor  # (K, PadN), 1 and 0, NaN in padding rows
    pc_poses_sensor_to_ego: Tensor  # (K, 4, 4)
    pc_poses_ego_to_global: Tensor  # (K, 4, 4)
    loader_type: Any = LoaderType.CAUSAL
    full_pc_gt_flowed: Tensor = field(default_factory=lambda: torch.tensor(NAN))  # truth, which no method may read


@dataclass
class TorchFullFrameOutputSequence:
    """Replacement of the class of this name. Its evaluation recognises padding by the NaN of the mask."""

    ego_flows: Tensor
    valid_flow_mask: Tensor

    def flow(self, index: int) -> np.ndarray:
        return self.ego_flows[index][~torch.isnan(self.valid_flow_mask[index])].numpy()

    def mask(self, index: int) -> np.ndarray:
        mask = self.valid_flow_mask[index]
        return (mask[~torch.isnan(mask)] != 0).numpy()


@pytest.fixture(autouse=True)
def zoo(monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    """Replace the packages `dataloaders` and `models`; return the table of models that a config can name."""
    dataloaders, models = ModuleType("dataloaders"), ModuleType("models")
    dataloaders.TorchFullFrameOutputSequence = TorchFullFrameOutputSequence  # type: ignore[attr-defined]
    models.name_to_class_lookup = {}  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "dataloaders", dataloaders)
    monkeypatch.setitem(sys.modules, "models", models)
    return models.name_to_class_lookup  # type: ignore[attr-defined, no-any-return]


def make_sequence(sweeps: Sequence[Sweep], loader: LoaderType = LoaderType.CAUSAL) -> TorchFullFrameInputSequence:
    """Make the input as its loaders do: poses relative to the last sweep, or (non-causal) to that after the middle."""
    origin = len(sweeps) - 1 if loader is LoaderType.CAUSAL else (len(sweeps) - 1) // 2 + 1
    poses = np.stack(relative_to(list(sweeps), origin))
    sensor = np.broadcast_to(np.eye(4), poses.shape).copy()
    points, mask = torch.full((len(sweeps), 640, 3), NAN), torch.full((len(sweeps), 640), NAN)
    for k, sweep in enumerate(sweeps):
        points[k, : len(sweep.points)] = torch.from_numpy(np.float32(sweep.points))
        mask[k, : len(sweep.points)] = torch.from_numpy(~np.asarray(sweep.is_ground)).float()
    return TorchFullFrameInputSequence(points, mask, torch.tensor(sensor).float(), torch.tensor(poses).float(), loader)


def run(sequences: Any, num_history: int = 0, **settings: Any) -> list[TorchFullFrameOutputSequence]:
    return CorrelationFlowModel(**{**SETTINGS, "num_history": num_history, **settings})("val", sequences, None)


def test_causal_gives_one_flow_in_the_axes_of_t_with_nan_in_padding_rows() -> None:
    """The mask marks padding. A point that is NaN keeps its row, as it does in the truth."""
    sweeps = drive(2)
    sequence, rows = make_sequence(sweeps), len(sweeps[0].points)
    (output,) = run([sequence])
    assert output.ego_flows.shape == (1, 640, 3) and output.ego_flows.dtype == torch.float32
    rotated = expected(sweeps, 0, 0)
    np.testing.assert_allclose(output.flow(0), rotated, rtol=0, atol=1e-6)
    assert (speeds(rotated) > 0.3).sum() > 50
    assert torch.isnan(sequence.full_pc[0, :rows]).any() and torch.isfinite(output.ego_flows[0, :rows]).all()
    assert torch.isnan(output.ego_flows[0, rows:]).all() and torch.isnan(output.valid_flow_mask[0, rows:]).all()
    np.testing.assert_array_equal(output.mask(0), ~np.asarray(sweeps[0].is_ground))
    assert not output.flow(0)[~output.mask(0)].any()
    assert output.valid_flow_mask.data_ptr() != sequence.full_pc_mask.data_ptr()


def test_sequences_of_a_batch_may_differ_in_length_and_kind() -> None:
    sweeps = drive(4)
    others = make_sequence(drive(3, seed=3), LoaderType.NON_CAUSAL), make_sequence(drive(2, rotation=-0.05))
    batch = [make_sequence(sweeps), *others]
    outputs = run(batch, num_history=1)
    assert [len(output.ego_flows) for output in outputs] == [1, 2, 1] and run([]) == []
    np.testing.assert_allclose(outputs[0].flow(0), expected(sweeps, 2, 1), rtol=0, atol=1e-6)
    for index in range(2):
        flow = outputs[1].flow(index)
        np.testing.assert_allclose(flow, expected(drive(3, seed=3), index, 1), rtol=0, atol=1e-6)
    for sequence, output in zip(batch, outputs):
        (alone,) = run([sequence], num_history=1)
        np.testing.assert_array_equal(output.ego_flows.numpy(), alone.ego_flows.numpy())
        np.testing.assert_array_equal(output.valid_flow_mask.numpy(), alone.valid_flow_mask.numpy())


def test_a_config_can_name_the_registered_model(zoo: dict[str, Any]) -> None:
    register()
    model = zoo["correlationflow"](preset="default", num_history=2, max_speed=30.0, device="cpu")
    assert model.model.config.max_speed == 30.0 and model.num_history == 2
    with pytest.raises(CFlowError, match="unknown setting voxel"):
        zoo["correlationflow"](voxel=0.1)


def test_the_error_outside_of_a_checkout_has_the_fix(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("dataloaders", "models"):
        monkeypatch.setitem(sys.modules, name, None)
    for call in (lambda: run([make_sequence(drive(2))]), register):
        with pytest.raises(CFlowError, match="clone github.com/kylevedder/SceneFlowZoo"):
            call()


@pytest.mark.parametrize(
    ("changes", "complaint"),
    [
        ({"full_pc": None}, r"batched_sequence\[1\]\.full_pc is NoneType: give \(K, PadN, 3\)"),
        ({"full_pc": torch.zeros(1, 640, 3)}, r"full_pc has shape \(1, 640, 3\).*at least 2"),
        ({"full_pc_mask": torch.zeros(2, 7)}, r"full_pc_mask has shape \(2, 7\).*give \(2, 640\)"),
        ({"pc_poses_ego_to_global": torch.full((2, 4, 4), NAN)}, r"pc_poses_ego_to_global\[0\] holds NaN"),
        ({"pc_poses_sensor_to_ego": 2 * torch.eye(4).repeat(2, 1, 1)}, r"pc_poses_sensor_to_ego\[0\] is not rigid"),
    ],
)
def test_the_error_names_the_bad_field_of_a_sequence(changes: dict[str, Any], complaint: str) -> None:
    good = make_sequence(drive(2))
    with pytest.raises(CFlowError, match=complaint):
        run([good, replace(good, **changes)])


@needs_gpu
@pytest.mark.cuda
def test_the_output_is_on_the_device_of_the_input() -> None:
    sequence = make_sequence(drive(3))
    tensors = {name: value.cuda() for name, value in vars(sequence).items() if isinstance(value, Tensor)}
    (on_cpu,) = run([sequence], num_history=1)
    (on_gpu,) = run([replace(sequence, **tensors)], num_history=1)
    (computed_on_gpu,) = run([sequence], num_history=1, device="cuda")
    assert on_gpu.ego_flows.is_cuda and on_gpu.valid_flow_mask.is_cuda and not computed_on_gpu.ego_flows.is_cuda
    np.testing.assert_array_equal(on_gpu.ego_flows.cpu().numpy(), on_cpu.ego_flows.numpy())
    np.testing.assert_array_equal(computed_on_gpu.ego_flows.numpy(), on_cpu.ego_flows.numpy())
