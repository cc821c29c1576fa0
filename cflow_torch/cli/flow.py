"""Estimate the flow of every pair of sweeps: `cflow flow`."""

from __future__ import annotations

import os
import sys
from contextlib import suppress
from dataclasses import asdict
from functools import partial
from itertools import islice
from pathlib import Path
from time import perf_counter
from typing import Any, Callable, Iterable, Iterator, NamedTuple, Sequence

import numpy as np
from tqdm import tqdm

from cflow_torch.applications.detection_files import (
    DETECTIONS_FILE,
    OPENPCDET_FILE,
    TRACKING_FILE,
    write_nuscenes,
    write_openpcdet,
)
from cflow_torch.applications.instance_files import (
    CLASSES,
    CLASSES_OF_READER,
    FRAMES_FILE,
    INSTANCES_FILE,
    write_drivestudio,
)
from cflow_torch.applications.kitti_tracks import write_kitti
from cflow_torch.applications.masks import check_cameras, check_pillow, write_masks
from cflow_torch.applications.moving_labels import write_moving_labels
from cflow_torch.applications.track_table import TRACKS_FILE, read_tracks, write_mot, write_tracks
from cflow_torch.applications.tracking import track_points
from cflow_torch.cli.commands import Flow, FlowFiles
from cflow_torch.cli.failures import Failures, UnfinishedJob, collect_failures, is_sweep
from cflow_torch.cli.flows import stored_flow
from cflow_torch.cli.logs import chosen_pairs, find_logs
from cflow_torch.cli.outputs import output_folder, settings_record, versions, write_config
from cflow_torch.data.atomic import ensure_writable
from cflow_torch.data.catalog import Logs, source_name
from cflow_torch.data.flow_file import CONTENTS, ON_REQUEST, POINTS, add_track_ids, has_track_ids, read_flow
from cflow_torch.data.hdf5.writer import check_result_name, check_writable, write_hdf5_results
from cflow_torch.data.json_file import write_json
from cflow_torch.data.log import Log
from cflow_torch.data.paths import as_path
from cflow_torch.fleet.job import Job, Part, Shard, find_shard
from cflow_torch.fleet.machine import Layout, choose_layout, frames_per_worker
from cflow_torch.fleet.manifest import (
    check_logs,
    clear_log,
    complete_frames,
    frame_file,
    labels_folder,
    make_identity,
    masks_folder,
)
from cflow_torch.fleet.parallel import local_executors
from cflow_torch.fleet.ray_engine import ray_executors
from cflow_torch.fleet.run import count_frames, forecast, format_missing, format_report, report_file, run_fleet
from cflow_torch.fleet.work import open_quickly
from cflow_torch.setting import AUTO
from cflow_torch.types import CFlowError, FlowResult

_ENGINES: dict[str, Callable[..., Any]] = {"local": local_executors, "ray": ray_executors}
_FOR_TRACKS = {"residual", "cluster_id", "is_valid", "confidence"}  # contents
_FOR_MOVING = {"residual", "moving"}
_TRACK_FILES = {
    "mot": ("mot.txt", write_mot),
    "kitti": ("kitti.txt", write_kitti),
    "openpcdet": (OPENPCDET_FILE, write_openpcdet),
}


class FlowRun(NamedTuple):
    """The logs, the job and this process's share of a run."""

    logs: Logs
    job: Job
    shard: Shard

    @property
    def parts(self) -> list[Part]:
        """The logs of this shard, or the parts of them that are its own."""
        return self.shard.parts(self.logs.sources)

    def open_logs(self) -> Iterator[Log]:
        """Open the logs of this shard one by one, without what takes time."""
        for part in self.parts:
            with suppress(Exception), open_quickly(self.job, part.source) as log:  # the worker reports the error
                yield log


def compute(
    cfg: Any,
    contents: Callable[[Any], tuple[str, ...]],
    check: Callable[[Any, FlowRun], None],
    use: Callable[[Any, FlowRun, dict[str, Any]], Failures],
) -> None:
    """Write the flow of all logs of a shard to files, print the report, and exit with its status if something failed.

    With dry_run=true, count the frames instead. A job of a sweep raises `UnfinishedJob` if something failed.

    Args:
        cfg: settings of the class `FlowFiles`.
        contents: returns the columns of a flow file.
        check: called before anything is computed; raises an error if the logs cannot be used.
        use: called with the report, unless a signal has stopped the run; returns what failed.
    """
    columns = contents(cfg)
    layout = choose_layout(cfg.device, cfg.engine.workers, cfg.engine.batch, os.environ)
    logs = find_logs(cfg.data)
    output = output_folder(cfg)
    job = Job(
        config=cfg.model,
        identity=make_identity(cfg.model, logs.name, logs.settings, columns),
        reader=logs.name,
        settings=dict(logs.settings),
        output=str(output),
        contents=columns,
        batch=layout.batch,
        redo=cfg.overwrite,
    )
    flow = FlowRun(logs, job, find_shard(cfg.shard.index, cfg.shard.count, os.environ))
    _check_output(cfg, flow, check)
    if cfg.dry_run:
        print(forecast(job, flow.parts))
        return
    write_config(cfg, output)
    layout = _useful_workers(cfg, flow, layout)
    settings = asdict(cfg.engine)
    name = settings.pop("name")
    own = {key: value for key, value in settings.items() if key not in ("workers", "batch")}
    with _ENGINES[name](job, layout, **own) as executors:
        parts = flow.shard.parts(logs.sources, len(layout.devices))
        about = {"config": settings_record(cfg), "versions": versions()}
        report = run_fleet(executors, parts, layout, flow.shard, job.output, name, about)
    _finish(cfg, flow, report, use)


