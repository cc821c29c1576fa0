"""Draws one pair of sweeps, or an animation of a log: OUTPUT/<picture>.png (animation: .gif or .mp4).

log=ID and pair=N choose the pair. Without log=, the first log is drawn.

picture=flow         the flow from above; truth=true|false|auto adds the ground truth and the error
picture=clusters     the points by cluster
picture=keypoints    the key points of both sweeps and their matches (model=keypoints)
picture=correlation  one cluster and the correlation of all its shifts (model=paper); cluster=ID chooses it
picture=scales       one cluster and the flow, coarse to fine: a column per pixel size, one more (model=paper, 3 sizes)
picture=animation    the flow of many pairs: first= step= count= format=gif|mp4 frames_per_second= width=

examples:
  cflow plot                                             the simulated street, outputs/plot/flow.png
  cflow plot picture=correlation pair=2
  cflow plot picture=scales model.pixel_sizes=[0.8,0.4,0.2,0.1]
  cflow plot data=av2 data.root=/data/av2/val/LOG pair=2 truth=true
  cflow plot picture=animation count=5 model.num_history=0
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any, Callable

import numpy as np
from omegaconf import DictConfig
from tqdm import tqdm

from cflow_torch.applications.deskewing import deskew
from cflow_torch.cli import run
from cflow_torch.cli.pairs import for_each_pair
from cflow_torch.data.atomic import ensure_writable
from cflow_torch.data.log import Log, window
from cflow_torch.fleet.work import source_name
from cflow_torch.model import SceneFlowModel
from cflow_torch.stages import TimedModel
from cflow_torch.types import CFlowError, FlowResult, Window
from cflow_torch.viz.animation import Frame, flow_figures, save_animation
from cflow_torch.viz.bev import plot_flow, save_picture
from cflow_torch.viz.clusters import plot_clusters
from cflow_torch.viz.stage_pictures import plot_correlation, plot_keypoints, plot_scales
from cflow_torch.viz.style import blank_figure


def task(cfg: DictConfig) -> None:
    output = run.local_folder(cfg)
    blank_figure((1, 1), 100)  # fails now if matplotlib is missing, not after the work
    model = run.make_model(cfg)
    if cfg.picture == "animation":
        path = _animate(cfg, model, output)
    else:
        log = find_log(cfg)
        if cfg.pair is None:
            cfg.pair = min(3, len(log.timestamps) - 2)  # some history precedes it
        pair = cfg.pair
        run.check_pair(pair, log)
        sweeps = window(log, pair, model.config.num_history, model.config.num_future)
        ensure_writable(output)
        figure = PICTURES[cfg.picture](cfg, model, log, sweeps)
        path = save_picture(figure, output / f"{cfg.picture}.png")
        print(f"log {log.log_id}, pair {pair}, sweep {log.timestamps[pair]}")
    print(f"picture: {path}")


def find_log(cfg: DictConfig) -> Log:
    """Open the log `cfg.log` of `cfg.data`, or the first one."""
    sources = run.find_logs(cfg)
    named = {source_name(source): source for source in sources.logs}
    if cfg.log is None or cfg.log in named:
        return sources.open(named.get(cfg.log, sources.logs[0]))
    for source in sources.logs:  # the id of some logs is not the name of their file or folder
        with suppress(CFlowError, OSError):
            log = sources.open(source)
            if log.log_id == cfg.log:
                return log
    raise CFlowError(f"log={cfg.log}: there is no such log; give one of {', '.join(sorted(named))}")


def _from_above(cfg: DictConfig, model: SceneFlowModel, log: Log, sweeps: Window) -> Any:
    points, (result,) = sweeps.pc0.points, model([sweeps])
    if cfg.deskew:
        points = deskew(sweeps, result).cpu()
    view: dict[str, Any] = {
        "is_ground": sweeps.pc0.is_ground,
        "point_cloud_range": model.config.point_cloud_range,
        "title": f"{log.log_id}, sweep {log.timestamps[cfg.pair]}",
    }
    if cfg.picture == "clusters":
        return plot_clusters(points, result, **view)
    return plot_flow(points, result, max_flow=cfg.max_flow, truth=_truth(cfg, log, result), **view)


def _truth(cfg: DictConfig, log: Log, result: FlowResult) -> np.ndarray | None:
    """(N, 3) true residual flow, NaN where unknown; None = not drawn."""
    labels = None if cfg.truth is False else log.labels(cfg.pair)
    if labels is None:
        if cfg.truth is True:
            raise CFlowError(f"truth=true: pair {cfg.pair} of {log.log_id} has no labels; give truth=false or auto")
        return None
    truth = labels.flow - result.pose_flow.cpu().numpy()
    return np.where(labels.is_valid[:, None], truth, np.nan)


PICTURES: dict[str, Callable[[DictConfig, SceneFlowModel, Log, Window], Any]] = {
    "flow": _from_above,
    "clusters": _from_above,
    "keypoints": lambda cfg, model, log, sweeps: plot_keypoints(sweeps, model.config),
    "correlation": lambda cfg, model, log, sweeps: plot_correlation(sweeps, model.config, cluster_id=cfg.cluster),
    "scales": lambda cfg, model, log, sweeps: plot_scales(sweeps, model.config, cluster_id=cfg.cluster),
}


def _animate(cfg: DictConfig, model: SceneFlowModel, output: Path) -> Path:
    """Estimate the flow of several pairs, then draw them. Nothing is written if one of them fails."""
    chosen, log = run.chosen_pairs(cfg), find_log(cfg)
    pairs = chosen(log)
    if not pairs:
        raise CFlowError(f"first={cfg.first}: log {log.log_id} has pairs 0 to {len(log.timestamps) - 2}")
    ensure_writable(output)
    frames: list[Frame] = []

    def keep(log: Log, index: int, sweeps: Window, result: FlowResult) -> None:
        flow = result.residual_flow
        result = replace(result, pose_flow=flow, flow=flow)  # frees the flow that is not drawn
        title = f"{log.log_id}, {(log.timestamps[index] - log.timestamps[pairs[0]]) / 1e9:.1f} s"
        frames.append(Frame(sweeps.pc0.points, result, sweeps.pc0.is_ground, title))

    run.finish(for_each_pair([(log, index) for index in pairs], TimedModel(model), keep))
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
