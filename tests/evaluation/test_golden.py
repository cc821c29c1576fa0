"""Scores of the real Argoverse 2 pair against numbers that the public evaluators printed for it.

The numbers were measured with av2 0.3.6, OpenSceneFlow 848bf86 and bucketed-scene-flow-eval 2.0.25. "npz" is the ego
motion that the test log stores in float32 (0.8 mm off the float64 poses, which moves 23 points across a bucket edge).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Dict

import numpy as np
import pyarrow.feather as feather
import pytest

from cflow_torch.data.av2 import AV2Log
from cflow_torch.data.log import FlowLabels
from cflow_torch.evaluation import DEFINITIONS, EvalFrame, SceneFlowMetrics
from cflow_torch.evaluation.frame import ego_motion_flow

TOLERANCE = 1e-6


@dataclass(frozen=True)
class Pair:
    """The real pair: points, two versions of the ego motion, stored truth, ground, official evaluation mask."""

    points: np.ndarray
    npz: np.ndarray
    poses: np.ndarray
    stored: FlowLabels
    is_ground: np.ndarray
    mask: np.ndarray
    bsfe_ground: np.ndarray
    next_points: np.ndarray

    def score(self, definition: Any, **parts: Any) -> Dict[str, Any]:
        """Scores of the prediction "nothing but ego motion", unless `parts` say otherwise."""
        metrics = SceneFlowMetrics(definition)
        defaults: Dict[str, Any] = {
            "points": self.points,
            "labels": self.stored,
            "T_ego1_ego0": self.npz,
            "is_ground": self.is_ground,
            "eval_mask": self.mask,
            "residual_flow": np.zeros_like(self.points),
        }
        metrics.update(EvalFrame(**{**defaults, **parts}))
        return metrics.compute()


@pytest.fixture(scope="module")
def pair(av2_folder: Path) -> Pair:
    log = AV2Log(av2_folder)
    sweep0, sweep1, stored = log.sweep(0), log.sweep(1), log.labels(0)
    assert stored is not None
    is_ground = feather.read_table(str(av2_folder / "flow_labels.feather"))["is_ground_0"].to_numpy()
    return Pair(
        points=sweep0.points,
        npz=np.load(av2_folder / "ego_motion.npz")["ego_motion"][0].astype(np.float64),
        poses=np.linalg.inv(sweep1.pose) @ sweep0.pose,
        stored=stored,
        is_ground=is_ground,
        mask=~is_ground & (np.abs(sweep0.points[:, :2]) <= 50).all(axis=1),
        bsfe_ground=AV2Log(av2_folder, ground="bsfe").sweep(0).is_ground,
        next_points=sweep1.points,
    )


@pytest.fixture(scope="module")
def from_boxes(av2_folder: Path, tmp_path_factory: pytest.TempPathFactory) -> FlowLabels:
    """Truth made from the boxes and the float64 poses, as BucketedSceneFlowEval makes its own."""
    folder = tmp_path_factory.mktemp("log") / "without_labels"
    folder.mkdir()
    for entry in av2_folder.iterdir():
        if entry.name != "flow_labels.feather":
            (folder / entry.name).symlink_to(entry)
    labels = AV2Log(folder).labels(0)
    assert labels is not None
    return labels


def check_three_way(results: Dict[str, Any], **expected: float) -> None:
    measured = {key: results["three_way"][key] for key in expected}
    assert measured == pytest.approx(expected, abs=TOLERANCE, rel=0)


def check_classes(results: Dict[str, Any], **expected: Any) -> None:
    """Expected: class = (static EPE, dynamic error); None = NaN."""
    for name, (static, dynamic) in expected.items():
        scores = results["bucketed"]["mean"] if name == "mean" else results["bucketed"]["classes"][name]
        for key, value in (("static_epe", static), ("dynamic_error", dynamic)):
            if value is None:
                assert np.isnan(scores[key]), (name, key)
            else:
                assert scores[key] == pytest.approx(value, abs=TOLERANCE, rel=0), (name, key)


def filled(results: Dict[str, Any], name: str, key: str) -> Dict[int, Any]:
    """Bucket number -> value, of the buckets that have points."""
    buckets = results["bucketed"]["classes"][name]["buckets"]
    return {i: value for i, (value, count) in enumerate(zip(buckets[key], buckets["count"])) if count}


def test_points_of_the_pair(pair: Pair) -> None:
    assert len(pair.points) == 99_229
    assert pair.is_ground.sum() == 17_374
    assert (~pair.is_ground).sum() == 81_855
    assert len(pair.next_points) == 99_466
    assert pair.mask.sum() == 78_506  # 78_507 with OpenSceneFlow's ground, which has one point less
    near = pair.points[~pair.is_ground, :2]
    assert (np.linalg.norm(near, axis=1) <= 35).sum() == 72_805
    assert (np.abs(near).max(axis=1) <= 35).sum() == 74_296


def test_av2_three_way(pair: Pair) -> None:
    # The official prediction is, bit for bit, the ego motion flow that the labels give to the background.
    background = (pair.stored.category == 0)[:, None]
    pose_flow = np.where(background, pair.stored.flow, ego_motion_flow(pair.points, pair.npz))
    check_three_way(
        pair.score("av2", pose_flow=pose_flow),
        epe_fd=0.6737204147,
        epe_fs=0.0062440348,
        epe_bs=0.0,
        epe_3way=0.2266548165,
        dynamic_iou=0.0,
    )


def test_opensceneflow_npz(pair: Pair) -> None:
    results = pair.score("opensceneflow")
    check_three_way(
        results, epe_fd=0.6737206772, epe_fs=0.0062896596, epe_bs=6.2128e-07, epe_3way=0.2266703194, dynamic_iou=0.0
    )
    check_classes(
        results,
        BACKGROUND=(6.21e-07, None),
        CAR=(0.00620734, 1.0),
        PEDESTRIAN=(0.00582801, 1.0),
        WHEELED_VRU=(0.00385737, None),
        OTHER_VEHICLES=(None, None),
        mean=(0.00397334, 1.0),
    )
    assert filled(results, "CAR", "count") == {0: 6051, 1: 24, 3: 208, 11: 239, 20: 1117, 26: 161}
    speeds = {0: 0.0062073, 1: 0.0491397, 3: 0.1400945, 11: 0.4419174, 20: 0.8175343, 26: 1.0444958}
    assert filled(results, "CAR", "speed") == pytest.approx(speeds, abs=TOLERANCE, rel=0)
    assert filled(results, "PEDESTRIAN", "count") == {0: 156, 2: 94}
    assert filled(results, "PEDESTRIAN", "speed")[2] == pytest.approx(0.0998975, abs=TOLERANCE, rel=0)
    assert filled(results, "WHEELED_VRU", "count") == {0: 166}
    dynamic = results["three_way"]["breakdown"]["foreground"]["dynamic"]["all"]["count"]
    assert dynamic == 1_819


def test_classes_within_35_metres(pair: Pair) -> None:
    counts = {}
    for region in ("disc", "box"):
        classes = pair.score(replace(DEFINITIONS["opensceneflow"], region=region))["bucketed"]["classes"]
        counts[region] = {name: row["num_static"] + row["num_dynamic"] for name, row in classes.items()}
    assert [counts["disc"][name] for name in ("CAR", "PEDESTRIAN", "WHEELED_VRU", "OTHER_VEHICLES")] == [
        7800,
        250,
        166,
        0,
    ]
    assert counts["box"]["WHEELED_VRU"] == 166 + 39  # a parked motorcycle in a corner of the box


def test_opensceneflow_range_wise(pair: Pair) -> None:
    ranges = pair.score("opensceneflow")["range_wise"]
    counts = {name: (row["num_static"], row["num_dynamic"]) for name, row in ranges.items() if name != "mean"}
    assert counts == {
        "0-35": (71_046, 1_612),
        "35-50": (5_502, 0),
        "50-75": (346, 0),
        "75-100": (0, 0),
        "100-inf": (0, 0),
    }
    measured = [ranges[name]["static_epe"] for name in ("0-35", "35-50", "50-75", "mean")]
    expected = [0.00091971, 0.00036213, 1.825e-06, 0.00042789]
    assert measured == pytest.approx(expected, abs=1e-8, rel=0)  # every digit that was printed
    assert ranges["0-35"]["dynamic_epe"] == pytest.approx(0.74473900, abs=TOLERANCE, rel=0)


def test_opensceneflow_float64_poses(pair: Pair) -> None:
    results = pair.score("opensceneflow", T_ego1_ego0=pair.poses)
    check_three_way(
        results, epe_fd=0.6740044185, epe_fs=0.0060820697, epe_bs=8.2264e-04, epe_3way=0.2269697108, dynamic_iou=0.0
    )
    assert filled(results, "CAR", "count") == {0: 6051, 1: 24, 3: 208, 10: 23, 11: 216, 20: 1117, 26: 161}


def test_bucketed_scene_flow_eval(pair: Pair, from_boxes: FlowLabels) -> None:
    parts: Dict[str, Any] = {
        "labels": from_boxes,
        "T_ego1_ego0": pair.poses,
        "is_ground": pair.bsfe_ground,
        "eval_mask": None,
    }
    results = pair.score("bucketed_scene_flow_eval", **parts)
    check_three_way(results, epe_fd=0.664467, epe_fs=0.005682, epe_bs=0.0)
    check_classes(
        results,
        BACKGROUND=(0.0, None),
        CAR=(0.005598, 1.0),
        PEDESTRIAN=(0.005120, 1.0),
        WHEELED_VRU=(0.003867, None),
        OTHER_VEHICLES=(None, None),
        mean=(0.003646, 1.0),
    )
    assert filled(results, "CAR", "count") == {0: 5729, 1: 21, 3: 208, 10: 21, 11: 216, 20: 1032, 26: 142}
    assert filled(results, "PEDESTRIAN", "count") == {0: 152, 2: 90}
    assert filled(results, "WHEELED_VRU", "count") == {0: 183}
    with_ground = replace(DEFINITIONS["bucketed_scene_flow_eval"], exclude_ground=False)
    check_classes(
        pair.score(with_ground, **parts), CAR=(0.006029, 1.0), PEDESTRIAN=(0.005703, 1.0), WHEELED_VRU=(0.004034, None)
    )


def test_half_of_the_true_residual(pair: Pair) -> None:
    residual = pair.stored.flow - ego_motion_flow(pair.points, pair.npz)
    results = pair.score("opensceneflow", residual_flow=0.5 * residual)
    check_three_way(results, epe_fd=0.3368603381, epe_fs=0.0031448298, epe_3way=0.1133351595, dynamic_iou=0.9747113793)
    for name, expected in (("CAR", 0.49999999993), ("PEDESTRIAN", 0.50000000074)):
        error = results["bucketed"]["classes"][name]["dynamic_error"]
        assert error == pytest.approx(expected, abs=TOLERANCE, rel=0)


def test_noise(pair: Pair) -> None:
    noise = np.random.default_rng(0).normal(0, 0.05, (99_229, 3)).astype(np.float32)
    results = pair.score("opensceneflow", residual_flow=noise)
    check_three_way(results, epe_fd=0.6799331272, epe_fs=0.0798506559, epe_bs=0.0799001127, dynamic_iou=0.0247696440)
    check_classes(
        results,
        CAR=(0.0797635345, 1.1924512872),
        PEDESTRIAN=(0.0811704863, 1.3127384422),
        WHEELED_VRU=(0.0797579710, None),
        mean=(0.0801480261, 1.2525948647),
    )


@pytest.mark.parametrize("definition", sorted(DEFINITIONS))
def test_truth_returned_scores_zero(pair: Pair, definition: str) -> None:
    results = pair.score(definition, flow=pair.stored.flow, residual_flow=None, T_ego1_ego0=pair.poses)
    assert results["three_way"]["epe_fd"] == 0.0
    assert results["three_way"]["dynamic_iou"] == pytest.approx(1.0, abs=1e-9)
    if "bucketed" in results:
        check_classes(results, CAR=(0.0, 0.0), PEDESTRIAN=(0.0, 0.0))
