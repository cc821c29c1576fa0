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

from contextlib import suppress

from omegaconf import DictConfig

from cflow_torch.cli import run
from cflow_torch.cli.pairs import for_each_pair
from cflow_torch.cli.record import Scores, finished_results, objective
from cflow_torch.data.atomic import ensure_writable
from cflow_torch.stages import TimedModel
from cflow_torch.types import CFlowError


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
