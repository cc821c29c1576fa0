"""Estimate the flow of every pair of sweeps: `cflow flow`."""

from __future__ import annotations

from functools import partial
from itertools import islice
from pathlib import Path
from typing import Any, Callable, Iterable, Iterator

import numpy as np
from tqdm import tqdm

from cflow_torch.applications.instance_files import CAMERAS_OF_READER, write_drivestudio_masks
from cflow_torch.applications.masks import check_cameras, load_pillow, write_masks
from cflow_torch.applications.moving_labels import write_moving_labels
from cflow_torch.applications.track_table import TRACKS_FILE, read_tracks, write_tracks
from cflow_torch.applications.tracking import track_points
from cflow_torch.cli.commands import Flow
from cflow_torch.cli.failures import Failures, collect_failures
from cflow_torch.cli.flow_run import FlowRun
from cflow_torch.cli.stored_flow import stored_flow
from cflow_torch.cli.track_formats import TRACK_FORMATS
from cflow_torch.data.catalog import Logs, source_name
from cflow_torch.data.flow_file import CONTENTS, ON_REQUEST, POINTS, add_track_ids, has_track_ids, read_flow
from cflow_torch.data.hdf5.writer import check_result_name, check_writable, write_hdf5_results
from cflow_torch.data.log import CachedLog, Log, TimedLog
from cflow_torch.fleet.manifest import (
    complete_frames,
    drivestudio_masks_folder,
    frame_file,
    labels_folder,
    masks_folder,
)
from cflow_torch.types import CFlowError, FlowResult

_FOR_TRACKS = {"residual", "cluster_id", "is_valid", "confidence"}  # contents
_FOR_MOVING = {"residual", "moving"}


def task(cfg: Flow) -> None:
    run = FlowRun(cfg, _contents(cfg), cfg.overwrite)
    if cfg.dry_run:
        print(run.forecast())
        return
    _check_results(cfg, run)
    report = run.compute()
    failures: Failures = []
    if not report["stopped_by"] and cfg.result_name is not None:
        failures += _into_scenes(cfg.result_name, run)
    if not report["stopped_by"] and (cfg.tracks or cfg.masks or cfg.labels is not None):
        failures += _write_logs(cfg, run)
    run.finish(report, failures)


def _check_results(cfg: Flow, run: FlowRun) -> None:
    if cfg.masks:
        load_pillow()  # fails now if it is missing
        for log in islice(run.open_logs(), 1):
            check_cameras(log, log.cameras(0))
    if cfg.result_name is None:
        return
    if cfg.data.get("name") != "hdf5":
        raise CFlowError("result_name= writes into HDF5 scenes: give data=hdf5")
    if run.shard.count > 1:
        raise CFlowError("result_name= needs the flow of whole scenes: give it in a last run without shards")
    check_result_name(cfg.result_name)
    for scene in run.logs.sources:
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


def _write_logs(cfg: Flow, run: FlowRun) -> Failures:
    """Write tracks, labels and masks of each log of this shard.

    We skip logs with incomplete frames, in this or another shard.
    """
    failures: Failures = []
    output = run.output
    stored = stored_flow(output, ())
    logs = Logs(run.logs.name, run.logs.sources, {**run.logs.settings, "check": False})  # it was checked before
    wanted = [name for name in ("tracks", "labels", "masks") if getattr(cfg, name)]
    for part in tqdm(run.parts, desc=" and ".join(wanted), unit="log", disable=None):
        with collect_failures(failures, source_name(part.source)):
            log = TimedLog(CachedLog(logs.open(part.source), 2), cfg.model.sweep_interval)
            pairs = log.pairs  # the pair over a gap has no flow
            if not complete_frames(output / log.log_id) >= {int(log.timestamps[index]) for index in pairs}:
                tqdm.write(f"{log.log_id}: no {' and '.join(wanted)}, because frames are missing")
                continue
            results = partial(_read_all, stored, log, pairs)
            if cfg.tracks or cfg.masks:
                tqdm.write(_write_tracks(cfg.tracks, log, results, output / log.log_id, logs.name))
            if cfg.masks:
                tqdm.write(_write_masks(cfg.tracks == "drivestudio", log, logs.name, results(), output))
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
    kind: Any, log: Log, results: Callable[[], Iterator[tuple[int, FlowResult]]], folder: Path, data_set: str
) -> str:
    """Write the tracks of a log and the ids of its points, unless they exist, and then the form `kind`.

    `results` reads the flow files. Returns a line with the files.
    """
    frames = {index: frame_file(folder, log.timestamps[index]) for index in log.pairs}
    if not (folder / TRACKS_FILE).exists() or not all(map(has_track_ids, frames.values())):
        table, points = track_points(log, results())
        for each in points:
            if each.sweep in frames:  # others have no flow
                add_track_ids(frames[each.sweep], each.track_id(table["id"]))
        write_tracks(folder / TRACKS_FILE, table)  # last, so that a killed run begins again
    table = read_tracks(folder / TRACKS_FILE)
    files = [TRACKS_FILE]
    if kind in TRACK_FORMATS:
        TRACK_FORMATS[kind].write(folder, table, log, data_set)
        files += TRACK_FORMATS[kind].files
    return f"{folder}: {len(np.unique(table['id']))} tracks in {', '.join(files)}"


def _write_masks(
    is_for_drivestudio: bool, log: Log, reader: str, results: Iterable[tuple[int, FlowResult]], output: Path
) -> str:
    """Write the masks of a log, whose tracks are written. Returns a line with their folder."""
    tracks = read_tracks(output / log.log_id / TRACKS_FILE)
    if is_for_drivestudio:
        folder = drivestudio_masks_folder(output, log.log_id)
        write_drivestudio_masks(folder, log, results, tracks, CAMERAS_OF_READER.get(reader))
    else:
        folder = masks_folder(output, log.log_id)
        write_masks(folder, log, results, tracks)
    return f"{folder}: {sum(1 for _ in folder.glob('*/*.png'))} masks"


def _into_scenes(name: str, run: FlowRun) -> Failures:
    """Copy the flow files into their scenes. A scene that cannot be written stays as it was and is reported."""
    failures: Failures = []
    count = 0
    for scene in tqdm(run.logs.sources, desc=name, unit="scene", disable=None):
        folder = run.output / scene.stem
        stamps = sorted(complete_frames(folder))
        with collect_failures(failures, scene.stem):
            count += write_hdf5_results(scene, name, ((t, read_flow(frame_file(folder, t)).flow) for t in stamps))
    print(f"sweeps with a key {name} written into their scene: {count} (the last sweep of a scene has no flow)")
    return failures
