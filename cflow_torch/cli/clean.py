"""Remove dynamic objects from logs, and build static maps: `cflow clean`."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any, Callable

import numpy as np

from cflow_torch.applications.clean_files import RECORD_FILE, own_suffix, stored_masks, write_clean_log
from cflow_torch.applications.cleaning import CleanLog, MaskedLog, static_map_with_intensity
from cflow_torch.cli.commands import Clean
from cflow_torch.cli.failures import collect_failures, finish
from cflow_torch.cli.logs import open_logs
from cflow_torch.cli.outputs import check_made_by, local_folder, made_by, write_config
from cflow_torch.cli.stored_flow import interval_of_flow, method_of_flow, stored_flow
from cflow_torch.data.arrays import ArraysLog
from cflow_torch.data.arrays.bin_layout import KITTI_COLUMNS
from cflow_torch.data.arrays.cloud_file import SUFFIXES, write_cloud
from cflow_torch.data.atomic import ensure_writable
from cflow_torch.data.json_file import read_json, write_json
from cflow_torch.data.log import Log
from cflow_torch.data.paths import suffix_of
from cflow_torch.errors import import_optional
from cflow_torch.estimate import make_model
from cflow_torch.fleet.manifest import describe_log
from cflow_torch.types import CFlowError
from cflow_torch.viz.bev import plot_map, save_picture

MAP_FILE = "map.ply"  # next to its picture, map.png
_APPLIED = ("read_as", "poses_of", "ego_T_lidar")  # settings of the data that clean clouds and their poses contain
_NEEDED = ("residual_flow", "cluster_id", "is_valid", "moving")  # of flow files; remove_stopped needs confidence, too


def task(cfg: Clean) -> None:
    output = local_folder(cfg)
    if cfg.suffix is not None and cfg.suffix not in SUFFIXES:
        raise CFlowError(f"suffix={cfg.suffix}: give one of {', '.join(SUFFIXES)}")
    if cfg.suffix == ".pcd":
        import_optional("pypcd4", "suffix=.pcd needs pypcd4 (extra clouds): pip install pypcd4")
    clean = _cleaner(cfg)
    logs, failures = open_logs(cfg.data)
    is_written = {log.log_id: _is_written(cfg, log, output) for log in logs}
    write_config(cfg, ensure_writable(output))
    for log in logs:
        with collect_failures(failures, log.log_id):
            folder = output / log.log_id
            if log.log_id not in is_written:
                raise CFlowError(f"{folder} has another log of this run: rename one of two logs of this name")
            removed = "it is complete" if is_written.pop(log.log_id) else _write(cfg, log, output, clean)
            print(f"{folder}: {len(log.timestamps)} sweeps, {removed}{_how_to_read(cfg, log)}")
            if cfg.map and not _has_map(cfg, folder):
                print(_write_map(cfg, log, folder))
    finish(failures)


def _cleaner(cfg: Clean) -> Callable[[Log], CleanLog]:
    """Return a function that makes the clean log, by the flow of earlier files or by the method."""
    if cfg.flow is None:
        model = make_model(cfg.model, cfg.device)
        return lambda log: CleanLog(log, model, None, cfg.remove_stopped, cfg.model.sweep_interval)
    stored = stored_flow(cfg.flow, (*_NEEDED, "confidence") if cfg.remove_stopped else _NEEDED)
    return lambda log: CleanLog(log, None, partial(stored, log), cfg.remove_stopped, interval_of_flow(cfg, log.log_id))


def _is_written(cfg: Clean, log: Log, output: Path) -> bool:
    """Test whether the folder of a log stays as it is.

    A folder that is not ours, that holds the log itself, or that has results of other settings or sweeps is a
    `CFlowError`.
    """
    folder = output / log.log_id
    if not folder.exists():
        return False
    if not (folder / RECORD_FILE).exists():
        raise CFlowError(f"{folder} exists and is not a result of `cflow clean`: give output=FOLDER")
    own = log.unwrapped
    if isinstance(own, ArraysLog) and folder.resolve() in own.files[0].resolve().parents:
        raise CFlowError(f"{folder} has the log that is to be cleaned: give output=FOLDER")
    if not cfg.overwrite:
        check_made_by(cfg, folder, read_json(folder / RECORD_FILE), _record(cfg, log))
    return not cfg.overwrite


def _record(cfg: Clean, log: Log) -> dict[str, Any]:
    """Return what the clean points follow from: settings, versions, sweeps, and the method of stored flow."""
    made = made_by(cfg, log=describe_log(log))
    for name in ("root", "label"):  # several logs, which may be elsewhere tomorrow
        made["data"].pop(name, None)
    if cfg.flow is not None:
        del made["model"]  # it is not used
        made["flow_by"] = method_of_flow(cfg.flow, log.log_id)
        made["sweep_interval"] = interval_of_flow(cfg, log.log_id)
    return made


def _write(cfg: Clean, log: Log, output: Path, clean: Callable[[Log], CleanLog]) -> str:
    """Write the folder of a log in place of an older one of ours, and return what was removed."""
    clean_log = clean(log)
    removed = write_clean_log(clean_log, log, output, cfg.suffix, _record(cfg, log), cfg.overwrite)
    if clean_log.num_stopped is None:
        return str(removed)
    return f"{removed}; remove_stopped removed {clean_log.num_stopped:,} of them"


def _has_map(cfg: Clean, folder: Path) -> bool:
    """Test whether the folder of a log has its map with these voxels."""
    return (folder / MAP_FILE).exists() and read_json(folder / RECORD_FILE)["voxel_size"] == cfg.voxel_size


def _write_map(cfg: Clean, log: Log, folder: Path) -> str:
    """Write the map of a log into its folder, in place of one with other voxels, and return a line with its files."""
    file = folder / MAP_FILE
    points, intensity = static_map_with_intensity(MaskedLog(log, stored_masks(folder, log)), cfg.voxel_size)
    for older in (file, file.with_suffix(".png")):  # first, so that the record below is never that of another map
        older.unlink(missing_ok=True)
    write_json(folder / RECORD_FILE, {**read_json(folder / RECORD_FILE), "voxel_size": cfg.voxel_size})
    write_cloud(file, points, None if intensity is None else {"intensity": intensity})
    return f"{file}: {len(points):,} points{_draw(points, log.log_id, file.with_suffix('.png'))}"


def _how_to_read(cfg: Clean, log: Log) -> str:
    """Return which settings read the clean log: that of `.bin` files of several columns, and none that is applied."""
    how = [f"without data.{name}" for name in _APPLIED if cfg.data.get(name) not in (None, "auto")]
    own = log.unwrapped
    if (cfg.suffix or own_suffix(log)).lower() == ".bin":
        if isinstance(own, ArraysLog) and suffix_of(own.files[0]) == ".bin" and own.bin_layout is not None:
            columns = own.bin_layout.columns
        else:
            columns = max(3 + len(log.columns(0)), KITTI_COLUMNS)
        if columns != KITTI_COLUMNS:
            how.append(f"with data.bin_columns={columns}")
    return f"; read them {' and '.join(how)}" if how else ""


def _draw(points: np.ndarray, title: str, file: Path) -> str:
    """Draw the map if matplotlib is installed, and name the picture."""
    try:
        return f", drawn in {save_picture(plot_map(points, title), file)}"
    except CFlowError as error:
        return f" (no picture: {error})"
