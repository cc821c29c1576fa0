"""Arrays of every form and type at every door: the same result, or the one error; and never a byte of them changed."""

from __future__ import annotations

import sys
import warnings
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from types import ModuleType
from typing import Any, Callable, Dict, Iterator, List, Sequence

import numpy as np
import pytest
import torch
from preset_windows import PRESETS, changed, num_moving, on_a_raster, small, windows_for
from scenes import RANGE, assert_same
from test_bucketed_scene_flow_eval_integration import Flow, make_frames
from turning_drive import drive

from cflow_torch import CFlowError, Config, FlowResult, Sweep, Window, estimate_flow, make_model
from cflow_torch.data.log import FlowLabels
from cflow_torch.evaluation import DEFINITIONS, EvalFrame, SceneFlowMetrics
from cflow_torch.integrations.bucketed_scene_flow_eval import CorrelationFlowEstimator
from cflow_torch.integrations.opensceneflow import CFlow
from cflow_torch.integrations.sequence import Frame, SequenceFlow
from cflow_torch.windows.ground import find_ground, has_ground

# ------------------------------------------------------------------------------------------------- form of points


def mapped(array: np.ndarray, folder: Path) -> np.memmap:
    """A file that is mapped into memory and cannot be written to."""
    file = folder / f"{id(array)}.npy"
    np.save(file, array)
    return np.load(file, mmap_mode="r")


def locked(array: np.ndarray) -> np.ndarray:
    array = array.copy()
    array.flags.writeable = False
    return array


def broadcast(array: np.ndarray) -> np.ndarray:
    """Rows of stride 0 in front of the columns: (N, 3) without a copy."""
    return np.broadcast_to(array, (2, *array.shape))[1]


FORMS: Dict[str, Callable[[np.ndarray], Any]] = {
    "float16": lambda p: p.astype(np.float16),
    "float64": lambda p: p.astype(np.float64),
    "longdouble": lambda p: p.astype(np.longdouble),
    "big-endian float32": lambda p: p.astype(">f4"),
    "big-endian float64": lambda p: p.astype(">f8"),
    "columns first": np.asfortranarray,
    "transposed": lambda p: np.ascontiguousarray(p.T).T,
    "rows backwards": lambda p: p[::-1].copy()[::-1],
    "columns backwards": lambda p: p[:, ::-1].copy()[:, ::-1],
    "both backwards": lambda p: p[::-1, ::-1].copy()[::-1, ::-1],
    "every third row": lambda p: np.repeat(p, 3, 0)[::3],
    "not aligned": lambda p: np.frombuffer(b"x" + p.tobytes(), np.uint8)[1:].view(p.dtype).reshape(p.shape),
    "read-only": locked,
    "broadcast": broadcast,
    "part of a record": lambda p: np.pad(p, [(0, 0), (0, 2)])[:, :3],
    "tensor": lambda p: torch.from_numpy(p.copy()),
    "tensor of float64": lambda p: torch.from_numpy(p).double(),
    "tensor of float16": lambda p: torch.from_numpy(p).half(),
    "tensor of bfloat16": lambda p: torch.from_numpy(p).bfloat16(),
    "tensor, transposed": lambda p: torch.from_numpy(np.ascontiguousarray(p.T)).t(),
    "tensor, every second row": lambda p: torch.from_numpy(p).repeat_interleave(2, 0)[::2],
    "tensor with gradient": lambda p: torch.from_numpy(p.copy()).requires_grad_(),
    "tensor in inference mode": lambda p: in_inference_mode(p),
}


def in_inference_mode(points: np.ndarray) -> torch.Tensor:
    with torch.inference_mode():
        return torch.from_numpy(points).clone()


def as_bytes(value: Any) -> bytes:
    if isinstance(value, torch.Tensor):
        value = value.detach().double().numpy()
    return np.ascontiguousarray(value).tobytes()


def coarse(sweep: Sweep) -> Sweep:
    """Points at multiples of 1/16 m within 8 m, where bfloat16 holds multiples of 1/32 m."""
    points = np.nan_to_num(np.asarray(sweep.points), nan=0.0, posinf=0.0, neginf=0.0).clip(-7.9, 7.9)
    return Sweep((np.round(points * 16) / 16).astype(np.float32), sweep.is_ground)