def _check_output(cfg: FlowFiles, flow: FlowRun, check: Callable[[Any, FlowRun], None]) -> None:
    """Make sure that the results may be added to the output, and clear what is replaced."""
    output = as_path(flow.job.output)
    is_alone = flow.shard.count == 1
    if not cfg.dry_run:
        check(cfg, flow)
        ensure_writable(output)
    names = [source_name(part.source) for part in flow.parts]
    check_logs(output, names, flow.job.identity, cfg.overwrite, is_alone)
    if cfg.overwrite and is_alone and not cfg.dry_run:
        for log in flow.open_logs():
            clear_log(output / log.log_id)


def _useful_workers(cfg: FlowFiles, flow: FlowRun, layout: Layout) -> Layout:
    """Leave out workers that would not save time, because few frames are left to do."""
    if cfg.engine.name != "local" or cfg.engine.workers != AUTO or layout.devices[0] != "cpu":
        return layout
    least = frames_per_worker(cfg.model)
    count = 0
    for _, _, todo in count_frames(flow.job, flow.parts):  # opens a log after the other
        count += todo
        if count >= least * len(layout.devices):
            break
    return layout._replace(devices=layout.devices[: max(1, count // least)])


def _finish(
    cfg: FlowFiles, flow: FlowRun, report: dict[str, Any], use: Callable[[Any, FlowRun, dict[str, Any]], Failures]
) -> None:
    """Use the flow, print the report and what is missing, and exit with the status of the run unless it is complete."""
    file = report_file(flow.job.output, flow.shard)
    failures: Failures = []
    if not report["stopped_by"]:  # a signal leaves no time for this
        begin = perf_counter()
        failures = use(cfg, flow, report)
        report["seconds"] += perf_counter() - begin
        with suppress(OSError):  # the run has reported it
            write_json(file, report)
    print(f"{format_report(report)}\nflow files in {flow.job.output}, report in {file}")
    status = report["exit_status"] or int(bool(failures))
    if status:
        missing = format_missing(report) + "".join(f"\n  {scene}: {message}" for scene, message in failures)
        print(f"missing:\n{missing}", file=sys.stderr)
        if is_sweep():  # Hydra runs the other jobs before it exits with status 1
            raise UnfinishedJob(f"some frames are missing: see {file}")
        raise SystemExit(status)


def _check_results(cfg: Flow, flow: FlowRun) -> None:
    if cfg.masks:
        check_pillow()
        for log in islice(flow.open_logs(), 1):
            check_cameras(log, log.cameras(0))
    if cfg.result_name is None:
        return
    if cfg.data.get("name") != "hdf5":
        raise CFlowError("result_name= writes into HDF5 scenes: give data=hdf5")
    if flow.shard.count > 1:
        raise CFlowError("result_name= needs the flow of whole scenes: give it in a last run without shards")
    check_result_name(cfg.result_name)
    for scene in flow.logs.sources:
        check_writable(scene)


def _contents(cfg: Flow) -> tuple[str, ...]:
    has_confidence = cfg.model.method == "verified"
    allowed = (*CONTENTS, *ON_REQUEST) if has_confidence else CONTENTS
    if cfg.contents == "auto":
        return allowed
    allowed = (POINTS, *allowed)
    given = [cfg.contents] if isinstance(cfg.contents, str) else list(cfg.contents)
    if not given or set(given) - set(allowed):
        why = "" if has_confidence else "; only model=default, offline and live have a confidence"
        raise CFlowError(f"contents={given}: give auto, or some of {', '.join(allowed)}{why}")
    needed = set(CONTENTS) if cfg.result_name is not None else set()
    if cfg.tracks or cfg.masks:
        needed |= _FOR_TRACKS & set(allowed)
    if cfg.labels is not None or cfg.masks:
        needed |= _FOR_MOVING & set(allowed)
    missing = sorted(needed - set(given))
    if missing:
        readers = "result_name=, tracks=, labels= and masks= read the flow files"
        raise CFlowError(f"contents={given}: {readers}: add {', '.join(missing)}")
    return tuple(name for name in allowed if name in given)


def _write_more(cfg: Flow, flow: FlowRun, report: dict[str, Any]) -> Failures:
    """Write the scenes, the tracks and the labels that the settings ask for."""
    output, failures = as_path(flow.job.output), []
    if cfg.result_name is not None:
        failures = _into_scenes(cfg.result_name, flow.logs.sources, output)
    if cfg.tracks or cfg.masks or cfg.labels is not None:
        failures += _write_logs(cfg, flow, output)
    return failures


def _write_logs(cfg: Flow, flow: FlowRun, output: Path) -> Failures:
    """Write tracks, labels and masks of each log of this shard.

    We skip logs with incomplete frames, in this or another shard.
    """
    failures: Failures = []
    stored = stored_flow(output, ())
    # The flow files say which points are valid, so nothing here needs ground masks, and the log was checked before.
    cheap = {"check": False, "find_ground": None}
    logs = Logs(flow.logs.name, flow.logs.sources, {**flow.logs.settings, **cheap})
    wanted = [name for name in ("tracks", "labels", "masks") if getattr(cfg, name)]
    for part in tqdm(flow.parts, desc=" and ".join(wanted), unit="log", disable=None):
        with collect_failures(failures, source_name(part.source)):
            log = logs.open(part.source)
            pairs = chosen_pairs(log, first=0, step=1)  # the pair over a gap has no flow
            if not complete_frames(output / log.log_id) >= {int(log.timestamps[index]) for index in pairs}:
                continue
            results = partial(_read_all, stored, log, pairs)
            if cfg.tracks or cfg.masks:
                classes = CLASSES_OF_READER.get(logs.name, CLASSES)
                tqdm.write(_write_tracks(cfg.tracks, log, results, output / log.log_id, classes))
            if cfg.masks:
                tracks = read_tracks(output / log.log_id / TRACKS_FILE)
                masks = masks_folder(output, log.log_id)
                write_masks(masks, log, results(), tracks)
                tqdm.write(f"{masks}: masks of {len(pairs)} sweeps")
            if cfg.labels is not None:
                labels = labels_folder(output, log.log_id)
                write_moving_labels(labels, log, results())
                tqdm.write(f"{labels}: labels of {len(log.timestamps)} sweeps")
    return failures


def _read_all(
    stored: Callable[[Log, int], FlowResult], log: Log, pairs: Iterable[int]
) -> Iterator[tuple[int, FlowResult]]:
    shown = tqdm(pairs, desc=log.log_id, unit="sweep", leave=False, disable=None)
    return ((index, stored(log, index)) for index in shown)


def _write_tracks(
    kind: Any, log: Log, results: Callable[[], Iterator[tuple[int, FlowResult]]], folder: Path, classes: Sequence[Any]
) -> str:
    """Write the tracks of a log and the ids of its points, unless they exist, and then the form `kind`.

    `results` reads the flow files. Returns a line with the files.
    """
    frames = (frame_file(folder, log.timestamps[index]) for index in chosen_pairs(log, first=0, step=1))
    if not (folder / TRACKS_FILE).exists() or not all(map(has_track_ids, frames)):
        table, points = track_points(log, results())
        for each in points:
            add_track_ids(frame_file(folder, log.timestamps[each.sweep]), each.track_id(table["id"]))
        write_tracks(folder / TRACKS_FILE, table)  # last, so that a killed run begins again
    table = read_tracks(folder / TRACKS_FILE)
    files = [TRACKS_FILE]
    if kind in _TRACK_FILES:
        name, write = _TRACK_FILES[kind]
        write(folder / name, table, log)
        files.append(name)
    elif kind == "drivestudio":
        write_drivestudio(folder, table, log, *classes)
        files += [INSTANCES_FILE, FRAMES_FILE]
    elif kind == "nuscenes":
        write_nuscenes(folder, table, log)
        files += [DETECTIONS_FILE, TRACKING_FILE]
    return f"{folder}: {len(np.unique(table['id']))} tracks in {', '.join(files)}"


def _into_scenes(name: str, scenes: Sequence[Path], output: Path) -> Failures:
    """Copy the flow files into their scenes. A scene that cannot be written stays as it was and is reported."""
    failures: Failures = []
    count = 0
    for scene in tqdm(scenes, desc=name, unit="scene", disable=None):
        folder = output / scene.stem
        stamps = sorted(complete_frames(folder))
        with collect_failures(failures, scene.stem):
            count += write_hdf5_results(scene, name, ((t, read_flow(frame_file(folder, t)).flow) for t in stamps))
    print(f"sweeps with a key {name} written into their scene: {count} (the last sweep of a scene has no flow)")
    return failures


task = partial(compute, contents=_contents, check=_check_results, use=_write_more)
