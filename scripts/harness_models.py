#!/usr/bin/env python3
"""Write the presets as models of OpenSceneFlow's configuration: configs/opensceneflow/model/*.yaml."""

from __future__ import annotations

from dataclasses import fields
from pathlib import Path

from cflow_torch.cli.settings import as_yaml
from cflow_torch.config import PRESETS, WINDOW
from cflow_torch.setting import describe_limits

FOLDER = Path(__file__).resolve().parents[1] / "configs" / "opensceneflow" / "model"
# The values are literals, because the harness's eval.yaml and save.yaml define no settings that they could refer to.
HEAD = """\
# CorrelationFlow, preset {preset}: hydra.searchpath=[pkg://cflow_torch.configs.opensceneflow] model={name}
# For OpenSceneFlow. Written by scripts/harness_models.py; `cflow settings` says what each setting does.
name: {name}
val_monitor: val/Dynamic/Mean
iter_only: false  # true: the runner for methods without training (needs a GPU, no checkpoint)
target:
  _target_: cflow_torch.integrations.opensceneflow.CFlow
  num_frames: {num_frames}  # sweeps per window, t+1 and t included: h + 2
  ego_T_lidar: auto  # auto | null | 4 x 4: points in the sensor frame, poses of the vehicle (Argoverse 2)
  output: full  # full | valid (by pc0_valid_point_idxes)
  device: auto  # auto = that of the batch
  voxel_size: [0.1, 0.1, 2000.0]  # the harness asks for it; without effect, pixel_sizes counts
  preset: {preset}
"""
FAR = 1000.0  # metres, replaces infinite bounds of z, because the harness computes with the bounds


def models() -> dict[str, str]:
    """Return the text of each file, except for the preset offline: the harness has no sweeps after t+1."""
    texts = {}
    for preset, config in PRESETS.items():
        if config.num_future > 0:
            continue
        name = "cflow" if preset == "default" else f"cflow_{preset}"
        text = HEAD.format(preset=preset, name=name, num_frames=config.num_history + 2)
        region = [min(max(bound, -FAR), FAR) for bound in config.point_cloud_range]
        for f in fields(config):
            value = region if f.name == "point_cloud_range" else getattr(config, f.name)
            if f.name not in ("method", *WINDOW):  # preset and num_frames replace them
                text += f"  {f.name}: {as_yaml(value)}  # {describe_limits(f.metadata)}\n"
        texts[f"{name}.yaml"] = text
    return texts


if __name__ == "__main__":
    for file, text in models().items():
        (FOLDER / file).write_text(text, encoding="utf-8")
