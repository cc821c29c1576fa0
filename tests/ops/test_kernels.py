"""Medians, counts, adjugates, nearest pixels, surfaces, correlation and morphology, against NumPy, SciPy and loops."""

from __future__ import annotations

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from scipy import ndimage

from cflow_torch.ops import morphology
from cflow_torch.ops.cross_correlation import cross_correlate
from cflow_torch.ops.groups import Groups
from cflow_torch.ops.indices import divide, floor_divide, split_index, unique_pairs
from cflow_torch.ops.kornia_engine import close_3x3_kornia
from cflow_torch.ops.labeling import pad
from cflow_torch.ops.linear import adjugate, full, upper
from cflow_torch.ops.lower_surface import NO_HEIGHT, _cone, _lowest, _surface, lower_surface
from cflow_torch.ops.medians import masked_median, segment_median
from cflow_torch.ops.nearest import nearest_set_pixel


@pytest.mark.parametrize("length", [0, 1, 50])
def test_unique_pairs_are_numpys(length):
    pairs = np.random.default_rng(length).integers([0, -1], [4, 3], (length, 2))
    expected, index, count = np.unique(pairs, axis=0, return_inverse=True, return_counts=True)
    first, second, *rest = (values.tolist() for values in unique_pairs(*torch.from_numpy(pairs).T))
    assert [first, second] == expected.T.tolist() and rest == [index.ravel().tolist(), count.tolist()]


def test_medians_are_numpys():
    rng = np.random.default_rng(6)
    for width in (1, 2, 3, 6):
        values, mask = rng.normal(size=(40, width, 2)).round(1), rng.random((40, width)) < 0.6
        found = masked_median(torch.from_numpy(values), torch.from_numpy(mask)).tolist()
        assert found == [np.median(v[m], 0).tolist() if m.any() else [0.0, 0.0] for v, m in zip(values, mask)]
    for num_segments in (1, 5, 40):
        values, index = rng.integers(-4, 5, 60).astype(np.float64), rng.integers(0, num_segments, 60)
        median = segment_median(torch.from_numpy(values), torch.from_numpy(index), num_segments)
        members = [values[index == segment] for segment in range(num_segments)]
        assert median.tolist() == [float(np.median(m)) if len(m) else 0.0 for m in members]
    nothing = torch.zeros(0, dtype=torch.float64)
    assert segment_median(nothing, nothing.long(), 3).tolist() == [0, 0, 0]


def test_adjugate_is_the_inverse_times_the_determinant():
    factors = np.random.default_rng(0).normal(size=(50, 3, 3))
    matrices = factors @ factors.transpose(0, 2, 1)
    found, determinant = adjugate(upper(torch.from_numpy(matrices.transpose(1, 2, 0).copy())))
    inverse = full(found / determinant).permute(2, 0, 1)
    np.testing.assert_allclose(inverse, np.linalg.inv(matrices), rtol=1e-8)
    np.testing.assert_allclose(determinant, np.linalg.det(matrices), rtol=1e-8)
    alone = [adjugate(upper(torch.from_numpy(matrix[:, :, None].copy())))[0] for matrix in matrices]
    assert torch.equal(torch.cat(alone, 1), found)


def test_singular_whole_numbers_give_exactly_zero():
    matrix = torch.tensor([[1.0, 2, 3], [2, 4, 6], [3, 6, 9]], dtype=torch.float64)[:, :, None]
    found, determinant = adjugate(upper(matrix))
    assert not found.any() and determinant.tolist() == [0.0]


def test_the_nearest_pixel_is_the_first_in_raster_order_among_ties():
    for seed in range(9):
        rng = np.random.default_rng(seed)
        seeds = rng.random((3, 11, 8)) < (0.0, 0.02, 0.2)[seed % 3]
        seeds[1] = False
        pixels = np.sort(rng.choice(seeds.size, 60, replace=False))
        expected = []
        for image, row, col in zip(*np.unravel_index(pixels, seeds.shape)):
            found = np.argwhere(seeds[image])  # in raster order, so argmin breaks ties
            best = found[((found - (row, col)) ** 2).sum(1).argmin()] if len(found) else None
            expected.append(-1 if best is None else int(np.ravel_multi_index((image, *best), seeds.shape)))
        assert nearest_set_pixel(torch.from_numpy(seeds), torch.from_numpy(pixels)).tolist() == expected
    assert nearest_set_pixel(torch.ones((1, 2, 2), dtype=torch.bool), torch.zeros(0, dtype=torch.int64)).shape == (0,)


def test_a_surface_is_that_of_the_whole_map_where_heights_are_known():
    generator = torch.Generator().manual_seed(0)
    for rows, cols in ((slice(3, 30), slice(40, 90)), (slice(0, 5), slice(90, 96)), (slice(60, 61), slice(7, 8))):
        low = torch.full((2, 80, 96), NO_HEIGHT, dtype=torch.int32)
        part = low[:, rows, cols]
        heights = torch.randint(-800, 3000, part.shape, dtype=torch.int32, generator=generator)
        part.copy_(heights.masked_fill(torch.rand(part.shape, generator=generator) < 0.4, NO_HEIGHT))
        is_known = low < NO_HEIGHT
        assert torch.equal(lower_surface(low)[is_known], _surface(low, _lowest(low))[is_known])
    assert lower_surface(torch.full((1, 9, 9), NO_HEIGHT, dtype=torch.int32)).shape == (1, 9, 9)


