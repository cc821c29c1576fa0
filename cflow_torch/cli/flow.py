"""Estimates the flow of every pair of sweeps: OUTPUT/<log id>/<time stamp of sweep t>.feather.

Each file has one row per point of sweep t. Columns: flow_t{x,y,z}_m total flow, residual_t{x,y,z}_m motion of objects,
pose_t{x,y,z}_m ego motion (float32, metres until the next sweep, in the ego frame at t+1), cluster_id, score, is_valid.
There is also a column confidence, unless model=paper or keypoints. contents=[residual,is_valid] writes only these
columns: files are much smaller, and the flow and pose follow from the poses.

OUTPUT/config.yaml contains the settings and versions, OUTPUT/reports what was done. Run the command again to resume.
After Ctrl-C, SIGTERM or SIGHUP the run finishes the frames that it has begun. The exit status is 0 if every frame is
complete, 1 if one is missing, 2 if the call was wrong, and 128 + n after signal number n. The report has the time of
each stage, and verbose=true prints it.

result_name=NAME also writes the total flow into the HDF5 scenes, as key NAME of every sweep, where the viewers of
OpenSceneFlow read it. tracks=true also writes OUTPUT/<log id>/tracks.parquet when all frames of a log are complete: one
row per moving object and sweep, with id, box and velocity. tracks=mot and tracks=kitti add OUTPUT/<log id>/mot.txt or
kitti.txt, the tracks in these formats.

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
from cflow_torch.data.atomic import ensure_writable, write_text
from cflow_torch.data.flow_file import CONTENTS, ON_REQUEST, read_flow
from cflow_torch.data.hdf5.results import check_result_name, check_writable, write_hdf5_results
from cflow_torch.data.paths import as_path
from cflow_torch.fleet.job import Job, Shard, find_shard
from cflow_torch.fleet.machine import AUTO, choose_layout, frames_per_worker
from cflow_torch.fleet.manifest import claim_folder, complete_frames, find_conflict, frame_file, make_identity
from cflow_torch.fleet.report import count_todo, forecast, format_missing, format_report
from cflow_torch.fleet.run import report_file, run_fleet
from cflow_torch.fleet.work import source_name
from cflow_torch.types import CFlowError

_FOR_TRACKS = {"residual", "cluster_id", "is_valid"}  # contents
_TRACK_FORMATS = {"mot": write_mot, "kitti": write_kitti}


class FlowRun(NamedTuple):
    """The logs, the job and the report of a run."""

    sources: Sources
    job: Job
    report: dict[str, Any]


def task(cfg: DictConfig) -> None:
    shard = find_shard(cfg.shard.index, cfg.shard.count, os.environ)
    if cfg.result_name is not None:
        _check_results(cfg, shard)
    if cfg.tracks not in (False, True, *_TRACK_FORMATS):
        raise CFlowError(f"tracks={cfg.tracks}: give true, false, {' or '.join(_TRACK_FORMATS)}")
    contents = _contents(cfg, run.make_model(cfg).config.method == "verified")
    done = compute(cfg, shard, contents, _check_scenes if cfg.result_name is not None else None)
    if done is None:
        return
    failures: Failures = []
    if cfg.result_name is not None and done.report["stopped_by"] is None:  # a signal leaves no time for this
        failures = _into_scenes(cfg.result_name, done.sources.logs, as_path(done.job.output))
    if cfg.tracks and done.report["stopped_by"] is None:
        failures += _write_tracks(cfg.tracks, done.sources, shard, as_path(done.job.output))
    finish(done, shard, failures, cfg.verbose)


def compute(
    cfg: DictConfig, shard: Shard, contents: tuple[str, ...], check: Callable[[Job, Sources], None] | None = None
) -> FlowRun | None:
    """Write the flow of all logs of a shard to files. With dry_run=true, count the frames and return None.

    `contents` are the columns of a flow file. `check` is called before anything is computed, and raises an error if the
    logs are not usable.
    """
    output = run.output_folder(cfg)
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
    if cfg.dry_run:
        conflict = find_conflict(output, identity, cfg.resume or cfg.overwrite)
        print(forecast(job, shard.units(sources.logs)))
        if conflict is not None:
            print(f"{output} has results of another run{conflict}; overwrite=true would replace them")
        return None
    if check is not None:
        check(job, sources)
    kept = {**{key: settings.get(key) for key in ("model", "data", "result_name")}, "versions": run.versions()}
    ensure_writable(output)
    claim_folder(output, identity, cfg.resume, cfg.overwrite, shard.count == 1)
    write_text(output / "config.yaml", OmegaConf.to_yaml(OmegaConf.create(kept)))
    about = {"config": settings, "versions": run.versions()}
    if name == "local" and workers == AUTO and layout.devices[0] == "cpu":
        least = frames_per_worker(config)
        count = count_todo(job, shard.units(sources.logs), least * len(layout.devices))
        layout = choose_layout(cfg.device, workers, batch, os.environ, count // least)
    return FlowRun(sources, job, run_fleet(job, sources.logs, layout, shard, name, about, **engine))


def finish(done: FlowRun, shard: Shard, failures: Failures, verbose: bool) -> None:
    """Print the report, with `verbose` also the times of the stages, and exit with its status if something is missing.

    `failures` are those of later steps, such as tracks. A job of a sweep raises `UnfinishedJob` instead.
    """
    report, file = done.report, report_file(done.job.output, shard)
    status = report["exit_status"] or int(bool(failures))
    print(f"{format_report(report, verbose)}\nflow files in {done.job.output}, report in {file}")
    if status:
        missing = format_missing(report) + "".join(f"\n  {scene}: {message}" for scene, message in failures)
        print(f"missing:\n{missing}", file=sys.stderr)
        if run.is_sweep():  # Hydra runs the other jobs before it exits with status 1
            raise run.UnfinishedJob(f"some frames are missing: see {file}")
        raise SystemExit(status)


def _check_scenes(job: Job, sources: Sources) -> None:
    for scene in sources.logs:
        check_writable(scene)


def _check_results(cfg: DictConfig, shard: Shard) -> None:
    if cfg.data.get("name") != "hdf5":
        raise CFlowError("result_name= writes into HDF5 scenes: give data=hdf5")
    if shard.count > 1:
        raise CFlowError("result_name= needs the flow of whole scenes: give it in a last run without shards")
    check_result_name(cfg.result_name)


def _contents(cfg: DictConfig, has_confidence: bool) -> tuple[str, ...]:
    allowed = (*CONTENTS, *ON_REQUEST)
    if cfg.contents == "auto":
        return allowed if has_confidence else CONTENTS
    given = list(cfg.contents) if OmegaConf.is_list(cfg.contents) else [cfg.contents]
    if not given or set(given) - set(allowed):
        raise CFlowError(f"contents={given}: give auto, or some of {', '.join(allowed)}")
    if "confidence" in given and not has_confidence:
        raise CFlowError(f"contents={given}: only model=default and offline have a confidence")
    if cfg.result_name is not None and not set(given) >= set(CONTENTS):
        raise CFlowError("result_name= reads the flow files: it needs all contents")
    needed = _FOR_TRACKS | {"confidence"} if has_confidence else _FOR_TRACKS
    if cfg.tracks and not set(given) >= needed:
        raise CFlowError(f"tracks=true reads the flow files: contents needs {', '.join(sorted(needed))}")
    return tuple(name for name in allowed if name in given)


def _write_tracks(kind: Any, sources: run.Sources, shard: Shard, output: Path) -> Failures:
    """Write the tracks of each log of this shard whose frames are all complete, also those of other shards."""
    failures: Failures = []
    flow = run.stored_flow(output, ())
    for unit in tqdm(shard.units(sources.logs), desc="tracks", unit="log", disable=None):
        with run.collect_failures(failures, source_name(unit.source)):
            log = sources.open(unit.source)
            folder = output / log.log_id
            stamps = [int(stamp) for stamp in log.timestamps[:-1]]
            if not complete_frames(folder) >= set(stamps):
                continue
            if not (folder / TRACKS_FILE).exists():
                results = ((index, flow(log, index)) for index in range(len(stamps)))
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
