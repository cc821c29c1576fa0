"""The oracle itself: cases whose answer is known by hand, and SciPy / OpenCV on random images."""

from __future__ import annotations

import math
from fractions import Fraction

import cv2
import numpy as np
import pytest
import torch
from scipy import ndimage
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import connected_components as graph_components

import oracle as ref
from cflow_torch.config import Config
from cflow_torch.types import Sweep, Window

INF = math.inf
# (row, column) pixels of an L, 6 high and 5 wide.
ELL = [(r, 10) for r in range(10, 16)] + [(15, c) for c in range(11, 15)]


def config(**overrides) -> Config:
    base = Config(pixel_sizes=(1.0,), point_cloud_range=(0.0, 0.0, -INF, 40.0, 40.0, INF), max_extent=1000.0)
    return base.replace(**overrides)


def sweep(pixels, move=(0.0, 0.0, 0.0), **fields) -> Sweep:
    """A sweep with one point in the middle of each 1 m pixel."""
    points = np.array([(c + 0.5, r + 0.5, 0.5) for r, c in pixels], dtype=np.float64).reshape(-1, 3)
    return Sweep(points + np.array(move), **fields)


def image_of(pixels, shape) -> np.ndarray:
    image = np.zeros(shape, dtype=bool)
    for r, c in pixels:
        image[r, c] = True
    return image


def same_partition(a, b) -> bool:
    """Whether two lists of labels group the same things together."""
    pairs = set(zip(a.tolist(), b.tolist()))
    return len(pairs) == len({p[0] for p in pairs}) == len({p[1] for p in pairs})


def random_images(count=12):
    rng = np.random.default_rng(7)
    for _ in range(count):
        yield rng.random(tuple(rng.integers(1, 40, 2))) < rng.choice([0.02, 0.08, 0.2, 0.5])


# ----------------------------------------------------------------------------------------------- one object


def test_ell_moved_by_whole_pixels():
    result = ref.reference_flow(Window(sweep(ELL), sweep(ELL, (2, 1, 0))), config())
    assert result.residual_flow.tolist() == [[2.0, 1.0, 0.0]] * len(ELL)
    assert result.flow.tolist() == result.residual_flow.tolist()
    assert result.pose_flow.abs().max() == 0
    assert result.cluster_id.tolist() == [0] * len(ELL)
    assert result.score.tolist() == [1.0] * len(ELL)
    assert result.is_valid.all()
    types = [t.dtype for t in (result.residual_flow, result.flow, result.pose_flow, result.cluster_id, result.score)]
    assert types == [torch.float32] * 3 + [torch.int64, torch.float32]


def test_displacement_scales_with_the_pixel_size():
    window = Window(
        Sweep(sweep(ELL).points * 0.25), Sweep(torch.tensor(sweep(ELL, (2, 1, 0)).points * 0.25, dtype=torch.float32))
    )
    flow = ref.reference_flow(window, config(pixel_sizes=(0.25,))).residual_flow
    assert flow.tolist() == [[0.5, 0.25, 0.0]] * len(ELL)


