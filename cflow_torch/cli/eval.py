"""Flow and scores of every labelled pair: a table on the screen, OUTPUT/results.json, OUTPUT/config.yaml.

A run whose results are there already is skipped; overwrite=true redoes it. The jobs of a sweep write to folders below
OUTPUT that are named by what was overridden; the score that a sweeper sees is the mean dynamic error.

examples:
  cflow eval data=av2 data.root=/data/av2/val model=paper
  cflow eval data=hdf5 data.root=/data/scenes model=fast     a cheaper method
  cflow eval definition=av2                    scores as another public evaluator defines them
  cflow eval -m model.connectivity=4,8         a sweep: outputs/eval/model.connectivity=4/results.json, ...
  cflow eval -m experiment=pixel_size          a table or figure of the paper, see docs/settings.md
"""

from __future__ import annotations

from contextlib import suppress
from typing import Any

from omegaconf import DictConfig

from cflow_torch.cli.record import DataIdentity, finished_results, objective, report
from cflow_torch.cli.run import (
    UnfinishedJob,
    chosen_pairs,
    finish,
    for_each_pair,
    make_model,
    open_logs,
    output_folder,
)
from cflow_torch.data.atomic import ready_folder
from cflow_torch.data.log import Log
from cflow_torch.evaluation.frame import EvalFrame
from cflow_torch.evaluation.metrics import SceneFlowMetrics
from cflow_torch.stages import StopWatch
from cflow_torch.types import CFlowError, FlowResult, Window


def task(cfg: DictConfig) -> float:
    """Run `cflow eval`; returns the score of a sweep, see `objective`."""
    output = output_folder(cfg)
    pairs = chosen_pairs(cfg, "data.")
    record = finished_results(cfg, output)
    if record is not None:
        print(f"skipped, done before: {output}")
        return objective(record["results"])
    metrics = SceneFlowMetrics(cfg.definition)
    model = StopWatch(make_model(cfg))
    logs, failures = open_logs(cfg)
    identity = DataIdentity()
    ready_folder(output)

    def score(log: Log, index: int, sweeps: Window, result: FlowResult) -> None:
        labels = log.labels(index)
        if labels is not None:
            parts = {"eval_mask": _of(log, "eval_mask", index)}
            if metrics.definition.ego_motion == "stored":
                parts["stored_motion"] = _of(log, "stored_motion", index)
            metrics.update(EvalFrame.from_result(sweeps, result, labels, **parts))
            identity.add(sweeps, labels)

    failures += for_each_pair(logs, model, score, pairs)
    if metrics.num_frames == 0:
        raise CFlowError("no pair has labels: nothing to score; `cflow flow` estimates the flow without them")
    results = report(cfg, metrics, output, data=identity.report(cfg, logs), seconds=model.report(), failures=failures)
    with suppress(UnfinishedJob):  # a job of a sweep has a score all the same; a run on its own ends with status 1
        finish(failures)
    return objective(results)


def _of(log: Log, name: str, index: int) -> Any:
    """What a log knows about a pair beyond the protocol; None where it does not."""
    find = getattr(log, name, None)
    return None if find is None else find(index)
