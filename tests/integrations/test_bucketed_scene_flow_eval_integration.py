"""CorrelationFlowEstimator: on frames of our own with the package's fields, and live on bucketed-scene-flow-eval."""

from __future__ import annotations

import math
import subprocess
import sys
from dataclasses import dataclass, replace
from enum import Enum
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any, Dict, List, Sequence, Tuple

import numpy as np
import pytest
from scenes import pose
from test_live_evaluators import (
    EDGES,
    LOG,
    MadeUp,
    compare_buckets,
    compare_three_way,
    score,
    total_flow,
    write_bsfe_truth,
    write_log,
)
from turning_drive import SETTINGS, YAW_STEP, drive, expected, relative_to, speeds

from cflow_torch import CFlowError, CorrelationFlow, Sweep
from cflow_torch.data.av2 import AV2Log
from cflow_torch.data.log import FlowLabels, window
from cflow_torch.evaluation import EvalFrame
from cflow_torch.integrations.bucketed_scene_flow_eval import CorrelationFlowEstimator
from cflow_torch.integrations.sequence import times_in_ns

# ------------------------------------------------------------------------------ frames with the same fields, no package


@dataclass
class Flow:
    """Stands for `EgoLidarFlow`."""

    full_flow: np.ndarray
    mask: np.ndarray


class LoaderType(Enum):
    CAUSAL = 0
    NON_CAUSAL = 1


@pytest.fixture
def stand_in(monkeypatch: pytest.MonkeyPatch) -> None:
    """`bucketed_scene_flow_eval.datastructures` with the one class that is returned."""
    module = ModuleType("bucketed_scene_flow_eval.datastructures")
    module.EgoLidarFlow = Flow  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "bucketed_scene_flow_eval", ModuleType("bucketed_scene_flow_eval"))
    monkeypatch.setitem(sys.modules, "bucketed_scene_flow_eval.datastructures", module)


class SE3:
    """Stands for the package's class of that name."""

    def __init__(self, matrix: np.ndarray) -> None:
        self.matrix = matrix

    def to_array(self) -> np.ndarray:
        return self.matrix


def make_frame(
    number: int,
    sweep: Sweep,
    ego_to_global: np.ndarray,
    sensor_to_ego: np.ndarray = np.eye(4),  # noqa: B008
) -> SimpleNamespace:
    points = np.asarray(sweep.points)
    return SimpleNamespace(
        pc=SimpleNamespace(
            full_pc=SimpleNamespace(points=points),
            mask=~np.asarray(sweep.is_ground),
            pose=SimpleNamespace(
                sensor_to_ego=SE3(np.eye(4) if sensor_to_ego is None else sensor_to_ego),
                ego_to_global=SE3(ego_to_global),
            ),
        ),
        log_id="log",
        log_idx=number,
        log_timestamp=sweep.timestamp_ns,
    )


def make_frames(sweeps: Sequence[Sweep], origin: int = -1) -> List[SimpleNamespace]:
    poses = relative_to(list(sweeps), origin)
    return [make_frame(number, sweep, own) for number, (sweep, own) in enumerate(zip(sweeps, poses))]


def estimator(num_history: int = 0, **settings: Any) -> CorrelationFlowEstimator:
    return CorrelationFlowEstimator(**{**SETTINGS, "num_history": num_history, **settings})


@pytest.mark.parametrize("origin", [-1, 0, 1])
def test_flow_is_in_the_axes_of_t(stand_in: None, origin: int) -> None:
    """Whatever sweep the poses are relative to: a causal loader takes the last, a non-causal one that in the middle."""
    sweeps = drive(3)
    flows = estimator()(make_frames(sweeps, origin))
    assert len(flows) == 2
    for number, flow in enumerate(flows):
        turned = expected(sweeps, number, 0)
        assert flow.full_flow.dtype == np.float32 and flow.full_flow.shape == turned.shape
        np.testing.assert_allclose(flow.full_flow, turned, rtol=0, atol=1e-6)
        # The moving box: 0.5 m in the world's axes, to one pixel.
        moves = speeds(turned) > 0.3
        assert 100 < moves.sum() <= 150
        world = flow.full_flow[moves] @ pose(0, 0, YAW_STEP * number)[:3, :3].T
        assert np.linalg.norm(np.median(world, axis=0) - [0.3, 0.4, 0]) < 0.25
        # What the axes of t + 1 would give: the difference that this test is for.
        assert np.abs(turned[moves] @ pose(0, 0, -YAW_STEP)[:3, :3].T - turned[moves]).max() > 0.03


