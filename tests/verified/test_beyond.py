"""Options beyond the paper (docs/beyond.md): known answers, and the fast path against the reference to the last bit."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace
from typing import Any, Dict, List

import numpy as np
import oracle as ref
import pytest
import torch
from oracle import reference_flow
from scenes import LABELINGS, assert_same, config, needs_gpu, scene

from cflow_torch import CFlowError, CorrelationFlow, Sweep, Window, make_config
from cflow_torch.bench.opencv_loop import opencv_flow
from cflow_torch.checks import DENSE_ONLY
from cflow_torch.data.av2 import AV2Log
from cflow_torch.data.log import window as window_of
from cflow_torch.dense.correlation import best_shifts
from cflow_torch.dense.displacement import beats_zero, parabola
from cflow_torch.dense.lookup import Lookup
from cflow_torch.dense.packing import Images

CORRELATIONS = ("fft", "conv")
# Every option on its own, and all of them, as the small scenes can use them.
EACH: List[Dict[str, Any]] = [{"max_object": 2.0}, {"zero_test": 1.5}, {"subpixel": "parabola"}, {"height_slices": 4}]
ALL: Dict[str, Any] = {key: value for options in EACH for key, value in options.items()}
OPTIONS = [*EACH, ALL]


def ids(options: Dict[str, Any]) -> str:
    return "-".join(options)


# ----------------------------------------------------------------------------------- equal to the reference


@pytest.mark.parametrize("labeling", LABELINGS)
@pytest.mark.parametrize("correlation", CORRELATIONS)
@pytest.mark.parametrize("options", OPTIONS, ids=ids)
def test_equals_the_reference(options, correlation, labeling):
    for num_history, pixel_sizes, max_speed in itertools.product((0, 3), ((0.25,), (0.5, 0.25)), (None, 6.0)):
        settings = config(
            num_history=num_history,
            pixel_sizes=pixel_sizes,
            max_speed=max_speed,
            correlation=correlation,
            labeling=labeling,
            **options,
        )
        window = scene(11 * num_history + len(pixel_sizes) + (max_speed is None), num_history=num_history)
        (result,) = CorrelationFlow(settings)([window])
        assert_same(result, reference_flow(window, settings))


@pytest.mark.parametrize("options", OPTIONS, ids=ids)
def test_equals_the_reference_on_many_scenes(options):
    for seed in range(20):
        settings = config(num_history=seed % 3, sectional_view=seed % 2 == 0, **options)
        window = scene(200 + seed, num_history=seed % 3, poses=seed % 5 > 0)
        (result,) = CorrelationFlow(settings)([window])
        assert_same(result, reference_flow(window, settings))


@pytest.mark.parametrize("options", OPTIONS, ids=ids)
def test_batch_threads_and_order_of_points_do_not_matter(options):
    settings = config(num_history=2, **options)
    windows = [scene(seed, num_history=seed % 3, num_objects=3 + 4 * seed) for seed in range(5)]
    model = CorrelationFlow(settings)
    alone = [model([window])[0] for window in windows]
    for together, one in zip(model(windows), alone):
        assert_same(together, one)
    for together, one in zip(CorrelationFlow(settings.replace(max_memory=2_000_000))(windows), alone):
        assert_same(together, one)
    threads = torch.get_num_threads()
    try:
        torch.set_num_threads(3 - min(threads, 2))
        assert_same(model(windows)[3], alone[3])
    finally:
        torch.set_num_threads(threads)
    rng = np.random.default_rng(0)
    shuffled = [
        replace(sweep, points=sweep.points[order], is_ground=sweep.is_ground[order])
        for sweep in (windows[2].pc1, *windows[2].pch)
        for order in [rng.permutation(len(sweep.points))]
    ]
    assert_same(model([Window(windows[2].pc0, shuffled[0], tuple(shuffled[1:]))])[0], alone[2])


@pytest.mark.parametrize("options", OPTIONS, ids=ids)
def test_equals_the_reference_on_the_real_pair(av2_folder, options):
    window = window_of(AV2Log(av2_folder), 0)
    options = {key: 6.0 if key == "max_object" else value for key, value in options.items()}
    settings = make_config("paper", **options)
    (result,) = CorrelationFlow(settings)([window])
    assert (result.residual_flow.norm(dim=1) >= 0.05).sum() > 1000  # there is something to find
    assert_same(result, reference_flow(window, settings))
    (paper,) = CorrelationFlow(make_config("paper"))([window])
    assert not torch.equal(paper.residual_flow, result.residual_flow)  # and the options change it


@pytest.mark.parametrize("options", OPTIONS, ids=ids)
def test_nothing_to_find(options):
    window = scene(0)
    empty = replace(window.pc0, points=window.pc0.points[:0], is_ground=None)
    for result in CorrelationFlow(config(**options))([Window(empty, window.pc1), Window(window.pc0, empty)]):
        assert not result.residual_flow.any() and not result.score.any() and (result.cluster_id == -1).all()


@pytest.mark.parametrize("name", DENSE_ONLY)
def test_the_opencv_loop_has_none_of_them(name):
    settings = make_config("paper", **{name: {**ALL, "proof": True}[name]})
    with pytest.raises(CFlowError, match=name):
        opencv_flow(scene(0), settings)


@pytest.mark.cuda
@needs_gpu
@pytest.mark.parametrize("options", OPTIONS, ids=ids)
def test_cuda_equals_cpu(options):
    windows = [scene(seed, num_history=2) for seed in range(6)]
    settings = config(num_history=2, **options)
    on_cpu = CorrelationFlow(settings, device="cpu")(windows)
    for gpu, cpu in zip(CorrelationFlow(settings, device="cuda")(windows), on_cpu):
        assert_same(gpu.to("cpu"), cpu)


@pytest.mark.parametrize("engine", CORRELATIONS)
@pytest.mark.parametrize("num_slices", [pytest.param(2, marks=pytest.mark.slow), 5, 8])
def test_best_shifts_of_slices_equal_the_loop(num_slices, engine):
    """All sizes in one call, two templates per target."""
    rng = np.random.default_rng(num_slices)
    sizes = [(1, 1), (1, 9), (8, 8), (3, 7), (17, 16), (2, 33), (70, 30), (130, 120)]
    targets = [random_slices(rng, num_slices, size) for size in sizes]
    own = [*range(len(sizes)), *range(len(sizes))]
    templates = [random_slices(rng, num_slices, sizes[n]) for n in range(len(sizes))]
    templates += [np.roll(target, (1, -1), (1, 2)) for target in targets]
    shift, score = best_shifts(
        sliced_images(templates),
        sliced_images(targets),
        torch.tensor(own),
        torch.tensor(sizes),
        engine=engine,
        num_slices=num_slices,
    )
    for job, (template, n) in enumerate(zip(templates, own)):
        (dx, dy), expected = ref.scene_flow_in_1view(template, targets[n], 1.0)
        assert shift[job].tolist() == [dy, dx] and float(score[job]) == np.float32(expected)


def random_slices(rng, num_slices, size) -> np.ndarray:
    image = rng.random((num_slices, *size)) < rng.choice([0.05, 0.3])
    image.flat[rng.integers(image.size)] = True
    return image


def sliced_images(images: List[np.ndarray]) -> Images:
    """Set pixels of (n, H, W) images."""
    rows = [np.column_stack([np.full(i.any(0).sum(), k), np.argwhere(i.any(0))]) for k, i in enumerate(images)]
    bits = [(i[:, i.any(0)] << np.arange(len(i))[:, None]).sum(0) for i in images]
    index = torch.from_numpy(np.concatenate(rows).astype(np.int64))
    return Images(*index.t().contiguous(), slices=torch.from_numpy(np.concatenate(bits).astype(np.uint8)))


# ------------------------------------------------------------------------------------------ truths by hand

METRE = config().replace(pixel_sizes=(1.0,), point_cloud_range=(0.0, 0.0, -9.0, 40.0, 40.0, 9.0), max_extent=1000.0)
# (row, column) pixels of an L, 6 high and 5 wide.
ELL = [(r, 10) for r in range(10, 16)] + [(15, c) for c in range(11, 15)]


def sweep(pixels, z=0.5) -> Sweep:
    """A point in the middle of each 1 m pixel."""
    return Sweep(np.array([(c + 0.5, r + 0.5, z) for r, c in pixels]))


def moved(pixels, rows, cols):
    return [(r + rows, c + cols) for r, c in pixels]


def flow_of(pc0: Sweep, pc1: Sweep, **options):
    """Flow and score of the first point; both paths."""
    window, settings = Window(pc0, pc1), METRE.replace(**options)
    (result,) = CorrelationFlow(settings)([window])
    assert_same(result, reference_flow(window, settings))
    return [*result.residual_flow[0, :2].tolist(), float(result.score[0])]


def test_longer_than_max_object_does_not_move():
    ell, gone = sweep(ELL), sweep(moved(ELL, 1, 2))
    assert flow_of(ell, gone) == flow_of(ell, gone, max_object=6.0) == [2.0, 1.0, 1.0]  # exactly 6 m is not longer
    coinciding = len(set(ELL) & set(moved(ELL, 1, 2)))
    score = float(np.float32(coinciding / math.sqrt(len(ELL) ** 2)))
    assert flow_of(ell, gone, max_object=5.9) == [0.0, 0.0, score]
    # What counts is the length at t+1, not at t.
    short = ELL[1:]
    assert flow_of(ell, sweep(moved(short, 1, 2)), max_object=5.9)[:2] == [2.0, 1.0]
    assert flow_of(sweep(short), gone, max_object=5.9)[:2] == [0.0, 0.0]


def test_the_zero_test_by_hand():
    # Ten pixels in a row; c of them are there again at t+1, b others are one pixel further.
    def kept(b: int, c: int, z: float) -> bool:
        old = [(5 * i, 10) for i in range(b + c)]
        new = [(r, 11 if i < b else 10) for i, (r, _) in enumerate(old)]
        template, target = np.zeros((2, 100, 30), dtype=bool)
        for r, col in old:
            template[r, col] = True
        for r, col in new:
            target[r, col] = True
        expected = b > c and (b - c) / math.sqrt(b + c) >= z
        images = [
            Images(torch.zeros(n, dtype=torch.int64), *torch.from_numpy(np.argwhere(image)).t())
            for n, image in ((b + c, template), (b + c, target))
        ]
        lookup = Lookup(*images, torch.tensor([0]), torch.tensor([[100, 30]]))
        (found,) = beats_zero(lookup, torch.tensor([[0, 1]]), z).tolist()
        assert found == ref.beats_zero(template, target, 0, 1, z) == expected
        assert not ref.beats_zero(template, target, 0, 0, z)
        return found

    assert kept(9, 1, 2.5) and kept(6, 4, 0.5) and not kept(5, 5, 0.01) and not kept(4, 6, 0.01)
    assert kept(9, 0, 3.0) and not kept(9, 0, 3.01)  # 9 / sqrt(9): exactly z is enough
    assert kept(16, 4, 2.68) and not kept(16, 4, 2.69)  # 2.683: between two decimals


def test_a_shift_that_does_not_beat_zero_is_no_motion():
    ell, gone = sweep(ELL), sweep(moved(ELL, 1, 2))
    # 10 pixels, of which the shift brings all to coincide, no shift a few.
    coinciding = len(set(ELL) & set(moved(ELL, 1, 2)))
    b = len(ELL) - coinciding
    score = float(np.float32(coinciding / len(ELL)))
    assert flow_of(ell, gone, zero_test=math.floor(math.sqrt(b) * 100) / 100) == [2.0, 1.0, 1.0]
    assert flow_of(ell, gone, zero_test=math.ceil(math.sqrt(b) * 100 + 1) / 100) == [0.0, 0.0, score]


@pytest.mark.parametrize(
    "counts, offset",
    [
        ((3, 9, 3), 0.0),
        ((2, 9, 6), 4 / 20),  # (high - low) / (2 (2 top - low - high))
        ((6, 9, 2), -4 / 20),
        ((9, 9, 0), -0.5),
        ((12, 9, 5), -0.5),  # the NCC has its peak here, the counts do not: no farther than half a pixel
        ((9, 9, 9), 0.0),
        ((12, 9, 12), 0.0),  # curves upwards
    ],
)
def test_the_parabola_by_hand(counts, offset):
    # One template pixel per count and row, far enough apart that each meets its own target pixel at one shift only.
    template, target = np.zeros((2, 9 * sum(counts), 40), dtype=bool)
    row = 0
    for shift, count in zip((-1, 0, 1), counts):
        for _ in range(count):
            row += 5
            template[row, 10] = target[row, 12 + shift] = True
    images = [
        Images(torch.zeros(int(image.sum()), dtype=torch.int64), *torch.from_numpy(np.argwhere(image)).t())
        for image in (template, target)
    ]
    lookup = Lookup(*images, torch.tensor([0]), torch.tensor([template.shape]))
    for axis, swap in ((1, False), (0, True)):
        if swap:
            images = [Images(image.image, image.col, image.row) for image in images]
            lookup = Lookup(*images, torch.tensor([0]), torch.tensor([template.T.shape]))
            template, target = template.T, target.T
        shift = [0, 2] if axis == 1 else [2, 0]
        (found,) = parabola(lookup, torch.tensor([shift])).tolist()
        assert found == list(ref.parabola(template, target, *shift))
        assert found[axis] == offset and found[1 - axis] == 0.0


def test_subpixel_is_nearer_to_the_truth():
    rng = np.random.default_rng(3)
    outline = np.concatenate(
        [
            np.column_stack([rng.uniform(0, 4, 900), np.zeros(900), rng.uniform(0, 1.5, 900)]),
            np.column_stack([np.zeros(400), rng.uniform(0, 1.8, 400), rng.uniform(0, 1.5, 400)]),
        ]
    )
    errors = {"none": [], "parabola": []}
    for _ in range(20):
        motion = np.array([*rng.uniform(-0.6, 0.6, 2), 0.0])
        pc0, pc1 = (outline + rng.normal(0, 0.08, outline.shape) + move for move in (0.0, motion))
        for name, found in errors.items():
            (result,) = CorrelationFlow(config(subpixel=name))([Window(Sweep(pc0), Sweep(pc1))])
            found.append(float((result.residual_flow[0] - torch.from_numpy(motion)).norm()))
    assert np.mean(errors["parabola"]) < 0.8 * np.mean(errors["none"])


def test_pixels_coincide_only_in_the_same_slice():
    # A low line of pixels; at t+1 a high one stands one pixel to the left of it and the low one two to the right.
    line = [(r, 8) for r in range(6, 14)]
    pc0 = sweep(line, 0.25)
    high, low = sweep([*moved(line, 0, -1), (6, 4)], 0.75), sweep(moved(line, 0, 2), 0.25)
    pc1 = Sweep(np.concatenate([high.points, low.points]))
    assert flow_of(pc0, pc1)[:2] == [-1.0, 0.0]
    assert flow_of(pc0, pc1, height_slices=2)[:2] == [2.0, 0.0]
    assert flow_of(pc0, pc1, height_slices=2, slice_height=1.0) == flow_of(pc0, pc1)  # all in one slice
    box = (6, 4, 8, 7)
    template, target = (ref.slice_images(s.points, METRE.replace(height_slices=3), 1.0, box) for s in (pc0, pc1))
    assert [int(image.sum()) for image in (*template, *target)] == [8, 0, 0, 8, 9, 0]
    overlap, energy = ref.overlap_and_energy(template, target)
    assert (overlap[4, 3 - 1], overlap[4, 3 + 2]) == (0, 8) and energy[4, 3] == 17


def test_slices_below_zero_and_far_away():
    z = np.array([-0.01, -0.5, -0.51, 0.0, 0.49, 0.5, 2.0, -1e11, 1e11, 1e15, -1e15, 123456.78])
    numbers = [math.floor(min(max(v, -1e12), 1e12) / 0.5) % 4 for v in z.tolist()]
    assert numbers[:7] == [3, 3, 2, 0, 0, 1, 0]
    settings = METRE.replace(height_slices=4, point_cloud_range=(0.0, 0.0, -math.inf, 40.0, 40.0, math.inf))
    cloud = np.column_stack([np.arange(len(z)) + 0.5, np.full(len(z), 3.5), z])
    images = ref.slice_images(cloud, settings, 1.0, (3, 0, 1, len(z)))
    assert images[:, 0].argmax(0).tolist() == numbers and (images.sum(0) == 1).all()
    window = Window(Sweep(cloud), Sweep(cloud[::-1] * [1, 1, -1] + [0, 0, 0.3]))
    (result,) = CorrelationFlow(settings)([window])
    assert_same(result, reference_flow(window, settings))


def test_one_point_a_pixel_in_the_same_slice_is_the_flat_result():
    window = scene(5, num_history=2)
    sweeps = (window.pc0, window.pc1)
    finite = [np.where(np.isfinite(s.points), s.points, np.nan) for s in sweeps]
    flat = [replace(s, points=p * np.float32([1, 1, 0]), pose=None) for s, p in zip(sweeps, finite)]
    (plain,) = CorrelationFlow(config())([Window(*flat)])
    (sliced,) = CorrelationFlow(config(height_slices=8, slice_height=100.0))([Window(*flat)])
    assert_same(plain, sliced)
    assert plain.residual_flow.any()
