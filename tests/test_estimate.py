"""`estimate_flow`: its arguments, its warnings, its equality with the module. The module: its class, its results."""

from __future__ import annotations

import doctest
import re
import subprocess
import sys
import warnings
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from preset_windows import changed
from scenes import assert_same, assert_same_bits, assert_zeros, config, scene

from cflow_torch import CorrelationFlow, CorrelationFlowKeypoints, VerifiedFlow, estimate_flow, make_config, make_model
from cflow_torch.diagnosis.inspection import Inspection
from cflow_torch.errors import CFlowError, CFlowWarning
from cflow_torch.ground.segmentation import find_ground_batch
from cflow_torch.simulator import make_drive
from cflow_torch.stages import TimedModel, time_report
from cflow_torch.types import Sweep, Window

RNG = np.random.default_rng(0)
P0, P1 = RNG.uniform(-5, 5, (50, 3)).astype(np.float32), RNG.uniform(-5, 5, (40, 3)).astype(np.float32)
EYE, SWEEPS = np.eye(4), {"pc0": Sweep(P0), "pc1": Sweep(P1)}


@pytest.mark.parametrize(
    "arguments, complaint",
    [
        ({**SWEEPS, "future": [Sweep(P1), Sweep(P0)], "preset": "paper"}, "2 future sweeps.*num_future=0"),
        ({"config": make_config("paper")}, "there is no config=: preset= says the method, too"),
        ({"method": "dense"}, "there is no method=.*'paper', 'keypoints'"),
        ({"history": [Sweep(P1)]}, "give pc0 and pc1 as cflow_torch.Sweep"),
        ({**SWEEPS, "history": [P1]}, "history: give a list of cflow_torch.Sweep"),
        ({**SWEEPS, "future": Sweep(P1), "preset": "offline"}, "future: give a list of cflow_torch.Sweep"),
        ({"T_ego1_ego0": EYE[None]}, r"T_ego1_ego0 has shape \(1, 4, 4\)"),
        ({"T_ego1_ego0": (np.eye(3), np.zeros(3))}, r"T_ego1_ego0 is tuple: give one \(4, 4\)"),
        ({"T_ego1_ego0": np.diag([1, 1, -1, 1.0])}, "T_ego1_ego0 is not rigid"),
        ({"pc0": np.repeat(P0, 10, 0).T}, r"pc0 has shape \(3, 500\): .* give its transpose"),
        ({"preset": "defualt"}, r"preset='defualt' \(did you mean default\?\)"),
        ({"point_cloud_range": 50}, r"give a list of numbers: \(x0, y0, z0, x1, y1, z1\)"),
        ({"pc0": Sweep(P0, timestamp_ns=0.1), "pc1": Sweep(P1, timestamp_ns=0.2)}, "give whole nanoseconds"),
        ({"max_hight": 3}, r"unknown setting max_hight \(did you mean min_height\?\): the fields are method,"),
        ({"ground": "yes"}, "ground='yes'.*'auto'"),
        ({"pixel_size": 1e-5}, "point_cloud_range"),
        ({**SWEEPS, "gm0": np.zeros(50, bool), "T_ego1_ego0": EYE}, "T_ego1_ego0, gm0 or gm1 is given with a Sweep"),
        ({"pc0": Sweep(P0)}, "pc1 is ndarray: give cflow_torch.Sweep"),
        ({**SWEEPS, "pc1": Sweep(P1, pose=EYE)}, "pose"),
    ],
)
def test_invalid_arguments_are_refused(arguments, complaint):
    with pytest.raises(CFlowError, match=complaint) as caught:
        estimate_flow(**{"pc0": P0, "pc1": P1, **arguments})
    assert isinstance(caught.value, ValueError)


@pytest.mark.parametrize(
    "name", ["dt0", "dt1"] + [f"{name}{side}" for name in ("pc", "gm", "dt", "T_ego1_ego") for side in "hf"]
)
def test_an_argument_of_earlier_versions_says_the_new_form(name):
    with pytest.raises(CFlowError, match=rf"has no {name}: give estimate_flow\(Sweep\(pc0, .*history="):
        estimate_flow(P0, P1, **{name: None})


