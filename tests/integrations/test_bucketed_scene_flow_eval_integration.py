"""CorrelationFlowEstimator on our own frames with the package's fields, and on bucketed-scene-flow-eval itself."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any, List, Sequence

import numpy as np
import public_evaluators as public
import pytest
from scenes import pose
from turning_drive import SETTINGS, drive, expected, relative_to, speeds

from cflow_torch import CFlowError, Sweep, Window
from cflow_torch.data.av2 import AV2Log
from cflow_torch.data.log import window
from cflow_torch.evaluation import EvalFrame
from cflow_torch.integrations.bucketed_scene_flow_eval import CorrelationFlowEstimator


def make_frame(number: int, sweep: Sweep, ego_to_global: np.ndarray, sensor_to_ego: Any = None) -> SimpleNamespace:
    def SE3(matrix: np.ndarray) -> SimpleNamespace:
        return SimpleNamespace(to_array=lambda: matrix)

    poses = {"sensor_to_ego": SE3(np.eye(4) if sensor_to_ego is None else sensor_to_ego)}
    pc = SimpleNamespace(
        full_pc=SimpleNamespace(points=np.asarray(sweep.points)),
        mask=~np.asarray(sweep.is_ground),
        pose=SimpleNamespace(**poses, ego_to_global=SE3(ego_to_global)),
    )
    return SimpleNamespace(pc=pc, log_id="log", log_idx=number, log_timestamp=sweep.timestamp_ns)


def make_frames(sweeps: Sequence[Sweep], origin: int = -1) -> list[SimpleNamespace]:
    poses = relative_to(list(sweeps), origin)
    return [make_frame(number, sweep, own) for number, (sweep, own) in enumerate(zip(sweeps, poses))]


def estimator(num_history: int = 0, **settings: Any) -> CorrelationFlowEstimator:
    return CorrelationFlowEstimator(**{**SETTINGS, "num_history": num_history, **settings})


def check_flow(flow: Any, rotated: np.ndarray) -> None:
    np.testing.assert_allclose(flow.full_flow, rotated, rtol=0, atol=1e-6)


@pytest.mark.parametrize("origin", [-1, 0, 1])
def test_flow_is_in_the_axes_of_t(bsfe: ModuleType, origin: int) -> None:
    """Poses may be relative to any sweep: a causal loader takes the last, a non-causal one that in the middle."""
    sweeps = drive(3)
    frames = make_frames(sweeps, origin)
    flows = estimator()(frames)
    assert len(flows) == 2
    for number, flow in enumerate(flows):
        rotated = expected(sweeps, number, 0)
        assert flow.full_flow.dtype == np.float32 and np.isfinite(flow.full_flow).all()
        check_flow(flow, rotated)
        # In the axes of t + 1 the flow would differ.
        moving = speeds(rotated) > 0.3
        assert np.abs(rotated[moving] @ pose(0, 0, -0.2)[:3, :3].T - rotated[moving]).max() > 0.03
        np.testing.assert_array_equal(flow.mask, frames[number].pc.mask)
        assert flow.mask is not frames[number].pc.mask  # the evaluator writes into masks
        assert np.isnan(frames[number].pc.full_pc.points).any() and not flow.full_flow[~flow.mask].any()


def test_earlier_frames_are_the_history(bsfe: ModuleType) -> None:
    sweeps = drive(5)
    flows = estimator(2)(make_frames(sweeps))
    assert len(flows) == 4
    for number, flow in enumerate(flows):
        check_flow(flow, expected(sweeps, number, 2))
    assert np.abs(flows[3].full_flow - expected(sweeps, 3, 0)).max() > 0.01


def test_a_sensor_with_a_frame_of_its_own(bsfe: ModuleType) -> None:
    """In nuScenes, points and true flow are in the axes of the sensor."""
    sweeps = drive(2)
    sensor_to_ego = pose(1.0, 0.2, math.radians(-90), 1.8)
    inverse = np.linalg.inv(sensor_to_ego)
    (flow,) = estimator()(make_frames(sweeps))
    frames = []
    for number, (sweep, own) in enumerate(zip(sweeps, relative_to(sweeps, -1))):
        seen = replace(sweep, points=np.asarray(sweep.points, dtype=np.float64) @ inverse[:3, :3].T + inverse[:3, 3])
        frames.append(make_frame(number, seen, own, sensor_to_ego))
    (in_sensor,) = estimator()(frames)
    check_flow(in_sensor, flow.full_flow @ inverse[:3, :3].T)
    assert speeds(flow.full_flow).max() > 0.3


class DataSet(List[List[SimpleNamespace]]):
    """Replacement of a causal or non-causal data set of several logs."""

    def __init__(self, logs: Sequence[Sequence[Sweep]], length: int, loader: str, step: int = 1) -> None:
        super().__init__()
        for name, log in enumerate(logs):
            for start in range(0, len(log) - length + 1, step):
                self.append(make_frames(log[start : start + length]))
                for number, frame in enumerate(self[-1]):
                    frame.log_id, frame.log_idx = f"log {name}", start + number
        self.loader = loader

    def loader_type(self) -> SimpleNamespace:
        return SimpleNamespace(name=self.loader)

    def evaluator(self) -> Any:
        flows: dict[tuple[str, int], Any] = {}
        store = lambda flow, frame: flows.__setitem__((frame.log_id, frame.log_idx), flow)  # noqa: E731
        return SimpleNamespace(flows=flows, eval=store)


@pytest.mark.parametrize("length", [2, 3])
def test_overlapping_items_share_their_history(bsfe: ModuleType, length: int) -> None:
    logs = [drive(5), drive(4, seed=3)]
    flows = estimator(2).evaluate(DataSet(logs, length, "CAUSAL")).flows
    assert sorted(flows) == [(f"log {n}", i) for n, log in enumerate(logs) for i in range(length - 2, len(log) - 1)]
    for (name, index), flow in flows.items():
        check_flow(flow, expected(logs[int(name[-1])], index, 2))


def test_one_warning_about_ground_which_can_be_found(bsfe: ModuleType) -> None:
    """With with_ground=True the masks do not mark the ground."""
    rng = np.random.default_rng(0)
    ground = np.concatenate([rng.uniform(-30, 30, (20000, 2)), 0.02 * rng.standard_normal((20000, 1))], 1)
    car, no_mask = rng.uniform((4, 2, 0.5), (8, 4, 1.8), (2000, 3)), np.zeros(22000, dtype=bool)
    clouds = [np.concatenate([ground, car + [k, 0, 0]]).astype(np.float32) for k in range(2)]
    frames = make_frames([Sweep(points, no_mask, np.eye(4), 10**8 * k) for k, points in enumerate(clouds)])
    plain = CorrelationFlowEstimator("paper")
    with pytest.warns(UserWarning, match="ground='auto'") as caught:
        (joined,) = plain(frames)
        plain(frames)
    assert len(caught) == 1 and joined.full_flow[:-2000].any()  # the ground moves with the car
    (flow,) = CorrelationFlowEstimator("paper", ground="auto")(frames)
    np.testing.assert_allclose(np.median(flow.full_flow[-2000:], axis=0), [1, 0, 0], atol=0.051)
    assert not flow.full_flow[:-2000].any() and flow.mask.all()


@pytest.mark.parametrize(
    ("path", "value", "complaint"),
    [
        ("pc.mask", np.ones(3, dtype=bool), r"frames\[1\]\.pc\.mask has shape \(3,\)"),
        ("pc.full_pc", np.zeros((5, 4)), r"frames\[1\]\.pc\.full_pc has shape \(5, 4\)"),
        ("pc.pose.ego_to_global", np.full((4, 4), np.nan), r"frames\[1\]\.pc\.pose\.ego_to_global holds NaN"),
        ("log_idx", 2, r"frames\[1\]\.log_id, log_idx.* 2 after 'log', 0"),
    ],
)
def test_the_error_names_the_bad_field_of_a_frame(bsfe: ModuleType, path: str, value: Any, complaint: str) -> None:
    frames = make_frames(drive(2))
    *holders, last = path.split(".")
    holder: Any = frames[1]
    for name in holders:
        holder = getattr(holder, name)
    setattr(holder, last, value)
    with pytest.raises(CFlowError, match=complaint):
        estimator()(frames)
    for few_or_pairs in (frames[:1], [(frame, None) for frame in frames]):
        with pytest.raises(CFlowError, match="at least two frames"):
            estimator()(few_or_pairs)


@pytest.mark.parametrize("preset", ["paper", "default"])
def test_real_pair_through_their_evaluator(bsfe: ModuleType, av2_folder: Path, tmp_path: Path, preset: str) -> None:
    """Our evaluation gets the flow of the same points as their data set's items, in our own axes."""
    pair, raw, stored = public.read_pair(av2_folder), av2_folder.parent, window(AV2Log(av2_folder, ground="bsfe"), 0)
    sweeps = Window(*(replace(sweep, point_times=None) for sweep in (stored.pc0, stored.pc1)))  # frames have no times
    T, labels = pair.T_float64, pair.labels
    truth = public.write_bsfe_truth(tmp_path, [(public.residual_at_t(pair), labels.category, labels.is_valid)])
    data_set = public.bsfe_data_set(bsfe, raw, truth, "bucketed_epe", truth)
    (item,) = data_set
    cropped = [replace(sweep, is_ground=~frame.pc.mask) for sweep, frame in zip((sweeps.pc0, sweeps.pc1), item)]
    estimate = CorrelationFlowEstimator(preset)
    (result,) = estimate.model([Window(*cropped)])
    rotated = result.residual_flow.double().numpy() @ T[:3, :3]
    (flow,) = estimate(item)
    check_flow(flow, rotated)
    assert speeds(rotated).max() > 0.5 and np.abs(rotated - result.residual_flow.numpy()).max() > 1e-3
    # Both readers have the same points, masks and ground.
    np.testing.assert_array_equal(item[0].pc.full_pc.points.astype(np.float32), pair.points)
    assert not (item[0].pc.mask & pair.bsfe_ground).any() and (flow.mask == item[0].pc.mask).all()
    parts = {"residual_flow": result.residual_flow, "T_ego1_ego0": T, "is_ground": pair.bsfe_ground}
    ours = public.score("bucketed_scene_flow_eval", [EvalFrame(pair.points, labels, **parts)])
    evaluator = estimate.evaluate(data_set)
    public.check("estimator, buckets", public.bucket_numbers(ours["bucketed"], evaluator, truth))
