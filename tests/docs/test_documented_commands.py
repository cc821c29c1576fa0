"""Every command and every Python block of README, docs and notebooks is run, on tiny simulated data.

`documented_commands.py` finds them, `documented_places.py` makes the data they name, `documented_rules.py` says which
are made smaller and which cannot run here. A new command needs a rule only if it fails or takes long as it stands.
"""

from __future__ import annotations

import importlib.util
import os
import re
import runpy
import shlex
import subprocess
import sys
from pathlib import Path
from typing import Any, Dict, Iterator, List, Set, Tuple

import pytest
import torch
from documented_commands import (
    ROOT,
    Snippet,
    command_blocks,
    commands,
    commands_without_language,
    python_blocks,
)
from documented_places import Places, namespace
from documented_rules import BLOCK_NEEDS, KINDS_NOT_RUN, NOT_RUN, SHRUNK, SLOW_BLOCKS, reason_not_run, rules_of
from hydra import compose, initialize_config_module
from omegaconf import OmegaConf

from cflow_torch import CFlowError
from cflow_torch.cli.main import COMMANDS, main

pytest.importorskip("h5py", reason="half of the commands read HDF5 scenes")
if not (ROOT / "docs").is_dir():
    pytest.skip("the documents are not beside the tests", allow_module_level=True)

ALL = commands()
RUN = [snippet for snippet in ALL if not (reason_not_run(snippet.text) or snippet.is_mention or snippet.is_script)]
REST = [snippet for snippet in ALL if snippet not in RUN]
# Files with these endings that a command names are files that it makes.
MADE = (".png", ".gif", ".mp4", ".rrd", ".ckpt", ".md", ".pdf")
# What each command leaves below its output folder.
LEFT = {
    "demo": ("flow.png", "results.json", "config.yaml"),
    "flow": ("manifest.json", "config.yaml", "*/*.feather"),
    "eval": ("**/results.json", "**/config.yaml"),
    "submit": ("v*.zip",),
    "bench": ("bench.json",),
    "plot": ("*.*",),
    "view": ("*.rrd", "config.yaml"),
}


@pytest.fixture(scope="session")
def places(tmp_path_factory: pytest.TempPathFactory) -> Places:
    return Places(tmp_path_factory.mktemp("places"))


@pytest.fixture(scope="session")
def programs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder for PATH: `python` and `cflow` are those of this test."""
    folder = tmp_path_factory.mktemp("bin")
    for name, call in (
        ("python", ""),
        ("cflow", " -m cflow_torch.cli.main"),
        ("torchrun", " -m torch.distributed.run"),
    ):
        (folder / name).write_text(f'#!/bin/sh\nexec "{sys.executable}"{call} "$@"\n')
        (folder / name).chmod(0o755)
    return folder


@pytest.fixture(scope="session")
def cache(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Simulated drives, made once."""
    return tmp_path_factory.mktemp("cache")


@pytest.fixture
def home(tmp_path: Path, cache: Path, programs: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """An empty folder to be in, as a reader begins; what is run here also finds the checkout."""
    (tmp_path / "docs" / "benchmarks").mkdir(parents=True)  # where commands of the repository put pictures
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("CFLOW_CACHE", str(cache))
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(ROOT), *os.environ.get("PYTHONPATH", "").split(os.pathsep)]))
    monkeypatch.setenv("PATH", f"{programs}{os.pathsep}{os.environ['PATH']}")
    monkeypatch.setenv("USER", os.environ.get("USER") or "reader")
    monkeypatch.setattr(sys, "argv", list(sys.argv))
    threads = torch.get_num_threads()
    yield tmp_path
    torch.set_num_threads(threads)


def name_of(snippet: Snippet) -> str:
    return f"{snippet.file}:{snippet.line}:{snippet.text.splitlines()[0][:60]}"


def marked(snippet: Snippet) -> Any:
    slow = any(rule.slow for rule in rules_of(snippet.text))
    return pytest.param(snippet, id=name_of(snippet), marks=[pytest.mark.slow] if slow else [])


