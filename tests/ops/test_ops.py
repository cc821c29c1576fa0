"""Tensor operations that know nothing of LiDAR, against SciPy, kornia and direct counting."""

from __future__ import annotations

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from kornia import contrib
from scenes import LABELINGS, needs_gpu
from scipy import ndimage
from scipy.sparse import coo_matrix, csgraph

from cflow_torch.ops import morphology
from cflow_torch.ops.cross_correlation import FAST_LENGTHS, cross_correlate
from cflow_torch.ops.indices import divide, split_index
from cflow_torch.ops.labeling import connected_components, connected_components_kornia, pad, union_find
from cflow_torch.ops.nearest import nearest_set_pixel
from cflow_torch.ops.patches import gather_patches
from cflow_torch.ops.segments import (
    bounding_boxes,
    first_of_segment,
    masked_median,
    segment_amin,
    segment_ends,
    segment_median,
)
from cflow_torch.types import CFlowError

SQUARE = np.ones((3, 3), dtype=bool)
STRUCTURE = {4: ndimage.generate_binary_structure(2, 1), 8: SQUARE}


# ------------------------------------------------------------------------------------------------- labelling


def scipy_first(images: np.ndarray, connectivity: int, reach: int) -> np.ndarray:
    """What `connected_components` must return, by SciPy, image by image."""
    first = []
    for image in images:
        drawn = ndimage.binary_dilation(image, SQUARE) if reach == 3 else image
        labels = ndimage.label(drawn, STRUCTURE[connectivity])[0][image]
        _, position, inverse = np.unique(labels, return_index=True, return_inverse=True)
        first.append(position[inverse.reshape(-1)] + sum(map(len, first)))
    return np.concatenate(first)


def label(images: np.ndarray, connectivity: int, reach: int, engine: str) -> np.ndarray:
    occupancy = torch.from_numpy(images)
    pixels = occupancy.flatten().nonzero()[:, 0]
    if engine == "sparse":
        return connected_components(occupancy, pixels, connectivity, reach).numpy()
    dense = morphology.dilate_3x3_kornia(occupancy) if reach == 3 else occupancy
    return connected_components_kornia(dense, pixels, connectivity).numpy()


def spiral(size: int, step: int = 2) -> np.ndarray:
    """One arm winding inwards, one pixel wide; neighbouring turns are `step` pixels apart."""
    image = np.zeros((size, size), dtype=bool)
    row, col, length = 0, 0, size - 1
    image[0, 0] = True
    directions = [(0, 1), (1, 0), (0, -1), (-1, 0)]
    for turn in range(4 * size):
        if length <= 0:
            break
        for _ in range(length):
            row, col = row + directions[turn % 4][0], col + directions[turn % 4][1]
            image[row, col] = True
        if turn >= 2 and turn % 2 == 0:
            length -= step
    return image


def comb(height: int, width: int, step: int) -> np.ndarray:
    """Teeth that meet only in the last row, so raster order learns late that they are one."""
    image = np.zeros((height, width), dtype=bool)
    image[:, ::step] = True
    image[-1] = True
    return image


def snake(height: int, width: int, step: int) -> np.ndarray:
    """Rows joined alternately at the right and at the left end: one long component."""
    image = np.zeros((height, width), dtype=bool)
    image[::step] = True
    for i, row in enumerate(range(0, height - step, step)):
        image[row : row + step, -1 if i % 2 == 0 else 0] = True
    return image


@pytest.mark.parametrize("engine", LABELINGS)
@pytest.mark.parametrize("reach", [1, 3])
@pytest.mark.parametrize("connectivity", [4, 8])
def test_labelling_equals_scipy_on_random_images(connectivity, reach, engine):
    rng = np.random.default_rng(connectivity + reach)
    for shape in [(1, 1), (1, 17), (19, 1), (2, 2), (7, 5), (23, 40), (64, 63)]:
        densities = np.array([0.0, 0.02, 0.05, 0.1, 0.2, 0.41, 0.59, 0.8, 1.0])[:, None, None]
        images = rng.random((9, *shape)) < densities
        found = label(images, connectivity, reach, engine)
        assert found.tolist() == scipy_first(images, connectivity, reach).tolist(), shape


