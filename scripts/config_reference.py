#!/usr/bin/env python3
"""Write docs/configuration.md: every setting of the method, of the commands, of data sets, engines and experiments.

  python scripts/config_reference.py            # writes the page, if it changes
  python scripts/config_reference.py --check    # exit status 1 if the page is not what this would write

Nothing is written by hand twice: fields, types and defaults come from `Config`, their descriptions from its docstring,
presets from `PRESETS`; the rest from the YAML files and the comments in them.
"""

from __future__ import annotations

import argparse
import inspect
import re
import sys
from dataclasses import MISSING, fields
from pathlib import Path
from typing import Any, Dict, Iterator, List, Sequence

ROOT = Path(__file__).resolve().parent.parent
if str(ROOT) not in sys.path:
    sys.path.insert(0, str(ROOT))

from config_files import Key, bases, heading, keys, sweeps  # noqa: E402
from config_limits import GROUPS, LIMITS  # noqa: E402

from cflow_torch.config import PRESETS, Config  # noqa: E402

PAGE = ROOT / "docs" / "configuration.md"
CONFIGS = ROOT / "configs"
# The order of the page; what is not named here comes last, by name.
COMMAND_ORDER = ("demo", "flow", "eval", "submit", "bench", "plot", "view")
FOLDERS = ("data", "engine", "picture", "experiment")
# What a key means wherever its file has no comment for it.
PLAIN: Dict[str, str] = {
    "name": "name of this choice; leave it as it is",
    "root": "file or folder, or the address of one in an object store (docs/storage.md); must be given",
    "device": "auto = a GPU if there is one, else the CPU; cpu, cuda or cuda:1",
    "output": "folder for what the command writes",
    "overwrite": "true: replace what an earlier run left there",
    "definition": "whose evaluation, see docs/evaluation.md",
    "repeats": "runs that are timed",
    "reference": "also time the reference in NumPy loops",
    "opencv": "also time the loop over clusters in OpenCV (extra bench)",
    "seed": "of the simulation: another number, another drive",
    "num_sweeps": "sweeps of the drive",
    "cache": "folder where made drives are kept; the environment variable CFLOW_CACHE moves it",
    "scenes": "kinds of simulated scene, in turn",
    "num_drives": "drives per sensor",
    "first": "first pair that is scored",
    "step": "every how many pairs are scored",
    "first_seed": "of the first drive; the next ones count up",
    "frames_per_second": "of the animation",
    "label": "what tables call it",
    "workers": "processes",
}
HEAD = """# Configuration

Every setting, its values and its default. This page is made by `python scripts/config_reference.py` from the code and
the YAML files; do not edit it.

The same names hold everywhere:

```python
from cflow_torch import CorrelationFlow, estimate_flow, make_config

result = estimate_flow(pc0, pc1, preset="fast", num_history=0, max_speed=30.0)  # fields of Config as keywords
model = CorrelationFlow(make_config("paper", pixel_size=0.2))  # pixel_size=s is short for pixel_sizes=(s,)
```

```bash
cflow eval model=fast model.max_speed=30.0      # model= chooses a preset, model.FIELD= changes a field
cflow eval -m model.connectivity=4,8            # a sweep
```

A wrong value or name is refused with a message that says what is allowed. `cflow eval --cfg job` prints what a command
would run with.
"""
METHOD = """\
Fields of `cflow_torch.Config`; on the command line `model.` stands before them. Defaults are those of `Config()`, which
is the preset `paper`; the column of presets says where another one differs. null is None in Python. Words such as
Alg. clustering are labels of the paper: [method.md](method.md)."""
COMMANDS = """\
`model=`, `data=` and `engine=` choose a file of that group, whose settings then have the group's name in front, such as
`data=hdf5 data.root=/data/scenes`."""
EXPERIMENTS = """\
Tables and figures of the paper, for cflow eval -m: [experiments.md](experiments.md). All start from `model=paper` and
`data=benchmark`. A row is a set of values for `model.`."""


