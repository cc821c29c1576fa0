"""Draw one pair of sweeps, or an animation of a log: `cflow plot`."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from cflow_torch.cli.commands import Animation, CorrelationPicture, FlowPicture, FromAbove, Plot
from cflow_torch.cli.failures import finish
from cflow_torch.cli.logs import check_pair, chosen_pairs, find_logs, paths_of
from cflow_torch.cli.outputs import chosen_preset, local_folder
from cflow_torch.cli.pairs import for_each_pair
from cflow_torch.data.atomic import ensure_writable
from cflow_torch.data.catalog import source_name
from cflow_torch.data.log import Log, window
from cflow_torch.errors import import_optional
from cflow_torch.estimate import make_model
from cflow_torch.model import SceneFlowModel
from cflow_torch.types import CFlowError, FlowResult, Window
from cflow_torch.viz.animation import AnimatedPair, flow_figures, save_animation
from cflow_torch.viz.bev import plot_flow, save_picture
from cflow_torch.viz.clusters import plot_clusters
from cflow_torch.viz.stage_pictures import plot_correlation, plot_keypoints, plot_scales
from cflow_torch.viz.style import blank_figure
from cflow_torch.windows.deskewing import deskew_objects


def task(cfg: Plot) -> None:
    output = local_folder(cfg)
    blank_figure((1, 1), 100)  # fails now if matplotlib is missing, not after the work
    if isinstance(cfg, Animation) and cfg.format == "mp4":
        import_optional("imageio_ffmpeg", "format=mp4 needs imageio-ffmpeg (extra video): pip install imageio-ffmpeg")
    model = make_model(cfg.model, cfg.device)
    log = find_log(cfg)
    if isinstance(cfg, Animation):
        path = _animate(cfg, model, log, output)
    else:
        fourth = (log.pairs[:4] or [0])[-1]  # some history precedes it
        pair = fourth if cfg.pair is None else cfg.pair
        check_pair(pair, log)
        sweeps = window(log, pair, model.config.num_history, model.config.num_future)
        ensure_writable(output)
        path = save_picture(_draw(cfg, model, log, pair, sweeps), output / f"{cfg.picture}.png")
        print(f"log {log.log_id}, pair {pair}, sweep {log.timestamps[pair]}")
    print(f"picture: {path}")


def find_log(cfg: Plot) -> Log:
    """Open the log `cfg.log` of `cfg.data`, or the first one."""
    if cfg.log is None and len(paths_of(cfg.data)) > 1:
        raise CFlowError("a picture shows one log, but several paths were given: give one of them, or log=ID")
    logs = find_logs(cfg.data)
    named = {source_name(source): source for source in logs.sources}
    if cfg.log is None:
        return logs[0]
    if cfg.log in named:
        return logs.open(named[cfg.log])
    for source in logs.sources:  # the id of some logs is not the name of their file or folder
        with suppress(CFlowError, OSError):
            log = logs.open(source)
            if log.log_id == cfg.log:
                return log
    raise CFlowError(f"log={cfg.log}: there is no such log; give one of {', '.join(sorted(named))}")


def _draw(cfg: Plot, model: SceneFlowModel, log: Log, pair: int, sweeps: Window) -> Any:
    """Return the figure of one pair."""
    if isinstance(cfg, CorrelationPicture):
        draw = plot_scales if cfg.picture == "scales" else plot_correlation
        return draw(sweeps, model.config, cluster_id=cfg.cluster)
    if isinstance(cfg, FromAbove):
        return _from_above(cfg, model, log, pair, sweeps)
    return plot_keypoints(sweeps, model.config)


def _from_above(cfg: FromAbove, model: SceneFlowModel, log: Log, pair: int, sweeps: Window) -> Any:
    points, (result,) = sweeps.pc0.points, model([sweeps])
    if cfg.deskew:
        points = deskew_objects(sweeps, result, model.config.sweep_interval).cpu()
    view: dict[str, Any] = {
        "is_ground": sweeps.pc0.is_ground,
        "point_cloud_range": model.config.point_cloud_range,
        "title": f"{log.log_id}, sweep {log.timestamps[pair]}, preset {chosen_preset(cfg)}",
    }
    if not isinstance(cfg, FlowPicture):
        return plot_clusters(points, result, **view)
    return plot_flow(points, result, max_flow=cfg.max_flow, truth=_truth(cfg, log, pair, result), **view)


def _truth(cfg: FlowPicture, log: Log, pair: int, result: FlowResult) -> np.ndarray | None:
    """(N, 3) true residual flow, NaN where unknown; None = not drawn."""
    labels = None if cfg.truth is False else log.labels(pair)
    if labels is None:
        if cfg.truth is True:
            raise CFlowError(f"truth=true: pair {pair} of {log.log_id} has no labels; give truth=false or auto")
        return None
    truth = labels.flow - result.pose_flow.cpu().numpy()
    return np.where(labels.is_valid[:, None], truth, np.nan)


def _animate(cfg: Animation, model: SceneFlowModel, log: Log, output: Path) -> Path:
    """Estimate the flow of several pairs, then draw them. Nothing is written if one of them fails."""
    pairs = chosen_pairs(log, cfg.data, cfg.count)
    ensure_writable(output)
    seconds = log.sweep_times(model.config.sweep_interval)
    frames: list[AnimatedPair] = []

    def keep(log: Log, index: int, sweeps: Window, result: FlowResult) -> None:
        flow = result.residual_flow
        result = replace(result, pose_flow=flow, flow=flow)  # frees the flow that is not drawn
        title = f"{log.log_id}, {seconds[index] - seconds[pairs[0]]:.1f} s"
        frames.append(AnimatedPair(sweeps.pc0.points, result, sweeps.pc0.is_ground, title))

    finish(for_each_pair([(log, index) for index in pairs], model, keep))
    figures = flow_figures(
        frames,
        point_cloud_range=model.config.point_cloud_range,
        max_flow=cfg.max_flow,
        legend=cfg.legend,
        width=cfg.width,
    )
    print(f"log {log.log_id}, {len(pairs)} pairs from {pairs[0]} to {pairs[-1]}")
    path = output / f"animation.{cfg.format}"
    drawn = tqdm(figures, total=len(frames), unit="picture", disable=None)
    return save_animation(drawn, path, frames_per_second=cfg.frames_per_second)
