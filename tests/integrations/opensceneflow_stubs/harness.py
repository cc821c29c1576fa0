"""Runs scripts of a real OpenSceneFlow checkout, and reads and checks what they print.

The harness swallows exceptions of a model, goes on, prints a table and exits with 0: an exit status proves nothing.
"""

from __future__ import annotations

import math
import os
import re
import subprocess
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Dict, List

LAUNCHER = Path(__file__).with_name("launch.py")
SEARCHPATH = "hydra.searchpath=[pkg://cflow_torch.configs.opensceneflow]"
SWALLOWED = ("==> Exception occur", "failed to write to")  # the Lightning path; the runner, which cannot store a result
SECONDS = 600  # for one script

THREE_WAY = {"EPE_FD": "epe_fd", "EPE_BS": "epe_bs", "EPE_FS": "epe_fs", "IoU": "dynamic_iou", "Three-way": "epe_3way"}
CLASSES = ("BACKGROUND", "CAR", "OTHER_VEHICLES", "PEDESTRIAN", "WHEELED_VRU", "Mean")
_THREE_WAY_ROW = re.compile(rf"^({'|'.join(THREE_WAY)}) +(\S+) *$", re.MULTILINE)
_CLASS_ROW = re.compile(rf"^\| ({'|'.join(CLASSES)}) +\| +(\S+) +\| +(\S+) +\| *$", re.MULTILINE)


class BadRun(AssertionError):
    """A run of the harness that failed, whatever it says itself."""


@dataclass(frozen=True)
class Harness:
    """A checkout, never modified.

    Args:
        root: folder of the checkout.
        python: interpreter that has what the harness needs, and this package installed.
        work: folder for what the runs leave behind.
    """

    root: Path
    python: str
    work: Path

    def run(self, name: str, script: str, *overrides: str, runner: bool = False) -> str:
        """Standard output and standard error of a script; checked.

        Args:
            name: of the run, a folder below `work`.
            script: eval.py or save.py.
            overrides: of its settings; "-m" first for a sweep.
            runner: give the runner for methods without training the CPU.

        Raises:
            BadRun: the script failed, or swallowed an exception.
        """
        sweep = list(overrides[:1]) if overrides[:1] == ("-m",) else []
        # The scripts replace the last folder but one by the name of the model; what they write stays in `work`.
        folders = [f"hydra.run.dir={self.work}/runs-{name}/job", f"hydra.sweep.dir={self.work}/sweep-{name}"]
        arguments = [script, *sweep, SEARCHPATH, *folders, *overrides[len(sweep) :]]
        return self._python(str(LAUNCHER), *arguments, runner=runner)

    def write_checkpoint(self, file: Path) -> None:
        """The user's first command."""
        self._python("-m", "cflow_torch.integrations.opensceneflow", str(file))

    def _python(self, *arguments: str, runner: bool = False) -> str:
        environment = {
            **os.environ,
            "PYTHONPATH": str(LAUNCHER.parent),
            "PYTHONDONTWRITEBYTECODE": "1",  # nothing is left in the checkout
            "CUDA_VISIBLE_DEVICES": "",  # there the harness computes with fewer digits
            "COLUMNS": "200",
            "HYDRA_FULL_ERROR": "1",
            "OSF_CPU_RUNNER": str(int(runner)),
        }
        done = subprocess.run(
            [self.python, *arguments],
            cwd=self.root,
            env=environment,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            encoding="utf-8",
            timeout=SECONDS,
        )
        return checked_text(done.returncode, done.stdout)


def checked_text(status: int, text: str) -> str:
    """The text, if the run that printed it did not fail.

    Raises:
        BadRun: an exit status other than 0, or a swallowed exception.
    """
    found = [sign for sign in SWALLOWED if sign in text]
    if status != 0 or found:
        raise BadRun(f"exit status {status}, signs of a swallowed exception: {found}; the run said:\n{text[-6000:]}")
    return text


def read_tables(text: str) -> Dict[str, str]:
    """Printed digits of the two tables: "EPE_FD", ..., "CAR/static", "CAR/dynamic", ..., "Mean/dynamic".

    Raises:
        BadRun: a table is not there, or no class in it has a number, or it is there more than once.
    """
    if len(_THREE_WAY_ROW.findall(text)) > len(THREE_WAY):
        raise BadRun("the tables of several jobs; read them with read_sweep")
    tables = dict(_THREE_WAY_ROW.findall(text))
    for name, static, dynamic in _CLASS_ROW.findall(text):
        tables[f"{name}/static"], tables[f"{name}/dynamic"] = static, dynamic
    wanted = [*THREE_WAY, *(f"{name}/{motion}" for name in CLASSES for motion in ("static", "dynamic"))]
    missing = [key for key in wanted if key not in tables]
    if missing:
        raise BadRun(f"no table, or one without {missing}; the run said:\n{text[-6000:]}")
    # Without a scored point the three-way values are NaN or 0, so they say nothing.
    empty = [key for key in ("Mean/static", "EPE_FD", "EPE_BS", "EPE_FS") if not math.isfinite(float(tables[key]))]
    if empty:
        raise BadRun(f"nothing was scored, {empty} have no number; the run said:\n{text[-6000:]}")
    return tables


def read_sweep(text: str) -> List[Dict[str, str]]:
    """Tables of the jobs of a sweep, in their order, out of what the one process printed.

    The jobs' own files do not tell them apart: that of a job also gets all that later jobs print.
    """
    starts = [row.start() for row in _THREE_WAY_ROW.finditer(text) if row.group(1) == next(iter(THREE_WAY))]
    return [read_tables(text[start:end]) for start, end in zip(starts, [*starts[1:], len(text)])]


def flat(results: Dict[str, Any]) -> Dict[str, float]:
    """Scores of this package under the keys of `read_tables`; NaN where there is none."""
    bucketed = results["bucketed"]
    values = {printed: results["three_way"][ours] for printed, ours in THREE_WAY.items()}
    for name in CLASSES:
        row = bucketed["mean"] if name == "Mean" else bucketed["classes"][name]
        values[f"{name}/static"], values[f"{name}/dynamic"] = row["static_epe"], row["dynamic_error"]
    return {key: float("nan") if value is None else float(value) for key, value in values.items()}


def disagreements(printed: Dict[str, str], values: Dict[str, float]) -> List[str]:
    """Values that are not the printed ones.

    Args:
        printed: what `read_tables` read: six significant digits, of which the last may be rounded the other way.
        values: under the same keys.
    """
    found = []
    for key, digits in printed.items():
        number, value = float(digits), values[key]
        last_digit = 10.0 ** (math.floor(math.log10(abs(number))) - 5) if number and math.isfinite(number) else 1e-12
        both_nan = math.isnan(number) and math.isnan(value)
        if not both_nan and not abs(number - value) <= 1.0001 * last_digit:
            found.append(f"{key}: printed {digits}, expected {value!r}")
    return found
