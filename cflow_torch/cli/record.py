"""results.json: its content, how it is written, and how a finished run is recognised."""

from __future__ import annotations

import hashlib
import json
from dataclasses import asdict
from datetime import datetime, timezone
from pathlib import Path
from typing import Any, Sequence

import numpy as np
from omegaconf import DictConfig, OmegaConf

from cflow_torch.cli.comparison import RESULTS, headline, summary
from cflow_torch.cli.run import Failures, machine, versions, write_config
from cflow_torch.data.files import describe_changes, json_ready, write_json
from cflow_torch.data.log import Log
from cflow_torch.evaluation.frame import EvalFrame
from cflow_torch.evaluation.metrics import SceneFlowMetrics
from cflow_torch.evaluation.tables import format_table
from cflow_torch.simulator.benchmark import generator_key
from cflow_torch.types import CFlowError, FlowResult, Window

# Settings that do not change the results.
_PATHS = ("config.output", "config.overwrite", "config.data.cache")


class Scores:
    """The scores of a run by `cfg.definition`, and a digest of all scored points and labels."""

    def __init__(self, cfg: DictConfig) -> None:
        self.metrics = SceneFlowMetrics(cfg.definition)
        self._cfg, self._digest = cfg, hashlib.sha256()

    def add(self, log: Log, index: int, sweeps: Window, result: FlowResult) -> None:
        """Add the flow of one pair, if the pair has labels."""
        labels = log.labels(index)
        if labels is None:
            return
        wanted = ("eval_mask", "stored_motion") if self.metrics.definition.ego_motion == "stored" else ("eval_mask",)
        parts = {name: getattr(log, name)(index) for name in wanted if hasattr(log, name)}
        self.metrics.update(EvalFrame.from_result(sweeps, result, labels, **parts))
        for values in (sweeps.pc0.points, labels.flow, labels.category, labels.is_valid):
            self._digest.update(np.ascontiguousarray(values).tobytes())

    def report(self, folder: Path, logs: Sequence[Log], seconds: dict[str, Any], failures: Failures) -> dict[str, Any]:
        """Print and return the scores, and write `folder/results.json` and `folder/config.yaml`.

        The seconds are those of `TimedModel.report`.
        """
        results = self.metrics.compute()
        data = {
            "label": self._cfg.data.label,
            "generator": _generator(self._cfg),
            "logs": [{"log_id": log.log_id, "sweeps": len(log.timestamps)} for log in logs],
            "digest": self._digest.hexdigest()[:16],
        }
        record = {
            "date": datetime.now(timezone.utc).isoformat(timespec="seconds"),
            "versions": versions(),
            "machine": machine(),
            "num_pairs": results["num_frames"],
            "failures": [list(failure) for failure in failures],
            "seconds_per_pair": seconds,
            "data": data,
            "config": _plain(self._cfg),
            "definition": asdict(self.metrics.definition),
            "results": results,
        }
        write_config(self._cfg, folder)
        write_json(folder / RESULTS, record)
        print(f"{summary(results, seconds)}\n\n{folder}: {format_table(results)}")
        return results


def finished_results(cfg: DictConfig, folder: Path) -> dict[str, Any] | None:
    """The record of an earlier run with the same settings and versions; None if there is none or `overwrite` is set.

    Results of other settings are a `CFlowError`.
    """
    file = folder / RESULTS
    if cfg.overwrite or not file.exists():
        return None
    try:
        record: dict[str, Any] = json.loads(file.read_text(encoding="utf-8"))
        objective(record["results"])
        before = {"versions": record["versions"], "generator": record["data"]["generator"], "config": record["config"]}
    except (ValueError, KeyError, TypeError) as error:
        hint = "give output=FOLDER, or overwrite=true"
        raise CFlowError(f"{file} is not a results file of this version ({error!r}): {hint}") from None
    now = {"versions": versions(), "generator": _generator(cfg), "config": _plain(cfg)}
    changed = describe_changes(before, now, _PATHS)
    if changed:
        raise CFlowError(f"{folder} has results of another run ({changed}): give output=FOLDER, or overwrite=true")
    return record


def objective(results: dict[str, Any]) -> float:
    """The number that a sweeper minimises: the mean dynamic error, or if the definition has none, the three-way
    end-point error in metres. NaN without scored points."""
    if results.keys() & {"bucketed", "bucketed_by_range"}:
        return headline(results, {})["dynamic_error"]
    value = results["three_way"]["epe_3way"]
    return float("nan") if value is None else float(value)


def _generator(cfg: DictConfig) -> str | None:
    return generator_key() if cfg.data.get("name") == "benchmark" else None


def _plain(cfg: DictConfig) -> Any:
    return json_ready(OmegaConf.to_container(cfg, resolve=True))