def test_cones_are_the_highest_surfaces_of_limited_slope():
    heights = torch.from_numpy(np.random.default_rng(0).integers(-900, 900, (2, 7, 9)).astype(np.int32))
    found = _cone(heights, 51)
    for b, r, c in np.ndindex(*heights.shape):
        steps = np.abs(np.arange(7) - r)[:, None] + np.abs(np.arange(9) - c)
        assert found[b, r, c] == (heights[b].numpy() + 51 * steps).min()


SQUARE = np.ones((1, 3, 3), dtype=bool)


@pytest.mark.parametrize("shape", [(1, 1, 1), (1, 1, 9), (1, 8, 1), (3, 13, 17), (2, 11, 12), (0, 5, 5)])
def test_closing_equals_scipy(shape):
    rng = np.random.default_rng(len(shape))
    for density in (0.0, 0.1, 0.5, 0.95, 1.0):
        image = rng.random(shape) < density
        given = torch.from_numpy(image)
        padded = pad([given])
        before = padded.clone()
        found = morphology.close_3x3(padded, *shape[1:])
        closed = found[:, : shape[1], : shape[2]]
        assert found.shape == padded.shape and found.sum() == closed.sum()  # nothing in the margin
        assert torch.equal(padded, before)
        if image.size:
            dilated = ndimage.binary_dilation(image, SQUARE)
            assert (closed.numpy() == ndimage.binary_erosion(dilated, SQUARE, border_value=1)).all()
            assert torch.equal(close_3x3_kornia(given), closed)


@pytest.mark.parametrize("shape", [(1, 1), (1, 7), (7, 2), (9, 13)])
def test_erosion_with_a_cross_is_scipys_with_background_outside(shape):
    for seed in range(8):
        image = np.random.default_rng(seed).random((2, *shape)) < 0.8
        expected = np.stack([ndimage.binary_erosion(part, border_value=0) for part in image])
        assert np.array_equal(morphology.erode_cross(torch.from_numpy(image)).numpy(), expected)


def test_indices_are_divided_like_integers():
    index = torch.tensor([0, 1, 6, 7, 8, 2**40, 2**62 + 5])
    for width in (1, 2, 7, 701, 2**31 + 1):
        row, col = split_index(index, width)
        assert [tuple(pair) for pair in zip(row.tolist(), col.tolist())] == [divmod(i, width) for i in index.tolist()]
    assert floor_divide(torch.tensor(7), 2) == 3 and floor_divide(torch.tensor(7), 2).shape == ()


def test_numbers_are_divided_and_not_multiplied_by_a_reciprocal():
    values = np.random.default_rng(0).normal(size=(3, 100))
    assert not np.array_equal(values / 0.1, values * (1 / 0.1))
    assert np.array_equal(divide(torch.from_numpy(values), 0.1).numpy(), values / 0.1)


def test_counts_are_those_of_bincount():
    rng = np.random.default_rng(0)
    for number, size in [(0, 0), (0, 4), (1, 1), (50, 7), (1000, 300)]:
        index = rng.integers(0, max(size, 1), number)
        weights = rng.integers(-(2**40), 2**40, (3, number))
        groups = Groups(torch.from_numpy(index), size)
        assert groups.size().tolist() == np.bincount(index, minlength=size).tolist()
        expected = [[int(row[index == i].sum()) for i in range(size)] for row in weights]
        assert groups.sum(torch.from_numpy(weights)).tolist() == expected
        assert groups.sum(torch.from_numpy(weights[1])).tolist() == expected[1]
        halves = groups.sum(torch.from_numpy(weights / 2))
        assert halves.shape == (3, size) and halves.dtype == torch.float64
        assert halves.tolist() == [[total / 2 for total in row] for row in expected]


@pytest.mark.parametrize("shape", [(100, 100), (317, 401), (4, 3000)])
def test_fft_counts_stay_exact_on_full_images(shape):
    # The largest counts there are: the overlap of two full images is (H - |dy|) (W - |dx|).
    height, width = shape
    template = F.pad(torch.ones((1, *shape), dtype=torch.bool), (0, width // 2, 0, height // 2))
    target = F.pad(torch.ones((1, *shape), dtype=torch.bool), (width // 2, 0, height // 2, 0))  # moved by half the size
    found = cross_correlate(torch.cat((template, target)), 1, torch.zeros(1, dtype=torch.int64), "fft")
    rows, cols = (side - abs(np.arange(-(side // 2), side // 2 + 1)) for side in shape)
    found = found[0, : len(rows), : len(cols)]
    assert (found - found.round()).abs().max() < 0.5 and np.array_equal(found.round(), rows[:, None] * cols)