@pytest.mark.parametrize("method, num_future", [("dense", 0), ("verified", 2)])
def test_estimate_flow_equals_the_module(method, num_future):
    """With history, sweeps after t+1 and the times of points."""
    rng, settings = np.random.default_rng(0), config(method, num_history=1)
    settings = settings.replace(num_future=num_future) if num_future else settings
    window = scene(6, num_history=1, num_future=num_future)
    window = changed(window, lambda sweep: replace(sweep, point_times=rng.uniform(0, 0.1, len(sweep.points))))
    names = ["0", "1", *(f"h{k}" for k in range(1, 1 + len(window.pch))), *(f"f{k}" for k in range(1, 1 + num_future))]
    columns = {"pc": "points", "gm": "is_ground", "pose": "pose", "dt": "point_times"}
    sample = {"scene_id": "a", "pc3": P0, "pch9": P0}  # others are ignored
    for name, sweep in zip(names, window.sweeps):
        sample.update({f"{prefix}{name}": getattr(sweep, column) for prefix, column in columns.items()})
    (expected,) = make_model(settings)([window])
    assert_same_bits(make_model(settings)([Window.from_dict(sample)])[0], expected)
    of_sweeps = estimate_flow(window.pc0, window.pc1, history=window.pch, future=list(window.pcf), preset=settings)
    assert_same_bits(of_sweeps, expected)
    if not num_future:
        T_ego1_ego0 = np.linalg.inv(window.pc1.pose) @ window.pc0.pose
        masks = {"gm0": window.pc0.is_ground, "gm1": window.pc1.is_ground}
        of_arrays = estimate_flow(window.pc0.points, window.pc1.points, T_ego1_ego0, preset=settings, **masks)
        assert_same(of_arrays, make_model(settings)([replace(window, pch=())])[0])
    if num_future:
        for less in (replace(window, pcf=()), replace(window, pc1=replace(window.pc1, point_times=None))):
            assert not torch.equal(make_model(settings)([less])[0].residual_flow, expected.residual_flow)


def test_everything_ground_and_single_points():
    ground = np.ones(50, dtype=bool)
    with pytest.warns(UserWarning, match="not all of them ground"):
        result = estimate_flow(P0, P0 + np.float32(0.5), gm0=ground, gm1=ground)
    assert_zeros(result, 50)
    assert not result.is_valid.any()
    alone = estimate_flow(P0[:1], P0[:1], preset="paper")
    assert alone.cluster_id.tolist() == [0] and alone.score.tolist() == [1.0] and not alone.flow.any()


@pytest.mark.parametrize(
    ("points", "seen"),
    [
        (1000 * P0.astype(np.float64) + 1e6, "they span x (99|100)"),
        (np.full((4, 3), np.nan), "all are NaN or infinite"),
    ],
    ids=["millimetres", "nothing finite"],
)
def test_a_warning_if_no_point_is_active(points, seen):
    with pytest.warns(CFlowWarning, match=f"none of the .* points of pc0 is active.*{seen}"):
        assert not estimate_flow(points, P1).is_valid.any()
    with pytest.warns(CFlowWarning, match="none of the"):
        make_model(config("dense"))([Window(Sweep(points), Sweep(P1))])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        make_model(config("dense"))([Window(Sweep(points), Sweep(P1))], warns=False)
        estimate_flow(P0, P1)
        estimate_flow(P0[:0], P1)


@pytest.fixture(scope="module")
def street():
    """Two sweeps of a moving vehicle without masks, and the transform between them."""
    now, later = (replace(sweep, is_ground=None) for sweep in make_drive(seed=1, num_sweeps=3, profile="demo")[1:])
    return now, later, np.linalg.inv(later.pose) @ now.pose


