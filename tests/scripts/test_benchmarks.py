"""Scripts of benchmarks: the OpenCV loop, the replacements of compiled extensions, and the comparison with peers."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from preset_windows import small
from scenes import RANGE, assert_same
from scipy.spatial.transform import Rotation
from small_logs import make_small_drive

from cflow_torch import CorrelationFlow, Sweep, VerifiedFlow, Window, make_config
from cflow_torch.config import PRESETS
from cflow_torch.data.av2 import AV2Log
from cflow_torch.data.log import window

S = 0.25  # pixel of the small scenes
# (row, col, height, width) and the shift per sweep (rows, cols); objects do not touch within three sweeps.
OBJECTS = [((5, 5, 9, 6), (0, 1)), ((5, 30, 5, 9), (1, -1)), ((32, 8, 7, 7), (-1, 0)), ((35, 40, 12, 8), (0, 0))]


@pytest.fixture()
def loop(script: Any) -> Any:
    pytest.importorskip("cv2")
    return script("benchmarks", "opencv_loop")


def ell(row: int, col: int, height: int, width: int) -> np.ndarray:
    """Points in the middle of the pixels of an L: its correlation has one peak."""
    pixels = [(r, 0) for r in range(height)] + [(height - 1, c) for c in range(1, width)]
    x = [RANGE[0] + (col + c + 0.5) * S for _, c in pixels]
    y = [RANGE[1] + (row + r + 0.5) * S for r, _ in pixels]
    return np.stack([x, y, np.linspace(0, 1, len(x))], 1)


def moving_ells(num_history: int) -> Window:
    def sweep(step: int) -> Sweep:
        """All objects `step` sweeps after t + 1."""
        return Sweep(np.concatenate([ell(r + step * v, c + step * u, h, w) for (r, c, h, w), (v, u) in OBJECTS]))

    return Window(sweep(-1), sweep(0), tuple(sweep(-2 - i) for i in range(num_history)))


@pytest.mark.parametrize(
    "overrides", [{}, {"connectivity": 4}, {"num_history": 2}, {"num_history": 1, "pixel_sizes": (0.5, 0.25)}], ids=str
)
def test_the_loop_finds_shifts_by_whole_pixels(loop: Any, overrides: dict) -> None:
    settings = small("paper", **{"num_history": 0, **overrides})
    sweeps = moving_ells(settings.num_history)
    result = loop.opencv_flow(sweeps, settings)
    assert_same(result, CorrelationFlow(settings, "cpu")([sweeps])[0])
    if len(settings.pixel_sizes) == 1:
        truth = [np.tile([u * S, v * S, 0.0], (h + w - 1, 1)) for (_, _, h, w), (v, u) in OBJECTS]
        np.testing.assert_allclose(result.residual_flow, np.concatenate(truth), rtol=0, atol=1e-6)


def test_the_loop_agrees_on_the_real_pair(loop: Any, av2_folder: Any) -> None:
    settings, sweeps = make_config("paper"), window(AV2Log(av2_folder), 0)
    result, (expected,) = loop.opencv_flow(sweeps, settings), CorrelationFlow(settings, "cpu")([sweeps])
    assert torch.equal(result.cluster_id, expected.cluster_id)
    same = (result.residual_flow - expected.residual_flow).abs().amax(1) <= 1e-5
    assert same[expected.is_valid].double().mean() >= 0.95


@pytest.fixture()
def cpu(script: Any) -> Any:
    return script("benchmarks", "opensceneflow_cpu")


def assert_close(found: Any, expected: Any) -> None:
    """As `torch.testing.assert_close` for float32, whose import takes seconds."""
    np.testing.assert_allclose(found, expected, rtol=1.3e-6, atol=1e-5)


def test_chamfer_and_its_gradient(cpu: Any) -> None:
    """Against autograd of the dense distances, with different weights of the points."""
    generator = torch.Generator().manual_seed(0)
    clouds = [torch.randn(count, 3, generator=generator).requires_grad_() for count in (70, 50)]
    weights = [torch.rand(count, generator=generator) for count in (70, 50)]
    dense = (clouds[0][:, None] - clouds[1][None]).square().sum(2)
    nearest = [dense.min(dim=1), dense.min(dim=0)]
    loss = sum((each.values * weight).sum() for each, weight in zip(nearest, weights))
    loss.backward()
    distance, index = [torch.zeros(70), torch.zeros(50)], [torch.zeros(n, dtype=torch.int32) for n in (70, 50)]
    plain = [cloud.detach() for cloud in clouds]
    cpu.chamfer(*plain, *distance, *index)
    gradients = [torch.zeros_like(cloud) for cloud in plain]
    cpu.chamfer_gradient(*plain, *index, *weights, *gradients)
    for k in range(2):
        assert torch.equal(index[k].long(), nearest[k].indices)
        assert_close(distance[k], nearest[k].values.detach())
        assert_close(gradients[k], clouds[k].grad)


def test_histogram_counts_the_differences_of_all_pairs(cpu: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """Vote by vote; rows that are padding do not count, the lower bound does and the upper one does not."""
    monkeypatch.setattr(cpu, "_PAIRS_AT_ONCE", 100)
    rng, low, high, sizes = np.random.default_rng(0), (-1.0, -0.5, -0.25), (1.0, 0.5, 0.25), (8, 5, 3)
    clouds = [np.round(rng.uniform(-1, 1, (2, count, 4)) * 8).astype(np.float32) / 8 for count in (40, 30)]
    expected = np.zeros((2, *sizes), np.float32)
    for b, first, second in ((k, p, q) for k in range(2) for p in clouds[0][k] for q in clouds[1][k]):
        difference = first[:3] - second[:3]
        inside = all(low[k] <= difference[k] < high[k] for k in range(3))
        if first[3] > 0 and second[3] > 0 and inside:
            cell = [int((difference[k] - low[k]) / (high[k] - low[k]) * sizes[k]) for k in range(3)]
            expected[(b, *cell)] += 1
    found = cpu.histogram(*map(torch.from_numpy, clouds), *low, *high, *sizes, 8)
    assert expected.sum() > 20 and np.array_equal(found.numpy(), expected)


def test_nearest_neighbours_of_padded_clouds(cpu: Any) -> None:
    rng = np.random.default_rng(0)
    clouds = [torch.from_numpy(rng.normal(size=(3, count, 3)).astype(np.float32)) for count in (20, 25)]
    clouds[0][1, 12:], clouds[1][1, 7:], clouds[1][2] = 1e8, 1e8, 1e8  # the last cloud has no point
    found = cpu.knn_points(*clouds, K=1, return_nn=True)
    for b, rows, columns in ((0, 20, 25), (1, 12, 7)):
        dense = (clouds[0][b, :rows, None] - clouds[1][b, None, :columns]).square().sum(2)
        assert torch.equal(found.idx[b, :rows, 0], dense.argmin(1))
        assert_close(found.dists[b, :rows, 0], dense.min(1).values)
        assert torch.equal(found.knn[b, :rows, 0], clouds[1][b, dense.argmin(1)])
    assert not found.dists[1, 12:].any()


def test_angles_of_a_rotation(cpu: Any) -> None:
    angles = np.array([0.7, -0.4, 0.2])
    matrix = Rotation.from_euler("ZYX", angles).as_matrix()
    found = cpu.euler_angles(torch.from_numpy(matrix)[None], "ZYX")
    np.testing.assert_allclose(found[0].numpy(), angles, atol=1e-12)


def test_weighted_mean(cpu: Any) -> None:
    x, weight = torch.arange(12.0).reshape(2, 2, 3), torch.tensor([[1, 3], [0, 0]])
    assert cpu.weighted_mean(x, weight).tolist() == [[[2.25, 3.25, 4.25]], [[0, 0, 0]]]


def test_distance_to_the_nearest_occupied_cell(cpu: Any) -> None:
    mask = torch.ones(1, 1, 7, 5, 4)
    occupied, spacing = torch.tensor([[0, 1, 2], [6, 4, 0], [3, 3, 3]]), torch.tensor([0.5, 0.25, 1.0])
    mask[(0, 0, *occupied.T)] = 0
    cells = torch.cartesian_prod(*(torch.arange(size) for size in mask.shape[2:]))
    dense = ((cells[:, None] - occupied[None]) * spacing).square().sum(2).min(1).values.sqrt()
    found = cpu.distance_transform(torch.zeros_like(mask), mask, spacing.tolist(), 1e10, 0.0, 1)
    assert_close(found.reshape(-1), dense)


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    from cflow_torch.data.hdf5 import write_hdf5_scene

    file = tmp_path_factory.mktemp("peers") / "drive.h5"
    write_hdf5_scene(make_small_drive(5, seed=1), file)
    return file


def test_rows_of_a_scene(script: Any, scene: Path, tmp_path: Path, monkeypatch: Any, capsys: Any) -> None:
    """Known values of zero flow; a table; rows of an earlier run are kept, and replaced by the same run again."""
    peers, file = script("benchmarks", "peers"), tmp_path / "rows.json"
    monkeypatch.setattr(peers, "START", 2)
    call = ["peers.py", str(scene), "--history", "0", "2", "--json", str(file)]
    monkeypatch.setattr(sys, "argv", [*call, "--methods", "zero", "nsfp"])
    peers.main()
    monkeypatch.setattr(sys, "argv", [*call, "--methods", "default", "zero"])
    peers.main()
    printed = capsys.readouterr()
    assert "skipped nsfp: give --opensceneflow PATH" in printed.err
    rows = {(row["method"], row["history"]): row for row in json.loads(file.read_text())}
    assert len(json.loads(file.read_text())) == len(rows) == 3
    (zero, ours, older) = (rows[key] for key in (("zero", 0), ("default", 0), ("default", 2)))
    assert zero["ratio"] == pytest.approx(1) and zero["static"] < 1e-5 and zero["dynamic"] > 0.1
    assert ours["dynamic"] < 0.5 * zero["dynamic"] and older["dynamic"] < 0.5 * zero["dynamic"]
    lines = printed.out.splitlines()[-3:-1]
    assert [line.split(" | ")[0] for line in lines] == ["| default", "| zero"]
    assert f"{zero['dynamic']:.3f} / 1.00 / 0.0" in lines[1]


def test_clouds_of_the_peers(script: Any, scene: Path, monkeypatch: Any) -> None:
    """They lie in the frame of t+1: with the true flow a static world coincides, and no point is ground or far."""
    peers = script("benchmarks", "peers")
    monkeypatch.setattr(peers, "START", 2)
    monkeypatch.setattr(peers, "NEAR", 20.0)
    ((*_, case),) = peers.cases(scene, 0)
    truth, pc0 = case.item.frame, case.item.window.pc0
    assert np.abs(case.pc0[:, :2]).max() <= 20 and np.abs(case.pc1[:, :2]).max() <= 20
    assert len(case.rows) > 1000 and not pc0.is_ground[case.rows].any()
    expected = truth.points[case.rows] + truth.pose_flow[case.rows]
    np.testing.assert_allclose(case.pc0, expected, atol=1e-5)
    assert np.abs(truth.pose_flow[case.rows]).max() > 0.1, "the vehicle drives"


def test_true_and_false_labels_are_counted(script: Any, scene: Path) -> None:
    from cflow_torch.data.hdf5 import HDF5Log

    labels, log = script("benchmarks", "labels"), HDF5Log(scene)
    none = [np.zeros(len(log.sweep(index).points), bool) for index in range(len(log))]
    found, false, missed, _, missed_walkers = labels.counts(log, none)
    assert (found, false) == (0, 0) and missed > missed_walkers
    found, false, *_ = labels.counts(log, [~each for each in none])
    assert found == missed and false > missed


NEAR = (-20.0, -20.0, -float("inf"), 20.0, 20.0, float("inf"))


def test_every_step_can_be_left_out(script: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """What the ablation replaces is a step of the method, and it replaces something but in the first row."""
    script("figures", "drives")
    steps = script("ablation", "steps")
    monkeypatch.setattr(steps, "score_preset", lambda scored, preset, changes, replaced: (changes, replaced))
    for name in (*steps.STEPS, *steps.SETTINGS):
        changes, replaced = steps.score_without(None, name)
        assert changes == steps.SETTINGS.get(name, {})
        assert bool(changes or replaced) == (name != "all steps")
        model = VerifiedFlow.from_preset("default", num_history=0, point_cloud_range=NEAR, **changes)
        for step, replacement in replaced.items():
            assert callable(getattr(model, step))
            setattr(model, step, replacement)
        car = 0.1 * torch.cartesian_prod(torch.arange(45.0), torch.arange(18.0), torch.arange(15.0)) + 5.05
        assert model([Window(Sweep(car), Sweep(car + torch.tensor([0.5, 0.0, 0.0])))])[0].residual_flow.any()


def test_every_preset_has_the_history_and_the_region_of_a_set(script: Any) -> None:
    run = script("ablation", "run")
    for preset in PRESETS:
        config = make_config(preset, **run.settings_of_set(preset, 2, 35.0))
        assert config.num_history in (0, 2) and config.point_cloud_range[3] == 35.0


def test_a_step_of_a_model_can_be_replaced() -> None:
    car = 0.1 * torch.cartesian_prod(torch.arange(45.0), torch.arange(18.0), torch.arange(15.0)) + 5.05
    window = Window(Sweep(car), Sweep(car + torch.tensor([0.5, 0.0, 0.0])))
    model = VerifiedFlow.from_preset("default", num_history=0)
    assert model([window])[0].residual_flow.any()
    model.movable_nodes = _nothing_may_move
    assert not model([window])[0].residual_flow.any()


def _nothing_may_move(sweeps: Any, components: Any, longest: Any) -> Any:
    return components.nodes(torch.zeros(components.count, dtype=torch.bool))


def test_beams_are_counted_by_turns_and_by_elevation(script: Any) -> None:
    beams = script("benchmarks", "beams")
    azimuth = np.concatenate([np.linspace(-3.1, 3.1, count) for count in (13, 16, 62)])  # once around for each beam
    points = np.stack([10 * np.cos(azimuth), 10 * np.sin(azimuth), 0 * azimuth], 1)
    assert beams.beams_of("kitti-0000", points).tolist() == [0] * 13 + [1] * 16 + [2] * 62
    elevation = np.radians(beams.PANDAR64 + 0.05)
    points = np.stack([20 * np.cos(elevation), 0 * elevation, 20 * np.sin(elevation) + beams.SENSOR_HEIGHT], 1)
    assert beams.beams_of("panda-002", points).tolist() == list(range(64))