def test_nothing_moves_but_the_vehicle(stand_in: None) -> None:
    for flow in estimator(1)(make_frames(drive(3, velocity=0.0, noise=0.0))):
        assert not flow.full_flow.any()


def test_earlier_frames_are_history_nearest_first_and_every_frame_gets_a_flow(stand_in: None) -> None:
    sweeps = drive(5)
    flows = estimator(2)(make_frames(sweeps))
    assert len(flows) == 4
    for number, flow in enumerate(flows):
        np.testing.assert_allclose(flow.full_flow, expected(sweeps, number, 2), rtol=0, atol=1e-6)
    assert np.abs(flows[3].full_flow - expected(sweeps, 3, 0)).max() > 0.01
    last = estimator(2).last(make_frames(sweeps))
    np.testing.assert_array_equal(last.full_flow, flows[3].full_flow)


def test_masks_and_points_that_take_no_part(stand_in: None) -> None:
    frames = make_frames(drive(2))
    (flow,) = estimator()(frames)
    np.testing.assert_array_equal(flow.mask, frames[0].pc.mask)
    assert flow.mask is not frames[0].pc.mask  # the evaluator writes into masks
    assert np.isnan(frames[0].pc.full_pc.points).any() and np.isfinite(flow.full_flow).all()
    assert not flow.full_flow[~flow.mask].any()


def test_pairs_of_frame_and_data_as_load_frame_list_gives_them(stand_in: None) -> None:
    sweeps = drive(3)
    bare = estimator(1)(make_frames(sweeps))
    frames = make_frames(sweeps)
    pairs = []
    for frame, sweep in zip(frames, sweeps):
        frame.pc.mask = np.ones(len(sweep.points), dtype=bool)
        pairs.append((frame, SimpleNamespace(is_ground_points=sweep.is_ground, in_range_mask=None)))
    for flow, reference in zip(estimator(1)(pairs), bare):
        np.testing.assert_array_equal(flow.full_flow, reference.full_flow)
        assert flow.mask.all()


@pytest.mark.parametrize("dtype", [np.float16, np.float64])
def test_a_sensor_with_a_frame_of_its_own(stand_in: None, dtype: Any) -> None:
    """nuScenes: points, and the truth of the flow, are in the axes of the sensor."""
    sweeps = [replace(sweep, points=np.asarray(sweep.points).astype(dtype)) for sweep in drive(2)]
    sensor_to_ego = pose(1.0, 0.2, math.radians(-90), 1.8)
    inverse = np.linalg.inv(sensor_to_ego)
    (flow,) = estimator()(make_frames(sweeps))
    frames = []
    for number, (sweep, own) in enumerate(zip(sweeps, relative_to(sweeps, -1))):
        seen = replace(sweep, points=np.asarray(sweep.points, dtype=np.float64) @ inverse[:3, :3].T + inverse[:3, 3])
        frames.append(make_frame(number, seen, own, sensor_to_ego))
    (in_sensor,) = estimator()(frames)
    np.testing.assert_allclose(in_sensor.full_flow, flow.full_flow @ inverse[:3, :3].T, rtol=0, atol=1e-6)
    assert speeds(flow.full_flow).max() > 0.3