def test_ground_is_found_where_there_is_no_mask(street):
    now, later, T = street
    masks = dict(zip(("gm0", "gm1"), find_ground_batch([now.points, later.points])))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        expected = estimate_flow(now.points, later.points, T_ego1_ego0=T, preset="paper", **masks)
        named = estimate_flow(now.points, later.points, T_ego1_ego0=T, preset="paper", ground="grid")
        left_in = estimate_flow(now.points, later.points, T_ego1_ego0=T, preset="paper", ground=None)
    with pytest.warns(CFlowWarning, match="no ground mask for some sweeps, so we found.*ground=None") as caught:
        found = estimate_flow(now.points, later.points, T_ego1_ego0=T, preset="paper")
    assert caught[0].filename == __file__ and len(caught) == 1
    assert_same_bits(found, expected)
    assert_same_bits(named, expected)
    assert left_in.is_valid.sum() > 1.5 * expected.is_valid.sum()


FLIP = np.diag([1.0, -1, -1, 1])


@pytest.mark.parametrize(
    ("change", "found"),
    [
        (lambda a, b, T: (a, b, np.linalg.inv(T)), "inverted"),
        (lambda a, b, T: (b, a, T), "interchanged"),
        (lambda a, b, T: (a, a, T), "the same points"),
        (lambda a, b, T: (a, b * np.float32(np.nan), T), "pc1 has no finite points"),
        (lambda a, b, T: (a @ np.float32(FLIP[:3, :3]), b @ np.float32(FLIP[:3, :3]), FLIP @ T @ FLIP), "z seems"),
    ],
    ids=["inverted", "interchanged", "repeated", "empty", "z down"],
)
def test_likely_mistakes_are_warned_of(street, change, found):
    now, later, T = street
    pc0, pc1, T = change(now.points, later.points, T)
    masks = [np.zeros(len(points), bool) for points in (pc0, pc1)]
    with pytest.warns(CFlowWarning, match=found):
        estimate_flow(pc0, pc1, T_ego1_ego0=T, gm0=masks[0], gm1=masks[1], preset="paper")
    inspect, window = Inspection(), Window(Sweep(pc0, masks[0], T), Sweep(pc1, masks[1], np.eye(4)))
    with pytest.warns(CFlowWarning, match=found):
        inspect([window])
    with warnings.catch_warnings():  # once, but for what is wrong with pc1
        warnings.simplefilter("error" if found not in ("the same points", "pc1 has no finite points") else "ignore")
        inspect([window])


def test_ground_left_in_is_warned_of_once(street):
    now, later, _ = street
    inspect = Inspection()
    with pytest.warns(CFlowWarning, match="without a ground mask contains ground"):
        inspect([Window(now, later)])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        inspect([Window(now, later)])


OF_METHOD = {"dense": "paper", "keypoints": "keypoints", "verified": "default"}


def test_a_class_refuses_the_settings_of_another_method():
    classes = {"dense": CorrelationFlow, "keypoints": CorrelationFlowKeypoints, "verified": VerifiedFlow}
    for method, kind in classes.items():
        assert type(make_model(config(method))) is kind and kind.from_preset().config == make_config(OF_METHOD[method])
        for other in set(classes) - {method}:
            with pytest.raises(CFlowError, match=f"{kind.__name__} is .*'{method}', but the config is for '{other}'"):
                kind(config(other))
    for wrong in (None, {"pixel_sizes": (0.1,)}, "paper"):
        with pytest.raises(CFlowError, match="give the result of make_config"):
            CorrelationFlow(wrong)
    for wrong in (None, {"pixel_sizes": (0.1,)}, "papr"):
        with pytest.raises(CFlowError, match="preset=.*or the result of make_config"):
            make_model(wrong)
    assert make_model("paper", pixel_size=0.2).config == make_config("paper", pixel_size=0.2)
    assert "pixel_sizes=(0.25,)" in repr(make_model(config())) and make_model(config())([]) == []


def test_results_are_ordinary_tensors_that_a_training_loop_may_use():
    (result,) = make_model(config("verified"))([scene(0)])
    weight = torch.ones(3, requires_grad=True)
    for tensor in (result.residual_flow, result.pose_flow, result.flow):
        (tensor * weight).sum().backward()  # saves the tensor for backward: refused for tensors of inference mode
    assert not any(value.is_inference() for value in vars(result).values() if value is not None)


