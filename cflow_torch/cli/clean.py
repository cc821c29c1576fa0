"""Writes logs without dynamic objects: OUTPUT/<log id>, a folder of point clouds, poses, times and ground masks.

data=arrays reads such a folder. A point is dynamic if its residual flow is at least 0.05 m per sweep.
remove_stopped=true tracks objects and also removes those that move at another time, such as a waiting car. map=true
also writes OUTPUT/<log id>.ply, the static points in the world, one per voxel, and a picture of them, <log id>.png.
We keep the other columns of cloud folders, bags, Argoverse 2 and PandaSet, such as intensity, and poses in
VIEWPOINT of .pcd files. A log is written as a
whole or not at all. Run the command again to write the missing logs. OUTPUT/config.yaml has settings and versions.

examples:
  cflow clean /data/drive map=true voxel_size=0.2            any recognised format, such as a bag
  cflow clean data=av2 data.root=/data/av2/val remove_stopped=true
  cflow clean /data/drive flow=outputs/flow                  with the output of `cflow flow`
"""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Callable

import numpy as np
from omegaconf import DictConfig

from cflow_torch.applications.cleaning import CleanLog, static_map
from cflow_torch.cli import run
from cflow_torch.data.arrays import ArraysLog, write_array_log
from cflow_torch.data.arrays.bin_layout import KITTI_COLUMNS
from cflow_torch.data.arrays.cloud_file import SUFFIXES, write_cloud
from cflow_torch.data.read_as import read_as
from cflow_torch.types import CFlowError, FlowResult
from cflow_torch.viz.bev import plot_map, save_picture
from cflow_torch.windows.readings import WORLD


def task(cfg: DictConfig) -> None:
    output = run.local_folder(cfg)
    if cfg.suffix is not None and cfg.suffix not in SUFFIXES:
        raise CFlowError(f"suffix={cfg.suffix}: give one of {', '.join(SUFFIXES)}")
    needed = ("residual_flow", "cluster_id", "is_valid")
    stored = None if cfg.flow is None else run.stored_flow(cfg.flow, needed)
    model = None if stored is not None else run.make_model(cfg)
    logs, failures = run.open_logs(cfg)
    run.claim_output(cfg, output, ("device", "map"))
    for log in logs:
        folder, file = output / log.log_id, output / f"{log.log_id}.ply"
        flow: Callable[[int], FlowResult] | None = None if stored is None else partial(stored, log)
        with run.collect_failures(failures, log.log_id):
            own, more = log.unwrapped, ""
            suffix = cfg.suffix or (own.files[0].suffix.lower() if isinstance(own, ArraysLog) else ".npy")
            viewpoint = None
            if suffix == ".pcd" and getattr(own, "has_viewpoints", False):  # the same form again
                viewpoint = "world" if getattr(log, "read_as", None) == WORLD else "sensor"
            if not folder.exists():
                clean = CleanLog(log, model, flow, cfg.remove_stopped)
                write_array_log(clean, output, suffix, viewpoint)
                if clean.num_stopped is not None:
                    more = f"; remove_stopped removed {clean.num_stopped} more points"
            bin_columns = max(3 + len(log.columns(0)), KITTI_COLUMNS) if suffix == ".bin" else KITTI_COLUMNS
            to_read = "" if bin_columns == KITTI_COLUMNS else f", read them with data.bin_columns={bin_columns}"
            print(f"{folder}: {len(log.timestamps)} sweeps{to_read}{more}")
            if cfg.map and not file.exists():
                written = ArraysLog(folder, ground=None, bin_columns=bin_columns)
                points = static_map(read_as(written, WORLD if viewpoint == "world" else None), cfg.voxel_size)
                write_cloud(file, points)
                print(f"{file}: {len(points)} points{_draw(points, file.with_suffix('.png'))}")
    run.finish(failures)


def _draw(points: np.ndarray, file: Path) -> str:
    """Draw the map if matplotlib is installed, and name the picture."""
    try:
        return f", drawn in {save_picture(plot_map(points, file.stem), file)}"
    except CFlowError as error:
        return f" (no picture: {error})"
