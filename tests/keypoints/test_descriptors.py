"""Key points compared with a distance transform."""

from __future__ import annotations

import numpy as np
import torch
from scipy import ndimage

from cflow_torch.keypoints.descriptors import detect


def test_keypoints_are_at_distance_one():
    rng = np.random.default_rng(0)
    for density in (0.02, 0.3, 0.7, 0.95, 1.0, 0.0):
        image = rng.random((23, 31)) < density
        distance = ndimage.distance_transform_edt(np.pad(image, 1))[1:-1, 1:-1]  # outside the image is background
        assert np.array_equal(detect(torch.from_numpy(image)).numpy(), distance == 1)
