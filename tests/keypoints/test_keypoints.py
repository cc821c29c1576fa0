"""The key-point variant against the reference, to the last bit of every field; and against truths known beforehand."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
import torch
from oracle import reference_flow
from scenes import LABELINGS, assert_same, assert_zeros, box, config, needs_gpu, scene

from cflow_torch import CFlowError, CorrelationFlowKeypoints, Sweep, Window, estimate_flow, make_model
from cflow_torch.config import make_config
from cflow_torch.data.av2 import AV2Log
from cflow_torch.data.hdf5.reader import HDF5Log
from cflow_torch.data.log import window as window_of
from cflow_torch.keypoints import match_candidates as gating
from cflow_torch.keypoints import matching
from cflow_torch.keypoints.descriptors import KeyPoints, describe, detect
from cflow_torch.keypoints.matching import match
from cflow_torch.simulator import make_drive
from cflow_torch.types import FlowResult

DENSIFIERS = ("components", "clusters", "nearest")


def settings_for(**overrides):
    return config(**{"method": "keypoints", "gate_radius": 1.6, **overrides})


def check(window: Window, **overrides) -> FlowResult:
    settings = settings_for(**overrides)
    (result,) = CorrelationFlowKeypoints(settings)([window])
    assert_same(result, reference_flow(window, settings))
    return result


# --------------------------------------------------------------------------------- equal to the reference


@pytest.mark.parametrize("labeling", LABELINGS)
@pytest.mark.parametrize("densify", DENSIFIERS)
@pytest.mark.parametrize("mutual_check", [False, True])
@pytest.mark.parametrize("second_best_distance", [0.0, 1.5, 3.0])
def test_equals_the_reference(second_best_distance, mutual_check, densify, labeling):
    found = 0
    for connectivity, ratio_threshold, patch_size in itertools.product((4, 8), (1.0, 1.1), (3, 11)):
        result = check(
            scene(17 * connectivity + patch_size),
            densify=densify,
            mutual_check=mutual_check,
            second_best_distance=second_best_distance,
            ratio_threshold=ratio_threshold,
            patch_size=patch_size,
            connectivity=connectivity,
            labeling=labeling,
        )
        found += int((result.score > 0).sum())
    assert found > 1000


@pytest.mark.parametrize("seed", range(12))
def test_equals_the_reference_on_many_scenes(seed):
    check(
        scene(200 + seed, poses=seed % 3 > 0, stamps=seed % 4 == 0),
        densify=DENSIFIERS[seed % 3],
        pixel_size=(0.25, 0.11, 0.6)[seed % 3],
        patch_size=(11, 21, 1, 15)[seed % 4],  # longer than 13: the float64 branch
        ratio_threshold=(1.02, 1.3)[seed % 2],
    )


@pytest.mark.parametrize("max_speed", [None, 4.0])
def test_the_gate_follows_the_time_between_the_sweeps(max_speed):
    for seed, gate_radius in itertools.product(range(3), (0.3, 2.5)):
        check(scene(seed, stamps=True), gate_radius=gate_radius, max_speed=max_speed)
        check(scene(seed), gate_radius=gate_radius, max_speed=max_speed, sweep_interval=0.2)


@pytest.mark.parametrize("densify", DENSIFIERS)
def test_coarse_to_fine_equals_the_reference(densify):
    for seed in range(3):
        check(scene(40 + seed), pixel_sizes=(0.5, 0.25), densify=densify)


@pytest.mark.parametrize(
    "overrides",
    [
        {},
        {"densify": "nearest", "patch_size": 15, "gate_radius": 2.0},
        {"densify": "clusters", "mutual_check": True, "second_best_distance": 3.0, "connectivity": 4},
    ],
    ids=["paper", "nearest", "clusters-mutual"],
)
def test_equals_the_reference_on_the_real_pair(av2_folder, overrides):
    check_drive(window_of(AV2Log(av2_folder), 0), overrides)


def test_kitti_equals_the_reference(kitti_file):
    pytest.importorskip("h5py")
    with HDF5Log(kitti_file) as log:
        check_drive(window_of(log, 9, 0), {})


def test_simulated_drive_equals_the_reference():
    check_drive(window_of(make_drive(seed=11, num_sweeps=3), 1, 0), {"pixel_sizes": (0.2, 0.1)})


def check_drive(window: Window, overrides: dict) -> None:
    settings = make_config("paper", method="keypoints", **overrides)
    (result,) = make_model(settings)([window])
    assert (result.residual_flow.norm(dim=1) >= 0.05).sum() > 1000  # there is something to find
    assert_same(result, reference_flow(window, settings))


# ---------------------------------------------------------------------- what must not matter, to the last bit


def test_batch_equals_loop_whatever_the_chunks(monkeypatch):
    windows = [scene(60), scene(61, num_points=5), Window(Sweep(np.zeros((0, 3))), Sweep(np.zeros((4, 3)))), scene(62)]
    windows = [Window(Sweep(w.pc0.points, w.pc0.is_ground), Sweep(w.pc1.points, w.pc1.is_ground)) for w in windows]
    for densify in DENSIFIERS:
        model = CorrelationFlowKeypoints(settings_for(densify=densify))
        alone = [model([window])[0] for window in windows]
        for whole, single in zip(model(windows), alone):
            assert_same(whole, single)
        small = CorrelationFlowKeypoints(settings_for(densify=densify, max_memory=3_000_000))
        for whole, single in zip(small(windows), alone):
            assert_same(whole, single)
        with monkeypatch.context() as patch:
            patch.setattr(gating, "_PAIRS_AT_ONCE_CPU", 1)  # every group on its own
            patch.setattr("cflow_torch.ops.nearest._COMPARED_AT_ONCE", 1)
            assert_same(model([windows[0]])[0], alone[0])


def test_tiles_and_groups_do_not_show(monkeypatch):
    window, model = scene(63), CorrelationFlowKeypoints(settings_for(second_best_distance=2.0, mutual_check=True))
    (expected,) = model([window])
    for rows, cols, band, group in ((1, 1, 1, 1), (3, 2, 5, 2), (64, 9, 2, 40), (5, 200, 64, 7)):
        for name, value in (("_TILE_ROWS", rows), ("_TILE_COLS", cols), ("_BAND", band), ("_GROUP", group)):
            monkeypatch.setattr(gating, name, value)
        assert_same(model([window])[0], expected)


@pytest.mark.parametrize("precision", ["highest", "high", "medium"])
@pytest.mark.parametrize("patch_size", [1, 3, 11, 13, 41, 51])
def test_the_products_count_exactly(patch_size, precision):
    generator = torch.Generator().manual_seed(patch_size)
    descriptors = []
    for number, density in ((7, 0.1), (9, 0.7)):
        patch = torch.rand((number, patch_size**2), generator=generator) < density
        patch[0], patch[1] = True, False
        descriptors.append(patch.byte())
    expected = (descriptors[0][:, None] & descriptors[1]).sum(2)
    strips0, strips1 = matching._pack(descriptors[0], False), matching._pack(descriptors[1], True)
    before = torch.get_float32_matmul_precision()
    try:
        torch.set_float32_matmul_precision(precision)
        found = matching._overlap(strips0, torch.arange(8).view(2, 4), strips1, torch.arange(10).repeat(2))
    finally:
        torch.set_float32_matmul_precision(before)
    found = found.reshape(8, 10) >> 7
    assert torch.equal(found[:7, :9], expected.int()) and not found[7].any() and not found[:, 9].any()  # padding


def test_few_contenders_a_time_give_the_same_bits(monkeypatch):
    window = scene(64)
    for overrides in ({"patch_size": 15}, {"ratio_threshold": 1.0}, {"ratio_threshold": 2.0, "mutual_check": True}):
        model = CorrelationFlowKeypoints(settings_for(**overrides))
        (expected,) = model([window])
        assert_same(expected, reference_flow(window, model.config))
        with monkeypatch.context() as patch:
            patch.setattr(gating, "_PAIRS_AT_ONCE_CPU", 3)
            patch.setattr(matching, "_STRIP_NUMBERS", 5)
            assert_same(model([window])[0], expected)


def test_different_values_are_told_apart_or_both_looked_at():
    # count^2 / energy of the largest descriptors, twice as close as any two can be: float32 takes them for equal.
    share = 1 - matching._ROUNDING
    for count, energy in ((2601, 2601), (2600, 2599), (51, 2601), (1, 2601)):
        value = torch.tensor(float(count * count)) / energy
        below = torch.nextafter(value, torch.tensor(0.0))
        assert below >= value * share and value.double() * (1 - 2**-22) >= (value * share).double()


def test_order_of_points_does_not_matter():
    window, rng = scene(65), np.random.default_rng(0)
    order = rng.permutation(len(window.pc0.points))
    shuffled = Window(Sweep(window.pc0.points[order], window.pc0.is_ground[order], window.pc0.pose), window.pc1)
    for densify in DENSIFIERS:
        model = CorrelationFlowKeypoints(settings_for(densify=densify))
        (a,), (b,) = model([window]), model([shuffled])
        assert_same(b, FlowResult(*(getattr(a, name)[order] for name in a.numpy())))


@pytest.mark.cuda
@needs_gpu
@pytest.mark.parametrize("densify", DENSIFIERS)
def test_gpu_equals_cpu(densify):
    for seed in range(6):
        settings = settings_for(densify=densify, mutual_check=seed % 2 == 0, patch_size=(11, 21)[seed % 2])
        for on_gpu, on_cpu in zip(
            CorrelationFlowKeypoints(settings, "cuda")([scene(seed), scene(seed + 50)]),
            CorrelationFlowKeypoints(settings, "cpu")([scene(seed), scene(seed + 50)]),
        ):
            assert_same(on_gpu, on_cpu)


# ------------------------------------------------------------------------------------- truths known beforehand


def test_key_points_are_at_distance_one(av2_folder):
    distance_transform_edt = pytest.importorskip("scipy.ndimage").distance_transform_edt
    rng = np.random.default_rng(0)
    images = [rng.random((23, 31)) < density for density in (0.02, 0.3, 0.7, 0.95, 1.0, 0.0)]
    from cflow_torch.windows.bev_grid import Grid
    from cflow_torch.windows.collation import make_batch

    settings = make_config("paper")
    grid = Grid(0.1, settings.point_cloud_range[:3], settings.point_cloud_range[3:])
    batch = make_batch([window_of(AV2Log(av2_folder), 0)], settings, grid)
    images += list(grid.project(batch.positions, batch.image, 2, batch.takes_part)[0].numpy())
    for image in images:
        distance = distance_transform_edt(np.pad(image, 1))[1:-1, 1:-1]  # outside the image is background
        np.testing.assert_array_equal(detect(torch.from_numpy(image)).numpy(), distance == 1)


def test_descriptors_are_the_patches():
    images = torch.rand((2, 9, 12), generator=torch.Generator().manual_seed(0)) < 0.5
    place, points = describe(images, detect(images), 5)
    padded = np.pad(images.numpy(), [(0, 0), (2, 2), (2, 2)])
    assert place.numel() > 50
    for k, flat in enumerate(place.tolist()):
        window, row, col = np.unravel_index(flat, images.shape)
        assert (points.window[k], points.row[k], points.col[k]) == (window, row, col)
        patch = padded[window, row : row + 5, col : col + 5]
        assert points.patch[k].tolist() == patch.flatten().tolist()
        assert points.energy[k] == patch.sum()


def hand_made(places, patches) -> KeyPoints:
    places = torch.tensor(places, dtype=torch.int64).reshape(-1, 2)
    patch = torch.tensor(patches, dtype=torch.uint8).reshape(-1, 121)
    return KeyPoints(torch.zeros(len(places), dtype=torch.int64), places[:, 0], places[:, 1], patch, patch.sum(1))


def bits(number: int, size: int = 121) -> list:
    """A descriptor with the first `number` pixels set."""
    return [1] * number + [0] * (size - number)


def shifts(pc0: KeyPoints, pc1: KeyPoints, reach: float = 10.0, **overrides) -> dict:
    found = match(pc0, pc1, torch.tensor([reach], dtype=torch.float64), settings_for(patch_size=11, **overrides))
    return dict(zip(found.source.tolist(), map(tuple, found.shift.tolist())))


def test_the_ratio_test_is_exact():
    # R^2 = c^2 / (E E'): the best coincides fully with the 121 ones, the second in 100: R = 1, R' = 10 / 11.
    pc0 = hand_made([[5, 5]], [bits(121)])
    pc1 = hand_made([[5, 6], [5, 9]], [bits(121), bits(100)])
    assert shifts(pc0, pc1, ratio_threshold=1.0999) == {0: (0, 1)}
    assert shifts(pc0, pc1, ratio_threshold=1.1) == {}  # R = rho R' does not pass; 1.1 * 1.1 is not 1.21 in floats
    assert shifts(pc0, pc1, ratio_threshold=1.10004) == {}  # four decimals count
    assert shifts(pc0, pc1, ratio_threshold=1.09996) == {}  # and are what is looked for
    # Second best 1 / 1.2^2 = 25 / 36 of the energy: 36 against 25 ones.
    pc0, pc1 = hand_made([[5, 5]], [bits(36)]), hand_made([[5, 6], [5, 9]], [bits(36), bits(25)])
    assert shifts(pc0, pc1, ratio_threshold=1.2) == {} and shifts(pc0, pc1, ratio_threshold=1.1999) == {0: (0, 1)}


def test_a_single_candidate_has_no_rival():
    assert shifts(hand_made([[5, 5]], [bits(9)]), hand_made([[4, 3]], [bits(1)]), ratio_threshold=2.0) == {0: (-1, -2)}


def test_ties():
    pc0 = hand_made([[20, 20]], [bits(9)])
    around = [[20, 23], [23, 20], [17, 20], [20, 17], [20, 25]]
    pc1 = hand_made(around, [bits(9)] * 5)
    assert shifts(pc0, pc1, ratio_threshold=1.0) == {}  # equal scores: neither is clearly the best
    apart = {"ratio_threshold": 1.0, "second_best_distance": 9.0}  # no rival that far away
    assert shifts(pc0, pc1, **apart) == {0: (-3, 0)}  # nearest, then smallest dy, then smallest dx
    assert shifts(pc0, hand_made([[20, 23], [23, 20], [20, 17]], [bits(9)] * 3), **apart) == {0: (0, -3)}
    assert shifts(pc0, hand_made([[20, 25], [20, 23]], [bits(9)] * 2), **apart) == {0: (0, 3)}


def test_the_rival_lies_at_least_that_far_from_the_best():
    pc0 = hand_made([[20, 20]], [bits(20)])
    pc1 = hand_made([[20, 20], [23, 24]], [bits(20), bits(19)])  # 5 pixels apart
    assert shifts(pc0, pc1, ratio_threshold=1.1, second_best_distance=5.0) == {}
    assert shifts(pc0, pc1, ratio_threshold=1.1, second_best_distance=5.001) == {0: (0, 0)}


def test_mutual_check():
    # Both key points of t like the one of t+1; it likes the second.
    pc0, pc1 = hand_made([[5, 5], [5, 8]], [bits(9), bits(12)]), hand_made([[5, 9]], [bits(12)])
    assert shifts(pc0, pc1) == {0: (0, 4), 1: (0, 1)}
    assert shifts(pc0, pc1, mutual_check=True) == {1: (0, 1)}
    # Ties are ruled by the same shift t -> t+1 from both sides: (0, -2) before (0, 2).
    pc0, pc1 = hand_made([[5, 5], [5, 9]], [bits(9)] * 2), hand_made([[5, 7]], [bits(9)])
    assert shifts(pc0, pc1, mutual_check=True) == {1: (0, -2)}


def test_the_gate_is_closed():
    for corner in (50, 32_700):  # there and far from the corner of the image
        pc0 = hand_made([[corner, corner]], [bits(9)])
        for (dy, dx), reach, inside in (((3, 4), 5.0, True), ((3, 4), 4.999, False), ((0, 0), 0.5, True)):
            assert bool(shifts(pc0, hand_made([[corner + dy, corner + dx]], [bits(9)]), reach)) == inside
    assert shifts(hand_made([[0, 0]], [bits(9)]), hand_made([[32_700, 32_700]], [bits(9)]), 1e9) == {
        0: (32_700, 32_700)
    }


def test_no_key_points():
    none, one = hand_made([], []), hand_made([[5, 5]], [bits(9)])
    for pc0, pc1 in ((none, one), (one, none), (none, none)):
        assert shifts(pc0, pc1, mutual_check=True) == {}


@pytest.mark.parametrize("densify", DENSIFIERS)
@pytest.mark.parametrize("empty", ["both", "pc0", "pc1"])
def test_empty_sweeps(densify, empty):
    nothing, some = np.zeros((0, 3)), np.random.default_rng(0).uniform(-3, 3, (40, 3)).clip(max=2.9)
    pc0, pc1 = (nothing if empty in ("both", name) else some for name in ("pc0", "pc1"))
    result = check(Window(Sweep(pc0), Sweep(pc1)), densify=densify)
    assert not result.residual_flow.any() and not result.score.any()
    if densify == "nearest":
        assert_zeros(result, len(pc0))


def test_whole_pixel_shifts_are_found():
    rng = np.random.default_rng(3)
    boxes = [box(rng, 3.0, 1.5, 1.5, 4000) + place for place in ([-5.0, -4.0, 0], [1.0, 3.0, 0], [4.0, -3.0, 0])]
    moved = [points + shift for points, shift in zip(boxes, ([0.5, 0.25, 0], [-0.75, 0, 0], [0, 0, 0]))]
    result = estimate_flow(np.concatenate(boxes), np.concatenate(moved), method="keypoints", pixel_size=0.25)
    expected = np.repeat([[0.5, 0.25, 0], [-0.75, 0, 0], [0, 0, 0]], 4000, axis=0)
    np.testing.assert_array_equal(result.residual_flow.numpy(), expected.astype(np.float32))
    assert result.cluster_id.unique().tolist() == [0, 1, 2]


def test_a_component_without_a_match_says_so():
    rng = np.random.default_rng(4)
    seen, lost = box(rng, 2.0, 1.0, 1.0, 2000), box(rng, 2.0, 1.0, 1.0, 2000) + [6.0, 5.0, 0]
    result = check(Window(Sweep(np.concatenate((seen, lost))), Sweep(seen + [0.5, 0, 0])), pixel_size=0.25)
    assert (result.score[:2000] > 0).all() and (result.cluster_id[:2000] == 0).all()
    assert not result.score[2000:].any() and (result.cluster_id[2000:] == 1).all()
    assert not result.residual_flow[2000:].any() and result.is_valid.all()


def test_history_is_refused():
    with pytest.raises(CFlowError, match=r"one pair of sweeps.*num_history=0"):
        make_config("default", method="keypoints", num_history=2)
    with pytest.raises(CFlowError, match=r"2 history sweeps"):
        CorrelationFlowKeypoints(settings_for())([scene(1, num_history=2)])


def test_presets():
    for preset in ("default", "fast", "keypoints"):
        assert make_config(preset, method="keypoints") == make_config("keypoints")
    assert make_config("keypoints").num_history == 0 and len(make_config("keypoints").pixel_sizes) == 1
    assert make_config("paper", method="keypoints") == make_config("paper").replace(method="keypoints")
    assert make_config("default", method="keypoints", pixel_sizes=(0.2, 0.1)).pixel_sizes == (0.2, 0.1)


def test_the_preset_chooses_the_method():
    rng = np.random.default_rng(5)
    pc0 = np.concatenate((box(rng, 2.0, 1.0, 1.0, 500), box(rng, 2.0, 1.0, 1.0, 500) + [8.0, 0, 0]))
    pc1 = pc0[:500] + [0.5, 0, 0]  # the second box is gone: the dense method has no cluster of it
    named, asked = estimate_flow(pc0, pc1, preset="keypoints"), estimate_flow(pc0, pc1, method="keypoints")
    assert_same(named, asked)
    assert (named.cluster_id[500:] == 1).all() and (estimate_flow(pc0, pc1).cluster_id[500:] == -1).all()
