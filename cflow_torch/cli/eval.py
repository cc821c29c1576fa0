"""Estimate and score all labelled pairs: `cflow eval`."""

from __future__ import annotations

import hashlib
from contextlib import suppress
from dataclasses import asdict
from datetime import datetime, timezone
from functools import lru_cache
from pathlib import Path
from typing import Any, Callable, Mapping, Sequence

import numpy as np

from cflow_torch.cli.commands import Demo, Eval
from cflow_torch.cli.comparison import RESULTS, headline, summary
from cflow_torch.cli.failures import Failures, UnfinishedJob, collect_failures, finish
from cflow_torch.cli.logs import chosen_pairs, open_logs
from cflow_torch.cli.outputs import (
    check_made_by,
    machine,
    made_by,
    output_folder,
    read_config,
    settings_record,
    write_config,
)
from cflow_torch.cli.pairs import for_each_pair
from cflow_torch.data.atomic import ensure_writable
from cflow_torch.data.json_file import read_json, write_json
from cflow_torch.data.log import FlowLabels, Log
from cflow_torch.estimate import make_model
from cflow_torch.evaluation.frame import EvalFrame
from cflow_torch.evaluation.metrics import SceneFlowMetrics
from cflow_torch.evaluation.tables import format_table
from cflow_torch.fleet.manifest import are_of_same_log, describe_log, versions
from cflow_torch.simulator.benchmark import generator_key
from cflow_torch.stages import CallTime, time_report
from cflow_torch.types import CFlowError, FlowResult, Window

_KEPT = 32  # labels, as many as pairs that are read ahead


def task(cfg: Eval) -> float:
    """Run `cflow eval`; returns the score that a sweeper minimises, see `objective`."""
    output = output_folder(cfg)
    scores = Scores(cfg)
    record = finished_results(cfg, output)
    logs, failures = open_logs(cfg.data)
    if record is not None:
        _check_logs(output, record, logs, bool(failures))
        print(f"skipped, its results exist: {output}")
        _print_scores(output, record["results"], record["seconds_per_pair"])
        with suppress(UnfinishedJob):
            finish(failures)
        return objective(record["results"])
    model = make_model(cfg.model, cfg.device)
    read_config(cfg, ensure_writable(output))  # one of others fails now, not after the work
    pairs: list[tuple[Log, int]] = []
    for log in logs:
        with collect_failures(failures, log.log_id):
            pairs += [(log, index) for index in chosen_pairs(log, cfg.data)]
    times: list[CallTime] = []
    failures += for_each_pair(pairs, model, scores.add, times, scores.needs)
    if scores.metrics.counts["num_frames"] == 0 and failures:
        raise CFlowError("no pair could be scored; {} failed first: {}".format(*failures[0]))
    if scores.metrics.counts["num_frames"] == 0:
        raise CFlowError("no pair has labels, so there is nothing to score; `cflow flow` needs no labels")
    results = scores.report(output, logs, time_report(times), failures)
    with suppress(UnfinishedJob):  # a job of a sweep returns its score; `Comparison` gives the exit status
        finish(failures)
    return objective(results)