def run_cflow(words: List[str], expected: int = 0) -> None:
    """A cflow command in this process."""
    try:
        main(words)
        status = 0
    except SystemExit as stop:
        status = int(stop.code or 0)
    assert status == expected, f"status {status} of cflow {shlex.join(words)}"


def run(text: str) -> None:
    """One command line."""
    if text.startswith("cflow "):
        run_cflow(shlex.split(text)[1:])
        return
    text = re.sub(r"(?<![\w/])(scripts|tests)/", rf"{ROOT}/\1/", text)
    text = re.sub(rf"^{ROOT}/scripts/\S+\.py", r"python \g<0>", text)
    done = subprocess.run(["bash", "-euo", "pipefail", "-c", text], capture_output=True, text=True)
    assert done.returncode == 0, f"status {done.returncode} of {text}\n{done.stdout[-3000:]}\n{done.stderr[-3000:]}"


def assert_promises(text: str, home: Path) -> None:
    """What the command names, or writes by default, is there."""
    words = shlex.split(text)
    for word in words:
        name = word.rpartition("=")[2]
        if name.endswith(MADE):
            assert (home / name).is_file() and (home / name).stat().st_size, f"{name} was not made"
    command = words[1] if words[0] == "cflow" else ""
    if command not in LEFT or {"--cfg", "--help", "dry_run=true"} & set(words) or "archive=" in text:
        return
    given = [word.partition("=")[2] for word in words if word.startswith("output=")]
    folder = Path(home, given[-1].replace("file://", "") if given else f"outputs/{command}")
    for pattern in LEFT[command]:
        assert list(folder.glob(pattern)), f"{folder} lacks {pattern}: {sorted(folder.rglob('*'))[:20]}"


@pytest.mark.parametrize("snippet", [marked(snippet) for snippet in RUN])
def test_command(snippet: Snippet, home: Path, places: Places) -> None:
    text = snippet.text
    for rule in rules_of(snippet.text):
        if rule.needs and importlib.util.find_spec(rule.needs.partition(".")[0]) is None:
            pytest.skip(f"{rule.needs} is not installed")
        if rule.needs:
            pytest.importorskip(rule.needs, reason=f"{rule.needs} is not installed")
        for command in rule.before:
            run(places.fill(command))
        for old, new in rule.replace:
            assert old in text, f"{old!r} of a rule is not in {text!r}"
            text = text.replace(old, new)
        text = f"{text} {rule.add}".strip()
    text = places.fill(os.path.expandvars(text))
    run(text)
    assert_promises(text, home)


