"""A GPU gives the flow of the CPU on whole sweeps. On a machine with a GPU: `python -m pytest -m cuda`."""

from __future__ import annotations

import pytest
from preset_windows import PRESETS
from scenes import assert_same, needs_gpu

from cflow_torch import make_config, make_model
from cflow_torch.data.log import window
from cflow_torch.simulator import make_drive

pytestmark = [pytest.mark.cuda, needs_gpu]


@pytest.mark.parametrize("max_memory", [None, 30_000_000])
@pytest.mark.parametrize("preset", PRESETS)
def test_a_gpu_gives_the_flow_of_the_cpu(preset: str, max_memory: int | None) -> None:
    config = make_config(preset, max_memory=max_memory)
    drives = [make_drive(seed=seed, num_sweeps=11) for seed in (7, 8, 9)]
    windows = [window(drive, 5, config.num_history, config.num_future) for drive in drives]
    for gpu, cpu in zip(make_model(config, "cuda")(windows), make_model(config, "cpu")(windows)):
        assert gpu.flow.is_cuda
        assert_same(gpu, cpu, atol=1e-4)
