"""No data needed: a simulated drive goes through reader, method, evaluation and picture like a real log.

Leaves in OUTPUT (outputs/demo): <log id>/ one flow file per pair, flow.png the picture, results.json the scores,
config.yaml the resolved settings and versions; in outputs/cache the drive in Argoverse 2's format.

examples:
  cflow demo                                              no data needed
  cflow demo data.seed=7 pair=2 output=outputs/another    another street, drawn at another moment
  cflow demo model=paper                                  with the method of the paper
"""

from __future__ import annotations

from pathlib import Path

from omegaconf import DictConfig

from cflow_torch.cli.record import report
from cflow_torch.cli.run import finish, for_each_pair, make_model, open_logs, output_folder
from cflow_torch.data.atomic import ready_folder, remove_stale
from cflow_torch.data.flow_file import write_flow
from cflow_torch.data.log import Log
from cflow_torch.data.names import folder_in
from cflow_torch.evaluation.frame import EvalFrame
from cflow_torch.evaluation.metrics import SceneFlowMetrics
from cflow_torch.model import SceneFlowModel
from cflow_torch.types import CFlowError, FlowResult, Window
from cflow_torch.viz.bev import plot_flow, save_picture


def task(cfg: DictConfig) -> None:
    """Run `cflow demo`."""
    output, picture = output_folder(cfg), "none"
    metrics = SceneFlowMetrics(cfg.definition)
    model = make_model(cfg)
    logs, failures = open_logs(cfg)
    num_pairs = max((len(log.timestamps) - 1 for log in logs), default=0)
    if logs and not 0 <= cfg.pair < num_pairs:
        raise CFlowError(f"pair={cfg.pair}: the drive has {num_pairs} pairs, give 0 ... {num_pairs - 1}")
    ready_folder(output)

    def keep(log: Log, index: int, sweeps: Window, result: FlowResult) -> None:
        nonlocal picture
        write_flow(folder_in(output, log.log_id, "the log") / f"{log.timestamps[index]}.feather", result)
        labels = log.labels(index)
        if labels is not None:
            metrics.update(EvalFrame.from_result(sweeps, result, labels))
        if index == cfg.pair:
            picture = _draw(log, model, sweeps, result, output)

    for log in logs:
        remove_stale(output / log.log_id)
    failures += for_each_pair(logs, model, keep, lambda log: range(len(log.timestamps) - 1))
    report(cfg, metrics, output)
    print(f"picture: {picture}")
    print(f"flow files, scores, settings: {output}")
    finish(failures)


def _draw(log: Log, model: SceneFlowModel, sweeps: Window, result: FlowResult, output: Path) -> str:
    """The file of the picture, or why there is none: matplotlib is an extra."""
    try:
        figure = plot_flow(
            sweeps.pc0.points,
            result,
            is_ground=sweeps.pc0.is_ground,
            point_cloud_range=model.config.point_cloud_range,
            title=f"CorrelationFlow, {log.log_id}",
        )
    except CFlowError as error:
        return f"none ({error})"
    return str(save_picture(figure, output / "flow.png"))
