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
from typing import Any

LAUNCHER = Path(__file__).with_name("launch.py")
SEARCHPATH = "hydra.searchpath=[pkg://cflow_torch.configs.opensceneflow]"
SWALLOWED = ("==> Exception occur", "failed to write to")  # the Lightning path; the runner, which cannot store a result
SCORES = {"EPE_FD": "epe_fd", "EPE_BS": "epe_bs", "EPE_FS": "epe_fs", "IoU": "dynamic_iou", "Three-way": "epe_3way"}
_ROW = re.compile(rf"^({'|'.join(SCORES)}) +(\S+) *$", re.MULTILINE)
_MEAN = re.compile(r"^\| Mean +\| +(\S+) +\| +(\S+) +\| *$", re.MULTILINE)  # over classes: static, dynamic


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
        """Output of a script, checked by `checked_text`.

        Args:
            name: of the run, a folder below `work`.
            script: eval.py or save.py.
            overrides: of its settings; "-m" first for a sweep.
            runner: give the runner for methods without training the CPU.
        """
        sweep = list(overrides[:1]) if overrides[:1] == ("-m",) else []
        # The scripts replace the last folder but one by the name of the model; what they write stays in `work`.
        folders = [f"hydra.run.dir={self.work}/runs-{name}/job", f"hydra.sweep.dir={self.work}/sweep-{name}"]
        return self.python_run(
            str(LAUNCHER), script, *sweep, SEARCHPATH, *folders, *overrides[len(sweep) :], cpu=runner
        )

    def python_run(self, *arguments: str, cpu: bool = False) -> str:
        """Output of the checkout's Python, checked."""
        environment = {
            **os.environ,
            "PYTHONPATH": str(LAUNCHER.parent),
            "PYTHONDONTWRITEBYTECODE": "1",  # nothing is left in the checkout
            "CUDA_VISIBLE_DEVICES": "",  # there the harness computes with fewer digits
            "COLUMNS": "200",
            "HYDRA_FULL_ERROR": "1",
            "OSF_CPU_RUNNER": str(int(cpu)),
        }
        pipes: dict[str, Any] = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT, "encoding": "utf-8"}
        done = subprocess.run([self.python, *arguments], cwd=self.root, env=environment, timeout=600, **pipes)
        return checked_text(done.returncode, done.stdout)


def checked_text(status: int, text: str) -> str:
    """The text, if the run that printed it did not fail.

    Raises:
        BadRun: an exit status other than 0, or a swallowed exception.
    """
    if status != 0 or any(sign in text for sign in SWALLOWED):
        raise BadRun(f"exit status {status}; the run said:\n{text[-6000:]}")
    return text


def read_scores(text: str) -> list[dict[str, float]]:
    """Printed scores of each job, by the names of `SCORES`, "static" and "dynamic".

    Raises:
        BadRun: a table is not whole, or a job scored nothing.
    """
    starts = [row.start() for row in _ROW.finditer(text) if row.group(1) == next(iter(SCORES))]
    jobs = []
    for start, end in zip(starts, [*starts[1:], len(text)]):
        rows, mean = dict(_ROW.findall(text[start:end])), _MEAN.search(text[start:end])
        if set(rows) != set(SCORES) or mean is None or not math.isfinite(float(mean.group(1))):
            raise BadRun(f"no whole table, or nothing was scored:\n{text[start:end]}")
        rows["static"], rows["dynamic"] = mean.groups()
        jobs.append({name: float(digits) for name, digits in rows.items()})
    if not jobs:
        raise BadRun(f"no table; the run said:\n{text[-6000:]}")
    return jobs


def printed(results: dict[str, Any]) -> dict[str, float]:
    """Scores of this package as `read_scores` gives them: six significant digits."""
    mean = results["bucketed"]["mean"]
    values = {name: results["three_way"][ours] for name, ours in SCORES.items()}
    values.update(static=mean["static_epe"], dynamic=mean["dynamic_error"])
    return {name: math.nan if value is None else float(f"{value:.6g}") for name, value in values.items()}
