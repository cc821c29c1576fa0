"""Write a 3-D page, or a recording for the viewer rerun: `cflow view`."""

from __future__ import annotations

import subprocess
import sys
import webbrowser
from pathlib import Path
from typing import Any, Callable, Iterator, Sequence

from cflow_torch.applications.track_table import TRACKS_FILE, Table, read_tracks
from cflow_torch.applications.tracking import LogTracker
from cflow_torch.cli.commands import View
from cflow_torch.cli.failures import Failures, collect_failures, finish
from cflow_torch.cli.logs import chosen_pairs, open_logs
from cflow_torch.cli.outputs import chosen_preset, local_folder, write_config
from cflow_torch.cli.stored_flow import interval_of_flow, method_of_flow, stored_flow
from cflow_torch.data.atomic import ensure_writable
from cflow_torch.data.log import CachedLog, Log, TimedLog, window
from cflow_torch.data.paths import as_path
from cflow_torch.estimate import make_model
from cflow_torch.fleet.changes import nearest_preset
from cflow_torch.fleet.progress import Progress
from cflow_torch.types import CFlowError, FlowResult
from cflow_torch.viz.page import load_k3d, save_page
from cflow_torch.viz.recording import load_rerun, record_log


def task(cfg: View) -> None:
    load_k3d() if cfg.format == "html" else load_rerun()  # fails now if it is missing, not after the work
    output = local_folder(cfg)
    flow, num_sweeps = _flow(cfg)
    logs, failures = open_logs(cfg.data)
    write_config(cfg, ensure_writable(output))
    files: list[Path] = []
    for log in logs:
        recent: Any = CachedLog(log, num_sweeps)
        file = output / f"{log.log_id}.{'html' if cfg.format == 'html' else 'rrd'}"
        with collect_failures(failures, log.log_id):
            if file in files:
                raise CFlowError(f"{file} exists for another log of this name: give a data.root= with one of them")
            pairs = chosen_pairs(log, cfg.data, cfg.count)
            results = _results(recent, pairs, flow, failures)
            timed = TimedLog(recent, interval_of_flow(cfg, log.log_id))
            stored = None if cfg.flow is None else as_path(cfg.flow) / log.log_id / TRACKS_FILE
            table = None if stored is None or not stored.exists() else read_tracks(stored)
            if cfg.format == "html":
                count = _save_page(cfg, timed, results, file, table)
            else:
                count = record_log(timed, results, file, max_flow=cfg.max_flow, tracks=table)
            files.append(file)
            print(f"{file}: {count} pair{'' if count == 1 else 's'}, {file.stat().st_size / 1e6:,.1f} MB")
    if files and not cfg.show:
        print(f"open it with: {'any browser' if cfg.format == 'html' else f'rerun {files[0]}'}")
    if files and cfg.show and cfg.format == "html":
        for file in files:
            webbrowser.open(file.resolve().as_uri())
    elif files and cfg.show:  # the viewer outlives this command; without --bind it accepts data from anywhere
        command = [sys.executable, "-m", "rerun", "--bind", "127.0.0.1", *map(str, files)]
        subprocess.Popen(command, start_new_session=True)
    finish(failures)


def _save_page(cfg: View, log: Log, results: Iterator[tuple[int, FlowResult]], file: Path, table: Table | None) -> int:
    """Save a page. Without a table of tracks, track the objects of the results as they arrive."""
    tracker = LogTracker(log)

    def tracked() -> Iterator[tuple[int, FlowResult]]:
        for index, result in results:
            tracker.push(index, result)
            yield index, result

    return save_page(
        log,
        results if table is not None else tracked(),
        file,
        tracks=lambda: tracker.table() if table is None else table,
        preset=chosen_preset(cfg) if cfg.flow is None else nearest_preset(method_of_flow(cfg.flow, log.log_id) or {}),
        max_flow=cfg.max_flow,
        voxel=cfg.voxel,
    )


def _flow(cfg: View) -> tuple[Callable[[Log, int], FlowResult], int]:
    """Return a function that returns the flow of a pair, and the number of sweeps that this function needs."""
    if cfg.flow is not None:
        return stored_flow(cfg.flow, ("residual_flow", "pose_flow", "cluster_id", "is_valid")), 2
    model = make_model(cfg.model, cfg.device)
    num_history, num_future = model.config.num_history, model.config.num_future
    return lambda log, index: model([window(log, index, num_history, num_future)])[0], model.config.num_sweeps


def _results(
    log: Log, pairs: Sequence[int], flow: Callable[[Log, int], FlowResult], failures: Failures
) -> Iterator[tuple[int, FlowResult]]:
    """Yield the flow of each pair. A bad frame is reported and skipped."""
    for index in Progress(pairs, log.log_id):
        result = None
        with collect_failures(failures, f"{log.log_id}/{log.timestamps[index]}"):
            window(log, index)  # fails now if a sweep cannot be read, not while the file is written
            log.labels(index)
            result = flow(log, index)
        if result is not None:
            yield index, result
