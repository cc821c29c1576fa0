"""The logs of all fleet tests, and the flow of an undisturbed run."""

from __future__ import annotations

from pathlib import Path

import pytest
from small_fleet import run, tree, write_fleet

from cflow_torch.fleet.machine import Layout


@pytest.fixture(scope="session")
def fleet(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of three logs, of 3, 5 and 2 pairs."""
    return write_fleet(tmp_path_factory.mktemp("fleet"))


@pytest.fixture(scope="session")
def single_run(fleet: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The output of one worker, one window at a time; read only."""
    output = tmp_path_factory.mktemp("single") / "flow"
    assert run(fleet, output, Layout(("cpu",), batch=1))["status"] == "complete"
    return output


@pytest.fixture(scope="session")
def single(single_run: Path) -> dict[str, bytes]:
    """Its files: name -> content."""
    return tree(single_run)
