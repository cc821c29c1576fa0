"""The shape of the package: imports point one way, importing costs little and changes nothing, a model has no state."""

from __future__ import annotations

import ast
import re
import subprocess
import sys
from pathlib import Path

import numpy as np

import cflow_torch
from cflow_torch import CorrelationFlow, Sweep, Window

PACKAGE = Path(cflow_torch.__file__).parent
# A room imports from itself and from rooms that stand before it.
ROOMS = (
    *("errors", "types", "setting", "config", "stages", "tensors", "transforms", "ops", "ground", "windows"),
    *("diagnosis", "model", "dense", "keypoints", "verified", "estimate", "data", "simulator", "evaluation", "viz"),
    *("fleet", "applications", "integrations", "configs", "cli"),
)
# Methods of the standard library that Python 3.8 lacks, and slices of Path.parents.
NEWER = re.compile(
    r"\.parents\[[^\]]*:|\.(removeprefix|removesuffix|is_relative_to|with_stem|hardlink_to|bit_count|pairwise)\("
    r"|functools import [^\n]*\bcache\b|\b(?:zip|map)\([^()]*strict="
)
HEAVY = ("kornia", "matplotlib", "hydra", "omegaconf", "pyarrow", "h5py", "cv2", "sklearn", "ray", "rerun", "k3d")


def test_imports_point_one_way():
    wrong = []
    for file in PACKAGE.rglob("*.py"):
        room = file.relative_to(PACKAGE).parts[0].replace(".py", "")
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
            if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("cflow_torch."):
                other = str(node.module).split(".")[1]
                if room != "__init__" and ROOMS.index(other) > ROOMS.index(room):
                    wrong.append(f"{file.relative_to(PACKAGE)} imports {node.module}")
    assert not wrong


def test_nothing_newer_than_python_3_8_is_used():
    """CI runs newer versions only; CONTRIBUTING tells how to test the oldest one."""
    files = {file: file.read_text(encoding="utf-8") for file in PACKAGE.rglob("*.py")}
    found = {str(file): NEWER.search(text).group() for file, text in files.items() if NEWER.search(text)}
    assert not found
    assert NEWER.search("[top, *top.parents[:2]]") and not NEWER.search("file.parents[2]")


def test_nothing_changes_the_filters_of_warnings():
    """All threads share them: a reader would switch off the warnings, or the errors, of the thread that computes."""
    texts = {str(file): file.read_text(encoding="utf-8") for file in PACKAGE.rglob("*.py")}
    assert not [file for file, text in texts.items() if re.search("catch_warnings|simplefilter", text)]


def test_importing_loads_nothing_heavy_and_changes_nothing():
    code = (
        "import sys, numpy, torch\n"
        "state = lambda: (torch.get_default_dtype(), torch.get_num_threads(), torch.get_rng_state().sum().item(),\n"
        "    numpy.random.get_state()[1].sum(), torch.is_grad_enabled(), torch.backends.cudnn.benchmark)\n"
        "torch.manual_seed(5)\n"
        "before, loaded = state(), set(sys.modules)\n"
        "import cflow_torch\n"
        "cflow_torch.estimate_flow\n"
        "assert state() == before, (state(), before)\n"
        "print(*sorted({name.split('.')[0] for name in set(sys.modules) - loaded}))\n"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=str(PACKAGE.parent), capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert "cflow_torch" in done.stdout.split()
    assert not set(done.stdout.split()) & set(HEAVY)


def test_messages_about_missing_packages_name_their_extra():
    project = (Path(__file__).parents[1] / "pyproject.toml").read_text(encoding="utf-8")
    listed = re.search(r"\[project.optional-dependencies\](.*?)\n\[", project, re.DOTALL).group(1)
    packages = {}
    for extra, members in re.findall(r"^(\w+) = \[(.+)$", listed, re.MULTILINE):
        for package in re.findall(r'"([\w-]+)[><=;]', members):
            packages.setdefault(package.lower(), set()).add(extra)
    assert packages["scipy"] == {"label"} and packages["k3d"] == {"html"}
    silent = []
    for file in PACKAGE.rglob("*.py"):
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
            is_text = isinstance(node, ast.Constant) and isinstance(node.value, str)
            text = node.value if is_text and "\n" not in node.value else ""  # no docstrings
            for package in re.findall(r"pip install '?([\w-]+)", text):
                named = packages.get(package.lower(), ())
                if named and not any(re.search(rf"extras? [\w, ]*{extra}", text) for extra in named):
                    silent.append(f"{file.relative_to(PACKAGE)}: {text}")
    assert not silent, silent


# Phrases of a private dialect, see "Style" in CONTRIBUTING.md.
WORDS = "what stands|what moves|of equals|says? nothing|at hand|whoever|mend(s|ed|ing)?|creep|doubt"
PHRASES = re.compile(rf"\b({WORDS}|(?<!there )is no (?!longer|wider))\b", re.IGNORECASE)


def test_prose_uses_the_words_of_the_field():
    root = PACKAGE.parent
    files = [*root.glob("*.md"), *root.glob("docs/*.md"), *PACKAGE.rglob("*.py")]
    texts = {str(file.relative_to(root)): file.read_text(encoding="utf-8") for file in files}
    assert not [(name, hit.group()) for name, text in texts.items() for hit in PHRASES.finditer(text)]


def test_a_model_has_no_state():
    model = CorrelationFlow.from_preset("paper")
    before = dict(vars(model))
    sweep = Sweep(np.zeros((5, 3), np.float32), np.zeros(5, bool))
    model([Window(sweep, sweep)])
    assert vars(model) == before, "a call leaves nothing behind"
    assert not list(model.parameters()) and not list(model.buffers()) and not model.state_dict()
    assert [type(module) for module in model.modules()] == [CorrelationFlow]
    assert model.eval() is model and model.to("cpu") is model