def descriptions() -> Dict[str, str]:
    """Field of `Config` -> its text in the docstring's Args, on one line."""
    lines = inspect.getdoc(Config).split("\n")  # type: ignore[union-attr]
    found: Dict[str, str] = {}
    name = ""
    for line in lines[lines.index("Args:") + 1 :]:
        start = re.match(r"    (\w+): (.*)", line)
        if start:
            name, found[start[1]] = start[1], start[2]
        elif line.startswith("        ") and name:
            found[name] += " " + line.strip()
    return found


def written(value: Any) -> str:
    """A value as YAML has it."""
    if value is None or isinstance(value, bool):
        return {None: "null", True: "true", False: "false"}[value]
    if isinstance(value, (list, tuple)):
        return "[" + ", ".join(written(v) for v in value) + "]"
    return str(value).replace("inf", ".inf")


def cell(text: str) -> str:
    """Text that may stand in a table."""
    return text.replace("|", "\\|")


def table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> List[str]:
    """Lines of a table."""
    lines = ["| " + " | ".join(head) + " |", "|" + "---|" * len(head)]
    return lines + ["| " + " | ".join(map(cell, row)) + " |" for row in rows]


def method_rows(names: Sequence[str]) -> List[List[str]]:
    """A row for each of these fields of `Config`."""
    text = descriptions()
    known = {field.name: field for field in fields(Config)}
    rows = []
    for name in names:
        default = known[name].default
        assert default is not MISSING
        others: Dict[str, List[str]] = {}
        for preset, changed in PRESETS.items():
            if name in changed:
                others.setdefault(written(changed[name]), []).append(preset)
        in_presets = "; ".join(f"{', '.join(presets)} `{value}`" for value, presets in others.items())
        rows.append([f"`{name}`", LIMITS[name].text, f"`{written(default)}`", in_presets, text[name]])
    return rows


def key_row(key: Key) -> List[str]:
    """A row of a table."""
    group, _, last = key.name.rpartition(".")
    meaning = "changes this field of the method" if group == "model" else PLAIN.get(last, "")
    return [f"`{key.name}`", f"`{key.value}`", key.comment or meaning]


def in_order(files: Sequence[Path], order: Sequence[str]) -> List[Path]:
    """Files by the place of their name in `order`, then by name."""
    return sorted(files, key=lambda f: (order.index(f.stem) if f.stem in order else len(order), f.stem))


def method_part() -> Iterator[str]:
    """Fields of `Config`."""
    yield "## The method"
    yield ""
    yield METHOD
    for title, names in GROUPS.items():
        yield f"\n### {title}\n"
        yield from table(("setting", "values", "default", "presets", "meaning"), method_rows(names))


def command_part() -> Iterator[str]:
    """configs/*.yaml."""
    yield "\n## Commands\n"
    yield COMMANDS
    files = [file for file in CONFIGS.glob("*.yaml") if file.stem != "hydra"]
    for file in in_order(files, COMMAND_ORDER):
        yield f"\n### cflow {file.stem}\n"
        chosen = [base for base in bases(file) if not base.endswith("=null")]
        yield f"{sentence(heading(file), file)} Starts from " + ", ".join(f"`{base}`" for base in chosen) + ".\n"
        yield from table(("setting", "default", "meaning"), [key_row(key) for key in keys(file)])


def sentence(text: str, file: Path) -> str:
    """The heading of a command's file without the command's name in front."""
    text = re.sub(rf"^cflow {file.stem}: ", "", text)
    return text[:1].upper() + text[1:]


def is_name(key: Key, file: Path) -> bool:
    """Whether a key only says what the file is called."""
    return key.name in ("name", "label", file.parent.name) and key.value == file.stem


def shared_keys(files: Sequence[Path]) -> List[Key]:
    """Keys that most of the files have, with the same value and comment, in the order of the first file with all."""
    lists = [list(keys(file)) for file in files]
    longest = max(lists, key=lambda found: sum(sum(key in other for other in lists) for key in found))
    return [key for key in longest if sum(key in found for found in lists) > len(lists) / 2]