def coarse_window(config: Config) -> Window:
    return changed(windows_for(config)[0], coarse)


@lru_cache(maxsize=None)
def expected_of(preset: str) -> FlowResult:
    config = small(preset, num_history=0 if preset == "keypoints" else 1)
    return make_model(config, "cpu")([coarse_window(config)])[0]


@pytest.mark.parametrize("form", [*FORMS, "memory-mapped"])
@pytest.mark.parametrize("preset", PRESETS)
def test_every_form_gives_the_bits_of_float32(preset: str, form: str, tmp_path: Path) -> None:
    config = small(preset, num_history=0 if preset == "keypoints" else 1)
    window = coarse_window(config)
    make = FORMS.get(form, lambda p: mapped(p, tmp_path))
    given = changed(window, lambda sweep: replace(sweep, points=make(sweep.points)))
    before = [as_bytes(sweep.points) for sweep in (given.pc0, given.pc1, *given.pch)]
    model = make_model(config, "cpu")
    expected = expected_of(preset)
    assert num_moving(expected) > 100
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        (result,) = model([given])
    assert_same(result, expected)
    assert [as_bytes(sweep.points) for sweep in (given.pc0, given.pc1, *given.pch)] == before


@pytest.mark.parametrize(
    "points",
    [
        np.ones((4, 3), dtype=np.int32),
        np.ones((4, 3), dtype=np.uint8),
        torch.ones((4, 3), dtype=torch.int16),
        np.ones((4, 3), dtype="datetime64[ns]"),
        np.array([["1", "2", "3"]] * 4),
        np.zeros((4, 3), dtype=[("x", "f4")]),
        np.ma.masked_greater(np.ones((4, 3)), 0.5),
        torch.ones((4, 3)).to_sparse(),
        torch.ones((4, 3), device="meta"),
    ],
    ids=lambda p: f"{type(p).__name__} {p.dtype}",
)
def test_points_that_are_no_floating_point_numbers_are_refused(points: Any) -> None:
    """None of them becomes metres by chance: millimetres come as integers, a mask says what is not there."""
    with pytest.raises(CFlowError, match="give"):
        estimate_flow(points, points)
    with pytest.raises(CFlowError, match="give"):
        find_ground(points)


@pytest.mark.parametrize(
    "mask", [torch.zeros(4, dtype=torch.bool).to_sparse(), np.ma.masked_array(np.zeros(4, bool), [True] * 4)], ids=type
)
def test_ground_masks_that_hold_something_else_are_refused(mask: Any) -> None:
    with pytest.raises(CFlowError, match="ground mask of pc0.*give"):
        estimate_flow(np.ones((4, 3)), np.ones((4, 3)), gm0=mask)


@pytest.mark.parametrize(
    "wrong",
    [np.ones((4, 3), complex), np.full((4, 3), "1"), np.full((4, 3), object())],
    ids=["complex", "text", "objects"],
)
def test_scores_and_pictures_take_numbers_only(wrong: np.ndarray) -> None:
    pytest.importorskip("matplotlib")
    from cflow_torch.viz import plot_flow

    good = np.zeros((4, 3), np.float32)
    labels = FlowLabels(good, np.zeros(4, np.uint8), np.ones(4, bool))
    parts = {"points": good, "labels": labels, "residual_flow": good, "pose_flow": good}
    for name in ("points", "residual_flow", "pose_flow"):
        with pytest.raises(CFlowError, match=name):
            EvalFrame(**{**parts, name: wrong})
    for name, value in (("flow", wrong), ("category", wrong[:, 0])):
        with pytest.raises(CFlowError, match=f"labels.{name}"):
            EvalFrame(**{**parts, "labels": replace(labels, **{name: value})})
    for arguments in ((wrong, good), (good, wrong)):
        with pytest.raises(CFlowError, match="give numbers"):
            plot_flow(*arguments)


def test_pictures_take_bfloat16() -> None:
    from cflow_torch.viz import flow_to_rgb

    flow = np.array([[1.0, 0.0, 0.0], [0.0, -0.5, 0.0]], np.float32)
    assert np.array_equal(flow_to_rgb(torch.from_numpy(flow).bfloat16()), flow_to_rgb(flow))


