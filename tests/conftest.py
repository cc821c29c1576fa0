"""Fixtures: where the real data lies. Tests that need it are skipped, with the reason, where it is absent."""

from __future__ import annotations

import importlib.util
import os
import sys
from pathlib import Path
from types import ModuleType
from typing import Iterator
from unittest.mock import MagicMock

import pytest

WHY_SKIPPED = "the public evaluator is not installed: see docs/evaluation.md"


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


@pytest.fixture(scope="module")
def bsfe() -> Iterator[ModuleType]:
    """bucketed_scene_flow_eval.datasets; open3d, which it imports for its viewer alone, is replaced by a mock."""
    if importlib.util.find_spec("bucketed_scene_flow_eval") is None:
        pytest.skip(WHY_SKIPPED)
    mocked = "open3d" not in sys.modules and importlib.util.find_spec("open3d") is None
    if mocked:
        sys.modules["open3d"] = MagicMock()
    yield pytest.importorskip("bucketed_scene_flow_eval.datasets", reason=WHY_SKIPPED)
    if mocked:
        del sys.modules["open3d"]
