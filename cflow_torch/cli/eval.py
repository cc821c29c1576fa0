"""Estimates and scores all labelled pairs: tables on the screen, OUTPUT/results.json and OUTPUT/config.yaml.

A run whose results exist is skipped; overwrite=true repeats it. Each job of a sweep (-m) writes to a folder below
OUTPUT that is named after its swept settings. At the end of the sweep, a table compares all jobs in OUTPUT; it is also
written to OUTPUT/comparison.csv. A sweeper minimises the mean dynamic error.

examples:
  cflow eval data=av2 data.root=/data/av2/val model=paper
  cflow eval data=hdf5 data.root=/data/scenes model.num_history=2     fewer sweeps: faster
  cflow eval definition=av2                    scores as another public evaluator defines them
  cflow eval -m model.num_history=0,2,4        a sweep: outputs/eval/model.num_history=2/results.json, ...
  cflow eval -m experiment=pixel_size          a table or figure of the paper, see docs/settings.md
"""

from __future__ import annotations

import hashlib
from contextlib import suppress
from dataclasses import asdict
from datetime import datetime, timezone
from pathlib import Path
from typing import Any, Sequence

import numpy as np
from omegaconf import DictConfig, OmegaConf

from cflow_torch.cli import run
from cflow_torch.cli.comparison import RESULTS, headline, summary
from cflow_torch.cli.pairs import for_each_pair
from cflow_torch.data.atomic import ensure_writable
from cflow_torch.data.files import describe_changes, json_ready, read_json, write_json
from cflow_torch.data.log import Log
from cflow_torch.evaluation.frame import EvalFrame
from cflow_torch.evaluation.metrics import SceneFlowMetrics
from cflow_torch.evaluation.tables import format_table
from cflow_torch.simulator.benchmark import generator_key
from cflow_torch.stages import TimedModel
from cflow_torch.types import CFlowError, FlowResult, Window

# Settings that do not change the results.
_PATHS = ("config.output", "config.overwrite", "config.data.cache")


def task(cfg: DictConfig) -> float:
    """Run `cflow eval`; returns the score that a sweeper minimises, see `objective`."""
    output = run.output_folder(cfg)
    pairs = run.chosen_pairs(cfg, "data.")
    record = finished_results(cfg, output)
    if record is not None:
        print(f"skipped, its results exist: {output}")
        return objective(record["results"])
    scores = Scores(cfg)
    model = TimedModel(run.make_model(cfg))
    logs, failures = run.open_logs(cfg)
    ensure_writable(output)
    failures += for_each_pair([(log, index) for log in logs for index in pairs(log)], model, scores.add)
    if scores.metrics.counts["num_frames"] == 0 and failures:
        raise CFlowError("no pair could be scored; {} failed first: {}".format(*failures[0]))
    if scores.metrics.counts["num_frames"] == 0:
        raise CFlowError("no pair has labels, so there is nothing to score; `cflow flow` needs no labels")
    results = scores.report(output, logs, model.report(), failures)
    with suppress(run.UnfinishedJob):  # a job of a sweep returns its score; a single run exits with status 1
        run.finish(failures)
    return objective(results)


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

    def report(
        self, folder: Path, logs: Sequence[Log], seconds: dict[str, Any], failures: run.Failures
    ) -> dict[str, Any]:
        """Print and return the scores, and write `folder/results.json` and `folder/config.yaml`.

        `seconds` is the result of `TimedModel.report`.
        """
        results = self.metrics.compute()
        record = {
            "date": datetime.now(timezone.utc).isoformat(timespec="seconds"),
            "machine": run.machine(),
            "num_pairs": results["num_frames"],
            "failures": failures,
            "seconds_per_pair": seconds,
            "data": {
                "label": self._cfg.data.label,
                "logs": [{"log_id": log.log_id, "sweeps": len(log.timestamps)} for log in logs],
                "digest": self._digest.hexdigest()[:16],
            },
            **_origin(self._cfg),
            "definition": asdict(self.metrics.definition),
            "results": results,
        }
        run.write_config(self._cfg, folder)
        write_json(folder / RESULTS, record)
        print(f"{summary(results, seconds)}\n\n{folder}: {format_table(results)}")
        return results


def finished_results(cfg: DictConfig, folder: Path) -> dict[str, Any] | None:
    """Read the record of an earlier run with the same settings and versions; None without one, or with `overwrite`.

    Results of other settings are a `CFlowError`.
    """
    file = folder / RESULTS
    if cfg.overwrite or not file.exists():
        return None
    record: dict[str, Any] = read_json(file)
    now = _origin(cfg)
    changed = describe_changes({key: record.get(key) for key in now}, now, _PATHS)
    if changed:
        raise CFlowError(f"{folder} has results of another run ({changed}): give output=FOLDER, or overwrite=true")
    return record


def objective(results: dict[str, Any]) -> float:
    """Return what a sweeper minimises: the mean dynamic error, else the three-way EPE in metres; NaN without points."""
    if results.keys() & {"bucketed", "bucketed_by_range"}:
        return headline(results, {})["dynamic_error"]
    value = results["three_way"]["epe_3way"]
    return float("nan") if value is None else float(value)


def _origin(cfg: DictConfig) -> dict[str, Any]:
    """Return what determines the results, in types that JSON has."""
    generator = generator_key() if cfg.data.get("name") == "benchmark" else None
    settings = json_ready(OmegaConf.to_container(cfg, resolve=True))
    return {"versions": run.versions(), "generator": generator, "config": settings}
