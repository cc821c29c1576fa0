"""Estimates the flow of every pair of sweeps: OUTPUT/<log id>/<time stamp of sweep t>.feather.

Each file has one row per point of sweep t. Columns: flow_t{x,y,z}_m total flow, residual_t{x,y,z}_m motion of objects,
pose_t{x,y,z}_m ego motion (float32, metres per sweep, axes of the ego frame at t+1), cluster_id, score, is_valid. There
is also a column confidence, unless model=paper or keypoints. contents=[residual,is_valid] writes only these columns.
Files are then much smaller; ego motion and total flow follow from the poses.

OUTPUT/config.yaml contains settings and versions; OUTPUT/reports has the report. Run the command again to resume.
After Ctrl-C, SIGTERM or SIGHUP the run finishes the frames that it has begun. The exit status is 0 if every frame is
complete, 1 if one is missing, 2 if the call was wrong, and 128 + n after signal number n. The report has the times of
all stages; verbose=true prints them.

result_name=NAME also writes the total flow into the HDF5 scenes, as key NAME of every sweep but the last. The
viewers of OpenSceneFlow read it there. tracks=true also writes OUTPUT/<log id>/tracks.parquet when all frames of a log
are complete: one row per moving object and sweep, with id, box and velocity. tracks=mot and tracks=kitti add
OUTPUT/<log id>/mot.txt or kitti.txt, the tracks in these formats.

examples:
  cflow flow data=av2 data.root=/data/av2/val output=outputs/val
  cflow flow data=av2 data.root=/data/av2/val dry_run=true        counts the frames
  cflow flow model=paper model.pixel_sizes=[0.2] engine.workers=8
  cflow flow shard.index=2 shard.count=16 ...                     one of 16 processes, on any machine
  cflow flow engine=ray engine.address=auto ...                   on a Ray cluster
  cflow flow data=av2 data.root=s3://bucket/val output=s3://bucket/flow
  cflow flow data=hdf5 data.root=/data/scenes result_name=cflow
  cflow flow /data/drive tracks=true
"""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import Any, Callable, NamedTuple, Sequence

from omegaconf import DictConfig, OmegaConf
from tqdm import tqdm

from cflow_torch.applications.track_table import TRACKS_FILE, read_tracks, write_kitti, write_mot, write_tracks
from cflow_torch.applications.tracking import track
from cflow_torch.cli import run
from cflow_torch.cli.run import Failures, Sources
from cflow_torch.data.atomic import ensure_writable
from cflow_torch.data.flow_file import CONTENTS, ON_REQUEST, read_flow
from cflow_torch.data.hdf5.writer import check_result_name, check_writable, write_hdf5_results
from cflow_torch.data.paths import as_path
from cflow_torch.fleet.job import Job, Shard, find_shard
from cflow_torch.fleet.machine import AUTO, choose_layout, frames_per_worker
from cflow_torch.fleet.manifest import check_folder, claim_folder, complete_frames, frame_file, make_identity
from cflow_torch.fleet.run import count_frames, forecast, format_missing, format_report, report_file, run_fleet
from cflow_torch.fleet.work import source_name
from cflow_torch.types import CFlowError

_FOR_TRACKS = {"residual", "cluster_id", "is_valid", "confidence"}  # contents
_TRACK_FORMATS = {"mot": write_mot, "kitti": write_kitti}


class FlowRun(NamedTuple):
    """The logs, the job and this process's share of a run."""

    sources: Sources
    job: Job
    shard: Shard


def task(cfg: DictConfig) -> None:
    compute(cfg, _contents(cfg, run.make_model(cfg).config.method == "verified"), _check_results, _write_more)


