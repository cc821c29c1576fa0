"""Simulates a drive, estimates its flow, scores it and draws it. You need no data.

The drive is written in Argoverse 2's format to outputs/cache and read from there like a real log. OUTPUT (outputs/demo)
contains flow.html (a 3-D page for any browser), flow.png, <log id>/ with one flow file per pair, results.json with the
scores, and config.yaml with the settings.

examples:
  cflow demo
  cflow demo data.seed=7 pair=2 output=outputs/another    another street, another pair in the picture
  cflow demo model=paper                                  the method of the paper
"""

from __future__ import annotations

from typing import Any, Callable

from omegaconf import DictConfig

from cflow_torch.applications.tracking import track
from cflow_torch.cli import run
from cflow_torch.cli.eval import Scores
from cflow_torch.cli.pairs import for_each_pair
from cflow_torch.data.atomic import ensure_writable, remove_stale
from cflow_torch.data.flow_file import write_flow
from cflow_torch.data.log import Log
from cflow_torch.data.paths import safe_name
from cflow_torch.stages import TimedModel
from cflow_torch.types import CFlowError, FlowResult, Window
from cflow_torch.viz.bev import plot_flow, save_picture
from cflow_torch.viz.page import load_k3d, save_page
from cflow_torch.viz.style import blank_figure


def task(cfg: DictConfig) -> None:
    output, picture = run.output_folder(cfg), "none"
    draws = _is_available("picture", lambda: blank_figure((1, 1), 100))  # matplotlib and k3d are extras
    shows = _is_available("page", load_k3d)
    scores = Scores(cfg)
    model = TimedModel(run.make_model(cfg))
    logs, failures = run.open_logs(cfg)
    if logs:
        run.check_pair(cfg.pair, max(logs, key=lambda log: len(log.timestamps)))
    ensure_writable(output)
    results: list[tuple[int, FlowResult]] = []

    def keep(log: Log, index: int, sweeps: Window, result: FlowResult) -> None:
        nonlocal picture
        write_flow(output / safe_name(log.log_id, "the log") / f"{log.timestamps[index]}.feather", result)
        scores.add(log, index, sweeps, result)
        results.append((index, result))
        if draws and index == cfg.pair:
            view: Any = {"is_ground": sweeps.pc0.is_ground, "point_cloud_range": model.config.point_cloud_range}
            figure = plot_flow(sweeps.pc0.points, result, title=f"CorrelationFlow, {log.log_id}", **view)
            picture = str(save_picture(figure, output / "flow.png"))

    for log in logs:
        remove_stale(output / log.log_id)
    pairs = [(log, index) for log in logs for index in range(len(log.timestamps) - 1)]
    failures += for_each_pair(pairs, model, keep)
    scores.report(output, logs, model.report(), failures)
    print(f"picture: {picture}")
    if shows and results:
        page, tracks = output / "flow.html", track(logs[0], results)
        save_page(logs[0], results, page, tracks=lambda: tracks, preset=run.preset())
        print(f"3-D page, for any browser: {page}")
    print(f"flow files, scores, settings: {output}")
    run.finish(failures)


def _is_available(name: str, load: Callable[[], Any]) -> bool:
    """Return True if the extra for an output is installed; if not, print which output is missing."""
    try:
        load()
    except CFlowError as error:
        print(f"no {name} ({error}); everything else is written")
        return False
    return True