def test_ego_motion_is_removed():
    # The sensor moves 1 m along x and turns 90 degrees to the left; the object moves (2, 1) in the axes of ego1.
    pose1 = np.array([[0.0, -1, 0, 1], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
    in_ego1 = sweep(ELL).points
    in_ego0 = in_ego1 @ pose1[:3, :3].T + pose1[:3, 3]
    window = Window(Sweep(in_ego0, pose=np.eye(4)), sweep(ELL, (2, 1, 0), pose=pose1))
    result = ref.reference_flow(window, config())
    assert result.residual_flow.tolist() == [[2.0, 1.0, 0.0]] * len(ELL)
    np.testing.assert_array_equal(result.pose_flow.numpy(), (in_ego1 - in_ego0).astype(np.float32))
    np.testing.assert_array_equal(result.flow.numpy(), result.pose_flow.numpy() + np.float32([2, 1, 0]))


def test_rows_that_take_no_part():
    pixels = [*ELL, (30, 30), (12, 10)]
    pc0 = sweep(pixels, is_ground=np.array([False] * (len(ELL) + 1) + [True]))
    points = np.concatenate([pc0.points, [[np.nan, 1, 1], [1, INF, 1], [-1, 1, 1], [40, 40, 9]]])
    ground = np.concatenate([pc0.is_ground, [False] * 4])
    poses = {"pose": np.eye(4)}
    result = ref.reference_flow(Window(Sweep(points, ground, **poses), sweep(ELL, (2, 1, 0), **poses)), config())
    n = len(ELL)
    # Alone at t: valid, no cluster. Ground, NaN, inf, outside: not valid. On the upper border: valid.
    assert result.is_valid.tolist() == [True] * n + [True, False, False, False, False, True]
    assert result.cluster_id.tolist() == [0] * n + [-1] * 6
    assert result.residual_flow[n:].abs().max() == 0 and result.score[n:].abs().max() == 0
    assert torch.isfinite(result.flow).all()


@pytest.mark.parametrize("empty", ["pc0", "pc1", "both", "ground"])
def test_empty_sweeps(empty):
    nothing = Sweep(np.zeros((0, 4), dtype=np.float32))
    pc0 = nothing if empty in ("pc0", "both") else sweep(ELL)
    pc1 = nothing if empty in ("pc1", "both") else sweep(ELL)
    if empty == "ground":
        pc1 = sweep(ELL, is_ground=torch.ones(len(ELL), dtype=torch.bool))
    result = ref.reference_flow(Window(pc0, pc1, (nothing,)), config(num_history=1, sectional_view=True))
    n = len(pc0.points)
    assert result.residual_flow.shape == result.flow.shape == result.pose_flow.shape == (n, 3)
    assert result.cluster_id.shape == result.score.shape == result.is_valid.shape == (n,)
    assert (result.cluster_id == -1).all() and (result.flow == 0).all() and (result.score == 0).all()


# ----------------------------------------------------------------------------------------- points and pixels


def test_pixels_and_dimensions():
    settings = config(point_cloud_range=(-35.0, -10.0, -1.0, 35.0, 10.0, 2.0))
    assert ref.bev_dims(settings, 0.5) == (41, 141)
    assert ref.bev_dims(settings, 0.3) == (67, 234)  # 66.67 and 233.3, rounded down, plus one
    points = np.array([[-35.0, -10, 0], [-34.51, -9.0, 0], [35.0, 10.0, 0]])
    assert ref.project_bev(points, settings, 0.5).tolist() == [[0, 0], [2, 0], [40, 140]]
    on_and_off = np.array([[35, 10, 2], [-35, -10, -1], [35.001, 0, 0], [0, 0, 2.001], [np.nan, 0, 0]])
    assert ref.in_range(on_and_off, settings).tolist() == [True, True, False, False, False]


# ---------------------------------------------------------------------------------------------- clustering


def test_diagonal_pixels_join_under_8_connectivity_only():
    image = image_of([(0, 0), (1, 1), (3, 1), (3, 2)], (5, 4))
    labels8, count8 = ref.connected_components(image, 8)
    labels4, count4 = ref.connected_components(image, 4)
    assert (count8, count4) == (2, 3)
    assert labels8[image].tolist() == [1, 1, 2, 2]
    assert labels4[image].tolist() == [1, 2, 3, 3]
    assert (labels8[~image] == 0).all()


@pytest.mark.parametrize("connectivity", [4, 8])
def test_labelling_is_that_of_scipy(connectivity):
    structure = ndimage.generate_binary_structure(2, 1 if connectivity == 4 else 2)
    for image in random_images():
        labels, count = ref.connected_components(image, connectivity)
        expected, expected_count = ndimage.label(image, structure)
        assert count == expected_count
        assert same_partition(labels.ravel(), expected.ravel())


def test_morphology_is_that_of_scipy():
    square = np.ones((3, 3), dtype=bool)
    for image in random_images():
        np.testing.assert_array_equal(ref.dilate(image), ndimage.binary_dilation(image, square))
        np.testing.assert_array_equal(ref.erode(image), ndimage.binary_erosion(image, square, border_value=1))
        filled = ref.dilate(image)
        np.testing.assert_array_equal(ref.erode(filled), ndimage.binary_erosion(filled, square, border_value=1))
        assert (ref.erode(filled) >= image).all()  # a closing loses no pixel


@pytest.mark.parametrize(
    "other, clusters8, clusters4",
    [((5, 8), 1, 1), ((5, 9), 2, 2), ((8, 8), 1, 2), ((8, 7), 1, 1), ((9, 9), 2, 2)],
)
def test_dilation_bridges_two_free_pixels(other, clusters8, clusters4):
    image = image_of([(5, 5), other], (14, 14))
    for connectivity, clusters in ((8, clusters8), (4, clusters4)):
        found = ref.cluster([image, image], 1.0, 1000.0, connectivity)
        assert found.max() + 1 == clusters
        assert ((found >= 0) == image).all()


@pytest.mark.parametrize("connectivity", [4, 8])
def test_clusters_link_pixels_up_to_distance_3(connectivity):
    # Without oversized components: Chebyshev distance <= 3, less the offsets |dx| = |dy| = 3 under 4-connectivity.
    for image in random_images():
        pixels = np.argwhere(image)
        gap = np.abs(pixels[:, None] - pixels[None])
        near = gap.max(-1) <= 3
        if connectivity == 4:
            near &= gap.min(-1) < 3
        count, expected = graph_components(csr_matrix(near), directed=False)
        found = ref.cluster([image, image], 0.1, 1000.0, connectivity)
        assert found.max() + 1 == count
        assert same_partition(found[image], expected)


@pytest.mark.parametrize("connectivity", [4, 8])
def test_all_oversized_clusters_link_pixels_of_the_closing(connectivity):
    # With every component oversized: components of the closed image.
    structure = ndimage.generate_binary_structure(2, 1 if connectivity == 4 else 2)
    for image in random_images():
        closed = ndimage.binary_erosion(
            ndimage.binary_dilation(image, np.ones((3, 3))), np.ones((3, 3)), border_value=1
        )
        expected, _ = ndimage.label(closed, structure)
        found = ref.cluster([image, image], 1.0, 0.5, connectivity)
        assert same_partition(found[image], expected[image])
        assert (found[image] >= 0).all()


@pytest.mark.parametrize(
    "pixels, extent",
    [
        ([(5, 5), (8, 8)], 6),  # staggered contact of two 3 x 3 squares
        ([(0, 0), (3, 3)], 5),  # the same in the corner, where the square is clipped
        ([(13, 13), (10, 10)], 5),
    ],
)
def test_erosion_splits_an_oversized_component(pixels, extent):
    image = image_of(pixels, (14, 14))
    kept = ref.cluster([image, image], 0.5, extent * 0.5, 8)  # exactly d^max is not too large
    split = ref.cluster([image, image], 0.5, extent * 0.5 - 0.01, 8)
    assert kept[image].tolist() == [0, 0]
    assert split[image].tolist() == [0, 1]


def test_erosion_keeps_a_straight_bridge():
    image = image_of([(5, 5), (5, 8)], (14, 14))
    assert ref.cluster([image, image], 1.0, 1.0, 8)[image].tolist() == [0, 0]


def test_only_the_oversized_component_is_eroded():
    image = image_of([(1, 1), (4, 4), (7, 7), (1, 11), (4, 14)], (16, 20))
    found = ref.cluster([image, image], 1.0, 7.0, 8)  # boxes of 9 and of 6 pixels
    assert [found[p] for p in ((1, 1), (1, 11), (4, 4), (4, 14), (7, 7))] == [0, 1, 2, 1, 3]


def test_clusters_need_pixels_at_t1_and_before():
    shape = (12, 40)
    at_t1 = image_of([(9, 2), (2, 10), (2, 30)], shape)
    at_t = image_of([(9, 3), (2, 20)], shape)
    older = image_of([(1, 30), (5, 20)], shape)
    found = ref.cluster([at_t1, at_t, older], 1.0, 1000.0, 8)
    assert found[1, 30] == found[2, 30] == 0  # first in raster order, by a pixel of the oldest sweep
    assert found[9, 2] == found[9, 3] == 1
    assert found[2, 10] == found[2, 20] == found[5, 20] == -1
    assert np.count_nonzero(found >= 0) == 4


# --------------------------------------------------------------------------------------------- correlation


def test_counts_and_ncc_are_those_of_opencv():
    rng = np.random.default_rng(3)
    for height, width in [(1, 1), (1, 6), (5, 1), (4, 4), (7, 9), (31, 18), (60, 41)]:
        template = rng.random((height, width)) < 0.3
        target = rng.random((height, width)) < 0.2
        template[rng.integers(height), rng.integers(width)] = True
        above, left = height // 2, width // 2
        padded = np.pad(target, ((above, height - 1 - above), (left, width - 1 - left))).astype(np.float32)
        overlap, energy = ref.overlap_and_energy(template, target)
        expected = cv2.matchTemplate(padded, template.astype(np.float32), cv2.TM_CCORR)
        np.testing.assert_array_equal(overlap, np.rint(expected))
        ones = np.ones((height, width), dtype=np.float32)
        np.testing.assert_array_equal(energy, np.rint(cv2.matchTemplate(padded, ones, cv2.TM_CCORR)))
        scores = ref.ncc_map(template, target)
        expected = cv2.matchTemplate(padded, template.astype(np.float32), cv2.TM_CCORR_NORMED)
        np.testing.assert_allclose(scores[energy > 0], expected[energy > 0], atol=2e-6)
        assert (scores[energy == 0] == 0).all()
        assert scores.min() >= 0 and scores.max() <= 1


def test_ncc_map_by_hand():
    template = image_of([(0, 0), (1, 1)], (2, 2))
    target = image_of([(0, 0), (0, 1), (1, 1)], (2, 2))
    # Corners (-1, -1), (-1, 0), (0, -1), (0, 0) see 1, 2, 1, 3 target pixels and match 1, 1, 0, 2.
    expected = [[1 / math.sqrt(2 * 1), 1 / math.sqrt(2 * 2)], [0.0, 2 / math.sqrt(2 * 3)]]
    np.testing.assert_allclose(ref.ncc_map(template, target), expected, rtol=1e-15)


@pytest.mark.parametrize(
    "targets, displacement",
    [
        ([(2, 1), (2, 3), (1, 2), (3, 2)], (0, -1)),  # equal norm: the smallest row displacement
        ([(2, 1), (2, 3)], (-1, 0)),  # equal norm and row: the smallest column displacement
        ([(2, 3), (0, 2)], (1, 0)),  # the smallest norm comes first
        ([(1, 1), (1, 3), (3, 1), (3, 3)], (-1, -1)),
        ([(2, 2), (2, 3)], (0, 0)),
    ],
)
def test_tie_rule(targets, displacement):
    template = image_of([(2, 2)], (5, 5))
    target = image_of(targets, (5, 5))
    found, score = ref.scene_flow_in_1view(template, target, 0.5)
    assert found == (displacement[0] * 0.5, displacement[1] * 0.5)
    assert score == 1 / math.sqrt(len(targets))


def test_fewer_other_pixels_in_the_window_win():
    # The template pixel matches at -1 and at +1; the window at +1 no longer holds the first target pixel.
    template = image_of([(0, 1)], (1, 5))
    target = image_of([(0, 0), (0, 2)], (1, 5))
    found, score = ref.scene_flow_in_1view(template, target, 1.0)
    assert (found, score) == ((1.0, 0.0), 1.0)


def test_the_peak_is_that_of_the_ncc_map():
    rng = np.random.default_rng(5)
    for _ in range(40):
        height, width = rng.integers(1, 12, 2)
        template, target = rng.random((2, height, width)) < 0.3
        template[rng.integers(height), rng.integers(width)] = True
        scores = ref.ncc_map(template, target)
        (dx, dy), score = ref.scene_flow_in_1view(template, target, 1.0)
        assert score == scores[int(dy) + height // 2, int(dx) + width // 2]
        assert score == pytest.approx(scores.max(), abs=1e-15)
        rows, columns = np.nonzero(scores > scores.max() - 1e-12)
        ties = [(y * y + x * x, y, x) for y, x in zip(rows - height // 2, columns - width // 2)]
        assert (dy, dx) == min(ties)[1:]


def test_no_overlap_gives_no_motion():
    found, score = ref.scene_flow_in_1view(image_of([(0, 4)], (1, 5)), image_of([(0, 0)], (1, 5)), 1.0)
    assert (found, score) == ((0.0, 0.0), 0.0)  # -4 is outside half of the box


def test_search_range_is_half_of_the_box_and_max_speed():
    template = image_of([(0, 4)], (1, 8))
    for column, expected in [(0, -4.0), (7, 3.0)]:  # from -floor(8 / 2) to 8 - 1 - floor(8 / 2)
        target = image_of([(0, column)], (1, 8))
        assert ref.scene_flow_in_1view(template, target, 1.0)[0] == (expected, 0.0)
        assert ref.scene_flow_in_1view(template, target, 1.0, abs(expected))[0] == (expected, 0.0)
        assert ref.scene_flow_in_1view(template, target, 1.0, abs(expected) - 0.1)[0] == (0.0, 0.0)
    assert ref.search_radius(config(), 0.1, 0.5) is None
    assert ref.search_radius(config(max_speed=20.0), 0.1, 0.5) == 5.0


def test_max_speed_counts_elapsed_time():
    # 3 m in a step: 20 m/s need 0.1 s per step for a reach of 2 + 1 pixels; at 0.05 s the reach is 2 pixels.
    window = Window(sweep(ELL), sweep(ELL, (3, 0, 0)))
    fast = ref.reference_flow(window, config(max_speed=20.0)).residual_flow
    slow = ref.reference_flow(window, config(max_speed=20.0, sweep_interval=0.05)).residual_flow
    assert fast.tolist() == [[3.0, 0.0, 0.0]] * len(ELL)
    assert slow.norm(dim=1).max() <= 2
    stamped = Window(sweep(ELL, timestamp_ns=0), sweep(ELL, (3, 0, 0), timestamp_ns=50_000_000))
    assert torch.equal(ref.reference_flow(stamped, config(max_speed=20.0)).residual_flow, slow)


# ------------------------------------------------------------------------------------------- sectional view


@pytest.mark.parametrize("move", [(3, 4, 1), (-4, 3, -2), (0, 2, 1), (0, 0, 2), (3, 0, 0)])
def test_sectional_view_finds_a_vertical_move(move):
    pixels = [(r, 10) for r in range(10, 22)] + [(21, c) for c in range(11, 22)]
    low = sweep(pixels).points
    points = np.concatenate([low + [0, 0, z] for z in range(6)])
    result = ref.reference_flow(Window(Sweep(points), Sweep(points + move)), config(sectional_view=True))
    np.testing.assert_allclose(result.residual_flow.numpy(), np.tile(np.float32(move), (len(points), 1)), atol=1e-6)
    flat = ref.reference_flow(Window(Sweep(points), Sweep(points + move)), config())
    assert flat.residual_flow.tolist() == [[*map(float, move[:2]), 0.0]] * len(points)
    assert torch.equal(flat.score, result.score)


def test_sectional_view_corrects_the_motion_along_the_heading():
    # 0.8 -> 1.2: the same BEV pixel, as its grid starts at -0.25; the grid of the section starts at 0.
    settings = config(point_cloud_range=(-0.25, 0.0, -INF, 20.0, 20.0, INF), sectional_view=True)
    before = np.array([[0.8 + i, 5.5, 0.5] for i in range(4)])
    after = np.array([[1.2 + i, 5.5, 0.5] for i in range(4)])
    window = Window(Sweep(before), Sweep(after))
    assert ref.reference_flow(window, settings).residual_flow.tolist() == [[1.0, 0.0, 0.0]] * 4
    assert ref.reference_flow(window, settings.replace(sectional_view=False)).residual_flow.abs().max() == 0


# --------------------------------------------------------------------------------------------------- pooling


@pytest.mark.parametrize(
    "estimates, expected",
    [
        ([(3, -4, 2)], (3, -4, 2)),
        ([(1, 0, 0), (4, 0, 0), (2, 0, 0)], (2, 0, 0)),
        ([(1, 0, 1), (3, 0, 2)], (2, 0, 1.5)),  # even: the mean of the middle two
        ([(1, 0, 0), (0, 5, 0), (3, 0, 0)], (3, 0, 0)),  # orientation and magnitude from different estimates
        ([(3, 0, 0), (0, 1, 0)], (math.sqrt(2), math.sqrt(2), 0)),  # bisector, length (3 + 1) / 2
        ([(1, 0, 0), (-1, 0, 0)], (1, 0, 0)),  # opposite: the nearest
        ([(-1, 0, 0), (1, 0, 0)], (-1, 0, 0)),
        ([(1, 0, 0), (-1, 0, 0), (0, 1, 0)], (0, 1, 0)),
        ([(0, 2, 0), (0, -2, 0), (0, 2, 0), (0, -2, 0)], (0, 2, 0)),
        ([(-8, 6, 0), (-10, 0, 0), (-8, -6, 0)], (-10, 0, 0)),  # across the cut at 180 degrees
        ([(0, 0, 0), (2, 0, 0)], (1, 0, 0)),  # zero counts as a magnitude, has no orientation
        ([(0, 0, 0), (0, 0, 0), (3, 0, 0)], (0, 0, 0)),
        ([(0, 3, 0), (0, 0, 0), (0, 5, 0)], (0, 3, 0)),
        ([(0, 0, 1), (0, 0, 3)], (0, 0, 2)),
        ([(0, 0, 1), (0, 0, 3), (0, 0, 7)], (0, 0, 3)),
    ],
)
def test_pool(estimates, expected):
    np.testing.assert_allclose(ref.pool([np.array(e, dtype=float) for e in estimates]), expected, rtol=1e-15)


def test_diamond_angle_grows_with_the_angle():
    angles = np.linspace(-np.pi, np.pi, 401)[1:]
    for mean in (0.0, 1.0, -2.5):
        keys = [
            ref.diamond_angle(3 * np.cos(mean), 3 * np.sin(mean), np.cos(mean + a), np.sin(mean + a)) for a in angles
        ]
        assert (np.diff(keys[:-1]) > 0).all()
    assert [ref.diamond_angle(1, 0, *u) for u in ((0, -1), (1, 0), (0, 1), (-1, 0))] == [-1, 0, 1, 2]


# --------------------------------------------------------------------------------------------------- history


# Longer, so that half of the bounding box holds the whole way since t-2.
LONG_ELL = [(r, 10) for r in range(10, 16)] + [(15, c) for c in range(11, 30)]


def ell_at(*steps):
    """Sweeps of the long L displaced along x by the given metres."""
    return [sweep(LONG_ELL, (x, 0, 0)) for x in steps]


def test_history_divides_by_the_steps():
    pc1, pc0, *older = ell_at(2, 0, -4, -7)  # 2, 6 / 2, 9 / 3
    for num_history, expected in [(0, 2.0), (1, 2.5), (2, 3.0)]:
        flow = ref.reference_flow(Window(pc0, pc1, tuple(older)), config(num_history=num_history)).residual_flow
        assert flow.tolist() == [[expected, 0.0, 0.0]] * len(LONG_ELL)


def test_history_skips_a_sweep_without_the_cluster():
    pc1, pc0, older = ell_at(2, 0, -6)  # 2, nothing, 8 / 3
    gap = sweep([(35, 35)])
    flow = ref.reference_flow(Window(pc0, pc1, (gap, older)), config(num_history=2)).residual_flow
    np.testing.assert_allclose(flow[0], [(2 + 8 / 3) / 2, 0, 0], rtol=1e-6)


def test_score_is_that_of_the_newest_sweep():
    pc1, pc0 = ell_at(1, 0)
    older = sweep(LONG_ELL[:6], (-1, 0, 0))
    result = ref.reference_flow(Window(pc0, pc1, (older,)), config(num_history=1))
    assert result.score.tolist() == [1.0] * len(LONG_ELL)


def test_repeated_sweep_is_dropped_and_places_still_count():
    pc1, pc0, repeat, older = ell_at(2, 0, 0, -4)  # the repeat would vote 2 / 2; the older one has k = 3
    cases = [((repeat,), 2.0), ((repeat, older), 2.0), ((older,), 2.5), ((repeat, repeat, older), 1.75)]
    for history, expected in cases:
        flow = ref.reference_flow(Window(pc0, pc1, history), config(num_history=3)).residual_flow
        np.testing.assert_allclose(flow[0], [expected, 0, 0], rtol=1e-6)
    # Points with NaN repeat too; another pose is no repeat.
    broken = Sweep(np.concatenate([pc0.points, [[np.nan, 0, 0]]]))
    flow = ref.reference_flow(Window(broken, pc1, (broken,)), config(num_history=1)).residual_flow
    assert flow[0].tolist() == [2.0, 0.0, 0.0]
    moved = np.eye(4)
    moved[0, 3] = -2.0
    posed = Window(
        Sweep(pc0.points, pose=np.eye(4)), Sweep(pc1.points, pose=np.eye(4)), (Sweep(pc0.points, pose=moved),)
    )
    compensated, _ = ref.compensate(posed, config(num_history=1))
    assert [c.steps for c in compensated] == [1.0, 2.0]


def test_timestamps_replace_steps_on_demand():
    stamps = [300_000_000, 200_000_000, 0]
    pc1, pc0, older = (Sweep(s.points, timestamp_ns=t) for s, t in zip(ell_at(2, 0, -4), stamps))
    flow = {
        use: ref.reference_flow(Window(pc0, pc1, (older,)), config(num_history=1, use_timestamps=use)).residual_flow
        for use in (False, True)
    }
    assert flow[False][0].tolist() == [2.5, 0.0, 0.0]  # 2, 6 / 2
    assert flow[True][0].tolist() == [2.0, 0.0, 0.0]  # 2, 6 / 3


# -------------------------------------------------------------------------------------------- coarse to fine


def row_of_dots(start, count=5):
    """Points 8 m apart along x: one object with 4 m pixels, strangers with 1 m pixels."""
    return Sweep(np.array([[start + 8.0 * i, 4.5, 0.5] for i in range(count)]))


TWO_SCALES = {"pixel_sizes": (4.0, 1.0), "point_cloud_range": (0.0, 0.0, -INF, 80.0, 16.0, INF)}


def test_coarse_to_fine_adds_the_levels():
    # 3.5 -> 10.5: columns 0 -> 2 with 4 m pixels, that is 8 m; then -1 m with 1 m pixels.
    window = Window(row_of_dots(3.5), row_of_dots(10.5))
    result = ref.reference_flow(window, config(**TWO_SCALES))
    assert result.residual_flow.tolist() == [[7.0, 0.0, 0.0]] * 5
    assert result.cluster_id.tolist() == [0, 1, 2, 3, 4]  # of the finest level
    coarse = ref.reference_flow(window, config(**TWO_SCALES).replace(pixel_sizes=(4.0,)))
    assert coarse.residual_flow.tolist() == [[8.0, 0.0, 0.0]] * 5
    assert coarse.cluster_id.tolist() == [0] * 5
    fine = ref.reference_flow(window, config(**TWO_SCALES).replace(pixel_sizes=(1.0,)))
    assert fine.residual_flow.tolist() == [[-1.0, 0.0, 0.0] if x != 3.5 else [0.0] * 3 for x in window.pc0.points[:, 0]]


def test_a_point_warped_out_of_range_gets_no_more():
    settings = config(**TWO_SCALES).replace(point_cloud_range=(0.0, 0.0, -INF, 43.0, 16.0, INF))
    result = ref.reference_flow(Window(row_of_dots(3.5), row_of_dots(10.5)), settings)
    assert result.residual_flow[:, 0].tolist() == [7.0] * 4 + [8.0]  # the last point went to 43.5
    assert result.cluster_id.tolist() == [0, 1, 2, 3, -1]
    assert result.score[4] == 0 and result.is_valid.all()


def test_older_sweeps_are_warped_by_their_steps():
    # With 4 m pixels: 8 m from t, 12 / 2 m from t-1, pooled 7 m; warped by 7 and 14 m both then lie on t+1.
    window = Window(row_of_dots(11.5, 6), row_of_dots(18.5, 6), (row_of_dots(4.5, 6),))
    result = ref.reference_flow(window, config(num_history=1, **TWO_SCALES))
    assert result.residual_flow.tolist() == [[7.0, 0.0, 0.0]] * 6
    assert result.score.tolist() == [1.0] * 6


# ------------------------------------------------------------------------------------------------ key points


def keypoint_config(**overrides) -> Config:
    return config(method="keypoints", **overrides)


def matches_of(pixels, pixels1, reach=100.0, shape=(12, 12), **overrides):
    """((row, column), (dx, dy), score) of every accepted match."""
    settings = keypoint_config(**overrides)
    found = ref.match_keypoints(image_of(pixels, shape), image_of(pixels1, shape), reach, settings)
    return [((m.row, m.column), (m.dx, m.dy), m.score) for m in found]


def block(rows, columns):
    return [(r, c) for r in rows for c in columns]


@pytest.mark.parametrize(
    "pixels, inner",
    [
        ([(4, 6)], []),
        ([(2, c) for c in range(12)], []),  # a line
        (block(range(3, 8), range(2, 7)), block(range(4, 7), range(3, 6))),  # a square: its ring
        (block(range(3), range(3)), [(1, 1)]),  # in the corner: outside the image is background
        (block(range(12), range(12)), block(range(1, 11), range(1, 11))),
        ([(4, 5), (5, 4), (5, 5), (5, 6), (6, 5)], [(5, 5)]),  # a free diagonal neighbour does not matter
        ([], []),
    ],
)
def test_keypoints_are_the_boundary(pixels, inner):
    found = ref.detect_keypoints(image_of(pixels, (12, 12)))
    assert found.shape == (len(pixels) - len(inner), 2)
    assert [tuple(p) for p in found.tolist()] == sorted(set(pixels) - set(inner))


def test_keypoints_are_at_distance_1_of_the_distance_transform():
    kept = 0
    for image in random_images(20):
        for filled in (image, ref.dilate(image)):
            distance = ndimage.distance_transform_edt(np.pad(filled, 1))[1:-1, 1:-1]
            np.testing.assert_array_equal(ref.detect_keypoints(filled), np.argwhere(distance == 1))
            kept += np.count_nonzero(distance > 1)
    assert kept > 1000  # there is something to leave out


def test_descriptor_is_the_patch_with_zeros_outside():
    image = image_of(block(range(3), range(3)) + [(3, 4)], (4, 5))
    first, last = ref.describe(image, np.array([[0, 0], [3, 4]]), 3).reshape(2, 3, 3).astype(int).tolist()
    assert first == [[0, 0, 0], [0, 1, 1], [0, 1, 1]]  # (1, 1) is no key point, but occupied
    assert last == [[0, 0, 0], [0, 1, 0], [0, 0, 0]]
    wide = ref.describe(image, np.array([[1, 0]]), 5).reshape(5, 5).astype(int).tolist()
    assert wide == [[0, 0, 0, 0, 0], [0, 0, 1, 1, 1], [0, 0, 1, 1, 1], [0, 0, 1, 1, 1], [0, 0, 0, 0, 0]]


PAIR, PAIR_MOVED = [(2, 2), (2, 3)], [(2, 4), (2, 5)]


def test_a_match_by_hand():
    # A descriptor of 3 x 3 sees its pixel and the other: right and left agree on c = 2 of E = 2; crosswise c = 1.
    assert matches_of(PAIR, PAIR_MOVED, patch_size=3) == [((2, 2), (2, 0), 1.0), ((2, 3), (2, 0), 1.0)]
    # R of the best is twice that of the second best: rho = 2 asks for more.
    assert matches_of(PAIR, PAIR_MOVED, patch_size=3, ratio_threshold=2.0) == []
    assert len(matches_of(PAIR, PAIR_MOVED, patch_size=3, ratio_threshold=1.9999)) == 2
    # E = 4 and E = 2, c = 2: the upper row alone keeps two of the four.
    square = block((2, 3), (2, 3))
    found = matches_of(square[:2], [(r + 1, c) for r, c in square], patch_size=3)
    assert found == []  # the upper and the lower row of the square correlate alike
    found = matches_of(square[:2], [(r + 1, c) for r, c in square], patch_size=3, second_best_distance=1.5)
    assert found == [((2, 2), (0, 1), 2 / math.sqrt(8)), ((2, 3), (0, 1), 2 / math.sqrt(8))]


def test_a_match_lies_within_the_gate():
    exact = matches_of(PAIR, PAIR_MOVED, patch_size=3, reach=2.0)
    assert exact == [((2, 2), (2, 0), 1.0), ((2, 3), (2, 0), 1.0)]
    # Just below 2: only (2, 3) sees one, and accepts it, as it has no second best.
    assert matches_of(PAIR, PAIR_MOVED, patch_size=3, reach=1.999) == [((2, 3), (1, 0), 0.5)]
    assert matches_of([(1, 1)], [(5, 4)], reach=5.0) == [((1, 1), (3, 4), 1.0)]
    assert matches_of([(1, 1)], [(5, 5)], reach=5.0) == []
    assert matches_of([(0, 11)], [(11, 0)], reach=INF) == [((0, 11), (-11, 11), 1.0)]


def test_the_energy_of_the_candidate_counts():
    # One pixel, two candidates with E = 2 near by and one with E = 1 farther off: c = 1 in all.
    assert matches_of([(5, 5)], [(5, 6), (5, 7), (5, 1)], patch_size=3) == [((5, 5), (-4, 0), 1.0)]
    assert matches_of([(5, 5)], [(5, 6), (5, 7)], patch_size=3) == []


@pytest.mark.parametrize(
    "targets, displacement",
    [
        ([(5, 4), (5, 6), (4, 5), (6, 5)], (0, -1)),  # equal norm: the smallest row displacement
        ([(5, 4), (5, 6)], (-1, 0)),  # equal norm and row: the smallest column displacement
        ([(3, 5), (5, 6)], (1, 0)),  # the smallest norm comes first
        ([(9, 2), (9, 8), (8, 9), (8, 1)], (-4, 3)),
        ([(5, 5), (5, 4)], (0, 0)),
    ],
)
def test_ties_of_matches(targets, displacement):
    # Descriptors of one pixel are all equal; far away there is no second best.
    assert matches_of([(5, 5)], targets, patch_size=1, second_best_distance=50.0) == [((5, 5), displacement, 1.0)]
    for ratio in (1.0, 1.1):
        assert matches_of([(5, 5)], targets, patch_size=1, ratio_threshold=ratio) == []


def test_the_second_best_is_away_from_the_best():
    for distance, accepted in [(0.0, 0), (2.0, 0), (2.0001, 1)]:  # the two are 2 pixels apart
        found = matches_of([(5, 5)], [(5, 4), (5, 6)], patch_size=1, second_best_distance=distance)
        assert len(found) == accepted


@pytest.mark.parametrize(
    "counts, ratio, accepted",
    [
        ((11, 20, 10, 20), 1.1, False),  # 11 = 1.1 x 10 exactly
        ((11, 20, 10, 20), 1.0999, True),
        ((11, 25, 12, 36), 1.1, False),  # 11 / 5 = 1.1 x 12 / 6
        ((11, 25, 12, 36), 1.10004, False),  # four decimals
        ((11, 25, 12, 36), 1.09996, False),
        ((11, 25, 12, 36), 1.09994, True),
        ((5, 9, 4, 9), 1.25, False),
        ((5, 9, 5, 9), 1.0, False),
        ((2601, 2601, 2600, 2601), 1.0, True),
        ((2601, 2601, 2600, 2600), 1.0, True),
        ((2600, 2600, 2601, 2601), 1.0, False),
        ((1, 1, 1, 4), 2.0, False),
        ((1, 1, 1, 5), 2.0, True),
    ],
)
def test_ratio_test_is_strict_and_exact(counts, ratio, accepted):
    assert ref.passes_ratio_test(*counts, ratio) is accepted


def test_mutual_check():
    # Both of t take the only one of t+1; it takes the nearest.
    assert len(matches_of([(5, 4), (5, 7)], [(5, 5)], patch_size=1)) == 2
    assert matches_of([(5, 4), (5, 7)], [(5, 5)], patch_size=1, mutual_check=True) == [((5, 4), (1, 0), 1.0)]
    # Equally near: the smallest dx of t -> t+1.
    assert matches_of([(5, 4), (5, 6)], [(5, 5)], patch_size=1, mutual_check=True) == [((5, 6), (-1, 0), 1.0)]
    assert matches_of([(4, 5), (6, 5)], [(5, 5)], patch_size=1, mutual_check=True) == [((6, 5), (0, -1), 1.0)]
    # A better descriptor farther away, where E of t counts.
    alone = matches_of([(5, 3), (5, 4), (5, 9)], [(5, 5)], patch_size=3, mutual_check=True)
    assert alone == [((5, 9), (-4, 0), 1.0)]
    # That one is outside the gate.
    near = matches_of([(5, 3), (5, 4), (5, 9)], [(5, 5)], patch_size=3, mutual_check=True, reach=3.0)
    assert near == [((5, 4), (1, 0), 1 / math.sqrt(2))]


def test_quotients_of_counts_rank_as_fractions():
    counts = [(c, e) for e in range(2561, 2602, 4) for c in range(2301, e + 1, 3)]
    exact = sorted(counts, key=lambda n: Fraction(n[0] * n[0], n[1]))
    for (c, e), (c1, e1) in zip(exact, exact[1:]):
        assert (c * c / e < c1 * c1 / e1) == (c * c * e1 < c1 * c1 * e)


@pytest.mark.parametrize("mutual_check", [False, True])
@pytest.mark.parametrize("second_best_distance, ratio", [(0.0, 1.0), (0.0, 1.1), (2.0, 1.05), (3.5, 1.2)])
def test_matches_are_those_of_all_pairs_in_fractions(second_best_distance, ratio, mutual_check):
    settings = keypoint_config(
        patch_size=5, ratio_threshold=ratio, second_best_distance=second_best_distance, mutual_check=mutual_check
    )
    rng = np.random.default_rng(11)
    total = 0
    for reach in (2.0, 3.3, 4.0, 60.0):
        images = rng.random((2, 13, 16)) < 0.3
        found = ref.match_keypoints(images[0], images[1], reach, settings)
        sides = [[tuple(p) for p in ref.detect_keypoints(image).tolist()] for image in images]
        patches = [
            dict(zip(side, ref.describe(image, np.array(side), 5).astype(int))) for side, image in zip(sides, images)
        ]

        def order(p, q, energy, patches=patches):  # best first
            c, (dy, dx) = int(patches[0][p] @ patches[1][q]), (q[0] - p[0], q[1] - p[1])
            return -Fraction(c * c, int(energy.sum())), dx * dx + dy * dy, dy, dx

        expected = []
        for p in sides[0]:
            ranked = sorted((*order(p, q, patches[1][q]), q) for q in sides[1] if math.dist(p, q) <= reach)
            if not ranked:
                continue
            rank, _, dy, dx, best = ranked[0]
            others = [other for other in ranked[1:] if math.dist(other[-1], best) >= second_best_distance]
            if others and not -rank > Fraction(str(ratio)) ** 2 * -others[0][0]:
                continue
            viewers = [v for v in sides[0] if math.dist(v, best) <= reach]
            if mutual_check and min(viewers, key=lambda v: order(v, best, patches[0][v])) != p:
                continue
            expected.append((*p, dx, dy))
        assert [m[:4] for m in found] == expected
        for m in found:
            a, b = patches[0][m.row, m.column], patches[1][m.row + m.dy, m.column + m.dx]
            assert m.score == pytest.approx(a @ b / (np.linalg.norm(a) * np.linalg.norm(b)), abs=1e-15)
        total += len(found)
    assert total > 0


def test_gate_of_keypoints():
    assert ref.gate(config(gate_radius=3.0), 0.1, 0.5) == 6.0
    assert ref.gate(config(gate_radius=3.0), 0.05, 0.5) == 3.0  # metres per 0.1 s
    assert ref.gate(config(gate_radius=3.0, max_speed=20.0), 0.1, 0.5) == 5.0  # 2 m and one pixel
    assert ref.gate(config(gate_radius=3.0, max_speed=50.0), 0.1, 0.5) == 6.0
    # 3 m in a step; the time stamps say 0.05 s.
    for stamps, expected in [((0, 100_000_000), 3.0), ((0, 50_000_000), 0.0), ((None, 50_000_000), 3.0)]:
        pc0, pc1 = sweep([(5, 5)], timestamp_ns=stamps[0]), sweep([(5, 8)], timestamp_ns=stamps[1])
        flow = ref.reference_flow(Window(pc0, pc1), keypoint_config(gate_radius=3.0)).residual_flow
        assert flow.tolist() == [[expected, 0.0, 0.0]]
    slow = keypoint_config(gate_radius=3.0, max_speed=10.0)
    assert ref.reference_flow(Window(sweep([(5, 5)]), sweep([(5, 8)])), slow).residual_flow.abs().max() == 0


def test_median_of_components():
    image = image_of([(0, 0), (0, 1), (1, 2), (4, 4), (6, 0), (6, 1)], (8, 8))
    matches = [
        ref.Match(0, 0, 1, -1, 0.5),
        ref.Match(0, 1, 4, 1, 1.0),
        ref.Match(6, 0, 7, 1, 0.25),
        ref.Match(6, 1, 2, 6, 0.75),
    ]
    ids = ref.connected_components(image, 8)[0] - 1
    motions = ref.median_of_components(ids, matches)
    assert ids[image].tolist() == [0, 0, 0, 1, 2, 2] and (ids[~image] == -1).all()
    assert motions == [(2.5, 0.0, 0.75), (0.0, 0.0, 0.0), (4.5, 3.5, 0.5)]  # (4, 4) without a match keeps its number
    assert math.copysign(1, motions[0].dy) == 1
    motions = ref.median_of_components(ids, [*matches, ref.Match(1, 2, 9, 9, 0.875)])
    assert motions[0] == (4, 1, 0.875)  # odd: the middle of each
    ids = ref.connected_components(image, 4)[0] - 1
    motions = ref.median_of_components(ids, matches)
    assert ids[image].tolist() == [0, 0, 1, 2, 3, 3]
    assert motions[1] == (0.0, 0.0, 0.0)


def test_nearest_match():
    image = image_of([(2, 2), (2, 4), (2, 5), (2, 6), (4, 4)], (8, 8))
    matches = [ref.Match(2, 2, 1, 0, 0.5), ref.Match(2, 6, 2, 0, 0.75)]
    ids, motions = ref.nearest_match(image, matches)
    assert ids[image].tolist() == [0, 0, 1, 1, 0]  # (2, 4) and (4, 4) are equally near: smallest column
    assert motions == [(1, 0, 0.5), (2, 0, 0.75)]
    ids, _ = ref.nearest_match(
        image_of([(2, 4), (4, 2), (4, 4)], (8, 8)), [ref.Match(2, 4, 0, 0, 1.0), ref.Match(4, 2, 0, 0, 1.0)]
    )
    assert ids[4, 4] == 0  # equally near: smallest row
    ids, motions = ref.nearest_match(image, [])
    assert (ids == -1).all() and motions == []


def test_keypoints_find_an_ell_and_keep_what_has_no_match():
    strangers = [(2, 30), (30, 5)]
    window = Window(sweep([*ELL, *strangers]), sweep(ELL, (2, 1, 0)))
    result = ref.reference_flow(window, keypoint_config(gate_radius=4.0))
    n = len(ELL)
    assert result.residual_flow.tolist() == [[2.0, 1.0, 0.0]] * n + [[0.0, 0.0, 0.0]] * 2
    assert result.cluster_id.tolist() == [1] * n + [0, 2]  # raster order of I_t, with or without a match
    assert result.score.tolist() == [1.0] * n + [0.0, 0.0]
    assert result.is_valid.all()
    nearest = ref.reference_flow(window, keypoint_config(gate_radius=4.0, densify="nearest"))
    assert nearest.residual_flow.tolist() == [[2.0, 1.0, 0.0]] * (n + 2)
    assert sorted(set(nearest.cluster_id.tolist())) == list(range(nearest.cluster_id.max() + 1))
    assert (nearest.score == 1).all()
    small = Window(*(Sweep(s.points * 0.25) for s in (window.pc0, window.pc1)))
    scaled = ref.reference_flow(small, keypoint_config(gate_radius=1.0, pixel_sizes=(0.25,)))
    assert torch.equal(scaled.residual_flow, result.residual_flow * 0.25)


def test_half_a_pixel_is_not_minus_zero():
    # Two pixels of one component, matched one to the left and one to the right: the median is +0.
    settings = keypoint_config(patch_size=1, gate_radius=1.0)
    result = ref.reference_flow(Window(sweep([(5, 5), (5, 6)]), sweep([(5, 4), (5, 7)])), settings)
    assert result.score.tolist() == [1.0, 1.0]
    assert result.residual_flow.tolist() == [[0.0, 0.0, 0.0]] * 2
    assert not torch.signbit(result.residual_flow).any()


def test_clusters_are_those_of_the_dense_method_in_sweep_t():
    # Two pixels apart: one cluster after the dilation, two components without.
    pc0 = sweep([(5, 5), (5, 7), (5, 12)])  # row, column
    window = Window(pc0, sweep([(6, 5), (6, 12)]))
    together = keypoint_config(patch_size=1, gate_radius=1.0, densify="clusters")
    result = ref.reference_flow(window, together)
    assert result.cluster_id.tolist() == [0, 0, 1] and result.score.tolist() == [1.0] * 3
    assert result.residual_flow.tolist() == [[0.0, 1.0, 0.0]] * 3
    apart = ref.reference_flow(window, together.replace(densify="components"))
    assert apart.cluster_id.tolist() == [0, 1, 2] and apart.score.tolist() == [1.0, 0.0, 1.0]


@pytest.mark.parametrize("densify", ["components", "clusters", "nearest"])
def test_rows_that_take_no_part_in_keypoints(densify):
    pc0 = sweep([*ELL, (12, 11)], is_ground=np.array([False] * len(ELL) + [True]))
    points = np.concatenate([pc0.points, [[np.nan, 1, 1], [1, INF, 1], [-1, 1, 1]]])
    ground = np.concatenate([pc0.is_ground, [False] * 3])
    window = Window(Sweep(points, ground), sweep(ELL, (2, 1, 0)))
    result = ref.reference_flow(window, keypoint_config(gate_radius=4.0, densify=densify))
    n = len(ELL)
    assert result.is_valid.tolist() == [True] * n + [False] * 4
    assert result.residual_flow.tolist() == [[2.0, 1.0, 0.0]] * n + [[0.0] * 3] * 4
    assert result.cluster_id[n:].tolist() == [-1] * 4 and (result.cluster_id[:n] >= 0).all()
    assert result.score.tolist() == [1.0] * n + [0.0] * 4
    assert torch.isfinite(result.flow).all()


@pytest.mark.parametrize("densify", ["components", "clusters", "nearest"])
@pytest.mark.parametrize("empty", ["pc0", "pc1", "both"])
def test_empty_sweeps_of_keypoints(empty, densify):
    nothing = Sweep(np.zeros((0, 4), dtype=np.float32))
    pc0 = nothing if empty in ("pc0", "both") else sweep(ELL)
    pc1 = nothing if empty in ("pc1", "both") else sweep(ELL)
    result = ref.reference_flow(Window(pc0, pc1), keypoint_config(densify=densify, mutual_check=True))
    n = len(pc0.points)
    assert result.residual_flow.shape == (n, 3) and (result.flow == 0).all() and (result.score == 0).all()
    # A component keeps its number without any match; a match that is not there has none.
    assert result.cluster_id.tolist() == [-1 if densify == "nearest" else 0] * n


@pytest.mark.parametrize("densify", ["components", "nearest"])
def test_keypoints_coarse_to_fine(densify):
    # As for the dense method: 8 m with 4 m pixels, then -1 m. Dots 8 pixels apart all look alike with 1 m pixels.
    settings = keypoint_config(**TWO_SCALES, densify=densify, gate_radius=9.0, second_best_distance=9.0)
    window = Window(row_of_dots(3.5), row_of_dots(10.5))
    result = ref.reference_flow(window, settings)
    assert result.residual_flow.tolist() == [[7.0, 0.0, 0.0]] * 5
    assert result.cluster_id.tolist() == [0, 1, 2, 3, 4] and result.score.tolist() == [1.0] * 5
    # The last dot is warped to 43.5.
    narrow = settings.replace(point_cloud_range=(0.0, 0.0, -INF, 43.0, 16.0, INF))
    result = ref.reference_flow(window, narrow)
    assert result.residual_flow[:, 0].tolist() == [7.0] * 4 + [8.0]
    assert result.cluster_id.tolist() == [0, 1, 2, 3, -1]
    assert result.score[4] == 0 and result.is_valid.all()


# ------------------------------------------------------------------------------------------------ properties


def scene(seed):
    rng = np.random.default_rng(seed)
    return [Sweep(rng.uniform([0, 0, 0], [40, 40, 3], (60, 3))) for _ in range(4)]


SETTINGS = {"num_history": 2, "sectional_view": True, "pixel_sizes": (2.0, 1.0, 0.5), "max_extent": 9.0}


def test_order_of_points_does_not_matter():
    pc0, pc1, *older = scene(1)
    result = ref.reference_flow(Window(pc0, pc1, tuple(older)), config(**SETTINGS)).numpy()
    order = np.random.default_rng(2).permutation(60)
    shuffled = Window(Sweep(pc0.points[order]), Sweep(pc1.points[::-1]), tuple(Sweep(s.points[order]) for s in older))
    again = ref.reference_flow(shuffled, config(**SETTINGS)).numpy()
    for name, values in again.items():
        np.testing.assert_array_equal(values, result[name][order], err_msg=name)
    assert (result["cluster_id"] >= 0).any() and np.abs(result["residual_flow"]).max() > 0


def test_shift_by_whole_pixels_shifts_the_scene():
    sweeps = [Sweep(np.floor(s.points * 8) / 8) for s in scene(4)]  # eighths of a metre: shifts are exact
    settings = config(**SETTINGS).replace(sectional_view=False)
    moved = [Sweep(s.points + [6.0, -4.0, 0.0]) for s in sweeps]
    box = config(**SETTINGS).point_cloud_range
    shifted = settings.replace(point_cloud_range=(box[0] + 6, box[1] - 4, -INF, box[3] + 6, box[4] - 4, INF))
    first = ref.reference_flow(Window(sweeps[0], sweeps[1], tuple(sweeps[2:])), settings)
    second = ref.reference_flow(Window(moved[0], moved[1], tuple(moved[2:])), shifted)
    assert torch.equal(first.cluster_id, second.cluster_id) and torch.equal(first.score, second.score)
    # Warped positions are sums of fractions (k, bisectors): the same motion up to rounding.
    torch.testing.assert_close(first.residual_flow, second.residual_flow, atol=1e-6, rtol=0)
