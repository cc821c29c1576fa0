"""A run of a command that writes flow files, `cflow flow` or `cflow label`: its logs, its report, its exit status."""

from __future__ import annotations

import os
import sys
from concurrent.futures import BrokenExecutor
from contextlib import suppress
from dataclasses import asdict
from pathlib import Path
from time import perf_counter
from typing import Any, Callable, Iterator, Sequence

from cflow_torch.cli.commands import FlowFiles
from cflow_torch.cli.failures import Failures, end_unfinished
from cflow_torch.cli.logs import find_logs
from cflow_torch.cli.outputs import output_folder, read_config, settings_record, write_config
from cflow_torch.cli.track_formats import TRACK_FILES
from cflow_torch.data.atomic import ensure_writable
from cflow_torch.data.catalog import source_name
from cflow_torch.data.json_file import write_json
from cflow_torch.data.log import Log
from cflow_torch.fleet.executors import Executor
from cflow_torch.fleet.job import Job, Part, find_shard
from cflow_torch.fleet.machine import choose_batch, choose_devices, frames_per_worker
from cflow_torch.fleet.manifest import check_logs, clear_log, is_of_run, versions
from cflow_torch.fleet.parallel import local_executors
from cflow_torch.fleet.ray_engine import ray_executors
from cflow_torch.fleet.run import count_frames, forecast, format_missing, format_report, report_file, run_fleet
from cflow_torch.fleet.work import open_quickly
from cflow_torch.setting import AUTO
from cflow_torch.types import CFlowError

_ENGINES: dict[str, Callable[..., Any]] = {"local": local_executors, "ray": ray_executors}


class FlowRun:
    """The logs, the job and this process's share of a run.

    Args:
        cfg: settings of the command.
        contents: the columns of a flow file.
        redo: compute frames of the same settings again, too.
    """

    def __init__(self, cfg: FlowFiles, contents: Sequence[str], redo: bool) -> None:
        self._cfg = cfg
        self._devices = choose_devices(cfg.device, cfg.engine.workers, os.environ)
        self.logs = find_logs(cfg.data)
        self.output = output_folder(cfg)
        self.job = Job(
            config=cfg.model,
            reader=self.logs.name,
            settings=dict(self.logs.settings),
            output=str(self.output),
            contents=tuple(contents),
            batch=choose_batch(cfg.engine.batch, self._devices[0]),
            redo=redo,
        )
        self.done: frozenset[Any] = frozenset()  # sources of logs that need no flow
        self.shard = find_shard(cfg.shard.index, cfg.shard.count, os.environ)

    @property
    def parts(self) -> list[Part]:
        """The logs of this shard, or the parts of them that are its own, without those that are `done`."""
        return self._parts()

    def _parts(self, workers: int = 1) -> list[Part]:
        return [part for part in self.shard.parts(self.logs.sources, workers) if part.source not in self.done]

    def open_logs(self) -> Iterator[Log]:
        """Open the logs of this shard one by one, without what takes time."""
        for part in self.parts:
            with suppress(Exception), open_quickly(self.job, part.source) as log:  # the worker reports the error
                yield log

    def forecast(self) -> str:
        """Count the frames that `compute` would compute, and write nothing."""
        self._check_output()
        return forecast(self.job, self.parts)

    def compute(self) -> dict[str, Any]:
        """Write the flow files of this shard, and return the report of `run_fleet`."""
        read_config(self._cfg, ensure_writable(self.output))  # one of others fails now, not when logs are cleared
        self._check_output()
        devices = self._useful_devices()
        settings = asdict(self._cfg.engine)
        name = settings.pop("name")
        own = {key: value for key, value in settings.items() if key not in ("workers", "batch")}
        with _ENGINES[name](self.job, devices, **own) as executors:
            if self._cfg.overwrite and self.shard.count == 1:
                _start(executors[0])
                for folder in (self.output / log.log_id for log in self.open_logs()):
                    if self.job.redo or not is_of_run(folder, self.job.identity):
                        clear_log(folder, TRACK_FILES)
            write_config(self._cfg, self.output)
            parts = self._parts(len(devices))
            about = {"config": settings_record(self._cfg), "versions": versions()}
            report = run_fleet(executors, parts, self.job, devices, self.shard, name, about)
        self._computed = perf_counter()
        return report

    def finish(self, report: dict[str, Any], failures: Failures, *copies: Path) -> None:
        """Print the report and what is missing, and exit with the status of the run unless it is complete.

        `failures` is what failed when the flow was used, after `compute`. `copies` are more files for the report.
        """
        file = report_file(self.job.output, self.shard)
        if failures:
            report["failures"] += failures
            report.update(status="incomplete", exit_status=1)
        if not report["stopped_by"]:  # a signal leaves no time for this
            report["seconds"] += perf_counter() - self._computed
            for path in (file, *copies):
                with suppress(OSError):  # the run has reported it
                    write_json(path, report)
        print(f"{format_report(report)}\nflow files in {self.job.output}, report in {file}")
        if report["exit_status"]:
            print(f"missing:\n{format_missing(report)}", file=sys.stderr)
            end_unfinished(f"something is missing: see {file}", report["exit_status"])

    def _check_output(self) -> None:
        """Make sure that the results may be added to the output."""
        names = [source_name(part.source) for part in self.parts]
        check_logs(self.output, names, self.job.identity, self._cfg.overwrite, self.shard.count == 1)

    def _useful_devices(self) -> Sequence[str]:
        """Leave out workers that would not save time, because few frames are left to do."""
        engine = self._cfg.engine
        if engine.name != "local" or engine.workers != AUTO or self._devices[0] != "cpu":
            return self._devices
        least = frames_per_worker(self._cfg.model)
        count = 0
        for _, _, todo in count_frames(self.job, self.parts):  # opens a log after the other
            count += todo
            if count >= least * len(self._devices):
                break
        return self._devices[: max(1, count // least)]


def _start(executor: Executor) -> None:
    """Start a worker. If it cannot start, for example on a broken GPU, that is a `CFlowError`."""
    try:
        executor.call("next_event", False)  # a worker without a part has no event
    except (BrokenExecutor, CFlowError) as error:
        executor.close()
        raise CFlowError(f"no worker can start: {error}") from error
