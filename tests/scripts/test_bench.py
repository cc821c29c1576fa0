"""The benchmark: its competitor computes the same flow, and its report says what it should."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest
import torch
from scenes import RANGE, config, pose, scene

from cflow_torch.bench import measure, timing
from cflow_torch.bench.agreement import same_bits, share_agreement
from cflow_torch.bench.measure import run_bench
from cflow_torch.bench.stages import STAGES
from cflow_torch.bench.table import format_bench
from cflow_torch.config import Config
from cflow_torch.data.av2 import AV2Log
from cflow_torch.data.log import window
from cflow_torch.dense.method import CorrelationFlow
from cflow_torch.types import CFlowError, Sweep, Window

pytest.importorskip("cv2")
from cflow_torch.bench.opencv_loop import find_clusters, opencv_flow  # noqa: E402

S = 0.25  # pixel of the small scenes


def ell(row: int, col: int, height: int, width: int) -> np.ndarray:
    """Points in the middle of the pixels of an L: its correlation has one peak."""
    pixels = [(r, 0) for r in range(height)] + [(height - 1, c) for c in range(1, width)]
    x = [RANGE[0] + (col + c + 0.5) * S for _, c in pixels]
    y = [RANGE[1] + (row + r + 0.5) * S for r, _ in pixels]
    return np.stack([x, y, np.linspace(0, 1, len(x))], 1)


# (row, col, height, width) and the shift per sweep (rows, cols): apart by more than the shifts of three sweeps.
OBJECTS = [((5, 5, 9, 6), (0, 1)), ((5, 30, 5, 9), (1, -1)), ((32, 8, 7, 7), (-1, 0)), ((35, 40, 12, 8), (0, 0))]


def boxes(step: int) -> np.ndarray:
    """All objects `step` sweeps after t + 1."""
    return np.concatenate([ell(r + step * v, c + step * u, h, w) for (r, c, h, w), (v, u) in OBJECTS])


def moving_boxes(num_history: int = 0) -> Window:
    return Window(Sweep(boxes(-1)), Sweep(boxes(0)), tuple(Sweep(boxes(-2 - i)) for i in range(num_history)))


def true_flow() -> np.ndarray:
    return np.concatenate([np.tile([u * S, v * S, 0.0], (h + w - 1, 1)) for (_, _, h, w), (v, u) in OBJECTS])


def assert_same(result, expected) -> None:
    torch.testing.assert_close(result.residual_flow, expected.residual_flow, rtol=0, atol=1e-6)
    torch.testing.assert_close(result.flow, expected.flow, rtol=0, atol=1e-6)
    torch.testing.assert_close(result.pose_flow, expected.pose_flow, rtol=0, atol=1e-6)
    torch.testing.assert_close(result.score, expected.score, rtol=0, atol=1e-6)
    assert torch.equal(result.cluster_id, expected.cluster_id)
    assert torch.equal(result.is_valid, expected.is_valid)


@pytest.mark.parametrize(
    "overrides",
    [
        {},
        {"connectivity": 4},
        {"max_speed": 3.0},
        {"num_history": 2},
        {"num_history": 1, "pixel_sizes": (0.5, 0.25)},
    ],
    ids=str,
)
def test_opencv_loop_finds_boxes_moved_by_whole_pixels(overrides):
    settings = config(**overrides)
    sweeps = moving_boxes(settings.num_history)
    result = opencv_flow(sweeps, settings)
    assert_same(result, CorrelationFlow(settings, "cpu")([sweeps])[0])
    if len(settings.pixel_sizes) == 1:
        np.testing.assert_allclose(result.residual_flow, true_flow(), rtol=0, atol=1e-6)


def test_opencv_loop_honours_max_speed():
    # 1 m/s for 0.1 s and a pixel of 0.25 m: 1.4 pixels. The true shift of two pixels is out of reach.
    slow = Window(Sweep(boxes(-2)), Sweep(boxes(0)))
    result = opencv_flow(slow, config(max_speed=1.0))
    assert (result.residual_flow[:, :2].norm(dim=1) <= 1.4 * S).all()
    assert opencv_flow(slow, config()).residual_flow.abs().max() == 2 * S


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("overrides", [{}, {"num_history": 3}, {"num_history": 2, "max_extent": 2.0}], ids=str)
def test_opencv_loop_takes_the_same_points_into_the_same_clusters(seed, overrides):
    # Poses, ground, points that are not finite or out of range, splits. Noisy objects tie, so no claim on their flow.
    settings = config(**overrides)
    sweeps = scene(seed, num_history=settings.num_history)
    result, (expected,) = opencv_flow(sweeps, settings), CorrelationFlow(settings, "cpu")([sweeps])
    assert expected.cluster_id.max() > 0
    assert torch.equal(result.cluster_id, expected.cluster_id)
    assert torch.equal(result.is_valid, expected.is_valid)
    torch.testing.assert_close(result.pose_flow, expected.pose_flow, rtol=0, atol=1e-6)


def test_opencv_loop_without_clusters():
    far = Sweep(np.array([[100.0, 0, 0], [math.nan, 0, 0]]), pose=pose(1, 0, 0))
    empty = Sweep(np.zeros((0, 3)), pose=pose(0, 0, 0))
    for sweeps in (Window(far, empty), Window(empty, far), Window(empty, empty)):
        assert_same(opencv_flow(sweeps, config()), CorrelationFlow(config(), "cpu")([sweeps])[0])


def test_opencv_loop_pools_like_the_method():
    # The object stops: estimates of different lengths and directions, an even number of them.
    places = [(20, 20), (20, 20), (20, 18), (18, 18), (17, 15)]  # (row, col) at t+1, t, t-1, ...
    first, *rest = (Sweep(ell(row, col, 14, 11)) for row, col in places)
    sweeps = Window(rest[0], first, tuple(rest[1:]))
    settings = config(num_history=3, max_extent=50.0)
    expected = CorrelationFlow(settings, "cpu")([sweeps])[0]
    assert expected.residual_flow.abs().max() > 0
    assert_same(opencv_flow(sweeps, settings), expected)


@pytest.mark.parametrize("overrides", [{"sectional_view": True}, {"method": "keypoints"}, {"clustering": "hdbscan"}])
def test_opencv_loop_says_what_it_does_not_have(overrides):
    with pytest.raises(CFlowError, match="OpenCV loop has"):
        opencv_flow(moving_boxes(), config(**overrides))


def test_opencv_loop_on_the_real_pair(av2_folder):
    sweeps = window(AV2Log(av2_folder), 0)
    result, (expected,) = opencv_flow(sweeps, Config()), CorrelationFlow(Config(), "cpu")([sweeps])
    assert torch.equal(result.cluster_id, expected.cluster_id)
    same = (result.residual_flow - expected.residual_flow).abs().amax(1) <= 1e-5
    assert same[expected.is_valid].double().mean() >= 0.95


def test_clusters_are_numbered_in_raster_order():
    images = [np.zeros((12, 12), np.uint8) for _ in range(2)]
    for image in images:
        image[8, 1:3] = image[2, 9] = image[2, 1] = 1
    images[0][11, 11] = 1  # at t+1 only
    clusters = find_clusters(images, 1.0, Config())
    assert clusters.boxes == [[2, 1, 1, 1], [2, 9, 1, 1], [8, 1, 1, 2]]
    assert clusters.number[[2, 2, 8, 8, 11], [1, 9, 1, 2, 11]].tolist() == [0, 1, 2, 2, -1]


@pytest.fixture(scope="module")
def report():
    threads = torch.get_num_threads()
    configs = {"one": config(), "history": config(num_history=1), "section": config(sectional_view=True)}
    configs["keys"] = config(method="keypoints")
    result = run_bench([moving_boxes(2), moving_boxes(1)], configs, repeats=3, num_threads=1, device="cpu")
    assert torch.get_num_threads() == threads
    return result


def test_report_is_strict_json_with_the_promised_keys(report):
    assert json.loads(json.dumps(report, allow_nan=False)) == report
    assert set(report) == {"machine", "num_windows", "points", "repeats", "results"}
    assert report["num_windows"] == 2
    assert report["machine"]["threads"] == 1
    assert report["machine"]["device"] == "cpu"
    assert report["machine"]["versions"]["torch"].split("+")[0] == torch.__version__.split("+")[0]
    assert list(report["results"]) == ["one", "history", "section", "keys"]
    keys = ["config", "fast", "stages_s", "opencv", "opencv_over_fast", "reference", "agreement", "clustering"]
    for result in report["results"].values():
        assert list(result) == [*keys, "peak_extra_mb", "work"]
        assert 0 < result["fast"]["min_s"] <= result["fast"]["median_s"] <= result["fast"]["max_s"]
        assert set(result["stages_s"]) == set(STAGES[result["config"]["method"]])
        assert all(seconds > 0 for seconds in result["stages_s"].values())


def test_report_compares_flows(report):
    assert report["results"]["keys"]["agreement"]["reference"]["bit_equal"] is True
    assert report["results"]["keys"]["clustering"]["fast"] == "no clustering"
    for name in ("one", "history", "section"):
        clustering = report["results"][name]["clustering"]
        for key in ("opencv_over_fast", "dilate_and_label_over_fast"):
            assert clustering[key] > 0
    for name in ("one", "history"):
        agreement = report["results"][name]["agreement"]
        assert agreement["reference"]["bit_equal"] is True
        assert agreement["opencv"] == {"same_flow": 1.0, "within_one_pixel": 1.0, "points": 2 * len(boxes(0))}
    section = report["results"]["section"]
    assert section["opencv"] == section["opencv_over_fast"] == section["agreement"]["opencv"] == "has no sectional view"


def test_agreement_counts_points():
    (right,) = CorrelationFlow(config(), "cpu")([moving_boxes()])
    flow = right.residual_flow.clone()
    flow[0, 0] += S  # one pixel
    flow[1, 1] -= 2 * S
    wrong = type(right)(**{**right.__dict__, "residual_flow": flow})
    agreement = share_agreement([right], [wrong], config())
    assert agreement["same_flow"] == pytest.approx(1 - 2 / len(flow))
    assert agreement["within_one_pixel"] == pytest.approx(1 - 1 / len(flow))
    same = same_bits([right], [wrong])
    assert (same["bit_equal"], same["residual_flow"], same["score"]) == (False, False, True)


def test_ratio_pairs_neighbouring_runs(monkeypatch):
    # Every second round of runs is ten times slower; OpenCV always takes three times as long.
    clock, calls = [0.0], []
    monkeypatch.setattr(timing.time, "sleep", lambda _: None)
    monkeypatch.setattr(timing.time, "perf_counter", lambda: clock[0])

    def run(name, seconds):
        calls.append(name)
        clock[0] += seconds * (10 if (len(calls) - 1) // 4 % 2 else 1)

    fast, loop = timing.alternate([lambda: run("fast", 1.0), lambda: run("loop", 3.0)], 4)
    assert calls == ["fast", "fast", "loop", "loop"] * 6
    assert [b / a for a, b in zip(fast, loop)] == [3.0] * 4
    assert timing.median_ratio(fast, loop) == 3.0


def test_table_prints(report):
    text = format_bench(report)
    rows = [line for line in text.splitlines() if line.startswith("|")]
    assert [row.split("|")[1].strip() for row in rows] == ["", "---", "one", "history", "section", "keys"] * 3
    assert len({row.count("|") for row in rows[:6]}) == 1
    median = report["results"]["one"]["fast"]["median_s"]
    assert f"| one | {1000 * median:.1f} |" in text
    assert "has no sectional view" in rows[4]
    work = report["results"]["history"]["work"]
    assert f"| history | {work['operations']} | {work['waits']} | {work['uploads']} |" in text


def test_bench_without_opencv_and_reference(monkeypatch):
    monkeypatch.setattr(measure, "has_opencv", lambda: False)
    result = run_bench([moving_boxes()], {"one": config()}, repeats=1, with_reference=False)["results"]["one"]
    assert result["opencv"] == result["opencv_over_fast"] == result["agreement"]["opencv"] == "not installed"
    assert result["clustering"]["opencv"] == result["clustering"]["dilate_and_label"] == "not installed"
    assert result["reference"] == result["agreement"]["reference"] == "not run"


def test_missing_opencv_is_explained(monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "cv2", None)
    with pytest.raises(CFlowError, match="pip install opencv-python-headless"):
        opencv_flow(moving_boxes(), config())


def test_bench_refuses_nothing_to_measure():
    some, named = [moving_boxes()], {"one": config()}
    for windows, configs, repeats in (([], named, 1), (some, {}, 1), (some, named, 0)):
        with pytest.raises(CFlowError, match="at least one"):
            run_bench(windows, configs, repeats=repeats)
