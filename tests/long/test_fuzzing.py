"""Every reader takes hostile files: a result or a CFlowError, nothing else. Long runs: scripts/fuzz.py."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from typing import List

import pytest
from fuzzing.outcome import RESULT, outcome
from fuzzing.targets import TARGETS
from hypothesis import HealthCheck, given, settings

NUM_CASES = 100
NAMES: List[str] = sorted(TARGETS)


@pytest.fixture
def folder(request: pytest.FixtureRequest, tmp_path: Path) -> Path:
    target = TARGETS[request.getfixturevalue("name")]
    if target.needs and importlib.util.find_spec(target.needs) is None:
        pytest.skip(f"needs {target.needs}")
    target.prepare(tmp_path)
    return tmp_path


@pytest.mark.parametrize("name", NAMES)
def test_whole_files_are_read(name: str, folder: Path) -> None:
    assert [outcome(TARGETS[name], folder, seed) for seed in TARGETS[name].seeds()] == [RESULT] * len(
        TARGETS[name].seeds()
    )


@pytest.mark.parametrize("name", NAMES)
def test_hostile_files(name: str, folder: Path) -> None:
    if TARGETS[name].needs == "h5py":
        h5py = pytest.importorskip("h5py")
        if h5py.version.hdf5_version_tuple < (2, 0, 0):
            pytest.skip(f"HDF5 {h5py.version.hdf5_version} itself crashes on damaged files: see docs/trust.md")

    @settings(
        max_examples=NUM_CASES,
        derandomize=True,
        database=None,
        deadline=None,
        suppress_health_check=list(HealthCheck),
    )
    @given(TARGETS[name].cases())
    def every_case(data: bytes) -> None:
        outcome(TARGETS[name], folder, data)

    every_case()
