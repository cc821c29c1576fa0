"""results.json: what is in it, how it is written, and whether a run is already done."""

from __future__ import annotations

import hashlib
import json
from dataclasses import asdict
from datetime import datetime, timezone
from pathlib import Path
from typing import Any, Sequence

import numpy as np
from omegaconf import DictConfig, OmegaConf

from cflow_torch.cli.run import Failures, machine, versions, write_config
from cflow_torch.data.json_file import describe_changes, json_ready, write_json
from cflow_torch.data.log import Log
from cflow_torch.evaluation.frame import EvalFrame
from cflow_torch.evaluation.metrics import SceneFlowMetrics
from cflow_torch.evaluation.tables import format_table
from cflow_torch.simulator.benchmark import generator_key
from cflow_torch.types import CFlowError, FlowResult, Window

RESULTS = "results.json"
# Settings that say where things lie, not what is computed.
_PLACES = ("config.output", "config.overwrite", "config.data.cache")


class Scores:
    """Scores of a run by `cfg.definition`, and a digest of all scored points and labels."""

    def __init__(self, cfg: DictConfig) -> None:
        self.metrics = SceneFlowMetrics(cfg.definition)
        self._cfg, self._digest = cfg, hashlib.sha256()

    def add(self, log: Log, index: int, sweeps: Window, result: FlowResult) -> None:
        """Count in the flow of one pair, if the pair has labels."""
        labels = log.labels(index)
        if labels is None:
            return
        wanted = ("eval_mask", "stored_motion") if self.metrics.definition.ego_motion == "stored" else ("eval_mask",)
        parts = {name: getattr(log, name)(index) for name in wanted if hasattr(log, name)}
        self.metrics.update(EvalFrame.from_result(sweeps, result, labels, **parts))
        for values in (sweeps.pc0.points, labels.flow, labels.category, labels.is_valid):
            self._digest.update(np.ascontiguousarray(values).tobytes())

    def report(self, folder: Path, logs: Sequence[Log], seconds: dict[str, Any], failures: Failures) -> dict[str, Any]:
        """Print the scores, write `folder/results.json` and `folder/config.yaml`, each whole or not at all.

        Args:
            folder: made if absent.
            logs: that were scored.
            seconds: what `TimedModel.report` returned.
            failures: pairs and logs that could not be used.

        Returns:
            What `metrics.compute` returned.
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
        print(f"{folder}: {format_table(results)}")
        return results


def finished_results(cfg: DictConfig, folder: Path) -> dict[str, Any] | None:
    """The record of an earlier run with the same settings, versions and data settings; None where there is none.

    Raises:
        CFlowError: the folder holds the results of a run with other settings, and `overwrite` is not set.
    """
    file = folder / RESULTS
    if cfg.overwrite or not file.exists():
        return None
    try:
        record: dict[str, Any] = json.loads(file.read_text(encoding="utf-8"))
        objective(record["results"])
        before = {"versions": record["versions"], "generator": record["data"]["generator"], "config": record["config"]}
    except (ValueError, KeyError, TypeError) as error:
        raise CFlowError(
            f"{file} is no results file of this version ({error!r}): give output=FOLDER, or overwrite=true"
        ) from None
    now = {"versions": versions(), "generator": _generator(cfg), "config": _plain(cfg)}
    changed = describe_changes(before, now, _PLACES)
    if changed:
        raise CFlowError(f"{folder} holds results of another run ({changed}): give output=FOLDER, or overwrite=true")
    return record


def objective(results: dict[str, Any]) -> float:
    """The one number that a sweep minimises: the mean dynamic error, of the ranges if the definition has them; else the
    three-way end-point error in metres. NaN where there is nothing to score."""
    if "bucketed_by_range" in results:
        value = results["bucketed_by_range"]["mean"]["dynamic_error"]
    elif "bucketed" in results:
        value = results["bucketed"]["mean"]["dynamic_error"]
    else:
        value = results["three_way"]["epe_3way"]
    return float("nan") if value is None else float(value)


def _generator(cfg: DictConfig) -> str | None:
    return generator_key() if cfg.data.get("name") == "benchmark" else None


def _plain(cfg: DictConfig) -> Any:
    return json_ready(OmegaConf.to_container(cfg, resolve=True))
