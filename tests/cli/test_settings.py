"""Settings of the commands: presets, groups, types, names, and the pages that list them."""

from __future__ import annotations

import shlex
from dataclasses import fields
from pathlib import Path
from typing import Callable

import pytest
from hydra.core.override_parser.overrides_parser import OverridesParser
from omegaconf import OmegaConf

from cflow_torch import make_config
from cflow_torch.cli.choices import FOLDER, choices, read_settings
from cflow_torch.cli.commands import COMMANDS, WITH_SETTINGS, Flow, Plot
from cflow_torch.cli.main import HELP
from cflow_torch.cli.settings import help_of
from cflow_torch.cli.track_formats import TRACK_FORMATS
from cflow_torch.cli.words import hydra_overrides, read_call, split
from cflow_torch.config import METHODS, PRESETS, Config
from cflow_torch.data.catalog import DATA_SETS


@pytest.mark.parametrize("preset", PRESETS)
def test_a_preset_is_the_same_as_in_python(preset, compose):
    assert Config.of(OmegaConf.to_container(compose("eval", f"model={preset}").model)) == make_config(preset)


def test_every_choice_of_every_group_composes(compose):
    """All choices with the first command that has their group; other tests call the other commands."""
    tested: set[str] = {"row", "experiment"}  # see test_experiments.py
    for command, kind in WITH_SETTINGS.items():
        of_groups = {group: choices(group) for group in kind.groups() if group not in ("row", "experiment")}
        of_groups = {group: names[:1] if group in tested else names for group, names in of_groups.items()}
        if tested >= set(of_groups):
            continue
        tested.update(of_groups)
        for number in range(max(map(len, of_groups.values()))):
            call = {group: names[number % len(names)] for group, names in of_groups.items()}
            cfg = compose(command, *(f"{group}={name}" for group, name in call.items()))
            assert call.items() <= dict(cfg.hydra.runtime.choices).items()
            OmegaConf.set_struct(cfg, False)
            del cfg["hydra"]
            assert isinstance(kind.of(OmegaConf.to_container(cfg, resolve=True)), kind)


def test_examples_use_existing_settings_and_choices():
    lines = [line for text in (HELP, *map(help_of, COMMANDS)) for line in text.splitlines()]
    lines = [line for line in lines if line.startswith("  cflow ")]
    assert len(lines) > 30
    for command, *words in (shlex.split(line.strip().partition("   ")[0])[1:] for line in lines):
        if command in WITH_SETTINGS:
            call = split([word for word in words if word != "..."])
            read_call([*call.settings, *call.options], command)
            OverridesParser.create().parse_overrides(hydra_overrides(WITH_SETTINGS[command], call))


@pytest.mark.parametrize(
    "words",
    [
        "data=benchmark_sensors data.profile=waymo",
        "model=paper_keypoints model.densify=nearest",
        "-m model=paper,default model.connectivity=4",
        "experiment=keypoints model.densify=nearest",
        "model=choice(paper,keypoints) model.connectivity=4",
    ],
)
def test_settings_of_chosen_groups_are_known(words):
    read_call(words.split(), "eval")


def test_the_format_of_a_path_may_have_any_setting():
    """data=auto lists the settings of all formats that it recognises."""
    of_formats = {name for name in DATA_SETS if DATA_SETS[name].marks or name == "arrays"}
    names = {name for one in (*of_formats, "synthetic") for name in read_settings(FOLDER / "data" / f"{one}.yaml")}
    assert set(read_settings(FOLDER / "data" / "auto.yaml")) == names


@pytest.fixture
def mine(tmp_path: Path) -> Callable[[str], Path]:
    """A folder with a preset model/mine.yaml of this text."""

    def write(text: str) -> Path:
        (tmp_path / "model").mkdir()
        (tmp_path / "model" / "mine.yaml").write_text(text)
        return tmp_path

    return write


def test_your_own_preset_contains_only_its_changes(mine, cflow, capsys):
    folder = mine("defaults: [default, _self_]\nnum_history: 3\n")
    call = ("eval", "--config-dir", folder, "model=mine", "model.max_speed=20", "--cfg", "job", "-p", "model")
    assert cflow(*call) == 0
    given = OmegaConf.create(capsys.readouterr().out)
    assert given == OmegaConf.create(make_config(num_history=3, max_speed=20.0).as_dict())


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("defaults: [paper, _self_]\nsignificance: 2\n", "significance is a setting of method verified"),
        ("defaults: [default, _self_]\nthorough: false\n", "unknown setting thorough: the fields are"),
        (
            "method: verified\nmax_object: 20\n",
            "unknown setting max_object (did you mean max_object_length?): the fields are",
        ),
        (
            "defaults: [paper, _self_]\nnum_history: many\n",
            "num_history='many': give a whole number of at least 0",
        ),
        ("num_history: 3\n", "method=None: give one of"),
    ],
)
def test_a_wrong_preset_is_one_line(text, message, mine, cflow, capsys):
    assert cflow("eval", "--config-dir", mine(text), "model=mine", "data.num_sweeps=2") == 2
    error = capsys.readouterr().err
    assert error.startswith("error: ") and message in error and error.count("\n") == 1