class DataSet:
    """Stands for a causal or non-causal data set over one or more logs."""

    def __init__(self, logs: Sequence[Sequence[Sweep]], length: int, loader: LoaderType, step: int = 1) -> None:
        self.items = []
        for name, log in enumerate(logs):
            for start in range(0, len(log) - length + 1, step):
                frames = make_frames(log[start : start + length])
                for number, frame in enumerate(frames):
                    frame.log_id, frame.log_idx = f"log {name}", start + number
                self.items.append(frames)
        self.loader = loader

    def __len__(self) -> int:
        return len(self.items)

    def __getitem__(self, index: int) -> List[SimpleNamespace]:
        return self.items[index]

    def loader_type(self) -> LoaderType:
        return self.loader

    def evaluator(self) -> Any:
        taken: Dict[Tuple[str, int], Flow] = {}
        return SimpleNamespace(
            taken=taken, eval=lambda flow, frame: taken.__setitem__((frame.log_id, frame.log_idx), flow)
        )


@pytest.mark.parametrize("length", [2, 3])
def test_overlapping_items_lend_each_other_history(stand_in: None, length: int) -> None:
    logs = [drive(5), drive(4, velocity=0.7)]
    taken = estimator(2).evaluate(DataSet(logs, length, LoaderType.CAUSAL)).taken
    assert sorted(taken) == [(f"log {n}", i) for n, log in enumerate(logs) for i in range(length - 2, len(log) - 1)]
    for (name, index), flow in taken.items():
        np.testing.assert_allclose(flow.full_flow, expected(logs[int(name[-1])], index, 2), rtol=0, atol=1e-6)


