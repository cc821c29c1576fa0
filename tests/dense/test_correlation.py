"""The best shift of each template, compared with the oracle's loop over all shifts."""

from __future__ import annotations

from dataclasses import replace
from typing import Optional, Tuple

import numpy as np
import pytest
import torch
from oracle.dense import scene_flow_in_1view
from scenes import same_bits

from cflow_torch import CFlowError
from cflow_torch.dense import packing
from cflow_torch.dense.correlation import best_shifts
from cflow_torch.dense.templates import Images, TemplatePairs
from cflow_torch.windows import memory

ENGINES = ("fft", "conv")
Pair = Tuple[np.ndarray, int, Optional[float]]  # template, its target, radius


def as_images(images: list[np.ndarray]) -> Images:
    """Set pixels of all images, in random order."""
    parts = [np.column_stack([np.full(image.sum(), i), np.argwhere(image)]) for i, image in enumerate(images)]
    pixels = np.random.default_rng(0).permutation(np.concatenate(parts).astype(np.int64))
    return Images(*torch.from_numpy(pixels).t().contiguous())


def as_pairs(targets: list[np.ndarray], pairs: list[Pair]) -> TemplatePairs:
    """Pairs in the order of their targets."""
    radius = None if pairs[0][2] is None else torch.tensor([pair[2] for pair in pairs], dtype=torch.float64)
    return TemplatePairs(
        as_images([pair[0] for pair in pairs]),
        as_images(targets),
        torch.tensor([pair[1] for pair in pairs]),
        torch.zeros(len(pairs), dtype=torch.int64),
        torch.tensor([target.shape for target in targets]),
        radius,
    )


def assert_equals_oracle(targets: list[np.ndarray], pairs: list[Pair], engine: str = "fft") -> None:
    shift, score = best_shifts(as_pairs(targets, pairs), engine)
    assert shift.dtype == torch.int64 and score.dtype == torch.float32
    expected = [scene_flow_in_1view(template, targets[own], 1.0, radius) for template, own, radius in pairs]
    assert shift.tolist() == [[dy, dx] for (dx, dy), _ in expected]
    assert score.tolist() == pytest.approx([value for _, value in expected], abs=1e-6)


def random_image(rng, shape, density=None) -> np.ndarray:
    image = rng.random(shape) < (rng.choice([0.05, 0.2, 0.5, 0.9]) if density is None else density)
    image.flat[rng.integers(image.size)] = True
    return image


def random_pairs(rng, sizes, num_pairs, with_radius) -> tuple[list[np.ndarray], list[Pair]]:
    targets = [random_image(rng, size) for size in sizes]
    pairs: list[Pair] = []
    for own in sorted([*range(len(sizes)), *rng.integers(0, len(sizes), num_pairs).tolist()]):
        moved = np.roll(targets[own], rng.integers(-2, 3, 2), (0, 1)) & (rng.random(sizes[own]) < 0.8)
        template = moved if moved.any() and rng.random() < 0.6 else random_image(rng, sizes[own])
        pairs.append((template, own, float(rng.choice([0, 1, 2**0.5, 2, 2.9, 5, 40])) if with_radius else None))
    return targets, pairs


SIZES = [(1, 1), (1, 2), (2, 2), (12, 1), (8, 8), (9, 8), (3, 7), (17, 16), (2, 33), (1, 300), (66, 50)]


@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize("with_radius", [False, True])
def test_best_shifts_equal_the_oracle(with_radius, engine):
    """All sizes in one call, several templates per target."""
    for seed in range(2):
        assert_equals_oracle(*random_pairs(np.random.default_rng(seed), SIZES, 30, with_radius), engine)


def test_every_small_image_equals_the_oracle():
    # All pairs of 2 x 3 images: plenty of ties of every kind.
    images = [np.array([(i >> b) & 1 for b in range(6)], dtype=bool).reshape(2, 3) for i in range(1, 64)]
    assert_equals_oracle(images, [(template, own, None) for own in range(len(images)) for template in images[::3]])


def shift_of(template: list[tuple[int, int]], target: list[tuple[int, int]], shape, radius=None) -> tuple[list, float]:
    image, other = np.zeros((2, *shape), dtype=bool)
    for pixels, drawn in ((template, image), (target, other)):
        for pixel in pixels:
            drawn[pixel] = True
    shift, score = best_shifts(as_pairs([other], [(image, 0, radius)]))
    return shift[0].tolist(), float(score)


def test_the_search_range():
    assert shift_of([(0, 0)], [(8, 8)], (9, 9)) == ([0, 0], 0.0)  # a shift of 8 is out of reach: no overlap at all
    assert shift_of([(0, 0)], [(8, 8), (4, 4)], (9, 9))[0] == [4, 4]
    assert shift_of([(0, 0)], [(8, 8), (4, 4)], (9, 9), 3.0) == ([0, 0], 0.0)
    assert shift_of([(3, 3)], [(6, 7)], (11, 11), 5.0)[0] == [3, 4]  # the radius itself
    assert shift_of([(3, 3)], [(6, 7)], (11, 11), float(np.nextafter(5, 0)))[0] == [0, 0]
    # Even sizes have one shift less on the far side.
    assert shift_of([(0, 0)], [(0, 4)], (1, 8))[0] == [0, 0] and shift_of([(0, 4)], [(0, 0)], (1, 8))[0] == [0, -4]


def test_the_layout_for_a_gpu_gives_equal_shifts(monkeypatch):
    targets, pairs = random_pairs(np.random.default_rng(3), [(5, 6), (300, 290), (40, 41)], 4, False)
    shift, score = best_shifts(as_pairs(targets, pairs))
    monkeypatch.setattr(packing, "_LINES_CPU", packing._LINES_GPU)
    found = best_shifts(as_pairs(targets, pairs))
    assert torch.equal(found[0], shift) and same_bits(found[1], score)


def test_a_cluster_that_is_too_large_is_refused(monkeypatch):
    ends = [np.zeros((1, 40_000), dtype=bool)]
    ends[0][0, [0, -1]] = True
    with pytest.raises(CFlowError, match="40000 pixels long.*finite z bounds"):
        best_shifts(as_pairs(ends, [(ends[0], 0, None)]))
    pairs = as_pairs([np.eye(300, dtype=bool)], [(np.eye(300, dtype=bool), 0, None)])
    monkeypatch.setattr(memory, "_MUCH", 0)
    monkeypatch.setattr(memory, "available_memory", lambda environ: 10**7)
    with pytest.raises(CFlowError, match=r"a cluster that is 300 pixels long needs about .* bytes\).*max_speed"):
        best_shifts(pairs)
    best_shifts(replace(pairs, radius=torch.tensor([3.0])))  # as the message says