class Scores:
    """The scores of a run by `cfg.definition`, and a digest of all scored points and labels."""

    def __init__(self, cfg: Demo | Eval) -> None:
        self.metrics = SceneFlowMetrics(cfg.definition)
        self._cfg, self._digest = cfg, hashlib.sha256()
        # We ask for labels before the window is read, and again when its flow is known.
        self._labels: Callable[[Log, int], FlowLabels | None] = lru_cache(_KEPT)(lambda log, index: log.labels(index))

    def needs(self, log: Log, index: int) -> bool:
        """Test whether a pair has labels; damaged ones are reported when its flow is added."""
        with suppress(CFlowError, OSError):
            return self._labels(log, index) is not None
        return True

    def add(self, log: Log, index: int, sweeps: Window, result: FlowResult) -> None:
        """Add the flow of one pair, if the pair has labels."""
        labels = self._labels(log, index)
        if labels is None:
            return
        parts: dict[str, Any] = {"eval_mask": log.eval_mask(index)}
        if self.metrics.definition.ego_motion == "stored":
            parts["stored_motion"] = log.stored_motion(index)
        if self.metrics.definition.truth == "motion":
            parts["moving"] = log.moving(index)
        self.metrics.update(EvalFrame.from_result(sweeps, result, labels, **parts))
        scored = [sweeps.pc0.points, labels.flow, labels.category, labels.is_valid]
        if parts.get("moving") is not None:
            scored.append(parts["moving"])
        for values in scored:
            self._digest.update(np.ascontiguousarray(values).tobytes())

    def report(self, folder: Path, logs: Sequence[Log], seconds: dict[str, Any], failures: Failures) -> dict[str, Any]:
        """Print and return the scores, and write `folder/results.json` and `folder/config.yaml`.

        `seconds` is the result of `time_report`.
        """
        results = self.metrics.compute()
        record = {
            "date": datetime.now(timezone.utc).isoformat(timespec="seconds"),
            "machine": machine(),
            "num_pairs": results["num_frames"],
            "failures": failures,
            "seconds_per_pair": seconds,
            "data": {
                "label": self._cfg.data["label"],
                "logs": [{"log_id": log.log_id, "sweeps": len(log.timestamps)} for log in logs],
                "digest": self._digest.hexdigest()[:16],
                "inputs": [describe_log(log) for log in logs],
            },
            "versions": versions(),
            "generator": _generator(self._cfg),
            "config": settings_record(self._cfg),
            "definition": asdict(self.metrics.definition),
            "results": results,
        }
        write_config(self._cfg, folder)
        write_json(folder / RESULTS, record)
        _print_scores(folder, results, seconds)
        return results


def _print_scores(folder: Path, results: dict[str, Any], seconds: dict[str, Any]) -> None:
    print(f"{summary(results, seconds)}\n\n{folder}: {format_table(results)}")


def finished_results(cfg: Eval, folder: Path) -> dict[str, Any] | None:
    """Read the record of an earlier run with the same settings and versions in which nothing failed.

    None without one, or with `overwrite`. Results of other settings are a `CFlowError`.
    """
    file = folder / RESULTS
    if cfg.overwrite or not file.exists():
        return None
    record: dict[str, Any] = read_json(file)
    before = {**record.get("config", {}), "versions": record.get("versions"), "generator": record.get("generator")}
    check_made_by(cfg, folder, before, made_by(cfg, generator=_generator(cfg)))
    return None if record.get("failures") else record


def _check_logs(folder: Path, record: Mapping[str, Any], logs: Sequence[Log], some_failed: bool) -> None:
    """Compare the logs that could be opened with those of existing results; other ones are a `CFlowError`."""
    before = {each["log_id"]: each for each in record["data"].get("inputs", ())}
    now = {log.log_id: describe_log(log) for log in logs}
    changed = {name for name, log in now.items() if not are_of_same_log(before.get(name, {}), log)}
    changed |= set() if some_failed else before.keys() - now.keys()
    if changed:
        names = ", ".join(sorted(changed))
        raise CFlowError(
            f"{folder} has scores of other data (added, removed or changed: {names}): give overwrite=true, or "
            "output=FOLDER"
        )


def objective(results: dict[str, Any]) -> float:
    """Return what a sweeper minimises; NaN without points.

    This is the mean dynamic error, else the three-way EPE in metres, else 1 - IoU of moving points.
    """
    if results.keys() & {"bucketed", "bucketed_by_range"}:
        return headline(results, {})["dynamic_error"]
    if "three_way" in results:
        value = results["three_way"]["epe_3way"]
        return float("nan") if value is None else float(value)
    return 1.0 - headline(results, {})["moving_iou"]


def _generator(cfg: Demo | Eval) -> Any:
    """Return the version of the simulator; None = the data is not simulated."""
    return generator_key() if cfg.data.get("name") == "benchmark" else None
