"""The best shift of each image, against a plain loop over all shifts and against OpenCV."""

from __future__ import annotations

import math
from typing import List, Optional, Tuple

import cv2
import numpy as np
import oracle as ref
import pytest
import torch
from scenes import needs_gpu, same_bits

from cflow_torch.dense.correlation import best_shifts
from cflow_torch.dense.packing import Images

ENGINES = ("fft", "conv")
Job = Tuple[np.ndarray, int, Optional[float]]  # template, its target, radius


def loop(template: np.ndarray, target: np.ndarray, radius: Optional[float]) -> Tuple[int, int, float]:
    """(dy, dx, score) by looking at every shift on its own."""
    height, width = template.shape
    best = None
    for dy in range(-(height // 2), height - height // 2):
        for dx in range(-(width // 2), width - width // 2):
            if radius is not None and dx * dx + dy * dy > radius * radius:
                continue
            window = np.zeros((height, width), dtype=bool)  # target pixels under the shifted template's box
            rows, cols = slice(max(dy, 0), min(height, height + dy)), slice(max(dx, 0), min(width, width + dx))
            window[rows.start - dy : rows.stop - dy, cols.start - dx : cols.stop - dx] = target[rows, cols]
            count, energy = int((template & window).sum()), int(window.sum())
            value = float(count * count) / float(energy) if energy else 0.0
            score = count / math.sqrt(float(int(template.sum()) * energy)) if energy else 0.0
            rank = (-value, dx * dx + dy * dy, dy, dx)
            if best is None or rank < best[0]:
                best = (rank, dy, dx, score)
    return best[1], best[2], float(np.float32(best[3]))


def as_images(images: List[np.ndarray], rng) -> Images:
    """Set pixels of all images, in random order."""
    parts = [np.column_stack([np.full(image.sum(), i), np.argwhere(image)]) for i, image in enumerate(images)]
    pixels = rng.permutation(np.concatenate(parts).astype(np.int64))
    return Images(*torch.from_numpy(pixels).t().contiguous())


def run_all(targets: List[np.ndarray], jobs: List[Job], engine: str, device: str = "cpu"):
    rng = np.random.default_rng(0)
    template = as_images([job[0] for job in jobs], rng)
    target = as_images(targets, rng)
    radius = None if jobs[0][2] is None else torch.tensor([job[2] for job in jobs], dtype=torch.float64, device=device)
    template, target = (Images(*(t.to(device) for t in (i.image, i.row, i.col))) for i in (template, target))
    return best_shifts(
        template,
        target,
        torch.tensor([job[1] for job in jobs], device=device),
        torch.tensor([t.shape for t in targets], device=device),
        radius,
        engine,
    )


def random_image(rng, shape, density=None) -> np.ndarray:
    image = rng.random(shape) < (rng.choice([0.05, 0.2, 0.5, 0.9]) if density is None else density)
    image.flat[rng.integers(image.size)] = True
    return image


def random_jobs(rng, sizes, num_jobs, with_radius) -> Tuple[List[np.ndarray], List[Job]]:
    targets = [random_image(rng, size) for size in sizes]
    jobs: List[Job] = []
    for own in [*range(len(sizes)), *rng.integers(0, len(sizes), num_jobs)]:
        moved = np.roll(targets[own], rng.integers(-2, 3, 2), (0, 1)) & (rng.random(sizes[own]) < 0.8)
        template = moved if moved.any() and rng.random() < 0.6 else random_image(rng, sizes[own])
        jobs.append((template, int(own), float(rng.choice([0, 1, 2**0.5, 2, 2.9, 5, 40])) if with_radius else None))
    order = rng.permutation(len(jobs))
    return targets, [jobs[i] for i in order]


@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize("with_radius", [False, True])
@pytest.mark.parametrize("seed", range(3))
def test_best_shifts_equal_the_loop(seed, with_radius, engine):
    """All sizes in one call, several templates per target, in no order."""
    rng = np.random.default_rng(seed)
    sizes = [
        (1, 1),
        (1, 2),
        (2, 1),
        (2, 2),
        (1, 9),
        (12, 1),
        (8, 8),
        (9, 8),
        (3, 7),
        (16, 5),
        (17, 16),
        (2, 33),
        (40, 3),
    ]
    targets, jobs = random_jobs(rng, sizes, 40, with_radius)
    shift, score = run_all(targets, jobs, engine)
    assert shift.dtype == torch.int64 and score.dtype == torch.float32
    expected = [loop(template, targets[own], radius) for template, own, radius in jobs]
    assert [(*s, v) for s, v in zip(shift.tolist(), score.tolist())] == expected


@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize("shape", [(1, 700), (700, 1), (3, 260), (97, 8), (65, 64), (64, 65), (66, 130)])
def test_long_thin_images(shape, engine):
    rng = np.random.default_rng(sum(shape))
    target = random_image(rng, shape, 0.1)
    shift = (shape[0] // 3, -(shape[1] // 3))
    template = np.zeros(shape, dtype=bool)
    for row, col in np.argwhere(target):  # the target moved by -shift, as far as it stays inside
        if 0 <= row - shift[0] < shape[0] and 0 <= col - shift[1] < shape[1]:
            template[row - shift[0], col - shift[1]] = True
    template |= random_image(rng, shape, 0.01)
    found, score = run_all([target], [(template, 0, None)], engine)
    (_, _), expected_score = ref.scene_flow_in_1view(template, target, 1.0)
    (dx, dy), _ = ref.scene_flow_in_1view(template, target, 1.0)
    assert found.tolist() == [[dy, dx]]
    assert score.tolist() == [np.float32(expected_score)]


@pytest.mark.parametrize("engine", ENGINES)
def test_every_small_image_against_the_loop(engine):
    # All pairs of 2 x 3 images: plenty of ties of every kind.
    images = [np.array([(i >> b) & 1 for b in range(6)], dtype=bool).reshape(2, 3) for i in range(1, 64)]
    jobs: List[Job] = [(template, own, None) for template in images for own in range(len(images))]
    shift, score = run_all(images, jobs, engine)
    expected = [loop(template, images[own], None) for template, own, _ in jobs]
    assert [(*s, v) for s, v in zip(shift.tolist(), score.tolist())] == expected


@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize(
    "target, best",
    [
        ([(3, 1), (3, 5)], (0, -2)),  # equal distance left and right: the smaller dx
        ([(1, 3), (5, 3)], (-2, 0)),  # above and below: the smaller dy
        ([(3, 5), (4, 3)], (1, 0)),  # the nearer one
        ([(2, 4), (4, 2)], (-1, 1)),  # same distance: dy before dx
        ([(3, 3), (3, 4)], (0, 0)),  # where it is
    ],
)
def test_ties(target, best, engine):
    image, template = np.zeros((2, 7, 7), dtype=bool)
    template[3, 3] = True
    for pixel in target:
        image[pixel] = True
    assert run_all([image], [(template, 0, None)], engine)[0].tolist() == [list(best)]


@pytest.mark.parametrize("engine", ENGINES)
def test_no_overlap_at_all_stays_where_it_is(engine):
    template, target = np.zeros((2, 9, 9), dtype=bool)
    template[0, 0] = target[8, 8] = True  # a shift of 8 is out of reach
    shift, score = run_all([target], [(template, 0, None)], engine)
    assert shift.tolist() == [[0, 0]] and score.tolist() == [0.0]
    target[4, 4] = True  # reachable without a radius, not within 3
    assert run_all([target], [(template, 0, None)], engine)[0].tolist() == [[4, 4]]
    shift, score = run_all([target], [(template, 0, 3.0)], engine)
    assert shift.tolist() == [[0, 0]] and score.tolist() == [0.0]


@pytest.mark.parametrize("engine", ENGINES)
def test_the_radius_itself_is_searched(engine):
    template, target = np.zeros((2, 11, 11), dtype=bool)
    template[3, 3] = target[6, 7] = True  # a shift of (3, 4), length 5
    assert run_all([target], [(template, 0, 5.0)], engine)[0].tolist() == [[3, 4]]
    assert run_all([target], [(template, 0, float(np.nextafter(5, 0)))], engine)[0].tolist() == [[0, 0]]


def test_even_sizes_search_one_shift_less_on_the_far_side():
    template, target = np.zeros((2, 1, 8), dtype=bool)
    template[0, 0] = target[0, 4] = True
    assert run_all([target], [(template, 0, None)], "fft")[0].tolist() == [[0, 0]]  # +4 is not searched
    assert run_all([template], [(target, 0, None)], "fft")[0].tolist() == [[0, -4]]  # -4 is


def test_no_jobs():
    none = torch.zeros(0, dtype=torch.int64)
    shift, score = best_shifts(Images(none, none, none), Images(none, none, none), none, torch.zeros(0, 2).long())
    assert shift.shape == (0, 2) and score.shape == (0,)


def test_result_does_not_depend_on_the_other_jobs():
    rng = np.random.default_rng(12)
    targets, jobs = random_jobs(rng, [(5, 6), (20, 20), (9, 33), (70, 3)], 10, False)
    shift, score = run_all(targets, jobs, "fft")
    for i, (template, own, _) in enumerate(jobs):
        alone = run_all([targets[own]], [(template, 0, None)], "fft")
        assert torch.equal(alone[0][0], shift[i]) and same_bits(alone[1][0], score[i])


def test_score_is_that_of_opencv():
    """cv2.TM_CCORR_NORMED is Eq. norm_correlation; OpenCV works in float32."""
    rng = np.random.default_rng(5)
    targets, jobs = random_jobs(rng, [(9, 9), (12, 20), (31, 17), (5, 40)], 30, False)
    shift, score = run_all(targets, jobs, "fft")
    for (template, own, _), (dy, dx), value in zip(jobs, shift.tolist(), score.tolist()):
        height, width = template.shape
        half = (height // 2, width // 2)
        padded = np.pad(targets[own], [(half[0], height - 1 - half[0]), (half[1], width - 1 - half[1])])
        scores = cv2.matchTemplate(padded.astype(np.float32), template.astype(np.float32), cv2.TM_CCORR_NORMED)
        assert scores.shape == (height, width)
        assert value == pytest.approx(scores[dy + half[0], dx + half[1]], abs=2e-6)
        seen = cv2.boxFilter(padded.astype(np.float64), -1, (width, height), anchor=(0, 0), normalize=False)
        scores[seen[:height, :width] < 0.5] = 0  # OpenCV divides by nearly zero where nothing is below the window
        assert value >= scores.max() - 2e-6


@pytest.mark.cuda
@needs_gpu
@pytest.mark.parametrize("engine", ENGINES)
def test_best_shifts_on_cuda_equal_cpu(engine):
    rng = np.random.default_rng(6)
    targets, jobs = random_jobs(rng, [(5, 6), (20, 20), (9, 33), (70, 3), (64, 64), (200, 16)], 60, True)
    for on_gpu, on_cpu in zip(run_all(targets, jobs, engine, "cuda"), run_all(targets, jobs, engine)):
        assert same_bits(on_gpu, on_cpu)
