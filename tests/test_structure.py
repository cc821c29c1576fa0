"""The shape of the package: imports point one way, importing costs little, the module has no state."""

from __future__ import annotations

import ast
import inspect
import subprocess
import sys
from pathlib import Path
from typing import Dict, Iterator, Set

import pytest
import torch
from torch import nn

import cflow_torch
from cflow_torch import CorrelationFlow

PACKAGE = Path(cflow_torch.__file__).parent
# Who may import whom: only modules of the same or a smaller number. A new module needs a place here.
LAYERS = {
    "types": 0,
    "checks": 0,
    "config": 0,
    "configs": 0,  # YAML; part of an installed package only
    "free_memory": 1,
    "resolution": 1,
    "ops": 1,
    "ego": 2,
    "grid": 2,
    "ground": 2,
    "inputs": 2,
    "descriptors": 2,
    "gate": 2,
    "jobs": 2,
    "judge": 2,
    "keypoint_motion": 2,
    "peaks": 2,
    "height": 2,
    "match": 2,
    "aperture": 2,
    "levels": 2,
    "low_columns": 2,
    "tree": 2,
    "densify": 2,
    "batch": 2,
    "candidates": 2,
    "cells": 2,
    "confidence": 2,
    "cluster": 2,
    "components": 2,
    "cubes": 2,
    "correlate": 2,
    "density": 2,
    "displacement": 2,
    "drawing": 2,
    "moving": 2,
    "lookup": 2,
    "nudge": 2,
    "pool": 2,
    "refine": 2,
    "relocate": 2,
    "rigid": 2,
    "sectional": 2,
    "slow": 2,
    "voxels": 2,
    "reference": 2,
    "dense": 3,
    "proof": 3,
    "keypoints": 3,
    "pyramid": 3,
    "estimate": 3,
    "stopwatch": 3,
    "": 4,  # cflow_torch/__init__.py
    "data": 4,
    "evaluation": 4,
    "submission": 4,
    "viz": 4,
    "bench": 4,
    "fleet": 5,
    "integrations": 5,
    "cli": 5,
}
HEAVY = ("kornia", "matplotlib", "cv2", "scipy", "hydra", "omegaconf", "pyarrow", "h5py", "pandas")


