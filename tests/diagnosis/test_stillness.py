import numpy as np
import pytest

from cflow_torch.diagnosis.stillness import IN_PLACE, Structure, static_rows, thinned_rows
from cflow_torch.transforms import transform_points


def test_the_share_equals_that_of_all_pairwise_distances():
    random = np.random.default_rng(0)
    source = random.uniform(-1.5, 1.5, (400, 3))
    target = random.uniform(-1.5, 1.5, (900, 3))
    angle = np.radians(20)
    T = np.eye(4)
    T[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    T[:3, 3] = 0.2, -0.1, 0.05
    distances = np.linalg.norm(transform_points(source, T)[:, None] - target[None], axis=2)
    expected = (distances.min(axis=1) <= IN_PLACE).mean()
    assert 0.05 < expected < 0.95
    assert Structure(target).share(source, T) == expected


def test_empty_and_absurd_inputs_have_a_share():
    points = np.ones((3, 3))
    far = np.eye(4)
    far[:3, 3] = 1e12
    assert np.isnan(Structure(points).share(points[:0], np.eye(4)))
    assert Structure(points[:0]).share(points, np.eye(4)) == 0
    assert Structure(points).share(points, far) == 0


def test_thinning_keeps_one_point_of_each_voxel():
    points = np.array([[0.1, 0.1, 0.1], [0.2, 0.2, 0.2], [-0.1, 0.1, 0.1], [5.0, 0.1, 0.1], [-0.2, 0.1, 0.2]])
    kept = thinned_rows(points).tolist()
    assert kept == sorted(kept) and len(kept) == 3
    assert (0 in kept) != (1 in kept) and (2 in kept) != (4 in kept) and 3 in kept
    rows = np.arange(1000.0)
    crowded = np.column_stack([rows // 10, rows % 10 / 40, 0 * rows])  # ten points in each of 100 voxels
    assert 2 < (thinned_rows(crowded) % 10).mean() < 7  # not always the first
    assert thinned_rows(points[:0]).tolist() == []


@pytest.mark.parametrize("has_mask", [True, False])
def test_static_rows_leave_out_ground_the_vehicle_and_what_is_far_or_missing(has_mask):
    grid = np.stack(np.meshgrid(np.arange(-30, 30, 0.4), np.arange(-30, 30, 0.4)), 2).reshape(-1, 2)
    ground = np.column_stack([grid, np.full(len(grid), -1.7)])
    others = np.array([[10.0, 3, 0], [0.5, 0, 0], [60, 0, 0], [np.nan, 0, 0]])
    points = np.vstack([ground, others]).astype(np.float32)
    mask = np.arange(len(points)) < len(ground) if has_mask else None
    assert static_rows(points, mask).tolist() == [len(ground)]