def compute(
    cfg: DictConfig,
    contents: tuple[str, ...],
    check: Callable[[DictConfig, FlowRun], None],
    use: Callable[[DictConfig, FlowRun, dict[str, Any]], Failures],
) -> None:
    """Write the flow of all logs of a shard to files, print the report, and exit with its status if something failed.

    With dry_run=true, count the frames instead. A job of a sweep raises `UnfinishedJob` if something failed.

    Args:
        contents: columns of a flow file.
        check: called before anything is computed; raises an error if the logs cannot be used.
        use: called with the report, unless a signal has stopped the run; returns what failed.
    """
    shard, output = find_shard(cfg.shard.index, cfg.shard.count, os.environ), run.output_folder(cfg)
    settings: dict[str, Any] = OmegaConf.to_container(cfg, resolve=True)  # type: ignore[assignment]
    engine = dict(settings["engine"])
    name, workers, batch = (engine.pop(key) for key in ("name", "workers", "batch"))
    layout = choose_layout(cfg.device, workers, batch, os.environ)
    config = run.make_model(cfg).config
    sources = run.find_logs(cfg)
    identity = make_identity(config, sources.reader, sources.settings, contents)
    job = Job(
        config=config,
        identity=identity["hash"],
        reader=sources.reader,
        settings=sources.settings,
        output=str(output),
        contents=contents,
        batch=layout.batch,
        redo=cfg.overwrite,
    )
    claim = (output, identity, cfg.resume, cfg.overwrite, shard.count == 1)
    parts = shard.parts(sources.logs)
    if cfg.dry_run:
        check_folder(*claim)
        print(forecast(job, parts))
        return
    flow = FlowRun(sources, job, shard)
    check(cfg, flow)
    ensure_writable(output)
    claim_folder(*claim)
    run.write_config(cfg, output)
    if name == "local" and workers == AUTO and layout.devices[0] == "cpu":
        least, count = frames_per_worker(config), 0
        for _, _, todo in count_frames(job, parts):
            count += todo
            if count >= least * len(layout.devices):
                break
        layout = layout._replace(devices=layout.devices[: max(1, count // least)])
    about = {"config": settings, "versions": run.versions()}
    report = run_fleet(job, sources.logs, layout, shard, name, about, **engine)
    failures = [] if report["stopped_by"] else use(cfg, flow, report)  # a signal leaves no time for this
    file, status = report_file(job.output, shard), report["exit_status"] or int(bool(failures))
    print(f"{format_report(report, cfg.verbose)}\nflow files in {job.output}, report in {file}")
    if status:
        missing = format_missing(report) + "".join(f"\n  {scene}: {message}" for scene, message in failures)
        print(f"missing:\n{missing}", file=sys.stderr)
        if run.is_sweep():  # Hydra runs the other jobs before it exits with status 1
            raise run.UnfinishedJob(f"some frames are missing: see {file}")
        raise SystemExit(status)


def _check_results(cfg: DictConfig, flow: FlowRun) -> None:
    if cfg.result_name is None:
        return
    if cfg.data.get("name") != "hdf5":
        raise CFlowError("result_name= writes into HDF5 scenes: give data=hdf5")
    if flow.shard.count > 1:
        raise CFlowError("result_name= needs the flow of whole scenes: give it in a last run without shards")
    check_result_name(cfg.result_name)
    for scene in flow.sources.logs:
        check_writable(scene)


def _contents(cfg: DictConfig, has_confidence: bool) -> tuple[str, ...]:
    allowed = (*CONTENTS, *ON_REQUEST) if has_confidence else CONTENTS
    if cfg.contents == "auto":
        return allowed
    given = list(cfg.contents) if OmegaConf.is_list(cfg.contents) else [cfg.contents]
    if not given or set(given) - set(allowed):
        why = "" if has_confidence else "; only model=default and offline have a confidence"
        raise CFlowError(f"contents={given}: give auto, or some of {', '.join(allowed)}{why}")
    needed = set(CONTENTS) if cfg.result_name is not None else set()
    if cfg.tracks:
        needed |= _FOR_TRACKS & set(allowed)
    missing = sorted(needed - set(given))
    if missing:
        raise CFlowError(f"contents={given}: result_name= and tracks= read the flow files: add {', '.join(missing)}")
    return tuple(name for name in allowed if name in given)


def _write_more(cfg: DictConfig, flow: FlowRun, report: dict[str, Any]) -> Failures:
    """Write the scenes and the tracks that the settings ask for."""
    output, failures = as_path(flow.job.output), []
    if cfg.result_name is not None:
        failures = _into_scenes(cfg.result_name, flow.sources.logs, output)
    return failures + (_write_tracks(cfg.tracks, flow, output) if cfg.tracks else [])


def _write_tracks(kind: Any, flow: FlowRun, output: Path) -> Failures:
    """Write the tracks of each log of this shard. Skip logs with incomplete frames, in this or another shard."""
    failures: Failures = []
    stored = run.stored_flow(output, ())
    for part in tqdm(flow.shard.parts(flow.sources.logs), desc="tracks", unit="log", disable=None):
        with run.collect_failures(failures, source_name(part.source)):
            log = flow.sources.open(part.source)
            folder = output / log.log_id
            stamps = [int(stamp) for stamp in log.timestamps[:-1]]
            if not complete_frames(folder) >= set(stamps):
                continue
            if not (folder / TRACKS_FILE).exists():
                results = ((index, stored(log, index)) for index in range(len(stamps)))
                write_tracks(folder / TRACKS_FILE, track(log, results))
            if kind in _TRACK_FORMATS:
                _TRACK_FORMATS[kind](folder / f"{kind}.txt", read_tracks(folder / TRACKS_FILE), log)
    return failures


def _into_scenes(name: str, scenes: Sequence[Path], output: Path) -> Failures:
    """Copy the flow files into their scenes. A scene that cannot be written stays as it was and is reported."""
    failures: Failures = []
    count = 0
    for scene in tqdm(scenes, desc=name, unit="scene", disable=None):
        folder = output / scene.stem
        stamps = sorted(complete_frames(folder))
        with run.collect_failures(failures, scene.stem):
            count += write_hdf5_results(scene, name, ((t, read_flow(frame_file(folder, t)).flow) for t in stamps))
    print(f"sweeps with a key {name} written into their scene: {count} (the last sweep of a scene has no flow)")
    return failures