def modules() -> Dict[str, Path]:
    """Dotted name without the package's own, "" for its __init__.py -> file."""
    result = {}
    for file in sorted(PACKAGE.rglob("*.py")):
        parts = file.relative_to(PACKAGE).with_suffix("").parts
        result[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = file
    return result


def imports(file: Path, known: Dict[str, Path]) -> Iterator[str]:
    """Modules of the package that a file imports, anywhere in it."""
    for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{file.name}: relative import"
            names = [f"{node.module}.{alias.name}" for alias in node.names]
        else:
            continue
        for name in names:
            if name.split(".")[0] != "cflow_torch":
                continue
            inner = name[len("cflow_torch") :].lstrip(".")
            while inner not in known:  # the name of a function or class: its module
                inner = inner.rpartition(".")[0]
            yield inner


def graph() -> Dict[str, Set[str]]:
    known = modules()
    return {name: set(imports(file, known)) for name, file in known.items()}


def layer(module: str) -> int:
    top = module.split(".")[0]
    assert top in LAYERS, f"cflow_torch/{top}: give it a place in LAYERS"
    return LAYERS[top]


def test_imports_point_one_way():
    wrong = [f"{a} imports {b}" for a, targets in graph().items() for b in targets if layer(b) > layer(a)]
    assert not wrong


def test_no_import_cycles():
    edges = {a: targets - {a} for a, targets in graph().items()}
    done: Set[str] = set()
    while len(done) < len(edges):
        free = [a for a, targets in edges.items() if a not in done and targets <= done]
        assert free, f"a cycle among {sorted(set(edges) - done)}"
        done.update(free)


def test_ops_know_nothing_of_the_method():
    known = modules()
    for name in known:
        if name.split(".")[0] == "ops":
            assert {t.split(".")[0] for t in imports(known[name], known)} <= {"ops", "types"}, name


def reference_modules() -> Dict[str, Path]:
    return {name: file for name, file in modules().items() if name.split(".")[0] == "reference"}


def test_the_reference_shares_nothing_with_the_fast_path():
    known = modules()
    pages = reference_modules()
    assert len(pages) > 5
    for name, file in pages.items():
        assert set(imports(file, known)) <= {"config", "types", *pages}, name
    for name in known:
        if layer(name) <= 4 and name.split(".")[0] not in ("reference", "bench"):
            assert not set(imports(known[name], known)) & set(pages), f"{name} imports the reference"


def test_the_reference_computes_with_numpy_only():
    # torch appears only at the two doors: tensors in (sweeps), FlowResult out (the package itself).
    doors = {"reference": {"from_numpy"}, "reference.sweeps": {"Tensor"}}
    for name, file in reference_modules().items():
        tree = ast.parse(file.read_text(encoding="utf-8"))
        used = {
            node.attr
            for node in ast.walk(tree)
            if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id == "torch"
        }
        from_torch = [n for n in ast.walk(tree) if isinstance(n, ast.ImportFrom) and "torch" in n.module.split(".")]
        assert used <= doors.get(name, set()) and not from_torch, name


def test_names_say_what_is_inside():
    vague = {"utils", "util", "misc", "helpers", "helper", "common", "tools", "stuff"}
    folders = [PACKAGE, PACKAGE.parent / "tests", PACKAGE.parent / "scripts"]
    names = [f.stem for folder in folders for f in folder.rglob("*") if "__pycache__" not in f.parts]
    assert not vague & {name.lower() for name in names}


def run(code: str) -> str:
    command = [sys.executable, "-c", code]
    done = subprocess.run(command, cwd=str(PACKAGE.parent), capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_importing_loads_nothing_heavy_and_changes_nothing():
    out = run(
        "import sys, numpy, torch\n"
        "state = lambda: (torch.get_default_dtype(), torch.get_num_threads(), torch.initial_seed(),\n"
        "    torch.get_rng_state().sum().item(), numpy.random.get_state()[1].sum(), torch.is_grad_enabled(),\n"
        "    torch.backends.cudnn.benchmark, torch.backends.cudnn.deterministic, \n"
        "    torch.backends.cuda.matmul.allow_tf32, torch.are_deterministic_algorithms_enabled())\n"
        "torch.manual_seed(5)\n"
        "before, loaded = state(), set(sys.modules)\n"
        "import cflow_torch\n"
        "assert state() == before, (state(), before)\n"
        "print(*sorted({name.split('.')[0] for name in set(sys.modules) - loaded}))\n"
    )
    new = set(out.split())
    assert "cflow_torch" in new
    assert not new & set(HEAVY)


def test_the_default_engines_run_without_kornia():
    run(
        "import sys\n"
        f"for name in {HEAVY}: sys.modules[name] = None\n"
        "import numpy as np, cflow_torch\n"
        "car = np.random.default_rng(0).uniform(0, 3, (200, 3))\n"
        "assert cflow_torch.estimate_flow(car, car + [0.5, 0, 0]).residual_flow[0, 0] == 0.5\n"
    )


def test_the_module_has_no_state():
    model = CorrelationFlow.from_preset("paper")
    assert isinstance(model, nn.Module)
    assert not list(model.parameters()) and not list(model.buffers()) and not model.state_dict()
    assert [type(m) for m in model.modules()] == [CorrelationFlow]  # no Conv, no Linear, no child at all
    assert model.eval() is model and model.to("cpu") is model


def test_no_layer_with_weights_is_built_anywhere():
    weighty = {"Conv1d", "Conv2d", "Conv3d", "Linear", "Bilinear", "Parameter", "Embedding", "register_buffer"}
    for name, file in modules().items():
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
            if isinstance(node, (ast.Attribute, ast.Name)):
                used = node.attr if isinstance(node, ast.Attribute) else node.id
                assert used not in weighty, f"{name} uses {used}"


def test_nothing_sets_global_state():
    setters = {
        "set_default_dtype",
        "set_default_device",
        "set_default_tensor_type",
        "manual_seed",
        "set_num_threads",
        "set_float32_matmul_precision",
        "use_deterministic_algorithms",
    }
    for name in modules():
        if layer(name) > 3:
            continue
        for node in ast.walk(ast.parse(modules()[name].read_text(encoding="utf-8"))):
            if isinstance(node, ast.Attribute):
                assert node.attr not in setters, f"{name} calls {node.attr}"


def test_public_names_are_few_and_documented():
    names = [name for name in cflow_torch.__all__ if name != "__version__"]
    assert 1 <= len(names) <= 13
    for name in names:
        doc = inspect.getdoc(getattr(cflow_torch, name))
        assert doc and len(doc) > 30, name
        assert not doc.startswith(f"{name}("), f"{name}: the docstring a dataclass makes itself"
    assert isinstance(cflow_torch.__version__, str)


@pytest.mark.parametrize("name", sorted(modules()))
def test_every_module_has_a_docstring_and_future_annotations(name):
    tree = ast.parse(modules()[name].read_text(encoding="utf-8"))
    assert ast.get_docstring(tree), name
    if len(tree.body) > 1 and "__init__" not in modules()[name].name:
        assert any(isinstance(n, ast.ImportFrom) and n.module == "__future__" for n in tree.body), name


def test_the_fast_path_is_run_without_gradients():
    points = torch.rand(30, 3, requires_grad=True)
    assert not cflow_torch.estimate_flow(points, points).flow.requires_grad
