"""Flow and scores of every labelled pair: a table on the screen, OUTPUT/results.json, OUTPUT/config.yaml.

cflow eval data=av2 data.root=/data/av2/val model=paper
cflow eval definition=av2                    scores as another public evaluator defines them
cflow eval -m model.connectivity=4,8         a sweep; give output=outputs/${model.connectivity} to keep both
"""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any, Dict

from omegaconf import DictConfig, OmegaConf

from cflow_torch.cli.run import finish, for_each_pair, make_model, open_logs, versions, write_config, write_text
from cflow_torch.data.hdf5 import HDF5Log
from cflow_torch.data.log import Log
from cflow_torch.evaluation.frame import EvalFrame
from cflow_torch.evaluation.metrics import SceneFlowMetrics
from cflow_torch.evaluation.tables import format_table
from cflow_torch.types import CFlowError, FlowResult, Window


def task(cfg: DictConfig) -> float:
    """Run `cflow eval`; returns the mean dynamic error, the objective of a sweep."""
    output = Path(cfg.output)
    metrics = SceneFlowMetrics(cfg.definition)
    model = make_model(cfg)
    logs, failures = open_logs(cfg, output)

    def score(log: Log, index: int, sweeps: Window, result: FlowResult) -> None:
        labels = log.labels(index)
        if labels is not None:
            eval_mask = log.eval_mask(index) if isinstance(log, HDF5Log) else None
            metrics.update(EvalFrame.from_result(sweeps, result, labels, eval_mask=eval_mask))

    failures += for_each_pair(logs, model, score)
    if metrics.num_frames == 0:
        raise CFlowError("no pair has labels: nothing to score")
    results = report(cfg, metrics, output)
    finish(failures)
    return float(results["bucketed"]["mean"]["dynamic_error"]) if "bucketed" in results else float("nan")


def report(cfg: DictConfig, metrics: SceneFlowMetrics, output: Path) -> Dict[str, Any]:
    """Print the scores and write results.json and config.yaml."""
    results = metrics.compute()
    record = {
        "results": _without_nan(results),
        "config": OmegaConf.to_container(cfg, resolve=True),
        "versions": versions(),
    }
    write_text(output / "results.json", json.dumps(record, indent=2) + "\n")
    write_config(cfg, output)
    print(format_table(results))
    return results


def _without_nan(value: Any) -> Any:
    """NaN (no points) becomes null: JSON has no NaN."""
    if isinstance(value, dict):
        return {key: _without_nan(part) for key, part in value.items()}
    if isinstance(value, list):
        return [_without_nan(part) for part in value]
    return None if isinstance(value, float) and math.isnan(value) else value