# ------------------------------------------------------------------------------------------- doors that only look


class Watched:
    """Arrays that cannot be written to, or tensors, and their bytes at the start."""

    def __init__(self, as_tensors: bool) -> None:
        self.as_tensors = as_tensors
        self.kept: List[Any] = []
        self.before: List[bytes] = []

    def __call__(self, array: Any) -> Any:
        own = torch.from_numpy(np.array(array)) if self.as_tensors else locked(np.asarray(array))
        self.kept.append(own)
        self.before.append(as_bytes(own))
        return own

    def sweep(self, sweep: Sweep) -> Sweep:
        return replace(sweep, points=self(sweep.points), is_ground=self(sweep.is_ground), pose=self(sweep.pose))

    def check(self) -> None:
        assert self.kept and [as_bytes(own) for own in self.kept] == self.before


def with_estimate_flow(watched: Watched) -> None:
    for preset in PRESETS:
        config = small(preset)
        window = changed(windows_for(config)[0], watched.sweep)
        to_world = [np.asarray(sweep.pose) for sweep in (window.pc0, window.pc1, *window.pch)]
        now, *older = [watched(np.linalg.inv(to_world[1]) @ own) for own in (to_world[0], *to_world[2:])]
        for ground in (None, "auto"):
            masks = {} if ground else {"gm0": window.pc0.is_ground, "gm1": window.pc1.is_ground}
            estimate_flow(
                window.pc0.points,
                window.pc1.points,
                T_ego1_ego0=now,
                pch=[sweep.points for sweep in window.pch],
                T_ego1_egoh=older,
                ground=ground,
                device="cpu",
                **{
                    **{key: getattr(config, key) for key in ("pixel_sizes", "num_history", "point_cloud_range")},
                    **masks,
                },
                preset=preset,
            )


def with_windows(watched: Watched) -> None:
    for preset in PRESETS:
        config = small(preset)
        make_model(config, "cpu")([changed(window, watched.sweep) for window in windows_for(config, 3)])


def with_ground(watched: Watched) -> None:
    points = watched(windows_for(small("paper"))[0].pc0.points)
    find_ground(points)
    has_ground([points])


def with_scores(watched: Watched) -> None:
    sweeps = drive(2)
    points = watched(np.nan_to_num(np.asarray(sweeps[0].points)))
    number, rng = len(points), np.random.default_rng(0)
    labels = FlowLabels(
        watched(rng.normal(size=(number, 3)).astype(np.float32)),
        watched(rng.integers(0, 30, number).astype(np.uint8)),
        watched(rng.random(number) < 0.9),
    )
    parts = {
        "residual_flow": watched(rng.normal(size=(number, 3)).astype(np.float32)),
        "pose_flow": watched(rng.normal(size=(number, 3)).astype(np.float32)),
        "T_ego1_ego0": watched(np.linalg.inv(sweeps[1].pose) @ sweeps[0].pose),
        "is_ground": watched(sweeps[0].is_ground),
        "eval_mask": watched(rng.random(number) < 0.9),
        "is_dynamic": watched(rng.random(number) < 0.5),
    }
    for definition in DEFINITIONS:
        metrics = SceneFlowMetrics(definition)
        metrics.update(EvalFrame(points=points, labels=labels, **parts))
        metrics.compute()


def with_pictures(watched: Watched) -> None:
    pytest.importorskip("matplotlib")
    from cflow_torch.viz import flow_to_rgb, plot_clusters, plot_correlation, plot_flow, plot_keypoints, plot_scales

    window = changed(windows_for(small("paper"))[0], watched.sweep)
    residual = watched(np.random.default_rng(0).normal(size=(len(window.pc0.points), 3)).astype(np.float32))
    cluster = watched(np.arange(len(residual)) % 7)
    ground = {"is_ground": window.pc0.is_ground, "point_cloud_range": RANGE}
    plot_flow(window.pc0.points, residual, truth=residual, **ground)
    plot_clusters(window.pc0.points, cluster, **ground)
    flow_to_rgb(residual)
    plot_correlation(window, small("paper"))
    plot_scales(window, small("paper", pixel_sizes=(0.5, 0.25)))
    plot_keypoints(replace(window, pch=()), small("keypoints"))