def test_items_that_do_not_overlap_stand_alone(stand_in: None) -> None:
    log = drive(6)
    taken = estimator(2).evaluate(DataSet([log], 3, LoaderType.NON_CAUSAL, step=3)).taken
    assert sorted(index for _, index in taken) == [0, 1, 3, 4]
    for (_, index), flow in taken.items():
        np.testing.assert_allclose(flow.full_flow, expected(log[index // 3 * 3 :], index % 3, 2), rtol=0, atol=1e-6)


def test_numbers_of_sweeps_are_not_taken_for_times(stand_in: None) -> None:
    assert times_in_ns([0, 1, 2]) == (None, None, None)
    assert times_in_ns([10**9, 10**9 + 10**8]) == (10**9, 10**9 + 10**8)
    frames, numbered = make_frames(drive(3)), make_frames(drive(3))
    for number, frame in enumerate(numbered):
        frame.log_timestamp = number
    settings = {"num_history": 1, "use_timestamps": True, "max_speed": 30.0}
    for a, b in zip(estimator(**settings)(frames), estimator(**settings)(numbered)):
        np.testing.assert_array_equal(a.full_flow, b.full_flow)
    frames[0].log_timestamp -= 3 * 10**8  # the sweep before t is 0.4 s old, so its motion is divided by 5, not by 2
    late = estimator(**settings)(frames)[1]
    assert np.abs(late.full_flow - b.full_flow).max() > 0.05


def ground_and_car() -> List[Sweep]:
    rng = np.random.default_rng(0)
    ground = np.concatenate([rng.uniform(-30, 30, (20000, 2)), 0.02 * rng.standard_normal((20000, 1))], 1)
    car = rng.uniform((4, 2, 0.5), (8, 4, 1.8), (2000, 3))
    sweeps = []
    for k in range(2):
        points = np.concatenate([ground, car + [k, 0, 0]]).astype(np.float32)
        sweeps.append(Sweep(points, np.zeros(len(points), dtype=bool), np.eye(4), 10**8 * k))
    return sweeps


def test_ground_that_the_data_set_left_in(stand_in: None) -> None:
    """with_ground=True: the masks do not tell. Said once; ground='auto' finds it."""
    frames, plain = make_frames(ground_and_car()), CorrelationFlowEstimator("paper")
    with pytest.warns(UserWarning, match="ground='auto'") as caught:
        (joined,) = plain(frames)
        plain(frames)
    assert len(caught) == 1
    assert joined.full_flow[:-2000].any()  # ground that moves with the car
    (flow,) = CorrelationFlowEstimator("paper", ground="auto")(frames)
    np.testing.assert_allclose(np.median(flow.full_flow[-2000:], axis=0), [1, 0, 0], atol=0.051)
    assert not flow.full_flow[:-2000].any() and flow.mask.all()


def test_both_methods_and_any_setting(stand_in: None) -> None:
    frames = make_frames(drive(2))
    (flow,) = CorrelationFlowEstimator(method="keypoints", device="cpu")(frames)
    assert flow.full_flow.shape == (len(flow.mask), 3)
    with pytest.raises(CFlowError, match="unknown setting voxel"):
        CorrelationFlowEstimator(voxel=0.1)
    with pytest.raises(CFlowError, match="ground='yes'"):
        CorrelationFlowEstimator(ground="yes")


def broken(**changes: Any) -> Any:
    def change(frames: List[SimpleNamespace]) -> None:
        for path, value in changes.items():
            *holders, last = path.split("__")
            holder: Any = frames[1]
            for name in holders:
                holder = getattr(holder, name)
            if value is AttributeError:
                delattr(holder, last)
            else:
                setattr(holder, last, value)

    return change


WRONG_POSE = np.diag([2.0, 1, 1, 1])
NAN_POSE = np.full((4, 4), np.nan)


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        (broken(pc=AttributeError), r"frames\[1\] is SimpleNamespace without 'pc'"),
        (broken(pc__mask=AttributeError), r"frames\[1\]\.pc is SimpleNamespace without 'mask'"),
        (broken(pc__mask=np.ones(3, dtype=bool)), r"frames\[1\]\.pc\.mask has shape \(3,\)"),
        (broken(pc__mask=np.ones(558)), r"frames\[1\]\.pc\.mask has shape \(558,\), float64"),
        (broken(pc__full_pc=np.zeros((5, 4))), r"frames\[1\]\.pc\.full_pc has shape \(5, 4\)"),
        (broken(pc__full_pc=np.zeros((5, 3), dtype=int)), r"frames\[1\]\.pc\.full_pc .*int"),
        (broken(pc__pose__ego_to_global=SE3(NAN_POSE)), r"frames\[1\]\.pc\.pose\.ego_to_global holds NaN"),
        (broken(pc__pose__sensor_to_ego=SE3(WRONG_POSE)), r"frames\[1\]\.pc\.pose\.sensor_to_ego is not rigid"),
        (broken(log_id="other"), r"frames\[1\]\.log_id is 'other' after 'log'"),
        (broken(log_idx=2), r"frames\[1\]\.log_idx is 2 after 0"),
        (broken(log_idx=0), r"frames\[1\]\.log_idx is 0 after 0"),
        (broken(log_timestamp=None), r"frames\[1\]\.log_timestamp is None"),
        (lambda frames: frames.pop(), "frames holds 1: give a list of at least two"),
    ],
)
def test_bad_frames_are_refused_by_the_name_of_the_field(stand_in: None, change: Any, complaint: str) -> None:
    frames = make_frames(drive(2))
    estimator()(frames)
    change(frames)
    with pytest.raises(CFlowError, match=complaint):
        estimator()(frames)


def test_the_package_is_asked_for_when_it_is_needed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "bucketed_scene_flow_eval", None)
    monkeypatch.setitem(sys.modules, "bucketed_scene_flow_eval.datastructures", None)
    with pytest.raises(CFlowError, match="pip install 'bucketed-scene-flow-eval>=2.0.25'"):
        estimator()(make_frames(drive(2)))
    code = (
        "import sys, cflow_torch.integrations.bucketed_scene_flow_eval, cflow_torch.integrations.scene_flow_zoo\n"
        "print({'bucketed_scene_flow_eval', 'open3d', 'dataloaders', 'models'} & set(sys.modules))"
    )
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout == "set()\n"


# ------------------------------------------------------------------------------------------------------------ live


def make_data_set(bsfe: ModuleType, raw: Path, truth: Path, output: Path, kind: str, length: int = 2) -> Any:
    return bsfe.Argoverse2CausalSceneFlow(
        raw,
        subsequence_length=length,
        flow_data_path=truth,
        with_ground=False,
        eval_type=kind,
        eval_args={"output_path": output / kind},
        cache_root=output,
        use_cache=False,
    )


