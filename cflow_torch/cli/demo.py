"""Simulate a drive, estimate its flow, score it and draw it: `cflow demo`."""

from __future__ import annotations

from typing import Any, Callable

from cflow_torch.applications.tracking import track
from cflow_torch.cli.commands import Demo
from cflow_torch.cli.eval import Scores
from cflow_torch.cli.failures import finish
from cflow_torch.cli.logs import check_pair, open_logs
from cflow_torch.cli.outputs import chosen_preset, local_folder, read_config
from cflow_torch.cli.pairs import for_each_pair
from cflow_torch.data.atomic import ensure_writable, remove_stale
from cflow_torch.data.flow_file import write_flow
from cflow_torch.data.log import Log
from cflow_torch.data.paths import safe_name
from cflow_torch.estimate import make_model
from cflow_torch.stages import CallTime, time_report
from cflow_torch.types import CFlowError, FlowResult, Window
from cflow_torch.viz.bev import plot_flow, save_picture
from cflow_torch.viz.page import load_k3d, save_page
from cflow_torch.viz.style import blank_figure


def task(cfg: Demo) -> None:
    output, picture = local_folder(cfg), "none"
    draws = _is_available("picture", lambda: blank_figure((1, 1), 100))  # matplotlib and k3d are extras
    shows = _is_available("page", load_k3d)
    scores = Scores(cfg)
    model = make_model(cfg.model, cfg.device)
    logs, failures = open_logs(cfg.data)
    if logs:
        check_pair(cfg.pair, logs[0])
    read_config(cfg, ensure_writable(output))  # one of others fails now, not after the work
    results: list[tuple[int, FlowResult]] = []

    def keep(log: Log, index: int, sweeps: Window, result: FlowResult) -> None:
        nonlocal picture
        write_flow(output / safe_name(log.log_id, "the log") / f"{log.timestamps[index]}.feather", result)
        scores.add(log, index, sweeps, result)
        if log is not logs[0]:  # the page and the picture show the first log
            return
        results.append((index, result))
        if draws and index == cfg.pair:
            view: Any = {"is_ground": sweeps.pc0.is_ground, "point_cloud_range": model.config.point_cloud_range}
            figure = plot_flow(sweeps.pc0.points, result, title=f"CorrelationFlow, {log.log_id}", **view)
            picture = str(save_picture(figure, output / "flow.png"))

    for log in logs:
        remove_stale(output / log.log_id)
    pairs = [(log, index) for log in logs for index in log.pairs]
    times: list[CallTime] = []
    failures += for_each_pair(pairs, model, keep, times)
    scores.report(output, logs, time_report(times), failures)
    print(f"picture: {picture}")
    if shows and results:
        page, tracks = output / "flow.html", track(logs[0], results)
        save_page(logs[0], results, page, tracks=lambda: tracks, preset=chosen_preset(cfg))
        print(f"3-D page, for any browser: {page}")
    print(f"flow files, scores, settings: {output}")
    finish(failures)


def _is_available(name: str, load: Callable[[], Any]) -> bool:
    """Return True if the extra for an output is installed; if not, print which output is missing."""
    try:
        load()
    except CFlowError as error:
        print(f"no {name} ({error}); everything else is written")
        return False
    return True