def with_sequences(watched: Watched) -> None:
    frames = [Frame(watched(s.points), ~np.asarray(s.is_ground), watched(np.eye(4)), watched(s.pose)) for s in drive(3)]
    if watched.as_tensors:
        frames = [
            replace(
                frame,
                takes_part=torch.from_numpy(frame.takes_part),
                sensor_to_ego=frame.sensor_to_ego.numpy(),
                ego_to_global=frame.ego_to_global.numpy(),
            )
            for frame in frames
        ]
    for ground in (None, "auto"):
        SequenceFlow("paper", "cpu", ground, num_history=1, point_cloud_range=RANGE)([frames], [0])


def with_bucketed_scene_flow_eval(watched: Watched) -> None:
    if watched.as_tensors:
        return  # it holds arrays
    frames = make_frames([replace(s, points=watched(s.points), is_ground=watched(s.is_ground)) for s in drive(3)])
    for frame in frames:
        frame.pc.mask = watched(frame.pc.mask)
    for flow in CorrelationFlowEstimator("paper", "cpu", num_history=1, point_cloud_range=RANGE)(frames):
        flow.mask[:] = True  # its evaluator overwrites masks


def with_opensceneflow(watched: Watched) -> None:
    if not watched.as_tensors:
        return  # it holds tensors
    sweeps = drive(3)
    batch: Dict[str, Sequence[Any]] = {}
    for name, sweep in zip(("h1", "0", "1"), sweeps):
        batch[f"pc{name}"], batch[f"gm{name}"] = [watched(sweep.points)], [watched(sweep.is_ground)]
        batch[f"pose{name}"] = [watched(sweep.pose.astype(np.float32))]
    CFlow(num_frames=3, device="cpu", point_cloud_range=RANGE)(batch)


DOORS = {
    function.__name__[5:]: function
    for function in (
        with_estimate_flow,
        with_windows,
        with_ground,
        with_scores,
        with_pictures,
        with_sequences,
        with_bucketed_scene_flow_eval,
        with_opensceneflow,
    )
}


@pytest.fixture
def stand_in(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """`bucketed_scene_flow_eval.datastructures` with the one class that is returned."""
    module = ModuleType("bucketed_scene_flow_eval.datastructures")
    module.EgoLidarFlow = Flow  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "bucketed_scene_flow_eval", ModuleType("bucketed_scene_flow_eval"))
    monkeypatch.setitem(sys.modules, "bucketed_scene_flow_eval.datastructures", module)
    yield


@pytest.mark.parametrize("as_tensors", [False, True], ids=["read-only arrays", "tensors"])
@pytest.mark.parametrize("door", DOORS)
def test_no_door_changes_what_it_is_given(door: str, as_tensors: bool, stand_in: None) -> None:
    """Arrays that are written to raise; tensors cannot be locked, their bytes are compared."""
    watched = Watched(as_tensors)
    with warnings.catch_warnings():
        warnings.filterwarnings("error", message=".*not writable.*")
        warnings.filterwarnings("ignore", message=".*ground.*")
        DOORS[door](watched)
    if watched.kept:
        watched.check()


def test_a_door_that_changes_something_would_be_seen() -> None:
    for as_tensors in (False, True):
        watched = Watched(as_tensors)
        own = watched(np.zeros(3))
        with pytest.raises((ValueError, AssertionError)):
            own[1] = 1.0
            watched.check()


def test_results_do_not_change_with_the_input() -> None:
    """Nothing of a result lies in the memory of what was given."""
    for preset in PRESETS:
        config = small(preset)
        window = changed(windows_for(config)[0], on_a_raster)
        given = changed(window, lambda sweep: replace(sweep, points=torch.from_numpy(np.asarray(sweep.points).copy())))
        (result,) = make_model(config, "cpu")([given])
        kept = {name: value.clone() for name, value in vars(result).items() if value is not None}
        for sweep in (given.pc0, given.pc1, *given.pch):
            sweep.points.fill_(7.0)
        assert all(torch.equal(getattr(result, name).nan_to_num(), value.nan_to_num()) for name, value in kept.items())
