"""`torch.hub.load` from a checkout. Its dependencies are tested in `test_structure.py`."""

from __future__ import annotations

from pathlib import Path

import torch
from scenes import assert_same, scene

from cflow_torch import make_config, make_model

ROOT = str(Path(__file__).resolve().parents[2])


def test_hub_loads_the_model_of_the_preset():
    window = scene(0, num_history=1)
    model = torch.hub.load(ROOT, "cflow", source="local", preset="paper", device="cpu", num_history=1)
    assert model.config == make_config("paper", num_history=1)
    assert torch.hub.load(ROOT, "cflow", source="local").config == make_config()
    assert_same(model([window])[0], make_model(make_config("paper", num_history=1))([window])[0])
