"""Writes a recording for the rerun viewer per log: OUTPUT/<log id>.rrd. Needs the extra `rerun` (Python 3.9 or newer).

A recording shows, along a timeline of sweeps, the points of sweep t coloured by residual flow, an arrow per moving
cluster, the clusters, sweep t+1, the true flow if the log has labels, and the path of the ego vehicle. flow=FOLDER
shows the output of `cflow flow` instead of new estimates, and its tracks as boxes with ids. `rerun FILE` opens a
recording on any machine; show=true does so at the end. OUTPUT/config.yaml contains the settings and versions.

examples:
  cflow view                                                   a simulated street, no data needed
  cflow view data=av2 data.root=/data/av2/val/LOG              one log
  cflow view data=hdf5 data.root=/data/scenes count=20         the first 20 pairs of each scene
  cflow view data.first=2 data.step=2 max_flow=0.5             every second pair; full colour at 0.5 m per sweep
  cflow view flow=outputs/flow                                 the output of `cflow flow` with the same data= settings
"""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Any, Callable, Iterator

from omegaconf import DictConfig

from cflow_torch.applications.track_table import TRACKS_FILE, read_tracks
from cflow_torch.cli import run
from cflow_torch.cli.run import Failures
from cflow_torch.data.atomic import ensure_writable
from cflow_torch.data.log import CachedLog, Log, window
from cflow_torch.data.paths import as_path, is_remote
from cflow_torch.fleet.progress import frames as counted
from cflow_torch.types import CFlowError, FlowResult
from cflow_torch.viz.recording import load_rerun, record_log


def task(cfg: DictConfig) -> None:
    """Run `cflow view`."""
    load_rerun()  # fails now if rerun is missing, not after the work
    output = run.output_folder(cfg)
    if is_remote(output):
        raise CFlowError(f"output={output}: give a folder of this machine, and copy the recordings from there")
    chosen = run.chosen_pairs(cfg, "data.")
    if cfg.max_flow is None or not 0 < cfg.max_flow < float("inf"):
        raise CFlowError(f"max_flow={cfg.max_flow}: give a positive length in metres per sweep")
    flow, num_sweeps = _flow(cfg)
    logs, failures = run.open_logs(cfg)
    run.write_config(cfg, ensure_writable(output))
    files: list[Path] = []
    for log in logs:
        recent: Any = CachedLog(log, num_sweeps)
        file = output / f"{log.log_id}.rrd"
        with run.collect_failures(failures, log.log_id):
            if file in files:
                raise CFlowError(f"{file} exists for another log of this name: give a data.root= with one of them")
            results = _results(recent, chosen(log), flow, failures)
            tracks = None if cfg.flow is None else as_path(cfg.flow) / log.log_id / TRACKS_FILE
            table = None if tracks is None or not tracks.exists() else read_tracks(tracks)
            count = record_log(recent, results, file, max_flow=cfg.max_flow, tracks=table)
            files.append(file)
            print(f"{file}: {count} pair{'' if count == 1 else 's'}, {file.stat().st_size / 1e6:,.1f} MB")
    if files and not cfg.show:
        print(f"open it with: rerun {files[0]}")
    if files and cfg.show:  # the viewer outlives this command; without --bind it accepts data from anywhere
        command = [sys.executable, "-m", "rerun", "--bind", "127.0.0.1", *map(str, files)]
        subprocess.Popen(command, start_new_session=True)
    run.finish(failures)


def _flow(cfg: DictConfig) -> tuple[Callable[[Log, int], FlowResult], int]:
    """(Function that returns the flow of a pair, number of sweeps that it needs)."""
    if cfg.flow is not None:
        return run.stored_flow(cfg.flow, ("residual_flow", "pose_flow", "cluster_id", "is_valid")), 2
    model = run.make_model(cfg)
    config = model.config

    def estimate(log: Log, index: int) -> FlowResult:
        (result,) = model([window(log, index, config.num_history, config.num_future)])
        return result

    return estimate, config.num_sweeps


def _results(
    log: Log, pairs: range, flow: Callable[[Log, int], FlowResult], failures: Failures
) -> Iterator[tuple[int, FlowResult]]:
    """Yield the flow of each pair. A bad frame is reported and skipped."""
    for index in counted(pairs, log.log_id):
        result = None
        with run.collect_failures(failures, f"{log.log_id}/{log.timestamps[index]}"):
            window(log, index)  # reads both sweeps, which the recording needs
            log.labels(index)
            result = flow(log, index)
        if result is not None:
            yield index, result