@pytest.mark.parametrize("engine", LABELINGS)
@pytest.mark.parametrize("connectivity", [4, 8])
@pytest.mark.parametrize("step", [2, 3, 4, 5])
def test_labelling_of_spirals_and_combs(step, connectivity, engine):
    images = np.stack([spiral(60, step), comb(60, 60, step), spiral(60, step).T, comb(60, 60, step)[::-1]])
    for reach in (1, 3):
        assert label(images, connectivity, reach, engine).tolist() == scipy_first(images, connectivity, reach).tolist()


def test_spiral_and_snake_are_single_components():
    # The shapes are what they claim to be, and a single label covers them.
    for image in (spiral(61), snake(61, 40, 2), comb(30, 31, 2)):
        assert ndimage.label(image)[1] == 1
        assert not label(image[None], 4, 1, "sparse").any()


@pytest.mark.parametrize("engine", LABELINGS)
@pytest.mark.parametrize("reach, step, shape", [(1, 2, (449, 450)), (3, 4, (633, 640))])
def test_labelling_of_a_snake_of_100000_pixels(reach, step, shape, engine):
    image = snake(*shape, step)
    assert image.sum() > 100_000
    assert not label(image[None], 4, reach, engine).any()  # one component, named by its first pixel
    image[shape[0] // 2 // step * step] = False  # cut it
    assert label(image[None], 8, reach, engine).tolist() == scipy_first(image[None], 8, reach).tolist()


@pytest.mark.parametrize("engine", LABELINGS)
@pytest.mark.parametrize("reach", [1, 3])
@pytest.mark.parametrize("connectivity", [4, 8])
def test_two_pixels_link_exactly_within_reach(connectivity, reach, engine):
    """Every offset up to 5, at every place relative to the blocks, the far pixel on the border of the image."""
    for dy in range(6):
        for dx in range(-5, 6):
            if (dy, dx) <= (0, 0):
                continue
            images = np.zeros((16, dy + 4, abs(dx) + 4), dtype=bool)
            for i in range(16):
                row, col = i // 4, i % 4 + max(-dx, 0)
                images[i, row, col] = images[i, row + dy, col + dx] = True
            linked = label(images, connectivity, reach, engine)[1::2] == np.arange(0, 32, 2)
            corner = connectivity == 4 and dy == abs(dx) == reach
            assert linked.tolist() == [max(dy, abs(dx)) <= reach and not corner] * 16, (dy, dx)


@pytest.mark.parametrize("engine", LABELINGS)
@pytest.mark.parametrize("reach", [1, 3])
def test_components_never_join_across_images(reach, engine):
    images = np.ones((5, 6, 7), dtype=bool)
    assert label(images, 8, reach, engine).tolist() == np.repeat(np.arange(5) * 42, 42).tolist()


@pytest.mark.parametrize("reach", [1, 3])
@pytest.mark.parametrize("connectivity", [4, 8])
def test_labelling_at_every_size(connectivity, reach):
    """Blocks and margins fit images of any size: the last row and column are full, so every neighbour is asked for."""
    rng = np.random.default_rng(connectivity + reach)
    for height, width in [(n, 1 + (5 * n) % 26) for n in range(1, 27)]:
        images = rng.random((3, height, width)) < 0.08
        images[:, -1, rng.random(width) < 0.5] = images[:, rng.random(height) < 0.5, -1] = True
        assert (
            label(images, connectivity, reach, "sparse").tolist() == scipy_first(images, connectivity, reach).tolist()
        )


def test_labelling_without_kornia_union_find_says_what_to_do(monkeypatch):
    monkeypatch.delattr(contrib, "connected_components_union_find", raising=False)
    with pytest.raises(CFlowError, match="kornia >= 0.9.*sparse"):
        label(np.ones((1, 3, 3), dtype=bool), 8, 1, "kornia")


def test_union_find_equals_scipy():
    rng = np.random.default_rng(0)
    for num_nodes, num_edges in [(1, 0), (5, 0), (1, 3), (10, 6), (200, 150), (1000, 700), (3000, 9000)]:
        edges = rng.integers(0, num_nodes, (2, num_edges))  # with loops and repeated edges
        root = union_find(num_nodes, *torch.from_numpy(edges)).numpy()
        graph = coo_matrix((np.ones(num_edges), tuple(edges)), shape=(num_nodes, num_nodes))
        _, labels = csgraph.connected_components(graph, directed=False)
        _, first = np.unique(labels, return_index=True)
        assert root.tolist() == first[labels].tolist()


@pytest.mark.parametrize("order", ["rising", "falling", "shuffled"])
def test_union_find_on_a_long_path(order):
    nodes = np.arange(100_000)
    if order == "shuffled":
        np.random.default_rng(1).shuffle(nodes)
    nodes = torch.from_numpy(nodes[::-1].copy() if order == "falling" else nodes)
    assert not union_find(100_000, nodes[:-1], nodes[1:]).any()


# ------------------------------------------------------------------------------------------------ morphology


@pytest.mark.parametrize("shape", [(1, 1, 1), (1, 1, 9), (1, 8, 1), (2, 2, 2), (3, 13, 17), (2, 11, 12), (0, 5, 5)])
def test_closing_dilation_and_erosion_equal_scipy(shape):
    rng = np.random.default_rng(len(shape))
    square = SQUARE[None]
    for density in (0.0, 0.05, 0.1, 0.3, 0.5, 0.7, 0.95, 1.0):
        image = rng.random(shape) < density
        given = torch.from_numpy(image)
        padded = pad([given])
        before = padded.clone()
        found = morphology.close_3x3(padded, *shape[1:])
        closed = found[:, : shape[1], : shape[2]]
        assert found.shape == padded.shape and found.sum() == closed.sum()  # nothing in the margin
        assert torch.equal(padded, before)
        assert (closed | ~given).all()  # no pixel is lost
        if image.size:
            dilated = ndimage.binary_dilation(image, square)
            assert (closed.numpy() == ndimage.binary_erosion(dilated, square, border_value=1)).all()
            assert (morphology.dilate_3x3_kornia(given).numpy() == dilated).all()
            eroded = ndimage.binary_erosion(image, square, border_value=1)
            assert (morphology.erode_3x3_kornia(given).numpy() == eroded).all()


# -------------------------------------------------------------------------------------------------- segments


def test_segment_reductions():
    index = torch.tensor([2, 0, 2, 4, 0])
    values = torch.tensor([5, 3, -7, 1, 9])
    assert segment_amin(values, index, 6, 99).tolist() == [3, 99, -7, 99, 1, 99]
    assert [index[i] for i in first_of_segment(index, 6)] == index.tolist()
    assert first_of_segment(torch.tensor([3, 1, 3, 1, 0]), 4).tolist() == [0, 1, 0, 1, 4]


def test_segment_ends():
    index, values = torch.tensor([2, 0, 2, 4, 0]), torch.tensor([5, 3, -7, 1, 9])
    first, last = segment_ends(values, index, 5)
    assert first[[0, 2, 4]].tolist() == [3, -7, 1] and last[[0, 2, 4]].tolist() == [9, 5, 1]
    assert (last < first)[[1, 3]].all() and (last - first < 0)[[1, 3]].all()


def test_split_index():
    index = torch.tensor([0, 1, 6, 7, 8, 2**40, 2**62 + 5])
    for width in (1, 2, 7, 701, 2**31 + 1):
        row, col = split_index(index, width)
        assert [tuple(pair) for pair in zip(row.tolist(), col.tolist())] == [divmod(i, width) for i in index.tolist()]
        assert torch.equal(divide(index, width), row) and row.dtype == torch.int64
    assert [part.shape for part in split_index(index[:0], 3)] == [(0,), (0,)]
    assert divide(torch.tensor(7), 2) == 3 and divide(torch.tensor(7), 2).shape == ()


def test_bounding_boxes():
    rng = np.random.default_rng(5)
    index = rng.permutation(np.concatenate([np.arange(12), rng.integers(0, 12, 80)]))
    rows, cols = rng.integers(-50, 50, (2, index.size))
    first, size = bounding_boxes(*map(torch.from_numpy, (rows, cols, index)), 12)
    for segment in range(12):
        r, c = rows[index == segment], cols[index == segment]
        assert first[segment].tolist() == [r.min(), c.min()]
        assert size[segment].tolist() == [np.ptp(r) + 1, np.ptp(c) + 1]
    none = torch.zeros(0, dtype=torch.int64)
    assert [tuple(t.shape) for t in bounding_boxes(none, none, none, 0)] == [(0, 2), (0, 2)]


def test_masked_median_equals_numpy():
    rng = np.random.default_rng(6)
    for width in (1, 2, 3, 6):
        values, mask = rng.normal(size=(40, width)).round(1), rng.random((40, width)) < 0.6
        found = masked_median(torch.from_numpy(values), torch.from_numpy(mask)).tolist()
        assert found == [float(np.median(v[m])) if m.any() else 0.0 for v, m in zip(values, mask)]


# --------------------------------------------------------------------------------------------- correlation


def counts(template, target, own, engine):
    """(J, 2 (H // 2) + 1, 2 (W // 2) + 1) int64, counts of `cross_correlate`, shifts in ascending order."""
    height, width = template.shape[1:]
    templates = F.pad(template.float(), (0, width // 2, 0, height // 2))
    targets = F.pad(target.float(), (width // 2, 0, height // 2, 0))  # moved by half the size: no shift is negative
    values = cross_correlate(torch.cat((templates, targets)), len(template), own, engine)
    values = values[:, : 2 * (height // 2) + 1, : 2 * (width // 2) + 1]
    assert ((values - values.round()).abs() < 0.5).all()
    return values.round().long()


def count_directly(template: np.ndarray, target: np.ndarray) -> np.ndarray:
    """sum over p of template(p) target(p + d), for all d within half the size: pairs of pixels, one by one."""
    height, width = template.shape
    counts = np.zeros((2 * (height // 2) + 1, 2 * (width // 2) + 1), dtype=np.int64)
    for r, c in np.argwhere(template):
        for i, j in np.argwhere(target):
            dy, dx = i - r + height // 2, j - c + width // 2
            if 0 <= dy < counts.shape[0] and 0 <= dx < counts.shape[1]:
                counts[dy, dx] += 1
    return counts


@pytest.mark.parametrize("engine", ["fft", "conv"])
@pytest.mark.parametrize("shape", [(1, 1), (1, 2), (2, 1), (1, 13), (9, 1), (2, 3), (8, 8), (15, 10), (3, 60), (70, 4)])
def test_cross_correlation_counts(shape, engine):
    rng = np.random.default_rng(sum(shape))
    template, target = rng.random((5, *shape)) < 0.3, rng.random((3, *shape)) < 0.4
    template[0], target[2] = True, True
    own = np.array([2, 0, 2, 1, 0])
    found = counts(*map(torch.from_numpy, (template, target, own)), engine)
    assert found.tolist() == [count_directly(template[j], target[n]).tolist() for j, n in enumerate(own)]


@pytest.mark.parametrize("shape", [(64, 64), (16, 1024), (512, 8), (130, 200)])
@pytest.mark.parametrize("density", [0.05, 0.5, 0.99])
def test_cross_correlation_engines_agree_on_large_images(shape, density):
    generator = torch.Generator().manual_seed(shape[0])
    template, target = torch.rand((2, 2, *shape), generator=generator) < density
    own = torch.tensor([1, 0])
    assert torch.equal(counts(template, target, own, "fft"), counts(template, target, own, "conv"))


@pytest.mark.parametrize("shape", [(100, 100), (317, 401), (640, 640), (4, 3000)])
def test_fft_counts_stay_exact_on_full_images(shape):
    # The largest counts there are: the overlap of two full images is (H - |dy|) (W - |dx|).
    full = torch.ones((1, *shape), dtype=torch.bool)
    rows, cols = (side - abs(np.arange(-(side // 2), side // 2 + 1)) for side in shape)
    found = counts(full, full, torch.tensor([0]), "fft")[0].numpy()
    assert (found == rows[:, None] * cols[None]).all()


@pytest.mark.parametrize("engine", ["fft", "conv"])
def test_cross_correlation_of_empty_images_is_zero(engine):
    empty = torch.zeros((2, 6, 7), dtype=torch.bool)
    assert not counts(empty, ~empty, torch.tensor([0, 1]), engine).any()
    assert not counts(~empty, empty, torch.tensor([0, 1]), engine).any()


def test_fast_lengths():
    longest = 3 * 2**15 // 2  # an image of 2^15 pixels a side and the margin for its shifts
    used = [n for n in FAST_LENGTHS if n <= longest]
    assert used[0] == 8 and FAST_LENGTHS[len(used)] > longest
    assert all(a < b <= 1.25 * a for a, b in zip(used, FAST_LENGTHS[1:]))


@pytest.mark.cuda
@needs_gpu
@pytest.mark.parametrize("connectivity, reach", [(4, 1), (8, 1), (4, 3), (8, 3)])
def test_labelling_on_cuda_equals_cpu(connectivity, reach):
    images = torch.from_numpy(np.random.default_rng(9).random((4, 90, 80)) < 0.15)
    pixels = images.flatten().nonzero()[:, 0]
    on_cpu = connected_components(images, pixels, connectivity, reach)
    assert torch.equal(connected_components(images.cuda(), pixels.cuda(), connectivity, reach).cpu(), on_cpu)


@pytest.mark.cuda
@needs_gpu
@pytest.mark.parametrize("engine", ["fft", "conv"])
@pytest.mark.parametrize("shape", [(8, 8), (64, 64), (16, 512)])
def test_cross_correlation_on_cuda_equals_cpu(shape, engine):
    template, target = torch.rand((2, 6, *shape), generator=torch.Generator().manual_seed(2)) < 0.3
    own = torch.arange(6)
    on_gpu = counts(template.cuda(), target.cuda(), own.cuda(), engine).cpu()
    assert torch.equal(on_gpu, counts(template, target, own, "fft"))


# ------------------------------------------------------------------------------------------ of the key points


@pytest.mark.parametrize("shape", [(1, 1), (1, 7), (7, 2), (9, 13)])
def test_erode_cross_is_scipys_with_background_outside(shape):
    for seed in range(20):
        image = np.random.default_rng(seed).random((2, *shape)) < 0.8
        expected = np.stack([ndimage.binary_erosion(part, border_value=0) for part in image])
        np.testing.assert_array_equal(morphology.erode_cross(torch.from_numpy(image)).numpy(), expected)


@pytest.mark.parametrize("size", [1, 3, 7, 13])
def test_gather_patches(size):
    images = np.random.default_rng(size).random((3, 6, 9)) < 0.4
    place = [torch.from_numpy(index) for index in np.indices(images.shape).reshape(3, -1)]
    patches, energy = gather_patches(torch.from_numpy(images), *place, size)
    half = size // 2
    padded = np.pad(images, [(0, 0), (half, half), (half, half)])
    expected = [padded[b, r : r + size, c : c + size].flatten() for b, r, c in np.ndindex(images.shape)]
    np.testing.assert_array_equal(patches.numpy(), np.array(expected))
    assert energy.tolist() == [int(patch.sum()) for patch in expected]
    assert patches.dtype == torch.uint8 and energy.dtype == torch.int64


def test_nearest_set_pixel_is_the_first_of_the_nearest():
    for seed in range(20):
        rng = np.random.default_rng(seed)
        seeds = rng.random((3, 11, 8)) < (0.0, 0.02, 0.2)[seed % 3]
        seeds[1] = False
        pixels = np.sort(rng.choice(seeds.size, 60, replace=False))
        expected = []
        for image, row, col in zip(*np.unravel_index(pixels, seeds.shape)):
            places = np.argwhere(seeds[image])  # in raster order: argmin takes the first of equals
            distance = ((places - (row, col)) ** 2).sum(1)
            best = places[distance.argmin()] if len(places) else None
            expected.append(-1 if best is None else np.ravel_multi_index((image, *best), seeds.shape))
        found = nearest_set_pixel(torch.from_numpy(seeds), torch.from_numpy(pixels))
        assert found.tolist() == [int(place) for place in expected]
    assert nearest_set_pixel(torch.ones((1, 2, 2), dtype=torch.bool), torch.zeros(0, dtype=torch.int64)).shape == (0,)


def test_segment_median_is_numpys():
    rng = np.random.default_rng(0)
    for num_segments in (1, 5, 40):
        values, index = rng.integers(-4, 5, 60).astype(np.float64), rng.integers(0, num_segments, 60)
        median = segment_median(torch.from_numpy(values), torch.from_numpy(index), num_segments)
        for segment in range(num_segments):
            members = values[index == segment]
            assert median[segment] == (np.median(members) if len(members) else 0)
    nothing = torch.zeros(0, dtype=torch.float64)
    assert segment_median(nothing, torch.zeros(0, dtype=torch.int64), 3).tolist() == [0, 0, 0]
