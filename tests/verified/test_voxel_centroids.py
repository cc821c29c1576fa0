"""Voxels: the oracle's centroids and nearest ones, borders."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from moving_scenes import LOWER, moving_scene, one_object
from oracle import voxel_centroids as oracle

from cflow_torch.verified.voxel_centroids import UNITS, Voxels


@pytest.mark.parametrize("snap", [0.0, 1 / 16])
def test_centroids_and_nearest_equal_the_oracle(snap):
    """Places on a lattice: several voxels are equally near, and places may lie outside of the image."""
    scene, rng = moving_scene([3, 4, 5], 3, snap=snap, num_points=300), np.random.default_rng(0)
    voxels = Voxels(scene.points(), scene.sweeps)
    names = list(zip(*(v.tolist() for v in (voxels.window, voxels.step, voxels.part, voxels.owner))))
    places = list(zip(voxels.x.tolist(), voxels.y.tolist()))
    first, expected = 0, []
    listed = [oracle.centroids(window.points(), window.sweeps) for window in scene.windows()]
    for window, of_window in enumerate(listed):
        expected += [((window, v.step, v.part, v.owner + first), (v.x, v.y)) for v in of_window.values()]
        first += scene.windows()[window].num_objects
    assert sorted(zip(names, places)) == sorted(expected)

    at = torch.from_numpy(rng.integers(0, len(names), 300))
    x, y = (v[at] + torch.from_numpy(rng.choice([-96.0, -51, 0, 32, 64, -4000], 300)) for v in (voxels.x, voxels.y))
    step = torch.from_numpy(rng.integers(0, 3, 300))
    found = voxels.nearest(voxels.window[at], step, voxels.part[at], x, y).tolist()
    num_found = 0
    for i, (of_window, _, part, _) in enumerate(names[j] for j in at.tolist()):
        wanted = oracle.nearest(listed[of_window], int(step[i]), part, float(x[i]), float(y[i]), 0.1)
        if wanted is None:
            assert found[i] == len(names)
        else:
            num_found += 1
            assert (*names[found[i]][:3], *places[found[i]]) == (of_window, *wanted[:2], *wanted[3:5])
    assert 50 < num_found < 300


def test_nearest_does_not_look_across_the_border():
    """A voxel in the first column is no neighbour of the last column of the row above."""
    cloud = np.array([[LOWER[0] + 0.02, 0.05, 0.2]])
    scene = one_object([cloud, cloud], (0.0, 0.0))
    voxels = Voxels(scene.points(), scene.sweeps)
    zero, row = torch.zeros(6, dtype=torch.int64), int((0.05 - LOWER[1]) / 0.1)
    y = torch.tensor([float(int((row + move + 0.5) * 0.1 * UNITS)) for move in (-2, -1, 0, 1, 2, 0)])
    x = torch.full_like(y, int((scene.sweeps.grid.width - 0.5) * 0.1 * UNITS))
    x[-1] = 20
    assert voxels.nearest(zero, zero, zero, x.double(), y.double()).tolist() == [2, 2, 2, 2, 2, 0]
