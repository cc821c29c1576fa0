"""List all settings, or write them for OpenSceneFlow: `cflow settings`."""

from __future__ import annotations

import re
from dataclasses import fields
from pathlib import Path
from typing import Iterator, NamedTuple

from cflow_torch.cli.choices import FOLDER, files, known_settings
from cflow_torch.cli.commands import ENGINES, PICTURES, WITH_SETTINGS, Plot, as_yaml, setting_lines
from cflow_torch.config import METHODS, PRESETS, WINDOW
from cflow_torch.errors import CFlowError, near
from cflow_torch.setting import describe_limits

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
  preset: {preset}
"""
_IN_FILES = ("data", "experiment", "row")  # groups whose choices are YAML files
_Z = 1000.0  # metres, replaces infinite bounds of z, because the harness computes with the bounds


def task(arguments: list[str]) -> None:
    if not arguments:
        sections = (f"## {title}\n\n" + "\n".join(lines) for title, lines, _ in _sections())
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
    for preset, config in PRESETS.items():
        if config.num_future > 0:
            continue
        name = "cflow" if preset == "default" else f"cflow_{preset}"
        text = _HARNESS.format(preset=preset, name=name, num_frames=config.num_history + 2)
        region = [min(max(bound, -_Z), _Z) for bound in config.point_cloud_range]
        for f in fields(config):
            value = region if f.name == "point_cloud_range" else getattr(config, f.name)
            if f.name not in ("method", *WINDOW):  # preset and num_frames replace them
                text += f"  {f.name}: {as_yaml(value)}  # {describe_limits(f.metadata)}\n"
        models[name] = text
    return models


class Section(NamedTuple):
    """A section of the page. `cflow settings` finds it by its title or one of its `names`."""

    title: str
    lines: list[str]
    names: tuple[str, ...] = ()


def _sections() -> Iterator[Section]:
    """Yield the sections of the page: methods, commands, engines, pictures, and the choices in YAML files."""
    for method in METHODS:
        presets = [preset for preset, config in PRESETS.items() if config.method == method]
        chosen = [f"model={preset}" for preset in presets]
        title = f"Method `{method}`: {', '.join(chosen)}"
        yield Section(title, _method_table(method, presets), (method, *presets, *chosen, "model"))
    for name, command in WITH_SETTINGS.items():
        yield Section(f"cflow {name}", _block(f"cflow {name}: {command.SUMMARY}.", setting_lines(command)), (name,))
    for name, engine in ENGINES.items():
        yield Section(f"engine={name}", _block(str(engine.__doc__), setting_lines(engine)))
    for name, picture in PICTURES.items():
        about = str(picture.__doc__).partition("\n")[0]
        yield Section(f"picture={name}", _block(about, setting_lines(picture, Plot)))
    of_all = (FOLDER / "data" / "_log.yaml").read_text(encoding="utf-8").partition("\n")[2]
    for group in _IN_FILES:
        for file in files(group):
            about, extends, own = file.read_text(encoding="utf-8").partition("defaults:\n  - _log\n\n")
            text = f"{about}{own}{of_all}" if extends else about
            yield Section(f"{group}={file.stem}", ["```yaml", *text.strip().splitlines(), "```"])


def _method_table(method: str, presets: list[str]) -> list[str]:
    """Return the rows of a table of all settings of a method."""
    rows = ["| setting | default | presets | allowed | meaning |", "|---|---|---|---|---|"]
    for f in fields(METHODS[method]):
        values = {preset: getattr(PRESETS[preset], f.name) for preset in presets}
        changed = [f"{preset} `{as_yaml(value)}`" for preset, value in values.items() if value != f.default]
        default = f"`{as_yaml(f.default)}`"
        cells = [f"`model.{f.name}`", default, ", ".join(changed), describe_limits(f.metadata), f.metadata["help"]]
        rows.append(f"| {' | '.join(cell.replace('|', chr(92) + '|') for cell in cells)} |")
    return rows


def _block(about: str, lines: Iterator[str]) -> list[str]:
    return ["```yaml", f"# {about}", *lines, "```"]


def _about(name: str) -> list[str]:
    """Return the sections of this name, the first lines of the choices of a group, and the lines of a setting."""
    whole: list[str] = []
    choices: list[str] = []
    titles_of: dict[str, list[str]] = {}  # line of a setting -> sections
    for section in _sections():
        if name in (section.title, *section.names):
            whole.append("\n".join([f"## {section.title}", "", *section.lines]))
        elif section.title.startswith(f"{name}="):
            about = next(line[2:] for line in section.lines if re.match("# [^@]", line))
            choices.append(f"{section.title:28} {about}")
        else:
            for line in _lines_of(name, section):
                titles_of.setdefault(line.strip(), []).append(section.title)
    single = [f"{', '.join(titles)}:\n  {line}" for line, titles in titles_of.items()]
    found = [*whole, *(["\n".join(choices)] if choices else []), *single]
    if not found:
        known = [key for command in WITH_SETTINGS.values() for key in known_settings(command)]
        known += [one for section in _sections() for one in (section.title, *section.names)]
        raise CFlowError(f"settings {name}: nothing has this name{near(name, known)}; `cflow settings` lists all")
    return found


def _lines_of(name: str, section: Section) -> Iterator[str]:
    """Yield the lines of a section that define a setting."""
    group, _, own = name.rpartition(".")
    is_near = group in ("", "model", section.title.partition("=")[0])
    if is_near or any(line.startswith(f"{group}:") for line in section.lines):
        yield from filter(re.compile(rf"(\| `model\.| *){re.escape(own)}(`|:)").match, section.lines)
