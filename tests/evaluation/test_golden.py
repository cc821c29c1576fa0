"""Scores of the real Argoverse 2 pair compared with the numbers that the public evaluators printed for it.

The numbers were measured with av2 0.3.6 and OpenSceneFlow 848bf86. "npz" is the ego motion that the test log stores in
float32 (0.8 mm off the float64 poses, which moves 23 points across a bucket edge).
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, Sequence

import numpy as np
import pytest
from public_evaluators import TOLERANCE, Pair, official_mask, read_pair, score

from cflow_torch.evaluation import EvalFrame
from cflow_torch.evaluation.frame import ego_motion_flow

CLASSES = ("BACKGROUND", "CAR", "PEDESTRIAN", "WHEELED_VRU", "OTHER_VEHICLES", "mean")
NAN = float("nan")
STATIC = [NAN, 1.0, 1.0, NAN, NAN, 1.0]  # dynamic errors of a residual of 0; no cyclist or other vehicle is dynamic


@pytest.fixture(scope="module")
def pair(av2_folder: Path) -> Pair:
    return read_pair(av2_folder)


def scores(pair: Pair, definition: Any, **parts: Any) -> dict[str, Any]:
    """Scores of a residual flow of 0, unless `parts` has another prediction."""
    defaults: dict[str, Any] = {
        "labels": pair.labels,
        "T_ego1_ego0": pair.T_float32,
        "is_ground": pair.is_ground,
        "eval_mask": official_mask(pair),
        "residual_flow": np.zeros_like(pair.points),
    }
    return score(definition, [EvalFrame(pair.points, **{**defaults, **parts})])


def check_three_way(results: dict[str, Any], **expected: float) -> None:
    measured = {key: results["three_way"][key] for key in expected}
    assert measured == pytest.approx(expected, abs=TOLERANCE, rel=0)


def check_classes(results: dict[str, Any], static: Sequence[float], dynamic: Sequence[float]) -> None:
    """Compare the static error in metres and the dynamic error of `CLASSES`."""
    rows = {**results["bucketed"]["classes"], "mean": results["bucketed"]["mean"]}
    for key, expected in (("static_epe", static), ("dynamic_error", dynamic)):
        found = [rows[name][key] for name in CLASSES]
        assert found == pytest.approx(expected, abs=TOLERANCE, rel=0, nan_ok=True), key


def filled(results: dict[str, Any], name: str, key: str) -> dict[int, Any]:
    """Bucket number -> value, of the buckets that have points."""
    buckets = results["bucketed"]["classes"][name]["buckets"]
    return {i: value for i, (value, count) in enumerate(zip(buckets[key], buckets["count"])) if count}


def test_av2_three_way(pair: Pair) -> None:
    # The official prediction is, bit for bit, the flow by ego motion that the labels store for the background.
    background = (pair.labels.category == 0)[:, None]
    pose_flow = np.where(background, pair.labels.flow, ego_motion_flow(pair.points, pair.T_float32))
    expected = {"epe_fd": 0.6737204147, "epe_fs": 0.0062440348, "epe_bs": 0.0, "epe_3way": 0.2266548165}
    check_three_way(scores(pair, "av2", pose_flow=pose_flow), **expected, dynamic_iou=0.0)


def test_opensceneflow_npz(pair: Pair) -> None:
    results = scores(pair, "opensceneflow")
    check_three_way(
        results, epe_fd=0.6737206772, epe_fs=0.0062896596, epe_bs=6.2128e-07, epe_3way=0.2266703194, dynamic_iou=0.0
    )
    check_classes(results, [6.21e-07, 0.00620734, 0.00582801, 0.00385737, NAN, 0.00397334], STATIC)
    assert filled(results, "CAR", "count") == {0: 6051, 1: 24, 3: 208, 11: 239, 20: 1117, 26: 161}
    speeds = {0: 0.0062073, 1: 0.0491397, 3: 0.1400945, 11: 0.4419174, 20: 0.8175343, 26: 1.0444958}
    assert filled(results, "CAR", "speed") == pytest.approx(speeds, abs=TOLERANCE, rel=0)
    assert filled(results, "PEDESTRIAN", "count") == {0: 156, 2: 94}
    assert filled(results, "PEDESTRIAN", "speed")[2] == pytest.approx(0.0998975, abs=TOLERANCE, rel=0)
    assert filled(results, "WHEELED_VRU", "count") == {0: 166}
    assert results["three_way"]["breakdown"]["foreground"]["dynamic"]["all"]["count"] == 1_819


def test_opensceneflow_range_wise(pair: Pair) -> None:
    ranges = scores(pair, "opensceneflow")["range_wise"]
    counts = {name: (row["num_static"], row["num_dynamic"]) for name, row in ranges.items() if name != "mean"}
    near = {"0-35": (71_046, 1_612), "35-50": (5_502, 0), "50-75": (346, 0)}
    assert counts == {**near, "75-100": (0, 0), "100-inf": (0, 0)}
    measured = [ranges[name]["static_epe"] for name in ("0-35", "35-50", "50-75", "mean")]
    expected = [0.00091971, 0.00036213, 1.825e-06, 0.00042789]
    assert measured == pytest.approx(expected, abs=1e-8, rel=0)  # every digit that was printed
    assert ranges["0-35"]["dynamic_epe"] == pytest.approx(0.74473900, abs=TOLERANCE, rel=0)


def test_noise(pair: Pair) -> None:
    noise = np.random.default_rng(0).normal(0, 0.05, pair.points.shape).astype(np.float32)
    results = scores(pair, "opensceneflow", residual_flow=noise)
    check_three_way(results, epe_fd=0.6799331272, epe_fs=0.0798506559, epe_bs=0.0799001127, dynamic_iou=0.0247696440)
    static = [0.0799001127, 0.0797635345, 0.0811704863, 0.0797579710, NAN, 0.0801480261]
    check_classes(results, static, [NAN, 1.1924512872, 1.3127384422, NAN, NAN, 1.2525948647])
