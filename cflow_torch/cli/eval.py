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

from omegaconf import DictConfig

from cflow_torch.cli import run
from cflow_torch.cli.record import Scores, finished_results, objective
from cflow_torch.data.atomic import ensure_writable
from cflow_torch.stages import TimedModel
from cflow_torch.types import CFlowError


def task(cfg: DictConfig) -> float:
    """Run `cflow eval`; returns the score of a sweep, see `objective`."""
    output = run.output_folder(cfg)
    pairs = run.chosen_pairs(cfg, "data.")
    record = finished_results(cfg, output)
    if record is not None:
        print(f"skipped, done before: {output}")
        return objective(record["results"])
    scores = Scores(cfg)
    model = TimedModel(run.make_model(cfg))
    logs, failures = run.open_logs(cfg)
    ensure_writable(output)
    failures += run.for_each_pair(logs, model, scores.add, pairs)
    if scores.metrics.num_frames == 0:
        raise CFlowError("no pair has labels: nothing to score; `cflow flow` estimates the flow without them")
    results = scores.report(output, logs, model.report(), failures)
    with suppress(run.UnfinishedJob):  # a job of a sweep has a score all the same; a run on its own ends with status 1
        run.finish(failures)
    return objective(results)