def check_scores(bsfe: ModuleType, estimate: Any, folders: Tuple[Path, Path, Path], frames: List[EvalFrame]) -> None:
    """Their evaluator over their data set with our estimator, against our evaluation of our frames."""
    import json

    from bucketed_scene_flow_eval.eval.base_per_frame_sceneflow_eval import PerFrameSceneFlowEvaluator

    ours = score("bucketed_scene_flow_eval", frames)
    raw, truth, output = folders
    evaluator = estimate.evaluate(make_data_set(bsfe, raw, truth, output, "bucketed_epe"))
    assert len(evaluator) == len(frames)
    classes = evaluator.compute_results()
    cells = PerFrameSceneFlowEvaluator.compute_results(evaluator, save_results=False)
    mean = json.loads((output / "bucketed_epe" / "mean_average_results_35.json").read_text())
    compare_buckets(ours["bucketed"], (classes, cells, mean), 35).check("estimator, buckets")
    three_way = estimate.evaluate(make_data_set(bsfe, raw, truth, output, "threeway_epe")).compute_results()
    compare_three_way(ours["three_way"], three_way).check("estimator, three-way")


@pytest.mark.parametrize("preset", ["paper", "default", "keypoints"])
def test_real_pair_through_their_evaluator(bsfe: ModuleType, av2_folder: Path, tmp_path: Path, preset: str) -> None:
    """Items of their data set: our evaluation gets the flow of the same points, in our own axes."""
    log = AV2Log(av2_folder, ground="bsfe")
    sweeps, labels = window(log, 0), log.labels(0)
    assert labels is not None
    T, start = np.linalg.inv(sweeps.pc1.pose) @ sweeps.pc0.pose, sweeps.pc0.points.astype(np.float64)
    end_at_t = (start + labels.flow - T[:3, 3]) @ T[:3, :3]
    write_bsfe_truth(tmp_path / "truth", [((end_at_t - start).astype(np.float32), labels.category, labels.is_valid)])
    data_set = make_data_set(bsfe, av2_folder.parent, tmp_path / "truth", tmp_path, "bucketed_epe")
    (item,) = [data_set[number] for number in range(len(data_set))]
    cropped = [replace(sweep, is_ground=~frame.pc.mask) for sweep, frame in zip((sweeps.pc0, sweeps.pc1), item)]
    estimate = CorrelationFlowEstimator(preset)
    (result,) = estimate.sequence_flow.model([replace(sweeps, pc0=cropped[0], pc1=cropped[1])])
    (flow,) = estimate(item)
    turned = result.residual_flow.double().numpy() @ T[:3, :3]
    np.testing.assert_allclose(flow.full_flow, turned, rtol=0, atol=1e-6)
    assert speeds(turned).max() > 0.5 and np.abs(turned - result.residual_flow.numpy()).max() > 1e-3
    # Points, masks and ground of the two readers are the same.
    np.testing.assert_array_equal(item[0].pc.full_pc.points.astype(np.float32), sweeps.pc0.points)
    assert not (item[0].pc.mask & sweeps.pc0.is_ground).any() and (flow.mask == item[0].pc.mask).all()
    frame = EvalFrame(
        sweeps.pc0.points,
        labels,
        residual_flow=result.residual_flow,
        T_ego1_ego0=T,
        is_ground=sweeps.pc0.is_ground,
    )
    check_scores(bsfe, estimate, (av2_folder.parent, tmp_path / "truth", tmp_path), [frame])


