"""The ablation: its rows are valid settings, kept figures are not computed again, made sets are what they say."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any, List

import numpy as np
import pytest
from scenes import scene

from cflow_torch.data.log import FlowLabels
from cflow_torch.types import Sweep, Window


@pytest.fixture()
def small_set(script: Any) -> Any:
    """Two small windows whose truth is that nothing moves, as a set of real data."""
    sets = script("ablation", "sets")

    def finite(sweep: Sweep) -> Sweep:
        rows = np.isfinite(sweep.points).all(1)
        return replace(sweep, points=sweep.points[rows], is_ground=sweep.is_ground[rows])

    def items() -> List[Any]:
        made = []
        for seed in (3, 5):
            whole = scene(seed, num_history=1)
            window = Window(finite(whole.pc0), finite(whole.pc1), (finite(whole.pch[0]),))
            still = sets.ego_motion_flow(window.pc0.points, sets.between(window.pc0, window.pc1))
            count = len(still)
            made.append(sets.make_item(window, FlowLabels(still, np.zeros(count, np.uint8), np.ones(count, bool))))
        return made

    return sets.ScoredSet("small h=1", "real", 1, 8.0, items)


def test_rows_are_valid_and_differ(script: Any, small_set: Any) -> None:
    rows = script("ablation", "rows").ROWS
    configs = [row.for_set(small_set) for row in rows]
    assert len(set(configs)) == len(rows)
    assert {config.num_history for row, config in zip(rows, configs) if "num_history" not in row.overrides} == {1}


def test_figures_that_are_kept_are_not_computed_again(
    script: Any, small_set: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    score, (paper, *_) = script("ablation", "score"), script("ablation", "rows").ROWS
    config = paper.for_set(small_set)
    first = score.Store(tmp_path).get(small_set, config)
    assert first["num_dynamic"] == 0 and first["static"] > 0
    estimates: List[Any] = []
    monkeypatch.setattr(score, "estimate", lambda *of: estimates.append(of) or [])
    monkeypatch.setattr(score, "pooled_figures", lambda frames, step: {"static": 7.0})
    assert score.Store(tmp_path).get(small_set, config)["static"] == first["static"] and not estimates
    assert score.Store(tmp_path).get(small_set, config.replace(connectivity=4)) == {"static": 7.0}
    assert len(estimates) == 1, "other settings are computed"
    (kept,) = (
        file for file in tmp_path.iterdir() if json.loads(file.read_text())["config"] == score.strict(config.as_dict())
    )
    kept.write_text(kept.read_text().replace(score.code_key(), "other"))
    assert score.Store(tmp_path).get(small_set, config) == {"static": 7.0}, "figures of other code are made anew"


def test_chained_labels_give_the_motion_over_several_sweeps(script: Any) -> None:
    rng = np.random.default_rng(0)
    body, far = rng.uniform(-1, 1, (20, 3)) + [9, 0, 0], rng.uniform(-1, 1, (5, 3))
    turn = np.array([[0.8, -0.6, 0], [0.6, 0.8, 0], [0, 0, 1]])
    places = [body, body @ turn.T + [1, 2, 0], (body @ turn.T + [1, 2, 0]) @ turn.T + [1, 2, 0]]
    pairs = []
    for start, end in zip(places, places[1:]):
        flow = np.concatenate([end - start, np.zeros((5, 3))])
        instance = np.repeat([4, 6], [20, 5])  # the second object has too few points
        pairs.append((np.concatenate([start, far]), instance, flow, np.ones(25, bool)))
    flow, is_known = script("ablation", "made").chain_flow(pairs, np.zeros((25, 3)))
    np.testing.assert_allclose(flow[:20], places[2] - places[0], atol=1e-6)
    assert is_known.tolist() == [True] * 20 + [False] * 5
