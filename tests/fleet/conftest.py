"""The logs of all fleet tests, and the flow of an undisturbed run."""

from __future__ import annotations

from pathlib import Path

import pytest
from small_fleet import SWEEPS, run, tree
from small_logs import make_small_drive

from cflow_torch.simulator.writers.av2 import write_av2_log


@pytest.fixture(scope="session")
def fleet(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of three logs, of 3, 5 and 2 pairs."""
    root = tmp_path_factory.mktemp("fleet")
    for seed, sweeps in enumerate(SWEEPS):
        write_av2_log(make_small_drive(sweeps, seed), root)
    return root


@pytest.fixture(scope="session")
def single_run(fleet: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The output of one worker, one window at a time; read only."""
    output = tmp_path_factory.mktemp("single") / "flow"
    assert run(fleet, output, batch=1)["status"] == "complete"
    return output


@pytest.fixture(scope="session")
def single(single_run: Path) -> dict[str, bytes]:
    """Its files: name -> content."""
    return tree(single_run)
