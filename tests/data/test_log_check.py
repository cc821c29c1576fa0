"""What is said about a log when it is opened: ground that is left in."""

from __future__ import annotations

import subprocess
import sys
import warnings
from pathlib import Path

import numpy as np
import pytest

from cflow_torch import CFlowError, Sweep
from cflow_torch.data.arrays.writer import write_array_log
from cflow_torch.data.log_check import GroundWarning, check_ground, check_log
from cflow_torch.data.static_check import StaticWorldWarning
from cflow_torch.simulator import make_drive


class WithoutMasks:
    """A log as it is, less its ground masks; of a broken one no sweep can be read."""

    def __init__(self, log, with_ground: bool = True, is_broken: bool = False) -> None:
        self.log_id, self.timestamps, self._log = log.log_id, log.timestamps, log
        self._with_ground, self._is_broken = with_ground, is_broken

    def sweep(self, index: int) -> Sweep:
        if self._is_broken:
            raise CFlowError("broken")
        sweep = self._log.sweep(index)
        kept = np.ones(len(sweep.points), bool) if self._with_ground else ~np.asarray(sweep.is_ground)
        return Sweep(np.asarray(sweep.points)[kept], None, sweep.pose, sweep.timestamp_ns)


@pytest.fixture(scope="module")
def drive():
    return make_drive(seed=3, num_sweeps=3)


def test_ground_without_a_mask_is_noticed(drive):
    with pytest.warns(GroundWarning, match=r"data\.find_ground=grid"):
        assert check_ground(WithoutMasks(drive))


def test_masks_and_points_without_ground_are_fine(drive):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert not check_ground(drive)
        assert not check_ground(WithoutMasks(drive, with_ground=False))


def test_what_cannot_be_read_is_passed_over(drive):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_log(WithoutMasks(drive, is_broken=True))


def test_both_checks_are_made(drive):
    class Standing(WithoutMasks):
        def sweep(self, index):
            sweep = super().sweep(index)
            return Sweep(sweep.points, None, np.eye(4), sweep.timestamp_ns)

    with pytest.warns(UserWarning) as caught:
        check_log(Standing(make_drive(seed=3, num_sweeps=6)))
    assert {warning.category for warning in caught} == {GroundWarning, StaticWorldWarning}


@pytest.mark.parametrize(
    "remedy", ["", "data.find_ground=grid", pytest.param("data.check=false", marks=pytest.mark.slow)]
)
def test_cflow_flow_says_so_and_the_remedies_help(drive, tmp_path: Path, remedy: str):
    root = write_array_log(WithoutMasks(drive), tmp_path / "mine")
    settings = ["data=arrays", f"data.root={root}", f"output={tmp_path / 'out'}", "model=paper", "engine.workers=1"]
    command = [sys.executable, "-m", "cflow_torch.cli.main", "flow", *settings, *([remedy] if remedy else [])]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert ("data.find_ground=grid" in done.stderr) == (remedy == "")
