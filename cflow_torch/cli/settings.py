"""Prints all settings as a Markdown page: of the methods, then of the commands, data sets and other groups.

--opensceneflow FOLDER writes the model files of OpenSceneFlow's configuration instead: cflow.yaml (preset default),
cflow_fast.yaml, cflow_paper.yaml and cflow_keypoints.yaml. They are those of the package.

examples:
  cflow settings > settings.md
  cflow settings --opensceneflow conf/model
"""

from __future__ import annotations

import math
from dataclasses import fields
from pathlib import Path
from typing import Any, Iterator

import yaml  # type: ignore[import-untyped]

from cflow_torch.cli.choices import CONFIGS, files
from cflow_torch.config import CONFIGS as METHODS
from cflow_torch.config import PRESETS, WINDOW, describe, make_config
from cflow_torch.errors import CFlowError

_PAGE = """# Settings

Settings have the same names in Python, `make_config("fast", max_speed=30.0)`, on the command line, `model=fast
model.max_speed=30`, and in a sweep, `-m model.num_history=0,2,4`. null is None in Python. Words such as Alg. clustering
are labels of the paper. If a name or a value is wrong, the error message lists what is allowed."""
# The values are literals, because the harness's eval.yaml and save.yaml define nothing to refer to.
_HARNESS = """\
# CorrelationFlow, preset {preset}: hydra.searchpath=[pkg://cflow_torch.configs.opensceneflow] model={name}
# For OpenSceneFlow. Written by `cflow settings --opensceneflow FOLDER`; `cflow settings` says what each setting does.
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
"""
_Z = 1000.0  # metres; the harness computes with the region, so infinite bounds of z are replaced by this one


def task(arguments: list[str]) -> None:
    """Run `cflow settings`."""
    if not arguments:
        print("\n\n".join(_page()))
    elif len(arguments) == 2 and arguments[0] == "--opensceneflow":
        from cflow_torch.data.atomic import ensure_writable, write_text

        folder = ensure_writable(Path(arguments[1]))
        for name, text in harness_models().items():
            write_text(folder / f"{name}.yaml", text)
            print(folder / f"{name}.yaml")
    else:
        raise CFlowError(f"settings takes no arguments or --opensceneflow FOLDER, got {' '.join(arguments)}")


def harness_models() -> dict[str, str]:
    """Name -> YAML of each preset as a model of OpenSceneFlow, except offline: the harness has no sweeps after t+1."""
    models = {}
    for preset, config in ((preset, make_config(preset)) for preset in PRESETS):
        if config.num_future > 0:
            continue
        name = "cflow" if preset == "default" else f"cflow_{preset}"
        text = _HARNESS.format(preset=preset, name=name, num_frames=config.num_history + 2)
        region = [min(max(bound, -_Z), _Z) for bound in config.point_cloud_range]
        for f in fields(config):
            value = region if f.name == "point_cloud_range" else getattr(config, f.name)
            if f.name not in WINDOW:  # num_frames replaces it
                text += f"  {f.name}: {_yaml(value)}  # {describe(f)}\n"
        models[name] = text
    return models


def _page() -> Iterator[str]:
    yield _PAGE
    for method, kind in METHODS.items():
        presets = {preset: make_config(preset) for preset, (of, _) in PRESETS.items() if of == method}
        rows = ["| setting | default | presets | allowed | meaning |", "|---|---|---|---|---|"]
        for f in fields(kind):
            values = {preset: getattr(config, f.name) for preset, config in presets.items()}
            changed = ", ".join(f"{p} `{_yaml(v)}`" for p, v in values.items() if v != f.default)
            cells = [f"`model.{f.name}`", f"`{_yaml(f.default)}`", changed, describe(f), f.metadata["help"]]
            rows.append(f"| {' | '.join(cell.replace('|', chr(92) + '|') for cell in cells)} |")
        yield f"## Method `{method}`: {', '.join(f'model={preset}' for preset in presets)}"
        yield "\n".join(rows)
    commands = [file for file in sorted(CONFIGS.glob("*.yaml")) if file.stem != "hydra"]
    in_groups = [file for group in sorted(CONFIGS.glob("*/")) for file in files(group.name)]
    for file in commands + in_groups:
        yield f"## {f'cflow {file.stem}' if file in commands else f'{file.parent.name}={file.stem}'}"
        yield f"```yaml\n{file.read_text(encoding='utf-8').strip()}\n```"


def _yaml(value: Any) -> str:
    value = list(value) if isinstance(value, tuple) else value
    return yaml.safe_dump([value], default_flow_style=True, width=math.inf).strip()[1:-1]  # type: ignore[no-any-return]
