"""Fixtures: where the real data lies. Tests that need it are skipped, with the reason, where it is absent.

Where the environment forbids bytecode, each worker and each process that a test starts would compile torch and kornia
again, a third of the time of the tests. So bytecode goes into the cache of pytest then.
"""

from __future__ import annotations

import gc
import importlib
import importlib.util
import os
import sys
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType
from typing import Iterator
from unittest.mock import MagicMock

import pytest

if sys.dont_write_bytecode:
    sys.dont_write_bytecode = False
    sys.pycache_prefix = str(Path(__file__).resolve().parents[1] / ".pytest_cache" / "bytecode")
    os.environ.update(PYTHONDONTWRITEBYTECODE="", PYTHONPYCACHEPREFIX=sys.pycache_prefix)


# Threads of torch mostly wait for each other where several processes share the cores: tests, and what they start.
os.environ.setdefault("OMP_NUM_THREADS", "1")
os.fsync = lambda _: None  # files of tests need not outlive a power cut


def pytest_collection_finish() -> None:
    """Let the garbage collector search less: not what is imported by now, and not after every 700 new objects."""
    gc.freeze()
    gc.set_threshold(10_000)


@pytest.fixture(scope="session")
def data_root() -> Path:
    """Folder of the real data sets: $CFLOW_DATA, else ../shared/data beside the checkout."""
    root = Path(os.environ.get("CFLOW_DATA") or Path(__file__).resolve().parents[2] / "shared" / "data")
    if not root.is_dir():
        pytest.skip(f"no real data at {root}; set CFLOW_DATA to its folder")
    return root


@pytest.fixture(scope="session")
def av2_folder(data_root: Path) -> Path:
    """The real Argoverse 2 log: two sweeps, one labelled pair."""
    folder = data_root / "av2-7fab2350" / "val" / "7fab2350-7eaf-3b7e-a39d-6937a4c1bede"
    if not folder.is_dir():
        pytest.skip(f"no Argoverse 2 log at {folder}")
    return folder


@pytest.fixture(scope="session")
def kitti_file(data_root: Path) -> Path:
    """The real KITTI drive in OpenSceneFlow's HDF5 layout: 16 sweeps."""
    file = data_root / "kitti-0000" / "kitti-0000-a.h5"
    if not file.is_file():
        pytest.skip(f"no KITTI file at {file}")
    return file


@contextmanager
def public_evaluator(module: str, drawing: str) -> Iterator[ModuleType]:
    """Import a public evaluator, with a mock of the package that it only draws with if that is not installed."""
    if importlib.util.find_spec(module.partition(".")[0]) is None:
        pytest.skip(f"{module} is not installed: see docs/evaluation.md")
    is_mocked = drawing not in sys.modules and importlib.util.find_spec(drawing) is None
    if is_mocked:
        sys.modules[drawing] = MagicMock()
    try:
        yield importlib.import_module(module)
    finally:
        if is_mocked:
            del sys.modules[drawing]


@pytest.fixture(scope="module")
def av2_tools() -> Iterator[ModuleType]:
    """`av2.evaluation.scene_flow`, with the modules that the tests use."""
    with public_evaluator("av2.evaluation.scene_flow", "numba") as package:
        for name in ("eval", "make_annotation_files", "make_submission_archive", "utils"):
            importlib.import_module(f"{package.__name__}.{name}")
        yield package


@pytest.fixture(scope="module")
def bsfe() -> Iterator[ModuleType]:
    """`bucketed_scene_flow_eval.datasets`."""
    with public_evaluator("bucketed_scene_flow_eval.datasets", "open3d") as package:
        yield package