def test_a_stop_watch_stands_in_for_the_method_and_knows_its_stages():
    watch, window = TimedModel(make_model(config("verified"))), scene(0)
    assert time_report([]) == {"pairs": 0}
    results = [watch([window])[0] for _ in range(3)]
    assert_same_bits(results[0], watch.model([window])[0])
    report = time_report(watch.times)
    assert report["pairs"] == 2 and 0 < report["min"] <= report["median"] <= report["max"]
    names = {"compensate", "draw", "align", "change", "tree", "propose", "verify", "select", "refine", "confidence"}
    assert set(report["stages"]) == names | {"spread"} and sum(report["stages"].values()) <= 3 * report["max"]
    first, *others = watch.times
    assert time_report([first, first, *others]) == report, "the first call of each of two processes is a warm-up"
    assert time_report([first])["median"] == first.seconds


@pytest.mark.parametrize("number", [1, 2])
def test_the_number_of_threads_is_as_before(number: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """In the caller's process, also after an error; while a window is computed it is one."""
    seen, before = [], torch.get_num_threads()
    model = CorrelationFlow.from_preset("paper")
    motion = model.motion
    monkeypatch.setattr(model, "motion", lambda batch: (seen.append(torch.get_num_threads()), motion(batch))[1])
    try:
        torch.set_num_threads(number)
        model([scene(0)])
        with pytest.raises(CFlowError):
            model(["no window"])
        estimate_flow(P0, P1, ground="auto")
        assert (seen, torch.get_num_threads()) == ([1], number)
    finally:
        torch.set_num_threads(before)


def test_the_model_is_kept_from_a_loaded_compiler(monkeypatch: pytest.MonkeyPatch) -> None:
    kept = []
    compiler = SimpleNamespace(disable=lambda function: kept.append(function) or function)
    model = CorrelationFlow.from_preset("paper")
    monkeypatch.setitem(sys.modules, "torch._dynamo", compiler)
    assert len(model([scene(0)])) == 1 and kept == [model._estimate]


@pytest.mark.slow
def test_compiling_leaves_the_model_alone():
    """In a process of its own, because TorchDynamo takes seconds to load and stays loaded."""
    script = """
import numpy as np, torch
from cflow_torch import CorrelationFlow, Sweep, Window
points = np.random.default_rng(0).uniform(0, 20, (2, 3000, 3)).astype(np.float32)
model, window = CorrelationFlow.from_preset(), Window(Sweep(points[0]), Sweep(points[1]))
plain, graphs = model([window])[0].flow, []
compiled = torch.compile(model, backend=lambda graph, _: graphs.append(graph) or graph.forward)
assert torch.equal(compiled([window])[0].flow, plain) and compiled.config is model.config
if hasattr(torch.nn.Module, "compile"):  # not in torch 2.0
    model.compile()
assert torch.equal(model([window])[0].flow, plain) and graphs == []
print("equal")
"""
    done = subprocess.run([sys.executable, "-W", "ignore", "-c", script], capture_output=True, text=True, check=False)
    if "torch.compile unsupported" in done.stderr or "not yet supported" in done.stderr:
        pytest.skip(done.stderr.splitlines()[-1])
    assert done.stdout.strip() == "equal", done.stderr


@pytest.mark.slow
def test_models_are_typed_for_users(tmp_path):
    """A user's type checker knows the class of a model and of its results."""
    api = pytest.importorskip("mypy.api")
    file = tmp_path / "user.py"
    file.write_text(
        "from cflow_torch import VerifiedFlow, Window\n"
        "def use(window: Window) -> None:\n"
        "    model = VerifiedFlow.from_preset('live')\n"
        "    reveal_type(model)\n"
        "    reveal_type(model([window]))\n",
        encoding="utf-8",
    )
    package = str(Path(__file__).resolve().parents[1])
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("MYPYPATH", package)
        printed, _, _ = api.run(["--config-file=", "--ignore-missing-imports", "--follow-imports=silent", str(file)])
    assert "verified.method.VerifiedFlow" in printed and re.search(r"list\[cflow_torch.types.FlowResult\]", printed)


@pytest.mark.parametrize("module", ["estimate", "dense.method", "keypoints.method", "simulator.drive"])
def test_examples_of_docstrings_run(module):
    done = doctest.testmod(import_module(f"cflow_torch.{module}"), extraglobs={"torch": torch})
    assert done.attempted > 0 and done.failed == 0
