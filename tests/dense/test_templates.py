"""Template/target pairs of clusters: which there are, where their pixels are, how far they are searched."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scenes import config, scene

from cflow_torch.dense.clustering import cluster_images
from cflow_torch.dense.templates import make_pairs
from cflow_torch.windows.bev_grid import Grid
from cflow_torch.windows.collation import make_batch


def test_pairs_by_hand():
    images = np.zeros((1, 4, 6, 30), dtype=bool)
    images[0, 0, [2, 3], 3], images[0, 1, 2, 4], images[0, 3, 1, 5] = True, True, True  # at t+1, t, t-2
    images[0, 0, 4, 20], images[0, 2, 5, 19] = True, True  # at t+1, t-1
    settings = config(num_history=2, max_extent=1000.0)
    clusters, _ = cluster_images(torch.from_numpy(images), 0.25, settings)
    grid = Grid(0.25, settings.point_cloud_range[:3], settings.point_cloud_range[3:])
    batch = make_batch([scene(0, num_history=2)], settings, grid, torch.device("cpu"))
    pairs = make_pairs(clusters, batch, 0.25, 5.0)
    assert clusters.first.tolist() == [[1, 3], [4, 19]] and pairs.size.tolist() == [[3, 3], [2, 2]]
    assert pairs.cluster.tolist() == [0, 0, 1] and pairs.source.tolist() == [0, 2, 1]
    template = sorted(zip(*(v.tolist() for v in (pairs.template.image, pairs.template.row, pairs.template.col))))
    assert template == [(0, 1, 1), (1, 0, 2), (2, 1, 0)]
    target = sorted(zip(*(v.tolist() for v in (pairs.target.image, pairs.target.row, pairs.target.col))))
    assert target == [(0, 1, 0), (0, 2, 0), (1, 0, 1)]
    # 5 m/s for 0.1 s and 0.2 s, and one pixel; t-2 is beyond this batch.
    assert pairs.radius[[0, 2]].tolist() == pytest.approx([0.5 / 0.25 + 1, 1.0 / 0.25 + 1])
    assert make_pairs(clusters, batch, 0.25, None).radius is None
    assert pairs.target.energy(2).tolist() == [2, 1]
    few = pairs.template.take(torch.tensor([False, True, True]))
    assert sorted(zip(few.image.tolist(), few.row.tolist(), few.col.tolist())) == [(0, 0, 2), (1, 1, 0)]