def group_part(folder: str) -> Iterator[str]:
    """configs/<folder>/*.yaml: what most of them have once, then what each has of its own."""
    titles = {"data": "Data sets", "engine": "Engines", "picture": "Pictures"}
    yield f"\n## {titles.get(folder, folder.capitalize())}"
    files = sorted((CONFIGS / folder).glob("*.yaml"))
    shared = shared_keys(files) if len(files) > 2 else []
    if shared:
        yield "\nMost of them have, beside `label`, what tables call them,"
        yield ""
        yield from table(("setting", "default", "meaning"), [key_row(key) for key in shared])
    for file in files:
        own = [key for key in keys(file) if key not in shared and not is_name(key, file)]
        lacks = [f"`{key.name}`" for key in shared if key not in list(keys(file))]
        yield f"\n### {folder}={file.stem}\n"
        yield heading(file)
        if bases(file):
            yield "\nStarts from " + ", ".join(f"`{base}`" for base in bases(file)) + "."
        elif lacks and len(lacks) < len(shared):
            yield "\nWithout " + ", ".join(lacks) + "."
        if own:
            yield ""
            yield from table(("setting", "default", "meaning"), [key_row(key) for key in own])


def experiment_part() -> Iterator[str]:
    """configs/experiment/*.yaml, one row each."""
    yield "\n## Experiments\n"
    yield EXPERIMENTS
    yield ""
    rows = []
    for file in sorted((CONFIGS / "experiment").glob("*.yaml")):
        named = [f"`{key.name}={key.value}`" for key in keys(file) if key.name.startswith("rows.")]
        swept = [f"`{entry}`" for entry in sweeps(file)] or [f"as `experiment={base}`" for base in bases(file)]
        rows.append([f"`{file.stem}`", heading(file), "; ".join(swept), "; ".join(named)])
    yield from table(("experiment", "what", "sweeps over", "rows"), rows)


def harness_part() -> Iterator[str]:
    """What the files for OpenSceneFlow have beside the fields of `Config`."""
    file = CONFIGS / "opensceneflow" / "model" / "cflow.yaml"
    own = {field.name for field in fields(Config)}
    rows = [row for row in map(key_row, keys(file)) if row[0].strip("`").split(".")[-1] not in own]
    rows = [[*row[:2], row[2] or "asked for by the harness; leave it as it is"] for row in rows]
    yield "\n## Inside OpenSceneFlow\n"
    yield "`model=cflow` and `model=cflow_keypoints`: the fields of `Config` are below `model.target.`, and"
    yield ""
    yield from table(("setting", "default", "meaning"), rows)
    yield "\nMore: [harness.md](harness.md)."


def page() -> str:
    """The whole page."""
    lines = [HEAD, *method_part(), *command_part()]
    folders = [folder.name for folder in CONFIGS.iterdir() if folder.is_dir() and list(folder.glob("*.yaml"))]
    for folder in sorted(folders, key=lambda f: (FOLDERS.index(f) if f in FOLDERS else len(FOLDERS), f)):
        if folder == "experiment":
            lines += experiment_part()
        elif folder != "model":
            lines += group_part(folder)
    lines += harness_part()
    return "\n".join(lines) + "\n"


def main() -> int:
    """Returns the exit status."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])  # type: ignore[union-attr]
    parser.add_argument("--check", action="store_true", help="write nothing; exit status 1 if the page is stale")
    arguments = parser.parse_args()
    wanted = page()
    is_stale = not PAGE.is_file() or PAGE.read_text(encoding="utf-8") != wanted
    if arguments.check:
        if is_stale:
            print("docs/configuration.md is stale: run python scripts/config_reference.py", file=sys.stderr)
        return int(is_stale)
    if is_stale:
        PAGE.write_text(wanted, encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
