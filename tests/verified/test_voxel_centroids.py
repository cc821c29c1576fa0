"""Voxels: the oracle's centroids and nearest ones, borders."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from moving_scenes import LOWER, moving_scene, one_object
from oracle import voxels as oracle
from oracle.registration import NUM_LAYERS

from cflow_torch.verified.voxel_centroids import UNITS, Voxels


@pytest.mark.parametrize("snap", [0.0, 1 / 16])
def test_centroids_and_nearest_equal_the_oracle(snap):
    """Places on a lattice: several voxels are equally near, and positions may lie outside of the image."""
    scene, rng = moving_scene([3, 4, 5], 3, snap=snap, num_points=300), np.random.default_rng(0)
    voxels = Voxels(scene.points(), scene.sweeps, NUM_LAYERS)
    names = list(zip(*(v.tolist() for v in (voxels.window, voxels.step, voxels.layer, voxels.object_id))))
    positions = list(zip(voxels.position.real.tolist(), voxels.position.imag.tolist(), voxels.height.tolist()))
    first, expected, windows = 0, [], scene.windows()
    listed = [oracle.centroids(window.points(), window.sweeps) for window in windows]
    for number, of_window in enumerate(listed):
        expected += [((number, v.step, v.layer, v.object_id + first), (v.x, v.y, v.z)) for v in of_window.values()]
        first += windows[number].num_objects
    assert sorted(zip(names, positions)) == sorted(expected)

    at = torch.from_numpy(rng.integers(0, len(names), 300))
    position = voxels.position[at] + torch.complex(
        *torch.from_numpy(rng.choice([-96.0, -51, 0, 32, 64, -4000], (2, 300)))
    )
    height = voxels.height[at] + torch.from_numpy(rng.choice([-64.0, 0, 32, 64], 300))
    step, num_found = torch.from_numpy(rng.integers(0, 3, 300)), 0
    found = voxels.nearest(voxels.window[at] * 3 + step, voxels.layer[at], position, height).tolist()
    for i, (number, _, layer, _) in enumerate(names[j] for j in at.tolist()):
        x, y = torch.view_as_real(position[i]).tolist()
        wanted = oracle.nearest(listed[number], int(step[i]), layer, x, y, float(height[i]), windows[number].sweeps)
        if wanted is None:
            assert found[i] == len(names)
        else:
            num_found += 1
            assert (*names[found[i]][:3], *positions[found[i]]) == (number, *wanted[:2], *wanted[3:6])
    assert 50 < num_found < 300


def test_nearest_does_not_look_across_the_border():
    """A voxel in the first column is no neighbour of the last column of the row above."""
    cloud = np.array([[LOWER[0] + 0.12, 0.05, 0.2], [LOWER[0] + 0.02, 0.05, 0.7]])
    scene = one_object([cloud, cloud], (0.0, 0.0))
    voxels = Voxels(scene.points(), scene.sweeps, NUM_LAYERS)
    row, none = int((0.05 - LOWER[1]) / 0.1), 4
    y = [float(int((row + move + 0.5) * 0.1 * UNITS)) for move in (-2, -1, 0, 1, 2, 0, 0)]
    x = [float(int((scene.sweeps.grid.width - at) * 0.1 * UNITS)) for at in (0.5, 0.5, 0.5, 1.5, 1.5)] + [120.0, 20.0]
    zero, position = torch.zeros(7, dtype=torch.int64), torch.complex(*torch.tensor([x, y], dtype=torch.float64))
    own = int(((voxels.step == 0) & (voxels.layer == 2)).nonzero())
    found = voxels.nearest(zero, zero + 2, position, 205.0 + zero).tolist()
    assert found == [none] * 5 + [own, own]  # from the first column one looks in the first three