def test_pairs_with_ground_points_are_what_our_reader_gives(bsfe: ModuleType, av2_folder: Path, tmp_path: Path) -> None:
    """`load_frame_list`: ground is known, nothing is cropped: the flow is that of `cflow eval` on the same log."""
    log = AV2Log(av2_folder, ground="bsfe")
    sweeps, labels = window(log, 0), log.labels(0)
    assert labels is not None
    (result,) = CorrelationFlow.from_preset("paper")([sweeps])
    T = np.linalg.inv(sweeps.pc1.pose) @ sweeps.pc0.pose
    no_motion = np.zeros_like(sweeps.pc0.points)
    write_bsfe_truth(tmp_path / "truth", [(no_motion, labels.category, labels.is_valid)])
    data_set = make_data_set(bsfe, av2_folder.parent, tmp_path / "truth", tmp_path, "bucketed_epe")
    pairs = data_set.sequence_loader.load_sequence(LOG).load_frame_list(relative_to_idx=0)
    (flow,) = CorrelationFlowEstimator("paper")(pairs)
    turned = result.residual_flow.double().numpy() @ T[:3, :3]
    np.testing.assert_allclose(flow.full_flow, turned, rtol=0, atol=1e-6)
    assert flow.mask.all() and speeds(turned).max() > 0.5


def test_turning_vehicle_with_history_through_their_evaluator(bsfe: ModuleType, tmp_path: Path) -> None:
    """Four sweeps, 5.7 degrees of yaw in each step; two sweeps of history that a data set of pairs does not hold."""
    sweeps = [replace(sweep, points=np.nan_to_num(sweep.points)) for sweep in drive(4, velocity=0.6)]
    rng = np.random.default_rng(1)
    made = []
    for sweep, following in zip(sweeps, sweeps[1:]):
        n = len(sweep.points)
        true = rng.choice([*EDGES[1:40]], (n, 1)) * np.array([0.6, 0.8, 0.0]) * 1.001
        T = np.linalg.inv(following.pose) @ sweep.pose
        category = rng.choice([0, 17, 19], n).astype(np.uint8)
        made.append(
            MadeUp(sweep.points, true.astype(np.float32), true, category, rng.random(n) < 0.9, true[:, 0] > 9, T)
        )
    write_log(tmp_path / "raw", made)  # its fourth sweep holds the first one's points, at another pose
    write_bsfe_truth(tmp_path / "truth", [(frame.true, frame.category, frame.is_valid) for frame in made])
    log = AV2Log(tmp_path / "raw" / LOG, ground="bsfe")
    pairs = make_data_set(bsfe, tmp_path / "raw", tmp_path / "truth", tmp_path, "bucketed_epe")
    masks = [~pairs[0][0].pc.mask, ~pairs[1][0].pc.mask, ~pairs[2][0].pc.mask, ~pairs[2][1].pc.mask]
    read = [replace(log.sweep(number), is_ground=masks[number]) for number in range(4)]
    settings = {**SETTINGS, "num_history": 2}
    estimate, frames, largest = CorrelationFlowEstimator(**settings), [], 0.0
    items = {length: make_data_set(bsfe, tmp_path / "raw", tmp_path / "truth", tmp_path, "bucketed_epe", length)
             for length in (2, 3, 4)}  # fmt: skip
    for number, frame in enumerate(made):
        T = np.linalg.inv(read[number + 1].pose) @ read[number].pose
        assert abs(math.degrees(math.atan2(T[1, 0], T[0, 0]))) > 5
        history = tuple(read[max(number - 2, 0) : number][::-1])
        own = replace(window(log, number), pc0=read[number], pc1=read[number + 1], pch=history)
        (result,) = estimate.sequence_flow.model([own])
        turned = result.residual_flow.double().numpy() @ T[:3, :3]
        # An item that ends with this pair and reaches back as far as the log: frame number is its last but one.
        (flow,) = [estimate.last(items[number + 2][0])]
        np.testing.assert_allclose(flow.full_flow, turned, rtol=0, atol=1e-6)
        largest = max(largest, float(np.abs(turned - result.residual_flow.numpy()).max()))
        labels = FlowLabels(total_flow(frame.points, frame.true, frame.T), frame.category, frame.is_valid)
        frames.append(
            EvalFrame(
                read[number].points,
                labels,
                residual_flow=result.residual_flow,
                T_ego1_ego0=T,
                is_ground=log.sweep(number).is_ground,
            )
        )
    assert largest > 0.02  # what ignoring the axes would cost
    check_scores(bsfe, estimate, (tmp_path / "raw", tmp_path / "truth", tmp_path), frames)
