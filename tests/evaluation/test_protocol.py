"""Several data sets and ranges to one number, on made-up results and on the figures that the paper prints."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from public_evaluators import score

from cflow_torch.data.log import FlowLabels
from cflow_torch.evaluation import EvalFrame
from cflow_torch.evaluation.protocol import CHALLENGE_DATA_SETS, CHALLENGE_RANGES, errors_by_range, score_data_sets
from cflow_torch.types import CFlowError


def test_figures_of_the_paper() -> None:
    """Data sets are means of their ranges (figure "performance_evolution_2x2", which does not show nuScenes), the
    overall score is the mean of data sets (figure "experiment_av2challenge_across_dataset"), rounded in another order.
    """
    printed = dict(zip(CHALLENGE_DATA_SETS, (0.4216, 0.3587, 0.6449, 0.45395, 0.34085)))
    pairs = {
        "AEVA": (0.3603, 0.4829),
        "AV2": (0.2106, 0.5068),
        "TruckScenes": (0.3043, 0.6036),
        "Waymo": (0.2141, 0.4676),
    }
    ranges = {name: dict(zip(CHALLENGE_RANGES, pair)) for name, pair in pairs.items()}
    for name, value in score_data_sets(ranges).data_sets.items():
        assert value == pytest.approx(printed[name], abs=1e-9), name
    whole = score_data_sets({name: {"0-70": value} for name, value in printed.items()}, CHALLENGE_DATA_SETS)
    assert whole.overall == pytest.approx(0.444, abs=5e-5, rel=0)


WHOLE = {"0-35": 0.25, "35-70": 0.5}


@pytest.mark.parametrize(
    ("results", "reason", "holes"),
    [
        ({"A": WHOLE}, "data set B, range 0-35: no result", 2),
        ({"A": WHOLE, "B": {"0-35": 0.25}}, "data set B, range 35-70: no result", 1),
        ({"A": WHOLE, "B": {"0-35": 0.25, "35-70": math.nan}}, "no moving points", 1),
        ({"A": WHOLE, "B": {"0-35": 0.25, "35-70": None}}, "no moving points", 1),
    ],
)
def test_holes_are_listed_and_no_mean_is_over_fewer(results: dict[str, Any], reason: str, holes: int) -> None:
    scores = score_data_sets(results, ("A", "B"), CHALLENGE_RANGES)
    assert len(scores.missing) == holes and reason in scores.missing[0]
    assert scores.data_sets["A"] == 0.375
    assert math.isnan(scores.data_sets["B"]) and math.isnan(scores.overall) and math.isnan(scores.ranges["35-70"])


def test_ranges_then_data_sets_and_nothing_that_was_not_asked_for() -> None:
    scores = score_data_sets({"A": {"0-35": 0.25, "35-70": 0.75}, "B": {"0-35": 0.125, "35-70": 0.375}})
    assert scores.data_sets == {"A": 0.5, "B": 0.25} and scores.ranges == {"0-35": 0.1875, "35-70": 0.5625}
    assert (scores.overall, scores.missing) == (0.375, ())
    for results, asked, message in (
        ({"A": WHOLE, "B": WHOLE}, {"data_sets": ("A",)}, r"\['B'\] given"),
        ({"A": WHOLE}, {"ranges": ("0-35",)}, r"\['35-70'\] given"),
        ({}, {}, "nothing to combine"),
    ):
        with pytest.raises(CFlowError, match=message):
            score_data_sets(results, **asked)


def test_from_scores_of_frames() -> None:
    """One car point 10 m away, missed; one 50 m away, half of its motion found; one 90 m away, in no range."""
    labels = FlowLabels(np.float32([[1, 0, 0]] * 3), np.full(3, 19, dtype=np.uint8), np.ones(3, dtype=bool))
    points, predicted = np.array([[10, 0, 0], [0, 50, 0], [90, 0, 0]]), np.array([[0, 0, 0], [0.5, 0, 0], [1, 0, 0]])
    frame = EvalFrame(points, labels, residual_flow=predicted, T_ego1_ego0=np.eye(4))
    results = score("challenge_2026", [frame])
    errors = errors_by_range(results)
    assert errors == {"0-35": 1.0, "35-70": 0.5}
    assert score_data_sets({"A": errors}).overall == results["bucketed_by_range"]["mean"]["dynamic_error"] == 0.75
    with pytest.raises(CFlowError, match="challenge_2026"):
        errors_by_range({"bucketed": {}})
