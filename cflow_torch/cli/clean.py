"""Remove dynamic objects from logs, and build static maps: `cflow clean`."""

from __future__ import annotations

import shutil
from functools import partial
from pathlib import Path
from typing import Any, Callable

import numpy as np

from cflow_torch.applications.clean_files import own_suffix, stored_masks, write_clean_log
from cflow_torch.applications.cleaning import CleanLog, MaskedLog, static_map_with_intensity
from cflow_torch.cli.commands import Clean
from cflow_torch.cli.failures import collect_failures, finish
from cflow_torch.cli.logs import open_logs
from cflow_torch.cli.outputs import check_made_by, local_folder, made_by, write_config
from cflow_torch.cli.stored_flow import method_of_flow, stored_flow
from cflow_torch.data.arrays import ArraysLog
from cflow_torch.data.arrays.bin_layout import KITTI_COLUMNS
from cflow_torch.data.arrays.cloud_file import SUFFIXES, write_cloud
from cflow_torch.data.atomic import ensure_writable
from cflow_torch.data.json_file import read_json, write_json
from cflow_torch.data.log import Log
from cflow_torch.errors import import_optional
from cflow_torch.estimate import make_model
from cflow_torch.fleet.changes import OVERWRITE
from cflow_torch.fleet.manifest import describe_log
from cflow_torch.types import CFlowError
from cflow_torch.viz.bev import plot_map, save_picture

_NEEDED = ("residual_flow", "cluster_id", "is_valid")  # of flow files


def task(cfg: Clean) -> None:
    output = local_folder(cfg)
    if cfg.suffix is not None and cfg.suffix not in SUFFIXES:
        raise CFlowError(f"suffix={cfg.suffix}: give one of {', '.join(SUFFIXES)}")
    if cfg.suffix == ".pcd":
        import_optional("pypcd4", "suffix=.pcd needs pypcd4 (extra clouds): pip install pypcd4")
    clean = _cleaner(cfg)
    logs, failures = open_logs(cfg.data)
    is_new = {log.log_id: _is_new(cfg, log, output) for log in logs}
    write_config(cfg, ensure_writable(output))
    for log in logs:
        with collect_failures(failures, log.log_id):
            _claim(cfg, log, output, is_new.pop(log.log_id, False))
            _write(cfg, log, output, clean)
    finish(failures)


def _cleaner(cfg: Clean) -> Callable[[Log], CleanLog]:
    """Return a function that makes the clean log, by the flow of earlier files or by the method."""
    if cfg.flow is None:
        model = make_model(cfg.model, cfg.device)
        return lambda log: CleanLog(log, model, None, cfg.remove_stopped)
    stored = stored_flow(cfg.flow, _NEEDED)
    return lambda log: CleanLog(log, None, partial(stored, log), cfg.remove_stopped)


def _is_new(cfg: Clean, log: Log, output: Path) -> bool:
    """Test whether a log is to be written. A folder with results of other settings or sweeps is a `CFlowError`."""
    if not (output / log.log_id).exists() or cfg.overwrite:
        return True
    _check(cfg, log, output)
    return False


def _check(cfg: Clean, log: Log, output: Path) -> None:
    """Raise a `CFlowError` if the folder of a log has results of other settings or sweeps."""
    folder = output / log.log_id
    file = _record_file(folder)
    before: dict[str, Any] = read_json(file) if file.exists() else {}
    remedy = "rename one of two logs of this name" if cfg.overwrite else OVERWRITE
    check_made_by(cfg, folder, before, _record(cfg, log), remedy)


def _claim(cfg: Clean, log: Log, output: Path, is_new: bool) -> None:
    """Remove the older results of a log that is to be written, and record its settings."""
    folder = output / log.log_id
    if not is_new:
        _check(cfg, log, output)  # another log of this run may have its name
        return
    shutil.rmtree(folder, ignore_errors=True)
    for suffix in (".ply", ".png"):
        folder.with_name(f"{log.log_id}{suffix}").unlink(missing_ok=True)
    write_json(_record_file(folder), _record(cfg, log))


def _record(cfg: Clean, log: Log) -> dict[str, Any]:
    """Return what the clean points follow from: settings, versions, sweeps, and the method of stored flow."""
    made = made_by(cfg, log=describe_log(log))
    for name in ("root", "label"):  # several logs, which may be elsewhere tomorrow
        made["data"].pop(name, None)
    if cfg.flow is not None:
        del made["model"]  # it is not used
        made["flow_by"] = method_of_flow(cfg.flow, log.log_id)
    return made


def _record_file(folder: Path) -> Path:
    return folder.with_name(f"{folder.name}.json")


def _write(cfg: Clean, log: Log, output: Path, clean: Callable[[Log], CleanLog]) -> None:
    """Write the folder and the map of a log, if they do not exist, and print them."""
    folder = output / log.log_id
    file = output / f"{log.log_id}.ply"
    removed: Any = "it is complete"
    stopped = ""
    if not folder.exists():
        clean_log = clean(log)
        removed = write_clean_log(clean_log, log, output, cfg.suffix)
        if clean_log.num_stopped is not None:
            stopped = f"; remove_stopped removed {clean_log.num_stopped:,} of them"
    print(f"{folder}: {len(log.timestamps)} sweeps, {removed}{stopped}{_how_to_read(log, cfg.suffix)}")
    if cfg.map and not file.exists():
        points, intensity = static_map_with_intensity(MaskedLog(log, stored_masks(folder, log)), cfg.voxel_size)
        write_cloud(file, points, None if intensity is None else {"intensity": intensity})
        print(f"{file}: {len(points):,} points{_draw(points, file.with_suffix('.png'))}")


def _how_to_read(log: Log, suffix: str | None) -> str:
    """Return the setting that reads `.bin` files of several columns."""
    own = log.unwrapped
    if (suffix or own_suffix(log)).lower() != ".bin":
        return ""
    if isinstance(own, ArraysLog) and own.files[0].suffix.lower() == ".bin" and own.bin_layout is not None:
        columns = own.bin_layout.columns
    else:
        columns = max(3 + len(log.columns(0)), KITTI_COLUMNS)
    return "" if columns == KITTI_COLUMNS else f"; read them with data.bin_columns={columns}"


def _draw(points: np.ndarray, file: Path) -> str:
    """Draw the map if matplotlib is installed, and name the picture."""
    try:
        return f", drawn in {save_picture(plot_map(points, file.stem), file)}"
    except CFlowError as error:
        return f" (no picture: {error})"
