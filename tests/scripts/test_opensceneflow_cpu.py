"""The replacements of OpenSceneFlow's compiled extensions compute what dense loops compute."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch

pytest.importorskip("scipy")


@pytest.fixture()
def cpu(script: Any) -> Any:
    return script("benchmarks", "opensceneflow_cpu")


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
        torch.testing.assert_close(distance[k], nearest[k].values.detach())
        torch.testing.assert_close(gradients[k], clouds[k].grad)


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
        torch.testing.assert_close(found.dists[b, :rows, 0], dense.min(1).values)
        assert torch.equal(found.knn[b, :rows, 0], clouds[1][b, dense.argmin(1)])
    assert not found.dists[1, 12:].any()


def test_angles_of_a_rotation(cpu: Any) -> None:
    angles = np.array([0.7, -0.4, 0.2])
    (cz, cy, cx), (sz, sy, sx) = np.cos(angles), np.sin(angles)
    about_z, about_y = (
        np.array([[cz, -sz, 0], [sz, cz, 0], [0, 0, 1]]),
        np.array([[cy, 0, sy], [0, 1, 0], [-sy, 0, cy]]),
    )
    about_x = np.array([[1, 0, 0], [0, cx, -sx], [0, sx, cx]])
    found = cpu.euler_angles(torch.from_numpy(about_z @ about_y @ about_x)[None], "ZYX")
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
    torch.testing.assert_close(found.reshape(-1), dense)