@pytest.mark.parametrize(
    "name",
    [
        "10203656353524179475_7625_000_7645_000",
        "1e5",
        "2024_11_22",
        "-1.5",
        "true",
        "a_1",
        "/a/b-c.d",
        "x y",
        "NaN",
        "Ausgänge/東京",
        'it\'s "ü"',
    ]
    + ["a (1)", "x=y", "s3://bucket/a", "C:\\data", "C:\\data\\", '\\\\host\\a \\"b\\\\', "50%", "a#b"],
)
def test_names_are_text_even_if_they_look_like_numbers(name):
    overrides = hydra_overrides(Plot, split([f"log={name}", f"+data.root={name}", "pair=1"]))
    read = OverridesParser.create().parse_overrides(overrides)
    assert [override.value() for override in read] == [name, name, 1]


def test_hydra_syntax_in_names_keeps_its_meaning(compose):
    def words(*given: str) -> list[str]:
        return hydra_overrides(Plot, split(list(given)))

    cfg = compose("plot", *words("log=null", "output=${device}"))
    assert cfg.log is None and cfg.output == "auto"
    assert words("-m", "log=1_0,b,2_0", "pair=1,2") == ['log="1_0",b,"2_0"', "pair=1,2"], "a job's folder has no quotes"
    assert words("log=[a,b]", "log=a,NaN") == ["log=[a,b]", 'log=a,"NaN"']
    assert words("log=choice(a,b)", "log='1_0'") == ["log=choice(a,b)", "log='1_0'"]


def test_tracks_has_the_formats_that_are_written():
    (tracks,) = (f for f in fields(Flow) if f.name == "tracks")
    assert set(tracks.metadata["choices"]) == {True, False, *TRACK_FORMATS}


def test_the_page_lists_every_setting(cflow, capsys):
    assert cflow("settings") == 0
    page = capsys.readouterr().out
    rows = [line[2:-2].split(" | ") for line in page.splitlines() if line.startswith("| `model.")]
    assert len(rows) == sum(len(fields(kind)) for kind in METHODS.values())
    name, *cells = next(row for row in reversed(rows) if row[0] == "`model.num_history`")
    changed = "default `4`, offline `4`, live `4`"
    assert cells[:3] == ["`0`", changed, "a whole number of at least 0"] and "sweeps" in cells[3]
    assert "dense \\| keypoints" in page, "bars in cells are escaped"
    sections = dict(section.split("\n\n", 1) for section in page.split("\n## ")[1:])
    for file in FOLDER.glob("data/[a-z]*.yaml"):
        section = sections[f"data={file.stem}"].splitlines()
        assert set(file.read_text().splitlines()) - {"defaults:", "  - _log", ""} <= set(section)
        assert "data=_log" not in sections and section.count("step: 1  # cflow eval and view: every n-th pair") < 2
    assert "\nfind_ground: auto  # ground" in sections["data=av2"]


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        (
            "max_speed",
            [
                "Method `dense`: model=paper, Method `keypoints`: model=keypoints, model=paper_keypoints:",
                "default `60.0`, offline `60.0`, live `60.0`",
            ],
        ),
        ("shard.index", ["cflow flow, cflow label:\n  index: auto  # index of this process"]),
        ("data", ["data=av2 ", "data=hdf5 "]),
        ("offline", ["## Method `verified`", "| `model.significance` | `1.5` |"]),
        ("flow", ["## cflow flow", "contents: ", "cflow clean:\n  flow: null  # output folder of `cflow flow`"]),
    ],
)
def test_settings_explains_one_name(name, expected, cflow, capsys):
    assert cflow("settings", name) == 0
    text = capsys.readouterr().out
    assert all(part in text for part in expected) and len(text) < 4500
    assert cflow("settings", "max_sped") == 2
    assert "nothing has this name (did you mean model.max_speed?)" in capsys.readouterr().err
