"""`torch.hub.load` from a checkout."""

from __future__ import annotations

import runpy
import subprocess
import sys
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


def test_hub_needs_no_other_dependencies(tmp_path):
    # In a process that finds only the checkout and the named dependencies.
    others = {"kornia", "pyarrow", "hydra", "omegaconf", "tqdm", "matplotlib", "h5py", "scipy", "cv2", "pandas"}
    given = set(runpy.run_path(f"{ROOT}/hubconf.py")["dependencies"])
    code = (
        "import sys\n"
        f"for name in {sorted(others - given)}: sys.modules[name] = None\n"
        "import torch\n"
        f"model = torch.hub.load({ROOT!r}, 'cflow', source='local', preset='paper')\n"
        "print(type(model).__name__, len(list(model.parameters())))\n"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=str(tmp_path), capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert done.stdout.split() == ["CorrelationFlow", "0"]