@pytest.mark.parametrize("snippet", REST, ids=name_of)
def test_command_that_is_not_run(snippet: Snippet, home: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Settings are composed, scripts asked for help, shell is parsed; named files, extras and models exist."""
    text = snippet.text
    subprocess.run(["bash", "-n", "-c", text], check=True)
    if snippet.is_script:
        return  # its commands are run
    words = [word for word in snippet.words if word != "..."]
    for name in re.findall(r"(?:^|[ /])((?:scripts|tests|\.ci)/[\w./]+)", text):
        assert (ROOT / name).is_file(), name
    for extra in re.findall(r"(?:cflow_torch|\.)\[([\w,]+)\]", text):
        listed = (ROOT / "pyproject.toml").read_text(encoding="utf-8").partition("[project.optional-dependencies]")[2]
        assert all(re.search(rf"^{name} = ", listed, re.M) for name in extra.split(","))
    if "cflow" in words and words.index("cflow") < len(words) - 1:
        check_cflow(words[words.index("cflow") + 1 :])
    elif re.match(r"python (eval|save)\.py", text):
        check_harness(words[2:])
    for script in [word for word in words if word.startswith("scripts/") and word.endswith(".py")]:
        subcommand = [words[words.index(script) + 1]] if script.endswith("beyond.py") else []
        monkeypatch.syspath_prepend(str(ROOT / "scripts"))
        monkeypatch.setattr(sys, "argv", [script, *subcommand, "--help"])
        with pytest.raises(SystemExit, match="0"):
            runpy.run_path(str(ROOT / script), run_name="__main__")


def check_cflow(words: List[str]) -> None:
    """The command is known, and its settings are (those of launchers that may not be installed are left out)."""
    command, *rest = words
    if command == "COMMAND":  # any of them
        for name in COMMANDS:
            if rest == ["--help"] or (ROOT / "configs" / f"{name}.yaml").is_file():  # else it has no settings
                run_cflow([name, *rest])
        return
    assert command in COMMANDS
    run_cflow([command, "--help"])
    settings = [word for word in rest if not word.startswith("-") and "hydra" not in word.partition("=")[0]]
    settings = [re.sub(r"range\((\d+)\)", "0", setting) for setting in settings]
    with initialize_config_module("cflow_torch.configs", version_base="1.3"):
        compose(command, settings)


def check_harness(words: List[str]) -> None:
    """The model is one of ours, and its settings are in its file."""
    model = next((word.partition("=")[2] for word in words if word.startswith("model=")), "cflow")
    file = ROOT / "configs" / "opensceneflow" / "model" / f"{model}.yaml"
    settings = {"model": OmegaConf.load(file)}
    for word in words:
        key = word.partition("=")[0]
        if key.startswith("model."):
            assert OmegaConf.select(OmegaConf.create(settings), key, default="absent") != "absent", (
                f"no {key} in {file}"
            )
    assert "hydra.searchpath=[pkg://cflow_torch.configs.opensceneflow]" in words


@pytest.mark.parametrize(
    "document",
    [pytest.param(name, marks=[pytest.mark.slow] if name in SLOW_BLOCKS else []) for name in sorted(python_blocks())],
)
def test_python_blocks(document: str, home: Path, places: Places) -> None:
    """In order, in one namespace, in one folder."""
    names: Dict[str, Any] = namespace()
    found = python_blocks()[document]
    places.link(home, "".join(block.text for block in found))
    for block in found:
        needed = BLOCK_NEEDS.get(block.text.splitlines()[0], "")
        if needed and (" " in needed or importlib.util.find_spec(needed) is None):
            continue
        code = compile("\n" * (block.line - 1) + places.fill(block.text, relative=False), document, "exec")
        if "import h5py" in block.text:  # it shows what the harness stored
            run_cflow(
                ["flow", "data=hdf5", "data.root=simulated/val", "result_name=cflow", "model=fast", "engine.workers=1"]
            )
        try:
            exec(code, names)
        except CFlowError as error:
            if "pip install" not in str(error):  # an extra that is not here; the block says so too
                raise


def test_no_rule_is_stale() -> None:
    texts = [snippet.text for snippet in ALL]
    assert not set(NOT_RUN) - set(texts), "of no document any more"
    assert not [kind for kind in KINDS_NOT_RUN if not any(re.match(kind, text) for text in texts)]
    assert not [rule.pattern for rule in SHRUNK if not any(re.search(rule.pattern, text) for text in texts)]
    first = {block.text.splitlines()[0] for found in python_blocks().values() for block in found}
    assert not set(BLOCK_NEEDS) - first


def test_commands_of_a_block_can_follow_each_other() -> None:
    """None would be refused because one above it left other results in the same folder."""
    for document, line, texts in command_blocks():
        left: Dict[Tuple[str, str], Set[str]] = {}
        for words in (shlex.split(text) for text in texts if text.startswith("cflow ")):
            if "-m" in words or words[1] not in LEFT or any(word.startswith("archive=") for word in words):
                continue  # the jobs of a sweep have folders of their own
            output = next((word for word in words if word.startswith("output=")), "")
            settings = set(words[2:]) - {"dry_run=true", "overwrite=true"}
            before = left.setdefault((words[1], output), settings)
            kept = words[1] in ("flow", "eval", "submit")
            assert not kept or before == settings, f"{document}:{line}: give {' '.join(words)} an output= of its own"


def test_every_block_of_commands_says_its_language() -> None:
    assert not commands_without_language(), "a block of commands begins with ```bash"
