"""Runs on the logs of the fixture `fleet` in this process, and the files of a run."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Sequence

from command_line import cflow

from cflow_torch import make_config
from cflow_torch.data.catalog import find_sources
from cflow_torch.fleet.job import Job, Shard
from cflow_torch.fleet.manifest import check_logs, clear_log
from cflow_torch.fleet.parallel import local_executors
from cflow_torch.fleet.ray_engine import ray_executors
from cflow_torch.fleet.run import run_fleet

SWEEPS = (4, 6, 3)  # of the logs
PAIRS = sum(SWEEPS) - len(SWEEPS)
CONFIG = make_config("paper", pixel_size=0.4, num_history=1)
# The same settings for the command.
COMMAND = ["flow", "data=av2", "model=paper", "model.pixel_sizes=[0.4]", "model.num_history=1", "data.check=false"]
ENGINES: dict[str, Any] = {"local": local_executors, "ray": ray_executors}
ONE, TWO = ("cpu",), ("cpu", "cpu")  # devices


def make_job(output: Path, **settings: Any) -> Job:
    """A job with `CONFIG` on Argoverse 2 logs."""
    values: dict[str, Any] = {"config": CONFIG, "settings": {"check": False}, "batch": 2, **settings}
    return Job(reader="av2", output=str(output), **values)


def run(
    root: Path,
    output: Path,
    devices: Sequence[str] = ONE,
    batch: int = 2,
    shard: Shard = Shard(),  # noqa: B008 (immutable)
    engine: str = "local",
    overwrite: bool = False,
    settings: dict[str, Any] = {},  # noqa: B006 (read only)
    **engine_settings: Any,
) -> dict[str, Any]:
    """Run `cflow flow` without the command line; returns the report. `settings` replace those of `make_job`."""
    job = make_job(output, batch=batch, redo=overwrite, **settings)
    sources = find_sources("av2", root)
    names = [source.name for source in sources]
    check_logs(output, names, job.identity, overwrite, shard.count == 1)
    for name in names if overwrite and shard.count == 1 else ():
        clear_log(output / name)
    with ENGINES[engine](job, devices, **engine_settings) as executors:
        parts = shard.parts(sources, len(devices))
        return run_fleet(executors, parts, job, devices, shard, engine)


def command(*arguments: Any) -> int:
    """Exit status of `cflow flow` in this process."""
    return cflow(*COMMAND, "engine.workers=1", *arguments)


def tree(output: Path) -> dict[str, bytes]:
    """All files, also hidden ones, except reports, which contain times, and config.yaml, which contains paths."""
    files = [f for f in output.rglob("*") if f.is_file() and "reports" not in f.parts and f.name != "config.yaml"]
    return {str(file.relative_to(output)): file.read_bytes() for file in files}


def flow_files(output: Path) -> dict[str, bytes]:
    return {name: content for name, content in tree(output).items() if name.endswith(".feather")}


def frames(output: Path) -> list[Path]:
    """Flow files, in order."""
    return sorted(output.glob("*/*.feather"))
