"""The dense method against the reference, to the last bit of every field; and against truths known beforehand."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import pytest
import torch
from oracle import reference_flow
from scenes import LABELINGS, assert_same, assert_zeros, box, config, needs_gpu, pose, scene

from cflow_torch import CorrelationFlow, Window, estimate_flow
from cflow_torch.config import make_config
from cflow_torch.data.av2 import AV2Log
from cflow_torch.data.log import window as window_of

CORRELATIONS = ("fft", "conv")
SCALES = ((0.25,), (0.5, 0.25), (0.8, 0.4, 0.2))


def check(window: Window, **overrides) -> None:
    settings = config(**overrides)
    (result,) = CorrelationFlow(settings)([window])
    assert_same(result, reference_flow(window, settings))


# --------------------------------------------------------------------------------- equal to the reference


@pytest.mark.parametrize("labeling", LABELINGS)
@pytest.mark.parametrize("correlation", CORRELATIONS)
@pytest.mark.parametrize("num_history", [0, 2, 4])
@pytest.mark.parametrize("pixel_sizes", SCALES, ids=len)
@pytest.mark.parametrize("sectional_view", [False, True])
def test_equals_the_reference(sectional_view, pixel_sizes, num_history, correlation, labeling):
    for connectivity, max_speed in itertools.product((4, 8), (None, 6.0)):
        seed = 31 * num_history + 7 * len(pixel_sizes) + 3 * connectivity + (max_speed is None)
        check(
            scene(seed, num_history=num_history),
            num_history=num_history,
            pixel_sizes=pixel_sizes,
            sectional_view=sectional_view,
            correlation=correlation,
            labeling=labeling,
            connectivity=connectivity,
            max_speed=max_speed,
        )


@pytest.mark.parametrize("labeling", LABELINGS)
@pytest.mark.parametrize("connectivity", [4, 8])
@pytest.mark.parametrize("max_extent", [0.3, 1.5, 3.0, 1000.0])
def test_equals_the_reference_whatever_the_largest_extent(max_extent, connectivity, labeling):
    for pixel_size in (0.11, 0.25, 0.6):
        check(
            scene(5, num_history=2),
            num_history=2,
            max_extent=max_extent,
            connectivity=connectivity,
            labeling=labeling,
            pixel_size=pixel_size,
        )


@pytest.mark.parametrize("seed", range(40))
def test_equals_the_reference_on_many_scenes_with_history(seed):
    check(scene(100 + seed, num_history=4, poses=seed % 3 > 0), num_history=4, sectional_view=seed % 2 == 0)


@pytest.mark.parametrize("use_timestamps", [False, True])
@pytest.mark.parametrize("max_speed", [None, 4.0])
def test_equals_the_reference_with_time_stamps(max_speed, use_timestamps):
    for seed in range(4):
        check(
            scene(seed, num_history=3, stamps=True),
            num_history=3,
            max_speed=max_speed,
            use_timestamps=use_timestamps,
            pixel_sizes=SCALES[seed % 3],
        )


def test_equals_the_reference_with_repeated_sweeps():
    window = scene(3, num_history=3)
    assert np.isnan(window.pc0.points).any()  # NaN points do not hide that two sweeps are the same
    copy = replace(window.pc0, points=window.pc0.points.copy(), pose=window.pc0.pose.copy())
    for pch in [
        (window.pc0, *window.pch),
        (window.pch[0], copy, window.pch[1]),
        (window.pch[0], window.pch[1], window.pch[1]),
        (replace(window.pc0, pose=window.pch[0].pose),),  # same points, other pose: not a repetition
        (window.pc1,),  # the target itself is not "a newer sweep with m <= t"
    ]:
        check(replace(window, pch=pch), num_history=4)


def test_a_repeated_sweep_changes_nothing():
    window = scene(8)
    model = CorrelationFlow(config(num_history=3))
    (once,), (repeated,) = model([window]), model([replace(window, pch=(window.pc0,) * 3)])
    assert_same(once, repeated)


def test_a_dropped_sweep_keeps_its_place_in_time():
    window = scene(9, num_history=2)
    check(replace(window, pch=(window.pc0, *window.pch)), num_history=3)


def test_result_does_not_depend_on_the_engine_with_open_z_range_and_wide_points():
    window = scene(4, num_history=1)
    wide = replace(window, pc0=replace(window.pc0, points=np.pad(window.pc0.points, [(0, 0), (0, 3)])))
    low, high = config().point_cloud_range[:2], config().point_cloud_range[3:5]
    check(wide, num_history=1, point_cloud_range=(*low, -np.inf, *high, np.inf))


@pytest.mark.parametrize("labeling", LABELINGS)
@pytest.mark.parametrize("correlation", CORRELATIONS)
def test_equals_the_reference_on_the_real_pair(av2_folder, correlation, labeling):
    """Paper preset, s = 0.1 m, +-35 m."""
    window = window_of(AV2Log(av2_folder), 0)
    settings = make_config("paper", labeling=labeling, correlation=correlation)
    (result,) = CorrelationFlow(settings)([window])
    assert (result.residual_flow.norm(dim=1) >= 0.05).sum() > 1000  # there is something to find
    assert_same(result, reference_flow(window, settings))


@pytest.mark.parametrize(
    "overrides",
    [
        {"pixel_sizes": (0.4, 0.2), "sectional_view": True},
        {"connectivity": 4, "max_extent": 4.0},
        {"max_speed": 15.0, "pixel_size": 0.2},
    ],
    ids=["scales-sectional", "connectivity4-extent4", "max-speed"],
)
def test_other_settings_equal_the_reference_on_the_real_pair(av2_folder, overrides):
    window = window_of(AV2Log(av2_folder), 0)
    settings = make_config("paper", **overrides)
    (result,) = CorrelationFlow(settings)([window])
    assert_same(result, reference_flow(window, settings))


# ------------------------------------------------------------------------------------- truths known beforehand


def street(rng: np.random.Generator) -> list:
    """Three boxes, at places where they do not touch: [points, place]."""
    places = [(-5.0, -4.0, 0.0), (0.5, 2.5, 0.0), (4.0, -3.0, 0.0)]
    return [box(rng, 2.5, 1.5, 1.5, 400) + place for place in places]


@pytest.mark.parametrize("labeling", LABELINGS)
@pytest.mark.parametrize("correlation", CORRELATIONS)
def test_every_object_gets_its_own_motion(correlation, labeling):
    objects = street(np.random.default_rng(0))
    motions = np.array([[0.5, -0.25, 0], [0, 0, 0], [-0.5, 0.75, 0]])
    pc0 = np.concatenate(objects)
    truth = np.repeat(motions, 400, axis=0)
    result = estimate_flow(
        pc0,
        pc0 + truth,
        pixel_size=0.25,
        point_cloud_range=(-8, -8, -1, 8, 8, 3),
        labeling=labeling,
        correlation=correlation,
    )
    assert np.array_equal(result.residual_flow.numpy(), truth)
    assert result.score.tolist() == [1.0] * 1200
    assert sorted(set(result.cluster_id.tolist())) == [0, 1, 2]
    assert result.cluster_id[800] == 1 and result.cluster_id[400] == 2  # raster order: rows of y first


def test_a_still_world_seen_from_a_moving_sensor():
    pc_world = np.concatenate(street(np.random.default_rng(1)))
    T_ego1_ego0 = np.linalg.inv(pose(0.9, 0.1, 0.05)) @ pose(0, 0, 0)
    pc1 = pc_world @ T_ego1_ego0[:3, :3].T + T_ego1_ego0[:3, 3]
    settings = {"pixel_size": 0.3, "point_cloud_range": (-8, -8, -1, 8, 8, 3)}
    result = estimate_flow(pc_world, pc1, T_ego1_ego0=T_ego1_ego0, **settings)
    assert np.abs(result.pose_flow.numpy() - (pc1 - pc_world)).max() < 1e-6
    assert not result.residual_flow.any()
    assert torch.equal(result.flow, result.pose_flow)
    without = estimate_flow(pc_world, pc1, **settings)
    assert not without.pose_flow.any() and without.residual_flow.any()  # else the test would see nothing


def test_sectional_view_finds_vertical_motion():
    """A dotted wall whose dots all sink: only the sectional view sees it."""
    rng = np.random.default_rng(2)
    pc0 = np.column_stack([rng.uniform(0, 3, 500), np.full(500, 1.0), rng.uniform(0, 2, 500)])
    motion = np.array([0.5, 0.0, -0.25])
    settings = {"preset": "paper", "pixel_size": 0.25, "point_cloud_range": (-8, -8, -3, 8, 8, 3)}
    flat = estimate_flow(pc0, pc0 + motion, **settings)
    full = estimate_flow(pc0, pc0 + motion, sectional_view=True, **settings)
    assert np.array_equal(flat.residual_flow.numpy(), np.tile([0.5, 0, 0], (500, 1)))
    assert np.array_equal(full.residual_flow.numpy(), np.tile(motion, (500, 1)))


def test_history_outvotes_one_bad_estimate():
    """One object, 0.5 m per sweep along x; at t it is seen one step too far, so t -> t+1 alone gives the wrong flow."""
    shape = street(np.random.default_rng(3))[1]
    at = [shape + [0.5 * step, 0.0, 0.0] for step in (0, -1, -2, -3, -4)]
    wrong = at[1] + [0.25, 0.0, 0.0]
    settings = {"preset": "paper", "pixel_size": 0.25, "point_cloud_range": (-8, -8, -1, 8, 8, 3), "num_history": 3}
    assert (estimate_flow(wrong, at[0], **settings).residual_flow[:, 0] == 0.25).all()
    with_history = estimate_flow(wrong, at[0], pch=at[2:], **settings)
    assert (with_history.residual_flow == torch.tensor([0.5, 0.0, 0.0])).all()


def test_coarse_to_fine_adds_up():
    """A truth of 0.9 m: half-way between the pixels of the first two scales, reached by the last."""
    pc0 = street(np.random.default_rng(4))[1]
    found = [
        estimate_flow(
            pc0, pc0 + [0.9, 0, 0], preset="paper", pixel_sizes=sizes, point_cloud_range=(-8, -8, -1, 8, 8, 3)
        ).residual_flow
        for sizes in [(0.8,), (0.8, 0.2), (0.8, 0.2, 0.1)]
    ]
    assert torch.allclose(found[0], torch.tensor([0.8, 0, 0]), atol=1e-6)
    assert torch.allclose((found[1][:, 0] - 0.9).abs(), torch.tensor(0.1), atol=1e-6)  # off by half a pixel
    assert torch.allclose(found[2], torch.tensor([0.9, 0, 0]), atol=1e-6)


def test_max_speed_bounds_the_flow():
    pc0 = street(np.random.default_rng(5))[1]
    settings = {"preset": "paper", "pixel_size": 0.25, "point_cloud_range": (-8, -8, -1, 8, 8, 3)}
    assert (estimate_flow(pc0, pc0 + [1.0, 0, 0], **settings).residual_flow[:, 0] == 1.0).all()
    # 5 m/s in 0.1 s are 2 pixels; one more is allowed, the fourth is not.
    slow = estimate_flow(pc0, pc0 + [1.0, 0, 0], max_speed=5.0, **settings).residual_flow
    assert 0 < slow.norm(dim=1).max() <= 0.75
    assert (estimate_flow(pc0, pc0 + [0.75, 0, 0], max_speed=5.0, **settings).residual_flow[:, 0] == 0.75).all()


def test_ground_never_moves_and_joins_nothing():
    objects = street(np.random.default_rng(6))
    floor = np.stack(np.meshgrid(np.arange(-7, 7, 0.2), np.arange(-7, 7, 0.2), [0.0]), -1).reshape(-1, 3)
    pc0 = np.concatenate([objects[1], floor])
    pc1 = np.concatenate([objects[1] + [0.5, 0, 0], floor])
    ground = np.repeat([False, True], [400, len(floor)])
    settings = {"pixel_size": 0.25, "point_cloud_range": (-8, -8, -1, 8, 8, 3)}
    result = estimate_flow(pc0, pc1, gm0=ground, gm1=ground, **settings)
    assert (result.residual_flow[:400, 0] == 0.5).all()
    assert not result.residual_flow[400:].any() and not result.is_valid[400:].any()
    assert (result.cluster_id[400:] == -1).all() and not result.score[400:].any()
    with pytest.warns(UserWarning, match="ground"):
        joined = estimate_flow(pc0, pc1, **settings)
    assert joined.is_valid.all() and (joined.residual_flow[:400, 0] != 0.5).all()  # the mask did it


# ------------------------------------------------------------------------------------------------------- module


def test_a_batch_of_nothing_to_find():
    window = scene(0)
    empty = Window(replace(window.pc0, points=window.pc0.points[:0], is_ground=None), window.pc1)
    results = CorrelationFlow(config())([empty, Window(window.pc0, empty.pc0)])
    assert_zeros(results[0], 0)
    assert_zeros(results[1], len(window.pc0.points))


def test_estimate_flow_is_the_module():
    window = scene(6, num_history=2)
    (result,) = CorrelationFlow(config(num_history=2))([window])
    to_ego1 = [np.linalg.inv(window.pc1.pose) @ sweep.pose for sweep in (window.pc0, *window.pch)]
    called = estimate_flow(
        window.pc0.points,
        window.pc1.points,
        T_ego1_ego0=to_ego1[0],
        gm0=window.pc0.is_ground,
        gm1=window.pc1.is_ground,
        pch=[sweep.points for sweep in window.pch],
        T_ego1_egoh=to_ego1[1:],
        gmh=[sweep.is_ground for sweep in window.pch],
        **{k: v for k, v in config(num_history=2).as_dict().items() if k != "method"},
    )
    assert_same(called, result)


def test_results_do_not_share_memory_with_the_input():
    window = scene(2)
    points = torch.from_numpy(window.pc0.points.astype(np.float64))
    before = points.clone()
    result = estimate_flow(points, points)
    for value in vars(result).values():
        value.zero_()
    assert torch.equal(points.nan_to_num(), before.nan_to_num())


@pytest.mark.cuda
@needs_gpu
@pytest.mark.parametrize("labeling", LABELINGS)
@pytest.mark.parametrize("correlation", CORRELATIONS)
@pytest.mark.parametrize("num_history, pixel_sizes", [(0, (0.25,)), (4, (0.25,)), (2, (0.5, 0.25))])
def test_cuda_equals_cpu(num_history, pixel_sizes, correlation, labeling):
    windows = [scene(seed, num_history=num_history) for seed in range(12)]
    settings = config(
        num_history=num_history,
        pixel_sizes=pixel_sizes,
        correlation=correlation,
        labeling=labeling,
        sectional_view=True,
    )
    on_cpu = CorrelationFlow(settings, device="cpu")(windows)
    for gpu, cpu in zip(CorrelationFlow(settings, device="cuda")(windows), on_cpu):
        assert gpu.flow.is_cuda
        assert_same(gpu.to("cpu"), cpu)


def test_results_are_ordinary_tensors_that_a_training_loop_may_use():
    (result,) = CorrelationFlow(config(num_history=0))([scene(0)])
    weight = torch.ones(3, requires_grad=True)
    for tensor in (result.residual_flow, result.pose_flow, result.flow):
        (tensor * weight).sum().backward()  # saves the tensor for backward: refused for tensors of inference mode
    assert not result.is_valid.is_inference() and not result.cluster_id.is_inference()
