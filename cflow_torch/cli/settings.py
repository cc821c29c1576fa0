"""Prints all settings as a Markdown page: of the methods, then of the commands, data sets and other groups.

With names, it prints only these: a setting, a preset, a command, a group or one of its choices.

--opensceneflow FOLDER writes the model files of OpenSceneFlow's configuration instead: cflow.yaml (preset default),
cflow_paper.yaml and cflow_keypoints.yaml. The package contains the same files.

examples:
  cflow settings max_speed          default, allowed values and meaning of a setting
  cflow settings data.find_ground   a setting of several data sets
  cflow settings data               the choices of a group
  cflow settings data=hdf5 eval     all settings of a data set and of a command
  cflow settings > settings.md
  cflow settings --opensceneflow conf/model
"""

from __future__ import annotations

import math
import re
from dataclasses import fields
from pathlib import Path
from typing import Any, Iterator

import yaml  # type: ignore[import-untyped]

from cflow_torch.cli.choices import CONFIGS, files, near, settings
from cflow_torch.config import CONFIGS as METHODS
from cflow_torch.config import PRESETS, WINDOW, make_config
from cflow_torch.errors import CFlowError
from cflow_torch.setting import describe

_PAGE = """# Settings

Settings have the same names in Python, `make_config("paper", max_speed=30.0)`, on the command line, `model=paper
model.max_speed=30`, and in a sweep, `-m model.num_history=0,2,4`. null is None in Python. Words such as Alg. clustering
are labels of the paper. If a name or a value is wrong, the error message lists what is allowed."""
# The values are literals, because the harness's eval.yaml and save.yaml define no settings that they could refer to.
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
_COMMANDS = sorted(file.stem for file in CONFIGS.glob("*.yaml") if file.stem != "hydra")
_Z = 1000.0  # metres, replaces infinite bounds of z, because the harness computes with the bounds


def task(arguments: list[str]) -> None:
    if not arguments:
        sections = (f"## {title}\n\n" + "\n".join(lines) for _, title, lines in _sections())
        print("\n\n".join([_PAGE, *sections]))
    elif len(arguments) == 2 and arguments[0] == "--opensceneflow":
        from cflow_torch.data.atomic import ensure_writable, write_text

        folder = ensure_writable(Path(arguments[1]))
        for name, text in harness_models().items():
            write_text(folder / f"{name}.yaml", text)
            print(folder / f"{name}.yaml")
    elif any(word.startswith("-") for word in arguments):
        raise CFlowError(f"settings takes names or --opensceneflow FOLDER, got {' '.join(arguments)}")
    else:
        print("\n\n".join(text for name in arguments for text in _about(name)))


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
                text += f"  {f.name}: {_yaml(value)}  # {describe(f.metadata)}\n"
        models[name] = text
    return models


def _sections() -> Iterator[tuple[list[str], str, list[str]]]:
    """Yield the sections of the page: names, title and lines."""
    for method, kind in METHODS.items():
        presets = {preset: make_config(preset) for preset, (of, _) in PRESETS.items() if of == method}
        rows = ["| setting | default | presets | allowed | meaning |", "|---|---|---|---|---|"]
        for f in fields(kind):
            values = {preset: getattr(config, f.name) for preset, config in presets.items()}
            changed = ", ".join(f"{p} `{_yaml(v)}`" for p, v in values.items() if v != f.default)
            cells = [f"`model.{f.name}`", f"`{_yaml(f.default)}`", changed, describe(f.metadata), f.metadata["help"]]
            rows.append(f"| {' | '.join(cell.replace('|', chr(92) + '|') for cell in cells)} |")
        chosen = [f"model={preset}" for preset in presets]
        yield [method, *presets, *chosen, "model"], f"Method `{method}`: {', '.join(chosen)}", rows
    chosen_files = [file for group in sorted(CONFIGS.glob("*/")) for file in files(group.name)]
    for file in [*(CONFIGS / f"{command}.yaml" for command in _COMMANDS), *chosen_files]:
        name = file.stem if file.parent == CONFIGS else f"{file.parent.name}={file.stem}"
        text = file.read_text(encoding="utf-8").strip()
        yield [name], name if "=" in name else f"cflow {name}", ["```yaml", *text.splitlines(), "```"]


def _about(name: str) -> list[str]:
    """Return the sections of this name, the first lines of the choices of a group, and the lines of a setting."""
    group, _, setting = name.rpartition(".")
    own_line = re.compile(rf"(\| `model\.| *){re.escape(setting)}(`|:)")
    found: list[str] = []
    choices: list[str] = []
    titles_of: dict[str, list[str]] = {}  # line of a setting -> sections
    for names, title, lines in _sections():
        if name in names:
            found.append("\n".join([f"## {title}", "", *lines]))
        elif title.startswith(f"{name}="):
            choices.append(f"{title:28} {next(line[2:] for line in lines if re.match('# [^@]', line))}")
        elif group in ("", "model", title.partition("=")[0]) or any(line.startswith(f"{group}:") for line in lines):
            for line in filter(own_line.match, lines):
                titles_of.setdefault(line.strip(), []).append(title)
    found += ["\n".join(choices)] if choices else []
    found += [f"{', '.join(titles)}:\n  {line}" for line, titles in titles_of.items()]
    if not found:
        known = [key for command in _COMMANDS for key in settings(command)]
        known += [one for names, *_ in _sections() for one in names]
        raise CFlowError(f"settings {name}: nothing has this name{near(name, known)}; `cflow settings` lists all")
    return found


def _yaml(value: Any) -> str:
    value = list(value) if isinstance(value, tuple) else value
    return yaml.safe_dump([value], default_flow_style=True, width=math.inf).strip()[1:-1]  # type: ignore[no-any-return]
